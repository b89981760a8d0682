"""A simulation that is changed while it moves. All of this is for one thread; session.py hands it to many."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ..errors import DivergedError, InputError
from ..grip import Grip
from ..model import Body
from ..simulator import REST_BLOCK, Simulator
from ..starts import warn_of_deep_starts
from .carrying import carry_hold, carry_over, center_of_mass, move_body
from .hearing import heard
from .pace import Pace
from .recording import Place, Recording
from .setup import SetUp
from .snapshot import Energies, Pull, Recorded, Snapshot

# Viewers get at most so many snapshots a second.
SNAPSHOT_RATE = 30.0
# A substep that takes longer than this is taken alone, s, so that what is asked for need not wait for a block of them.
LONG_SUBSTEP = 2e-3
# What does not move the simulation on takes at most this share of the time: making snapshots; measuring energies.
SNAPSHOT_SHARE, ENERGY_SHARE = 0.25, 0.05


class Live:
    """A simulation of a set-up that changes.

    Args:
        setup: what to start with.
        device: of the simulation.
        tell: called with a message for people, and its level.
        rebuilt: called with each simulator that is built.
    """

    def __init__(
        self,
        setup: SetUp,
        *,
        device: str,
        tell: Callable[[str, str], None],
        rebuilt: Callable[[Simulator], None],
    ) -> None:
        self._device = device
        self._tell = tell
        self._rebuilt = rebuilt
        self.setup = setup
        """What is simulated."""
        self.playing = False
        self.pace = Pace()
        self.recording: Recording | None = None
        self._diverged = False
        # Whether the simulator is not exactly at the set-up's start, though at time zero.
        self._moved = False
        self._revision = 0
        self._substep_seconds = 0.0
        self._changed = True
        self._next_snapshot = self._next_energies = 0.0
        self._good: Snapshot | None = None
        self.sim = self._build()
        self._energies = self._measure()

    # Time.

    def play(self) -> None:
        """Let time go on."""
        self._leave_start()
        self.playing = self._changed = True
        self._begin()

    def pause(self) -> None:
        """Hold time."""
        self.playing, self._changed = False, True

    def set_speed(self, factor: float) -> None:
        """Aim at another speed, simulated over real time."""
        self.pace.speed = factor
        self._begin()

    def step(self, substeps: int) -> None:
        """Hold time, and go on by some substeps."""
        self._leave_start()
        self.playing, self._changed = False, True
        self._go_on(substeps)
        self._look_after()

    def reset(self) -> None:
        """Go back to time zero."""
        self._require_no_recording()
        self._rebuild(carry=False)

    def advance(self) -> None:
        """Go on by some substeps, if they are due."""
        began = time.perf_counter()
        if self.pace.seconds_to(began, self.sim.time) > 0.0:
            return
        # A body may have been moved after time was let go on.
        self._leave_start()
        count = 1 if self._substep_seconds > LONG_SUBSTEP else REST_BLOCK
        self._go_on(count)
        ended = time.perf_counter()
        self._substep_seconds = (ended - began) / count
        self.pace.keep_up(ended, self.sim.time)

    def idle_seconds(self) -> float:
        """Return for how long there is nothing to do while playing, s."""
        now = time.perf_counter()
        return min(self.pace.seconds_to(now, self.sim.time), self._next_snapshot - now)

    # The set-up.

    def edit(self, setup: SetUp) -> None:
        """Simulate another set-up, from the present on, unless that has diverged; then from time zero.

        Raises:
            InputError: it cannot be built; nothing changes then.
        """
        self._simulate(setup, carry=True)

    def start(self, setup: SetUp) -> None:
        """Simulate another set-up from time zero, and hold time there.

        Raises:
            InputError: it cannot be built, and nothing changes then; or a recording is going.
        """
        self._require_no_recording()
        self._simulate(setup, carry=False)
        self.playing = False

    def move_body(self, before: SetUp, setup: SetUp, body: str, displacement: np.ndarray, *, at_rest: bool) -> None:
        """Move a body as it is, and its start in the set-up.

        Args:
            before: the set-up that is simulated.
            setup: the same with another start of the body.
            body: its name.
            displacement: [3], m.
            at_rest: whether the body stops.

        Raises:
            InputError: another set-up is simulated, as that one could not be built, and neither can this one.
        """
        if self._diverged or self.setup is not before:
            self.edit(setup)
            return
        self.setup = setup
        self._revision += 1
        move_body(self.sim, body, displacement, at_rest=at_rest)
        self._moved = self.sim.substep_count == 0
        self._changed = True

    def center(self, body: str) -> np.ndarray:
        """Return where the centre of mass of a body is, float64 [3], m."""
        return center_of_mass(self.sim, self._body(body))

    # The hand.

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of the particles of a body that are nearest to a point [3], m."""
        self._grip.grab(body, point)
        self._changed = True

    def drag(self, point: np.ndarray) -> None:
        """Move the hand to a point [3], m, if it holds anything."""
        if self._grip.hold is not None:
            self._grip.move(point)
            # While it plays the next snapshot shows it soon enough, however often the hand moves.
            self._changed |= not self.playing

    def release(self) -> None:
        """Let go."""
        self._grip.release()
        self._changed = True

    # Recording.

    def record(self, place: Place) -> None:
        """Record from now on."""
        self._leave_start()
        self.recording = Recording(place, self.sim, self.setup.scene)
        self._changed = True

    def end_recording(self) -> None:
        """Take no more samples; ``Recording.wait`` says when all are written."""
        recording, self.recording, self._changed = self.recording, None, True
        if recording is not None:
            recording.finish(self.sim, diverged=self._diverged)

    # What is shown.

    def snapshot(self) -> Snapshot | None:
        """Return a snapshot of the present, or of the last good moment; None while none is due."""
        began = time.perf_counter()
        if not self._changed and not (self.playing and began >= self._next_snapshot):
            return None
        if self.playing:
            self._look_after()
        if self._diverged and self._good is not None:
            held = replace(self._good, playing=False, substeps_per_second=0.0, real_time=0.0)
            snapshot = replace(held, diverged=True, recording=None)
        else:
            snapshot = self._good = self._show(began)
        ended = time.perf_counter()
        self._next_snapshot = max(began + 1.0 / SNAPSHOT_RATE, ended + (ended - began) / SNAPSHOT_SHARE)
        self._changed = False
        return snapshot

    def _show(self, now: float) -> Snapshot:
        sim, rates = self.sim, (0.0, 0.0)
        if self.playing:
            rates = self.pace.rates(now, sim.time, sim.substep_count)
        else:
            self.pace.rest()
        if self._changed or now >= self._next_energies:
            began = time.perf_counter()
            self._energies = self._measure()
            ended = time.perf_counter()
            self._next_energies = ended + (ended - began) / ENERGY_SHARE
        recorded = None
        if self.recording is not None:
            recorded = Recorded(self.recording.place.folder, self.recording.frames)
        return Snapshot(
            revision=self._revision,
            scene=self.setup.scene,
            bodies=tuple(sim.model.bodies),
            shapes=tuple(sim.model.shapes),
            frames=tuple(sim.shapes()),
            centers={body.name: center_of_mass(sim, body) for body in sim.model.bodies},
            time=sim.time,
            dt=sim.dt,
            playing=self.playing,
            diverged=False,
            energies=self._energies,
            substeps_per_second=rates[0],
            real_time=rates[1],
            particles=sim.model.particle_count,
            springs=sim.model.spring_count,
            pull=self._pull(),
            recording=recorded,
        )

    def _measure(self) -> Energies:
        figures = self.sim.diagnostics()
        names = ("kinetic", "elastic", "potential", "contact")
        return Energies(self.sim.time, **{name: figures[name] for name in names})

    def _pull(self) -> Pull | None:
        hold = self._grip.hold
        return None if hold is None else Pull(hold.body, self._grip.point(), hold.hand, self._grip.force())

    # Inside.

    def _begin(self) -> None:
        """Count from now on what is due."""
        self.pace.begin(time.perf_counter(), self.sim.time)

    def _leave_start(self) -> None:
        """Get ready to go on.

        Raises:
            InputError: the simulation has diverged.
        """
        if self._diverged:
            raise InputError("the simulation has diverged: reset it, after lowering solver.dt or stiffness")
        if self._moved:
            # At time zero bodies are exactly where the set-up says.
            self._rebuild(carry=True)

    def _go_on(self, substeps: int) -> None:
        """Take some substeps, and the samples of a recording among them."""
        while substeps > 0:
            missing = substeps if self.recording is None else self.recording.missing(self.sim)
            count = min(substeps, missing)
            self.sim.step(count)
            substeps -= count
            if self.recording is not None and count == missing:
                self._look_after()
                if self._diverged:
                    return
                try:
                    self.recording.add_sample(self.sim)
                except Exception:
                    self._abandon_recording()
                    raise

    def _abandon_recording(self) -> None:
        """Give up what cannot be written; what was written stays."""
        recording, self.recording = self.recording, None
        if recording is not None:
            # What is known already.
            with suppress(Exception):
                recording.wait()

    def _look_after(self) -> None:
        """Hold time if the simulation has diverged."""
        if self._diverged:
            return
        try:
            self.sim.require_sane()
        except DivergedError as error:
            self.playing, self._diverged, self._changed = False, True, True
            self._tell(f"{error}; shown is the last good moment", "error")
            if (recording := self.recording) is not None:
                self.end_recording()
                recording.wait()
                self._tell(f"recorded {recording.frames} frames into {recording.place.folder}", "info")

    def _require_no_recording(self) -> None:
        if self.recording is not None:
            raise InputError(f"recording to {self.recording.place.folder}; stop the recording first")

    def _simulate(self, setup: SetUp, *, carry: bool) -> None:
        before, self.setup = self.setup, setup
        try:
            self._rebuild(carry=carry)
        except BaseException:
            self.setup = before
            raise

    def _rebuild(self, *, carry: bool) -> None:
        old, new = self.sim, self._build()
        if self._diverged:
            self.playing = False
        elif carry:
            if old.substep_count > 0:
                carry_over(old, new)
            carry_hold(old, new)
        self.sim, self._moved, self._diverged, self._changed = new, False, False, True
        self._substep_seconds = 0.0
        self._begin()

    def _build(self) -> Simulator:
        sim = Simulator(self.setup.plan, device=self._device, interactive=True)
        self._revision += 1
        with heard(self._tell):
            warn_of_deep_starts(sim)
        self._rebuilt(sim)
        return sim

    @property
    def _grip(self) -> Grip:
        assert self.sim.grip is not None
        return self.sim.grip

    def _body(self, name: str) -> Body:
        return next(body for body in self.sim.model.bodies if body.name == name)
