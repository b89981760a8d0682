"""Penalty contact with half-spaces, finite planes and spheres: a spring and a damper along the normal, and friction.

A box that bodies stay inside is six half-spaces. Beside the current point, contact looks at where the particle was one
step earlier: a particle that crossed a plane within the step is caught, however fast, and one that entered a sphere is
pushed back to where it came in. A contact lasts from step to step; a stamp with the number of the step in which it was
last seen says so, and goes out of date by itself where culling skips the test.
"""

from typing import Any

import warp as wp

from . import bounds, turns, vectors

wp.set_module_options({"enable_backward": False})

HALF_SPACE = wp.constant(0)
PLANE = wp.constant(1)
SPHERE = wp.constant(2)

# Slower than this [m/s] along a surface, a particle rests, and static friction may hold it. It is far below what
# gravity gives in a millisecond, and far above what rounding leaves of a particle that was stopped.
REST_SPEED = 1e-4
# Particles that are looked at together, in one vector instruction, before each of them is.
GROUP = 8
# Lanes per chunk where a launch runs in parallel; where it runs one thread after another, one lane is best.
PARALLEL_LANES = 32


def _colliders_struct(real: type) -> Any:
    vector = wp.types.vector(3, real)

    @wp.struct
    class Colliders:
        kind: wp.array(dtype=wp.int32)  # [collider_count] HALF_SPACE, PLANE or SPHERE
        center: wp.array(dtype=vector)  # [collider_count] m
        tangent: wp.array(dtype=vector)  # [collider_count] unit; first side of a plane
        bitangent: wp.array(dtype=vector)  # [collider_count] unit; second side of a plane
        normal: wp.array(dtype=vector)  # [collider_count] unit, outward; for a sphere, the direction used at its centre
        size: wp.array(dtype=vector)  # [collider_count] m; plane: half sides and threshold; sphere: radius first
        lower: wp.array(dtype=vector)  # [collider_count] m; box around a sphere
        upper: wp.array(dtype=vector)  # [collider_count] m
        stiffness: wp.array(dtype=real)  # [collider_count] N/m
        damping: wp.array(dtype=real)  # [collider_count] N s/m
        static_friction: wp.array(dtype=real)  # [collider_count] share of the normal reaction
        dynamic_friction: wp.array(dtype=real)  # [collider_count] share of the normal reaction
        pulls: wp.array(dtype=wp.int32)  # [collider_count] 1 where the damper may pull a particle that leaves
        entry_normal: wp.array(dtype=wp.int32)  # [collider_count] 1 for spheres that push back to where one came in
        normal_force_term: wp.array(dtype=wp.int32)  # [collider_count] 1 to add what presses the particle in
        applied_friction: wp.array(dtype=wp.int32)  # [collider_count] 1 to take friction from what presses it in
        slot: wp.array(dtype=wp.int32)  # [collider_count] row of the memory of contacts, -1 without
        side: wp.array2d(dtype=real)  # [collider_count, body_count] -1 to keep a body behind a half-space, else 1

    return Colliders


# The table of colliders by precision; the same members, so that kernels take either.
COLLIDERS = {wp.float32: _colliders_struct(wp.float32), wp.float64: _colliders_struct(wp.float64)}


@wp.func
def in_rectangle(colliders: Any, c: int, local: Any):
    """Say whether the projection of a point, relative to the centre, lies in the rectangle of plane c."""
    size = colliders.size[c]
    return wp.abs(wp.dot(local, colliders.tangent[c])) <= size[0] and (
        wp.abs(wp.dot(local, colliders.bitangent[c])) <= size[1]
    )


@wp.func
def crosses_rectangle(colliders: Any, c: int, start: Any, below: Any, local: Any):
    """Say whether the segment from start to a point below plane c comes through the rectangle from the front."""
    zero = type(below)(0.0)
    before = start - colliders.center[c]
    above = wp.dot(before, colliders.normal[c])
    crosses = False
    if above >= zero:
        share = zero
        if above + below > zero:
            share = above / (above + below)
        crosses = in_rectangle(colliders, c, before + share * (local - before))
    return crosses


@wp.func
def entry_normal(radius: Any, before: Any, local: Any):
    """Return the normal where the segment from before to local, both relative to the centre, enters a sphere."""
    path = local - before
    # |before + s path| = radius, the smaller root; before is outside and local inside, so there is one in [0, 1].
    a = wp.dot(path, path)
    half_b = wp.dot(before, path)
    c = wp.dot(before, before) - radius * radius
    s = (-half_b - wp.sqrt(wp.max(type(radius)(0.0), half_b * half_b - a * c))) / a
    return wp.normalize(before + s * path)


