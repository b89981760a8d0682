"""A scene in motion: frames, what they show, and what is measured of them."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import diagnostics, shapes

from .device import choose_device
from .errors import DivergedError, SceneError
from .grip import Grip
from .machine import available_cores
from .model import Model, State, build
from .plan import Plan, plan_scene
from .scene import MAX_SUBSTEPS, Scene
from .shapes import ShapeFrame, starts_of
from .stability import (
    BOUNCE_SHARE,
    MAGNETIC_GAIN,
    SAFETY,
    add_contacts,
    bounce_limits,
    bound_spring_pairs,
    contact_pairs,
    magnetic_limits,
    step_limits,
)
from .stepping import MAX_CAPTURED_SUBSTEPS, Stepper, capture_lock

steps = logging.getLogger("warpjelly.steps")

# Substeps beyond whole frames are replayed so many at a time: few enough to capture at once, when they are asked for.
REST_BLOCK = 8


class Simulator:
    """A scene in motion.

    Args:
        scene: what to simulate, or its plan.
        device: "auto", "cpu", "cuda:0" ...
        threads: how many may be used on the CPU, None for one per core; results do not depend on it.
        interactive: whether there is a ``grip``, a hand to pull with.

    Raises:
        InputError: the scene cannot be built (SceneError), or there is no such device.
        ValueError: threads is less than 1.
    """

    def __init__(
        self, scene: Scene | Plan, *, device: str = "auto", threads: int | None = None, interactive: bool = False
    ) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"cannot simulate with {threads} threads")
        plan = scene if isinstance(scene, Plan) else plan_scene(scene)
        self.scene = plan.scene
        self.device = choose_device(device)
        self.model: Model
        self.state: State
        with capture_lock:
            self.model, self.state = build(plan, device=self.device)
            # Where the limits may be asked for later.
            self._rest = wp.clone(self.state.x) if interactive else None
        self.substep_count = 0
        """Substeps since the start."""
        self._limits: tuple[dict[str, float | None], dict[str, float | None]] | None = None
        self.substeps = self.scene.substeps_for(self._largest_step())
        """Substeps per frame."""
        self.dt = self.scene.dt_for(self.substeps)
        """The time step used, s."""
        self._point_start, self._normal_start = starts_of(self.model.shapes)
        point_count = int(self._point_start[-1])
        with wp.ScopedDevice(self.device):
            self._lost = wp.zeros(1, dtype=wp.int32)
            self._elastic = wp.zeros(1, dtype=wp.float64)
            self._sums = wp.zeros((len(self.model.chunk_body), diagnostics.COLUMNS), dtype=wp.float64)
            self._points = wp.zeros(point_count, dtype=wp.vec3f)
            self._normals = wp.zeros(int(self._normal_start[-1]), dtype=wp.vec3f)
            self._velocities = wp.zeros(point_count, dtype=wp.vec3f)
            self._magnitudes = wp.zeros(point_count, dtype=wp.float32)
        self.grip = Grip(self.model, self.state, dt=self.dt) if interactive else None
        """A hand to pull particles with."""
        self._launches: dict[wp.Kernel, wp.Launch] = {}
        with capture_lock:
            self._stepper = Stepper(
                self.model,
                self.state,
                integrator=self.scene.solver.integrator,
                dt=self.dt,
                culling=self.scene.solver.culling,
                threads=available_cores() if threads is None else threads,
                grip=self.grip,
            )

    @property
    def threads(self) -> int:
        """How many threads of the CPU simulate; small scenes are not worth more than one."""
        return self._stepper.threads

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.substep_count * self.dt

    @property
    def positions(self) -> np.ndarray:
        """Positions, [particle_count, 3], m; a copy."""
        return self._copy(self.state.x)

    @property
    def velocities(self) -> np.ndarray:
        """Velocities, [particle_count, 3], m/s; a copy."""
        return self._copy(self.state.v)

    @property
    def forces(self) -> np.ndarray:
        """Total forces of the last evaluation (at the start, those at time zero), [particle_count, 3], N; a copy."""
        return self._copy(self.state.f)

    @property
    def masses(self) -> np.ndarray:
        """Masses, [particle_count], kg; a copy."""
        return self.model.particle_mass.numpy().copy()

    @functools.cached_property
    def _contact_pairs(self) -> np.ndarray:
        """What contact adds to the pairs of springs; see ``contact_pairs``."""
        return contact_pairs(self.model)

    @property
    def _duration(self) -> float:
        """Duration of the scene, s."""
        return self.scene.frame_count / self.scene.fps

    def prepare(self) -> None:
        """Compile and capture what frames need, so that the first one takes no longer than the others."""
        for substeps in set(self._frame_blocks()):
            self._stepper.prepare(substeps)

    def step(self, count: int = 1) -> None:
        """Advance by a number of substeps.

        Raises:
            ValueError: the number is negative.
        """
        if count < 0:
            raise ValueError(f"cannot step back by {-count} substeps")
        frames, rest = divmod(count, self.substeps)
        blocks, single = divmod(rest, REST_BLOCK)
        try:
            for substeps in self._frame_blocks() * frames + [REST_BLOCK] * blocks + [1] * single:
                self._stepper.step(substeps)
        except KeyboardInterrupt:
            # Some blocks were done.
            self.substep_count = int(self.state.step.numpy()[0])
            raise
        self.substep_count += count

    def advance_frame(self) -> None:
        """Advance by one frame.

        Raises:
            DivergedError: a position or velocity is not finite any more, or absurd.
        """
        self.step(self.substeps)
        self.require_sane()

    def require_sane(self) -> None:
        """Make sure that every particle is at a sane place and speed.

        Raises:
            DivergedError: a position or velocity is not finite any more, or absurd.
        """
        if (particle := self.first_lost()) is not None:
            body = next(body for body in self.model.bodies if particle < body.particles.stop)
            # The limits belong to rest, which is lost: they are named if they were asked for before.
            broken = self.broken_limit() if self._limits is not None else None
            raise DivergedError(
                f"the simulation diverged before t = {self.time:.4g} s: particle {particle - body.particles.start} of "
                f"'{body.name}' is beyond {diagnostics.MAX_DISTANCE:.0e} m or {diagnostics.MAX_SPEED:.0e} m/s; "
                f"{broken or f'lower solver.dt (now {self.dt:.3g} s)'}, or stiffness and damping of its material or "
                "of a collider"
            )

    def update_forces(self) -> None:
        """Evaluate the forces of the current state anew, after it was changed by hand; nothing else changes."""
        self._stepper.add_forces(loss_weight=0.0)

    def first_lost(self) -> int | None:
        """Return the smallest index of a particle that is not at a sane place and speed, None if all are."""
        self._lost.fill_(self.model.particle_count)
        self._launch(diagnostics.find_lost, self.model.particle_count, [self.state.x, self.state.v], [self._lost])
        first = int(self._lost.numpy()[0])
        return first if first < self.model.particle_count else None

    def step_limits(self, *, contacts: bool, wanted: Callable[[], None] = lambda: None) -> dict[str, float | None]:
        """Return the largest stable step of each integrator, s; None where it has none.

        Belongs to small motions about time zero, so it is to be asked for the first time before the first step, unless
        the simulator is interactive: then at any time, also in another thread than that which steps.

        Args:
            contacts: as if each particle touched the worst collider, which is a safe bound; else the springs alone.
            wanted: called now and then; raises something where the limits are not wanted any more.
        """
        if self._limits is None:
            if self.substep_count > 0 and self._rest is None:
                raise RuntimeError("ask for the limits before the first step: they belong to the state at time zero")
            steps.info("finding the largest stable step")
            pairs = bound_spring_pairs(self.model, self.state.x if self._rest is None else self._rest, wanted)
            self._limits = step_limits(pairs), step_limits(add_contacts(pairs, self._contact_pairs))
        return self._limits[contacts]

    def broken_limit(self) -> str | None:
        """Say which limit the time step exceeds, with both numbers; None if it is within all of them."""
        name = self.scene.solver.integrator
        for touching, where in ((False, "of the springs"), (True, "in contact with a collider")):
            limit = self.step_limits(contacts=touching)[name]
            if limit is None:
                return f"{name} has no stable step {where}, whatever solver.dt"
            if self.dt > limit:
                return (
                    f"the time step of {self.dt:.4g} s is above the largest stable one {where}, {limit:.4g} s: lower "
                    "solver.dt"
                )
        bounce = bounce_limits(self._contact_pairs)[name]
        if bounce is not None and self.dt > bounce:
            return (
                f"with the time step of {self.dt:.4g} s bounces may gain energy: it is above {BOUNCE_SHARE:g} of what "
                f"contact alone allows a particle; lower solver.dt to {bounce:.4g} s"
            )
        magnetic = magnetic_limits(self.model, self._duration)[name]
        if self.dt > magnetic:
            return (
                f"with the time step of {self.dt:.4g} s magnetic fields add more than {MAGNETIC_GAIN:.0%} of energy to "
                f"what they turn; lower solver.dt to {magnetic:.4g} s"
            )
        return None

    def _largest_step(self) -> float:
        """Return ``solver.dt``, or what "auto" stands for, s."""
        solver = self.scene.solver
        if solver.dt != "auto":
            return solver.dt
        limits = self.step_limits(contacts=True)
        limit = limits[solver.integrator]
        if limit is None:
            others = ", ".join(name for name, other in limits.items() if other is not None)
            raise SceneError(
                f'solver.dt = "auto": {solver.integrator} has no stable step for this scene, where something is '
                f"undamped; integrators that have one: {others}"
            )
        bounce = bounce_limits(self._contact_pairs)[solver.integrator]
        magnetic = magnetic_limits(self.model, self._duration)[solver.integrator]
        step = min(SAFETY[solver.integrator] * limit, math.inf if bounce is None else bounce, magnetic)
        if self.scene.substeps_for(step) > MAX_SUBSTEPS:
            raise SceneError(
                f'solver.dt = "auto": a stable step of {step:.3g} s makes more than {MAX_SUBSTEPS} substeps a frame; '
                "lower stiffness or damping, or raise the particle mass"
            )
        return step

    def diagnostics(self) -> dict[str, Any]:
        """Measure the current state.

        Returns:
            ``kinetic``, ``elastic``, ``potential`` (of gravity, zero at the origin) and ``contact`` (in penetrated
            colliders and overlapping particles) energy, and what ``spring_losses`` (dampers), ``contact_losses``
            (damping of contacts) and ``friction_losses`` took since the start, J; together, less the ``field_work`` of
            fields, they keep their sum, to the order of the scheme;
            ``momentum`` [3], kg m/s; ``angular_momentum`` [3] about the origin, kg m^2/s;
            ``max_speed``, m/s; ``penetrations`` [body_count], the greatest depth of a particle of each body in a
            collider, m; ``overlaps`` [body_count], that of its particles with others as balls, m; ``contacts``, the
            number of particles in each collider summed, and of those that overlap others.
        """
        model, state = self.model, self.state
        self._elastic.zero_()
        self._launch(
            diagnostics.add_elastic_energy,
            len(model.spans),
            [model.spans, model.spring_classes, state.x],
            [self._elastic],
        )
        sums = self._measure_chunks()
        total, greatest = sums.sum(axis=0), sums.max(axis=0)
        contact_losses = state.contact_losses.numpy().sum(axis=1) + state.pair_losses.numpy().sum(axis=1)
        pair_energy, pair_contacts, overlaps = 0.0, 0, np.zeros(len(model.bodies))
        if self._stepper.soft is not None:
            pair_energy, pair_contacts, overlaps = self._stepper.soft.measure()
        penetrations = np.zeros(len(model.bodies))
        np.maximum.at(penetrations, model.chunk_body.numpy(), sums[:, diagnostics.DEPTH])
        return {
            "kinetic": float(total[diagnostics.KINETIC]),
            "elastic": float(self._elastic.numpy()[0]),
            "potential": float(total[diagnostics.POTENTIAL]),
            "contact": float(total[diagnostics.CONTACT]) + pair_energy,
            "spring_losses": float(self.state.spring_losses.numpy().sum()),
            "field_work": float(self.state.field_work.numpy().sum()),
            "contact_losses": float(contact_losses[0]),
            "friction_losses": float(contact_losses[1]),
            "momentum": total[diagnostics.MOMENTUM :][:3].copy(),
            "angular_momentum": total[diagnostics.ANGULAR_MOMENTUM :][:3].copy(),
            "max_speed": float(greatest[diagnostics.SPEED]),
            "penetrations": penetrations,
            "overlaps": overlaps,
            "contacts": int(total[diagnostics.CONTACTS]) + pair_contacts,
        }

    def shapes(self) -> list[ShapeFrame]:
        """Return what a frame shows, a sample of each of ``model.shapes``, as copies."""
        table, state = self.model.shape_table, self.state
        self._launch(
            shapes.gather_points,
            len(self._points),
            [table, state.x, state.v, state.f],
            [self._points, self._velocities, self._magnitudes],
        )
        self._normals.zero_()
        self._launch(shapes.add_face_normals, len(table.face_start) - 1, [table, self._points], [self._normals])
        self._launch(shapes.normalize, len(self._normals), [], [self._normals])
        points, normals, velocities, magnitudes = (
            array.numpy() for array in (self._points, self._normals, self._velocities, self._magnitudes)
        )
        frames = []
        for number in range(len(self.model.shapes)):
            own, own_normals = (slice(*start[number : number + 2]) for start in (self._point_start, self._normal_start))
            # On the CPU numpy() is a live view of the array, which the next frame overwrites.
            frames.append(
                ShapeFrame(
                    points=points[own].copy(),
                    normals=normals[own_normals].copy(),
                    velocities=velocities[own].copy(),
                    forces=magnitudes[own].copy(),
                )
            )
        return frames

    @staticmethod
    def _copy(rows: wp.array) -> np.ndarray:
        return np.ascontiguousarray(rows.numpy().T)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel, each time with the same arguments: the launch is recorded, which is quicker to repeat."""
        if dim == 0:
            return
        if kernel not in self._launches:
            arguments = {"inputs": inputs, "outputs": outputs, "device": self.device}
            self._launches[kernel] = wp.launch(kernel, dim=dim, record_cmd=True, **arguments)
        self._launches[kernel].launch()

    def _measure_chunks(self) -> np.ndarray:
        """Return the sums over each chunk, float64 [chunk_count, diagnostics.COLUMNS]; a view that is overwritten."""
        model, state = self.model, self.state
        self._launch(
            diagnostics.measure_chunks,
            len(model.chunk_body),
            [
                model.particle_mass,
                model.gravity,
                model.chunk_start,
                model.chunk_body,
                model.colliders,
                state.x_start,
                state.x,
                state.v,
                state.step,
                state.stamps,
                state.normals,
            ],
            [self._sums],
        )
        return self._sums.numpy()

    def _frame_blocks(self) -> list[int]:
        """Cut the substeps of a frame into blocks that graphs are captured for, of at most two sizes."""
        blocks, rest = divmod(self.substeps, MAX_CAPTURED_SUBSTEPS)
        return [MAX_CAPTURED_SUBSTEPS] * blocks + [rest] * (rest > 0)
