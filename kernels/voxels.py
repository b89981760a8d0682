"""Triangles -> occupied cells: scan conversion, and what it leaves out.

A cell's winding number is how often the surface goes round its centre: the crossings of a ray from there towards -z, +1
where it goes out of the mesh and -1 where it goes in. Each triangle has one crossing in each column of cells that it
covers, in front of the first cell whose centre lies beyond it, or after the last cell. Sorted and added up along the
columns they give the winding number of every cell, and what is left after the last one says whether the surface is
closed there. So nothing is stored of cells between crossings.

Kernels that find a number of things per triangle are launched twice: without room they count them, then they write.

Centres that lie exactly on an edge, a vertex or a face count as shifted by (e, e^2, e^3) for a vanishing e > 0, so that
neighbouring triangles never both count a column, nor both miss it. All tests are in integers, hence exact.
"""

import warp as wp

from .runs import first_beyond

wp.set_module_options({"enable_backward": False})

# Vertices are snapped to this fraction of a cell. At 4096 cells an edge function stays within 2 (2^12 2^18)^2 = 2^61.
SUBCELLS = 1 << 18
# Products of three coordinates are exact in two parts, of which the low one has this many bits.
LOW_BITS = wp.constant(wp.int64(30))
# A triangle is looked for all along a column where it is steeper than 10,000 cells in one, otherwise near its plane.
STEEP = wp.constant(wp.float64(1e-4))
MARGIN = wp.constant(wp.float64(1e-3))

vec3l = wp.types.vector(3, wp.int64)


@wp.func
def _corner(triangles: wp.array3d(dtype=wp.int64), t: int, corner: int):
    return vec3l(triangles[t, corner, 0], triangles[t, corner, 1], triangles[t, corner, 2])


@wp.func
def _covers(a: vec3l, b: vec3l, p: vec3l):
    """Say whether the shifted centre p lies to the left of the edge from a to b in the x-y plane."""
    dx = b[0] - a[0]
    dy = b[1] - a[1]
    edge = dx * (p[1] - a[1]) - dy * (p[0] - a[0])
    # The shift adds -dy e + dx e^2.
    return edge > wp.int64(0) or (
        edge == wp.int64(0) and (dy < wp.int64(0) or (dy == wp.int64(0) and dx > wp.int64(0)))
    )


@wp.func
def _is_beyond(normal: vec3l, offset: vec3l):
    """Say whether the shifted centre at an offset from a point of a plane lies on the side of its normal."""
    mask = (wp.int64(1) << LOW_BITS) - wp.int64(1)
    high = wp.int64(0)
    low = wp.int64(0)
    for k in range(3):
        high += offset[k] * (normal[k] >> LOW_BITS)
        low += offset[k] * (normal[k] & mask)
    high += low >> LOW_BITS
    low = low & mask
    beyond = high > wp.int64(0) or (high == wp.int64(0) and low > wp.int64(0))
    if high == wp.int64(0) and low == wp.int64(0):
        # The shift adds normal . (e, e^2, e^3).
        beyond = normal[0] > wp.int64(0)
        if normal[0] == wp.int64(0):
            beyond = normal[1] > wp.int64(0)
            if normal[1] == wp.int64(0):
                beyond = normal[2] > wp.int64(0)
    return beyond


@wp.func
def _reach(a: wp.vec3d, b: wp.vec3d, low: wp.float64, high: wp.float64):
    """Return the least and the greatest y of an edge from x = low to high, or infinity and its negative."""
    least = wp.float64(wp.inf)
    most = -least
    if wp.min(a[0], b[0]) <= high and wp.max(a[0], b[0]) >= low:
        zero = wp.float64(0.0)
        one = wp.float64(1.0)
        s = zero
        t = one
        if a[0] != b[0]:
            s = wp.clamp((low - a[0]) / (b[0] - a[0]), zero, one)
            t = wp.clamp((high - a[0]) / (b[0] - a[0]), zero, one)
        p = a[1] + s * (b[1] - a[1])
        q = a[1] + t * (b[1] - a[1])
        least = wp.min(p, q)
        most = wp.max(p, q)
    return wp.vec2d(least, most)