@wp.func
def is_within(colliders: Any, c: int, body: int, point: Any):
    """Say whether a point is within the surface of collider c, without which there is no contact."""
    local = point - colliders.center[c]
    within = bool(False)
    if colliders.kind[c] == SPHERE:
        within = wp.length(local) <= colliders.size[c][0]
    else:
        within = wp.dot(local, colliders.side[c, body] * colliders.normal[c]) <= type(point[0])(0.0)
    return within


@wp.func
def find_contact(
    colliders: Any, c: int, body: int, start: Any, point: Any, held: bool, held_normal: Any, anywhere: bool
):
    """Look for a contact of a point with collider c.

    Args:
        colliders: table of colliders.
        c: which collider.
        body: body of the particle.
        start: where the particle was one step earlier.
        point: where it is.
        held: whether it was in contact one step earlier.
        held_normal: the normal then.
        anywhere: whether a particle may be in contact without having come through the surface, as at time zero.

    Returns:
        The outward unit normal; the depth along it, negative without contact; the depth that counts for the force,
        which ends at a plane's threshold.
    """
    zero = type(point[0])(0.0)
    local = point - colliders.center[c]
    normal = colliders.side[c, body] * colliders.normal[c]
    depth = type(point[0])(-1.0)
    counted = depth
    if colliders.kind[c] == SPHERE:
        radius = colliders.size[c][0]
        distance = wp.length(local)
        if distance <= radius:
            before = start - colliders.center[c]
            if held and colliders.entry_normal[c] == 1:
                normal = held_normal
            elif colliders.entry_normal[c] == 1 and wp.length(before) > radius:
                normal = entry_normal(radius, before, local)
            elif distance > zero:
                normal = local / distance
            along = wp.dot(local, normal)
            depth = wp.sqrt(wp.max(zero, along * along + (radius - distance) * (radius + distance))) - along
            counted = depth
    else:
        below = -wp.dot(local, normal)
        if below >= zero:
            if colliders.kind[c] == HALF_SPACE:
                depth = below
                counted = below
            elif in_rectangle(colliders, c, local):
                threshold = colliders.size[c][2]
                if held or (anywhere and below <= threshold) or crosses_rectangle(colliders, c, start, below, local):
                    depth = below
                    counted = wp.min(below, threshold)
    return normal, depth, counted


@wp.func
def normal_reaction(colliders: Any, c: int, counted: Any, speed: Any, pressing: Any):
    """Return the size of the normal force [N]: spring and damper, and what presses the particle in where asked for.

    Args:
        colliders: table of colliders.
        c: which collider.
        counted: depth that counts, m.
        speed: velocity along the outward normal, m/s.
        pressing: all other forces against the normal, N, positive inwards.
    """
    zero = type(counted)(0.0)
    push = colliders.stiffness[c] * counted - colliders.damping[c] * speed
    if colliders.pulls[c] == 0:
        push = wp.max(zero, push)
    if colliders.normal_force_term[c] == 1:
        push += wp.max(zero, pressing)
    return push


@wp.func
def friction_force(
    colliders: Any, c: int, reaction: Any, pressing: Any, velocity: Any, applied: Any, mass: Any, dt: Any
):
    """Return the friction on a particle; velocity and applied (all forces but reactions) are the tangential parts.

    ``stop`` is the force that brings the particle to rest within the step. Friction is that, as long as it is within
    the static limit at rest, or the dynamic one in motion. Beyond, the particle slides, with the dynamic limit.
    """
    load = wp.abs(reaction)
    if colliders.applied_friction[c] == 1:
        load = wp.max(type(mass)(0.0), pressing)
    limit = colliders.dynamic_friction[c] * load
    hold = limit
    if wp.length(velocity) < type(mass)(REST_SPEED):
        hold = colliders.static_friction[c] * load
    stop = -(applied + velocity * (mass / dt))
    needed = wp.length(stop)
    friction = stop
    if needed > hold:
        friction = stop * (wp.min(limit, needed) / needed)
    return friction


@wp.func
def contact_energy(depth: Any, counted: Any, stiffness: Any):
    """Return the energy of a penetration, whose negative gradient is the undamped force, also past a threshold."""
    return stiffness * counted * (depth - type(depth)(0.5) * counted)


@wp.func
def may_touch(colliders: Any, c: int, body: int, lower: Any, upper: Any):
    """Say whether a box of particles may hold one in contact with collider c; never wrongly no."""
    if colliders.kind[c] == SPHERE:
        return bounds.are_near(lower, upper, colliders.lower[c], colliders.upper[c], type(lower[0])(0.0))
    center = colliders.center[c]
    clear = bounds.is_beyond(lower, upper, center, colliders.side[c, body] * colliders.normal[c])
    if not clear and colliders.kind[c] == PLANE:
        # A contact that holds may be anywhere behind the rectangle, so there is no bound on that side.
        a = colliders.size[c][0] * colliders.tangent[c]
        b = colliders.size[c][1] * colliders.bitangent[c]
        clear = (
            bounds.is_beyond(lower, upper, center + a, colliders.tangent[c])
            or bounds.is_beyond(lower, upper, center - a, -colliders.tangent[c])
            or bounds.is_beyond(lower, upper, center + b, colliders.bitangent[c])
            or bounds.is_beyond(lower, upper, center - b, -colliders.bitangent[c])
        )
    return not clear


