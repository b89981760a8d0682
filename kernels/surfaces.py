"""What a frame shows of a body: surface points, normals, velocities and force magnitudes, always float32."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_surface(
    # Model:
    surface_particles: wp.array(dtype=wp.int32),
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    f: wp.array2d(dtype=Any),
    # Out:
    points: wp.array(dtype=wp.vec3f),
    velocities: wp.array(dtype=wp.vec3f),
    forces: wp.array(dtype=wp.float32),
    normals: wp.array(dtype=wp.vec3f),
):
    """Copy the surface particles into point order and clear the normals; forces are magnitudes [N]."""
    point = wp.tid()
    i = surface_particles[point]
    points[point] = wp.vec3f(vectors.load(x, i))
    velocities[point] = wp.vec3f(vectors.load(v, i))
    forces[point] = wp.float32(wp.length(vectors.load(f, i)))
    normals[point] = wp.vec3f()


@wp.kernel
def add_quad_normals(
    # Model:
    quads: wp.array(dtype=wp.vec4i),
    # In:
    points: wp.array(dtype=wp.vec3f),
    # Out:
    normals: wp.array(dtype=wp.vec3f),
):
    """Add the area vector of each quad, half the cross product of its diagonals, to its four corners."""
    quad = quads[wp.tid()]
    area = wp.cross(points[quad[2]] - points[quad[0]], points[quad[3]] - points[quad[1]])
    for corner in range(4):
        wp.atomic_add(normals, quad[corner], area)


@wp.kernel
def normalize(
    # In and out:
    normals: wp.array(dtype=wp.vec3f),
):
    """Scale each normal to unit length; a zero normal stays zero."""
    point = wp.tid()
    normals[point] = wp.normalize(normals[point])
