"""What a frame shows: points that hang on particles, with velocities, force magnitudes and normals, always float32."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})


@wp.struct
class Shapes:
    """All shapes of a scene, one after another."""

    point_start: wp.array(dtype=wp.int32)  # [point_count + 1] where what each point hangs on starts
    particles: wp.array(dtype=wp.int32)  # particles that the points hang on
    weights: wp.array(dtype=wp.float32)  # how much of each, adding up to 1 for each point
    face_start: wp.array(dtype=wp.int32)  # [face_count + 1] where the corners of each face start
    corners: wp.array(dtype=wp.int32)  # point at each corner, counter-clockwise from outside
    corner_normals: wp.array(dtype=wp.int32)  # normal at each corner


@wp.kernel
def gather_points(
    # Model:
    shapes: Shapes,
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    f: wp.array2d(dtype=Any),
    # Out:
    points: wp.array(dtype=wp.vec3f),
    velocities: wp.array(dtype=wp.vec3f),
    forces: wp.array(dtype=wp.float32),
):
    """Overwrite points, velocities and force magnitudes [N], means of those of the particles."""
    point = wp.tid()
    first = shapes.point_start[point]
    i = shapes.particles[first]
    place = vectors.load(x, i)
    velocity = vectors.load(v, i)
    force = wp.float32(wp.length(vectors.load(f, i)))
    # Means of differences, which are small, lose nothing far from the origin; one particle alone is kept exactly.
    aside = wp.vec3f()
    faster = wp.vec3f()
    stronger = wp.float32(0.0)
    for k in range(first + 1, shapes.point_start[point + 1]):
        j = shapes.particles[k]
        weight = shapes.weights[k]
        aside += weight * wp.vec3f(vectors.load(x, j) - place)
        faster += weight * wp.vec3f(vectors.load(v, j) - velocity)
        stronger += weight * (wp.float32(wp.length(vectors.load(f, j))) - force)
    points[point] = wp.vec3f(place) + aside
    velocities[point] = wp.vec3f(velocity) + faster
    # What lies outside of its cell continues the cell's slope, which may lead below nothing.
    forces[point] = wp.max(force + stronger, 0.0)


@wp.kernel
def add_face_normals(
    # Model:
    shapes: Shapes,
    # In:
    points: wp.array(dtype=wp.vec3f),
    # Out:
    normals: wp.array(dtype=wp.vec3f),
):
    """Add twice the area vector of each face to the normals at its corners."""
    face = wp.tid()
    start = shapes.face_start[face]
    end = shapes.face_start[face + 1]
    first = points[shapes.corners[start]]
    area = wp.vec3f()
    for k in range(start + 1, end - 1):
        area += wp.cross(points[shapes.corners[k]] - first, points[shapes.corners[k + 1]] - first)
    for k in range(start, end):
        wp.atomic_add(normals, shapes.corner_normals[k], area)


@wp.kernel
def normalize(
    # In and out:
    normals: wp.array(dtype=wp.vec3f),
):
    """Scale each normal to unit length; a zero normal stays zero."""
    point = wp.tid()
    normals[point] = wp.normalize(normals[point])
