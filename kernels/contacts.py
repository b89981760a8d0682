"""Penalty contact with half-spaces, finite planes and spheres: a spring and a damper along the outward normal.

A box that bodies stay inside is six half-spaces. For a particle at depth d >= 0 with velocity v, the force along the
unit normal n is max(0, k d - c v.n): without the maximum a particle that leaves would be pulled back, which happens
only where a collider asks for it.
"""

from typing import Any

import warp as wp

from . import bounds, vectors

wp.set_module_options({"enable_backward": False})

HALF_SPACE = wp.constant(0)
PLANE = wp.constant(1)
SPHERE = wp.constant(2)


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
        lower: wp.array(dtype=vector)  # [collider_count] m; box around a plane's solid part or a sphere
        upper: wp.array(dtype=vector)  # [collider_count] m
        stiffness: wp.array(dtype=real)  # [collider_count] N/m
        damping: wp.array(dtype=real)  # [collider_count] N s/m
        pulls: wp.array(dtype=wp.int32)  # [collider_count] 1 where the force may point inwards, too
        side: wp.array2d(
            dtype=real
        )  # [collider_count, body_count] -1 where the body is kept behind a half-space, else 1

    return Colliders


# The table of colliders by precision; the same members, so that kernels take either.
COLLIDERS = {wp.float32: _colliders_struct(wp.float32), wp.float64: _colliders_struct(wp.float64)}


@wp.func
def contact_normal_and_depth(colliders: Any, c: int, body: int, point: Any):
    """Return the outward unit normal and the depth of a point in collider c; the depth is negative without contact."""
    zero = type(point[0])(0.0)
    local = point - colliders.center[c]
    normal = colliders.side[c, body] * colliders.normal[c]
    depth = type(point[0])(-1.0)
    if colliders.kind[c] == SPHERE:
        distance = wp.length(local)
        if distance <= colliders.size[c][0]:
            depth = colliders.size[c][0] - distance
            if distance > zero:
                normal = local / distance
    else:
        below = -wp.dot(local, normal)
        if below >= zero:
            if colliders.kind[c] == HALF_SPACE:
                depth = below
            else:
                size = colliders.size[c]
                inside = (
                    wp.abs(wp.dot(local, colliders.tangent[c])) <= size[0]
                    and wp.abs(wp.dot(local, colliders.bitangent[c])) <= size[1]
                )
                if inside and below <= size[2]:
                    depth = below
    return normal, depth


@wp.func
def contact_force(normal: Any, depth: Any, velocity: Any, stiffness: Any, damping: Any, pulls: int):
    """Return the force of a penetrated collider on a particle."""
    push = stiffness * depth - damping * wp.dot(velocity, normal)
    if pulls == 0:
        push = wp.max(type(depth)(0.0), push)
    return push * normal


@wp.func
def contact_energy(depth: Any, stiffness: Any):
    """Return the energy stored in the penetration, whose negative gradient is the undamped force."""
    return type(depth)(0.5) * stiffness * depth * depth


@wp.func
def may_touch(colliders: Any, c: int, body: int, lower: Any, upper: Any):
    """Say whether a box may hold a point in contact with collider c; never wrongly no."""
    if colliders.kind[c] == HALF_SPACE:
        normal = colliders.side[c, body] * colliders.normal[c]
        return bounds.least_height(lower, upper, colliders.center[c], normal) <= type(normal[0])(0.0)
    return bounds.boxes_overlap(lower, upper, colliders.lower[c], colliders.upper[c])


@wp.kernel
def add_contact_forces(
    # Model:
    chunk_start: wp.array(dtype=wp.int32),
    chunk_body: wp.array(dtype=wp.int32),
    colliders: Any,
    # State in:
    lower: wp.array2d(dtype=Any),
    upper: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    culling: bool,
    lanes: int,
    # State out:
    f: wp.array2d(dtype=Any),
):
    """Add the contact forces, launched over (chunk, lane); lane k takes particles k, k + lanes, ... of the chunk."""
    chunk, lane = wp.tid()
    body = chunk_body[chunk]
    low = vectors.load(lower, chunk)
    high = vectors.load(upper, chunk)
    for c in range(colliders.kind.shape[0]):
        if not culling or may_touch(colliders, c, body, low, high):
            for i in range(chunk_start[chunk] + lane, chunk_start[chunk + 1], lanes):
                normal, depth = contact_normal_and_depth(colliders, c, body, vectors.load(x, i))
                if depth >= type(depth)(0.0):
                    force = contact_force(
                        normal,
                        depth,
                        vectors.load(v, i),
                        colliders.stiffness[c],
                        colliders.damping[c],
                        colliders.pulls[c],
                    )
                    vectors.store(f, i, vectors.load(f, i) + force)
