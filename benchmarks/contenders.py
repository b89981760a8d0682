"""Who steps the same body: warpjelly, Newton, Taichi, Numba and NumPy, each with the arrays and the threads it likes.

All of them take full steps of semi-implicit Euler with gravity, and no contact.
"""

from __future__ import annotations

import math
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from warpjelly.bench import SCENES
from warpjelly.device import start_warp
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator

ROOT = Path(__file__).parents[1]
# Positions and velocities start beside those of rest by at most this share of the shortest spring; velocities, as much
# in a frame.
JITTER = 0.1


def make_scene(name: str) -> Scene:
    """Return a standard scene, or the body of coupler_40 alone, in steps like its own, ten to a frame."""
    if name != "coupler_40":
        return SCENES[name].scene()
    alone = {"colliders": [], "output.surface": "voxels", "expect": {}, "frames": 1, "duration": None}
    steps = {"solver.dt": 8e-5, "solver.steps_per_frame": 10}
    return load_scene(ROOT / "scenes" / "coupler_40.toml", overrides={**alone, **steps})


@dataclass(frozen=True)
class Thing:
    """Particles and springs as plain arrays, float32."""

    x: np.ndarray
    """[particle_count, 3], m."""
    v: np.ndarray
    """[particle_count, 3], m/s."""
    mass: np.ndarray
    """[particle_count], kg."""
    first: np.ndarray
    """One end of each spring, int32 [spring_count]."""
    second: np.ndarray
    """Its other end."""
    kind: np.ndarray
    """Its class, int32 [spring_count]."""
    classes: np.ndarray
    """(rest length [m], stiffness [N/m], damping [N s/m]), [class_count, 3]."""
    gravity: np.ndarray
    """[3], m/s^2."""
    dt: np.ndarray
    """[], s."""

    @classmethod
    def of(cls, sim: Simulator) -> Thing:
        """Take the arrays of a model, and a start at which no spring is at rest."""
        spans = sim.model.spans.numpy()
        counts = spans[:, 2]
        # Springs (i + s, j + s) with s = 0, 1 ... count - 1, for all spans at once.
        along = np.arange(counts.sum(), dtype=np.int32) - np.repeat(np.cumsum(counts) - counts, counts).astype(np.int32)
        classes = sim.model.spring_classes.numpy()
        reach = JITTER * classes[:, 0].min()
        rng = np.random.default_rng(0)
        offsets, speeds = rng.uniform(-reach, reach, (2, sim.model.particle_count, 3)).astype(np.float32)
        return cls(
            x=sim.positions + offsets,
            v=sim.velocities + speeds / np.float32(sim.substeps * sim.dt),
            mass=sim.masses,
            first=np.repeat(spans[:, 0], counts) + along,
            second=np.repeat(spans[:, 1], counts) + along,
            kind=np.repeat(spans[:, 3], counts),
            classes=classes,
            gravity=sim.model.gravity.numpy()[0],
            dt=np.array(sim.dt),
        )

    def save(self, folder: Path) -> None:
        """Write an .npy file for each array."""
        for name, array in vars(self).items():
            np.save(folder / f"{name}.npy", array)

    @classmethod
    def load(cls, folder: Path) -> Thing:
        """Map the files of another process into memory, which share it."""
        return cls(**{name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in cls.__annotations__})


class Contender:
    """What steps a thing; labels are for tables, packages have to be installed."""

    label: ClassVar[str]
    package: ClassVar[str]
    stride: ClassVar[int] = 1
    """Numbers of steps are multiples of it."""
    most_springs: ClassVar[float] = math.inf
    """Larger things are not for this one."""

    def __init__(self, thing: Thing, scene: Scene) -> None:
        raise NotImplementedError

    def step(self, count: int) -> None:
        """Make some steps."""
        raise NotImplementedError

    def positions(self) -> np.ndarray:
        """Return the positions, [particle_count, 3], m."""
        raise NotImplementedError


class Warpjelly(Contender):
    """This project, from the scene."""

    label, package = "warpjelly", "warpjelly"

    def __init__(self, thing: Thing, scene: Scene) -> None:
        self.sim = Simulator(scene, device="cpu")
        self.sim.state.x.assign(np.ascontiguousarray(thing.x.T))
        self.sim.state.v.assign(np.ascontiguousarray(thing.v.T))
        self.step = self.sim.step

    def positions(self) -> np.ndarray:
        return self.sim.positions


class Newton(Contender):
    """Newton's SolverSemiImplicit, step by step as its examples run it on a CPU, on the one core that Warp uses."""

    label, package = "Newton", "newton"

    def __init__(self, thing: Thing, scene: Scene) -> None:
        import newton

        start_warp()
        builder = newton.ModelBuilder(gravity=tuple(map(float, thing.gravity)))
        builder.add_particles(list(thing.x), list(thing.v), thing.mass.tolist())
        # What add_spring appends, spring by spring.
        builder.spring_indices = np.stack([thing.first, thing.second], axis=1).ravel()
        rest, stiffness, damping = np.ascontiguousarray(thing.classes.T)
        builder.spring_rest_length = rest[thing.kind]
        builder.spring_stiffness, builder.spring_damping = stiffness[thing.kind], damping[thing.kind]
        builder.spring_control = np.zeros(len(thing.kind), np.float32)
        self.model = builder.finalize(device="cpu")
        # Its particles would collide.
        self.model.particle_grid = None
        self.solver = newton.solvers.SolverSemiImplicit(self.model)
        self.states = self.model.state(), self.model.state()
        self.dt = float(thing.dt)

    def step(self, count: int) -> None:
        for _ in range(count):
            now, then = self.states
            now.clear_forces()
            self.solver.step(now, then, None, None, self.dt)
            self.states = then, now

    def positions(self) -> np.ndarray:
        return self.states[0].particle_q.numpy()


