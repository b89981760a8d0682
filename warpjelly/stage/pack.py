"""Stages in one file: from the parts of a run, or from any stage, with a memory that does not grow with its frames."""

from __future__ import annotations

import logging
import math
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from ..errors import EnvironmentFailedError, InputError
from ..files import whole_file
from .prims import WORLD
from .stagefiles import (
    GEOMETRY_NAME,
    STAGE_NAMES,
    active_clips,
    export_layer,
    failed_write,
    find_stage,
    open_clip,
    open_stage,
)
from .usd import FORCE, colors_in_range
from .usdlooks import asset_name, store_image

log = logging.getLogger("warpjelly")

FORMATS = (".usdc", ".usda", ".usdz")
# Samples that are in memory until they are saved, bytes.
_BATCH_BYTES = 64_000_000


def pack(source: Path, output: Path) -> None:
    """Write a stage as one self-contained file; textures go into a .usdz, and into a folder beside the others.

    Args:
        source: a stage, or a run directory, whether or not the run has finished.
        output: the file to make, .usdc, .usda or .usdz; it appears under its name only when it is complete.

    Raises:
        InputError: the source is no stage or not complete, or the output has another extension or a name that belongs
            to the run.
        EnvironmentFailedError: the output cannot be written.
    """
    suffix = output.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(f"{output}: a stage is packed into a file that ends in {', '.join(FORMATS)}")
    path, stage = find_stage(source), open_stage(source)
    if output.parent.resolve() == path.parent.resolve() and output.name in (path.name, *STAGE_NAMES):
        raise InputError(f"{output}: this name belongs to the stage that is to be packed; choose another")
    if errors := stage.GetCompositionErrors():
        raise InputError(f"{path}: the stage is not complete: {' '.join(str(errors[0]).split())}")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".pack.", dir=output.parent) as folder:
            flat = Path(folder) / f"{output.stem}.usdc"
            _flatten(stage, flat)
            textures = flat.with_name(f"{output.stem}_textures")
            _gather_textures(flat, stage.GetRootLayer(), textures)
            if suffix != ".usdz" and textures.exists():
                shutil.copytree(textures, output.with_name(textures.name), dirs_exist_ok=True)
            with whole_file(output) as unfinished:
                _convert(flat, unfinished)
    except (Tf.ErrorException, OSError) as error:
        raise failed_write(output, error) from error


def join_clips(
    rest: Sdf.Layer, clips: Sequence[tuple[float, Path]], force_range: tuple[float, float], output: Path
) -> None:
    """Write a stage in parts as one crate file, clip after clip.

    Args:
        rest: all but the samples; what it declares is what is taken of the clips.
        clips: first time code and file of each, in order.
        force_range: forces at both ends of the colours, N, where the clips still have the forces; other colours stay.
        output: the file to make, .usdc; it appears under its name only when it is complete.

    Raises:
        InputError: a clip is missing or damaged.
        EnvironmentFailedError: the output cannot be written.
    """
    try:
        with whole_file(output) as unfinished:
            if not rest.Export(str(unfinished)):
                raise EnvironmentFailedError(f"{output}: cannot write the stage")
            joined = Sdf.Layer.FindOrOpen(str(unfinished))
            # Within a process a file of this name may have been read before.
            joined.Reload(force=True)
            ends = [*(start for start, _ in clips), math.inf][1:]
            for (start, file), end in zip(clips, ends, strict=True):
                _add_clip(joined, open_clip(file), start, end, force_range)
    except (Tf.ErrorException, OSError) as error:
        raise failed_write(output, error) from error


def _add_clip(joined: Sdf.Layer, clip: Sdf.Layer, start: float, end: float, force_range: tuple[float, float]) -> None:
    """Add the samples of a clip from a time code to before another to a layer with a file, and save it."""
    waiting = 0
    for time, attribute in _samples(clip):
        if not start <= time < end or not joined.GetAttributeAtPath(attribute):
            continue
        value = colors_in_range(clip, attribute, time, force_range)
        if value is None:
            value = clip.QueryTimeSample(attribute, time)
        joined.SetTimeSample(attribute, time, value)
        waiting += np.asarray(value).nbytes
        if waiting > _BATCH_BYTES:
            _save(joined)
            waiting = 0
    _save(joined)


