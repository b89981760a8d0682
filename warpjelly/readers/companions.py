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
        why = reason(error) or type(error).__name__
        raise SceneError(f"{model}: not a sound {model.suffix} file: {why}") from error
    return [model, *dict.fromkeys(file for file in others if _readable(file) and not file.samefile(model))]


def _readable(file: Path) -> bool:
    # Unlike pathlib's, this one takes names that no file can have.
    return os.path.isfile(file) and os.access(file, os.R_OK)


# Readers take long to import, and most scenes need none or one of them.
def _gltf(model: Path) -> list[Path]:
    from .gltffile import gltf_addresses

    return [image_file(model, Path(address)) for address in gltf_addresses(model)]


def _obj(model: Path) -> list[Path]:
    from .mtlfile import mtl_images
    from .polygonfiles import obj_libraries

    libraries = [file for file in obj_libraries(model) if _readable(file)]
    images = [image_file(file, Path(name.replace("\\", "/"))) for file in libraries for name in mtl_images(file)]
    return [*libraries, *images]


def _dae(model: Path) -> list[Path]:
    names = re.findall(rb"<init_from>\s*(?:<ref>)?\s*([^<]*?)\s*<", model.read_bytes())
    plain = (unquote(html.unescape(name.decode(errors="replace"))).removeprefix("file://") for name in names)
    return [image_file(model, Path(name)) for name in plain]


def _usd(model: Path) -> list[Path]:
    from pxr import UsdUtils

    from ..stage.stagefiles import silent_usd

    # What is missing is said where the model is read.
    with silent_usd():
        layers, assets, _ = UsdUtils.ComputeAllDependencies(str(model))
    # What is in a package has the path of that package in front.
    return [Path(path.partition("[")[0]) for path in (*(layer.realPath for layer in layers), *assets)]


_NAMED: dict[str, Callable[[Path], list[Path]]] = {".gltf": _gltf, ".glb": _gltf, ".obj": _obj, ".dae": _dae}
