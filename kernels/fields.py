"""Forces that act on every particle."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def set_gravity_forces(
    # Model:
    mass: wp.array(dtype=Any),
    gravity: wp.array(dtype=Any),
    # State out:
    f: wp.array2d(dtype=Any),
):
    """Overwrite the forces with the weight of each particle; gravity is one vector [m/s^2]."""
    i = wp.tid()
    vectors.store(f, i, mass[i] * gravity[0])