@wp.func
def collider_bit(c: int):
    """Return the bit of a collider in a mask; those beyond the width of the mask share the last one."""
    return wp.uint32(1) << wp.uint32(wp.min(c, 31))


_ANY_WITHIN = f"""
    {vectors.ROW}
    auto px = row(x, 0), py = row(x, 1), pz = row(x, 2);
    auto cx = center[0], cy = center[1], cz = center[2], nx = normal[0], ny = normal[1], nz = normal[2], most = limit;
    int within = 0;
    for (int i = begin; i < end; ++i) {{
        auto dx = px[i] - cx, dy = py[i] - cy, dz = pz[i] - cz;
        auto height = dx * nx + dy * ny + dz * nz, square = dx * dx + dy * dy + dz * dz;
        within |= radial ? square <= most * most : height <= most;
    }}
    return within != 0;
"""


# What returns a value cannot be both native and generic, so there is one for each precision.
@wp.func_native(_ANY_WITHIN)
def any_within(
    x: wp.array2d(dtype=wp.float32),
    begin: int,
    end: int,
    center: wp.vec3f,
    normal: wp.vec3f,
    limit: float,
    radial: bool,
) -> bool:
    """Say whether any of some particles is within a distance of a centre, or no higher than that along a normal."""
    ...


@wp.func_native(_ANY_WITHIN)
def any_within(  # noqa: F811
    x: wp.array2d(dtype=wp.float64),
    begin: int,
    end: int,
    center: wp.vec3d,
    normal: wp.vec3d,
    limit: wp.float64,
    radial: bool,
) -> bool:
    """Do the same in float64."""
    ...


@wp.func
def group_may_touch(
    colliders: Any, near: wp.uint32, body: int, x: wp.array2d(dtype=Any), begin: int, end: int, reach: Any
):
    """Say whether any of some particles may be in contact with a collider of a mask; never wrongly no.

    Args:
        colliders: table of colliders.
        near: mask of those to look at.
        body: body of the particles.
        x: positions.
        begin: first of the particles.
        end: end of them.
        reach: no less than the distance of any of them from the origin, m.
    """
    found = bool(False)
    for c in range(colliders.kind.shape[0]):
        if near & collider_bit(c) != wp.uint32(0):
            center = colliders.center[c]
            radial = colliders.kind[c] == SPHERE
            # As for boxes, far above rounding errors.
            limit = type(reach)(bounds.MARGIN) * (type(reach)(1.0) + wp.length(center) + reach)
            if radial:
                limit += colliders.size[c][0]
            if any_within(x, begin, end, center, colliders.side[c, body] * colliders.normal[c], limit, radial):
                found = True
    return found


@wp.func
def held_contact(colliders: Any, c: int, stamps: wp.array2d(dtype=wp.int32), i: int, step: wp.int64):
    """Say whether particle i was in contact with collider c one step earlier, or has been in this step already."""
    held = bool(False)
    if colliders.slot[c] >= 0:
        stamp = stamps[colliders.slot[c], i]
        held = stamp == wp.int32(step) or stamp == wp.int32(step - wp.int64(1))
    return held


@wp.func
def held_normal(colliders: Any, c: int, normals: wp.array2d(dtype=Any), i: int):
    """Return the normal of a contact that holds."""
    normal = colliders.normal[c]
    if colliders.entry_normal[c] == 1:
        row = 3 * colliders.slot[c]
        normal = wp.vector(normals[row, i], normals[row + 1, i], normals[row + 2, i])
    return normal


@wp.func
def remember_contact(
    colliders: Any,
    c: int,
    i: int,
    step: wp.int64,
    normal: Any,
    stamps: wp.array2d(dtype=wp.int32),
    normals: wp.array2d(dtype=Any),
):
    """Note that particle i is in contact with collider c in this step."""
    if colliders.slot[c] >= 0:
        stamps[colliders.slot[c], i] = wp.int32(step)
        if colliders.entry_normal[c] == 1:
            row = 3 * colliders.slot[c]
            normals[row, i] = normal[0]
            normals[row + 1, i] = normal[1]
            normals[row + 2, i] = normal[2]