@wp.func
def _rows(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, low: wp.float64, high: wp.float64, margin: wp.float64, ny: int):
    """Return the first row along y that a triangle may meet from x = low to high, and the one after the last.

    Rows are those of cells whose middle is at most ``margin`` away.
    """
    p = _reach(a, b, low, high)
    q = _reach(b, c, low, high)
    r = _reach(c, a, low, high)
    least = wp.min(p[0], wp.min(q[0], r[0])) - wp.float64(0.5) - margin
    most = wp.max(p[1], wp.max(q[1], r[1])) - wp.float64(0.5) + margin
    size = wp.float64(ny)
    zero = wp.float64(0.0)
    # One more on each side than the sums say, which are rounded.
    first = int(wp.floor(wp.clamp(least, zero, size)))
    return first, int(wp.ceil(wp.clamp(most + wp.float64(1.0), zero, size)))


@wp.func
def _height(normal: vec3l, a: vec3l, p: vec3l, nz: int):
    """Return the first cell of a column beyond the plane through a, nz if none is; p is the centre of the cell at 0."""
    # Where the plane crosses the column to a rounding, and from there on exactly.
    rise = wp.float64(normal[0]) * wp.float64(a[0] - p[0]) + wp.float64(normal[1]) * wp.float64(a[1] - p[1])
    crossing = (wp.float64(a[2]) + rise / wp.float64(normal[2])) / wp.float64(SUBCELLS)
    k = wp.clamp(int(wp.ceil(crossing - wp.float64(0.5))), 0, nz)
    while k > 0 and _is_beyond(normal, p + vec3l(wp.int64(0), wp.int64(0), wp.int64(k - 1) * wp.int64(SUBCELLS)) - a):
        k -= 1
    while k < nz and not _is_beyond(normal, p + vec3l(wp.int64(0), wp.int64(0), wp.int64(k) * wp.int64(SUBCELLS)) - a):
        k += 1
    return k


@wp.kernel
def find_crossings(
    # In:
    triangles: wp.array3d(dtype=wp.int64),
    shape: wp.vec3i,
    starts: wp.array(dtype=wp.int64),
    # Out:
    crossings: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
):
    """Overwrite the crossings of triangles [count, corner, xyz], in subcells, and how many each triangle has.

    A crossing is twice its place, (x ny + y) (nz + 1) + z with z from 0 to nz, and one more where the ray goes out.
    """
    t = wp.tid()
    counts[t] = wp.int64(0)
    a = _corner(triangles, t, 0)
    b = _corner(triangles, t, 1)
    c = _corner(triangles, t, 2)
    normal = wp.cross(b - a, c - a)
    if normal[2] == wp.int64(0):
        return
    # Seen along z, the corners have to go round counter-clockwise. Then the surface faced down, and a ray goes out.
    goes_out = wp.int64(0)
    if normal[2] < wp.int64(0):
        normal = -normal
        swapped = b
        b = c
        c = swapped
        goes_out = wp.int64(1)
    cell = wp.int64(SUBCELLS)
    half = cell / wp.int64(2)
    # Columns whose centre lies between the least and the greatest coordinate.
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    first_x = int(wp.max(wp.int64(0), (low[0] - half) / cell))
    last_x = int(wp.min(wp.int64(shape[0] - 1), (high[0] + half) / cell))
    scale = wp.float64(1.0) / wp.float64(SUBCELLS)
    at = starts[t]
    for i in range(first_x, last_x + 1):
        x = wp.float64(i) + wp.float64(0.5)
        first_y, after_y = _rows(
            wp.vec3d(a) * scale, wp.vec3d(b) * scale, wp.vec3d(c) * scale, x, x, wp.float64(0.0), shape[1]
        )
        for j in range(first_y, after_y):
            p = vec3l(wp.int64(i) * cell + half, wp.int64(j) * cell + half, half)
            if _covers(a, b, p) and _covers(b, c, p) and _covers(c, a, p):
                if crossings.shape[0] > 0:
                    place = (wp.int64(i) * wp.int64(shape[1]) + wp.int64(j)) * wp.int64(shape[2] + 1)
                    place += wp.int64(_height(normal, a, p, shape[2]))
                    crossings[at] = wp.int64(2) * place + goes_out
                at += wp.int64(1)
    counts[t] = at - starts[t]


