"""Soft against soft: particles of the skin push each other apart, along the line of centres, with friction.

A particle is a ball of half a unit cell's edge. Two of one body never touch where they were close at rest: nearer than
their radii, or joined by a spring. Each particle sums the forces of its neighbours itself; what two do to each other is
the same up to the sign, bit for bit, so that momentum is kept to rounding and no atomic adds are needed. Far from every
other body, by the boxes of chunks, nobody searches for neighbours.
"""

from typing import Any

import warp as wp

from . import bounds, turns, vectors

wp.set_module_options({"enable_backward": False})

# The search radius is grown by this share, so that rounding in the grid never hides a pair.
SEARCH_MARGIN = 1e-5
# Nearer than the sum of radii at rest is nearer by more than this share, far above the rounding of places at rest.
REST_MARGIN = 1e-3
# Members of the skin that a thread of a CPU deals with at a time, and a block of a GPU at once.
GROUP = 256


def _skin_struct(real: type) -> Any:
    @wp.struct
    class Skin:
        particles: wp.array(dtype=wp.int32)  # [skin_count]
        body: wp.array(dtype=wp.int32)  # [skin_count]
        chunk: wp.array(dtype=wp.int32)  # [skin_count]
        radius: wp.array(dtype=real)  # [skin_count] m
        rest: wp.array(dtype=wp.types.vector(3, real))  # [skin_count] place at rest in the frame of the body, m
        neighbor_start: wp.array(dtype=wp.int32)  # [skin_count + 1] first neighbour of each, and the end of the last
        neighbors: wp.array(dtype=wp.int32)  # [neighbor_count] members of the skin that springs join to each
        greatest_radius: real  # m
        stiffness: real  # N/m of overlap
        damping: real  # N s/m along the line of centres
        friction: real  # share of the normal force
        with_itself: wp.bool  # whether particles of one body collide

    return Skin


# The particles that collide with others, by precision; the same members, so that kernels take either.
SKIN = {wp.float32: _skin_struct(wp.float32), wp.float64: _skin_struct(wp.float64)}


@wp.kernel
def find_meetings(
    # Model:
    chunk_body: wp.array(dtype=wp.int32),
    body_chunk_start: wp.array(dtype=wp.int32),
    skin: Any,
    # State in:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
    body_lower: wp.array2d(dtype=Any),
    body_upper: wp.array2d(dtype=Any),
    # Out:
    near_lower: wp.array2d(dtype=Any),
    near_upper: wp.array2d(dtype=Any),
    found: wp.array(dtype=wp.int32),
):
    """Overwrite the box [3, chunk_count] around what each chunk may touch, one thread per chunk.

    That is the box around those chunks of other bodies which are within reach; without any, nothing is within reach of
    it. With any, found[0] becomes 1.
    """
    chunk = wp.tid()
    body = chunk_body[chunk]
    low = vectors.load(lower, chunk)
    high = vectors.load(upper, chunk)
    infinity = type(low[0])(wp.inf)
    near_low = wp.vector(infinity, infinity, infinity)
    near_high = -near_low
    reach = search_radius(skin, skin.greatest_radius)
    for other in range(body_lower.shape[1]):
        if other != body and bounds.are_near(
            low, high, vectors.load(body_lower, other), vectors.load(body_upper, other), reach
        ):
            for c in range(body_chunk_start[other], body_chunk_start[other + 1]):
                other_low = vectors.load(lower, c)
                other_high = vectors.load(upper, c)
                if bounds.are_near(low, high, other_low, other_high, reach):
                    near_low = wp.min(near_low, other_low)
                    near_high = wp.max(near_high, other_high)
                    found[0] = 1
    vectors.store(near_lower, chunk, near_low)
    vectors.store(near_upper, chunk, near_high)


@wp.kernel
def gather_skin(
    # Model:
    skin: Any,
    # State in:
    x: wp.array2d(dtype=Any),
    # Out:
    points: wp.array(dtype=Any),
):
    """Overwrite the positions of the skin's particles, for the grid to be built over."""
    a = wp.tid()
    points[a] = vectors.load(x, skin.particles[a])


@wp.func
def search_radius(skin: Any, radius: Any):
    """Return how far from a particle of some radius the centres of those are that it may touch, m."""
    return (radius + skin.greatest_radius) * type(radius)(1.0 + SEARCH_MARGIN)


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
def are_joined(skin: Any, a: int, b: int):
    """Say whether a spring joins two points of the skin."""
    joined = bool(False)
    for k in range(skin.neighbor_start[a], skin.neighbor_start[a + 1]):
        if skin.neighbors[k] == b:
            joined = True
    return joined


