"""The largest stable time step, found beside a simulation that goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..errors import verdict
from ..simulator import Simulator
from ..stability import evaluations
from ..stepping import capture_lock
from .snapshot import Limits

# Larger scenes get no limits: so many springs, times evaluations of their forces, take some ten seconds.
MOST_EVALUATIONS = 1e9


class _UnwantedError(Exception):
    """The limits are not wanted any more."""


class LimitSearch:
    """A search, in a thread of its own from ``start`` on.

    Args:
        sim: whose limits; interactive, so that they may be asked for while it steps.
        found: called with this search and the limits, in that thread.
        tell: called with a message for people, and its level, where something fails.
        after: a search that was stopped, to be waited for, so that there is one at a time.
    """

    def __init__(
        self,
        sim: Simulator,
        found: Callable[[LimitSearch, Limits], None],
        tell: Callable[[str, str], None],
        *,
        after: LimitSearch | None = None,
    ) -> None:
        self._sim = sim
        self._found = found
        self._tell = tell
        self._after = after
        self._stopped = False
        self._thread = threading.Thread(target=self._seek, name="warpjelly limits", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """Want the limits no more."""
        self._stopped = True

    def join(self) -> None:
        """Wait for the end of the search."""
        self._thread.join()

    def _seek(self) -> None:
        if self._after is not None:
            self._after.join()
            self._after = None
        try:
            self._find()
        except _UnwantedError:
            return
        except Exception as error:
            self._tell(f"no largest stable step was found: {verdict(error)[0]}", "warning")

    def _find(self) -> None:
        sim = self._sim
        if evaluations(sim.model) * sim.model.spring_count > MOST_EVALUATIONS:
            return
        self._require_wanted()
        name = sim.scene.solver.integrator
        springs, contact = (sim.step_limits(contacts=on, wanted=self._require_wanted)[name] for on in (False, True))
        with capture_lock:
            limits = Limits(springs, contact, sim.broken_limit())
        if not self._stopped:
            self._found(self, limits)

    def _require_wanted(self) -> None:
        if self._stopped:
            raise _UnwantedError
