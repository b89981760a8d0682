"""Bodies that are not made of cells: springs between given points, and sheets of cloth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warpjelly.kernels.lattices import BEND, FACE_SHEAR, STRUCTURAL
from warpjelly.kernels.springs import MAX_SPAN

from .lattice import Lattice, SpringClasses, order_spans

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
    return Lattice(
        places=particles,
        spans=_join_runs(ends, rows.reshape(-1)),
        classes=SpringClasses(table[:, 0].astype(int), table[:, 1], np.ones((len(table), 1))),
        cell_counts=np.ones((1, len(particles)), np.uint8),
        unit=float(rest.min()) if len(rest) else 1.0,
        surface_particles=np.arange(len(particles), dtype=np.int32),
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
        places=np.stack([*np.meshgrid(x, [0.0], z, indexing="ij")], axis=-1).reshape(-1, 3),
        spans=_join_runs(
            np.concatenate([np.stack([first.ravel(), second.ravel()], axis=1) for _, _, first, second in families]),
            np.repeat(np.arange(len(families)), [first.size for _, _, first, _ in families]),
        ),
        classes=SpringClasses(
            np.array([kind for kind, *_ in families]),
            np.array([rest for _, rest, *_ in families]),
            np.ones((len(families), 1)),
        ),
        cell_counts=np.ones((1, number.size), np.uint8),
        unit=min(along_x, along_z),
        surface_particles=number.ravel(),
        surface_quads=np.stack([corner.ravel() for corner in corners], axis=1),
    )


def _join_runs(ends: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Join springs whose two ends both advance by one, int32 [span_count, 4] = (i, j, count, class).

    Args:
        ends: particles of each spring, int32 [spring_count, 2].
        classes: class of each spring, int [spring_count].
    """
    if len(ends) == 0:
        return np.zeros((0, 4), np.int32)
    first, second = ends.T
    breaks = np.flatnonzero((np.diff(first) != 1) | (np.diff(second) != 1) | (np.diff(classes) != 0)) + 1
    start = np.concatenate([[0], breaks])
    length = np.diff(np.append(start, len(ends)))
    # Long runs are cut into pieces of MAX_SPAN.
    pieces = -(-length // MAX_SPAN)
    piece = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin = np.repeat(start, pieces) + MAX_SPAN * piece
    end = np.minimum(begin + MAX_SPAN, np.repeat(start + length, pieces))
    return order_spans(np.stack([first[begin], second[begin], end - begin, classes[begin]], axis=1).astype(np.int32))
