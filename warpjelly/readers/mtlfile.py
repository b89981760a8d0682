"""Read the materials of an MTL file, which OBJ files name."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..looks import NORMAL_BIAS, NORMAL_SCALE, Images, Look, Placing, Texture, Value, shininess_roughness

log = logging.getLogger("warpjelly")


def _color(words: list[str]) -> tuple[float, float, float]:
    # One number stands for a grey.
    red, green, blue = map(float, words if len(words) == 3 else words * 3)
    return red, green, blue


def _number(words: list[str]) -> float:
    return float(" ".join(words))


# Statements that are read and the inputs that they give; of two for one input the last one counts.
_VALUES: dict[str, tuple[str, Callable[[list[str]], Value]]] = {
    "kd": ("diffuseColor", _color),
    "ke": ("emissiveColor", _color),
    "ns": ("roughness", lambda words: shininess_roughness(_number(words))),
    "pr": ("roughness", _number),
    "pm": ("metallic", _number),
    "tr": ("opacity", lambda words: 1.0 - _number(words)),
    "d": ("opacity", _number),
}
# Maps, which count instead of a value: the input, and what is taken of the image.
_MAPS = {
    "map_kd": ("diffuseColor", Texture("", b"", srgb=True)),
    "map_ke": ("emissiveColor", Texture("", b"", srgb=True)),
    "map_pr": ("roughness", Texture("", b"", "r")),
    "map_pm": ("metallic", Texture("", b"", "r")),
    "map_d": ("opacity", Texture("", b"", "r")),
    "norm": ("normal", Texture("", b"", scale=NORMAL_SCALE, bias=NORMAL_BIAS)),
}
# Numbers that may stand behind an option of a map, at most; other options have one word.
_NUMBER = re.compile(r"[-+]?[\d.]+(e[-+]?\d+)?", re.IGNORECASE)
_OPTION_NUMBERS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}


def read_mtl(model: Path, file: Path) -> list[Look]:
    """Read all materials of a file; colours are taken as linear, as most programs write them.

    What is wrong or missing gives a warning.

    Args:
        model: the model that uses the file, for warnings.
        file: the file.
    """
    try:
        text = file.read_text(encoding="utf-8-sig", errors="replace")
    # A name that no file can have is a ValueError.
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        log.warning("%s: the materials of %s cannot be read: %s", model, file.name, why)
        return []
    images = Images(file)
    return [Look(name, _inputs(file, name, statements, images)) for name, statements in _materials(text).items()]


def mtl_images(file: Path) -> list[str]:
    """Return the names of all images that the materials of a file have."""
    found = _materials(file.read_text(encoding="utf-8-sig", errors="replace"))
    return [_options(found[name][kind])[1] for name in found for kind in _MAPS if kind in found[name]]


def _materials(text: str) -> dict[str, dict[str, list[str]]]:
    """Return the statements of each material: the words behind the first one."""
    found: dict[str, dict[str, list[str]]] = {}
    statements: dict[str, list[str]] = {}
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["newmtl"]:
            statements = found.setdefault(" ".join(words[1:]), {})
        elif words:
            statements[words[0].lower()] = words[1:]
    return found


def _inputs(file: Path, name: str, statements: dict[str, list[str]], images: Images) -> dict[str, Value]:
    inputs: dict[str, Value] = {}
    for kind, (target, value) in _VALUES.items():
        if kind not in statements:
            continue
        try:
            inputs[target] = value(statements[kind])
        except ValueError:
            log.warning("%s: material %s: cannot read '%s'", file, name, " ".join([kind, *statements[kind]]))
    for kind, (target, texture) in _MAPS.items():
        if kind not in statements:
            continue
        try:
            options, image_name = _options(statements[kind])
            placing = Placing(0.0, _pair(options.get("-s", []), 1.0), _pair(options.get("-o", []), 0.0))
        except ValueError:
            continue
        if image := images.read(image_name):
            wrap = ("clamp", "clamp") if options.get("-clamp") == ["on"] else texture.wrap
            inputs[target] = replace(texture, name=image[0], data=image[1], wrap=wrap, placing=placing)
    color, cutout = inputs.get("diffuseColor"), inputs.get("opacity")
    if isinstance(color, Texture) and isinstance(cutout, Texture) and color.data == cutout.data:
        # A map of colours with transparency has it in its alpha.
        inputs["opacity"] = color.of("a")
    return inputs


def _options(words: list[str]) -> tuple[dict[str, list[str]], str]:
    """Return the options of a map, each with its words, and the name of its file."""
    options = {}
    while len(words) > 2 and words[0].startswith("-"):
        end = 2
        while end < len(words) and end <= _OPTION_NUMBERS.get(words[0], 1) and _NUMBER.fullmatch(words[end]):
            end += 1
        options[words[0]] = words[1:end]
        words = words[end:]
    return options, " ".join(words)


def _pair(words: list[str], default: float) -> tuple[float, float]:
    """Return the first two of the numbers of an option, or what they are where they are not given."""
    along_u, along_v, *_ = [*map(float, words), default, default]
    return along_u, along_v