class NewtonGraph(Newton):
    """The same without Python between two steps, as a captured graph."""

    label = "Newton, as a graph"
    stride = 2
    # Beyond, Python costs nothing beside the steps, but a second model much memory.
    most_springs = 1e6

    def __init__(self, thing: Thing, scene: Scene) -> None:
        import warp as wp

        super().__init__(thing, scene)
        # Kernels are compiled before they are captured.
        super().step(self.stride)
        for state in self.states:
            state.particle_q.assign(self.model.particle_q)
            state.particle_qd.assign(self.model.particle_qd)
        with wp.ScopedCapture(device="cpu") as capture:
            super().step(self.stride)
        self.launch, self.graph = wp.capture_launch, capture.graph

    def step(self, count: int) -> None:
        for _ in range(count // self.stride):
            self.launch(self.graph)


class Taichi(Contender):
    """A kernel that adds the forces of each spring to both ends, one that integrates; all cores."""

    label, package = "Taichi, atomic scatter", "taichi"

    def __init__(self, thing: Thing, scene: Scene) -> None:
        # It introduces itself on stdout.
        with redirect_stdout(sys.stderr):
            import scattering
            import taichi

            taichi.init(arch=taichi.cpu, log_level=taichi.ERROR)
        self.x, self.v, self.f = np.array(thing.x), np.array(thing.v), np.zeros_like(thing.x)
        self.springs = [np.array(rows) for rows in (thing.first, thing.second, thing.kind, thing.classes)]
        self.constants = np.array(thing.mass), np.array(thing.gravity)[None], float(thing.dt)
        self.add_forces, self.integrate = scattering.add_forces, scattering.integrate

    def step(self, count: int) -> None:
        for _ in range(count):
            self.add_forces(*self.springs, self.x, self.v, self.f)
            self.integrate(*self.constants, self.x, self.v, self.f)

    def positions(self) -> np.ndarray:
        return self.x


class Numba(Contender):
    """A loop over particles, on all cores, that gathers the forces of their springs: each spring is computed twice."""

    label, package = "Numba, prange gather", "numba"

    def __init__(self, thing: Thing, scene: Scene) -> None:
        import gathering

        self.start, self.others, self.kinds = gathering.rows(thing.first, thing.second, thing.kind, len(thing.x))
        self.x, self.v = np.array(thing.x), np.array(thing.v)
        self.spare = np.empty_like(self.x), np.empty_like(self.v)
        self.constants = np.array(thing.mass), np.array(thing.classes), np.array(thing.gravity), np.float32(thing.dt)
        self.kernel = gathering.step

    def step(self, count: int) -> None:
        for _ in range(count):
            self.kernel(self.start, self.others, self.kinds, *self.constants, self.x, self.v, *self.spare)
            self.x, self.v, self.spare = *self.spare, (self.x, self.v)

    def positions(self) -> np.ndarray:
        return self.x


class NumPy(Contender):
    """The law in whole arrays, float64: what the others are held against."""

    label, package = "NumPy, float64", "numpy"
    # Springs at a time, which bounds the memory of what is between them.
    BLOCK = 1 << 20

    def __init__(self, thing: Thing, scene: Scene) -> None:
        self.thing = thing
        self.x, self.v = (np.ascontiguousarray(rows.T, dtype=float) for rows in (thing.x, thing.v))
        self.mass, self.gravity, self.dt = thing.mass.astype(float), thing.gravity.astype(float), float(thing.dt)
        self.classes = thing.classes.astype(float)

    def step(self, count: int) -> None:
        for _ in range(count):
            self.v += self.dt * (self._forces() / self.mass + self.gravity[:, None])
            self.x += self.dt * self.v

    def _forces(self) -> np.ndarray:
        f = np.zeros_like(self.x)
        for begin in range(0, len(self.thing.first), self.BLOCK):
            block = slice(begin, begin + self.BLOCK)
            i, j = self.thing.first[block], self.thing.second[block]
            rest, stiffness, damping = self.classes.T[:, self.thing.kind[block]]
            offset = self.x[:, j] - self.x[:, i]
            length = np.sqrt((offset**2).sum(axis=0))
            direction = offset / length
            approach = ((self.v[:, j] - self.v[:, i]) * direction).sum(axis=0)
            force = (stiffness * (length - rest) + damping * approach) * direction
            for row, along in zip(f, force, strict=True):
                low, high = min(i.min(), j.min()), max(i.max(), j.max()) + 1
                size = high - low
                row[low:high] += np.bincount(i - low, along, size) - np.bincount(j - low, along, size)
        return f

    def positions(self) -> np.ndarray:
        return self.x.T


CONTENDERS: tuple[type[Contender], ...] = (Warpjelly, Newton, NewtonGraph, Taichi, Numba, NumPy)