@wp.func
def near_colliders(colliders: Any, body: int, lower: Any, upper: Any, culling: bool):
    """Return a mask of the colliders that a box of particles may touch; of all without culling."""
    near = wp.uint32(0)
    for c in range(colliders.kind.shape[0]):
        if not culling or may_touch(colliders, c, body, lower, upper):
            near |= collider_bit(c)
    return near


@wp.kernel
def add_contact_forces(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    lanes: int,
    # Model:
    mass: wp.array(dtype=Any),
    inv_mass: wp.array(dtype=Any),
    chunk_start: wp.array(dtype=wp.int32),
    chunk_body: wp.array(dtype=wp.int32),
    colliders: Any,
    # State in:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
    x_start: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    step: wp.array(dtype=wp.int64),
    # In:
    dt: Any,
    loss_weight: Any,
    ahead: Any,
    first: bool,
    culling: bool,
    # State in and out:
    stamps: wp.array2d(dtype=wp.int32),
    normals: wp.array2d(dtype=Any),
    f: wp.array2d(dtype=Any),
    losses: wp.array2d(dtype=wp.float64),
):
    """Add the contact forces, launched over (part, lane), where parts are chunks from part_start on.

    Lane k takes particles k, k + lanes, ... of each chunk. The first evaluation of a step remembers contacts; those of
    later stages look at trial positions only. Losses [2, chunk_count] gain what contact damping and friction take, at
    the velocities that the forces make some time ahead, times loss_weight.
    """
    part, lane = wp.tid()
    task = part * lanes + lane
    mine = turns.take(turn, task)
    now = step[0]
    at_start = now == wp.int64(0)
    # In the first evaluation a contact of the step before still holds; later ones go by what the first one found.
    latest = now
    if not first:
        latest = now + wp.int64(1)
    begin = part_start[part]
    end = part_start[part + 1]
    if not mine:
        end = begin
    for chunk in range(begin, end):
        body = chunk_body[chunk]
        low = vectors.load(lower, chunk)
        high = vectors.load(upper, chunk)
        near = near_colliders(colliders, body, low, high, culling)
        if near == wp.uint32(0):
            continue
        damped = wp.float64(0.0)
        rubbed = wp.float64(0.0)
        last = chunk_start[chunk + 1]
        reach = wp.length(low) + wp.length(high)
        for group in range(chunk_start[chunk], last, GROUP * lanes):
            stop = wp.min(group + GROUP * lanes, last)
            # Most groups in a chunk near a collider touch nothing. Lanes of a GPU each see that for themselves.
            if culling and lanes == 1:
                if not group_may_touch(colliders, near, body, x, group, stop, reach):
                    continue
            for i in range(group + lane, stop, lanes):
                point = vectors.load(x, i)
                total = type(dt)(0.0) * point
                damping = type(dt)(0.0) * point
                rubbing = type(dt)(0.0) * point
                touches = bool(False)
                for c in range(colliders.kind.shape[0]):
                    # What is not within is looked at no further, which is most.
                    if near & collider_bit(c) != wp.uint32(0) and is_within(colliders, c, body, point):
                        start = vectors.load(x_start, i)
                        held = held_contact(colliders, c, stamps, i, latest)
                        before = held_normal(colliders, c, normals, i)
                        normal, depth, counted = find_contact(colliders, c, body, start, point, held, before, at_start)
                        if depth >= type(dt)(0.0):
                            touches = True
                            if first:
                                remember_contact(colliders, c, i, now, normal, stamps, normals)
                            velocity = vectors.load(v, i)
                            speed = wp.dot(velocity, normal)
                            # Without the other colliders' reactions, so that their order does not matter.
                            applied = vectors.load(f, i)
                            pressing = -wp.dot(applied, normal)
                            reaction = normal_reaction(colliders, c, counted, speed, pressing)
                            # With what others rub already, so that all together do no more than stop the particle.
                            rubbed_along = rubbing - wp.dot(rubbing, normal) * normal
                            along = velocity - speed * normal
                            pull = applied + pressing * normal + rubbed_along
                            friction = friction_force(colliders, c, reaction, pressing, along, pull, mass[i], dt)
                            rubbing += friction
                            total += reaction * normal + friction
                            damping += (reaction - colliders.stiffness[c] * counted) * normal
                # Adding nothing would still turn -0 into 0, and culling would be seen in the bits.
                if touches:
                    force = vectors.load(f, i) + total
                    vectors.store(f, i, force)
                    # Colliders come last, so that this is the whole force.
                    velocity = vectors.load(v, i) + ahead * inv_mass[i] * force
                    damped -= wp.float64(wp.dot(damping, velocity))
                    rubbed -= wp.float64(wp.dot(rubbing, velocity))
        wp.atomic_add(losses, 0, chunk, wp.float64(loss_weight) * damped)
        wp.atomic_add(losses, 1, chunk, wp.float64(loss_weight) * rubbed)
    turns.leave(turn, task, mine)
