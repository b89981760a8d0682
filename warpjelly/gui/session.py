"""A live simulation: stepped in a thread of its own, changed while it moves, watched by any number of viewers."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from ..device import choose_device
from ..errors import DivergedError, InputError, WarpjellyError, verdict
from ..grip import Grip
from ..model import Body
from ..scene import Scene
from ..scenefile import load_scene
from ..scenewriter import require_scene_file, write_scene
from ..simulator import REST_BLOCK, Simulator
from ..stability import evaluations
from ..starts import warn_of_deep_starts
from ..stepping import capture_lock
from .carrying import carry_hold, carry_over, center_of_mass, move_body
from .recording import Place, Recording, shown_by
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
from .snapshot import Energies, Limits, Message, Pull, Recorded, Snapshot
from .uploads import Uploads

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
# Larger set-ups get no limits: so many springs, times evaluations of their forces, take some ten seconds.
MOST_EVALUATIONS = 1e9
# Kinds of commands of which only the last is carried out where several follow each other.
EDIT, MOVE_HAND = "edit", "move hand"
# Points of the energy plot, and messages, that are kept.
HISTORY, MESSAGES = 2000, 100


class _UnwantedError(Exception):
    """The set-up whose limits were looked for is not there any more."""


@dataclass
class _Command:
    """Something to do in the thread of the session."""

    run: Callable[[], None]
    kind: str = ""
    """Of two that follow each other and are of the same kind, unless it is empty, the first is left out."""
    edits: bool = False
    """Whether it changes the set-up."""


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
        # Guarded by _editing for whoever edits, and by _changed.
        self._wanted = self._setup
        self._sim = Simulator(self._setup.plan, device=self._device, interactive=True)
        self._stale = False
        self._recording: Recording | None = None
        self._uploads = Uploads()
        self._revision = 1
        self._playing = self._diverged = False
        self._dirty = True
        self._anchor = 0.0, 0.0
        self._substep_seconds = 0.0
        self._rates: deque[tuple[float, float, int]] = deque()
        self._next_snapshot = self._next_energies = 0.0
        self._limits: Limits | None = None
        self._seeker: threading.Thread | None = None
        self._told: set[str] = set()
        self._energies = self._measure()
        self._warn_of_start()
        self._publish()
        self._seek_limits()
        self._thread = threading.Thread(target=self._run, name="warpjelly session", daemon=True)
        self._thread.start()
        # A thread that were stepping while Python ends would crash.
        atexit.register(self.close)

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
            self._go_on(substeps)
            self._look_after()

        self._submit(_Command(step))

    def reset(self) -> None:
        """Go back to time zero of the set-up; it goes on playing if it does, unless it has diverged."""

        def reset() -> None:
            if self._recording is not None:
                raise InputError(f"recording to {self._recording.place.folder}; stop the recording first")
            self._rebuild(carry=False)

        self._submit(_Command(reset))

    def close(self) -> None:
        """End the simulation and its thread; a recording is finished, files that were sent are removed."""
        atexit.unregister(self.close)
        with suppress(InputError):
            self.stop_recording()
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        if self._seeker is not None:
            self._seeker.join()
        self._uploads.close()

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
            with self._heard():
                setup = SetUp.from_scene(scene)
            self._require_recordable(setup.scene)

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
                place = _vector("teleport", to)
                by = (place - self._ask(lambda: center_of_mass(self._sim, self._body(body)))).tolist()
            displacement = _vector("teleport", () if by is None else by)
            setup = self._wanted.edited(lambda tables: move_start(tables, body, displacement))

            def move() -> None:
                self._setup = setup
                self._revision += 1
                move_body(self._sim, body, displacement, at_rest=at_rest)
                # At time zero the set-up says exactly where bodies are.
                self._stale = self._sim.substep_count == 0
                self._dirty = True

            self._submit(_Command(move), setup)

    def grab(self, body: str, point: Sequence[float]) -> None:
        """Take hold of the particles of a body that are nearest to a point, and of nothing else.

        Args:
            body: its name.
            point: [3], m.

        Raises:
            InputError: there is no such body, or all of it is pinned.
        """
        place = _vector("grab", point)
        entry_named(self._wanted.tables, "bodies", body)

        def grab() -> None:
            self._grip.grab(body, place)
            self._dirty = True

        self._ask(grab)

    def drag(self, point: Sequence[float]) -> None:
        """Move the hand to a point [3], m: what it holds is pulled there by a damped spring, if it holds anything."""
        hand = _vector("drag", point)

        def move() -> None:
            if self._grip.hold is not None:
                self._grip.move(hand)
                self._dirty = True

        self._submit(_Command(move, MOVE_HAND))

    def release(self) -> None:
        """Let go of what is held."""

        def release() -> None:
            self._grip.release()
            self._dirty = True

        self._submit(_Command(release))

    # What lasts.

    def upload(self, name: str, content: bytes) -> Path:
        """Keep a model file that a viewer sends, and return where it is, for ``add_body``; ``save`` copies it.

        Args:
            name: of the file, which tells its format.
            content: of the file.

        Raises:
            InputError: it is not the kind of file that models are in, empty, or too large.
        """
        return self._uploads.add(name, content)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the set-up as a scene file, from which ``warpjelly run`` makes what a reset and playing make here.

        Model files are named relative to it; those that were sent are copied into a folder beside it.

        Args:
            path: file to write, .toml.
            force: replace a file that is there already.

        Raises:
            InputError: the name has another ending, or the file exists.
            EnvironmentFailedError: it cannot be written.
        """
        path = Path(path)
        with self._editing:
            require_scene_file(path, force=force)
            write_scene(self._wanted.with_files(lambda file: self._kept(file, path)).scene, path, force=force)
        self.tell(f"saved as {path}")

    def _kept(self, file: Path, scene: Path) -> Path:
        """Return where a file is after a scene was saved."""
        return self._uploads.copy(file, scene.parent / f"{scene.stem}_models") if self._uploads.has(file) else file

    def record(self, directory: str | Path, *, force: bool = False) -> None:
        """Record from now on, in the frames of the scene, into a run directory; the present is sample 0.

        Until the end of the recording only what the stage shows as motion may change: edits of bodies' shapes, of
        colliders' places, of the solver and of what is shown are refused, and so is a reset.

        Args:
            directory: the run directory.
            force: replace a run that is there already.

        Raises:
            InputError: it is a file, holds a run, or another process is writing to it; or a recording is going.
            EnvironmentFailedError: it cannot be written to.
        """
        with self._editing:
            if self._recording is not None:
                raise InputError(f"recording to {self._recording.place.folder} already; stop that first")
            place = Place(Path(directory), force=force)

            def begin() -> None:
                self._require_sound()
                self._start()
                self._recording = Recording(place, self._sim, self._setup.scene)
                self._dirty = True

            try:
                self._ask(begin)
            except BaseException:
                place.close()
                raise

    def stop_recording(self) -> dict[str, Any]:
        """End the recording, and wait until its stage is whole; the simulation goes on meanwhile.

        Returns:
            The contents of run.json.

        Raises:
            InputError: no recording is going.
            EnvironmentFailedError: not all could be written; what could is in the run directory.
        """
        with self._editing:
            recording = self._recording
            if recording is None:
                raise InputError("no recording is going")
            self._ask(self._end_recording)
        record = recording.wait()
        self.tell(f"recorded {recording.frames} frames into {recording.place.folder}")
        return record

    # Commands.

    def _edit(self, edit: Callable[[Tables], Result]) -> Result:
        """Check an edit of the tables, have it carried out, and return what the edit does."""
        with self._editing:
            results: list[Result] = []
            with self._heard():
                setup = self._wanted.edited(lambda tables: results.append(edit(tables)))
            self._require_recordable(setup.scene)
            self._submit(_Command(lambda: self._apply(setup, carry=True), EDIT), setup)
            return results[0]

    def _require_recordable(self, scene: Scene) -> None:
        """Refuse an edit that a recording could not show."""
        if self._recording is not None and shown_by(scene) != self._recording.shown:
            folder = self._recording.place.folder
            raise InputError(f"recording to {folder}, whose stage cannot show this change; stop the recording first")

    @contextmanager
    def _heard(self) -> Iterator[None]:
        """Tell viewers of what is warned of in this thread."""
        thread, heard = threading.get_ident(), logging.Handler(logging.WARNING)
        texts: list[str] = []
        heard.emit = lambda record: texts.append(record.getMessage()) if record.thread == thread else None  # type: ignore[method-assign]
        log.addHandler(heard)
        try:
            yield
        finally:
            log.removeHandler(heard)
        for text in texts:
            if text not in self._told:
                self.tell(text, "warning")
        self._told = set(texts)

    def _submit(self, command: _Command, wanted: SetUp | None = None) -> None:
        with self._changed:
            if self._closing:
                raise InputError("the session is closed")
            if command.kind and self._commands and self._commands[-1].kind == command.kind:
                self._commands.pop()
            self._commands.append(command)
            if wanted is not None:
                command.edits, self._wanted = True, wanted
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
            if not any(command.edits for command in self._commands):
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
        self._go_on(count)
        ended = time.perf_counter()
        self._substep_seconds = (ended - began) / count
        if self._due(ended) - self._sim.time > MOST_BEHIND * self._speed:
            self._set_anchor()

    def _go_on(self, substeps: int) -> None:
        """Take some substeps, and the samples of a recording among them."""
        while substeps > 0:
            count = substeps if self._recording is None else min(substeps, self._recording.missing)
            self._sim.step(count)
            substeps -= count
            if self._recording is not None:
                try:
                    self._recording.advanced(self._sim, count)
                except WarpjellyError:
                    self._abandon_recording()
                    raise

    def _end_recording(self) -> None:
        """Take no more samples."""
        recording, self._recording, self._dirty = self._recording, None, True
        if recording is not None:
            recording.finish(self._sim, diverged=self._diverged)

    def _abandon_recording(self) -> None:
        """Give up what could not be written; what was written stays."""
        recording, self._recording = self._recording, None
        if recording is not None:
            with suppress(WarpjellyError):
                recording.wait()

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
            if (recording := self._recording) is not None:
                self._end_recording()
                recording.wait()
                self.tell(f"recorded {recording.frames} frames into {recording.place.folder}")

    def _apply(self, setup: SetUp, *, carry: bool) -> None:
        """Simulate another set-up."""
        before, self._setup = self._setup, setup
        try:
            self._rebuild(carry=carry)
        except BaseException:
            self._setup = before
            raise

    def _rebuild(self, *, carry: bool) -> None:
        sim = Simulator(self._setup.plan, device=self._device, interactive=True)
        if self._diverged:
            self._playing = False
        elif carry and self._sim.substep_count > 0:
            carry_over(self._sim, sim)
        if carry and not self._diverged:
            carry_hold(self._sim, sim)
        if sim.substep_count == 0:
            with self._changed:
                self._history.clear()
        self._sim, self._stale, self._diverged, self._dirty = sim, False, False, True
        self._revision += 1
        self._substep_seconds = 0.0
        self._set_anchor()
        self._warn_of_start()
        self._seek_limits()

    def _warn_of_start(self) -> None:
        """Tell of bodies that start in colliders or in each other."""
        if self._sim.substep_count == 0:
            with self._heard():
                warn_of_deep_starts(self._sim)

    def _seek_limits(self) -> None:
        """Find the largest stable step of the set-up, in a thread of its own."""
        sim = self._sim
        self._limits = None

        def require_wanted() -> None:
            if self._sim is not sim or self._closing:
                raise _UnwantedError

        def seek() -> None:
            if evaluations(sim.model) * sim.model.spring_count > MOST_EVALUATIONS:
                return
            name = sim.scene.solver.integrator
            try:
                springs, contact = (sim.step_limits(contacts=on, wanted=require_wanted)[name] for on in (False, True))
            except _UnwantedError:
                return
            with capture_lock:
                limits = Limits(springs, contact, sim.broken_limit())
            with self._changed:
                if self._sim is sim:
                    self._limits = limits
                    assert self._snapshot is not None
                    self._show(replace(self._snapshot, limits=limits))

        self._seeker = threading.Thread(target=seek, name="warpjelly limits", daemon=True)
        self._seeker.start()

    @property
    def _grip(self) -> Grip:
        assert self._sim.grip is not None
        return self._sim.grip

    def _body(self, name: str) -> Body:
        return next(body for body in self._sim.model.bodies if body.name == name)

    # What is shown.

    def _measure(self) -> Energies:
        figures = self._sim.diagnostics()
        names = ("kinetic", "elastic", "potential", "contact")
        return Energies(self._sim.time, **{name: figures[name] for name in names})

    def _pull(self) -> Pull | None:
        grip = self._grip
        if (hold := grip.hold) is None:
            return None
        return Pull(hold.body, grip.point(), hold.hand, grip.force())

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
                limits=None,
                pull=self._pull(),
                recording=None,
                messages=(),
            )
        ended = time.perf_counter()
        self._next_snapshot = max(began + 1.0 / SNAPSHOT_RATE, ended + (ended - began) / SNAPSHOT_SHARE)
        self._dirty = False
        recording = None
        if self._recording is not None:
            recording = Recorded(self._recording.place.folder, self._recording.frames)
        with self._changed:
            self._show(replace(snapshot, limits=self._limits, recording=recording, messages=tuple(self._messages)))

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


def _vector(what: str, given: Sequence[float]) -> np.ndarray:
    """Return three finite numbers as an array.

    Raises:
        InputError: they are not.
    """
    try:
        vector = np.array(given, float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{what}: {given!r} must be three numbers")
    return vector
