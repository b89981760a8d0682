"""A live simulation: stepped in a thread of its own, changed while it moves, watched by any number of viewers."""

from __future__ import annotations

import atexit
import logging
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np

from ..device import choose_device
from ..errors import InputError, WarpjellyError, verdict
from ..scene import Scene
from ..scenefile import load_scene
from ..scenewriter import require_scene_file, write_scene
from ..simulator import Simulator
from .hearing import heard
from .limits import LimitSearch
from .live import Live
from .recording import Place, shown_by
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
from .snapshot import Energies, Limits, Message, Snapshot
from .uploads import Uploads

log = logging.getLogger("warpjelly")

Result = TypeVar("Result")

# Simulated over real time, at most.
MOST_SPEED = 1000.0
# Kinds of commands of which only the last is carried out where several follow each other.
EDIT, MOVE_HAND = "edit", "move hand"
# Points of the energy plot, and messages, that are kept.
HISTORY, MESSAGES = 2000, 100
# A warning that is among so many last messages is not repeated: each edit gives it anew.
REPEATED = 10


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
        # Whoever edits has this, so that each edit starts from the one before.
        self._editing = threading.RLock()
        # Whoever reads or changes what follows has this, and is told of changes.
        self._changed = threading.Condition()
        self._commands: deque[_Command] = deque()
        self._messages: deque[Message] = deque(maxlen=MESSAGES)
        self._message_count = 0
        self._history: deque[Energies] = deque(maxlen=HISTORY)
        self._limits: Limits | None = None
        self._failure: WarpjellyError | None = None
        self._snapshot: Snapshot | None = None
        self._busy, self._closing = True, False
        self._uploads = Uploads()
        self._search: LimitSearch | None = None
        chosen = choose_device(device)
        with heard(self.tell):
            self._wanted = SetUp.of(DEFAULT_TABLES, Path.cwd()) if scene is None else SetUp.from_scene(scene)
        # Of the thread alone, from its start on.
        self._live = Live(self._wanted, device=chosen, tell=self.tell, rebuilt=self._seek_limits)
        self._publish()
        self._thread = threading.Thread(target=self._run, name="warpjelly session", daemon=True)
        self._thread.start()
        # A thread that still stepped while Python ends would crash.
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
        return self._live.pace.speed

    @speed.setter
    def speed(self, factor: float) -> None:
        if not 0.0 < factor <= MOST_SPEED:
            raise InputError(f"speed = {factor:g}: must be above 0, and at most {MOST_SPEED:g} times real time")
        self._ask(lambda: self._live.set_speed(float(factor)))

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
        """Add a message for all viewers; a warning that is among the last ones not again.

        Args:
            text: one line.
            level: info, warning or error.
        """
        with self._changed:
            if level == "warning" and text in [message.text for message in list(self._messages)[-REPEATED:]]:
                return
            self._message_count += 1
            self._messages.append(Message(self._message_count, level, text))
            if self._snapshot is not None:
                self._show(self._snapshot)

    # Time.

    def play(self) -> None:
        """Let time go on."""
        self._submit(_Command(self._live.play))

    def pause(self) -> None:
        """Hold time."""
        self._submit(_Command(self._live.pause))

    def step(self, substeps: int = 1) -> None:
        """Hold time, and go on by some substeps."""
        if substeps < 1:
            raise InputError(f"substeps = {substeps}: must be at least 1")
        self._submit(_Command(lambda: self._live.step(substeps)))

    def reset(self) -> None:
        """Go back to time zero of the set-up; it goes on playing if it does, unless it has diverged.

        Raises:
            InputError: a recording is going.
        """
        self._ask(self._live.reset)

    def close(self) -> None:
        """End the simulation and its thread; a recording is finished, files that were sent are removed."""
        atexit.unregister(self.close)
        try:
            # Nobody begins another recording in between.
            with self._editing:
                try:
                    if self._live.recording is not None:
                        self.stop_recording()
                finally:
                    with self._changed:
                        self._closing = True
                        self._changed.notify_all()
        finally:
            self._thread.join()
            if self._search is not None:
                self._search.stop()
                self._search.join()
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
            InputError: the file cannot be read, or is no scene that can be built; or a recording is going.
        """
        self.take(load_scene(path))

    def take(self, scene: Scene) -> None:
        """Take a scene as the set-up, held at time zero.

        Raises:
            InputError: the scene cannot be built; or a recording is going.
        """
        with self._editing:
            with heard(self.tell):
                setup = SetUp.from_scene(scene)
            self._ask(lambda: self._live.start(setup), setup)

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
        displacement = _vector("teleport", to if by is None else by)
        with self._editing:
            entry_named(self._wanted.tables, "bodies", body)
            if by is None:
                displacement = displacement - self._ask(lambda: self._live.center(body))
            before = self._wanted
            setup = before.edited(lambda tables: move_start(tables, body, displacement))
            move = _Command(lambda: self._live.move_body(before, setup, body, displacement, at_rest=at_rest))
            self._submit(move, setup)

    def grab(self, body: str, point: Sequence[float]) -> None:
        """Take hold of the particles of a body that are nearest to a point, and of nothing else.

        Args:
            body: its name.
            point: [3], m.

        Raises:
            InputError: there is no such body, or all of it is pinned.
        """
        place = _vector("grab", point)
        with self._editing:
            entry_named(self._wanted.tables, "bodies", body)
            self._ask(lambda: self._live.grab(body, place))

    def drag(self, point: Sequence[float]) -> None:
        """Move the hand to a point [3], m: what it holds is pulled there by a damped spring, if it holds anything."""
        hand = _vector("drag", point)
        self._submit(_Command(lambda: self._live.drag(hand), MOVE_HAND))

    def release(self) -> None:
        """Let go of what is held."""
        self._submit(_Command(self._live.release))

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
            if (going := self._live.recording) is not None:
                raise InputError(f"recording to {going.place.folder} already; stop that first")
            place = Place(Path(directory), force=force)
            try:
                self._ask(lambda: self._live.record(place))
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
            if (recording := self._live.recording) is None:
                raise InputError("no recording is going")
            self._ask(self._live.end_recording)
        record = recording.wait()
        self.tell(f"recorded {recording.frames} frames into {recording.place.folder}")
        return record

    # Commands.

    def _edit(self, edit: Callable[[Tables], Result]) -> Result:
        """Check an edit of the tables, have it carried out, and return what the edit does."""
        with self._editing:
            results: list[Result] = []
            with heard(self.tell):
                setup = self._wanted.edited(lambda tables: results.append(edit(tables)))
            self._require_recordable(setup.scene)
            self._submit(_Command(lambda: self._live.edit(setup), EDIT), setup)
            return results[0]

    def _require_recordable(self, scene: Scene) -> None:
        """Refuse an edit that a recording could not show."""
        if (recording := self._live.recording) is not None and shown_by(scene) != recording.shown:
            folder = recording.place.folder
            raise InputError(f"recording to {folder}, whose stage cannot show this change; stop the recording first")

    def _submit(self, command: _Command, wanted: SetUp | None = None) -> None:
        with self._changed:
            if self._closing:
                raise InputError("the session is closed")
            if command.kind and self._commands and self._commands[-1].kind == command.kind:
                self._commands.pop()
            if wanted is not None:
                command.edits, self._wanted = True, wanted
            self._commands.append(command)
            self._changed.notify_all()

    def _ask(self, question: Callable[[], Result], wanted: SetUp | None = None) -> Result:
        """Return the answer to a question that only the thread of the session may answer, when what came of it shows.

        Args:
            question: what is asked.
            wanted: the set-up that comes of it, if it is an edit.
        """
        answers: list[Result] = []
        failures: list[BaseException] = []
        answered = threading.Event()

        def answer() -> None:
            try:
                answers.append(question())
                self._publish()
            except BaseException as error:
                self._take_back()
                failures.append(error)
            finally:
                answered.set()

        self._submit(_Command(answer), wanted)
        answered.wait()
        if failures:
            raise failures[0]
        return answers[0]

    # The thread.

    def _run(self) -> None:
        while (command := self._next_command()) is not None:
            try:
                command.run()
                self._publish()
            except BaseException as error:
                self._fail(error)

    def _next_command(self) -> _Command | None:
        """Wait for something to do, which is to go on where nothing else is asked for; None to end."""
        with self._changed:
            if not self._commands:
                self._busy = False
                self._changed.notify_all()
                idle = max(self._live.idle_seconds(), 0.0) if self._live.playing else None
                self._changed.wait_for(lambda: self._commands or self._closing, idle)
            # Whoever waits for commands is not left waiting: they come before the end.
            if self._commands:
                self._busy = True
                return self._commands.popleft()
            return None if self._closing else _Command(self._live.advance)

    def _publish(self) -> None:
        """Hand out a snapshot if one is due."""
        if (snapshot := self._live.snapshot()) is None:
            return
        with self._changed:
            energies, history = snapshot.energies, self._history
            # Another time step rounds the time, and a reset takes it back.
            while history and history[-1].time >= energies.time:
                history.pop()
            history.append(energies)
            self._show(snapshot)

    def _fail(self, error: BaseException) -> None:
        """Note that something went wrong, hold time, and take back edits that could not be carried out."""
        if not isinstance(error, WarpjellyError):
            log.error("session: %s", error, exc_info=error)
        text, _ = verdict(error)
        with self._changed:
            self._failure = self._failure or (error if isinstance(error, WarpjellyError) else WarpjellyError(text))
        self._take_back()
        self._live.pause()
        self.tell(text, "error")
        try:
            self._publish()
        except BaseException as another:
            # The thread goes on, as others may wait for it.
            log.error("session: nothing newer can be shown: %s", another, exc_info=another)

    def _take_back(self) -> None:
        """Want what is simulated, after an edit that could not be carried out, unless other edits wait."""
        with self._changed:
            if not any(command.edits for command in self._commands):
                self._wanted = self._live.setup

    def _seek_limits(self, sim: Simulator) -> None:
        """Look for the largest stable step of a simulator, and no more for that of the one before."""
        before = self._search
        if before is not None:
            before.stop()
        with self._changed:
            self._limits = None
            self._search = LimitSearch(sim, self._take_limits, self.tell, after=before)
        self._search.start()

    def _take_limits(self, search: LimitSearch, limits: Limits) -> None:
        with self._changed:
            if search is self._search:
                self._limits = limits
                if self._snapshot is not None:
                    self._show(self._snapshot)

    def _show(self, snapshot: Snapshot) -> None:
        """Hand out a snapshot with what is known besides; to be called with the lock."""
        number = 1 if self._snapshot is None else self._snapshot.number + 1
        self._snapshot = replace(snapshot, number=number, limits=self._limits, messages=tuple(self._messages))
        self._changed.notify_all()

    def _is_newer(self, number: int) -> bool:
        return self._snapshot is not None and self._snapshot.number > number


def _vector(what: str, given: Sequence[float] | None) -> np.ndarray:
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
