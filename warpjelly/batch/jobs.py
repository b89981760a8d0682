"""What an engine gets and gives: jobs and their results. Nothing here takes long to import."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

from ..errors import InputError

if TYPE_CHECKING:
    from ..scene import Scene

LOG_NAME = "run.log"
"""In a run directory, what the run said."""


@dataclass(frozen=True)
class Job:
    """One run to be done."""

    name: str
    scene: Scene
    folder: Path
    """The run directory."""
    memory_bytes: int
    """Estimate of its peak, that of a process without a run included."""
    resume: bool = False
    """Whether to go on with an unfinished run of the scene that is in the folder. All else there is replaced."""


@dataclass(frozen=True)
class Result:
    """What came of a job; everything else is in its run directory."""

    name: str
    exit_code: int
    """What ``warpjelly run`` would have returned."""
    reason: str | None
    """Why it did not finish, in one line."""
    attempts: int = 1
    """How often it was begun: again after its process was lost."""


def require_workers(workers: int | None) -> None:
    """Raise InputError unless a number of workers, or None for the engine's own, is one."""
    if workers is not None and workers < 1:
        raise InputError(f"workers = {workers}: must be at least 1")


class Watcher:
    """Hears how a batch goes; this one does nothing with it."""

    def begin(self, jobs: Sequence[Job], done: int) -> None:
        """These jobs are to be done now; so many runs are finished already."""

    def advance(self, worker: str, job: Job, done: int) -> None:
        """A worker has done so many frames of a job."""

    def end(self, worker: str, job: Job, result: Result) -> None:
        """A worker has ended a job."""

    def say(self, line: str) -> None:
        """Something that people should know."""

    def draw(self, done: int, total: int) -> None:
        """All jobs have ended, and pictures of so many of the runs are drawn."""


class Engine(Protocol):
    """Does jobs somewhere; used in a ``with`` block, at whose start it gets ready."""

    name: str
    """For the record."""
    workers: int
    """How many jobs it does at a time."""

    def __enter__(self) -> Self:
        """Get ready to do jobs, so far that what cannot be is found out."""
        ...

    def __exit__(self, *_: object) -> None:
        """Let go of everything, also of jobs that are under way."""
        ...

    def run(self, jobs: Sequence[Job], *, watcher: Watcher, stopping: Callable[[], bool]) -> Iterator[Result]:
        """Do jobs, and yield their results as they come.

        Args:
            jobs: what to do; the folders are on a file system that this process sees, too.
            watcher: is told of progress, in this thread.
            stopping: says whether to stop: jobs that are under way are interrupted, which leaves them where they can
                go on, and those that were not begun have no result.
        """
        ...
