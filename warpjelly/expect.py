"""Measure what a scene expects of itself.

The vocabulary is documented with the fields of ``scene.Expect``; here is how each quantity is measured.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from .placing import BLOCK

if TYPE_CHECKING:
    from .simulator import Simulator


log = logging.getLogger("warpjelly")


@dataclass(frozen=True)
class Outcome:
    """One measured quantity beside its bounds."""

    quantity: str
    body: str
    value: float
    min: float | None
    max: float | None

    @property
    def met(self) -> bool:
        """Whether the value is within the bounds; a value that is not a number is not."""
        return (self.min is None or self.value >= self.min) and (self.max is None or self.value <= self.max)

    def as_dict(self) -> dict[str, object]:
        """Return everything, for JSON."""
        return {**asdict(self), "met": self.met}


class Observer:
    """Watches a run frame by frame; costs nothing where the scene expects nothing."""

    def __init__(self, sim: Simulator) -> None:
        self._sim = sim
        self._expectations = list(sim.scene.expect.items())
        quantities = {quantity for _, quantity, _ in self._expectations}
        # Copies of large arrays, only for what needs them.
        self._compares_shapes = bool(quantities & {"rotation", "shape_error"})
        self._sees_speeds = "speed" in quantities
        self._rest = self._positions = sim.positions if self._compares_shapes else np.zeros((0, 3))
        self._velocities = np.zeros((0, 3))
        self._centers: list[np.ndarray] = []
        self._heights: list[np.ndarray] = []
        self._depths: list[np.ndarray] = []
        self.diverged = False
        """Whether the run diverged after the last frame that was observed; for whoever runs it to set."""

    def observe(self, penetrations: np.ndarray) -> None:
        """Take in the current frame; penetrations are those of ``Simulator.diagnostics``."""
        if not self._expectations:
            return
        sim = self._sim
        self._see(sim)
        x, mass = sim.state.x.numpy(), sim.model.particle_mass.numpy()
        parts = [body.particles for body in sim.model.bodies]
        self._centers.append(np.array([center_of_mass(x[:, part], mass[part]) for part in parts]))
        self._heights.append(np.array([np.ptp(x[sim.scene.up, part]) for part in parts]))
        self._depths.append(penetrations)

    def _see(self, sim: Simulator) -> None:
        """Copy what is measured at the last frame that is observed."""
        if self._compares_shapes:
            self._positions = sim.positions
        if self._sees_speeds:
            self._velocities = sim.velocities

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of what was observed, for a checkpoint after the current frame."""
        return {
            "centers": np.array(self._centers),
            "heights": np.array(self._heights),
            "depths": np.array(self._depths),
        }

    def restore(self, arrays: Mapping[str, np.ndarray], frame_count: int) -> None:
        """Go on after so many frames from what another observer took in, with the simulator where it was then."""
        if not self._expectations:
            return
        if len(arrays["centers"]) != frame_count:
            log.warning("what the scene expects is not measured: earlier frames were simulated without expectations")
            self._expectations = []
            return
        self._see(self._sim)
        self._centers, self._heights, self._depths = (list(arrays[name]) for name in ("centers", "heights", "depths"))

    def outcomes(self) -> list[Outcome]:
        """Return the quantities that the scene bounds, at the last frame that was observed."""
        found = []
        for _, quantity, expectation in self._expectations:
            bodies = self._sim.model.bodies
            number = next((i for i, body in enumerate(bodies) if body.name == expectation.body), 0)
            value = float(getattr(self, f"_{quantity}")(number))
            found.append(Outcome(quantity, bodies[number].name, value, expectation.min, expectation.max))
        return found

    def _rest_height(self, body: int) -> float:
        return self._centers[-1][body, self._sim.scene.up]

    def _displacement(self, body: int) -> float:
        return float(np.linalg.norm(self._centers[-1][body] - self._centers[0][body]))

    def _reach(self, body: int) -> float:
        centers = np.array(self._centers)[:, body]
        return float(np.linalg.norm(centers - centers[0], axis=1).max())

    def _rotation(self, body: int) -> float:
        part = self._sim.model.bodies[body].particles
        rotation = rigid_fit(self._rest[part], self._positions[part])
        return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))

    def _speed(self, body: int) -> float:
        return np.linalg.norm(self._velocities[self._sim.model.bodies[body].particles], axis=1).max()

    def _shape_error(self, body: int) -> float:
        part = self._sim.model.bodies[body].particles
        return rigid_fit_error(self._rest[part], self._positions[part])

    def _squash(self, body: int) -> float:
        heights = np.array(self._heights)[:, body]
        return heights.min() / heights[0]

    def _bounce(self, body: int) -> float:
        height = np.array(self._centers)[:, body, self._sim.scene.up]
        rising = np.flatnonzero(np.diff(height) > 0)
        return height[rising[0] :].max() - height[rising[0]] if len(rising) else 0.0

    def _penetration(self, body: int) -> float:
        return np.array(self._depths)[:, body].max() / self._sim.model.bodies[body].unit

    def _diverges(self, body: int) -> float:
        return float(self.diverged)


def center_of_mass(x: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return the centre of mass of particles at x [3, count] with masses [count], float64 [3]; summed in float64."""
    moment, total = np.zeros(3), 0.0
    for start in range(0, len(mass), BLOCK):
        part = slice(start, start + BLOCK)
        weights = mass[part].astype(float)
        moment += x[:, part] @ weights
        total += weights.sum()
    return np.asarray(moment / total)


def rigid_fit(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Return the rotation that best takes points to where they are now, up to a shift, [3, 3]; NaN if they are lost.

    It follows from a singular value decomposition (Kabsch 1976, doi:10.1107/S0567739476001873). A row vector x goes
    to x times the rotation.

    Args:
        rest: [count, 3].
        now: the same points, [count, 3].
    """
    a, b = rest - rest.mean(axis=0), now - now.mean(axis=0)
    if not np.isfinite(b).all():
        return np.full((3, 3), np.nan)
    u, _, vt = np.linalg.svd(a.T @ b)
    # A reflection would fit better than any rotation when the determinant is negative; it is not a motion.
    u[:, -1] *= np.sign(np.linalg.det(u @ vt))
    return np.asarray(u @ vt)


def rigid_fit_error(rest: np.ndarray, now: np.ndarray) -> float:
    """Return the rms distance of points from the best rigid fit of their rest shape, as a share of its diagonal.

    Args:
        rest: [count, 3].
        now: the same points, [count, 3].
    """
    a, b = rest - rest.mean(axis=0), now - now.mean(axis=0)
    rms = np.sqrt(((a @ rigid_fit(rest, now) - b) ** 2).sum(axis=1).mean())
    return float(rms / np.linalg.norm(np.ptp(rest, axis=0)))