@wp.func
def _separates(axis: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, half: wp.float64):
    """Say whether an axis separates a triangle from the box of half edge ``half`` around the origin."""
    p = wp.dot(axis, a)
    q = wp.dot(axis, b)
    r = wp.dot(axis, c)
    reach = half * (wp.abs(axis[0]) + wp.abs(axis[1]) + wp.abs(axis[2]))
    return wp.min(p, wp.min(q, r)) > reach or wp.max(p, wp.max(q, r)) < -reach


@wp.func
def _meets_box(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, half: wp.float64):
    """Say whether a triangle meets the box of half edge ``half`` around the origin, by the separating axes."""
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    meets = not _separates(wp.cross(b - a, c - a), a, b, c, half)
    for k in range(3):
        axis = wp.vec3d(zero, zero, zero)
        axis[k] = one
        meets = meets and not _separates(axis, a, b, c, half)
        meets = meets and not _separates(wp.cross(axis, b - a), a, b, c, half)
        meets = meets and not _separates(wp.cross(axis, c - b), a, b, c, half)
        meets = meets and not _separates(wp.cross(axis, a - c), a, b, c, half)
    return meets


@wp.struct
class Runs:
    """Occupied cells as runs along z."""

    shape: wp.vec3i
    row_start: wp.array(dtype=wp.int32)  # [nx ny + 1] first run of a row, and the end of the last one
    low: wp.array(dtype=wp.int32)  # [run_count] where a run begins
    high: wp.array(dtype=wp.int32)  # [run_count] and ends


@wp.func
def _is_near(runs: Runs, i: int, j: int, k: int):
    """Say whether a cell or one of the 26 around it is occupied."""
    near = bool(False)
    # The row itself first: it has one most often.
    for n in range(9):
        x = i + (n + 4) % 9 / 3 - 1
        y = j + (n + 4) % 3 - 1
        if not near and x >= 0 and y >= 0 and x < runs.shape[0] and y < runs.shape[1]:
            row = x * runs.shape[1] + y
            first = first_beyond(runs.row_start, runs.high, row, k - 1)
            near = first < runs.row_start[row + 1] and runs.low[first] <= k + 1
    return near


@wp.func
def _crosses_column(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, half: wp.float64):
    """Say whether a triangle meets the column of half edge ``half`` around the z axis; its box does."""
    up = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    apart = _separates(wp.cross(up, b - a), a, b, c, half)
    apart = apart or _separates(wp.cross(up, c - b), a, b, c, half)
    return not (apart or _separates(wp.cross(up, a - c), a, b, c, half))


