"""Percentiles of forces over a whole run, without keeping the forces."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

# A bin is all float32 with the same upper 17 bits, 9 of them of the mantissa: so percentiles are off by less than 2^-9
# of their value, half an entry of the colour table at its upper end. The least and the greatest force are exact.
_DROPPED_BITS = 14
_BIN_COUNT = 1 << (31 - _DROPPED_BITS)
# Forces that vary by less than this share of their value are one force and rounding: no range to stretch colours over.
_FLAT_RANGE = 1e-2


class ForceHistogram:
    """How often forces of each magnitude were seen, with the same relative resolution at every magnitude."""

    def __init__(self) -> None:
        self._counts = np.zeros(_BIN_COUNT, np.int64)
        self._limits = np.array([np.inf, 0.0])

    def add(self, forces: np.ndarray) -> None:
        """Count forces, not negative, float32 of any shape, N; those that are not finite are left out."""
        finite = forces[np.isfinite(forces)]
        if finite.size:
            np.add.at(self._counts, np.ascontiguousarray(finite, np.float32).view(np.uint32) >> _DROPPED_BITS, 1)
            self._limits = np.array([min(self._limits[0], finite.min()), max(self._limits[1], finite.max())])

    def color_range(self) -> tuple[float, float]:
        """Return the 1st to 99th percentile of all that was counted, N; never an empty range."""
        if not self._counts.any():
            return 0.0, 1.0
        low, high = self.percentile(1), self.percentile(99)
        if high - low <= _FLAT_RANGE * high:
            return low, (2 * high if high > 0 else 1.0)
        return low, high

    def percentile(self, percent: float) -> float:
        """Return a percentile, N, linear between neighbours, with a relative error below 2^-9."""
        cumulative = np.cumsum(self._counts)
        rank = percent / 100 * (cumulative[-1] - 1)
        ranks = np.array([np.floor(rank), np.ceil(rank)])
        bins = np.searchsorted(cumulative, ranks, side="right")
        # The forces in a bin count as evenly spread.
        low, high = (((bins + more) << _DROPPED_BITS).astype(np.uint32).view(np.float32) for more in (0, 1))
        share = 1 - (cumulative[bins] - ranks - 0.5) / self._counts[bins]
        below, above = np.clip(low + share * (high.astype(np.float64) - low), *self._limits)
        return float(below + (rank - ranks[0]) * (above - below))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what was counted, for a checkpoint."""
        bins = np.flatnonzero(self._counts)
        return {"bins": bins, "counts": self._counts[bins], "limits": self._limits}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what another histogram had counted."""
        self._counts[:] = 0
        self._counts[arrays["bins"]] = arrays["counts"]
        self._limits = arrays["limits"]
