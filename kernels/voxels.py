"""Scan conversion of triangles into an occupancy grid, by parity.

A cell is inside a closed mesh when the ray from its centre towards -x crosses the surface an odd number of times. Each
triangle toggles one bit per column of cells that it covers: the first cell whose centre lies beyond the crossing, or
the extra bit after the last cell. A prefix XOR along the columns then gives the parity of every cell, and the parity of
the extra bit says whether the surface is closed there.

Centres that lie exactly on an edge, a vertex or a face count as shifted by (e, e^2, e^3) for a vanishing e > 0, so that
neighbouring triangles never both count a column, nor both miss it. Edges are tested in integers, hence exactly.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Vertices are snapped to this fraction of a cell. At 4096 cells an edge function stays within 2 (2^12 2^18)^2 = 2^61.
SUBCELLS = 1 << 18


@wp.func
def _twice_area(triangles: wp.array3d(dtype=wp.int64), t: int, b: int, c: int):
    """Return twice the area of a triangle in the y-z plane, signed by the sense of its corners 0, b, c."""
    by = triangles[t, b, 1] - triangles[t, 0, 1]
    bz = triangles[t, b, 2] - triangles[t, 0, 2]
    cy = triangles[t, c, 1] - triangles[t, 0, 1]
    cz = triangles[t, c, 2] - triangles[t, 0, 2]
    return by * cz - bz * cy


@wp.func
def _covers(ay: wp.int64, az: wp.int64, by: wp.int64, bz: wp.int64, cy: wp.int64, cz: wp.int64):
    """Say whether the shifted centre (cy, cz) lies to the left of the edge from a to b in the y-z plane."""
    dy = by - ay
    dz = bz - az
    edge = dy * (cz - az) - dz * (cy - ay)
    # The shift adds -dz e^2 + dy e^3.
    return edge > wp.int64(0) or (
        edge == wp.int64(0) and (dz < wp.int64(0) or (dz == wp.int64(0) and dy > wp.int64(0)))
    )


@wp.kernel
def toggle_crossings(
    # In:
    triangles: wp.array3d(dtype=wp.int64),
    shape: wp.vec3i,
    # Out:
    bits: wp.array3d(dtype=wp.uint32),
):
    """Toggle the crossings of triangles [count, corner, xyz], in subcells, one thread per triangle.

    The bits are [y, z, x / 32], x from 0 to shape[0].
    """
    t = wp.tid()
    # Seen along x, the corners have to go round counter-clockwise.
    b = 1
    c = 2
    area = _twice_area(triangles, t, b, c)
    if area == wp.int64(0):
        return
    if area < wp.int64(0):
        area = -area
        b = 2
        c = 1
    ax, ay, az = triangles[t, 0, 0], triangles[t, 0, 1], triangles[t, 0, 2]
    bx, by, bz = triangles[t, b, 0], triangles[t, b, 1], triangles[t, b, 2]
    cx, cy, cz = triangles[t, c, 0], triangles[t, c, 1], triangles[t, c, 2]
    cell = wp.int64(SUBCELLS)
    half = cell / wp.int64(2)
    # Columns whose centre lies between the least and the greatest coordinate.
    first_y = wp.max(wp.int64(0), (wp.min(ay, wp.min(by, cy)) - half) / cell)
    last_y = wp.min(wp.int64(shape[1] - 1), (wp.max(ay, wp.max(by, cy)) + half) / cell)
    first_z = wp.max(wp.int64(0), (wp.min(az, wp.min(bz, cz)) - half) / cell)
    last_z = wp.min(wp.int64(shape[2] - 1), (wp.max(az, wp.max(bz, cz)) + half) / cell)
    for j in range(int(first_y), int(last_y) + 1):
        py = wp.int64(j) * cell + half
        for k in range(int(first_z), int(last_z) + 1):
            pz = wp.int64(k) * cell + half
            if _covers(ay, az, by, bz, py, pz) and _covers(by, bz, cy, cz, py, pz) and _covers(cy, cz, ay, az, py, pz):
                # Barycentric interpolation of x at the centre, relative to the first corner to keep digits.
                weight_b = wp.float64((py - ay) * (cz - az) - (pz - az) * (cy - ay))
                weight_c = wp.float64((by - ay) * (pz - az) - (bz - az) * (py - ay))
                rise = (weight_b * wp.float64(bx - ax) + weight_c * wp.float64(cx - ax)) / wp.float64(area)
                crossing = (wp.float64(ax) + rise) / wp.float64(SUBCELLS)
                # A centre exactly on the triangle is shifted by +e in x, so it lies beyond the crossing.
                i = wp.clamp(int(wp.ceil(crossing - wp.float64(0.5))), 0, shape[0])
                wp.atomic_xor(bits, j, k, i / 32, wp.uint32(1) << wp.uint32(i % 32))
