"""Bounding boxes of chunks of consecutive particles; contacts are only tested where a box may touch a collider."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})

# Boxes are grown by this share of 1 m plus their distance from the origin. It is far above the rounding errors of both
# precisions, so that culling never drops a contact that the exact test would find.
MARGIN = 1e-5


@wp.kernel
def update_chunk_bounds(
    # Model:
    chunk_start: wp.array(dtype=wp.int32),
    # State in:
    x: wp.array2d(dtype=Any),
    # Out:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
):
    """Overwrite the box [3, chunk_count] of each chunk, one thread per chunk."""
    chunk = wp.tid()
    begin = chunk_start[chunk]
    low = vectors.load(x, begin)
    high = low
    for i in range(begin + 1, chunk_start[chunk + 1]):
        p = vectors.load(x, i)
        low = wp.min(low, p)
        high = wp.max(high, p)
    vectors.store(lower, chunk, low)
    vectors.store(upper, chunk, high)


@wp.func
def boxes_overlap(lower_a: Any, upper_a: Any, lower_b: Any, upper_b: Any):
    """Say whether two boxes share a point."""
    return (
        lower_a[0] <= upper_b[0]
        and lower_b[0] <= upper_a[0]
        and lower_a[1] <= upper_b[1]
        and lower_b[1] <= upper_a[1]
        and lower_a[2] <= upper_b[2]
        and lower_b[2] <= upper_a[2]
    )


@wp.func
def least_height(lower: Any, upper: Any, point: Any, normal: Any):
    """Return a lower bound of the signed distance of a box from the flat wall through a point with a unit normal."""
    half = type(normal[0])(0.5)
    center = half * (lower + upper) - point
    reach = half * (upper - lower)
    height = wp.dot(center, normal) - wp.dot(reach, wp.abs(normal))
    return height - type(normal[0])(MARGIN) * (
        type(normal[0])(1.0) + wp.length(point) + wp.length(center) + wp.length(reach)
    )
