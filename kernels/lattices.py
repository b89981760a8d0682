"""Particles, springs and faces of a lattice, from its occupied cells.

Vertices of the grid are in rows along z, and of each row only the runs that touch cells are stored: vertex (x, y, z) of
a run has the place ``run_start + z - run_low``. There it has the pattern of the 8 cells around it (bit
``4 x + 2 y + z`` for the cell on the (x, y, z) side) and its first particle; a table of 256 patterns says which of the
particles at a vertex belongs to which cell.

These kernels run on the CPU alone. Those of springs and faces are launched over directions, and each thread walks the
whole grid in scan order: so springs come in order, and in runs as long as they can be.
"""

import warp as wp

from . import runs
from .springs import MAX_SPAN

# Unrolled loops would be no faster, and take a third longer to compile.
wp.set_module_options({"enable_backward": False, "max_unroll": 0})

# Kinds of springs.
STRUCTURAL = wp.constant(0)
FACE_SHEAR = wp.constant(1)
BODY_SHEAR = wp.constant(2)
BEND = wp.constant(3)
# What the springs of a class have in common, as one number: kind << 8 | cells << 5 | cells of the bend springs over it.
# At most 4 cells contain a spring, and at most 4 bend springs, each with at most 4 cells, run over a structural one.
# Above that, material << 10.
KIND_SHIFT = wp.constant(8)
CELLS_SHIFT = wp.constant(5)
MATERIAL_SHIFT = wp.constant(10)
# Springs of several materials have a row instead, with such a number for each material that has, above it, how many of
# the cells around the spring are of this material. Labels from MIXED on are numbers of rows.
MAX_MATERIALS = wp.constant(8)
MIXED = wp.constant(MAX_MATERIALS << MATERIAL_SHIFT)

FULL = wp.constant(255)
NONE = wp.constant(-1)

vec8i = wp.types.vector(8, wp.int32)


@wp.struct
class Grid:
    """The vertices of occupied cells, and the particles at each."""

    labels: wp.array2d(dtype=wp.uint8)  # [256, 8] particle of each cell around a vertex, from 0; 255 where empty
    shape: wp.vec3i  # vertices along x, y and z
    row_start: wp.array(dtype=wp.int32)  # [rows + 1] first run of row x shape[1] + y, and the end of the last one
    run_row: wp.array(dtype=wp.int32)  # [run_count] row of a run of vertices
    run_low: wp.array(dtype=wp.int32)  # [run_count] its first z
    run_high: wp.array(dtype=wp.int32)  # [run_count] z after the last
    run_start: wp.array(dtype=wp.int32)  # [run_count] place of its first vertex
    patterns: wp.array(dtype=wp.uint8)  # [vertex_count] occupied cells around each vertex
    first: wp.array(dtype=wp.int32)  # [vertex_count] its first particle
    material_count: int
    materials: wp.array(dtype=wp.uint8)  # [vertex_count] that of the cell above; empty where there is one
    alike: wp.array(dtype=wp.uint8)  # [vertex_count] patterns, but 0 where cells around differ in material


@wp.struct
class Springs:
    """Springs from one vertex in one direction; up to four cells name one each, and mostly the same one."""

    start: wp.vec4i  # particles; NONE where there is no spring
    end: wp.vec4i
    cells: wp.vec4i  # the cells that contain it, as a pattern of those around the vertex


@wp.struct
class Bends:
    """Bend springs from one vertex along one axis."""

    count: int
    start: vec8i
    end: vec8i
    near: vec8i  # which of the springs from the vertex it spans first,
    far: vec8i  # and which of those from the next vertex then
    near_cells: vec8i  # the cells of the first, around the vertex,
    far_cells: vec8i  # and of the second, around the next vertex


@wp.func
def row_of(grid: Grid, run: int):
    """Return x and y of the row of vertices that a run is in."""
    row = grid.run_row[run]
    return row / grid.shape[1], row % grid.shape[1]


@wp.func
def vertex(grid: Grid, x: int, y: int, z: int):
    """Return the place of a vertex, NONE where no cell touches it."""
    place = int(NONE)
    if x >= 0 and y >= 0 and x < grid.shape[0] and y < grid.shape[1]:
        row = x * grid.shape[1] + y
        run = runs.first_beyond(grid.row_start, grid.run_high, row, z)
        if run < grid.row_start[row + 1] and z >= grid.run_low[run]:
            place = grid.run_start[run] + z - grid.run_low[run]
    return place


@wp.func
def occupied(grid: Grid, x: int, y: int, z: int):
    """Say whether a unit cell is occupied: it is cell 7 of its lowest vertex."""
    place = vertex(grid, x, y, z)
    return place >= 0 and int(grid.patterns[wp.max(place, 0)]) >= 128


