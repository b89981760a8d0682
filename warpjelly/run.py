"""From a scene to a run directory: stage, metrics and the record of how they came about."""

from __future__ import annotations

import csv
import json
import logging
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from warpjelly.kernels.integrators import STAGES

from .errors import DivergedError, EnvironmentFailedError, InputError, WarpjellyError
from .expect import Observer, Outcome
from .files import whole_file
from .plan import plan_scene
from .scene import Scene
from .shapes import SURFACE, ShapeFrame
from .simulator import Simulator
from .stability import evaluations
from .starts import warn_of_deep_starts
from .usd import STAGE_NAME, StageWriter

log = logging.getLogger("warpjelly")

RECORD_NAME, METRICS_NAME = "run.json", "metrics.csv"
# A run warns of a step above the limit where finding the limit takes at most this share of it, or at most as long as
# evaluating the forces of so many springs once each, a second or less.
LIMIT_SHARE = 0.02
LIMIT_SPRINGS = 100_000_000
# How long a forecast measures, s.
FORECAST_SECONDS = 0.3


@dataclass(frozen=True)
class Run:
    """What came of a run."""

    record: dict[str, Any]
    """The contents of run.json."""
    outcomes: list[Outcome]
    """What the scene expects of itself, measured at the last frame that was finished."""


class RunEndedError(WarpjellyError):
    """A run ended before its last frame; the frames that were finished are in the run directory."""

    def __init__(self, message: str, run: Run, exit_code: int) -> None:
        super().__init__(message)
        self.run = run
        self.exit_code = exit_code


