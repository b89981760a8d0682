"""From a scene to a run directory: stage, metrics and the record of how they came about."""

from __future__ import annotations

import logging
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpjelly.kernels.integrators import STAGES

from .background import Background
from .checkpoint import (
    Checkpoint,
    differences,
    origin_of,
    restore_state,
    scene_hash,
    scene_keys,
    state_arrays,
    version_of,
)
from .errors import INTERRUPTED, DivergedError, EnvironmentFailedError, InputError, WarpjellyError
from .expect import Observer, Outcome
from .files import locked
from .memory import COPIED_BYTES, seeks_limits
from .plan import plan_scene
from .readers.companions import files_of
from .rundir import (
    CHECKPOINT_NAME,
    RECORD_NAME,
    Recorder,
    find_checkpoint,
    open_metrics,
    read_record,
    refuse_to_replace_run,
    remove_leftovers,
    write_record,
)
from .scene import Scene
from .shapes import SURFACE, ShapeFrame
from .shot import Shot
from .signals import interruptions
from .simulator import Simulator
from .stability import evaluations
from .stage.stagefiles import find_stage
from .stage.stagewriter import StageWriter
from .starts import warn_of_deep_starts

log = logging.getLogger("warpjelly")
steps = logging.getLogger("warpjelly.steps")

