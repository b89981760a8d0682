"""Time integration, in place."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def semi_implicit_euler(
    # Model:
    inv_mass: wp.array(dtype=Any),
    # State in:
    f: wp.array2d(dtype=Any),
    # In:
    dt: Any,
    # State in and out:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
):
    """Advance by dt: first the velocities by the forces, then the positions by the new velocities."""
    i = wp.tid()
    velocity = vectors.load(v, i) + dt * inv_mass[i] * vectors.load(f, i)
    vectors.store(v, i, velocity)
    vectors.store(x, i, vectors.load(x, i) + dt * velocity)
