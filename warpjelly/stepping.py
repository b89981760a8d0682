"""Steps of time: which kernels an evaluation of the forces and a step consist of, and the graphs that replay them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import warp as wp

from warpjelly.kernels import bounds, contacts, fields, grips, integrators, springs, turns

from .grip import Grip
from .model import CHUNK_SIZE, Model, State, zero_rows
from .parts import find_parts
from .softcontact import SoftContact
from .team import Team

log = logging.getLogger("warpjelly")

# A captured graph holds at most this many substeps; longer frames replay it. To capture a substep takes as long as some
# dozens of them in a small scene; to replay 16 costs 1 to 3 % more for each than to replay 64.
MAX_CAPTURED_SUBSTEPS = 16
# Launches of an evaluation of the forces and of the stage that follows it, but for those of the springs.
MAX_LAUNCHES = 10
# Most threads where bodies may touch: each needs a graph of its own, and the search for contact runs in one of them.
MAX_SOFT_THREADS = 4
# Warp cannot capture in two threads at once, nor allocate in one while it captures in another.
capture_lock = threading.Lock()


def launch_spring_forces(
    model: Model,
    classes: wp.array,
    x: wp.array,
    v: wp.array,
    f: wp.array,
    *,
    phases: list[tuple[turns.Turn, wp.array]],
    loss_weight: float,
    losses: wp.array,
) -> None:
    """Add the forces of all springs, by the kernel that suits the device.

    Args:
        model: has the spans.
        classes: (rest length, stiffness, damping) of each class, real vec3 [class_count].
        x: positions, real [3, particle_count], m.
        v: velocities, m/s.
        f: forces to add to, N.
        phases: on the CPU, the turn and the tasks of one phase after the other; see ``Parts``.
        loss_weight: what the power of the dampers counts for in the losses, s.
        losses: energy taken by the dampers of each span, to add to, float64 [span_count], J.
    """
    inputs, outputs = [model.spans, classes, x, v, model.real(loss_weight)], [f, losses]
    if not model.spans.device.is_cpu:
        dim = (len(model.spans), springs.MAX_SPAN)
        wp.launch(springs.add_spring_forces, dim, inputs=inputs, outputs=outputs, device=model.spans.device)
        return
    for turn, tasks in phases:
        wp.launch(springs.add_span_forces, len(tasks), inputs=[turn, tasks, *inputs], outputs=outputs, device="cpu")


class Stepper:
    """Advances a state by steps of equal length.

    Args:
        model: what stays the same.
        state: what changes.
        integrator: name of the scheme.
        dt: the time step, s.
        culling: look for contact only where bounding boxes meet; results are the same.
        threads: how many there may be on the CPU; results are the same.
        grip: a hand that may pull; without one nothing is launched for it.
    """

    def __init__(
        self,
        model: Model,
        state: State,
        *,
        integrator: str,
        dt: float,
        culling: bool,
        threads: int,
        grip: Grip | None = None,
    ) -> None:
        self._model = model
        self._grip = grip
        self._state = state
        self._dt = dt
        self._culling = culling
        self._stages = integrators.STAGES.get(integrator, [])
        self._device = state.x.device
        self._parts = find_parts(model)
        # Where the threads of a launch run one after another, one lane does best.
        self._lanes = 1 if self._device.is_cpu else CHUNK_SIZE
        chunk_count = len(model.chunk_body)
        with wp.ScopedDevice(self._device):
            # What only Runge-Kutta schemes need between their stages.
            scratch: list[Any] = (
                zero_rows(3, model.particle_count, model.real, self._device) if self._stages else [None] * 3
            )
            self._v_start, self._x_sum, self._v_sum = scratch
            self._lower = wp.zeros((3, chunk_count), dtype=model.real)
            self._upper = wp.zeros((3, chunk_count), dtype=model.real)
            self._chosen = wp.zeros(threads, dtype=wp.int32)
        self.soft = SoftContact(model, state, culling=culling) if model.skin is not None else None
        """Contact between bodies, where there is any."""
        self._graphs: dict[int, list[Any]] = {}
        # On a GPU a graph would build grids from memory of the host that all of Warp's grids of one precision share:
        # another simulator in this process would put its own there.
        self.capturable = self.soft is None or self._device.is_cpu
        """Whether steps are replayed as captured graphs."""
        most = self._parts.most_tasks if self._device.is_cpu else 1
        if self.soft is not None:
            most = min(most, MAX_SOFT_THREADS)
        launches = MAX_CAPTURED_SUBSTEPS * max(1, len(self._stages)) * (MAX_LAUNCHES + len(self._parts.phases))
        self._team = Team(min(threads, most), launches) if most > 1 else None
        # The thread whose graph is being captured.
        self._thread: int | None = None
        # Kernels compile at their first launch, which must not be inside a capture; a step of no time changes nothing.
        self.add_forces(loss_weight=0.0)
        if self._stages:
            self._integrate_stage(0.0, 0.0, 0.0, first=True, last=True)
        else:
            self._integrate(0.0)
        self._count()
        state.step.zero_()

    @property
    def threads(self) -> int:
        """How many threads of the CPU advance the state."""
        return 1 if self._team is None else self._team.threads

    def step(self, count: int) -> None:
        """Advance by at most ``MAX_CAPTURED_SUBSTEPS`` steps, as a graph where the device can capture them."""
        graphs = self.prepare(count)
        if graphs is None:
            for _ in range(count):
                self.launch_step()
        elif self._team is not None:
            self._team.replay(graphs)
        else:
            wp.capture_launch(graphs[0])

    def prepare(self, count: int) -> list[Any] | None:
        """Return the captured graphs of some steps, one for all threads or one for each; None if there are none."""
        if self.capturable and count not in self._graphs:
            with capture_lock:
                try:
                    # Threads share a graph, unless there is in it what only one of them may do.
                    own = self._team.threads if self._team is not None and self.soft is not None else 1
                    self._graphs[count] = [self._capture(count, thread) for thread in range(own)]
                except RuntimeError as error:
                    self.capturable = False
                    log.warning(
                        "%s cannot capture graphs (%s); launching kernel by kernel, which is slower",
                        self._device,
                        error,
                    )
        return self._graphs[count] if self.capturable else None

    def launch_step(self) -> None:
        """Launch the kernels of one step."""
        # By an Euler step kinetic energy gains the work of the forces at the mean of old and new velocities.
        middle = self._dt / 2.0
        if not self._stages:
            self.add_forces(loss_weight=self._dt, ahead=middle)
            self._integrate(self._dt)
        else:
            ahead = middle if len(self._stages) == 1 else 0.0
            for number, (share, weight, reach) in enumerate(self._stages):
                first, last = number == 0, number == len(self._stages) - 1
                self.add_forces(loss_weight=weight * self._dt, offset=share * self._dt, ahead=ahead, first=first)
                self._integrate_stage(self._dt, weight, reach, first=first, last=last)
        self._count()

    def add_forces(self, *, loss_weight: float, offset: float = 0.0, ahead: float = 0.0, first: bool = True) -> None:
        """Overwrite the forces with those at the current positions and velocities.

        Args:
            loss_weight: what the power of dampers and friction counts for in the losses, and that of fields in their
                work, s.
            offset: time since the start of the step, s.
            ahead: losses of contact are taken at the velocities that the forces make in this time, s.
            first: whether this is the first evaluation of a step, which remembers contacts.
        """
        model, state = self._model, self._state
        weight = model.real(loss_weight)
        self._launch_particles(fields.set_gravity_forces, [model.particle_mass, model.gravity], [state.f])
        if len(model.fields.kind) > 0:
            self._launch_particles(
                fields.add_field_forces,
                [
                    *(model.particle_charge, model.fields, state.step, state.x, state.v),
                    *(wp.float64(self._dt), wp.float64(offset), wp.float64(loss_weight)),
                ],
                [state.f, state.field_work],
            )
        launch_spring_forces(
            *(model, model.spring_classes, state.x, state.v, state.f),
            phases=[(self._turn(len(tasks)), tasks) for tasks in self._parts.phases],
            loss_weight=loss_weight,
            losses=state.spring_losses,
        )
        if (grip := self._grip) is not None:
            held = [grip.count, grip.particles, grip.stiffness, grip.damping, grip.places]
            self._launch(grips.add_grip_forces, self._lanes, [self._lanes, *held, state.x, state.v], [state.f])
        has_colliders = len(model.colliders.kind) > 0
        boxes = [self._lower, self._upper]
        if (self.soft is not None and self.soft.culls) or (has_colliders and self._culling):
            self._launch(
                bounds.update_chunk_bounds,
                self._parts.count,
                [self._parts.chunk_start, model.chunk_start, state.x],
                boxes,
            )
        if self.soft is not None:
            self._alone(self.soft.search, lower=self._lower, upper=self._upper)
            self.soft.add_forces(self._launch, dt=self._dt, loss_weight=loss_weight, ahead=ahead)
        if has_colliders:
            lanes = min(self._lanes, contacts.PARALLEL_LANES)
            self._launch(
                contacts.add_contact_forces,
                (self._parts.count, lanes),
                [
                    *(self._parts.chunk_start, lanes, model.particle_mass, model.particle_inv_mass),
                    *(model.chunk_start, model.chunk_body, model.colliders, *boxes),
                    *(state.x_start, state.x, state.v, state.step),
                    *(model.real(self._dt), weight, model.real(ahead), first, self._culling),
                ],
                [state.stamps, state.normals, state.f, state.contact_losses],
            )

    def _alone(self, work: Callable[..., None], **options: Any) -> None:
        """Let one thread do some work, whichever comes first, while the others wait."""
        if self._thread is None:
            work(**options)
            return
        assert self._team is not None
        turn, chosen = self._team.turn(1), self._chosen[self._thread : self._thread + 1]
        wp.launch(turns.volunteer, 1, inputs=[turn], outputs=[chosen], device=self._device)
        wp.capture_if(chosen, work, **options)
        wp.launch(turns.rejoin, 1, inputs=[turn, chosen], device=self._device)

    def _integrate(self, dt: float) -> None:
        model, state = self._model, self._state
        self._launch_particles(
            integrators.semi_implicit_euler,
            [model.particle_inv_mass, state.f, model.real(dt)],
            [state.x_start, state.x, state.v],
        )

    def _integrate_stage(self, dt: float, weight: float, reach: float, *, first: bool, last: bool) -> None:
        model, state, real = self._model, self._state, self._model.real
        self._launch_particles(
            integrators.runge_kutta_stage,
            [model.particle_inv_mass, state.f, real(dt), real(weight), real(reach), first, last],
            [state.x_start, self._v_start, self._x_sum, self._v_sum, state.x, state.v],
        )

    def _count(self) -> None:
        self._launch(integrators.count_step, 1, [], [self._state.step])

    def _launch_particles(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel over all particles, part by part."""
        parts = [self._parts.particle_start, self._lanes]
        self._launch(kernel, (self._parts.count, self._lanes), [*parts, *inputs], outputs)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel whose tasks threads may share."""
        turn = self._turn(dim if isinstance(dim, int) else dim[0] * dim[1])
        wp.launch(kernel, dim, inputs=[turn, *inputs], outputs=outputs, device=self._device)

    def _turn(self, tasks: int) -> turns.Turn:
        """Return the turn of a launch: that of a team in its graphs, else that of a thread alone."""
        if self._thread is None:
            return turns.Turn()
        assert self._team is not None
        return self._team.turn(tasks)

    def _capture(self, count: int, thread: int) -> Any:
        if self._team is not None:
            self._team.begin()
            self._thread = thread
        try:
            with wp.ScopedCapture(device=self._device) as capture:
                for _ in range(count):
                    self.launch_step()
        finally:
            self._thread = None
        return capture.graph
