"""Parts of a model that may be worked on at once; they follow from the model alone, whatever the number of threads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpjelly.kernels.springs import MAX_SPAN

from .model import Model

# Least particles of a part: less is not worth taking turns for.
MIN_PART = 2048
# Most parts: enough to keep many threads busy, few enough to compare each with each.
MAX_PARTS = 256


@dataclass(frozen=True)
class Parts:
    """How the work on a model is cut into tasks; arrays are on its device."""

    particle_start: wp.array
    """First particle of each part, and the end of the last, int32 [part_count + 1]."""
    chunk_start: wp.array
    """First chunk of each part, and the end of the last, int32 [part_count + 1]."""
    phases: list[wp.array]
    """(first span, end) of the tasks of one phase after the other, vec2i [task_count] each; empty on a GPU."""

    @property
    def count(self) -> int:
        """Number of parts."""
        return len(self.chunk_start) - 1

    @property
    def most_tasks(self) -> int:
        """How many threads can be of use at most."""
        return max(self.count, *(len(phase) for phase in self.phases), 1)


def find_parts(model: Model) -> Parts:
    """Cut a model into parts: on a GPU each chunk is one, on the CPU some chunks together."""
    device, chunk_start = model.spans.device, model.chunk_start.numpy()
    if device.is_cpu:
        length = _part_length(model.particle_count)
        first = np.searchsorted(chunk_start[:-1], np.arange(0, model.particle_count, length))
        parts = np.unique(np.append(first, len(chunk_start) - 1))
        phases = cut_spans(model.spans.numpy(), model.particle_count)
    else:
        parts, phases = np.arange(len(chunk_start)), []
    return Parts(
        particle_start=wp.array(chunk_start[parts], dtype=wp.int32, device=device),
        chunk_start=wp.array(parts, dtype=wp.int32, device=device),
        phases=[wp.array(phase, dtype=wp.vec2i, device=device) for phase in phases],
    )


def cut_spans(spans: np.ndarray, particle_count: int) -> list[np.ndarray]:
    """Sort spans into phases: threads may do all tasks of a phase at once, because no two touch the same particle.

    A task is the spans that begin in one part of the particles. They touch that part and those in which they end: in a
    lattice the next ones, so that every second or third part can be worked on at once. Coarser parts touch fewer
    others; of several cuts that one is taken whose phases have most tasks.

    Args:
        spans: (i, j, count, class), by ascending i, int32 [span_count, 4].
        particle_count: how many particles there are.

    Returns:
        (first span, end of spans) of each task of each phase, int32 [task_count, 2] each.
    """
    length = _part_length(particle_count)
    starts = np.searchsorted(spans[:, 0], np.arange(0, particle_count + length, length)).astype(np.int32)
    touched = _touched_parts(spans, starts, length)
    best: list[np.ndarray] = []
    while True:
        tasks = np.stack([starts[:-1], starts[1:]], axis=1)
        colors = _color(touched)
        phases = [tasks[colors == color] for color in range(colors.max(initial=-1) + 1)]
        if not best or len(tasks) * len(best) >= sum(map(len, best)) * len(phases):
            best = phases
        if len(phases) <= 2:
            filled = (phase[phase[:, 0] < phase[:, 1]] for phase in best)
            return [phase for phase in filled if len(phase) > 0]
        # Twice as long parts: the last one may be alone.
        starts = np.append(starts[:-1:2], starts[-1])
        touched = np.logical_or.reduceat(touched, np.arange(0, len(touched), 2), axis=0)
        touched = np.logical_or.reduceat(touched, np.arange(0, touched.shape[1], 2), axis=1)


def _part_length(particle_count: int) -> int:
    """Return how many particles a part has at least."""
    return max(MIN_PART, -(-particle_count // MAX_PARTS))


def _touched_parts(spans: np.ndarray, starts: np.ndarray, length: int) -> np.ndarray:
    """Return whether the spans that begin in a part touch another, bool [part_count, part_count].

    Args:
        spans: (i, j, count, class), int32 [span_count, 4].
        starts: first span that begins in each part, and the end of the last, [part_count + 1].
        length: particles of a part.
    """
    part_count = len(starts) - 1
    touched = np.zeros((part_count, part_count), bool)
    for part in range(part_count):
        first, second, count, _ = spans[starts[part] : starts[part + 1]].T
        for offset in range(0, MAX_SPAN + length - 1, length):
            for end in (first, second):
                touched[part, (end + np.minimum(offset, count - 1)) // length] = True
    return touched


def _color(touched: np.ndarray) -> np.ndarray:
    """Return the least color of each row that no earlier row has with which it shares an entry, int [part_count]."""
    shared = touched.astype(np.float32) @ touched.T > 0
    colors = np.full(len(touched), -1)
    for part in range(len(touched)):
        taken = set(colors[:part][shared[part, :part]])
        colors[part] = next(color for color in range(part + 1) if color not in taken)
    return colors