@wp.kernel
def find_thin_parts(
    # In:
    triangles: wp.array3d(dtype=wp.int64),
    runs: Runs,
    far: bool,
    chosen: wp.array(dtype=wp.int64),
    starts: wp.array(dtype=wp.int64),
    # Out:
    places: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
):
    """Overwrite the cells that triangles [count, corner, xyz], in subcells, pass through, and how many each has.

    Far: those with no occupied cell around them. Otherwise those with one. Only of triangles for which ``chosen`` is
    above 0. A cell is given by its place (x ny + y) (nz + 1) + z.
    """
    t = wp.tid()
    counts[t] = wp.int64(0)
    if chosen[t] == wp.int64(0):
        return
    edge_a = _corner(triangles, t, 1) - _corner(triangles, t, 0)
    edge_b = _corner(triangles, t, 2) - _corner(triangles, t, 0)
    normal = wp.vec3d(wp.cross(edge_a, edge_b))
    scale = wp.float64(1.0) / wp.float64(SUBCELLS)
    a = wp.vec3d(_corner(triangles, t, 0)) * scale
    b = wp.vec3d(_corner(triangles, t, 1)) * scale
    c = wp.vec3d(_corner(triangles, t, 2)) * scale
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    half = wp.float64(0.5)
    slope = wp.abs(normal[0]) + wp.abs(normal[1])
    at = starts[t]
    for i in range(wp.max(0, int(low[0])), wp.min(runs.shape[0], int(high[0]) + 1)):
        first_y, after_y = _rows(a, b, c, wp.float64(i), wp.float64(i + 1), half + MARGIN, runs.shape[1])
        for j in range(wp.max(first_y, int(low[1])), wp.min(after_y, int(high[1]) + 1)):
            column = wp.vec3d(wp.float64(i) + half, wp.float64(j) + half, wp.float64(0.0))
            if _crosses_column(a - column, b - column, c - column, half):
                bottom = low[2]
                top = high[2]
                if wp.abs(normal[2]) > STEEP * slope:
                    rise = normal[0] * (a[0] - column[0]) + normal[1] * (a[1] - column[1])
                    middle = a[2] + rise / normal[2]
                    reach = half * slope / wp.abs(normal[2]) + MARGIN
                    bottom = wp.max(bottom, middle - reach)
                    top = wp.min(top, middle + reach)
                for k in range(wp.max(0, int(bottom)), wp.min(runs.shape[2], int(top) + 1)):
                    if _is_near(runs, i, j, k) != far:
                        center = column + wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(k) + half)
                        if _meets_box(a - center, b - center, c - center, half):
                            if places.shape[0] > 0:
                                row = wp.int64(i) * wp.int64(runs.shape[1]) + wp.int64(j)
                                places[at] = row * wp.int64(runs.shape[2] + 1) + wp.int64(k)
                            at += wp.int64(1)
    counts[t] = at - starts[t]


@wp.func
def _root(parent: wp.array(dtype=wp.int32), run: int):
    """Return the run that stands for the piece of a run, and shorten the way there."""
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@wp.kernel
def join_runs(
    # In:
    runs: Runs,
    # In and out:
    parent: wp.array(dtype=wp.int32),
):
    """Join runs of occupied cells that share faces with those of neighbouring rows.

    For one thread, on the CPU: it walks the rows once. ``parent`` begins as the numbers of the runs and ends with the
    first run of each piece.
    """
    for x in range(runs.shape[0]):
        for y in range(runs.shape[1]):
            row = x * runs.shape[1] + y
            for side in range(2):
                other = row - wp.where(side == 0, runs.shape[1], 1)
                if (side == 0 and x > 0) or (side == 1 and y > 0):
                    a = runs.row_start[row]
                    b = runs.row_start[other]
                    while a < runs.row_start[row + 1] and b < runs.row_start[other + 1]:
                        if runs.low[a] < runs.high[b] and runs.low[b] < runs.high[a]:
                            p = _root(parent, a)
                            q = _root(parent, b)
                            parent[wp.max(p, q)] = wp.min(p, q)
                        if runs.high[a] < runs.high[b]:
                            a += 1
                        else:
                            b += 1
    for run in range(parent.shape[0]):
        parent[run] = _root(parent, run)


@wp.kernel
def find_windings(
    # In:
    mesh: wp.uint64,
    centers: wp.array(dtype=wp.vec3f),
    # Out:
    inside: wp.array(dtype=wp.uint8),
):
    """Overwrite whether the generalised winding number of points about a mesh is at least a half."""
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, centers[i], wp.inf)
    inside[i] = wp.where(query.sign < 0.0, wp.uint8(1), wp.uint8(0))