def simulate(
    scene: Scene,
    *,
    output: str | Path | None = None,
    device: str = "auto",
    force: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Simulate a scene and write its run directory.

    Args:
        scene: what to simulate.
        output: the run directory; ``outputs/<scene name>`` unless given.
        device: "auto", "cpu", "cuda:0" ...
        force: replace a run that is there already.
        progress: called after each frame with the number of frames done and in all.

    Raises:
        InputError: the scene cannot be built, or the directory holds a run and ``force`` is not set.
        RunEndedError: the simulation diverged or was interrupted; the error has the run up to there.
        EnvironmentFailedError: the run directory cannot be written.
    """
    folder = Path(output) if output is not None else Path("outputs") / scene.name
    if folder.exists() and not folder.is_dir():
        raise EnvironmentFailedError(f"{folder}: cannot write the run: it is a file; choose a folder with -o")
    if not force:
        _refuse_to_replace(folder)
    plan = plan_scene(scene)
    sim = Simulator(plan, device=device)
    warn_of_deep_starts(sim)
    _warn_of_long_steps(sim)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Without its record a run does not count as finished. The old stage stays until the new one is whole.
        (folder / RECORD_NAME).unlink(missing_ok=True)
        with open(folder / METRICS_NAME, "w", newline="", encoding="utf-8") as metrics:
            return _simulate_into(folder, sim, csv.writer(metrics), progress)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot write the run: {error.strerror or error}") from error


def _refuse_to_replace(folder: Path) -> None:
    """Raise InputError where a folder holds a run."""
    found = [name for name in (RECORD_NAME, STAGE_NAME, METRICS_NAME) if (folder / name).exists()]
    if found:
        what = "a run" if RECORD_NAME in found else "a run that did not finish"
        raise InputError(
            f"{folder}: holds {what} already ({', '.join(found)}); replace it with --force, or choose another folder "
            "with -o"
        )


def _simulate_into(folder: Path, sim: Simulator, metrics: Any, progress: Callable[[int, int], None]) -> Run:
    scene, total = sim.scene, sim.scene.frame_count
    shapes, rest = sim.model.shapes, sim.shapes()
    writer = StageWriter(folder / STAGE_NAME, scene=scene, shapes=shapes, rest=rest, provenance=provenance(scene, sim))
    observer = Observer(sim)
    sim.prepare()
    stepping, frames = 0.0, 0
    ended: DivergedError | KeyboardInterrupt | None = None
    began = time.perf_counter()
    try:
        for index in range(total):
            if index > 0:
                before = time.perf_counter()
                sim.advance_frame()
                stepping += time.perf_counter() - before
            figures = sim.diagnostics()
            row = _metrics_row(index, sim.time, figures)
            if index == 0:
                metrics.writerow(row)
            metrics.writerow(row.values())
            observer.observe(figures["penetrations"])
            writer.write_frame(index, sim.shapes())
            frames = index + 1
            progress(frames, total)
    except (DivergedError, KeyboardInterrupt) as error:
        ended = error
    finally:
        # Whatever happens, also what nobody foresaw: the frames that were finished are saved.
        writer.close()
    _warn_of_inside_out(rest, sim)
    stages = len(STAGES.get(scene.solver.integrator, [None]))
    forces = max(frames - 1, 0) * sim.substeps * stages
    observer.diverged = isinstance(ended, DivergedError)
    outcomes = observer.outcomes()
    record = {
        "scene": scene.name,
        "stage": str(folder / STAGE_NAME),
        "run_dir": str(folder),
        "frames": frames,
        "fps": scene.fps,
        "particles": sim.model.particle_count,
        "springs": sim.model.spring_count,
        "voxels": sim.model.voxel_count,
        "substeps": sim.substeps,
        "dt": sim.dt,
        "precision": scene.solver.precision,
        "wall_seconds": time.perf_counter() - began,
        "springs_per_second": sim.model.spring_count * forces / stepping if forces else 0.0,
        "diverged": isinstance(ended, DivergedError),
        "interrupted": isinstance(ended, KeyboardInterrupt),
        "expect": [outcome.as_dict() for outcome in outcomes],
        **provenance(scene, sim),
    }
    with whole_file(folder / RECORD_NAME) as unfinished:
        unfinished.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    run = Run(record, outcomes)
    if isinstance(ended, DivergedError):
        raise RunEndedError(str(ended), run, ended.exit_code) from ended
    if ended is not None:
        raise RunEndedError(f"interrupted after {frames} of {total} frames, which are in {folder}", run, 130) from ended
    return run


def forecast(scene: Scene, *, device: str = "auto") -> dict[str, Any]:
    """Build a scene, step it for a moment, and say what a run of it takes.

    Returns:
        ``particles, springs, voxels``; ``memory_bytes``, an estimate of the peak, and ``body_memory_bytes``, of
        each body by name; ``dt`` [s], ``substeps`` a frame,
        ``frames``; ``dt_limit`` and ``dt_limit_in_contact``, the largest stable step by integrator, s or None;
        ``seconds``, an estimate from this machine's speed now; ``device``.

    Raises:
        InputError: the scene cannot be built.
    """
    plan = plan_scene(scene)
    sim = Simulator(plan, device=device)
    warn_of_deep_starts(sim)
    if broken := sim.broken_limit():
        log.warning("%s", broken)
    sim.step()
    sim.shapes()
    sim.diagnostics()
    began = time.perf_counter()
    sim.step()
    # Whole frames where they are quick, as a run does them; single substeps where a frame would take too long.
    count = sim.substeps if sim.substeps * (time.perf_counter() - began) < FORECAST_SECONDS else 1
    sim.prepare()
    began, substeps = time.perf_counter(), 0
    while substeps == 0 or time.perf_counter() - began < FORECAST_SECONDS:
        sim.step(count)
        substeps += count
    stepped = time.perf_counter()
    sim.shapes()
    sim.diagnostics()
    frame = (stepped - began) / substeps * sim.substeps + time.perf_counter() - stepped
    return {
        "scene": scene.name,
        "voxels": sim.model.voxel_count,
        "particles": sim.model.particle_count,
        "springs": sim.model.spring_count,
        "memory_bytes": plan.memory_bytes,
        "body_memory_bytes": plan.body_bytes,
        "dt": sim.dt,
        "dt_limit": sim.step_limits(contacts=False),
        "dt_limit_in_contact": sim.step_limits(contacts=True),
        "substeps": sim.substeps,
        "frames": scene.frame_count,
        "seconds": frame * (scene.frame_count - 1),
        "device": sim.device,
    }


def provenance(scene: Scene, sim: Simulator) -> dict[str, Any]:
    """Return what is needed to repeat a run."""
    packages = ("warpjelly", "warp-lang", "numpy", "usd-core", "trimesh")
    return {
        "resolved_scene": scene.model_dump(mode="json", exclude_none=True) | {"gravity": scene.gravity_vector.tolist()},
        "versions": {"python": platform.python_version()} | {name: metadata.version(name) for name in packages},
        "machine": platform.machine(),
        "device": sim.device,
    }


def _metrics_row(index: int, seconds: float, figures: Mapping[str, Any]) -> dict[str, float]:
    """Return one row of metrics.csv by column name; SI units."""
    row: dict[str, float] = {"frame": index, "time": seconds}
    for name, value in figures.items():
        if name in ("momentum", "angular_momentum"):
            row |= {f"{name}_{axis}": float(component) for axis, component in zip("xyz", value, strict=True)}
        elif name in ("penetrations", "overlaps"):
            row[f"max_{name[:-1]}"] = float(value.max())
        else:
            row[name] = value
    return row


def _warn_of_long_steps(sim: Simulator) -> None:
    effort = evaluations(sim.model)
    if effort * sim.model.spring_count > LIMIT_SPRINGS and effort > LIMIT_SHARE * sim.substeps * sim.scene.frame_count:
        return
    if broken := sim.broken_limit():
        log.warning("%s", broken)


def _warn_of_inside_out(rest: Sequence[ShapeFrame], sim: Simulator) -> None:
    names = [
        shape.body
        for shape, before, now in zip(sim.model.shapes, rest, sim.shapes(), strict=True)
        if shape.name == SURFACE and not shape.double_sided and _is_mirrored(before.points, now.points)
    ]
    if names:
        log.warning(
            "%s: inside out at the end; stiffer springs, a slower impact or a smaller step keep a body from it",
            ", ".join(f"'{name}'" for name in names),
        )


def _is_mirrored(rest: np.ndarray, now: np.ndarray) -> bool:
    """Say whether the linear map that best takes points [count, 3] to where they are now mirrors them."""
    a, b = (points.astype(float) - points.mean(axis=0, dtype=float) for points in (rest, now))
    return bool(np.isfinite(b).all() and np.linalg.det(np.linalg.lstsq(a, b)[0]) < 0.0)