# Frames that were simulated and are not written yet: while one is written, the next but one may be simulated.
FRAMES_IN_FLIGHT = 2
# A run warns of a body that is deeper than this in a collider at the end, in unit cells.
DEEP_END = 1.0
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
    threads: int | None = None,
    force: bool = False,
    resume: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Simulate a scene and write its run directory.

    Args:
        scene: what to simulate.
        output: the run directory; ``outputs/<scene name>`` unless given.
        device: "auto", "cpu", "cuda:0" ...
        threads: how many may be used on the CPU, None for one per core; results do not depend on it.
        force: replace a run that is there already.
        resume: go on with a run of this scene that is there already, however it ended, as if it had never ended; also
            one that has finished, if the scene has more frames now. Without one, start.
        progress: called after each frame with the number of frames done and in all.

    Raises:
        InputError: the scene cannot be built; the directory is a file, or holds a run and neither ``force`` nor
            ``resume`` is set, or one of another scene; or another process is writing to it.
        RunEndedError: the simulation diverged or was interrupted; the error has the run up to there.
        EnvironmentFailedError: the run directory cannot be written.
    """
    folder = Path(output) if output is not None else Path("outputs") / scene.name
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: cannot write the run: it is a file; choose a folder with -o")
    _require_no_shot(scene, folder)
    if force and resume:
        raise InputError("--resume goes on with a run, --force replaces it: give one of them")
    try:
        with ExitStack() as held:
            if existed := folder.is_dir():
                held.enter_context(locked(folder))
            checkpoint = find_checkpoint(folder, scene) if resume else None
            if checkpoint is not None and (run := _finished_run(folder, scene)):
                return run
            if checkpoint is not None and checkpoint.frame_count == 0:
                checkpoint = None
            if not (force or resume):
                refuse_to_replace_run(folder)
            began = time.perf_counter()
            sim = Simulator(plan_scene(scene), device=device, threads=threads)
            build_seconds = time.perf_counter() - began
            warn_of_deep_starts(sim)
            _warn_of_long_steps(sim)
            if not existed:
                folder.mkdir(parents=True, exist_ok=True)
                held.enter_context(locked(folder))
                # Another process may have come first.
                refuse_to_replace_run(folder)
            return _simulate_into(folder, sim, build_seconds, checkpoint, progress)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot write the run: {error.strerror or error}") from error


def _require_no_shot(scene: Scene, folder: Path) -> None:
    """Refuse a run directory with a file that the shot is made of: the run could replace it."""
    for file in files_of(scene.output.over) if scene.output.over is not None else ():
        if folder.resolve() in file.resolve().parents:
            raise InputError(f"{folder}: a file of output.over is in this folder: {file}; choose another with -o")


def _finished_run(folder: Path, scene: Scene) -> Run | None:
    """Return what came of the run in a folder, if it needs no more frames.

    Raises:
        RunEndedError: it diverged.
    """
    if not (folder / RECORD_NAME).is_file():
        return None
    record = read_record(folder)
    run = Run(record, [Outcome(**{k: v for k, v in entry.items() if k != "met"}) for entry in record["expect"]])
    if record["diverged"]:
        raise RunEndedError(f"{folder}: the run diverged after {record['frames']} frames", run, DivergedError.exit_code)
    return run if record["frames"] >= scene.frame_count and not record["interrupted"] else None


def _simulate_into(
    folder: Path,
    sim: Simulator,
    build_seconds: float,
    checkpoint: Checkpoint | None,
    progress: Callable[[int, int], None],
) -> Run:
    """Simulate the frames that a run directory lacks."""
    scene, rest = sim.scene, sim.shapes()
    keys, origin = scene_keys(scene), origin_of(sim.device)
    if checkpoint is not None and (changed := differences(checkpoint.origin, origin)):
        log.warning("%s: from here on, last bits may differ: %s", folder, "; ".join(changed))
    observer = Observer(sim)
    done = 0 if checkpoint is None else checkpoint.frame_count
    if checkpoint is not None:
        restore_state(sim, checkpoint.part("state"))
        observer.restore(checkpoint.part("observer"), done)
    # Without its record a run does not count as finished.
    (folder / RECORD_NAME).unlink(missing_ok=True)
    remove_leftovers(folder)
    if checkpoint is None:
        Checkpoint(0, keys, origin, {}).save(folder / CHECKPOINT_NAME)
    with closing(open_metrics(folder, done)) as metrics:
        writer = StageWriter(
            folder,
            scene=scene,
            shapes=sim.model.shapes,
            rest=rest,
            provenance=provenance(scene, sim),
            resume=None if checkpoint is None else checkpoint.part("stage"),
        )
        recorder = Recorder(folder, writer, metrics, scene=keys, origin=origin)
        sim.prepare()
        began, ended = time.perf_counter(), None
        try:
            stepping, ended = _simulate_frames(sim, observer, writer, recorder, progress)
            if not isinstance(ended, KeyboardInterrupt):
                writer.finish()
        except KeyboardInterrupt as error:
            ended = error
        except EnvironmentFailedError as error:
            if not writer.saved_count:
                raise
            kept = f"{writer.saved_count} of {scene.frame_count} frames are kept; go on with --resume"
            raise EnvironmentFailedError(f"{error}; {kept}") from error
    if not isinstance(ended, DivergedError):
        _warn_of_inside_out(rest, sim)
        _warn_of_deep_ends(sim)
    frames = writer.frame_count
    observer.diverged = isinstance(ended, DivergedError)
    outcomes = observer.outcomes()
    stages = len(STAGES.get(scene.solver.integrator, [None]))
    forces = max(frames - max(done, 1), 0) * sim.substeps * stages
    record = {
        "scene": scene.name,
        "scene_hash": scene_hash(scene),
        "stage": str(find_stage(folder)),
        "run_dir": str(folder),
        "frames": frames,
        "resumed_from": done,
        **simulated(scene, sim),
        "build_seconds": build_seconds,
        "threads": sim.threads,
        "wall_seconds": time.perf_counter() - began,
        "springs_per_second": sim.model.spring_count * forces / stepping if forces else 0.0,
        "diverged": isinstance(ended, DivergedError),
        "interrupted": isinstance(ended, KeyboardInterrupt),
        "expect": [outcome.as_dict() for outcome in outcomes],
        **provenance(scene, sim),
    }
    write_record(folder, record)
    run = Run(record, outcomes)
    if isinstance(ended, DivergedError):
        raise RunEndedError(str(ended), run, ended.exit_code) from ended
    if ended is not None:
        what = f"interrupted after {frames} of {scene.frame_count} frames, which are in {folder}; go on with --resume"
        raise RunEndedError(what, run, INTERRUPTED) from ended
    return run


def _simulate_frames(
    sim: Simulator,
    observer: Observer,
    writer: StageWriter,
    recorder: Recorder,
    progress: Callable[[int, int], None],
) -> tuple[float, DivergedError | KeyboardInterrupt | None]:
    """Simulate the frames that are not written yet; however that ends, those that were finished are on the disk then.

    Returns:
        The time it took to step, s; and what ended the run before its last frame.
    """
    first, total = writer.frame_count, sim.scene.frame_count
    stepping = 0.0
    with Background(FRAMES_IN_FLIGHT) as background, interruptions() as interrupted:
        try:
            for index in range(first, total):
                if index > 0:
                    before = time.perf_counter()
                    sim.advance_frame()
                    stepping += time.perf_counter() - before
                figures = sim.diagnostics()
                observer.observe(figures["penetrations"])
                stopping = interrupted()
                due = stopping or index + 1 == total or (index + 1 - first) % writer.clip_length == 0
                # One checkpoint at a time: each may have a copy of the state.
                if due:
                    background.join()
                changing, copied = _changing_arrays(sim, observer) if due else (None, True)
                row = metrics_row(index, sim.time, figures)
                background.submit(recorder.save, index, sim.shapes(), row, changing)
                if not copied:
                    background.join()
                progress(index + 1, total)
                if stopping and index + 1 < total:
                    return stepping, KeyboardInterrupt()
        except (DivergedError, KeyboardInterrupt) as error:
            return stepping, error
        finally:
            background.join()
            writer.flush()
    return stepping, None


def _changing_arrays(sim: Simulator, observer: Observer) -> tuple[dict[str, np.ndarray], bool]:
    """Return all that a checkpoint needs besides the stage, and whether it is copied: otherwise it changes."""
    parts = {"state": state_arrays(sim), "observer": observer.arrays()}
    arrays = {f"{owner}.{name}": array for owner, group in parts.items() for name, array in group.items()}
    copied = sum(array.nbytes for array in arrays.values()) <= COPIED_BYTES
    return {name: array.copy() for name, array in arrays.items()} if copied else arrays, copied


def forecast(scene: Scene, *, device: str = "auto", threads: int | None = None) -> dict[str, Any]:
    """Build a scene, step it for a moment, and say what a run of it takes, with the same options.

    Returns:
        ``particles, springs, voxels``; ``materials``, the number of voxels of each by name; ``memory_bytes``, an
        estimate of the peak, and ``body_memory_bytes``, of each body by name; ``dt`` [s], ``substeps`` a frame,
        ``frames``; ``dt_limit`` and ``dt_limit_in_contact``, the largest stable step by integrator, s or None;
        ``seconds``, an estimate from this machine's speed now; ``device``; ``over``, of a run over a shot, its file,
        the meshes that move, and the first and the last time code.

    Raises:
        InputError: the scene cannot be built.
    """
    plan = plan_scene(scene)
    sim = Simulator(plan, device=device, threads=threads)
    warn_of_deep_starts(sim)
    if broken := sim.broken_limit():
        log.warning("%s", broken)
    steps.info("measuring how long a frame takes")
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
        "materials": plan.materials,
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
        "over": _over_figures(sim),
    }


def _over_figures(sim: Simulator) -> dict[str, Any] | None:
    """Return where in a shot a run writes, if it writes over one."""
    if sim.scene.output.over is None:
        return None
    shot = Shot(sim.scene)
    return {
        "shot": str(shot.path),
        "meshes": [shape.prim for shape in sim.model.shapes],
        "time_codes": [shot.time(frame) for frame in (0, sim.scene.frame_count - 1)],
    }


def provenance(scene: Scene, sim: Simulator) -> dict[str, Any]:
    """Return what is needed to repeat a run."""
    packages = ("warpjelly", "warp-lang", "numpy", "usd-core", "trimesh")
    return {
        "resolved_scene": scene.model_dump(mode="json", exclude_none=True) | {"gravity": scene.gravity_vector.tolist()},
        "versions": {"python": platform.python_version()} | {name: version_of(name) for name in packages},
        "machine": platform.machine(),
        "device": sim.device,
    }


def simulated(scene: Scene, sim: Simulator) -> dict[str, Any]:
    """Return how much is simulated, and how finely, for the record of a run."""
    return {
        "fps": scene.fps,
        "particles": sim.model.particle_count,
        "springs": sim.model.spring_count,
        "voxels": sim.model.voxel_count,
        "substeps": sim.substeps,
        "dt": sim.dt,
        "precision": scene.solver.precision,
    }


def metrics_row(index: int, seconds: float, figures: Mapping[str, Any]) -> dict[str, float]:
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
    steps = sim.substeps * sim.scene.frame_count
    if seeks_limits(sim.model.spring_count, steps, evaluations(sim.model)) and (broken := sim.broken_limit()):
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


def _warn_of_deep_ends(sim: Simulator) -> None:
    depths = sim.diagnostics()["penetrations"]
    for body, depth in zip(sim.model.bodies, depths, strict=True):
        if depth > DEEP_END * body.unit:
            log.warning(
                "'%s' is %.3g m deep in a collider at the end, %.1f of its unit cells: the collider is too soft for "
                "it; raise contact.stiffness, or that of the collider",
                *(body.name, depth, depth / body.unit),
            )


def _is_mirrored(rest: np.ndarray, now: np.ndarray) -> bool:
    """Say whether the linear map that best takes points [count, 3] to where they are now mirrors them."""
    a, b = (points.astype(float) - points.mean(axis=0, dtype=float) for points in (rest, now))
    return bool(np.isfinite(b).all() and np.linalg.det(np.linalg.lstsq(a, b)[0]) < 0.0)
