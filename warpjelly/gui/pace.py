"""How simulated time follows real time, and how well."""

from __future__ import annotations

from collections import deque

# Where simulated time is farther behind than this, the rest is given up rather than made up for, s of real time.
MOST_BEHIND = 0.1
# Rates are means over so long, s of real time.
WINDOW = 1.0


class Pace:
    """Says which simulated time is due. Moments are those of one clock of real time, s."""

    def __init__(self) -> None:
        self.speed = 1.0
        """Simulated over real time that is aimed at."""
        self._moment = self._time = 0.0
        self._past: deque[tuple[float, float, int]] = deque()

    def begin(self, moment: float, time: float) -> None:
        """Count from a moment and a simulated time on, s."""
        self._moment, self._time = moment, time

    def due(self, moment: float) -> float:
        """Return the simulated time that belongs to a moment, s."""
        return self._time + (moment - self._moment) * self.speed

    def seconds_to(self, moment: float, time: float) -> float:
        """Return how long it is from a moment until a simulated time is due, s; negative where it was due."""
        return (time - self.due(moment)) / self.speed

    def keep_up(self, moment: float, time: float) -> None:
        """Give up what cannot be made up for."""
        if -self.seconds_to(moment, time) > MOST_BEHIND:
            self.begin(moment, time)

    def rates(self, moment: float, time: float, substeps: int) -> tuple[float, float]:
        """Note how far the simulation is, and return how fast it went over the last moments.

        Args:
            moment: now, s.
            time: simulated, s.
            substeps: since the start.

        Returns:
            Substeps a second; simulated over real time.
        """
        past = self._past
        if past and past[-1][2] > substeps:
            past.clear()
        past.append((moment, time, substeps))
        while len(past) > 2 and past[0][0] < moment - WINDOW:
            past.popleft()
        first_moment, first_time, first_substeps = past[0]
        if (passed := moment - first_moment) <= 0.0:
            return 0.0, 0.0
        return (substeps - first_substeps) / passed, (time - first_time) / passed

    def rest(self) -> None:
        """Forget how fast it went: it does not go any more."""
        self._past.clear()
