"""The files of a stage in a run directory, and how any stage is opened.

A finished run has its stage in one file, or, with ``output.format = "clips"``, in parts, as every run has while it is
going. Whatever is opened first then holds: the root of the parts is there from the first moment until the one file is.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdUtils

from ..errors import EnvironmentFailedError, InputError, reason
from ..files import missing, whole_file
from .prims import WORLD

STAGE_NAME = "stage.usdc"
"""The stage in one file."""
ROOT_NAME = "stage.usda"
"""The small root of a stage in parts: camera, colliders, and which clip has which frames."""
GEOMETRY_NAME = "geometry.usdc"
"""All that does not depend on the motion."""
CLIPS_NAME = "clips"
"""Folder of the files with the frames."""
MANIFEST_NAME = "manifest.usda"
"""In that folder, what varies from frame to frame."""
TEXTURES_NAME = "textures"
STAGE_NAMES = (STAGE_NAME, ROOT_NAME, GEOMETRY_NAME)

_PROGRESS = "progress"


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
        InputError: there is none, or it is not a USD file.
    """
    path = find_stage(source)
    try:
        with silent_usd():
            stage = Usd.Stage.Open(str(path))
            # USD shares what it has read of a file within a process, even after the file was replaced.
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


def progress(stage: Usd.Stage) -> tuple[int, int] | None:
    """Return how many frames of how many a stage has whose run has not finished; None for all others."""
    found = stage.GetPrimAtPath(WORLD).GetCustomDataByKey(_PROGRESS) if stage.GetPrimAtPath(WORLD) else None
    return (found["frames"], found["of"]) if found else None


def set_progress(stage: Usd.Stage, frames: int, of: int) -> None:
    """Note in a stage that its run has not finished."""
    stage.GetPrimAtPath(WORLD).SetCustomDataByKey(_PROGRESS, {"frames": frames, "of": of})


def active_clips(stage: Usd.Stage) -> list[tuple[int, Path]]:
    """Return the first frame and the file of each clip of a stage in parts, in order, whether or not it is there."""
    clips, root = Usd.ClipsAPI(stage.GetPrimAtPath(WORLD)), stage.GetRootLayer()
    files = [Path(root.ComputeAbsolutePath(asset.path)) for asset in clips.GetClipAssetPaths() or []]
    return [(int(start), files[int(number)]) for start, number in clips.GetClipActive() or []]


def remove_parts(folder: Path) -> None:
    """Remove a stage in parts from a run directory, the root first, so that it never names what is gone."""
    (folder / ROOT_NAME).unlink(missing_ok=True)
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
