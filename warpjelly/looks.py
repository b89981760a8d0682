"""What a surface looks like: the inputs of a UsdPreviewSurface, as numbers, colours and textures."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

log = logging.getLogger("warpjelly")


@dataclass(frozen=True)
class Placing:
    """Where in an image a UV is: it is scaled, turned, and then moved, as by a UsdTransform2d."""

    rotation: float = 0.0
    """Counterclockwise [deg]."""
    scale: tuple[float, float] = (1.0, 1.0)
    translation: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Texture:
    """An image that gives an input its values, at the UVs of the corners; v points up in it."""

    name: str
    """Name of a file for it."""
    data: bytes = field(repr=False)
    """Content of that file: PNG, JPEG or what else a viewer reads."""
    channel: str = "rgb"
    """What of the image is taken: rgb, r, g, b or a."""
    srgb: bool = False
    """Whether its colours are in sRGB; otherwise its values are taken as they are."""
    wrap: tuple[str, str] = ("repeat", "repeat")
    """What is beyond the image along u and v: repeat, clamp, mirror, black or, as the image says, useMetadata."""
    scale: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    """Factors of red, green, blue and alpha."""
    bias: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    """What is added to them thereafter."""
    placing: Placing = Placing()

    def of(self, channel: str) -> Self:
        """Return another channel of the same texture."""
        return replace(self, channel=channel)


# What an input can be: a number, a colour or what an image says.
Value = float | tuple[float, float, float] | Texture


@dataclass(frozen=True)
class Look:
    """A material."""

    name: str
    inputs: Mapping[str, Value]
    """Named as those of a UsdPreviewSurface; colours are linear. What is not here has the default."""


# Scale and bias of a map whose colours from 0 to 1 are normals from -1 to 1.
NORMAL_SCALE, NORMAL_BIAS = (2.0, 2.0, 2.0, 1.0), (-1.0, -1.0, -1.0, 0.0)


def shininess_roughness(exponent: float) -> float:
    """Return the roughness of a UsdPreviewSurface whose highlights are as wide as Blinn's with an exponent."""
    return (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25


# How images begin: PNG, JPEG, WebP, TIFF, BMP, GIF, EXR, HDR, DDS, KTX2; and extensions of those without such a sign.
_SIGNATURES = (
    *(b"\x89PNG", b"\xff\xd8\xff", b"RIFF", b"II*\0", b"MM\0*", b"BM", b"GIF8", b"\x76\x2f\x31\x01"),
    *(b"#?RADIANCE", b"DDS ", b"\xabKTX"),
)
_UNSIGNED = (".tga", ".pic", ".psd")


def image_file(model: Path, path: Path) -> Path:
    """Return the file of an image that a model names: beside the model, where the path belongs to another machine."""
    folder = model.parent
    return folder / path if os.path.exists(folder / path) else folder / path.name


class Images:
    """The image files that a model names, each of which is read once."""

    def __init__(self, model: Path) -> None:
        self._model = model
        self._read: dict[str, tuple[str, bytes] | None] = {}

    def read(self, name: str) -> tuple[str, bytes] | None:
        """Return name, without its folder, and content of a file; None, after a warning, if that is no image."""
        if name not in self._read:
            self._read[name] = self._found(Path(name.replace("\\", "/")))
        return self._read[name]

    def _found(self, path: Path) -> tuple[str, bytes] | None:
        try:
            data = image_file(self._model, path).read_bytes()
            if not (data.startswith(_SIGNATURES) or path.suffix.lower() in _UNSIGNED):
                log.warning("%s: the texture %s is left out: it is not an image of a known format", self._model, path)
                return None
            return path.name, data
        # A name that no file can have is a ValueError.
        except (OSError, ValueError) as error:
            why = getattr(error, "strerror", None) or error
            log.warning("%s: the texture %s cannot be read: %s", self._model, str(path).replace("\0", "?"), why)
            return None
