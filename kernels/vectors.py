"""Vectors in structure-of-arrays storage: ``[3, count]``, one row per component."""

from typing import Any

import warp as wp


@wp.func
def load(q: wp.array2d(dtype=Any), i: int):
    """Return column i of q."""
    return wp.vector(q[0, i], q[1, i], q[2, i])


@wp.func
def store(q: wp.array2d(dtype=Any), i: int, value: Any):
    """Overwrite column i of q."""
    q[0, i] = value[0]
    q[1, i] = value[1]
    q[2, i] = value[2]


@wp.func
def add(q: wp.array2d(dtype=Any), i: int, value: Any):
    """Add to column i of q, atomically."""
    wp.atomic_add(q, 0, i, value[0])
    wp.atomic_add(q, 1, i, value[1])
    wp.atomic_add(q, 2, i, value[2])
