"""A batch: what there is to do, an engine that does it, and the record of what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import INTERRUPTED, EnvironmentFailedError, InputError, WarpjellyError
from ..files import locked
from ..signals import interruptions
from .jobs import Engine, Watcher
from .pool import LocalEngine
from .specs import COMPARISON_NAME, PAGE_NAME, RECORD_NAME, TABLE_NAME, Entry, Spec, default_output, read_specs
from .sweep import Sweep


@dataclass(frozen=True)
class Batch:
    """What came of a batch."""

    folder: Path
    record: dict[str, Any]
    """The contents of batch.json; ``runs`` has an entry for each: parameters, status, figures, stage ..."""


class BatchInterruptedError(WarpjellyError):
    """A batch was interrupted; what was finished is kept."""

    exit_code = INTERRUPTED

    def __init__(self, batch: Batch) -> None:
        counts = batch.record["counts"]
        super().__init__(
            f"interrupted: {counts['finished']} of {counts['runs']} runs are finished, in {batch.folder}; go on with "
            "--resume"
        )
        self.batch = batch


class RunsFailedError(WarpjellyError):
    """Some runs of a batch failed; the others are finished."""

    exit_code = 3

    def __init__(self, batch: Batch) -> None:
        counts = batch.record["counts"]
        super().__init__(f"{counts['failed']} of {counts['runs']} runs failed; {batch.folder / TABLE_NAME} says why")
        self.batch = batch


def run_batch(
    specs: Spec | Sequence[Spec],
    *,
    output: str | Path | None = None,
    overrides: Mapping[str, Any] | None = None,
    frames: int | None = None,
    workers: int | None = None,
    device: str = "auto",
    engine: Engine | None = None,
    resume: bool = False,
    force: bool = False,
    pictures: bool = False,
    watcher: Watcher | None = None,
) -> Batch:
    """Simulate many scenes, each into a run directory of its own. A run that fails does not disturb the others.

    Args:
        specs: scene files, folders of them, sweep files, ``Sweep``s, or mappings from names to scenes; or one of them.
        output: the folder of the batch; ``outputs/<name of the only sweep file or folder>``, or ``outputs/batch``,
            unless given.
        overrides: values by dotted key of the scene, for all runs.
        frames: number of samples of all runs, as for ``load_scene``.
        workers: how many processes; as many as GPUs or cores unless given.
        device: "auto", "cpu", "cuda:0" ...
        engine: what does the runs, instead of ``workers`` processes on this machine.
        resume: go on with a batch: do only what is missing or failed. Runs are finished if scene and version are the
            same, whatever they were called then.
        force: replace runs that are there already; with ``resume``, only those that are of other scenes or versions.
        pictures: draw the finished runs for index.html, which loads VTK into this process.
        watcher: hears how it goes.

    Raises:
        InputError: a SPEC is not sound; the folder holds a batch and neither ``resume`` nor ``force`` is set, or one of
            other scenes; or another process is writing to it.
        RunsFailedError: after all others finished; the error has the batch.
        BatchInterruptedError: Ctrl-C; the error has the batch up to there.
        EnvironmentFailedError: the folder cannot be written.
    """
    chosen = _listed(specs)
    entries = read_specs(chosen, overrides=overrides, frames=frames)
    folder = Path(output) if output is not None else default_output(chosen, entries)
    if folder.exists() and not folder.is_dir():
        raise EnvironmentFailedError(f"{folder}: cannot write the batch: it is a file; choose a folder with -o")
    engine = engine or LocalEngine(workers=workers, device=device, most=len(entries))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked(folder):
            if not force:
                _refuse_to_replace(folder, entries, resume=resume)
            batch = _run(folder, entries, engine, watcher or Watcher(), resume=resume, force=force, pictures=pictures)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot write the batch: {error.strerror or error}") from error
    if batch.record["counts"]["failed"]:
        raise RunsFailedError(batch)
    return batch


def _refuse_to_replace(folder: Path, entries: Sequence[Entry], *, resume: bool) -> None:
    """Raise InputError where the folder holds a batch that is not gone on with, or files of others with its names."""
    for name in [RECORD_NAME, *(entry.name for entry in entries)] if not resume else ():
        if (folder / name).exists():
            raise InputError(
                f"{folder}: holds a batch already ({name}); go on with --resume, replace runs with --force, or choose "
                "another folder with -o"
            )
    for name in (TABLE_NAME, PAGE_NAME, COMPARISON_NAME):
        if (folder / name).exists() and not (folder / RECORD_NAME).exists():
            raise InputError(
                f"{folder / name}: not of a batch, and a batch would replace it; choose another folder with -o, or "
                "replace it with --force"
            )


def _run(
    folder: Path,
    entries: Sequence[Entry],
    engine: Engine,
    watcher: Watcher,
    *,
    resume: bool,
    force: bool,
    pictures: bool,
) -> Batch:
    with interruptions() as interrupted, engine:
        # To import this takes the better part of a second, in which the engine gets ready.
        from .ledger import Ledger, sort_out
        from .sheet import present

        agenda = sort_out(folder, entries, resume=resume, force=force)
        ledger = Ledger(folder, entries, engine, agenda)
        watcher.begin(agenda.jobs, len(agenda.results))
        try:
            for result in engine.run(agenda.jobs, watcher=watcher, stopping=interrupted):
                ledger.add(result)
        finally:
            batch = Batch(folder, ledger.write())
        stopped = interrupted()
    # Whoever stops a batch, or has all but its pictures, does not wait for them.
    try:
        present(folder, batch.record, pictures=pictures and not stopped, progress=watcher.draw)
    except KeyboardInterrupt:
        present(folder, batch.record, pictures=False)
        stopped = True
    if stopped:
        raise BatchInterruptedError(batch)
    return batch


def estimate_batch(
    specs: Spec | Sequence[Spec],
    *,
    overrides: Mapping[str, Any] | None = None,
    frames: int | None = None,
    workers: int | None = None,
    device: str = "auto",
    engine: Engine | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Say which runs a batch has and what they take; for arguments see ``run_batch``, for the result ``estimate``.

    Raises:
        InputError: a SPEC is not sound.
    """
    from .estimate import estimate

    entries = read_specs(_listed(specs), overrides=overrides, frames=frames)
    if engine is None:
        count = LocalEngine(workers=workers, device=device, most=len(entries)).workers
    else:
        with engine:
            count = engine.workers
    return estimate(entries, workers=count, device=device, progress=progress)


def _listed(specs: Spec | Sequence[Spec]) -> list[Spec]:
    return [specs] if isinstance(specs, str | Path | Sweep | Mapping) else list(specs)
