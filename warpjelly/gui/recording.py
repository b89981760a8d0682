"""Recording a live simulation into a run directory, as a run writes it."""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from ..background import Background
from ..checkpoint import origin_of, scene_keys
from ..errors import EnvironmentFailedError, InputError
from ..files import locked
from ..run import metrics_row, provenance, simulated
from ..rundir import Recorder, open_metrics, refuse_to_replace_run, remove_leftovers, write_record
from ..scene import MAX_FRAMES, Scene
from ..shapes import ShapeFrame
from ..simulator import Simulator
from ..stage.stagefiles import find_stage
from ..stage.stagewriter import StageWriter

# Samples that were taken and are not written yet may have so many bytes; beyond, the simulation waits.
WAITING_BYTES = 64_000_000
# What a recording may change without a change of what its stage shows besides motion.
_FREE_KEYS = {"name", "frames", "duration", "expect", "materials", "gravity", "contact", "soft_contact", "fields"}
_FREE_BODY_KEYS = {"material", "position", "velocity", "angular_velocity", "charge", "positions", "velocities"}
_FREE_COLLIDER_KEYS = {"stiffness", "damping", "static_friction", "dynamic_friction", "pulls"}


def shown_by(scene: Scene) -> dict[str, Any]:
    """Return what of a scene the stage of a recording holds for all of its frames."""
    shown = scene.model_dump(exclude=_FREE_KEYS)
    for body in shown["bodies"]:
        for key in _FREE_BODY_KEYS:
            body.pop(key, None)
        for region in body.get("regions", []):
            region.pop("material")
    for collider in shown["colliders"]:
        for key in _FREE_COLLIDER_KEYS:
            collider.pop(key, None)
    return shown


class Place:
    """A run directory that nothing else writes into, until it is closed.

    Args:
        folder: the run directory; it is made if missing.
        force: replace a run that is there already.

    Raises:
        InputError: it is a file, holds a run, or another process is writing to it.
        EnvironmentFailedError: it cannot be made or written to.
    """

    def __init__(self, folder: Path, *, force: bool) -> None:
        self.folder = folder
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{folder}: cannot record: it is a file; choose a folder")
        with ExitStack() as held:
            try:
                folder.mkdir(parents=True, exist_ok=True)
                held.enter_context(locked(folder))
            except OSError as error:
                raise EnvironmentFailedError(f"{folder}: cannot record: {error.strerror or error}") from error
            if not force:
                refuse_to_replace_run(folder)
            self._held = held.pop_all()

    def close(self) -> None:
        """Let others write there."""
        self._held.close()


class Recording:
    """Samples of a simulation from now on, written beside it, in a thread.

    Args:
        place: where to.
        sim: the simulation; its present state is sample 0.
        scene: its set-up.
    """

    def __init__(self, place: Place, sim: Simulator, scene: Scene) -> None:
        self.place = place
        self.frames = 0
        """Samples that were taken."""
        self.shown = shown_by(scene)
        self._began, self._start = time.perf_counter(), sim.time
        # How long it will be is not known yet.
        self._scene = scene.model_copy(update={"frames": MAX_FRAMES, "duration": None})
        self._held = ExitStack()
        samples = sim.shapes()
        size = sum(array.nbytes for sample in samples for array in vars(sample).values())
        self._background = Background(max(2, WAITING_BYTES // max(size, 1)))
        self._background.submit(self._begin, sim, samples)
        self._add(sim, samples)

    def missing(self, sim: Simulator) -> int:
        """Return how many substeps there are up to the next sample, which is due at a time, whatever the time step."""
        due = self._start + self.frames / self._scene.fps
        return max(1, round((due - sim.time) / sim.dt))

    def add_sample(self, sim: Simulator) -> None:
        """Take a sample of the present.

        Raises:
            EnvironmentFailedError: an earlier sample could not be written.
        """
        self._add(sim, sim.shapes())

    def finish(self, sim: Simulator, *, diverged: bool) -> None:
        """Take no more samples, and bring the stage into its final form; ``wait`` says when that is done."""
        # What could not be written before, wait() says.
        with suppress(Exception):
            self._background.submit(self._finish, sim, diverged)

    def wait(self) -> dict[str, Any]:
        """Wait until all is written, and return the record of the run.

        Raises:
            EnvironmentFailedError: something could not be written; what was written before is there.
        """
        try:
            with self._background:
                self._background.join()
        finally:
            self._held.close()
            self.place.close()
        return self._record

    def _add(self, sim: Simulator, samples: list[ShapeFrame]) -> None:
        figures = sim.diagnostics()
        self._background.submit(
            self._save, self.frames, samples, metrics_row(self.frames, self.frames / self._scene.fps, figures)
        )
        self.frames += 1

    # In the thread that writes.

    def _begin(self, sim: Simulator, rest: list[ShapeFrame]) -> None:
        folder = self.place.folder
        self._about = provenance(self._scene, sim)
        try:
            remove_leftovers(folder)
            # It says that nothing goes on with this: there is no checkpoint of what was done by hand.
            self._write_record(sim, frames=0, diverged=False, interrupted=True)
            metrics = self._held.enter_context(open_metrics(folder, 0))
        except OSError as error:
            raise EnvironmentFailedError(f"{folder}: cannot record: {error.strerror or error}") from error
        self._writer = StageWriter(
            folder, scene=self._scene, shapes=sim.model.shapes, rest=rest, provenance=self._about
        )
        keys, origin = scene_keys(self._scene), origin_of(sim.device)
        self._recorder = Recorder(folder, self._writer, metrics, scene=keys, origin=origin)

    def _save(self, index: int, samples: list[ShapeFrame], row: dict[str, float]) -> None:
        self._recorder.save(index, samples, row)
        if (index + 1) % self._writer.clip_length == 0:
            self._writer.flush()

    def _finish(self, sim: Simulator, diverged: bool) -> None:
        self._writer.finish()
        try:
            self._write_record(sim, frames=self._writer.frame_count, diverged=diverged, interrupted=False)
        except OSError as error:
            raise EnvironmentFailedError(f"{self.place.folder}: cannot record: {error.strerror or error}") from error

    def _write_record(self, sim: Simulator, *, frames: int, diverged: bool, interrupted: bool) -> None:
        folder, scene = self.place.folder, self._scene
        about = dict(self._about)
        about["resolved_scene"] = about["resolved_scene"] | {"frames": max(frames, 1)}
        self._record = {
            "scene": scene.name,
            "recorded_from": self._start,
            "run_dir": str(folder),
            "frames": frames,
            **simulated(scene, sim),
            "threads": sim.threads,
            "wall_seconds": time.perf_counter() - self._began,
            "diverged": diverged,
            "interrupted": interrupted,
            "expect": [],
            **about,
        }
        if not interrupted:
            self._record["stage"] = str(find_stage(folder))
        write_record(folder, self._record)
