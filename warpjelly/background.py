"""Jobs beside the main thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Self


class Background:
    """Does jobs one after another in a thread of its own; after one that fails, no other is started.

    Args:
        most: how many jobs may be unfinished; ``submit`` waits while there are more.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._executor = ThreadPoolExecutor(max_workers=1)
        self._unfinished: deque[Future[None]] = deque()
        self._failed = False

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Wait until all is done."""
        self._executor.shutdown()

    def submit(self, job: Callable[..., None], *arguments: Any) -> None:
        """Add a job; raises what an earlier one raised."""
        self._wait(0 if self._failed else self._most - 1)
        self._unfinished.append(self._executor.submit(self._do, job, *arguments))

    def join(self) -> None:
        """Wait until all is done; raises what a job raised."""
        self._wait(0)

    def _wait(self, most: int) -> None:
        while len(self._unfinished) > most:
            # One that fails stays, so that whoever asks next hears of it, too.
            self._unfinished[0].result()
            self._unfinished.popleft()

    def _do(self, job: Callable[..., None], *arguments: Any) -> None:
        if self._failed:
            return
        try:
            job(*arguments)
        except BaseException:
            self._failed = True
            raise
