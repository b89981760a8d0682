"""Bounding boxes of chunks of consecutive particles, and of bodies: what is far from everything is tested no further.

A particle that is not a number is in no box; it touches nothing either.
"""

from typing import Any

import warp as wp

from . import turns, vectors

wp.set_module_options({"enable_backward": False})

# Boxes are grown by this share of 1 m plus their distance from the origin. It is far above the rounding errors of both
# precisions, so that culling never drops a contact that the exact test would find.
MARGIN = 1e-5


# Each row in a loop that the compiler for CPUs turns into vector instructions: least and greatest of every 32nd number
# first. A comparison with what is not a number is false and changes nothing.
@wp.func_native(f"""
    {vectors.ROW}
    typedef decltype(infinity) real;
    for (int axis = 0; axis < 3; ++axis) {{
        const real* __restrict p = row(x, axis);
        real low[32], high[32];
        for (int k = 0; k < 32; ++k) {{ low[k] = infinity; high[k] = -infinity; }}
        int i = begin;
        for (; i + 32 <= end; i += 32) for (int k = 0; k < 32; ++k) {{
            low[k] = p[i + k] < low[k] ? p[i + k] : low[k];
            high[k] = p[i + k] > high[k] ? p[i + k] : high[k];
        }}
        for (int k = 0; i < end; ++i, ++k) {{
            low[k] = p[i] < low[k] ? p[i] : low[k];
            high[k] = p[i] > high[k] ? p[i] : high[k];
        }}
        for (int half = 16; half > 0; half /= 2) for (int k = 0; k < half; ++k) {{
            low[k] = low[k + half] < low[k] ? low[k + half] : low[k];
            high[k] = high[k + half] > high[k] ? high[k + half] : high[k];
        }}
        row(lower, axis)[box] = low[0];
        row(upper, axis)[box] = high[0];
    }}
""")
def _store_box(
    x: wp.array2d(dtype=Any),
    begin: int,
    end: int,
    infinity: Any,
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
    box: int,
): ...


@wp.kernel
def update_chunk_bounds(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    # Model:
    chunk_start: wp.array(dtype=wp.int32),
    # State in:
    x: wp.array2d(dtype=Any),
    # Out:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
):
    """Overwrite the box [3, chunk_count] of each chunk, launched over parts, each some chunks from part_start on."""
    part = wp.tid()
    mine = turns.take(turn, part)
    if mine:
        infinity = type(x[0, 0])(wp.inf)
        for chunk in range(part_start[part], part_start[part + 1]):
            _store_box(x, chunk_start[chunk], chunk_start[chunk + 1], infinity, lower, upper, chunk)
    turns.leave(turn, part, mine)


@wp.kernel
def update_body_bounds(
    # Model:
    body_chunk_start: wp.array(dtype=wp.int32),
    # State in:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
    # Out:
    body_lower: wp.array2d(dtype=Any),
    body_upper: wp.array2d(dtype=Any),
):
    """Overwrite the box [3, body_count] of each body by those of its chunks, one thread per body."""
    body = wp.tid()
    begin = body_chunk_start[body]
    low = vectors.load(lower, begin)
    high = vectors.load(upper, begin)
    for chunk in range(begin + 1, body_chunk_start[body + 1]):
        low = wp.min(low, vectors.load(lower, chunk))
        high = wp.max(high, vectors.load(upper, chunk))
    vectors.store(body_lower, body, low)
    vectors.store(body_upper, body, high)


@wp.func
def are_near(lower_a: Any, upper_a: Any, lower_b: Any, upper_b: Any, reach: Any):
    """Say whether two boxes are within reach of each other along every axis.

    Rounding keeps order, so no difference of a coordinate between particles of the two is smaller than that of the
    boxes: if this says no, no two particles are within reach, bit for bit.
    """
    return (
        lower_a[0] - upper_b[0] <= reach
        and lower_b[0] - upper_a[0] <= reach
        and lower_a[1] - upper_b[1] <= reach
        and lower_b[1] - upper_a[1] <= reach
        and lower_a[2] - upper_b[2] <= reach
        and lower_b[2] - upper_a[2] <= reach
    )


@wp.func
def is_beyond(lower: Any, upper: Any, point: Any, normal: Any):
    """Say whether a box lies wholly in front of the flat wall through a point with a unit normal; never wrongly yes."""
    half = type(normal[0])(0.5)
    center = half * (lower + upper) - point
    reach = half * (upper - lower)
    height = wp.dot(center, normal) - wp.dot(reach, wp.abs(normal))
    margin = type(normal[0])(MARGIN) * (type(normal[0])(1.0) + wp.length(point) + wp.length(center) + wp.length(reach))
    # Where a particle is at infinity, heights are not numbers, which is no.
    return height > margin
