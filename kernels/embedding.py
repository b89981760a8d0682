"""Hang points on the cells of a lattice, so that they move with it; on the CPU alone."""

import warp as wp

from .lattices import Grid, corner_particle, occupied, vertex

wp.set_module_options({"enable_backward": False})


@wp.kernel
def find_cells(
    # In:
    grid: Grid,
    faces: wp.uint64,
    face_cells: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=wp.vec3d),
    reach: float,
    # Out:
    cells: wp.array(dtype=wp.vec3i),
):
    """Overwrite the occupied unit cell that holds each point, in unit cells, or else the nearest one.

    The nearest is the one with the nearest face of the surface, a mesh of two triangles for each of ``face_cells``.
    """
    i = wp.tid()
    point = points[i]
    x = int(wp.floor(point[0]))
    y = int(wp.floor(point[1]))
    z = int(wp.floor(point[2]))
    cell = wp.vec3i(x, y, z)
    if not occupied(grid, x, y, z):
        nearest = wp.mesh_query_point_no_sign(faces, wp.vec3f(point), reach)
        cell = face_cells[nearest.face / 2]
    cells[i] = cell


@wp.kernel
def embed_points(
    # In:
    grid: Grid,
    points: wp.array(dtype=wp.vec3d),
    cells: wp.array(dtype=wp.vec3i),
    # Out:
    particles: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32),
):
    """Overwrite the particles [point_count, 8] at the corners of each point's cell, and their weights.

    Inside the cell the weights are trilinear. Outside, they continue those of the nearest point of the cell linearly.
    """
    i = wp.tid()
    cell = cells[i]
    one = wp.float64(1.0)
    local = points[i] - wp.vec3d(wp.float64(cell[0]), wp.float64(cell[1]), wp.float64(cell[2]))
    inside = wp.max(wp.min(local, wp.vec3d(one, one, one)), wp.vec3d())
    beyond = local - inside
    for number in range(8):
        cx = number / 4
        cy = number / 2 % 2
        cz = number % 2
        place = vertex(grid, cell[0] + cx, cell[1] + cy, cell[2] + cz)
        # The cell lies on the other side of the vertex than the vertex of it.
        particles[i, number] = corner_particle(grid, place, 7 - number)
        x = wp.where(cx == 1, inside[0], one - inside[0])
        y = wp.where(cy == 1, inside[1], one - inside[1])
        z = wp.where(cz == 1, inside[2], one - inside[2])
        dx = wp.float64(2 * cx - 1)
        dy = wp.float64(2 * cy - 1)
        dz = wp.float64(2 * cz - 1)
        slope = wp.dot(beyond, wp.vec3d(dx * y * z, x * dy * z, x * y * dz))
        weights[i, number] = wp.float32(x * y * z + slope)
