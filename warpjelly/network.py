"""Bodies that are not made of cells: springs between given points, and sheets of cloth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .lattice import BEND, FACE_SHEAR, STRUCTURAL, Lattice, SpringClasses

# Structural, shear and bend springs in the order of the scene file; a body diagonal is a thing of cells.
_KINDS = (STRUCTURAL, FACE_SHEAR, BEND)


def build_network(
    points: Sequence[Sequence[float]],
    springs: Sequence[Sequence[tuple[int, int]]],
    rest_lengths: Sequence[float] | None = None,
) -> Lattice:
    """Join points by springs.

    Args:
        points: where the particles start, [particle_count, 3], m.
        springs: both ends of the structural, the shear and the bend springs.
        rest_lengths: one for each spring in that order, m; the distances of the points unless given.
    """
    particles = np.array(points, float)
    ends = np.array([pair for pairs in springs for pair in pairs], np.int32).reshape(-1, 2)
    kinds = np.repeat(_KINDS, [len(pairs) for pairs in springs])
    if rest_lengths is None:
        rest = np.linalg.norm(particles[ends[:, 1]] - particles[ends[:, 0]], axis=1)
    else:
        rest = np.array(rest_lengths, float)
    table, rows = np.unique(np.stack([kinds, rest], axis=1), axis=0, return_inverse=True)
    # A particle without springs is shown as one of no length.
    lone = np.setdiff1d(np.arange(len(particles)), ends)
    return Lattice(
        particles=particles,
        springs=ends,
        spring_classes=rows.reshape(-1),
        classes=SpringClasses(table[:, 0].astype(int), table[:, 1]),
        cell_counts=np.zeros(len(particles), np.int32),
        unit=float(rest.min()) if len(rest) else 1.0,
        surface_particles=np.append(ends.ravel(), np.repeat(lone, 2)).astype(np.int32),
        surface_quads=np.zeros((0, 4), np.int32),
    )


def build_cloth(size: tuple[float, float], particles: tuple[int, int]) -> Lattice:
    """Make a rectangular sheet in the x-z plane around the origin; particles in scan order, z fastest.

    Args:
        size: sides along x and z, m.
        particles: how many of them along the sides, at least 2 each.
    """
    number = np.arange(particles[0] * particles[1], dtype=np.int32).reshape(particles)
    x, z = (np.linspace(-side / 2, side / 2, count) for side, count in zip(size, particles, strict=True))
    along_x, along_z = (side / (count - 1) for side, count in zip(size, particles, strict=True))
    families = [
        (STRUCTURAL, along_x, number[:-1], number[1:]),
        (STRUCTURAL, along_z, number[:, :-1], number[:, 1:]),
        (FACE_SHEAR, math.hypot(along_x, along_z), number[:-1, :-1], number[1:, 1:]),
        (FACE_SHEAR, math.hypot(along_x, along_z), number[:-1, 1:], number[1:, :-1]),
        (BEND, 2 * along_x, number[:-2], number[2:]),
        (BEND, 2 * along_z, number[:, :-2], number[:, 2:]),
    ]
    corners = [number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]]
    return Lattice(
        particles=np.stack([*np.meshgrid(x, [0.0], z, indexing="ij")], axis=-1).reshape(-1, 3),
        springs=np.concatenate([np.stack([first.ravel(), second.ravel()], axis=1) for _, _, first, second in families]),
        spring_classes=np.repeat(np.arange(len(families), dtype=np.uint8), [first.size for _, _, first, _ in families]),
        classes=SpringClasses(np.array([kind for kind, *_ in families]), np.array([rest for _, rest, *_ in families])),
        cell_counts=np.zeros(number.size, np.int32),
        unit=min(along_x, along_z),
        surface_particles=number.ravel(),
        surface_quads=np.stack([corner.ravel() for corner in corners], axis=1),
        double_sided=True,
    )
