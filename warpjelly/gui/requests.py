"""What people ask of the page, done one after another in a thread of its own, so that nothing else waits."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

from ..errors import InputError, verdict

# What is typed digit by digit is done when nothing followed for so long, s.
PAUSE = 0.4


@dataclass
class _Request:
    client: Any
    action: Callable[[], None]
    due: float


class Requests:
    """A queue of what to do.

    Args:
        failed: told of what could not be done: the client that asked, and a line for people.
    """

    def __init__(self, failed: Callable[[Any, str], None]) -> None:
        self._failed = failed
        self._waiting: dict[Hashable, _Request] = {}
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._work, name="requests", daemon=True)
        self._thread.start()

    def ask(self, client: Any, action: Callable[[], None], *, key: Hashable = None, pause: float = 0.0) -> None:
        """Have something done.

        Args:
            client: who asked.
            action: what to do; an InputError of it is a line in the page, and nothing else happens.
            key: of several requests with the same key, the last one counts, unless it is None.
            pause: when none with the same key has followed for so long, s.
        """
        now = time.monotonic()
        with self._changed:
            self._waiting.pop(key, None)
            if not pause:
                # What was typed before a button was pressed counts.
                for earlier in self._waiting.values():
                    earlier.due = now
            self._waiting[object() if key is None else key] = _Request(client, action, now + pause)
            self._changed.notify()

    def awaits(self, key: Hashable) -> bool:
        """Say whether a request with a key has not been done yet."""
        with self._changed:
            return key in self._waiting

    def stop(self) -> None:
        """End; what has not been begun is not done."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while (request := self._next()) is not None:
            try:
                request.action()
            except InputError as error:
                self._failed(request.client, str(error))
            except Exception as error:
                self._failed(request.client, verdict(error)[0])

    def _next(self) -> _Request | None:
        """Wait for the next request that is due, and take it."""
        with self._changed:
            while not self._stopped:
                now = time.monotonic()
                for key, request in self._waiting.items():
                    if request.due <= now:
                        return self._waiting.pop(key)
                soonest = min((request.due for request in self._waiting.values()), default=None)
                self._changed.wait(None if soonest is None else soonest - now)
        return None
