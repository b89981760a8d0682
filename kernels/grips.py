"""Pulling particles by hand: each is drawn to a place by a spring and a damper."""

from typing import Any

import warp as wp

from . import turns, vectors

wp.set_module_options({"enable_backward": False})


@wp.func
def grip_force(offset: Any, velocity: Any, stiffness: Any, damping: Any):
    """Return the force on a particle that is an offset [m] away from where it is wanted."""
    return -(stiffness * offset + damping * velocity)


@wp.kernel
def add_grip_forces(
    # Threads:
    turn: turns.Turn,
    lanes: int,
    # Grip:
    count: wp.array(dtype=wp.int32),
    particles: wp.array(dtype=wp.int32),
    stiffness: wp.array(dtype=Any),
    damping: wp.array(dtype=Any),
    places: wp.array2d(dtype=Any),
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # State in and out:
    f: wp.array2d(dtype=Any),
):
    """Add the pull on count[0] particles, which differ; lane k takes the k-th, the (k + lanes)-th ... of them.

    Where they are wanted is an array [3, capacity], m, and everything else one [capacity], so that a captured launch
    takes what is in them at the time of its replay.
    """
    lane = wp.tid()
    mine = turns.take(turn, lane)
    last = count[0]
    if not mine:
        last = 0
    for k in range(lane, last, lanes):
        i = particles[k]
        offset = vectors.load(x, i) - vectors.load(places, k)
        force = grip_force(offset, vectors.load(v, i), stiffness[k], damping[k])
        vectors.store(f, i, vectors.load(f, i) + force)
    turns.leave(turn, lane, mine)
