"""What a run directory holds besides the stage, in whichever state its run is, and what may be done with it."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from .checkpoint import Checkpoint, differences, load_checkpoint, scene_keys
from .errors import EnvironmentFailedError, InputError
from .files import unfinished_name, whole_file
from .scene import Scene
from .shapes import ShapeFrame
from .stage.stagefiles import CLIPS_NAME, ROOT_NAME, STAGE_NAME, STAGE_NAMES, TEXTURES_NAME
from .stage.stagewriter import StageWriter

RECORD_NAME, METRICS_NAME, CHECKPOINT_NAME = "run.json", "metrics.csv", "checkpoint.npz"


def refuse_to_replace_run(folder: Path) -> None:
    """Raise InputError where a folder holds a run."""
    names = (RECORD_NAME, STAGE_NAME, ROOT_NAME, METRICS_NAME, CHECKPOINT_NAME)
    found = [name for name in names if (folder / name).exists()]
    if not found:
        return
    if RECORD_NAME in found and not read_record(folder)["interrupted"]:
        what, more = "a run already", ""
    else:
        what, more = "an unfinished run", "go on with --resume, "
    raise InputError(
        f"{folder}: holds {what} ({', '.join(found)}); {more}replace it with --force, or choose another folder with -o"
    )


def read_record(folder: Path) -> dict[str, Any]:
    """Return the record of a run.

    Raises:
        InputError: it cannot be read.
    """
    path = folder / RECORD_NAME
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not the record of a run: {error}") from error
    if not (isinstance(record, dict) and {"diverged", "stage"} <= record.keys()):
        raise InputError(f"{path}: not the record of a run, which has diverged and stage")
    return {"interrupted": False, **record}


def write_record(folder: Path, record: Mapping[str, Any]) -> None:
    """Write the record of a run, without which it does not count as finished."""
    with whole_file(folder / RECORD_NAME) as unfinished:
        unfinished.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def find_checkpoint(folder: Path, scene: Scene) -> Checkpoint | None:
    """Return where a run can go on; None where there is nothing yet.

    Raises:
        InputError: the run is of another scene, has more frames than the scene, or cannot be gone on with.
    """
    path = folder / CHECKPOINT_NAME
    if not path.is_file():
        if (folder / RECORD_NAME).is_file():
            raise InputError(f"{path}: missing, so the run cannot go on; start anew with --force")
        return None
    checkpoint = load_checkpoint(path)
    if changed := differences(checkpoint.scene, scene_keys(scene)):
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        raise InputError(
            f"{folder}: the scene is not that of the run: {changed[0]}{more}; go on with the scene as it was, or start "
            "anew with --force"
        )
    if checkpoint.frame_count > scene.frame_count:
        raise InputError(
            f"{folder}: the run has {checkpoint.frame_count} frames already, more than the {scene.frame_count} asked "
            "for; start anew with --force, or choose another folder with -o"
        )
    return checkpoint


def remove_leftovers(folder: Path) -> None:
    """Remove what an earlier process was writing when it was killed."""
    # USD puts an ending of its own in the place of the file's while it writes.
    places = [(folder, unfinished_name(Path(name)).stem) for name in (RECORD_NAME, CHECKPOINT_NAME, *STAGE_NAMES)]
    places += [(folder / CLIPS_NAME, "*.tmp"), (folder / TEXTURES_NAME, "*.tmp")]
    for place, stem in places:
        for file in place.glob(f"{stem}.*"):
            file.unlink(missing_ok=True)


class Recorder:
    """Writes what a run leaves, frame by frame: the stage, the metrics, and checkpoints after clips of the stage.

    Args:
        folder: the run directory.
        writer: of the stage.
        metrics: see ``open_metrics``.
        scene: what it says, for checkpoints.
        origin: what decides the last bits besides the scene, for checkpoints.
    """

    def __init__(
        self, folder: Path, writer: StageWriter, metrics: TextIO, *, scene: dict[str, Any], origin: dict[str, str]
    ) -> None:
        self._folder = folder
        self._writer = writer
        self._metrics = metrics
        self._scene, self._origin = scene, origin

    def save(
        self,
        index: int,
        samples: list[ShapeFrame],
        row: Mapping[str, float],
        changing: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Write a frame, and a checkpoint with all frames so far on the disk if the arrays for it are given.

        Args:
            index: number of the frame.
            samples: see ``StageWriter.write_frame``.
            row: of the metrics, by column.
            changing: arrays of the checkpoint besides those of the stage.

        Raises:
            EnvironmentFailedError: something cannot be written.
        """
        try:
            metrics = csv.writer(self._metrics)
            if index == 0:
                metrics.writerow(row)
            metrics.writerow(row.values())
            self._metrics.flush()
            self._writer.write_frame(index, samples)
            if changing is None:
                return
            self._writer.flush()
            os.fsync(self._metrics.fileno())
            stage = {f"stage.{name}": array for name, array in self._writer.arrays().items()}
            Checkpoint(index + 1, self._scene, self._origin, {**changing, **stage}).save(self._folder / CHECKPOINT_NAME)
        except OSError as error:
            raise EnvironmentFailedError(f"{self._folder}: cannot write the run: {error.strerror or error}") from error


def open_metrics(folder: Path, frame_count: int) -> TextIO:
    """Open the metrics of a run to add rows after those of so many frames; before them, there is a header.

    Raises:
        InputError: there are not so many.
    """
    path = folder / METRICS_NAME
    if frame_count > 0:
        with open(path, "rb+") as file:
            for _ in range(1 + frame_count):
                if not file.readline().endswith(b"\n"):
                    raise InputError(f"{path}: has fewer than {frame_count} frames; start anew with --force")
            file.truncate(file.tell())
    return open(path, "a" if frame_count > 0 else "w", newline="", encoding="utf-8")
