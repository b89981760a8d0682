"""What the log warns of, for people who do not see the log."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger("warpjelly")


class _Ear(logging.Handler):
    """Hears the warnings of the thread in which it was made."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Take in a warning."""
        if record.thread == self._thread:
            self.texts.append(record.getMessage())


@contextmanager
def heard(tell: Callable[[str, str], None]) -> Iterator[None]:
    """Tell of the warnings of this thread in the block, after it ended, with their level."""
    ear = _Ear()
    log.addHandler(ear)
    try:
        yield
    finally:
        log.removeHandler(ear)
        for text in ear.texts:
            tell(text, "warning")
