"""Which cells of a grid are occupied, as runs along z.

Each row of cells along z has nz + 1 places, one below each cell and one above the last: ``(x ny + y) (nz + 1) + z``.
Cells are kept as the places where occupancy changes, in ascending order, so they cost what their surface does, and not
what they fill or what is empty around them.

Cells are combined by counting. An event, 2 place + 1 or 2 place, says that one more or one less counts from a place on;
sorted, events give the places where the count changes, and the count from there on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

# Cells that are held one by one at a time, where they are.
_CHUNK = 1 << 25


@dataclass(frozen=True, eq=False)
class Cells:
    """Occupied cells of a grid."""

    shape: tuple[int, int, int]
    """Cells along x, y and z."""
    edges: np.ndarray
    """Places where runs of occupied cells begin and end, by turns and ascending, int64 [2 run_count]."""

    @classmethod
    def of(cls, dense: np.ndarray) -> Cells:
        """Return what is occupied of an array, bool [nx, ny, nz]."""
        nx, ny, nz = dense.shape
        padded = np.zeros((nx * ny, nz + 1), np.int8)
        padded[:, :-1] = dense.reshape(nx * ny, nz)
        return cls((nx, ny, nz), np.flatnonzero(np.diff(padded.ravel(), prepend=np.int8(0))))

    @classmethod
    def between(cls, shape: tuple[int, int, int], places: np.ndarray, occupied: np.ndarray) -> Cells:
        """Return the cells that are occupied from some of ascending places on, each up to the next one.

        In every row the last place is not.
        """
        return cls(shape, places[np.diff(occupied, prepend=False)])

    def dense(self) -> np.ndarray:
        """Return whether each cell is occupied, bool [nx, ny, nz]."""
        nx, ny, nz = self.shape
        change = np.zeros(nx * ny * (nz + 1), np.int8)
        change[self.edges[::2]] = 1
        change[self.edges[1::2]] = -1
        return np.cumsum(change, out=change).view(bool).reshape(nx, ny, nz + 1)[:, :, :-1]

    @property
    def count(self) -> int:
        """Number of occupied cells."""
        return int((self.edges[1::2] - self.edges[::2]).sum())

    @property
    def run_count(self) -> int:
        """Number of runs of occupied cells along z."""
        return len(self.edges) // 2

    @property
    def grid_size(self) -> int:
        """Number of cells of the grid, occupied or not."""
        nx, ny, nz = self.shape
        return nx * ny * nz

    def runs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the row ``x ny + y`` of each run and the z where it begins and where it ends, int64 [run_count]."""
        row, low = np.divmod(self.edges[::2], self.shape[2] + 1)
        return row, low, low + (self.edges[1::2] - self.edges[::2])

    def row_start(self) -> np.ndarray:
        """Return the first run of each row and the end of the last one, int64 [nx ny + 1]."""
        nx, ny, nz = self.shape
        return np.searchsorted(self.edges[::2], np.arange(nx * ny + 1) * (nz + 1))

    def events(self) -> np.ndarray:
        """Return events that count one in each occupied cell, int64 [2 run_count]."""
        return 2 * self.edges + np.tile([1, 0], self.run_count)

    def kept(self, runs: np.ndarray) -> Cells:
        """Return the cells of some runs alone, bool [run_count]."""
        return Cells(self.shape, self.edges[np.repeat(runs, 2)])

    def places(self) -> np.ndarray:
        """Return the place below each occupied cell, ascending, int64 [count]."""
        return _ranges(self.edges[::2], self.edges[1::2])

    def refined(self, parts: int) -> Cells:
        """Cut every cell into parts x parts x parts."""
        return self if parts == 1 else self.sampled([np.arange(parts * n) // parts for n in self.shape])

    def sampled(self, layers: Sequence[np.ndarray]) -> Cells:
        """Return the cells of another grid that lie in one of these.

        Args:
            layers: for x, y and z, in which layer of this grid each layer of the other one lies, ascending; what is no
                layer of this grid is empty.
        """
        row, low, high = self.runs()
        x, y = np.divmod(row, self.shape[1])
        # The layers of the other grid that lie in each run.
        (x, end_x), (y, end_y), (low, high) = (
            np.searchsorted(numbers, ends)
            for numbers, ends in zip(layers, ((x, x + 1), (y, y + 1), (low, high)), strict=True)
        )
        run = np.repeat(np.arange(self.run_count), end_x - x)
        x, y, end_y = _ranges(x, end_x), y[run], end_y[run]
        x, run, y = np.repeat(x, end_y - y), np.repeat(run, end_y - y), _ranges(y, end_y)
        nx, ny, nz = map(len, layers)
        place = (x * ny + y) * (nz + 1)
        return unite((nx, ny, nz), np.concatenate([2 * (place + low[run]) + 1, 2 * (place + high[run])]))

    def within(self, other: Cells) -> Cells:
        """Return those that are among other cells of the same grid, too."""
        places, sums = add_up(np.concatenate([self.events(), other.events()]))
        return Cells.between(self.shape, places, sums > 1)

    def without(self, other: Cells) -> Cells:
        """Return those that are not among other cells of the same grid."""
        # The others count one less.
        places, sums = add_up(np.concatenate([self.events(), other.events() ^ 1]))
        return Cells.between(self.shape, places, sums > 0)

    def joined(self, other: Cells) -> Cells:
        """Return these cells and others of the same grid."""
        return unite(self.shape, np.concatenate([self.events(), other.events()]))

    def turned(self) -> Cells:
        """Return the same cells with axes (z, x, y) instead of (x, y, z).

        Along y, occupancy changes where one of two neighbouring rows is occupied and the other is not.
        """
        nx, ny, nz = self.shape
        row, z = np.divmod(self.edges, nz + 1)
        x, y = np.divmod(row, ny)
        # Between (x, y - 1) and (x, y) is gap (x, y), y from 0 to ny; the places of both rows, in order, bound cells
        # that are occupied in one of them.
        gap = x * (ny + 1) + y
        bounds = np.sort(np.concatenate([gap, gap + 1]) * (nz + 1) + np.tile(z, 2))
        gap, z = np.divmod(_ranges(bounds[::2], bounds[1::2]), nz + 1)
        x, y = np.divmod(gap, ny + 1)
        return Cells((nz, nx, ny), np.sort((z * nx + x) * (ny + 1) + y))

    def rows(self) -> Iterator[np.ndarray]:
        """Yield whether each cell is occupied, some rows along z at a time, bool [some, nz]."""
        nx, ny, nz = self.shape
        width = max(1, _CHUNK // nz)
        for start in range(0, nx * ny, width):
            stop = min(start + width, nx * ny)
            first, last = np.searchsorted(self.edges, (start * (nz + 1), stop * (nz + 1)))
            yield Cells((1, stop - start, nz), self.edges[first:last] - start * (nz + 1)).dense()[0]


def add_up(events: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of events, ascending, each once, and what all events up to there come to, int32."""
    events = np.sort(events)
    more = 2 * (events & 1).astype(np.int8) - np.int8(1)
    events >>= 1
    last = is_last(events)
    return events[last], np.cumsum(more, dtype=np.int32)[last]


def is_last(ascending: np.ndarray) -> np.ndarray:
    """Say of each of ascending numbers whether the next one is another, bool [count]."""
    return np.append(ascending[1:] != ascending[:-1], True)[: len(ascending)]


def unite(shape: tuple[int, int, int], events: np.ndarray) -> Cells:
    """Return the cells in which events come to something; at the end of every row they come to nothing."""
    places, sums = add_up(events)
    return Cells.between(shape, places, sums != 0)


def _ranges(starts: np.ndarray, stops: np.ndarray) -> np.ndarray:
    """Return the integers of one range after the other, int64."""
    lengths = stops - starts
    before = np.cumsum(lengths) - lengths
    return np.repeat(starts - before, lengths) + np.arange(lengths.sum())
