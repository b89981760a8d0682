"""From a scene to a run directory: stage, metrics and the record of how they came about."""

from __future__ import annotations

import csv
import json
import logging
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from .errors import DivergedError, EnvironmentFailedError, InputError
from .expect import Observer, Outcome
from .plan import plan_scene
from .scene import Scene
from .simulator import Simulator
from .surface import SurfaceMesh
from .usd import STAGE_NAME, StageWriter

log = logging.getLogger("warpjelly")

RECORD_NAME, METRICS_NAME = "run.json", "metrics.csv"
# A body that starts deeper than this in a collider, in unit cells, is thrown out of it, which is seldom meant.
DEEP_START = 0.05
# How long a forecast measures, s.
FORECAST_SECONDS = 0.3


@dataclass(frozen=True)
class Run:
    """What came of a run."""

    record: dict[str, Any]
    """The contents of run.json."""
    outcomes: list[Outcome]
    """What the scene expects of itself, measured."""
    error: DivergedError | None = field(default=None)
    """Why the run ended early, where it did."""


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

    Returns:
        What came of it. A run that diverged has ``error`` set; its frames up to there are in the stage.

    Raises:
        InputError: the scene cannot be built, or the directory holds a run and ``force`` is not set.
        EnvironmentFailedError: the run directory cannot be written.
        KeyboardInterrupt: after saving the frames that were finished.
    """
    folder = Path(output) if output is not None else Path("outputs") / scene.name
    if not force and (folder / RECORD_NAME).exists() | (folder / STAGE_NAME).exists():
        raise InputError(f"{folder}: holds a run already; replace it with --force, or choose another folder with -o")
    plan = plan_scene(scene)
    sim = Simulator(plan, device=device)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Without its record a directory does not count as a run, so one that is being replaced never looks finished.
        (folder / RECORD_NAME).unlink(missing_ok=True)
        (folder / STAGE_NAME).unlink(missing_ok=True)
        with open(folder / METRICS_NAME, "w", newline="", encoding="utf-8") as metrics:
            return _simulate_into(folder, sim, csv.writer(metrics), progress)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot write the run: {error.strerror or error}") from error


def _simulate_into(folder: Path, sim: Simulator, metrics: Any, progress: Callable[[int, int], None]) -> Run:
    scene, total = sim.scene, sim.scene.frame_count
    rest = sim.surfaces()
    meshes = [
        SurfaceMesh(body.name, surface.points, surface.normals, body.quads, body.double_sided)
        for body, surface in zip(sim.model.bodies, rest, strict=True)
    ]
    _warn_of_deep_starts(sim)
    writer = StageWriter(folder / STAGE_NAME, scene=scene, meshes=meshes, provenance=provenance(scene, sim))
    observer = Observer(sim)
    sim.prepare()
    stepping, frames, error, interrupted = 0.0, 0, None, None
    began = time.perf_counter()
    try:
        for index in range(total):
            if index > 0:
                before = time.perf_counter()
                sim.advance_frame()
                stepping += time.perf_counter() - before
            row = _metrics_row(index, sim)
            if index == 0:
                metrics.writerow(row)
            metrics.writerow(row.values())
            observer.observe()
            writer.write_frame(index, sim.surfaces())
            frames = index + 1
            progress(frames, total)
    except DivergedError as diverged:
        error = diverged
    except KeyboardInterrupt as interrupt:
        interrupted = interrupt
    writer.close()
    evaluations = max(frames - 1, 0) * scene.substeps
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
        "substeps": scene.substeps,
        "dt": scene.dt,
        "precision": scene.solver.precision,
        "wall_seconds": time.perf_counter() - began,
        "springs_per_second": sim.model.spring_count * evaluations / stepping if evaluations else 0.0,
        "diverged": error is not None,
        "interrupted": interrupted is not None,
        "expect": [outcome.as_dict() for outcome in outcomes],
        **provenance(scene, sim),
    }
    _write_atomically(folder / RECORD_NAME, json.dumps(record, indent=2) + "\n")
    if interrupted is not None:
        raise interrupted
    return Run(record, outcomes, error)


def forecast(scene: Scene, *, device: str = "auto") -> dict[str, Any]:
    """Build a scene, step it for a moment, and say what a run of it takes.

    Returns:
        ``particles, springs, voxels``; ``memory_bytes``, an estimate of the peak; ``dt`` [s], ``substeps`` a frame,
        ``frames``; ``seconds``, an estimate from this machine's speed now; ``device``.

    Raises:
        InputError: the scene cannot be built.
    """
    plan = plan_scene(scene)
    sim = Simulator(plan, device=device)
    sim.step()
    sim.surfaces()
    sim.diagnostics()
    began = time.perf_counter()
    sim.step()
    # Whole frames where they are quick, as a run does them; single substeps where a frame would take too long.
    count = scene.substeps if scene.substeps * (time.perf_counter() - began) < FORECAST_SECONDS else 1
    sim.prepare()
    began, substeps = time.perf_counter(), 0
    while substeps == 0 or time.perf_counter() - began < FORECAST_SECONDS:
        sim.step(count)
        substeps += count
    stepped = time.perf_counter()
    sim.surfaces()
    sim.diagnostics()
    frame = (stepped - began) / substeps * scene.substeps + time.perf_counter() - stepped
    return {
        "scene": scene.name,
        "voxels": sim.model.voxel_count,
        "particles": sim.model.particle_count,
        "springs": sim.model.spring_count,
        "memory_bytes": plan.memory_bytes,
        "dt": scene.dt,
        "substeps": scene.substeps,
        "frames": scene.frame_count,
        "seconds": frame * (scene.frame_count - 1),
        "device": sim.device,
    }


def provenance(scene: Scene, sim: Simulator) -> dict[str, Any]:
    """Return what is needed to repeat a run."""
    packages = ("warpjelly", "warp-lang", "numpy", "usd-core", "trimesh")
    return {
        "resolved_scene": scene.model_dump(mode="json", exclude_none=True),
        "versions": {"python": platform.python_version()} | {name: metadata.version(name) for name in packages},
        "machine": platform.machine(),
        "device": sim.device,
    }


def _metrics_row(index: int, sim: Simulator) -> dict[str, float]:
    """Return one row of metrics.csv by column name; SI units."""
    row: dict[str, float] = {"frame": index, "time": sim.time}
    for name, value in sim.diagnostics().items():
        if name in ("momentum", "angular_momentum"):
            row |= {f"{name}_{axis}": float(component) for axis, component in zip("xyz", value, strict=True)}
        else:
            row[name] = value
    return row


def _warn_of_deep_starts(sim: Simulator) -> None:
    for body, depth in zip(sim.model.bodies, sim.penetrations(), strict=True):
        if depth > DEEP_START * body.unit:
            log.warning("body '%s' starts %.3g m deep in a collider and will be thrown out of it", body.name, depth)


def _write_atomically(path: Path, text: str) -> None:
    """Write a file so that it is there whole or not at all, even after a power loss."""
    temporary = path.with_name(f"{path.name}.tmp.{os.getpid()}")
    with open(temporary, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
