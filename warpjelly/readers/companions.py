"""Which files a model is read from: the one that a scene names, and those that this one names."""

from __future__ import annotations

import html
import os
import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

from ..errors import SceneError, reason
from ..looks import image_file
from ..scene import USD_EXTENSIONS
from .gltffile import gltf_addresses
from .mtlfile import mtl_images
from .polygonfiles import obj_libraries


def files_of(model: Path) -> list[Path]:
    """Return a model file and the files that it names, textures too, as far as they can be read.

    Raises:
        SceneError: the model is broken.
    """
    kind = model.suffix.lower()
    named = _usd if kind in USD_EXTENSIONS else _NAMED.get(kind)
    if named is None:
        return [model]
    try:
        others = named(model)
    # As where models are read, parsing trips over whatever a broken file has.
    except Exception as error:
        raise SceneError(
            f"{model}: not a sound {model.suffix} file: {reason(error) or type(error).__name__}"
        ) from error
    readable = (file for file in others if file.is_file() and os.access(file, os.R_OK))
    return [model, *dict.fromkeys(file for file in readable if not file.samefile(model))]


def _gltf(model: Path) -> list[Path]:
    return [image_file(model, Path(address)) for address in gltf_addresses(model)]


def _obj(model: Path) -> list[Path]:
    libraries = [file for file in obj_libraries(model) if file.is_file()]
    images = [image_file(file, Path(name.replace("\\", "/"))) for file in libraries for name in mtl_images(file)]
    return [*libraries, *images]


def _dae(model: Path) -> list[Path]:
    names = re.findall(rb"<init_from>\s*(?:<ref>)?\s*([^<]*?)\s*<", model.read_bytes())
    plain = (unquote(html.unescape(name.decode(errors="replace"))).removeprefix("file://") for name in names)
    return [image_file(model, Path(name)) for name in plain]


def _usd(model: Path) -> list[Path]:
    from pxr import UsdUtils

    layers, assets, _ = UsdUtils.ComputeAllDependencies(str(model))
    # What is in a package has the path of that package in front.
    return [Path(path.partition("[")[0]) for path in (*(layer.realPath for layer in layers), *assets)]


_NAMED: dict[str, Callable[[Path], list[Path]]] = {".gltf": _gltf, ".glb": _gltf, ".obj": _obj, ".dae": _dae}
