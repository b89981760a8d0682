"""Speed on standard scenes, beside that of the plain scatter kernel: ratios hold where the speed of a machine drifts.

``benchmarks/peers.py`` measures other simulators with the same scenes, in the same way.
"""

from __future__ import annotations

import gc
import json
import logging
import math
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from multiprocessing import get_context
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import springs

from .device import choose_device
from .errors import EnvironmentFailedError, InputError
from .files import missing
from .machine import available_cores
from .scene import Scene
from .simulator import Simulator
from .stepping import Stepper

log = logging.getLogger("warpjelly")

# How long each variant steps in a round, s: long for a clock, short for the drift of a machine.
SLICE = 0.05
# A scene is warned of when it loses more than this share of what it was in the baseline, over the reference kernel.
TOLERANCE = 0.25
BASELINE = Path(__file__).with_name("baseline.json")

STEPS_PER_FRAME = 10
# A run of a second.
RUN_STEPS = 1000
TIME_STEP = 1e-5
# Between cubes in free fall, m.
GAP = 0.1
# Of what stands on the floor, m.
DEPTH = 1e-4
# The time step is a tenth of what one such spring alone allows.
MATERIAL = {
    "law": "hooke",
    "particle_mass": 0.01,
    **{kind: {"stiffness": 1e6, "damping": 2.0} for kind in ("structural", "shear", "bend")},
}
# The floor, and what culling has to keep away.
COLLIDERS = [
    {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [40.0, 40.0]},
    {"type": "plane", "center": [20.0, 2.0, 0.0], "normal": [-1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "plane", "center": [-20.0, 2.0, 0.0], "normal": [1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "sphere", "center": [10.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [-10.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [0.0, 0.5, 10.0], "radius": 0.5},
]


@dataclass(frozen=True)
class Cubes:
    """Cubes of 1 m beside each other."""

    particles_per_edge: int
    count: int = 1

    def scene(self, *, gap: float = GAP, pinned: bool = False, **parts: Any) -> Scene:
        """Return them in free fall, or pinned so that they stay where they stand on the floor; and parts of a scene."""
        side = math.ceil(math.sqrt(self.count))
        cube: dict[str, Any] = {
            "type": "cube",
            "material": "jelly",
            "particles_per_edge": self.particles_per_edge,
            "pinned": [{"lower": [-1.0] * 3, "upper": [1.0] * 3}] if pinned else [],
        }
        places = [[(1.0 + gap) * (number - side // 2) for number in divmod(i, side)] for i in range(self.count)]
        scene = {
            "name": "bench",
            "materials": {"jelly": MATERIAL},
            "soft_contact": {"mode": "off"},
            "bodies": [
                {**cube, "name": f"cube_{i}", "position": [x, 0.5 - DEPTH, z]} for i, (x, z) in enumerate(places)
            ],
        }
        solver = {"dt": TIME_STEP, "steps_per_frame": STEPS_PER_FRAME, **parts.pop("solver", {})}
        return Scene.model_validate({**scene, "solver": solver, **parts})


SCENES = {
    "cube_8": Cubes(8),
    "cube_32": Cubes(32),
    "cube_64": Cubes(64),
    "cube_128": Cubes(128),
    "cubes_100": Cubes(8, count=100),
}
# What takes less than a minute.
QUICK = [name for name in SCENES if name != "cube_128"]


@dataclass(frozen=True)
class Figures:
    """What was measured of a scene: medians over the rounds; steps are full ones, forces and integration."""

    particles: int
    springs: int
    seconds_per_substep: float
    """Of bodies in free fall, with semi-implicit Euler."""
    substeps_per_second: float
    springs_per_second: float
    springs_per_second_range: tuple[float, float]
    """Least and most of the rounds."""
    cores_used: float
    """Processor time over time."""
    reference_ratio: float
    """Springs per second over those of the plain scatter kernel alone, on one core."""
    reference_ratio_range: tuple[float, float]
    rk4_ratio: float
    """Time of a step of RK4 over that of a step."""
    integration_share: float
    """Share of a step that particles without springs take: gravity and integration."""
    contact_share: float
    """Share of a step on the floor that culling and contact take."""
    pair_share: float | None
    """Share of a step that contact between bodies takes where each touches its neighbours; None with one body."""
    at_once_ratio: float | None
    """Time that steps of the bodies take as scenes one after another, over that of one scene; None with one body."""
    at_once_core_ratio: float | None
    """The same of processor time: how much more each core does that is used."""
    runs_at_once_ratio: float | None
    """The same of whole runs: build a scene, capture its graphs, and make RUN_STEPS steps."""
    runs_at_once_core_ratio: float | None
    """The same of their processor time."""
    first_frame_seconds: float
    """From the start of a Python process to the end of the first frame, of 10 steps."""
    bytes_per_particle: float
    """Of all arrays of the simulator, with colliders."""


def run(
    names: Sequence[str], *, device: str, rounds: int, baseline: Path, progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Measure standard scenes, each in a process of its own, and compare them with an earlier run.

    Args:
        names: keys of SCENES.
        device: "auto", "cpu", "cuda:0" ...
        rounds: how often each variant is timed.
        baseline: report of the earlier run.
        progress: called with how many scenes are done, of how many.

    Returns:
        The report: ``device, device_name, cores, python, warpjelly, warp-lang, numpy, rounds``; ``scenes``, the fields
        of Figures by name of the scene; ``baseline``, the first three, and ``reference_ratio`` and ``cores_used`` by
        name of the scene, or None where it is of another kind of device; ``regressions``, a line for each scene that
        has become slower.

    Raises:
        InputError: there is no such device, or the baseline is no such report.
        EnvironmentFailedError: the process of a scene was lost.
    """
    then: dict[str, Any] | None = read_baseline(baseline)
    device = choose_device(device)
    if then is not None and device.partition(":")[0] != then["device"].partition(":")[0]:
        then = None
    figures: dict[str, Figures] = {}
    for name in names:
        progress(len(figures), len(names))
        with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
            try:
                figures[name] = pool.submit(measure, SCENES[name], device, rounds, time.time()).result()
            except BrokenProcessPool as error:
                raise EnvironmentFailedError(f"{name}: its process was killed; is there too little memory?") from error
    progress(len(figures), len(names))
    slower = regressions(figures, then, cores=available_cores()) if then is not None else []
    for line in slower:
        log.warning("%s", line)
    return {
        **machine(device),
        "rounds": rounds,
        "scenes": {name: asdict(measured) for name, measured in figures.items()},
        "baseline": then,
        "regressions": slower,
    }


def measure(cubes: Cubes, device: str, rounds: int, began: float) -> Figures:
    """Measure a scene; variants take turns, so that drift of the machine hits them alike.

    Args:
        cubes: the bodies.
        device: "cpu", "cuda:0" ...
        rounds: how often each variant is timed.
        began: when the time to the first frame began, s since the epoch.
    """
    free = Simulator(cubes.scene(), device=device)
    free.advance_frame()
    first_frame = time.time() - began
    dust = {"name": "dust", "type": "network", "material": "jelly", "points": free.positions.tolist()}
    ground = Simulator(cubes.scene(pinned=True, colliders=COLLIDERS), device=device)
    variants = {
        "free": free.step,
        "reference": reference_sweep(free),
        "rk4": twin(free, cubes.scene(solver={"integrator": "rk4"})),
        "dust": Simulator(cubes.scene(bodies=[dust]), device=device).step,
        "ground": ground.step,
        "standing": twin(ground, cubes.scene(pinned=True)),
    }
    if cubes.count > 1:
        # Opposite particles, balls as wide as a unit cell, overlap.
        close: dict[str, Any] = {"gap": 0.9 / (cubes.particles_per_edge - 1), "pinned": True}
        touching = Simulator(cubes.scene(**close, soft_contact={}), device=device)
        singles = [Simulator(Cubes(cubes.particles_per_edge).scene(), device=device) for _ in range(cubes.count)]

        def step_singles(count: int) -> None:
            for single in singles:
                single.step(count)

        variants["touching"], variants["beside"] = touching.step, twin(touching, cubes.scene(**close))
        variants["singles"] = step_singles
    times = time_in_turn(variants, device=device, rounds=rounds)
    if cubes.count > 1:
        single = Cubes(cubes.particles_per_edge)
        for _ in range(rounds):
            times.setdefault("single_runs", []).append(time_runs([single] * cubes.count, device=device))
            times.setdefault("run", []).append(time_runs([cubes], device=device))

    def ratio(above: str, below: str) -> float:
        return statistics.median(a.seconds / b.seconds for a, b in zip(times[above], times[below], strict=True))

    def core_ratio(above: str, below: str) -> float:
        turns = zip(times[above], times[below], strict=True)
        return statistics.median(a.seconds * a.cores / (b.seconds * b.cores) for a, b in turns)

    model = free.model
    seconds = statistics.median(slice_.seconds for slice_ in times["free"])
    rates = [model.spring_count / slice_.seconds for slice_ in times["free"]]
    ratios = [a.seconds / b.seconds for a, b in zip(times["reference"], times["free"], strict=True)]
    return Figures(
        particles=model.particle_count,
        springs=model.spring_count,
        seconds_per_substep=seconds,
        substeps_per_second=1.0 / seconds,
        springs_per_second=model.spring_count / seconds,
        springs_per_second_range=(min(rates), max(rates)),
        cores_used=statistics.median(slice_.cores for slice_ in times["free"]),
        reference_ratio=statistics.median(ratios),
        reference_ratio_range=(min(ratios), max(ratios)),
        rk4_ratio=ratio("rk4", "free"),
        integration_share=ratio("dust", "free"),
        contact_share=1.0 - ratio("standing", "ground"),
        pair_share=1.0 - ratio("beside", "touching") if "touching" in times else None,
        at_once_ratio=ratio("singles", "free") if "singles" in times else None,
        at_once_core_ratio=core_ratio("singles", "free") if "singles" in times else None,
        runs_at_once_ratio=ratio("single_runs", "run") if "run" in times else None,
        runs_at_once_core_ratio=core_ratio("single_runs", "run") if "run" in times else None,
        first_frame_seconds=first_frame,
        bytes_per_particle=held_bytes(ground) / model.particle_count,
    )


def twin(sim: Simulator, scene: Scene) -> Callable[[int], None]:
    """Return a function that steps the arrays of a simulator as another scene of the same bodies, with no more contact.

    Where arrays lie in memory changes speed by up to a fifth, which is more than what is measured.
    """
    contact = Simulator(scene, device=sim.device).model
    stepper = Stepper(
        replace(sim.model, colliders=contact.colliders, skin=contact.skin),
        sim.state,
        integrator=scene.solver.integrator,
        dt=sim.dt,
        culling=scene.solver.culling,
        threads=available_cores(),
    )

    def step(count: int) -> None:
        frames, rest = divmod(count, STEPS_PER_FRAME)
        for steps in [STEPS_PER_FRAME] * frames + [1] * rest:
            stepper.step(steps)

    return step


@dataclass(frozen=True)
class Slice:
    """Some steps that were timed."""

    seconds: float
    """Of one step."""
    cores: float
    """Processor time over time."""


def time_in_turn(variants: Mapping[str, Callable[[int], None]], *, device: str, rounds: int) -> dict[str, list[Slice]]:
    """Time functions that make a number of steps, in rounds in which each has its turn."""
    counts = {}
    for name, step in variants.items():
        # The first steps compile and capture, whole frames and single steps.
        time_steps(step, STEPS_PER_FRAME + 1, device=device)
        counts[name] = steps_for(SLICE, time_steps(step, STEPS_PER_FRAME, device=device).seconds)
    times: dict[str, list[Slice]] = {name: [] for name in variants}
    for _ in range(rounds):
        for name, step in variants.items():
            times[name].append(time_steps(step, counts[name], device=device))
    return times


def time_runs(scenes: Sequence[Cubes], *, device: str) -> Slice:
    """Time runs one after another, each from its scene to its last step; per step of all of them."""

    def run(count: int) -> None:
        for cubes in scenes:
            sim = Simulator(cubes.scene(), device=device)
            sim.prepare()
            sim.step(count)

    return time_steps(run, RUN_STEPS, device=device)


def steps_for(seconds: float, seconds_per_step: float) -> int:
    """Return how many steps take about some time, at least one; whole frames where it is some of them."""
    steps = max(1, round(seconds / seconds_per_step))
    return steps // STEPS_PER_FRAME * STEPS_PER_FRAME or steps


def time_steps(step: Callable[[int], None], count: int, *, device: str = "cpu") -> Slice:
    """Time a function that makes a number of steps."""
    began, began_processor = time.perf_counter(), time.process_time()
    step(count)
    if device != "cpu":
        wp.synchronize_device(device)
    seconds = time.perf_counter() - began
    return Slice(seconds / count, (time.process_time() - began_processor) / seconds)


def reference_sweep(sim: Simulator) -> Callable[[int], None]:
    """Return a function that launches the plain scatter kernel over all springs a number of times."""
    model, state = sim.model, sim.state
    f, losses = wp.zeros_like(state.f), wp.zeros(len(model.spans), dtype=wp.float64, device=sim.device)

    def sweep(count: int) -> None:
        for _ in range(count):
            wp.launch(
                springs.add_spring_forces,
                dim=(len(model.spans), springs.MAX_SPAN),
                inputs=[model.spans, model.spring_classes, state.x, state.v, model.real(0.0)],
                outputs=[f, losses],
                device=sim.device,
            )

    return sweep


def held_bytes(root: object) -> int:
    """Return the size of all arrays that an object holds, of Warp and of NumPy; views count as what they look at."""
    # Objects are kept, so that no other gets the same id.
    seen: dict[int, object] = {}
    size = 0
    todo = [root]
    while todo:
        item = todo.pop()
        if id(item) in seen or isinstance(item, type | ModuleType | FunctionType | wp.Device | wp.Kernel):
            continue
        seen[id(item)] = item
        if isinstance(item, wp.array) and item.deleter is not None:
            size += item.capacity
        elif isinstance(item, np.ndarray) and not isinstance(item.base, np.ndarray | wp.array):
            size += item.nbytes
        elif isinstance(item, np.ndarray):
            todo.append(item.base)
        else:
            todo += gc.get_referents(item)
    return size


def processor() -> str:
    """Return the name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def machine(device: str) -> dict[str, Any]:
    """Return what the figures belong to."""
    return {
        "device": device,
        "device_name": processor() if device == "cpu" else wp.get_device(device).name,
        "cores": available_cores(),
        "python": platform.python_version(),
        **{package: metadata.version(package) for package in ("warpjelly", "warp-lang", "numpy")},
    }


def read_baseline(path: Path) -> dict[str, Any]:
    """Return of the report of an earlier run what a later one is compared with.

    Raises:
        InputError: the file is missing, or is no such report.
    """
    if why := missing(path):
        raise InputError(f"{path}: {why}; `warpjelly bench -o {path}` writes a baseline")
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        return {
            **{key: str(report[key]) for key in ("device", "device_name")},
            "cores": int(report["cores"]),
            **{
                key: {name: float(scene[key]) for name, scene in report["scenes"].items()}
                for key in ("reference_ratio", "cores_used")
            },
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a baseline; `warpjelly bench -o FILE.json` writes one") from error


def regressions(figures: Mapping[str, Figures], baseline: Mapping[str, Any], *, cores: int) -> list[str]:
    """Say which scenes are slower than in a baseline, by their ratios to the reference kernel.

    That runs on one core, so with fewer cores than were used then the ratio may be as much smaller.
    """
    lines = []
    for name, now in figures.items():
        if name in baseline["reference_ratio"]:
            then = baseline["reference_ratio"][name] * min(1.0, cores / baseline["cores_used"][name])
            if now.reference_ratio < (1.0 - TOLERANCE) * then:
                lines.append(
                    f"{name}: {now.reference_ratio:.2f} times as fast as the reference kernel, but {then:.2f} times "
                    f"with {cores} cores by the baseline, of {baseline['device_name']} with {baseline['cores']} cores; "
                    f"{TOLERANCE:.0%} less are tolerated"
                )
    return lines


def table(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return the figures in words, a row for each, the first one with the names of the scenes."""
    scenes = report["scenes"].values()
    ratios = report["baseline"]["reference_ratio"] if report["baseline"] is not None else {}

    def row(label: str, form: Callable[[dict[str, Any]], str]) -> tuple[str, ...]:
        return (label, *map(form, scenes))

    def share(value: float | None) -> str:
        return "–" if value is None else f"{value:.0%}"

    def times(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    return [
        ("", *report["scenes"]),
        row("particles", lambda s: f"{s['particles']:,}"),
        row("springs", lambda s: f"{s['springs']:,}"),
        row("million springs/s", lambda s: f"{s['springs_per_second'] / 1e6:.0f}"),
        row("  least to most", lambda s: " to ".join(f"{rate / 1e6:.0f}" for rate in s["springs_per_second_range"])),
        row("ns per spring", lambda s: f"{1e9 / s['springs_per_second']:.2f}"),
        row("substeps/s", lambda s: f"{s['substeps_per_second']:,.4g}"),
        row("cores used", lambda s: f"{s['cores_used']:.1f}"),
        row("reference kernel: times as fast", lambda s: f"{s['reference_ratio']:.1f}"),
        row("  least to most", lambda s: " to ".join(f"{ratio:.1f}" for ratio in s["reference_ratio_range"])),
        ("  in the baseline", *(f"{ratios[name]:.1f}" if name in ratios else "–" for name in report["scenes"])),
        row("a step of RK4, in steps", lambda s: f"{s['rk4_ratio']:.2f}"),
        row("share of springs", lambda s: share(1.0 - s["integration_share"])),
        row("  gravity, integration", lambda s: share(s["integration_share"])),
        row("  contact, on the floor", lambda s: share(s["contact_share"])),
        row("  contact between bodies", lambda s: share(s["pair_share"])),
        row("steps one after another, in times at once", lambda s: times(s["at_once_ratio"])),
        row("  per core used", lambda s: times(s["at_once_core_ratio"])),
        row(f"runs of {RUN_STEPS:,} steps one after another", lambda s: times(s["runs_at_once_ratio"])),
        row("  per core used", lambda s: times(s["runs_at_once_core_ratio"])),
        row("first frame after", lambda s: f"{s['first_frame_seconds']:.2f} s"),
        row("bytes per particle", lambda s: f"{s['bytes_per_particle']:.0f}"),
    ]
