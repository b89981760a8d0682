"""A live simulation: stepped in a thread of its own, changed while it moves, watched by any number of viewers."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from ..device import choose_device
from ..errors import DivergedError, InputError, WarpjellyError, verdict
from ..model import Body
from ..scene import Scene
from ..scenefile import load_scene
from ..shapes import Shape, ShapeFrame
from ..simulator import REST_BLOCK, Simulator
from .carrying import carry_over, center_of_mass, move_body
from .setup import (
    DEFAULT_COLLIDERS,
    DEFAULT_TABLES,
    SetUp,
    Tables,
    add_entry,
    change_keys,
    change_material,
    delete_entry,
    entry_named,
    move_start,
)

log = logging.getLogger("warpjelly")

Result = TypeVar("Result")

# Viewers get at most so many snapshots a second.
SNAPSHOT_RATE = 30.0
# A substep that takes longer than this is taken alone, s, so that what is asked for need not wait for a block of them.
LONG_SUBSTEP = 2e-3
# What does not move the simulation on takes at most this share of the time: making snapshots; measuring energies.
SNAPSHOT_SHARE, ENERGY_SHARE = 0.25, 0.05
# Where simulated time is farther behind than this, the rest is given up rather than made up for, s.
MOST_BEHIND = 0.1
# Speeds are means over so long, s.
RATE_WINDOW = 1.0
# Points of the energy plot, and messages, that are kept.
HISTORY, MESSAGES = 2000, 100


@dataclass(frozen=True)
class Energies:
    """What there is of energy at a time, J."""

    time: float
    """Simulated time, s."""
    kinetic: float
    elastic: float
    potential: float
    """Of gravity, zero at the origin."""
    contact: float
    """Stored in penetrated colliders and overlapping particles."""

    @property
    def total(self) -> float:
        """All of it, J."""
        return self.kinetic + self.elastic + self.potential + self.contact


@dataclass(frozen=True)
class Message:
    """Something that people should know."""

    number: int
    """Ascending from 1."""
    level: str
    """info, warning or error."""
    text: str


@dataclass(frozen=True)
class Snapshot:
    """What a session shows at a moment; immutable, and so are its arrays."""

    number: int
    """Ascending from 1 with each snapshot."""
    revision: int
    """Ascending with each set-up: where it is the same, so are scene, shapes (topology) and bodies."""
    scene: Scene
    """The set-up that is simulated."""
    bodies: tuple[Body, ...]
    """Names of the bodies, and their particles."""
    shapes: tuple[Shape, ...]
    """What is shown, prim by prim; what stays the same."""
    frames: tuple[ShapeFrame, ...]
    """A sample of each shape."""
    centers: Mapping[str, np.ndarray]
    """Centre of mass of each body, float64 [3], m."""
    time: float
    """Simulated time, s."""
    dt: float
    """The time step used, s."""
    playing: bool
    diverged: bool
    """Whether the simulation left the world; then this is the last good moment, until a reset or an edit."""
    energies: Energies
    """As last measured, which may be some moments earlier."""
    substeps_per_second: float
    """While it plays; else 0."""
    real_time: float
    """Simulated over real time, as reached; 0 unless it plays."""
    particles: int
    springs: int
    messages: tuple[Message, ...]
    """The last ones, oldest first."""


@dataclass
class _Command:
    """Something to do in the thread of the session."""

    run: Callable[[], None]
    setup: SetUp | None = None
    """Of an edit: what it makes of the set-up. Of two that follow each other, the first is left out."""


class Session:
    """A live simulation.

    Commands may be given from any thread. They are checked at once, raise InputError before anything changes, and are
    carried out between substeps, in their order; ``settle`` waits for that. Edits go on from where the simulation is;
    those that follow each other faster than they can be carried out are carried out together. Of a simulation that has
    diverged an edit starts anew.

    Args:
        scene: what to start with; the cube of the thesis over a floor unless given. What it expects of itself is left
            out, since it belongs to the scene as it was.
        device: "auto", "cpu", "cuda:0" ...

    Raises:
        InputError: the scene cannot be built, or there is no such device.
    """

    def __init__(self, scene: Scene | None = None, *, device: str = "auto") -> None:
        self._device = choose_device(device)
        self._changed = threading.Condition()
        self._editing = threading.RLock()
        # Guarded by _changed: what is asked for, and what is shown.
        self._commands: deque[_Command] = deque()
        self._messages: deque[Message] = deque(maxlen=MESSAGES)
        self._message_count = 0
        self._history: deque[Energies] = deque(maxlen=HISTORY)
        self._failure: BaseException | None = None
        self._busy = True
        self._closing = False
        self._speed = 1.0
        self._snapshot: Snapshot | None = None
        # Of the thread alone.
        self._setup = SetUp.of(DEFAULT_TABLES, Path.cwd()) if scene is None else SetUp.from_scene(scene)
        self._wanted = self._setup
        self._sim = Simulator(self._setup.plan, device=self._device)
        self._stale = False
        self._revision = 1
        self._playing = self._diverged = False
        self._dirty = True
        self._anchor = 0.0, 0.0
        self._substep_seconds = 0.0
        self._rates: deque[tuple[float, float, int]] = deque()
        self._next_snapshot = self._next_energies = 0.0
        self._energies = self._measure()
        self._publish()
        self._thread = threading.Thread(target=self._run, name="warpjelly session", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    # What is there.

    @property
    def scene(self) -> Scene:
        """The set-up as asked for by all edits so far."""
        return self._wanted.scene

    @property
    def folder(self) -> Path:
        """What relative paths of models are relative to."""
        return self._wanted.folder

    @property
    def speed(self) -> float:
        """Simulated time over real time that is aimed at while playing."""
        return self._speed

    @speed.setter
    def speed(self, factor: float) -> None:
        if not 0.0 < factor <= 1000.0:
            raise InputError(f"speed = {factor:g}: must be above 0 and at most 1000 times real time")

        def change() -> None:
            self._speed = float(factor)
            self._set_anchor()

        self._submit(_Command(change))

    def latest(self) -> Snapshot:
        """Return the newest snapshot."""
        with self._changed:
            assert self._snapshot is not None
            return self._snapshot

    def wait_for_newer(self, number: int, timeout: float | None = None) -> Snapshot | None:
        """Wait for a snapshot that is newer than that of a number.

        Args:
            number: of a snapshot; 0 for any.
            timeout: for so long at most, s.

        Returns:
            The newest snapshot; None if there was no newer one in time, or the session was closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._is_newer(number) or self._closing, timeout)
            return self._snapshot if self._is_newer(number) else None

    def history(self) -> list[Energies]:
        """Return the energies since the start, oldest first; of a long time, the last of it."""
        with self._changed:
            return list(self._history)

    def settle(self, timeout: float | None = None) -> Snapshot:
        """Wait until all that was asked for is done.

        Returns:
            A snapshot of what came of it.

        Raises:
            WarpjellyError: something of it failed; the message says what. Each failure is raised once.
            TimeoutError: it was not done in time.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: not (self._commands or self._busy), timeout):
                raise TimeoutError(f"the session is still busy after {timeout:g} s")
            failure, self._failure = self._failure, None
            if failure is not None:
                raise failure
            assert self._snapshot is not None
            return self._snapshot

    def tell(self, text: str, level: str = "info") -> None:
        """Add a message for all viewers."""
        with self._changed:
            self._message_count += 1
            self._messages.append(Message(self._message_count, level, text))
            if self._snapshot is not None:
                self._show(replace(self._snapshot, messages=tuple(self._messages)))

    # Time.

    def play(self) -> None:
        """Let time go on."""

        def play() -> None:
            self._require_sound()
            self._start()
            self._playing = self._dirty = True
            self._set_anchor()

        self._submit(_Command(play))

    def pause(self) -> None:
        """Hold time."""

        def pause() -> None:
            self._playing, self._dirty = False, True

        self._submit(_Command(pause))

    def step(self, substeps: int = 1) -> None:
        """Hold time, and go on by some substeps."""
        if substeps < 1:
            raise InputError(f"substeps = {substeps}: must be at least 1")

        def step() -> None:
            self._require_sound()
            self._start()
            self._playing, self._dirty = False, True
            self._sim.step(substeps)
            self._look_after()

        self._submit(_Command(step))

    def reset(self) -> None:
        """Go back to time zero of the set-up; it goes on playing if it does, unless it has diverged."""

        def reset() -> None:
            self._rebuild(carry=False)

        self._submit(_Command(reset))

    def close(self) -> None:
        """End the simulation and its thread."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()

    # The set-up.

    def change(self, key: str, value: Any) -> None:
        """Change a value of the set-up.

        Args:
            key: dotted, as for ``--set``: ``solver.dt``, ``bodies.cube.particles_per_edge``, ``colliders.ball.radius``
                ...; entries of lists go by their names or numbers. A material may be that of several bodies: for one
                alone see ``change_material``.
            value: what a scene file would say; None for nothing.

        Raises:
            InputError: there is no such key, or the value is not allowed.
        """
        self.change_all({key: value})

    def change_all(self, changes: Mapping[str, Any]) -> None:
        """Change several values at once, by dotted key; see ``change``."""
        self._edit(lambda tables: change_keys(tables, changes))

    def change_material(self, body: str, changes: Mapping[str, Any]) -> None:
        """Change the material of one body; if others have the same, it gets one of its own first.

        Args:
            body: its name.
            changes: values by key: ``particle_mass`` [kg], ``structural.stiffness``, ``shear.damping`` ...
        """
        self._edit(lambda tables: change_material(tables, body, changes))

    def add_body(self, table: Mapping[str, Any]) -> str:
        """Add a body, and return its name.

        Args:
            table: as in a scene file: type, and what goes with it; without a material it gets a copy of that of the
                first body.
        """

        def add(tables: Tables) -> str:
            shared = tables["bodies"][0]["material"]
            name = add_entry(tables, "bodies", {"material": shared, **table})
            if "material" not in table:
                change_material(tables, name, {})
            return name

        return self._edit(add)

    def replace_body(self, name: str, table: Mapping[str, Any]) -> None:
        """Make another body of one: it keeps its name, place and material unless the table says otherwise."""
        kept = ("name", "material", "position", "rotation", "velocity", "angular_velocity", "charge")

        def exchange(tables: Tables) -> None:
            entry = entry_named(tables, "bodies", name)
            given = {key: entry[key] for key in kept if key in entry}
            entry.clear()
            entry.update(given | dict(table))

        self._edit(exchange)

    def delete_body(self, name: str) -> None:
        """Delete a body; there has to be another one."""
        self._edit(lambda tables: delete_entry(tables, "bodies", name))

    def add_collider(self, table: Mapping[str, Any] | str) -> str:
        """Add a collider, and return its name.

        Args:
            table: as in a scene file, or its type alone: half_space, plane, sphere or box. What it does not say has a
                default, and so has its name.
        """
        given = {"type": table} if isinstance(table, str) else dict(table)
        return self._edit(
            lambda tables: add_entry(tables, "colliders", DEFAULT_COLLIDERS.get(str(given.get("type")), {}) | given)
        )

    def delete_collider(self, name: str) -> None:
        """Delete a collider."""
        self._edit(lambda tables: delete_entry(tables, "colliders", name))

    def open(self, path: str | Path) -> None:
        """Take a scene file as the set-up, held at time zero.

        Raises:
            InputError: the file cannot be read, or is no scene that can be built.
        """
        self.take(load_scene(path))

    def take(self, scene: Scene) -> None:
        """Take a scene as the set-up, held at time zero."""
        with self._editing:
            setup = SetUp.from_scene(scene)

            def begin() -> None:
                self._playing = False
                self._apply(setup, carry=False)

            self._submit(_Command(begin), setup)

    # Moving bodies by hand.

    def teleport(
        self,
        body: str,
        *,
        by: Sequence[float] | None = None,
        to: Sequence[float] | None = None,
        at_rest: bool = True,
    ) -> None:
        """Put a body elsewhere as it is, deformed as it may be, and its start in the set-up by the same displacement.

        Args:
            body: its name.
            by: displacement, [3], m.
            to: instead, where its centre of mass is put, [3], m.
            at_rest: whether it stops; else it keeps its velocities.

        Raises:
            InputError: there is no such body, or it would be out of bounds.
        """
        if (by is None) == (to is None):
            raise InputError("teleport: give by or to")
        with self._editing:
            entry_named(self._wanted.tables, "bodies", body)
            if to is not None:
                by = np.array(to, float) - self._ask(lambda: center_of_mass(self._sim, self._body(body)))
            displacement = np.array(by, float)
            if displacement.shape != (3,) or not np.isfinite(displacement).all():
                raise InputError(f"teleport: {by}: must be three numbers")
            setup = self._wanted.edited(lambda tables: move_start(tables, body, displacement))

            def move() -> None:
                self._setup = setup
                self._revision += 1
                move_body(self._sim, body, displacement, at_rest=at_rest)
                # At time zero the set-up says exactly where bodies are.
                self._stale = self._sim.substep_count == 0
                self._dirty = True

            self._submit(_Command(move), setup)

    # Commands.

    def _edit(self, edit: Callable[[Tables], Result]) -> Result:
        """Check an edit of the tables, have it carried out, and return what the edit does."""
        with self._editing:
            results: list[Result] = []
            setup = self._wanted.edited(lambda tables: results.append(edit(tables)))
            self._submit(_Command(lambda: self._apply(setup, carry=True), setup), setup)
            return results[0]

    def _submit(self, command: _Command, wanted: SetUp | None = None) -> None:
        with self._changed:
            if self._closing:
                raise InputError("the session is closed")
            if command.setup is not None and self._commands and self._commands[-1].setup is not None:
                self._commands.pop()
            self._commands.append(command)
            if wanted is not None:
                self._wanted = wanted
            self._changed.notify_all()

    def _ask(self, question: Callable[[], Result]) -> Result:
        """Return the answer to a question that only the thread of the session may answer."""
        answers: list[Result] = []
        failures: list[BaseException] = []
        answered = threading.Event()

        def answer() -> None:
            try:
                answers.append(question())
            except WarpjellyError as error:
                failures.append(error)
            finally:
                answered.set()

        self._submit(_Command(answer))
        answered.wait()
        if failures:
            raise failures[0]
        return answers[0]

    # The thread.

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._commands:
                    self._busy = False
                    self._changed.notify_all()
                    if not self._playing:
                        self._changed.wait_for(lambda: self._commands or self._closing)
                    elif not self._closing and (idle := self._idle_seconds()) > 0.0:
                        self._changed.wait_for(lambda: self._commands or self._closing, idle)
                if self._closing:
                    self._commands.clear()
                    self._busy = False
                    self._changed.notify_all()
                    return
                command = self._commands.popleft() if self._commands else None
                self._busy = True
            try:
                if command is not None:
                    command.run()
                elif self._playing:
                    self._advance()
                if self._dirty or (self._playing and time.perf_counter() >= self._next_snapshot):
                    self._publish()
            except BaseException as error:
                self._fail(error)

    def _fail(self, error: BaseException) -> None:
        """Note that something went wrong, hold time, and take back edits that could not be carried out."""
        if not isinstance(error, WarpjellyError):
            log.error("session: %s", error, exc_info=error)
        text, _ = verdict(error)
        with self._changed:
            self._failure = self._failure or (error if isinstance(error, WarpjellyError) else WarpjellyError(text))
            if not any(command.setup is not None for command in self._commands):
                self._wanted = self._setup
        self._playing = False
        self.tell(text, "error")
        self._publish()

    def _advance(self) -> None:
        """Go on by some substeps, if they are due."""
        began = time.perf_counter()
        if self._sim.time > self._due(began):
            return
        count = 1 if self._substep_seconds > LONG_SUBSTEP else REST_BLOCK
        self._sim.step(count)
        ended = time.perf_counter()
        self._substep_seconds = (ended - began) / count
        if self._due(ended) - self._sim.time > MOST_BEHIND * self._speed:
            self._set_anchor()

    def _due(self, now: float) -> float:
        """Return the simulated time that belongs to a moment while playing, s."""
        wall, simulated = self._anchor
        return simulated + (now - wall) * self._speed

    def _set_anchor(self) -> None:
        """Count what is due from now on."""
        self._anchor = time.perf_counter(), self._sim.time

    def _idle_seconds(self) -> float:
        """Return for how long there is nothing to do while playing, s."""
        now = time.perf_counter()
        step = (self._sim.time - self._due(now)) / self._speed
        return min(step, self._next_snapshot - now)

    def _start(self) -> None:
        """Get ready to leave time zero."""
        if self._stale:
            self._rebuild(carry=False)

    def _require_sound(self) -> None:
        if self._diverged:
            raise InputError("the simulation has diverged: reset it, after lowering solver.dt or stiffness")

    def _look_after(self) -> None:
        """Hold time if the simulation diverged."""
        try:
            self._sim.require_sane()
        except DivergedError as error:
            self._playing, self._diverged, self._dirty = False, True, True
            self.tell(f"{error}; this is the last good moment", "error")

    def _apply(self, setup: SetUp, *, carry: bool) -> None:
        """Simulate another set-up."""
        before, self._setup = self._setup, setup
        try:
            self._rebuild(carry=carry)
        except BaseException:
            self._setup = before
            raise

    def _rebuild(self, *, carry: bool) -> None:
        sim = Simulator(self._setup.plan, device=self._device)
        if self._diverged:
            self._playing = False
        elif carry and self._sim.substep_count > 0:
            carry_over(self._sim, sim)
        if sim.substep_count == 0:
            with self._changed:
                self._history.clear()
        self._sim, self._stale, self._diverged, self._dirty = sim, False, False, True
        self._revision += 1
        self._substep_seconds = 0.0
        self._set_anchor()

    def _body(self, name: str) -> Body:
        return next(body for body in self._sim.model.bodies if body.name == name)

    # What is shown.

    def _measure(self) -> Energies:
        figures = self._sim.diagnostics()
        names = ("kinetic", "elastic", "potential", "contact")
        return Energies(self._sim.time, **{name: figures[name] for name in names})

    def _publish(self) -> None:
        """Make a snapshot of the present, or of the last good moment."""
        began = time.perf_counter()
        if self._playing:
            self._look_after()
        sim, shown = self._sim, self._snapshot
        rates = self._update_rates(began)
        if self._diverged and shown is not None:
            snapshot = replace(shown, playing=False, diverged=True, substeps_per_second=0.0, real_time=0.0)
        else:
            if self._dirty or began >= self._next_energies:
                self._energies = self._measure()
                now = time.perf_counter()
                self._next_energies = now + (now - began) / ENERGY_SHARE
                with self._changed:
                    if not self._history or self._history[-1].time < self._energies.time:
                        self._history.append(self._energies)
            snapshot = Snapshot(
                number=0,
                revision=self._revision,
                scene=self._setup.scene,
                bodies=tuple(sim.model.bodies),
                shapes=tuple(sim.model.shapes),
                frames=tuple(sim.shapes()),
                centers={body.name: center_of_mass(sim, body) for body in sim.model.bodies},
                time=sim.time,
                dt=sim.dt,
                playing=self._playing,
                diverged=False,
                energies=self._energies,
                substeps_per_second=rates[0],
                real_time=rates[1],
                particles=sim.model.particle_count,
                springs=sim.model.spring_count,
                messages=(),
            )
        ended = time.perf_counter()
        self._next_snapshot = max(began + 1.0 / SNAPSHOT_RATE, ended + (ended - began) / SNAPSHOT_SHARE)
        self._dirty = False
        with self._changed:
            self._show(replace(snapshot, messages=tuple(self._messages)))

    def _update_rates(self, now: float) -> tuple[float, float]:
        """Return substeps per second and simulated over real time, means over the last moments of playing."""
        if not self._playing:
            self._rates.clear()
            return 0.0, 0.0
        rates = self._rates
        if rates and rates[-1][2] > self._sim.substep_count:
            rates.clear()
        rates.append((now, self._sim.time, self._sim.substep_count))
        while rates[0][0] < now - RATE_WINDOW and len(rates) > 2:
            rates.popleft()
        wall = now - rates[0][0]
        if wall <= 0.0:
            return 0.0, 0.0
        return (rates[-1][2] - rates[0][2]) / wall, (rates[-1][1] - rates[0][1]) / wall

    def _show(self, snapshot: Snapshot) -> None:
        """Hand out a snapshot; to be called with the lock."""
        number = 1 if self._snapshot is None else self._snapshot.number + 1
        self._snapshot = replace(snapshot, number=number)
        self._changed.notify_all()

    def _is_newer(self, number: int) -> bool:
        return self._snapshot is not None and self._snapshot.number > number
