"""Forces that act on every particle: weight, and force fields that may vary in space and time.

A field's force at time t is its law's force times the factor of its curve at t. Time is ``step * dt``, with the step
counted on the device, so that it is exact after any number of steps and changes inside a captured graph.
"""

from typing import Any

import warp as wp

from . import turns, vectors

wp.set_module_options({"enable_backward": False})

CONSTANT = wp.constant(0)
GRID = wp.constant(1)
ELECTRIC = wp.constant(2)
MAGNETIC = wp.constant(3)


def _fields_struct(real: type) -> Any:
    vector = wp.types.vector(3, real)

    @wp.struct
    class Fields:
        kind: wp.array(dtype=wp.int32)  # [field_count] CONSTANT, GRID, ELECTRIC or MAGNETIC
        strength: wp.array(dtype=vector)  # [field_count] N (constant), V/m (electric), T (magnetic)
        lower: wp.array(dtype=vector)  # [field_count] m; box of a grid
        upper: wp.array(dtype=vector)  # [field_count] m
        resolution: wp.array(dtype=wp.int32)  # [field_count] nodes along each axis of a grid
        node_start: wp.array(dtype=wp.int32)  # [field_count] first of its nodes
        clamped: wp.array(dtype=wp.int32)  # [field_count] 0 where a grid is zero outside its box
        nodes: wp.array(dtype=vector)  # [node_count] N, grid after grid; i outermost, k innermost
        curve_start: wp.array(dtype=wp.int32)  # [field_count + 1] first keyframe of each curve, and the end of the last
        curve_time: wp.array(dtype=wp.float64)  # [keyframe_count] s, ascending within a curve
        curve_factor: wp.array(dtype=wp.float64)  # [keyframe_count]

    return Fields


# The table of fields by precision; the same members, so that kernels take either.
FIELDS = {wp.float32: _fields_struct(wp.float32), wp.float64: _fields_struct(wp.float64)}


@wp.func
def curve_factor(fields: Any, m: int, time: wp.float64):
    """Return the factor of field m: linear between keyframes, constant outside them, 1 without any."""
    begin = fields.curve_start[m]
    end = fields.curve_start[m + 1]
    if begin == end:
        return wp.float64(1.0)
    # The last keyframe that is not later than now.
    before = int(begin - 1)
    for k in range(begin, end):
        if fields.curve_time[k] <= time:
            before = k
    if before < begin:
        return fields.curve_factor[begin]
    if before == end - 1:
        return fields.curve_factor[before]
    share = (time - fields.curve_time[before]) / (fields.curve_time[before + 1] - fields.curve_time[before])
    return fields.curve_factor[before] + share * (fields.curve_factor[before + 1] - fields.curve_factor[before])


@wp.func
def face_force(fields: Any, near: int, n: int, share: Any):
    """Return the bilinear interpolation over four nodes of a grid's cell, from node near along j and k."""
    return wp.lerp(
        wp.lerp(fields.nodes[near], fields.nodes[near + 1], share[2]),
        wp.lerp(fields.nodes[near + n], fields.nodes[near + n + 1], share[2]),
        share[1],
    )


@wp.func
def grid_force(fields: Any, m: int, point: Any):
    """Return the trilinear interpolation of grid m at a point."""
    lower = fields.lower[m]
    upper = fields.upper[m]
    nearest = wp.min(wp.max(point, lower), upper)
    if fields.clamped[m] == 0 and not (nearest == point):
        return type(point[0])(0.0) * point
    n = fields.resolution[m]
    place = type(point[0])(n - 1) * wp.cw_div(nearest - lower, upper - lower)
    # The integers are clamped too: a position that is not a number must not read elsewhere.
    i = wp.clamp(int(place[0]), 0, n - 2)
    j = wp.clamp(int(place[1]), 0, n - 2)
    k = wp.clamp(int(place[2]), 0, n - 2)
    near = fields.node_start[m] + (i * n + j) * n + k
    share = place - type(point)(type(point[0])(i), type(point[0])(j), type(point[0])(k))
    return wp.lerp(face_force(fields, near, n, share), face_force(fields, near + n * n, n, share), share[0])


@wp.func
def field_force(fields: Any, m: int, point: Any, velocity: Any, charge: Any):
    """Return the force of field m, without its curve, on a particle."""
    if fields.kind[m] == GRID:
        return grid_force(fields, m, point)
    if fields.kind[m] == ELECTRIC:
        return charge * fields.strength[m]
    if fields.kind[m] == MAGNETIC:
        return charge * wp.cross(velocity, fields.strength[m])
    return fields.strength[m]


@wp.func_native(f"""
    {vectors.ROW}
    {vectors.EACH}
    for (int axis = 0; axis < 3; ++axis) {{
        auto weight = gravity.data[0][axis];
        auto m = mass.data;
        auto p = row(f, axis);
        each(begin, end, [=](int i) {{ p[i] = m[i] * weight; }});
    }}
""")
def _set_weights(
    mass: wp.array(dtype=Any), gravity: wp.array(dtype=Any), f: wp.array2d(dtype=Any), begin: int, end: int, lanes: int
): ...


@wp.kernel
def set_gravity_forces(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    lanes: int,
    # Model:
    mass: wp.array(dtype=Any),
    gravity: wp.array(dtype=Any),
    # State out:
    f: wp.array2d(dtype=Any),
):
    """Overwrite the forces with the weight of each particle; gravity is one vector [m/s^2].

    Launched over (part, lane); lane k takes particles k, k + lanes, ... of the part.
    """
    part, lane = wp.tid()
    task = part * lanes + lane
    mine = turns.take(turn, task)
    if mine:
        _set_weights(mass, gravity, f, part_start[part] + lane, part_start[part + 1], lanes)
    turns.leave(turn, task, mine)


@wp.func
def total_force(fields: Any, time: wp.float64, point: Any, velocity: Any, charge: Any):
    """Return the sum of the forces of all fields on a particle at a time [s]."""
    total = type(charge)(0.0) * point
    for m in range(fields.kind.shape[0]):
        factor = type(charge)(curve_factor(fields, m, time))
        total += factor * field_force(fields, m, point, velocity, charge)
    return total


@wp.kernel
def add_field_forces(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    lanes: int,
    # Model:
    charge: wp.array(dtype=Any),
    fields: Any,
    # State in:
    step: wp.array(dtype=wp.int64),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    dt: wp.float64,
    offset: wp.float64,
    work_weight: wp.float64,
    # State out:
    f: wp.array2d(dtype=Any),
    work: wp.array(dtype=wp.float64),
):
    """Add the forces of all fields at the time step * dt + offset [s], launched over (part, lane) as above.

    Work [particle_count] gains their power times work_weight.
    """
    part, lane = wp.tid()
    task = part * lanes + lane
    mine = turns.take(turn, task)
    if mine:
        time = wp.float64(step[0]) * dt + offset
        for i in range(part_start[part] + lane, part_start[part + 1], lanes):
            velocity = vectors.load(v, i)
            total = total_force(fields, time, vectors.load(x, i), velocity, charge[i])
            vectors.store(f, i, vectors.load(f, i) + total)
            work[i] += work_weight * wp.float64(wp.dot(total, velocity))
    turns.leave(turn, task, mine)
