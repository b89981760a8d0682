"""Triangles -> occupied cells: scan conversion, and what it leaves out.

A cell's winding number is how often the surface goes round its centre: the crossings of a ray from there towards -z, +1
where it goes out of the mesh and -1 where it goes in. Each triangle adds its crossing to one place in each column of
cells that it covers: to the first cell whose centre lies beyond it, or to the extra place after the last cell. Sums
along the columns then give the winding number of every cell, and the one after the last cell says whether the surface
is closed there. Counters are bits in planes: one plane keeps them modulo 2, which is parity, and four modulo 16.

Centres that lie exactly on an edge, a vertex or a face count as shifted by (e, e^2, e^3) for a vanishing e > 0, so that
neighbouring triangles never both count a column, nor both miss it. All tests are in integers, hence exact.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Vertices are snapped to this fraction of a cell. At 4096 cells an edge function stays within 2 (2^12 2^18)^2 = 2^61.
SUBCELLS = 1 << 18
# Products of three coordinates are exact in two parts, of which the low one has this many bits.
LOW_BITS = wp.constant(wp.int64(30))
BITS_PER_WORD = 32

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


@wp.kernel
def add_crossings(
    # In:
    triangles: wp.array3d(dtype=wp.int64),
    shape: wp.vec3i,
    # Out:
    planes: wp.array4d(dtype=wp.uint32),
):
    """Add the crossings of triangles [count, corner, xyz], in subcells, one thread per triangle.

    Counters are in the bits of planes [plane, x, y, z / 32], z from 0 to shape[2].
    """
    t = wp.tid()
    a = _corner(triangles, t, 0)
    b = _corner(triangles, t, 1)
    c = _corner(triangles, t, 2)
    normal = wp.cross(b - a, c - a)
    if normal[2] == wp.int64(0):
        return
    # Seen along z, the corners have to go round counter-clockwise. Then the surface faced down, and a ray goes out.
    goes_out = bool(False)
    if normal[2] < wp.int64(0):
        normal = -normal
        swapped = b
        b = c
        c = swapped
        goes_out = True
    cell = wp.int64(SUBCELLS)
    half = cell / wp.int64(2)
    # Columns whose centre lies between the least and the greatest coordinate.
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    first_x = int(wp.max(wp.int64(0), (low[0] - half) / cell))
    last_x = int(wp.min(wp.int64(shape[0] - 1), (high[0] + half) / cell))
    first_y = int(wp.max(wp.int64(0), (low[1] - half) / cell))
    last_y = int(wp.min(wp.int64(shape[1] - 1), (high[1] + half) / cell))
    for i in range(first_x, last_x + 1):
        for j in range(first_y, last_y + 1):
            p = vec3l(wp.int64(i) * cell + half, wp.int64(j) * cell + half, half)
            if _covers(a, b, p) and _covers(b, c, p) and _covers(c, a, p):
                # Where the plane crosses the column to a rounding, and from there on exactly.
                rise = wp.float64(normal[0]) * wp.float64(a[0] - p[0]) + wp.float64(normal[1]) * wp.float64(a[1] - p[1])
                crossing = (wp.float64(a[2]) + rise / wp.float64(normal[2])) / wp.float64(SUBCELLS)
                k = wp.clamp(int(wp.ceil(crossing - wp.float64(0.5))), 0, shape[2])
                while k > 0 and _is_beyond(normal, vec3l(p[0], p[1], wp.int64(k - 1) * cell + half) - a):
                    k -= 1
                while k < shape[2] and not _is_beyond(normal, vec3l(p[0], p[1], wp.int64(k) * cell + half) - a):
                    k += 1
                # A carry of +1 goes on where the bit was 1, that of -1 where it was 0.
                bit = wp.uint32(1) << wp.uint32(k % BITS_PER_WORD)
                carries = bool(True)
                for plane in range(planes.shape[0]):
                    if carries:
                        before = wp.atomic_xor(planes, plane, i, j, k / BITS_PER_WORD, bit)
                        carries = ((before & bit) != wp.uint32(0)) == goes_out


# Whole runs of cells at once: between crossings, far apart at fine resolutions, all cells are alike.
@wp.func_native("""
    auto column = cells.data + (size_t(i) * cells.shape[1] + j) * cells.shape[2];
    if (stop > start) memset(column + start, value, stop - start);
