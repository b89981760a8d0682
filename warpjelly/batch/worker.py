"""A process of the local engine: does the jobs that arrive on stdin, and says on stdout how they go."""

from __future__ import annotations

import faulthandler
import os
import pickle
import queue
import signal
import sys
import threading
import time
from typing import BinaryIO

from ..errors import EnvironmentFailedError
from .jobs import Job
from .perform import perform

# Progress is reported at most so often, s: whoever reads it shares the processors.
INTERVAL = 0.1


def work(device: str) -> None:
    """Do jobs one after another, so that imports and kernels are paid for once.

    The process ends as soon as nobody can hear it any more, however that came about; a job that it was doing then is
    in the state that any kill leaves.

    Args:
        device: where to simulate.
    """
    faulthandler.enable()
    # What libraries print must not come between messages.
    messages = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    # Being told to end interrupts the job, which can go on later.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    _send(messages, None)
    threading.Thread(target=_listen, args=(sys.stdin.buffer, jobs), daemon=True).start()
    while True:
        job = jobs.get()
        result = perform(job, device=device, progress=_Reporter(messages))
        _send(messages, result)
        if result.exit_code == EnvironmentFailedError.exit_code:
            # After an error of the machine, or one that nobody thought of, a fresh process is the safer one.
            os._exit(0)


class _Reporter:
    """Sends the number of frames that are done, the first at once and later ones from time to time."""

    def __init__(self, messages: BinaryIO) -> None:
        self._messages = messages
        self._last = 0.0

    def __call__(self, done: int, total: int) -> None:
        if (now := time.monotonic()) >= self._last + INTERVAL:
            self._last = now
            _send(self._messages, done)


def _send(messages: BinaryIO, message: object) -> None:
    pickle.dump(message, messages)
    messages.flush()


def _listen(orders: BinaryIO, jobs: queue.SimpleQueue[Job]) -> None:
    """Take jobs in until there is nobody any more to send them, and then end the process."""
    while True:
        try:
            jobs.put(pickle.load(orders))
        except (EOFError, pickle.UnpicklingError):
            os._exit(0)