@wp.func
def material_around(grid: Grid, x: int, y: int, z: int, number: int):
    """Return the material of an occupied cell around a vertex: it is kept at the lowest vertex of the cell."""
    m = int(0)
    if grid.material_count > 1:
        m = int(grid.materials[vertex(grid, x - 1 + number / 4, y - 1 + number / 2 % 2, z - 1 + number % 2)])
    return m


@wp.func
def count_materials(grid: Grid, x: int, y: int, z: int, pattern: int):
    """Return how many of the cells around a vertex that a pattern has are of each material."""
    counts = vec8i()
    for number in range(8):
        if (pattern >> number) % 2 == 1:
            m = material_around(grid, x, y, z, number)
            counts[m] = counts[m] + 1
    return counts


@wp.func
def corner_particle(grid: Grid, place: int, number: int):
    """Return the particle that a cell has at a vertex of which it is cell ``number``."""
    return grid.first[place] + int(grid.labels[int(grid.patterns[place]), number])


@wp.func
def is_inner(grid: Grid, place: int):
    """Say whether a vertex, if there is one at the place, has all 8 cells around it, of one material."""
    return place >= 0 and int(grid.alike[wp.max(place, 0)]) == FULL


@wp.func
def springs_from(grid: Grid, x: int, y: int, z: int, dx: int, dy: int, dz: int):
    """Return the springs from a vertex in a direction of components -1, 0, 1.

    A cell contains both ends if the vertex is its corner (cx, cy, cz), and the end its corner (cx + dx, ...).
    """
    springs = Springs()
    springs.start = wp.vec4i(NONE, NONE, NONE, NONE)
    here = vertex(grid, x, y, z)
    there = vertex(grid, x + dx, y + dy, z + dz)
    if here >= 0 and there >= 0:
        found = int(0)
        for number in range(8):
            cx = number / 4
            cy = number / 2 % 2
            cz = number % 2
            fits = cx + dx >= 0 and cx + dx <= 1 and cy + dy >= 0 and cy + dy <= 1 and cz + dz >= 0 and cz + dz <= 1
            # The cell lies on the other side of the vertex than the vertex of it.
            if fits and (int(grid.patterns[here]) >> (7 - number)) % 2 == 1:
                start = corner_particle(grid, here, 7 - number)
                end = corner_particle(grid, there, 7 - number - (4 * dx + 2 * dy + dz))
                repeated = bool(False)
                for earlier in range(found):
                    if springs.start[earlier] == start and springs.end[earlier] == end:
                        springs.cells[earlier] = springs.cells[earlier] | (1 << (7 - number))
                        repeated = True
                if not repeated:
                    springs.start[found] = start
                    springs.end[found] = end
                    springs.cells[found] = 1 << (7 - number)
                    found += 1
    return springs


@wp.func
def bends_from(grid: Grid, x: int, y: int, z: int, dx: int, dy: int, dz: int):
    """Return the bend springs from a vertex along an axis: they span two structural springs one after the other.

    Two ways around a gap may lead to the same end; one spring is enough.
    """
    bends = Bends()
    near = springs_from(grid, x, y, z, dx, dy, dz)
    far = springs_from(grid, x + dx, y + dy, z + dz, dx, dy, dz)
    here = vertex(grid, x, y, z)
    found = int(0)
    if here >= 0:
        for particle in range(grid.first[here], grid.first[here] + 4):
            for a in range(4):
                for b in range(4):
                    if near.start[a] == particle and far.start[b] == near.end[a]:
                        fresh = bool(True)
                        for earlier in range(found):
                            if bends.start[earlier] == particle and bends.end[earlier] == far.end[b]:
                                fresh = False
                        if fresh:
                            bends.start[found] = particle
                            bends.end[found] = far.end[b]
                            bends.near[found] = a
                            bends.far[found] = b
                            bends.near_cells[found] = near.cells[a]
                            bends.far_cells[found] = far.cells[b]
                            found += 1
    bends.count = found
    return bends


@wp.kernel
def find_alike(
    # In and out:
    grid: Grid,
):
    """Overwrite ``alike`` of a run of vertices, where there are several materials."""
    run = wp.tid()
    x, y = row_of(grid, run)
    start = grid.run_start[run] - grid.run_low[run]
    for z in range(grid.run_low[run], grid.run_high[run]):
        pattern = int(grid.patterns[start + z])
        found = count_materials(grid, x, y, z, pattern)
        uniform = wp.max(found) == wp.dot(found, vec8i(1))
        grid.alike[start + z] = wp.uint8(wp.where(uniform, pattern, 0))