""")
def _fill_run(cells: wp.array3d(dtype=wp.uint8), i: int, j: int, start: int, stop: int, value: int): ...


@wp.kernel
def fill_columns(
    # In:
    planes: wp.array4d(dtype=wp.uint32),
    # Out:
    cells: wp.array3d(dtype=wp.uint8),
    open_columns: wp.array2d(dtype=wp.uint8),
    seen: wp.array(dtype=wp.int32),
):
    """Overwrite which cells have a winding number that is not 0, one thread per column.

    Overwrite too in which columns the surface is open, and set what winding numbers were seen, modulo seen's length.
    """
    i, j = wp.tid()
    count = planes.shape[0]
    nz = cells.shape[2]
    winding = int(0)
    # Where the cells begin that have this winding number.
    start = int(0)
    for word in range(nz / BITS_PER_WORD + 1):
        crossed = wp.uint32(0)
        for plane in range(count):
            crossed |= planes[plane, i, j, word]
        if crossed != wp.uint32(0):
            for bit in range(BITS_PER_WORD):
                if ((crossed >> wp.uint32(bit)) & wp.uint32(1)) != wp.uint32(0):
                    k = word * BITS_PER_WORD + bit
                    _fill_run(cells, i, j, start, k, wp.min(winding, 1))
                    start = k
                    for plane in range(count):
                        winding += int((planes[plane, i, j, word] >> wp.uint32(bit)) & wp.uint32(1)) << plane
                    winding = winding & ((1 << count) - 1)
                    seen[winding] = 1
    _fill_run(cells, i, j, start, nz, wp.min(winding, 1))
    open_columns[i, j] = wp.uint8(wp.min(winding, 1))


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


@wp.func
def _is_near(cells: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int):
    """Say whether a cell or one of the 26 around it is occupied."""
    if cells[i, j, k] != wp.uint8(0):
        return True
    for x in range(wp.max(0, i - 1), wp.min(cells.shape[0], i + 2)):
        for y in range(wp.max(0, j - 1), wp.min(cells.shape[1], j + 2)):
            for z in range(wp.max(0, k - 1), wp.min(cells.shape[2], k + 2)):
                if cells[x, y, z] != wp.uint8(0):
                    return True
    return False


@wp.kernel
def find_thin_parts(
    # In:
    triangles: wp.array2d(dtype=wp.vec3d),
    cells: wp.array3d(dtype=wp.uint8),
    far: bool,
    # In and out:
    thin: wp.array(dtype=wp.uint8),
    # Out:
    found: wp.array3d(dtype=wp.uint8),
):
    """Find the cells that triangles [count, corner], in cells, pass through, one thread per triangle.

    Far: those with no occupied cell around them, whose triangles become thin. Otherwise: of thin triangles, those with
    one. Occupy the cells found, where there is room for them.
    """
    t = wp.tid()
    if not far and thin[t] == wp.uint8(0):
        return
    a = triangles[t, 0]
    b = triangles[t, 1]
    c = triangles[t, 2]
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    half = wp.float64(0.5)
    for i in range(wp.max(0, int(low[0])), wp.min(cells.shape[0], int(high[0]) + 1)):
        for j in range(wp.max(0, int(low[1])), wp.min(cells.shape[1], int(high[1]) + 1)):
            for k in range(wp.max(0, int(low[2])), wp.min(cells.shape[2], int(high[2]) + 1)):
                if _is_near(cells, i, j, k) != far:
                    center = wp.vec3d(wp.float64(i) + half, wp.float64(j) + half, wp.float64(k) + half)
                    if _meets_box(a - center, b - center, c - center, half):
                        thin[t] = wp.uint8(1)
                        if found.shape[0] > 0:
                            found[i, j, k] = wp.uint8(1)


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
    row_start: wp.array2d(dtype=wp.int32),
    low: wp.array(dtype=wp.int32),
    high: wp.array(dtype=wp.int32),
    # In and out:
    parent: wp.array(dtype=wp.int32),
):
    """Join runs of occupied cells, from low to high along z, that share faces with those of neighbouring rows.

    For one thread, on the CPU: it walks the rows once. ``row_start`` [nx, ny + 1] has the first run of each row and the
    end of the last one in y; ``parent`` begins as the numbers of the runs and ends with the first run of each piece.
    """
    for x in range(row_start.shape[0]):
        for y in range(row_start.shape[1] - 1):
            for side in range(2):
                nx = x - 1 + side
                ny = y - side
                if nx >= 0 and ny >= 0:
                    a = row_start[x, y]
                    b = row_start[nx, ny]
                    while a < row_start[x, y + 1] and b < row_start[nx, ny + 1]:
                        if low[a] < high[b] and low[b] < high[a]:
                            p = _root(parent, a)
                            q = _root(parent, b)
                            parent[wp.max(p, q)] = wp.min(p, q)
                        if high[a] < high[b]:
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