def has_forces(clip: Path) -> bool:
    """Say whether a clip still has the forces that its colours show."""
    return any(attribute.name == FORCE for _, attribute in _samples(open_clip(clip)))


def recolor_clip(path: Path, force_range: tuple[float, float], *, keep_forces: bool) -> None:
    """Stretch the colours of a clip over a range of forces, N, as far as it has the forces.

    Raises:
        EnvironmentFailedError: the clip cannot be written; it is as it was before.
    """
    clip = open_clip(path)
    samples = _samples(clip)
    for time, attribute in samples:
        if (colors := colors_in_range(clip, attribute, time, force_range)) is not None:
            clip.SetTimeSample(attribute, time, colors)
    forces = {attribute for _, attribute in samples if attribute.name == FORCE}
    for attribute in forces if not keep_forces else ():
        clip.GetPrimAtPath(attribute.GetPrimPath()).RemoveProperty(clip.GetAttributeAtPath(attribute))
    if forces:
        export_layer(clip, path)


def _flatten(stage: Usd.Stage, output: Path) -> None:
    """Write all that a stage consists of, but for textures, into one crate file."""
    root = stage.GetRootLayer()
    layers = [layer for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer()]
    if list(root.subLayerPaths) == [f"./{GEOMETRY_NAME}"]:
        world = stage.GetPrimAtPath(WORLD)
        rest = UsdUtils.FlattenLayerStack(stage, lambda layer, path: path)
        rest.GetPrimAtPath(WORLD).ClearInfo("clips")
        force_range = tuple(world.GetCustomDataByKey("legend")["range"])
        join_clips(rest, active_clips(stage), force_range, output)
        return
    # A stage of one file is copied as it is; of others, whose paths to textures become absolute, all is in memory.
    whole = root if len(layers) == 1 else stage.Flatten()
    if not whole.Export(str(output)):
        raise EnvironmentFailedError(f"{output}: cannot write the stage")


def _samples(layer: Sdf.Layer) -> list[tuple[float, Sdf.Path]]:
    """Return all (time, attribute) at which a layer has samples, in the order of time."""
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, found.append)
    paths = [path for path in found if path.IsPrimPropertyPath()]
    return sorted((time, path) for path in paths for time in layer.ListTimeSamplesForPath(path))


def _save(layer: Sdf.Layer) -> None:
    if not layer.Save():
        raise EnvironmentFailedError(f"{layer.realPath}: cannot write the stage")


def _gather_textures(flat: Path, origin: Sdf.Layer, folder: Path) -> None:
    """Copy the files that a stage refers to into a folder beside it, made where there are any, and refer to those.

    Args:
        flat: the stage, without other layers.
        origin: what paths are relative to so far.
        folder: where the files go.
    """
    layer = Sdf.Layer.FindOrOpen(str(flat))
    stage, resolver = Usd.Stage.Open(layer), Ar.GetResolver()
    for prim in stage.TraverseAll():
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetTypeName() != Sdf.ValueTypeNames.Asset or not (asset := attribute.Get()):
                continue
            path = resolver.Resolve(origin.ComputeAbsolutePath(asset.path))
            opened = resolver.OpenAsset(path) if path else None
            if opened is None:
                log.warning("%s: %s is missing, and not packed", attribute.GetPath(), asset.path)
                continue
            name = store_image(folder, asset_name(asset.path), bytes(opened.GetBuffer()))
            attribute.Set(Sdf.AssetPath(f"./{folder.name}/{name}"))
    _save(layer)


def _convert(flat: Path, output: Path) -> None:
    """Bring a crate file into the format of another file's name."""
    suffix = output.suffix.lower()
    if suffix == ".usdc":
        os.replace(flat, output)
        return
    if suffix == ".usda":
        written = Sdf.Layer.OpenAsAnonymous(str(flat)).Export(str(output))
    else:
        written = UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(flat)), str(output))
    if not written:
        raise EnvironmentFailedError(f"{output}: cannot write the stage")
