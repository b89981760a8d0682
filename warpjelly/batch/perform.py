"""How a job is done, whichever engine does it."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..checkpoint import version_of
from ..errors import INTERRUPTED, EnvironmentFailedError, InputError, WarpjellyError, verdict
from ..run import simulate
from ..rundir import RECORD_NAME, find_checkpoint, read_record
from ..scene import Scene
from .jobs import LOG_NAME, Job, Result

log = logging.getLogger("warpjelly")


def resumable(folder: Path, scene: Scene) -> bool:
    """Say whether a folder holds a run of a scene by this version that has frames to come, or was just finishing."""
    try:
        record = read_record(folder) if (folder / RECORD_NAME).is_file() else {"interrupted": True, "diverged": False}
        checkpoint = find_checkpoint(folder, scene)
    except InputError:
        return False
    if checkpoint is None or record["diverged"] or checkpoint.origin["warpjelly"] != version_of("warpjelly"):
        return False
    return bool(record["interrupted"]) or checkpoint.frame_count < scene.frame_count


def perform(job: Job, *, device: str, progress: Callable[[int, int], None] = lambda done, total: None) -> Result:
    """Do a job in this process; what it says goes to the log of its run directory.

    Args:
        job: what to do.
        device: as for ``simulate``.
        progress: as for ``simulate``.
    """
    try:
        job.folder.mkdir(parents=True, exist_ok=True)
        with _logged(job.folder / LOG_NAME, append=job.resume):
            return _perform(job, device, progress)
    except OSError as error:
        why = f"{job.folder}: cannot write the log of the run: {error.strerror or error}"
        return Result(job.name, EnvironmentFailedError.exit_code, why)


def _perform(job: Job, device: str, progress: Callable[[int, int], None]) -> Result:
    began = time.perf_counter()
    try:
        resume = job.resume and resumable(job.folder, job.scene)
        log.info("%s in process %d", "going on" if resume else "begun", os.getpid())
        simulate(job.scene, output=job.folder, device=device, force=not resume, resume=resume, progress=progress)
    except (Exception, KeyboardInterrupt) as error:
        why, code = verdict(error)
        foreseen = isinstance(error, WarpjellyError | KeyboardInterrupt)
        log.log(logging.INFO if code == INTERRUPTED else logging.ERROR, "%s", why, exc_info=not foreseen)
        return Result(job.name, code, why)
    log.info("finished after %.1f s", time.perf_counter() - began)
    return Result(job.name, 0, None)


@contextmanager
def _logged(path: Path, *, append: bool) -> Iterator[None]:
    """Send all that this process says to a file, native code and Python's tracebacks included."""
    with open(path, "a" if append else "w", encoding="utf-8") as file:
        handler = logging.StreamHandler(file)
        handler.setFormatter(logging.Formatter("{asctime} {levelname}: {message}", style="{"))
        handlers, log.handlers, level = log.handlers, [handler], log.level
        log.setLevel(logging.INFO)
        kept = [os.dup(descriptor) for descriptor in (1, 2)]
        try:
            for descriptor in (1, 2):
                os.dup2(file.fileno(), descriptor)
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for descriptor, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, descriptor)
                os.close(copy)
            log.handlers = handlers
            log.setLevel(level)
