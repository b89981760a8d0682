"""A hand that holds some particles of a body and pulls them along."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from .errors import InputError
from .model import Body, Model, State

# Of a body the hand holds the particles that are nearest to where it takes hold: this share of them, so that bodies of
# any resolution are held alike, but no more than fit into its arrays.
HELD_SHARE, MAX_HELD = 1.0 / 16.0, 256
# A body that hangs in the hand swings about it at this rate, rad/s: it sags by 9.81 / rate^2, 4 cm.
SWING_RATE = 15.0
# The rate of a held particle times the time step is at most this.
MAX_TURN = 0.1


@dataclass(frozen=True)
class Hold:
    """What a hand holds, and where it wants it."""

    body: str
    particles: np.ndarray
    """Numbers in the body, int [held_count]."""
    weights: np.ndarray
    """How firmly each is held, 0 to 1, float64 [held_count]."""
    offsets: np.ndarray
    """Where each is wanted relative to the hand, float64 [3, held_count], m."""
    hand: np.ndarray
    """Where the hand is, float64 [3], m."""


class Grip:
    """The hand of a simulation: a damped spring for each particle that it holds.

    A particle of mass m and weight w gets the stiffness k = w m r^2 and the damping c = 2 w m r, critical for w = 1,
    with one rate r for all. So k / m = w r^2 and c / m = 2 w r, whatever the masses. With r dt <= q = MAX_TURN they
    take dt^2 k/m + 2 dt c/m <= q^2 + 4 q = 0.41 of the 4 that semi-implicit Euler has for everything together (see
    stability.py), a tenth, and as little of what Runge-Kutta schemes have. Below that the rate is such that the held
    particles carry the whole body of mass M: M SWING_RATE^2 = sum(w m) r^2.

    Args:
        model: what is simulated.
        state: where it is.
        dt: the time step, s.
    """

    def __init__(self, model: Model, state: State, *, dt: float) -> None:
        self._model = model
        self._state = state
        self._dt = dt
        self.hold: Hold | None = None
        """What is held now."""
        with wp.ScopedDevice(state.x.device):
            self.count = wp.zeros(1, dtype=wp.int32)
            self.particles = wp.zeros(MAX_HELD, dtype=wp.int32)
            self.stiffness, self.damping = (wp.zeros(MAX_HELD, dtype=model.real) for _ in range(2))
            self.places = wp.zeros((3, MAX_HELD), dtype=model.real)

    def grab(self, body: str, point: np.ndarray) -> None:
        """Take hold of the particles of a body that are nearest to a point [3], m, and want them where they are.

        Raises:
            InputError: the body cannot be moved, as all of it is pinned.
        """
        own = self._body(body).particles
        free = np.flatnonzero(self._model.particle_inv_mass.numpy()[own] > 0.0)
        if not len(free):
            raise InputError(f"bodies.{body}: cannot be pulled, as all of its particles are pinned")
        away = self._state.x.numpy()[:, own][:, free].astype(float) - point[:, None]
        count = min(max(1, round(HELD_SHARE * len(free))), MAX_HELD)
        distance = np.linalg.norm(away, axis=0)
        # Particles at one distance by their numbers, so that the same are held each time.
        nearest = np.sort(np.argsort(distance, kind="stable")[:count])
        # Firmly in the middle, hardly at the rim.
        beyond = distance[nearest] ** 2 - distance[nearest].min() ** 2
        weights = 1.0 - beyond / (beyond.max() * (1.0 + 1.0 / count) or 1.0)
        self._take(Hold(body, free[nearest], weights, away[:, nearest], point))

    def move(self, hand: np.ndarray) -> None:
        """Move the hand to a point [3], m."""
        assert self.hold is not None
        hold = self.hold
        self.hold = Hold(hold.body, hold.particles, hold.weights, hold.offsets, hand)
        self._place(self.hold)

    def release(self) -> None:
        """Let go."""
        self.hold = None
        self.count.zero_()

    def go_on(self, hold: Hold) -> None:
        """Hold what another simulation's hand held, of a body with as many particles."""
        self._take(hold)

    def point(self) -> np.ndarray:
        """Return where the hand would be if nothing pulled: what was grabbed is there now, float64 [3], m."""
        assert self.hold is not None
        x = self._state.x.numpy()[:, self._body(self.hold.body).particles.start + self.hold.particles].astype(float)
        return np.asarray((x - self.hold.offsets) @ (self.hold.weights / self.hold.weights.sum()))

    def force(self) -> np.ndarray:
        """Return the force of the hand on the body now, float64 [3], N."""
        count = 0 if self.hold is None else len(self.hold.particles)
        chosen = self.particles.numpy()[:count]
        x, v = (rows.numpy()[:, chosen].astype(float) for rows in (self._state.x, self._state.v))
        offset = x - self.places.numpy()[:, :count]
        return np.asarray(-(self.stiffness.numpy()[:count] * offset + self.damping.numpy()[:count] * v).sum(axis=1))

    def _take(self, hold: Hold) -> None:
        own = self._body(hold.body).particles
        chosen = own.start + hold.particles
        mass, inv_mass = (
            array.numpy().astype(float) for array in (self._model.particle_mass, self._model.particle_inv_mass)
        )
        held = hold.weights * mass[chosen] * (inv_mass[chosen] > 0.0)
        moved = mass[own][inv_mass[own] > 0.0].sum()
        wanted = SWING_RATE * math.sqrt(moved / held.sum()) if held.sum() > 0.0 else 0.0
        rate = min(wanted, MAX_TURN / self._dt)
        count = len(chosen)
        for array, values in (
            (self.particles, chosen),
            (self.stiffness, held * rate**2),
            (self.damping, 2.0 * held * rate),
        ):
            array.assign(np.pad(values, (0, MAX_HELD - count)).astype(array.numpy().dtype))
        self.hold = hold
        self._place(hold)
        self.count.assign([count])

    def _place(self, hold: Hold) -> None:
        places = hold.hand[:, None] + hold.offsets
        self.places.assign(np.pad(places, ((0, 0), (0, MAX_HELD - places.shape[1]))).astype(self.places.numpy().dtype))

    def _body(self, name: str) -> Body:
        return next(body for body in self._model.bodies if body.name == name)