@wp.kernel
def place_particles(
    # In:
    grid: Grid,
    # Out:
    vertices: wp.array(dtype=wp.vec3i),
    cells: wp.array2d(dtype=wp.uint8),
):
    """Overwrite the grid coordinates of the particles of a run, and add the cells of each material that share each."""
    run = wp.tid()
    x, y = row_of(grid, run)
    start = grid.run_start[run] - grid.run_low[run]
    for z in range(grid.run_low[run], grid.run_high[run]):
        pattern = int(grid.patterns[start + z])
        for number in range(8):
            if (pattern >> number) % 2 == 1:
                particle = corner_particle(grid, start + z, number)
                vertices[particle] = wp.vec3i(x, y, z)
                m = material_around(grid, x, y, z, number)
                cells[m, particle] = cells[m, particle] + wp.uint8(1)


@wp.func
def bend_cells(grid: Grid, x: int, y: int, z: int, dx: int, dy: int, dz: int, near: int, far: int):
    """Return the cells that count for a bend spring from a vertex, of each material.

    Those are the fewer of the cells around both structural springs under it, ``near`` and ``far``, as patterns.
    """
    return wp.min(
        count_materials(grid, x, y, z, near),
        count_materials(grid, x + dx, y + dy, z + dz, far),
    )


@wp.func
def cells_of_bends(grid: Grid, x: int, y: int, z: int, dx: int, dy: int, dz: int, slot: int):
    """Return the sum of the cells of the bend springs over a structural one, given as one of those from a vertex."""
    total = vec8i()
    after = bends_from(grid, x, y, z, dx, dy, dz)
    for b in range(after.count):
        if after.near[b] == slot:
            total += bend_cells(grid, x, y, z, dx, dy, dz, after.near_cells[b], after.far_cells[b])
    before = bends_from(grid, x - dx, y - dy, z - dz, dx, dy, dz)
    for b in range(before.count):
        if before.far[b] == slot:
            total += bend_cells(grid, x - dx, y - dy, z - dz, dx, dy, dz, before.near_cells[b], before.far_cells[b])
    return total


@wp.func
def describe(grid: Grid, kind: int, around: vec8i, cells: vec8i, bends: vec8i):
    """Return the row of a spring, from its numbers of cells of each material: around it, in it and in its bends."""
    row = vec8i()
    for m in range(grid.material_count):
        if around[m] > 0:
            row[m] = around[m] << MATERIAL_SHIFT | kind << KIND_SHIFT | cells[m] << CELLS_SHIFT | bends[m]
    return row


@wp.func
def label_row(grid: Grid, rows: wp.array(dtype=vec8i), row: vec8i, last: vec8i, at: int):
    """Return the label of a spring with this row, and where the next row goes.

    Of several materials, store the row at ``at`` unless it is the last one again, or rows are only counted.
    """
    label = int(0)
    found = int(0)
    for m in range(grid.material_count):
        if row[m] > 0:
            label = row[m] % (1 << MATERIAL_SHIFT) | m << MATERIAL_SHIFT
            found += 1
    if found > 1:
        if not (row == last):
            if at < rows.shape[0]:
                rows[at] = row
            at += 1
            last = row
        label = MIXED + at - 1
    return label, last, at


@wp.func
def append_spring(spans: wp.array(dtype=wp.vec4i), span: wp.vec4i, at: int, start: int, end: int, label: int):
    """Lengthen the current span by a spring, or store it at ``at`` and begin another; return it and where it goes."""
    count = span[2]
    if count > 0 and count < MAX_SPAN and span[3] == label and start == span[0] + count and end == span[1] + count:
        span[2] = count + 1
    else:
        at = store_span(spans, span, at)
        span = wp.vec4i(start, end, 1, label)
    return span, at


@wp.func
def store_span(spans: wp.array(dtype=wp.vec4i), span: wp.vec4i, at: int):
    """Store a span, unless it is empty or the spans are only counted; return where the next one goes."""
    if span[2] > 0:
        if at < spans.shape[0]:
            spans[at] = span
        at += 1
    return at


