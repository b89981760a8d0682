"""The folder of a batch: what is finished in it, what is to be done, and the record of both."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ..checkpoint import scene_hash, version_of
from ..errors import InputError, verdict
from ..files import wait_for_lock
from ..rundir import RECORD_NAME, write_record
from ..scene import Scene
from ..stage.stagefiles import find_stage
from .estimate import Estimator
from .jobs import Engine, Job, Result
from .perform import resumable
from .report import count, describe, figures_of, record_of, write_batch
from .specs import Entry

# The record is written anew at most so often, s.
RECORD_INTERVAL = 5.0
# How long a run directory may still be locked by the processes of a batch that was killed, s.
LOCK_PATIENCE = 10.0


class Ledger:
    """The record of a batch, on the disk from the start, and then from time to time.

    Args:
        folder: of the batch.
        entries: its runs.
        engine: what does them.
        agenda: what it does of them.
    """

    def __init__(self, folder: Path, entries: Sequence[Entry], engine: Engine, agenda: Agenda) -> None:
        self._folder = folder
        self._began, self._date = time.monotonic(), datetime.now(UTC)
        self._entries = {entry.name: entry for entry in entries}
        self._engine = engine
        self._hashes = agenda.hashes
        self._runs = {name: self._describe(name, agenda.results.get(name)) for name in self._entries}
        self.write()

    def add(self, result: Result) -> None:
        """Take in what came of a run."""
        self._runs[result.name] = self._describe(result.name, result)
        if time.monotonic() - self._written > RECORD_INTERVAL:
            self.write()

    def write(self) -> dict[str, Any]:
        """Write the record, and return it."""
        runs = list(self._runs.values())
        record = {
            "warpjelly": version_of("warpjelly"),
            "folder": str(self._folder),
            "engine": self._engine.name,
            "workers": self._engine.workers,
            "began": self._date.isoformat(timespec="seconds"),
            "wall_seconds": time.monotonic() - self._began,
            "counts": count(runs),
            "runs": runs,
        }
        write_batch(self._folder, record)
        self._written = time.monotonic()
        return record

    def _describe(self, name: str, result: Result | None) -> dict[str, Any]:
        return describe(self._folder, self._entries[name], result, self._hashes.get(name))


@dataclass(frozen=True)
class Agenda:
    """What a batch has to do."""

    jobs: list[Job]
    results: dict[str, Result]
    """Of runs that need not be done: they are finished, or cannot be begun."""
    hashes: dict[str, str]
    """Of the scenes that can be read, by the names of the runs; see ``scene_hash``."""


def sort_out(folder: Path, entries: Sequence[Entry], *, resume: bool, force: bool) -> Agenda:
    """Find out what is to be done, and what is known already.

    Args:
        folder: of the batch.
        entries: its runs.
        resume: whether finished runs count, and unfinished ones go on.
        force: whether finished runs of other scenes or versions are replaced then; without, there must be none.

    Raises:
        InputError: there are some, or another process is writing to a run directory.
    """
    results: dict[str, Result] = {}
    hashes, jobs, estimator = {}, [], Estimator()
    for entry in entries:
        if entry.scene is None:
            results[entry.name] = Result(entry.name, InputError.exit_code, entry.problem)
            continue
        with _told(entry, results):
            hashes[entry.name] = scene_hash(entry.scene)
    _wait_for_orphans([folder / name for name in hashes])
    sound = [(entry, entry.scene) for entry in entries if entry.scene is not None and entry.name in hashes]
    if resume:
        finished, places = _find_finished(folder, hashes)
        results |= {name: Result(name, 0, None, attempts=0) for name in finished}
        sound = [(entry, scene) for entry, scene in sound if entry.name not in finished]
        outdated = [
            there
            for entry, scene in sound
            if _is_outdated(there := folder / places.get(entry.name, entry.name), scene, hashes[entry.name])
        ]
        if outdated and not force:
            more = f" (and {len(outdated) - 1} more do)" if len(outdated) > 1 else ""
            raise InputError(
                f"{outdated[0]}: holds a finished run of another scene or version, or one that cannot be read{more}; "
                "replace with --resume --force, or choose another folder with -o"
            )
        _move(folder, places)
    for entry, scene in sound:
        with _told(entry, results):
            needed = estimator.memory_bytes(scene)
            jobs.append(Job(entry.name, scene, folder / entry.name, needed, resume=resume))
    return Agenda(jobs, results, hashes)


@contextmanager
def _told(entry: Entry, results: dict[str, Result]) -> Iterator[None]:
    """Make whatever is wrong with a run its result."""
    try:
        yield
    except Exception as error:
        why, code = verdict(error)
        results[entry.name] = Result(entry.name, code, f"{entry.source}: {why}")


def _wait_for_orphans(folders: Sequence[Path]) -> None:
    """Wait a moment for workers of a batch that was killed to notice it and end."""
    until = time.monotonic() + LOCK_PATIENCE
    for folder in folders:
        wait_for_lock(folder, until - time.monotonic())


def _find_finished(folder: Path, hashes: Mapping[str, str]) -> tuple[set[str], dict[str, str]]:
    """Find the runs that are finished, whatever they were called when they were simulated.

    Args:
        folder: of the batch.
        hashes: of the scenes, by the names of the runs.

    Returns:
        The names of those that are finished; and for each folder that is to be renamed, and for each that then changes
        places with one, where its contents are now.
    """
    there = {path.parent.name: found for path in folder.glob(f"*/{RECORD_NAME}") if (found := _finished(path.parent))}
    spare = {found: name for name, found in there.items() if hashes.get(name) != found}
    places: dict[str, str] = {}
    for name, wanted in hashes.items():
        if there.get(name) == wanted or wanted not in spare:
            continue
        old, other = spare.pop(wanted), there.get(name)
        there[name] = there.pop(old)
        if other is not None:
            there[old] = other
            if hashes.get(old) != other:
                spare[other] = old
        places[name], places[old] = places.get(old, old), places.get(name, name)
    return {name for name, wanted in hashes.items() if there.get(name) == wanted}, places


def _finished(folder: Path) -> str | None:
    """Return the hash of the scene of a finished run; None where there is none with all that a batch needs of it."""
    record = record_of(folder)
    if record is None or record["interrupted"] or record["diverged"]:
        return None
    try:
        find_stage(folder)
        figures_of(folder, record)
    except (InputError, OSError, ValueError, KeyError):
        return None
    return record.get("scene_hash", "")


def _move(folder: Path, places: Mapping[str, str]) -> None:
    """Give folders other names, by where their contents are now."""
    parked = {}
    for name, old in places.items():
        if name != old and (folder / old).exists():
            # Whatever ends this in the middle, finished runs are found under any name.
            free = next(path for n in itertools.count(1) if not (path := folder / f"{old}.{n}").exists())
            parked[name] = (folder / old).rename(free)
    for name, path in parked.items():
        own = path.rename(folder / name)
        if record := record_of(own):
            stage = str(own / Path(record["stage"]).name)
            write_record(own, {**record, "stage": stage, "run_dir": str(own)})


def _is_outdated(folder: Path, scene: Scene, wanted: str) -> bool:
    """Say whether a folder has a finished run that is not, and does not go on to be, that of a scene with this hash."""
    if not (folder / RECORD_NAME).is_file():
        return False
    record = record_of(folder)
    if record is None:
        return True
    unfinished = record["interrupted"] or record["diverged"] or record.get("scene_hash") == wanted
    return not (unfinished or resumable(folder, scene))
