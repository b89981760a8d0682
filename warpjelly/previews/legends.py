"""What the colours of a stage mean, in words, as pictures and pages say it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd

from ..colors import range_in_words, srgb_from_linear


@dataclass(frozen=True)
class Legend:
    """The legend of a stage."""

    low: str
    """At the lower end of the colour map."""
    high: str
    """At its upper end."""
    caption: str
    """Between them: the quantity, and its unit."""
    springs: dict[str, list[int]]
    """The colours of the kinds of springs that are shown, sRGB, 0 to 255."""


def legend_of(stage: Usd.Stage) -> Legend | None:
    """Return the legend of a stage; None where its colours have no meaning."""
    found = stage.GetDefaultPrim().GetCustomDataByKey("legend") if stage.GetDefaultPrim() else None
    if not found:
        return None
    low, high = range_in_words(tuple(found["range"]))
    springs = {
        name: np.rint(srgb_from_linear(np.array(color)) * 255).astype(int).tolist()
        for name, color in found.get("springs", {}).items()
    }
    return Legend(low, high, f"{found['quantity']}, {found['unit']}", springs)
