"""Ctrl-C and the like, as a question instead of an exception."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptions() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether Ctrl-C was pressed, or the like; a second time it interrupts as ever."""
    asked = threading.Event()

    def ask(number: int, frame: FrameType | None) -> None:
        asked.set()
        signal.signal(number, signal.default_int_handler)

    ours = [number for number in (signal.SIGINT, signal.SIGTERM) if _interrupts(number)]
    for number in ours:
        signal.signal(number, ask)
    try:
        yield asked.is_set
    finally:
        for number in ours:
            signal.signal(number, signal.default_int_handler)


def _interrupts(number: int) -> bool:
    """Say whether a signal raises KeyboardInterrupt here; only the main thread may change that."""
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(number) is signal.default_int_handler
