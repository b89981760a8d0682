"""Threads that replay a captured graph together on the CPU; kernels/turns.py says how they share the work."""

from __future__ import annotations

import ctypes
import os
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import warp as wp

from warpjelly.kernels.turns import Turn


def _give_way() -> int:
    """Return the address of the function of the system that lets other threads have the processor."""
    library, name = ("kernel32", "SwitchToThread") if os.name == "nt" else (None, "sched_yield")
    return ctypes.cast(getattr(ctypes.CDLL(library), name), ctypes.c_void_p).value or 0


class Team:
    """Threads, and what they know of each other while they replay a graph.

    Args:
        threads: how many there are, that of the caller included.
        launches: how many launches a graph has at most.
    """

    def __init__(self, threads: int, launches: int) -> None:
        self.threads = threads
        self._helpers = ThreadPoolExecutor(threads - 1) if threads > 1 else None
        self._started: list[Future[None]] = []
        self._counts = wp.zeros((launches, 2), dtype=wp.int32, device="cpu")
        self._used = 0
        self._give_way = _give_way()

    def begin(self) -> None:
        """Begin the capture of a graph."""
        self._used = 0

    def turn(self, tasks: int) -> Turn:
        """Return the turn of the next launch of the graph."""
        if self._used == len(self._counts):
            raise RuntimeError(f"a graph has more than the {self._used} launches that were expected")
        turn = Turn()
        turn.counts, turn.launch, turn.tasks, turn.give_way = self._counts, self._used, tasks, self._give_way
        self._used += 1
        return turn

    def replay(self, graphs: list[Any]) -> None:
        """Replay a graph that was captured once for all threads, or once for each of them."""
        # Helpers are still at work if waiting for them was interrupted; cleared counters would mislead them.
        self._wait()
        self._counts.numpy()[:] = 0
        try:
            if self._helpers is not None:
                for thread in range(1, self.threads):
                    self._started.append(self._helpers.submit(wp.capture_launch, graphs[thread % len(graphs)]))
            wp.capture_launch(graphs[0])
        finally:
            self._wait()

    def _wait(self) -> None:
        """Wait until no helper is at work; raises what one of them raised."""
        # The work is done, so who has not begun is not needed. In a process that was forked off nobody would.
        self._started = [helper for helper in self._started if not helper.cancel()]
        wait(self._started)
        ended, self._started = self._started, []
        for helper in ended:
            helper.result()
