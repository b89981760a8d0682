"""The files of a stage in a run directory, and how any stage is opened.

A finished run has its stage in one file, or, with ``output.format = "clips"``, in parts, as every run has while it is
going. Whatever is opened first then holds: the root of the parts is there from the first moment until the one file is.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from ..errors import EnvironmentFailedError, InputError, reason
from ..files import missing, whole_file
from .prims import WORLD

STAGE_NAME = "stage.usdc"
"""The stage in one file."""
OVER_NAME = "override.usdc"
"""Of a stage over a shot, the layer with all samples; its root is below ROOT_NAME."""
ROOT_NAME = "stage.usda"
"""The small root of a stage in parts: camera, colliders, and which clip has which frames."""
GEOMETRY_NAME = "geometry.usdc"
"""All that does not depend on the motion."""
CLIPS_NAME = "clips"
"""Folder of the files with the frames."""
MANIFEST_NAME = "manifest.usda"
"""In that folder, what varies from frame to frame."""
TEXTURES_NAME = "textures"
STAGE_NAMES = (STAGE_NAME, OVER_NAME, ROOT_NAME, GEOMETRY_NAME)

# Of the custom data of a layer, what is ours.
_NOTES = "warpjelly"
# The set of value clips; the shot may have some of its own.
CLIP_SET = "warpjelly"


def clip_name(first: int) -> str:
    """Return the name of the clip that starts with a frame."""
    return f"frames.{first:06d}.usdc"


def find_stage(source: Path) -> Path:
    """Return the stage file of a run directory, or the file that is given.

    Raises:
        InputError: there is none.
    """
    if not source.is_dir():
        if not source.is_file():
            raise InputError(f"{source}: no such file")
        return source
    for name in (ROOT_NAME, STAGE_NAME):
        if (source / name).is_file():
            return source / name
    raise InputError(f"{source}: no {STAGE_NAME} or {ROOT_NAME} in this directory")


@contextmanager
def silent_usd() -> Iterator[None]:
    """Keep USD from printing what it stumbles over; what matters of it is said otherwise."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        # It is silent as long as this lives.
        del delegate


def open_stage(source: Path) -> Usd.Stage:
    """Open a stage file, or the stage of a run directory, whether or not the run has finished.

    Of its parts some may be missing: ``validate.py`` says so.

    Raises:
        InputError: there is none, it is not a USD file, or it goes over a shot that is not there.
    """
    path = find_stage(source)
    try:
        with silent_usd():
            # USD shares what it has read of a file within a process, even after the file was replaced. The root goes
            # first: what it named before may be gone.
            root = Sdf.Layer.FindOrOpen(str(path))
            root.Reload()
            _require_shot(path, root)
            stage = Usd.Stage.Open(root)
            stage.Reload()
        return stage
    except Tf.ErrorException as error:
        raise InputError(f"{path}: not a readable USD file: {reason(error)}") from error


def open_clip(path: Path) -> Sdf.Layer:
    """Open a clip, as it is now.

    Raises:
        InputError: it is missing or damaged.
    """
    if why := missing(path):
        raise InputError(f"{path}: {why}")
    try:
        return Sdf.Layer.OpenAsAnonymous(str(path))
    except Tf.ErrorException as error:
        raise InputError(f"{path}: not a readable USD file: {reason(error)}") from error


def set_note(layer: Sdf.Layer, key: str, value: object) -> None:
    """Note something in the custom data of a layer."""
    notes = layer.customLayerData
    layer.customLayerData = {**notes, _NOTES: {**notes.get(_NOTES, {}), key: value}}


def remove_notes(layer: Sdf.Layer) -> None:
    """Remove what was noted in the custom data of a layer."""
    layer.customLayerData = {key: value for key, value in layer.customLayerData.items() if key != _NOTES}


def _note(layer: Sdf.Layer, key: str) -> Any:
    return layer.customLayerData.get(_NOTES, {}).get(key)