@wp.kernel
def find_spans(
    # In:
    grid: Grid,
    directions: wp.array(dtype=wp.vec3i),
    kinds: wp.array(dtype=wp.int32),
    weighted: bool,
    starts: wp.array(dtype=wp.int32),
    # Out:
    spans: wp.array(dtype=wp.vec4i),
    rows: wp.array(dtype=vec8i),
    counts: wp.array(dtype=wp.int32),
):
    """Overwrite the spans (i, j, count, label) of a direction, and the rows of their labels, from their starts on.

    Overwrite, too, how many there are; starts and counts are those of all spans, then of all rows. Without room, count
    alone. Unless weighted, labels and rows tell kinds and materials apart alone.
    """
    d = wp.tid()
    dx = directions[d][0]
    dy = directions[d][1]
    dz = directions[d][2]
    kind = kinds[d]
    reach = wp.where(kind == BEND, 2, 1)
    # Deep inside, which is nearly everywhere, there is one spring from each vertex, and all are alike.
    inner_label = kind << KIND_SHIFT
    if weighted:
        inner_label |= (8 >> (wp.abs(dx) + wp.abs(dy) + wp.abs(dz))) << CELLS_SHIFT
        if kind == STRUCTURAL:
            inner_label |= 8
    at = starts[d]
    row_start = starts[kinds.shape[0] + d]
    row_at = int(row_start)
    last = vec8i()
    span = wp.vec4i(0, 0, 0, 0)
    for run in range(grid.run_row.shape[0]):
        x, y = row_of(grid, run)
        for z in range(grid.run_low[run], grid.run_high[run]):
            here = grid.run_start[run] + z - grid.run_low[run]
            there = vertex(grid, x + reach * dx, y + reach * dy, z + reach * dz)
            inner = is_inner(grid, here) and is_inner(grid, there)
            if inner and kind == BEND:
                inner = is_inner(grid, vertex(grid, x + dx, y + dy, z + dz))
            if inner and weighted and kind == STRUCTURAL:
                inner = is_inner(grid, vertex(grid, x - dx, y - dy, z - dz)) and (
                    is_inner(grid, vertex(grid, x + 2 * dx, y + 2 * dy, z + 2 * dz))
                )
            if inner:
                label = inner_label
                if grid.material_count > 1:
                    label |= int(grid.materials[here]) << MATERIAL_SHIFT
                span, at = append_spring(spans, span, at, grid.first[here], grid.first[there], label)
            elif kind == BEND:
                bends = bends_from(grid, x, y, z, dx, dy, dz)
                for b in range(bends.count):
                    near = count_materials(grid, x, y, z, bends.near_cells[b])
                    far = count_materials(grid, x + dx, y + dy, z + dz, bends.far_cells[b])
                    cells = vec8i()
                    if weighted:
                        cells = wp.min(near, far)
                    row = describe(grid, kind, near + far, cells, vec8i())
                    label, last, row_at = label_row(grid, rows, row, last, row_at)
                    span, at = append_spring(spans, span, at, bends.start[b], bends.end[b], label)
            else:
                found = springs_from(grid, x, y, z, dx, dy, dz)
                for s in range(4):
                    if found.start[s] >= 0:
                        around = count_materials(grid, x, y, z, found.cells[s])
                        cells = vec8i()
                        over = vec8i()
                        if weighted:
                            cells = around
                            if kind == STRUCTURAL:
                                over = cells_of_bends(grid, x, y, z, dx, dy, dz, s)
                        row = describe(grid, kind, around, cells, over)
                        label, last, row_at = label_row(grid, rows, row, last, row_at)
                        span, at = append_spring(spans, span, at, found.start[s], found.end[s], label)
    counts[d] = store_span(spans, span, at) - starts[d]
    counts[kinds.shape[0] + d] = row_at - row_start


@wp.kernel
def find_faces(
    # In:
    grid: Grid,
    starts: wp.array(dtype=wp.int32),
    # Out:
    quads: wp.array(dtype=wp.vec4i),
    counts: wp.array(dtype=wp.int32),
):
    """Overwrite the exposed faces of cells on one of six sides, from its start on, and how many there are.

    The corners, particles, go round counter-clockwise from outside. Without room for faces, count them alone.
    """
    direction = wp.tid()
    axis = direction / 2
    side = direction % 2
    # The other two axes, in the order that makes their cross product point along +axis.
    u = (axis + 1) % 3
    w = (axis + 2) % 3
    at = starts[direction]
    step = wp.vec3i(0, 0, 0)
    step[axis] = 2 * side - 1
    for run in range(grid.run_row.shape[0]):
        x, y = row_of(grid, run)
        for z in range(grid.run_low[run], grid.run_high[run]):
            if occupied(grid, x, y, z):
                if not occupied(grid, x + step[0], y + step[1], z + step[2]):
                    if at < quads.shape[0]:
                        quad = wp.vec4i(0, 0, 0, 0)
                        for k in range(4):
                            # (0, 0), (1, 0), (1, 1), (0, 1) along (u, w), or the other way round.
                            corner = wp.vec3i(0, 0, 0)
                            corner[axis] = side
                            along_u = (k + 1) / 2 % 2
                            along_w = k / 2
                            corner[u] = wp.where(side == 1, along_u, along_w)
                            corner[w] = wp.where(side == 1, along_w, along_u)
                            place = vertex(grid, x + corner[0], y + corner[1], z + corner[2])
                            number = 7 - (4 * corner[0] + 2 * corner[1] + corner[2])
                            quad[k] = corner_particle(grid, place, number)
                        quads[at] = quad
                    at += 1
    counts[direction] = at - starts[direction]
