"""Where the particles of a body start, how fast, and how heavy they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .errors import SceneError
from .lattice import Lattice
from .scene import DEFAULT_PARTICLE_MASS, AnyBody, CubeBody, Material

# Boxes of pinned particles are grown by this share of a unit cell, so that rounding decides nothing.
PIN_MARGIN = 1e-6
# Particles that are dealt with at a time: in float64, all of a large body would take more memory than its simulation.
BLOCK = 1 << 18


def place_body(
    lattice: Lattice,
    materials: Sequence[Material],
    body: AnyBody,
    *,
    x: np.ndarray,
    v: np.ndarray,
    mass: np.ndarray,
    inv_mass: np.ndarray,
) -> np.ndarray:
    """Overwrite what the particles of a body start with.

    Args:
        lattice: what the body is made of.
        materials: of its cells.
        body: where it is, and what is pinned of it.
        x: positions, real [3, particle_count], m.
        v: velocities, m/s.
        mass: real [particle_count], kg.
        inv_mass: 1/kg; 0 where pinned.

    Returns:
        The centre of mass, float64 [3], m.

    Raises:
        SceneError: an entry pins a particle that does not exist, or none at all.
    """
    pinned = _pinned(lattice, body)
    moment, total = np.zeros(3), 0.0
    for part in _blocks(len(mass)):
        weights, places = _masses(lattice, materials, part), _positions(lattice, body, part)
        x[:, part], mass[part] = places.T, weights
        inv_mass[part] = np.where(pinned[part], 0.0, 1.0 / weights)
        moment += weights @ places
        total += weights.sum()
    center = moment / total
    for part in _blocks(len(mass)):
        v[:, part] = np.where(pinned[part], 0.0, _velocities(lattice, body, part, center).T)
    return center


def _blocks(count: int) -> Iterator[slice]:
    return (slice(start, min(start + BLOCK, count)) for start in range(0, count, BLOCK))


def _masses(lattice: Lattice, materials: Sequence[Material], part: slice) -> np.ndarray:
    """Return the mass of some particles, float64 [count], kg.

    Each cell that shares a particle adds an eighth of its mass or, with ``particle_mass``, its part of a mean.
    """
    counts = lattice.cell_counts[:, part]
    mass = np.zeros(counts.shape[1])
    for material, cells in zip(materials, counts, strict=True):
        if material.density is not None:
            mass += material.density * lattice.unit**3 / 8.0 * cells
        else:
            given = DEFAULT_PARTICLE_MASS if material.particle_mass is None else material.particle_mass
            mass += given * (cells / counts.sum(axis=0))
    return mass


def _positions(lattice: Lattice, body: AnyBody, part: slice) -> np.ndarray:
    """Return where some particles start, float64 [count, 3], m."""
    if isinstance(body, CubeBody) and body.positions is not None:
        return np.array(body.positions[part])
    return lattice.positions(part) @ _turn(body).T + body.position


def _velocities(lattice: Lattice, body: AnyBody, part: slice, center: np.ndarray) -> np.ndarray:
    """Return how fast some particles of a body with this centre of mass start, float64 [count, 3] or [1, 3], m/s."""
    if isinstance(body, CubeBody) and body.velocities is not None:
        return np.array(body.velocities[part])
    velocity = np.array([body.velocity])
    if any(body.angular_velocity):
        velocity = velocity + np.cross(body.angular_velocity, _positions(lattice, body, part) - center)
    return velocity


def _turn(body: AnyBody) -> np.ndarray:
    """Return the rotation of a body, [3, 3]."""
    turn = np.eye(3)
    for axis, angle in enumerate(np.radians(body.rotation)):
        u, w = (axis + 1) % 3, (axis + 2) % 3
        about = np.eye(3)
        about[[u, w], [u, w]] = np.cos(angle)
        about[w, u], about[u, w] = np.sin(angle), -np.sin(angle)
        turn = about @ turn
    return turn


def _pinned(lattice: Lattice, body: AnyBody) -> np.ndarray:
    """Return which particles never move, bool [particle_count].

    Raises:
        SceneError: an entry pins a particle that does not exist, or none at all.
    """
    count = lattice.particle_count
    pinned = np.zeros(count, bool)
    for number, pin in enumerate(body.pinned):
        key = f"bodies.{body.name}.pinned.{number}"
        if pin.indices is not None:
            if max(pin.indices) >= count:
                raise SceneError(f"{key}.indices: no particle {max(pin.indices)}; they are 0 to {count - 1}")
            pinned[pin.indices] = True
            continue
        margin = PIN_MARGIN * lattice.unit
        lower, upper = np.array(pin.lower) - margin, np.array(pin.upper) + margin
        found = False
        for part in _blocks(count):
            x = lattice.positions(part)
            inside = ((x >= lower) & (x <= upper)).all(axis=1)
            pinned[part] |= inside
            found |= bool(inside.any())
        if not found:
            x = lattice.particles
            low, high = (np.array2string(corner, precision=4, separator=", ") for corner in (x.min(0), x.max(0)))
            raise SceneError(f"{key}: pins no particle; the body reaches from {low} to {high} m in its own frame")
    return pinned
