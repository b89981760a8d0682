"""Soft against soft: particles of the skin push each other apart, along the line of centres, with friction.

A particle is a ball of half a unit cell's edge. Two of one body never touch where they were close at rest: nearer than
their radii, or joined by a spring. Each particle sums the forces of its neighbours itself; what two do to each other is
the same up to the sign, bit for bit, so that momentum is kept to rounding and no atomic adds are needed.
"""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})

# The search radius is grown by this share, so that rounding in the grid never hides a pair.
SEARCH_MARGIN = 1e-5
# Nearer than the sum of radii at rest is nearer by more than this share, far above the rounding of places at rest.
REST_MARGIN = 1e-3
# Farther from the origin than this [m], no cell of the grid has a number.
LOST = 1e7


@wp.kernel
def gather_skin(
    # Model:
    skin: wp.array(dtype=wp.int32),
    # State in:
    x: wp.array2d(dtype=Any),
    # Out:
    points: wp.array(dtype=Any),
):
    """Overwrite the positions of the skin's particles, for the grid to be built over.

    The grid cannot take numbers that are not finite: whoever is lost is put at the origin, to be found after the frame.
    """
    point = wp.tid()
    position = vectors.load(x, skin[point])
    if not (wp.length(position) < type(position[0])(LOST)):
        position = type(position[0])(0.0) * points[point]
    points[point] = position


@wp.func
def pair_force(offset: Any, velocity: Any, reach: Any, stiffness: Any, damping: Any, friction: Any, mass: Any, dt: Any):
    """Return what a particle feels of another one within reach, as (force, overlap).

    Args:
        offset: its position relative to the other, m.
        velocity: its velocity relative to the other, m/s.
        reach: sum of both radii, m.
        stiffness: N/m of overlap.
        damping: N s/m along the line of centres.
        friction: share of the normal force.
        mass: reduced mass of both, kg; friction never does more than stop the sliding within the step.
        dt: step, s.
    """
    zero = type(reach)(0.0)
    distance = wp.length(offset)
    overlap = reach - distance
    force = zero * offset
    # Centres that coincide for a moment have no direction, hence no force.
    if overlap > zero and distance > zero:
        normal = offset / distance
        speed = wp.dot(velocity, normal)
        push = wp.max(zero, stiffness * overlap - damping * speed)
        sliding = velocity - speed * normal
        slip = wp.length(sliding)
        force = push * normal
        if slip > zero:
            force -= sliding * (wp.min(friction * push, mass * slip / dt) / slip)
    return force, overlap


@wp.func
def are_joined(neighbor_start: wp.array(dtype=wp.int32), neighbors: wp.array(dtype=wp.int32), a: int, b: int):
    """Say whether a spring joins two points of the skin."""
    joined = bool(False)
    for k in range(neighbor_start[a], neighbor_start[a + 1]):
        if neighbors[k] == b:
            joined = True
    return joined


@wp.func
def may_collide(
    skin_body: wp.array(dtype=wp.int32),
    skin_rest: wp.array(dtype=Any),
    neighbor_start: wp.array(dtype=wp.int32),
    neighbors: wp.array(dtype=wp.int32),
    with_itself: bool,
    reach: Any,
    a: int,
    b: int,
):
    """Say whether two points of the skin collide when they meet."""
    collide = bool(True)
    if skin_body[a] == skin_body[b]:
        collide = with_itself
        if collide:
            # Opposite walls of a gap of one cell are exactly that far apart at rest: rounding must not decide.
            apart = reach * type(reach)(1.0 - REST_MARGIN)
            collide = wp.length(skin_rest[a] - skin_rest[b]) >= apart and not are_joined(
                neighbor_start, neighbors, a, b
            )
    return collide


@wp.kernel
def add_pair_forces(
    # Model:
    skin: wp.array(dtype=wp.int32),
    skin_body: wp.array(dtype=wp.int32),
    skin_radius: wp.array(dtype=Any),
    skin_rest: wp.array(dtype=Any),
    neighbor_start: wp.array(dtype=wp.int32),
    neighbors: wp.array(dtype=wp.int32),
    response: wp.array(dtype=Any),
    mass: wp.array(dtype=Any),
    # State in:
    grid: wp.uint64,
    points: wp.array(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    with_itself: bool,
    greatest_radius: Any,
    dt: Any,
    loss_weight: Any,
    # State out:
    f: wp.array2d(dtype=Any),
    losses: wp.array2d(dtype=wp.float64),
):
    """Add the forces on each particle of the skin, one thread each.

    ``response`` [1] is stiffness [N/m], damping [N s/m] and friction. Losses [2, point_count] gain each particle's half
    of the power of damping and of friction times loss_weight.
    """
    a = wp.tid()
    i = skin[a]
    point = points[a]
    total = type(dt)(0.0) * point
    damped = wp.float64(0.0)
    rubbed = wp.float64(0.0)
    half = wp.float64(0.5) * wp.float64(loss_weight)
    c = response[0]
    search = (skin_radius[a] + greatest_radius) * type(dt)(1.0 + SEARCH_MARGIN)
    query = wp.hash_grid_query(grid, point, search)
    b = wp.int32(0)
    while wp.hash_grid_query_next(query, b):
        if b != a:
            offset = point - points[b]
            reach = skin_radius[a] + skin_radius[b]
            if wp.length(offset) < reach and may_collide(
                skin_body, skin_rest, neighbor_start, neighbors, with_itself, reach, a, b
            ):
                j = skin[b]
                velocity = vectors.load(v, i) - vectors.load(v, j)
                reduced = mass[i] * mass[j] / (mass[i] + mass[j])
                force, overlap = pair_force(offset, velocity, reach, c[0], c[1], c[2], reduced, dt)
                total += force
                normal = wp.normalize(offset)
                push = wp.dot(force, normal)
                speed = wp.dot(velocity, normal)
                damped -= wp.float64((push - c[0] * overlap) * speed)
                rubbed -= wp.float64(wp.dot(force - push * normal, velocity))
    vectors.store(f, i, vectors.load(f, i) + total)
    losses[0, a] += half * damped
    losses[1, a] += half * rubbed


@wp.kernel
def measure_pairs(
    # Model:
    skin_body: wp.array(dtype=wp.int32),
    skin_radius: wp.array(dtype=Any),
    skin_rest: wp.array(dtype=Any),
    neighbor_start: wp.array(dtype=wp.int32),
    neighbors: wp.array(dtype=wp.int32),
    response: wp.array(dtype=Any),
    # State in:
    grid: wp.uint64,
    points: wp.array(dtype=Any),
    # In:
    with_itself: bool,
    greatest_radius: Any,
    # Out:
    energy: wp.array(dtype=wp.float64),
):
    """Overwrite each point's half of the energy stored in its overlaps, 1/2 k overlap^2, [point_count], J."""
    a = wp.tid()
    point = points[a]
    stored = wp.float64(0.0)
    query = wp.hash_grid_query(
        grid, point, (skin_radius[a] + greatest_radius) * type(greatest_radius)(1.0 + SEARCH_MARGIN)
    )
    b = wp.int32(0)
    while wp.hash_grid_query_next(query, b):
        if b != a:
            reach = skin_radius[a] + skin_radius[b]
            overlap = reach - wp.length(point - points[b])
            if overlap > type(reach)(0.0) and may_collide(
                skin_body, skin_rest, neighbor_start, neighbors, with_itself, reach, a, b
            ):
                stored += wp.float64(0.25) * wp.float64(response[0][0] * overlap * overlap)
    energy[a] = stored
