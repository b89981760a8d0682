"""The local engine: processes on this machine that do jobs one after another."""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Self

from ..device import choose_device, gpus
from ..errors import INTERRUPTED, EnvironmentFailedError
from ..machine import available_cores, memory_limit, threads_of
from .jobs import Job, Result, Watcher, require_workers

# A job whose process was lost is begun so often in all.
ATTEMPTS = 2
# How often the engine looks whether it is to stop, s.
INTERVAL = 0.1
# How long an idle worker may take to end, s.
PATIENCE = 5.0
# Starts a worker, with the module path of this process. A child of multiprocessing would run the user's script again,
# which then has to be written for that.
_START = "import sys; sys.path[:] = {path!r}; from warpjelly.batch.worker import work; work({device!r}, {threads})"
# Of libraries that start a thread for each core unless told otherwise.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "PXR_WORK_THREAD_LIMIT")


class LocalEngine:
    """Does jobs on this machine, in processes that each do one at a time.

    Args:
        workers: how many processes; unless given, one for each GPU, or for each core where there is none. Fewer are at
            work while memory does not take more.
        device: as for ``simulate``; "auto" gives the workers the GPUs in turn.
        most: as many jobs there are at most, and so processes.
    """

    name = "local"

    def __init__(self, *, workers: int | None = None, device: str = "auto", most: int | None = None) -> None:
        require_workers(workers)
        self.devices = (gpus() if device == "auto" else []) or [choose_device(device)]
        count = workers or (available_cores() if self.devices == ["cpu"] else len(self.devices))
        self.workers = count if most is None else min(count, most)
        self._crew: _Crew | None = None

    def __enter__(self) -> Self:
        """Start the processes."""
        self._crew = _Crew(self.devices, self.workers)
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes; those that are still at work at once."""
        if self._crew is not None:
            self._crew.dismiss()

    def run(self, jobs: Sequence[Job], *, watcher: Watcher, stopping: Callable[[], bool]) -> Iterator[Result]:
        """See ``Engine``. A job whose process is lost is begun once more, from where it was."""
        assert self._crew is not None
        crew = self._crew
        crew.take(jobs)
        while crew.is_busy():
            if stopping():
                crew.stop()
            crew.give_out()
            yield from crew.listen(watcher)


@dataclass(frozen=True)
class _Attempt:
    """A job that is begun for the first time, or again."""

    job: Job
    number: int = 1


@dataclass(frozen=True)
class _Gone:
    """What is heard last from a process."""


class _Crew:
    """The workers of one batch, and the jobs that wait for them."""

    def __init__(self, devices: Sequence[str], count: int) -> None:
        self._waiting: list[_Attempt] = []
        self._inbox: queue.SimpleQueue[tuple[_Worker, Any]] = queue.SimpleQueue()
        threads = threads_of(count)
        self._workers = [
            _Worker(str(number + 1), devices[number % len(devices)], threads, self._inbox) for number in range(count)
        ]
        self._stopped = False
        # The first job compiles the kernels that Warp's cache lacks; the others wait until it is under way.
        self._fanned_out = False

    def take(self, jobs: Sequence[Job]) -> None:
        """Add jobs to those that wait."""
        self._waiting += [_Attempt(job) for job in jobs]

    def is_busy(self) -> bool:
        """Say whether there is something to do or to wait for."""
        return any(worker.attempt for worker in self._workers) or bool(self._waiting and not self._stopped)

    def stop(self) -> None:
        """Interrupt what is under way, and begin nothing more."""
        if not self._stopped:
            self._stopped = True
            for worker in self._workers:
                worker.interrupt()

    def give_out(self) -> None:
        """Give jobs to the workers that have none, as far as memory takes them."""
        for number, worker in enumerate(self._workers):
            busy = [other.attempt.job for other in self._workers if other.attempt]
            if self._stopped or not self._waiting or (busy and not self._fanned_out):
                return
            if worker.attempt or (worker.leaving and not worker.gone):
                continue
            free = memory_limit() - sum(job.memory_bytes for job in busy)
            # What is larger than all memory is tried alone: it is an estimate.
            chosen = next((a for a in self._waiting if a.job.memory_bytes <= free or not busy), None)
            if chosen is None:
                continue
            if worker.gone:
                worker = self._workers[number] = worker.successor()
            self._waiting.remove(chosen)
            worker.begin(chosen)

    def listen(self, watcher: Watcher) -> Iterator[Result]:
        """Take in the next message, if there is one; yield what it says of a job that has ended."""
        try:
            worker, message = self._inbox.get(timeout=INTERVAL)
        except queue.Empty:
            return
        if isinstance(message, _Gone):
            lost = worker.bury()
        elif isinstance(message, Result) and message.exit_code == INTERRUPTED and not self._stopped:
            # Somebody else told the process to end.
            lost = "its process was told to end"
        else:
            lost = None
        attempt = worker.attempt
        if attempt is None:
            return
        self._fanned_out = True
        if isinstance(message, int):
            watcher.advance(worker.name, attempt.job, message)
            return
        worker.attempt = None
        if lost is None:
            result = replace(message, attempts=attempt.number)
            worker.leaving = result.exit_code == EnvironmentFailedError.exit_code
        elif self._stopped:
            result = Result(attempt.job.name, INTERRUPTED, "interrupted", attempt.number)
        elif attempt.number < ATTEMPTS:
            self._waiting.insert(0, _Attempt(replace(attempt.job, resume=True), attempt.number + 1))
            return
        else:
            why = f"{lost}, {attempt.number} times in a row"
            result = Result(attempt.job.name, EnvironmentFailedError.exit_code, why, attempt.number)
        watcher.end(worker.name, attempt.job, result)
        yield result

    def dismiss(self) -> None:
        """End all processes."""
        for worker in self._workers:
            worker.dismiss()


class _Worker:
    """One process, and which job it has."""

    def __init__(self, name: str, device: str, threads: int, inbox: queue.SimpleQueue[tuple[_Worker, Any]]) -> None:
        self.name = name
        self.attempt: _Attempt | None = None
        self.leaving = False
        """Whether it takes no more jobs."""
        self.gone = False
        """Whether it has ended."""
        self._ready = False
        self._device, self._threads, self._inbox = device, threads, inbox
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=sys.path, device=device, threads=threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={**dict.fromkeys(_THREADS, str(threads)), **os.environ},
            # Ctrl-C is for this process, which tells the workers.
            start_new_session=True,
        )
        threading.Thread(target=self._hear, daemon=True).start()

    def successor(self) -> _Worker:
        """Return a new process in the place of this one."""
        return _Worker(self.name, self._device, self._threads, self._inbox)

    def begin(self, attempt: _Attempt) -> None:
        """Have it begin with a job."""
        assert self._process.stdin is not None
        self.attempt = attempt
        # If it is gone, that is what is heard of it next.
        with suppress(BrokenPipeError):
            pickle.dump(attempt.job, self._process.stdin)
            self._process.stdin.flush()

    def interrupt(self) -> None:
        """Have it end its job after the current frame."""
        if self.attempt is not None:
            self._process.terminate()

    def bury(self) -> str:
        """Return how the process ended, which it has, or is about to.

        Raises:
            EnvironmentFailedError: it could not even start.
        """
        self.gone = True
        code = self._process.wait()
        if not self._ready and code > 0:
            self._errors.seek(0)
            lines = self._errors.read().decode(errors="replace").split("\n")
            said = next((line for line in reversed(lines) if line.strip()), f"exit code {code}")
            raise EnvironmentFailedError(f"a worker process did not start: {said}")
        if code >= 0:
            return f"its process ended with exit code {code}"
        hint = ", as the system does when memory runs out" if code == -signal.SIGKILL else ""
        known = {number.value: number.name for number in signal.Signals}
        return f"its process was killed by {known.get(-code, f'signal {-code}')}{hint}"

    def dismiss(self) -> None:
        """End the process, at once if it has not ended its job or is just starting, and wait until it has."""
        assert self._process.stdin is not None
        if self.attempt is not None or not self._ready:
            self._process.kill()
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def _hear(self) -> None:
        """Put what the process says into the inbox."""
        assert self._process.stdout is not None
        with self._process.stdout as messages, suppress(EOFError, pickle.UnpicklingError):
            pickle.load(messages)
            self._ready = True
            while True:
                self._inbox.put((self, pickle.load(messages)))
        self._inbox.put((self, _Gone()))