def _require_shot(path: Path, root: Sdf.Layer) -> None:
    """Refuse the root of a run over a shot that is not there: USD would only warn, and show nothing."""
    for layer in root.subLayerPaths if _note(root, "over") else ():
        if not Ar.GetResolver().Resolve(file := root.ComputeAbsolutePath(layer)):
            raise InputError(f"{path}: {file} is missing; a run over a shot and the shot have to move together")


def progress(stage: Usd.Stage) -> tuple[int, int] | None:
    """Return how many frames of how many a stage has whose run has not finished; None for all others."""
    found = _note(stage.GetRootLayer(), "progress")
    return (found["frames"], found["of"]) if found else None


def set_progress(layer: Sdf.Layer, frames: int, of: int) -> None:
    """Note in the root of a stage that its run has not finished."""
    set_note(layer, "progress", {"frames": frames, "of": of})


def overridden(stage: Usd.Stage) -> list[Sdf.Path]:
    """Return the meshes of a shot that a run has written over; none in all other stages."""
    return [Sdf.Path(path) for path in _note(stage.GetRootLayer(), "over") or ()]


def set_clips(prim: Usd.Prim, clips: Sequence[tuple[float, str]], last: float) -> None:
    """Let a prim have the samples of the clips of a run.

    Args:
        prim: of a root of a stage in parts; what is below it is at the same path in the clips.
        clips: first time code and name of each, in order.
        last: time code of the last sample.
    """
    api, first = Usd.ClipsAPI(prim), clips[0][0]
    api.SetClipPrimPath(str(prim.GetPath()), CLIP_SET)
    api.SetClipManifestAssetPath(f"./{CLIPS_NAME}/{MANIFEST_NAME}", CLIP_SET)
    api.SetClipAssetPaths([f"./{CLIPS_NAME}/{name}" for _, name in clips], CLIP_SET)
    api.SetClipActive([(start, number) for number, (start, _) in enumerate(clips)], CLIP_SET)
    api.SetClipTimes([(time, time) for time in sorted({first, last})], CLIP_SET)


def active_clips(stage: Usd.Stage) -> list[tuple[float, Path]]:
    """Return the first time code and the file of each clip of a stage in parts, in order, there or not."""
    clips, root = Usd.ClipsAPI(stage.GetPrimAtPath(next(iter(overridden(stage)), WORLD))), stage.GetRootLayer()
    files = [Path(root.ComputeAbsolutePath(asset.path)) for asset in clips.GetClipAssetPaths(CLIP_SET) or []]
    return [(start, files[int(number)]) for start, number in clips.GetClipActive(CLIP_SET) or []]


def remove_stage(folder: Path) -> None:
    """Remove a stage in parts or over a shot from a run directory, the root first, so that it names nothing gone."""
    (folder / ROOT_NAME).unlink(missing_ok=True)
    remove_parts(folder)
    (folder / OVER_NAME).unlink(missing_ok=True)


def remove_parts(folder: Path) -> None:
    """Remove the parts of a stage from a run directory which no root names any more."""
    (folder / GEOMETRY_NAME).unlink(missing_ok=True)
    if (folder / CLIPS_NAME).is_dir():
        shutil.rmtree(folder / CLIPS_NAME)


def export_layer(layer: Sdf.Layer, path: Path) -> None:
    """Write a layer to a file that is either complete or, under its final name, not there at all.

    Raises:
        EnvironmentFailedError: it cannot be written; a file that was there before is untouched.
    """
    try:
        with whole_file(path) as unfinished:
            if not layer.Export(str(unfinished)):
                raise EnvironmentFailedError(f"{path}: cannot write the stage")
    except (Tf.ErrorException, OSError) as error:
        raise failed_write(path, error) from error


def failed_write(path: Path, error: Exception) -> EnvironmentFailedError:
    """Say in one line why a file of a stage could not be written."""
    why = (error.strerror or str(error)) if isinstance(error, OSError) else reason(error)
    return EnvironmentFailedError(f"{path}: cannot write the stage: {why}")