@wp.func
def may_collide(skin: Any, reach: Any, a: int, b: int):
    """Say whether two points of the skin collide when they meet."""
    collide = bool(True)
    if skin.body[a] == skin.body[b]:
        collide = skin.with_itself
        if collide:
            # Opposite walls of a gap of one cell are exactly that far apart at rest: rounding must not decide.
            apart = reach * type(reach)(1.0 - REST_MARGIN)
            collide = wp.length(skin.rest[a] - skin.rest[b]) >= apart and not are_joined(skin, a, b)
    return collide


@wp.kernel
def add_pair_forces(
    # Threads:
    turn: turns.Turn,
    # How many lanes share a group:
    lanes: int,
    # Model:
    skin: Any,
    mass: wp.array(dtype=Any),
    inv_mass: wp.array(dtype=Any),
    # State in:
    near_lower: wp.array2d(dtype=Any),
    near_upper: wp.array2d(dtype=Any),
    found: wp.array(dtype=wp.int32),
    grid: wp.uint64,
    points: wp.array(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    dt: Any,
    loss_weight: Any,
    ahead: Any,
    culling: bool,
    # State out:
    f: wp.array2d(dtype=Any),
    losses: wp.array2d(dtype=wp.float64),
):
    """Add the forces on each particle of the skin; launched over (group of GROUP of them, lane).

    With culling, only particles near what their chunk may touch look for others, and none where nobody was found near
    anybody. Losses [2, skin_count] gain what damping and friction take from each particle, at the velocity that the
    forces so far make some time ahead, times loss_weight; only the sum over both particles of a pair is the same for
    who moves along.
    """
    group, lane = wp.tid()
    task = group * lanes + lane
    mine = turns.take(turn, task)
    begin = group * GROUP
    end = wp.min(begin + GROUP, points.shape[0])
    if not mine or (culling and found[0] == 0):
        end = begin
    for a in range(begin + lane, end, lanes):
        point = points[a]
        chunk = skin.chunk[a]
        search = search_radius(skin, skin.radius[a])
        near_low = vectors.load(near_lower, chunk)
        near_high = vectors.load(near_upper, chunk)
        if culling and not bounds.are_near(point, point, near_low, near_high, search):
            continue
        i = skin.particles[a]
        total = type(dt)(0.0) * point
        damping = type(dt)(0.0) * point
        rubbing = type(dt)(0.0) * point
        touches = bool(False)
        query = wp.hash_grid_query(grid, point, search)
        b = wp.int32(0)
        while wp.hash_grid_query_next(query, b):
            if b != a:
                offset = point - points[b]
                reach = skin.radius[a] + skin.radius[b]
                if wp.length(offset) < reach and may_collide(skin, reach, a, b):
                    touches = True
                    j = skin.particles[b]
                    velocity = vectors.load(v, i) - vectors.load(v, j)
                    reduced = mass[i] * mass[j] / (mass[i] + mass[j])
                    force, overlap = pair_force(
                        offset, velocity, reach, skin.stiffness, skin.damping, skin.friction, reduced, dt
                    )
                    total += force
                    normal = wp.normalize(offset)
                    push = wp.dot(force, normal)
                    damping += (push - skin.stiffness * overlap) * normal
                    rubbing += force - push * normal
        # Adding nothing would still turn -0 into 0, and culling would be seen in the bits.
        if touches:
            so_far = vectors.load(f, i) + total
            vectors.store(f, i, so_far)
            velocity = vectors.load(v, i) + ahead * inv_mass[i] * so_far
            losses[0, a] -= wp.float64(loss_weight) * wp.float64(wp.dot(damping, velocity))
            losses[1, a] -= wp.float64(loss_weight) * wp.float64(wp.dot(rubbing, velocity))
    turns.leave(turn, task, mine)


@wp.kernel
def measure_overlaps(
    # Model:
    skin: Any,
    # State in:
    grid: wp.uint64,
    points: wp.array(dtype=Any),
    # Out:
    energy: wp.array(dtype=wp.float64),
    overlaps: wp.array(dtype=wp.float64),
):
    """Overwrite each point's half of the energy stored in its overlaps, 1/2 k overlap^2, J, and the greatest, m."""
    a = wp.tid()
    point = points[a]
    stored = wp.float64(0.0)
    greatest = wp.float64(0.0)
    query = wp.hash_grid_query(grid, point, search_radius(skin, skin.radius[a]))
    b = wp.int32(0)
    while wp.hash_grid_query_next(query, b):
        if b != a:
            reach = skin.radius[a] + skin.radius[b]
            overlap = reach - wp.length(point - points[b])
            if overlap > type(reach)(0.0) and may_collide(skin, reach, a, b):
                stored += wp.float64(0.25) * wp.float64(skin.stiffness * overlap * overlap)
                greatest = wp.max(greatest, wp.float64(overlap))
    energy[a] = stored
    overlaps[a] = greatest
