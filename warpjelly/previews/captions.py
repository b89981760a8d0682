"""What is written on pictures: the time of each, and what the colours mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Usd

from ..colors import SRGB_TABLE
from .legends import Legend, legend_of

_INK = (70, 74, 84)
_GAP = 4


def captioned(stage: Usd.Stage, frames: Sequence[int], panels: Sequence[np.ndarray], *, with_legend: bool) -> Any:
    """Return pictures [height, width, 3] side by side, the time below each and the legend beside the last."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = panels[0].shape[:2]
    picture = Image.new("RGB", (len(panels) * (width + _GAP) - _GAP, height), "white")
    draw = ImageDraw.Draw(picture)
    text = max(10, round(height / 34))
    font = ImageFont.load_default(text)
    for i, (frame, panel) in enumerate(zip(frames, panels, strict=True)):
        left = i * (width + _GAP)
        picture.paste(Image.fromarray(panel), (left, 0))
        label = f"{frame / stage.GetTimeCodesPerSecond():.3f} s   frame {frame}"
        draw.text((left + text, height - text), label, fill=_INK, font=font, anchor="ls")

    legend = legend_of(stage)
    if legend and height >= 120:
        if with_legend:
            _draw_force_legend(picture, draw, font, legend, width)
        _draw_spring_legend(picture, draw, font, legend.springs)
    return picture


def _draw_force_legend(picture: Any, draw: Any, font: Any, legend: Legend, width: int) -> None:
    """Draw the colour map of forces into the lower right corner; a frame is ``width`` pixels wide."""
    from PIL import Image

    text, height = font.size, picture.height
    low, caption, high = legend.low, legend.caption, legend.high
    # The bar is as wide as its captions need, a line's height between them; the middle one is centred.
    needed = font.getlength(caption) + 2 * max(font.getlength(low), font.getlength(high)) + 2 * text
    bar = Image.fromarray(np.rint(SRGB_TABLE[None] * 255).astype(np.uint8))
    bar = bar.resize((max(width // 5, round(needed)), max(text // 2, 4)))
    left, top = picture.width - bar.width - text, height - 2 * text - bar.height - 2
    picture.paste(bar, (left, top))
    for x, label, anchor in (
        (left, low, "ls"),
        (left + bar.width / 2, caption, "ms"),
        (left + bar.width, high, "rs"),
    ):
        draw.text((x, height - text), label, fill=_INK, font=font, anchor=anchor)


def _draw_spring_legend(picture: Any, draw: Any, font: Any, colors: Mapping[str, list[int]]) -> None:
    """Name the kinds of springs in their colours, sRGB, in the upper right corner."""
    text, right = font.size, picture.width - font.size
    for name, color in reversed(list(colors.items())):
        draw.text((right, 2 * text), name, fill=_INK, font=font, anchor="rs")
        right -= round(font.getlength(name)) + text // 2
        draw.rectangle([right - text // 2, 2 * text - text // 2, right, 2 * text], fill=tuple(color))
        right -= 3 * text // 2
