"""Occupancy grid -> particles, springs and surface of one body.

Cubes that share a face share that face's particles; cubes that only touch along an edge or in a corner stay apart. One
rule does it: every corner of every occupied unit cell belongs to a particle, and at a grid vertex the cells that are
connected through faces around it share one. Which cells those are depends on the occupancy of the 8 cells alone, so a
table of 256 entries gives the particle of every corner, without a search.

Axes of all arrays are [x, y, z]; particles are in scan order, z fastest, so that neighbours in memory are neighbours in
space and springs come in long runs.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels.lattices import (
    BEND,
    BODY_SHEAR,
    CELLS_SHIFT,
    FACE_SHEAR,
    KIND_SHIFT,
    MATERIAL_SHIFT,
    MAX_MATERIALS,
    MIXED,
    STRUCTURAL,
    Grid,
    find_faces,
    find_patterns,
    find_spans,
    place_particles,
    vec8i,
)
from warpjelly.kernels.springs import MAX_SPAN

from .device import start_warp
from .errors import SceneError

# Rest lengths of the four kinds of springs, in unit cells.
REST_LENGTHS = np.sqrt([1.0, 2.0, 3.0, 4.0])

# The 13 directions of springs within a unit cell, one of each opposite pair, kind by kind; then those of bend springs.
DIRECTIONS = sorted(
    [(dx, dy, dz) for dx in (-1, 0, 1) for dy in (-1, 0, 1) for dz in (-1, 0, 1) if (dx, dy, dz) > (0, 0, 0)],
    key=lambda direction: np.abs(direction).sum(),
)
DIRECTIONS += DIRECTIONS[:3]
KINDS = np.repeat([STRUCTURAL, FACE_SHEAR, BODY_SHEAR, BEND], [3, 6, 4, 3])
# Vertices are numbered in int32.
MAX_VERTICES = 2**31 - 1
# Corners of a cell as (x, y, z) bits; a corner's number is 4 x + 2 y + z. Cells around a vertex are numbered alike.
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]


@dataclass(frozen=True)
class SpringClasses:
    """What the springs of a body have in common, whatever its materials are: a row for each distinct combination."""

    kinds: np.ndarray
    """STRUCTURAL, FACE_SHEAR, BODY_SHEAR or BEND, int [class_count]."""
    rest_lengths: np.ndarray
    """float64 [class_count], m."""
    shares: np.ndarray
    """Share of each material of the body in the unit cells around the spring, float64 [class_count, material_count]:
    those that contain it; of a bend spring, those that contain one of the two structural springs under it."""
    cells: np.ndarray | None = None
    """How many unit cells of each material contain the spring, int [class_count, material_count]; of a bend spring, the
    fewer of those of the two structural springs under it. None where it was not asked for."""
    bends: np.ndarray | None = None
    """Sum of ``cells`` of the bend springs over a structural spring, int [class_count, material_count]."""


@dataclass(frozen=True)
class Lattice:
    """One body at rest, in its own frame; in a network or a cloth, which have no cells, a particle counts as of one."""

    particles: np.ndarray
    """Rest positions, float64 [particle_count, 3], m."""
    spans: np.ndarray
    """Springs (i, j), (i + 1, j + 1), ... of one class as (i, j, count, class), by ascending i, at most MAX_SPAN each,
    int32 [span_count, 4]."""
    classes: SpringClasses
    cell_counts: np.ndarray
    """How many unit cells of each material share each particle, together 1 to 8, uint8 [material_count,
    particle_count]."""
    unit: float
    """Edge of a unit cell, m; without cells, the shortest rest length."""
    surface_particles: np.ndarray
    """Particles on the surface, ascending, int32 [surface_count]; without cells, all."""
    surface_quads: np.ndarray
    """Outward faces, counter-clockwise from outside, indices into surface_particles, int32 [face_count, 4]."""
    grid: Grid | None = None
    """The cells and vertices that it is made of, for what hangs on them."""
    origin: np.ndarray | None = None
    """Lowest corner of the grid, float64 [3], m."""

    @property
    def spring_count(self) -> int:
        """Number of springs."""
        return int(self.spans[:, 2].sum(dtype=np.int64))

    def grid_coordinates(self, points: np.ndarray) -> np.ndarray:
        """Return points in the frame of the body, [..., 3], m, in unit cells from the origin of its grid."""
        return (points - self.origin) / self.unit

    def springs(self) -> tuple[np.ndarray, np.ndarray]:
        """Take the spans apart: both ends of each spring, int32 [spring_count, 2], and its class, int32 [spring_count].

        It takes some ten times the memory of the lattice itself.
        """
        counts = self.spans[:, 2]
        place = np.arange(self.spring_count) - np.repeat(np.cumsum(counts, dtype=np.int64) - counts, counts)
        ends = np.repeat(self.spans[:, :2], counts, axis=0)
        ends += place[:, None].astype(np.int32)
        return ends, np.repeat(self.spans[:, 3], counts)


def build_lattice(
    cells: np.ndarray,
    *,
    origin: np.ndarray,
    cell_size: float,
    particles_per_edge: int = 2,
    weighted: bool = False,
    materials: np.ndarray | None = None,
) -> Lattice:
    """Join the occupied cells of a grid into one lattice.

    Args:
        cells: occupied jelly cubes, bool [nx, ny, nz]; at least one.
        origin: lowest corner of the grid, [3], m.
        cell_size: edge of a jelly cube, m.
        particles_per_edge: particles along an edge of each jelly cube, at least 2.
        weighted: tell springs apart by how many cells contain them, too; otherwise the classes of each material are the
            four kinds.
        materials: material of each jelly cube, from 0 and below MAX_MATERIALS, uint8 [nx, ny, nz]; all 0 if None.

    Raises:
        SceneError: the grid has more vertices than can be numbered.
    """
    unit = cell_size / (particles_per_edge - 1)
    grid, particle_count = _number_particles(cells, particles_per_edge - 1, materials)
    vertices = wp.empty(particle_count, dtype=wp.vec3i, device="cpu")
    cell_counts = wp.zeros((grid.material_count, particle_count), dtype=wp.uint8, device="cpu")
    _launch(place_particles, grid.row_low.shape, [grid], [vertices, cell_counts])
    particles = vertices.numpy().astype(float)
    # In place: at this size each temporary counts.
    particles *= unit
    particles += origin
    spans, classes = _connect(grid, unit, weighted)
    surface_particles, surface_quads = _skin(grid, particle_count)
    return Lattice(
        particles=particles,
        spans=spans,
        classes=classes,
        cell_counts=cell_counts.numpy(),
        unit=unit,
        surface_particles=surface_particles,
        surface_quads=surface_quads,
        grid=grid,
        origin=np.asarray(origin),
    )


def order_spans(spans: np.ndarray) -> np.ndarray:
    """Return spans by ascending first particle: its springs, close together in time, find it still in the cache."""
    return spans[np.argsort(spans[:, 0], kind="stable")]


def count_lattice(cells: np.ndarray, *, particles_per_edge: int = 2) -> tuple[int, int, int, int]:
    """Count what ``build_lattice`` would make without making it, from the corners, edges and faces of the jelly cubes.

    Args:
        cells: occupied jelly cubes, bool [nx, ny, nz].
        particles_per_edge: particles along an edge of each jelly cube, at least 2.

    Returns:
        The number of particles, exact; an upper bound of the number of springs, close for thick bodies; about the
        number of spans of springs and of points on the surface.
    """
    cubes = int(np.count_nonzero(cells))
    vertices = int(corner_labels()[1][_vertex_patterns(cells)].sum(dtype=np.int64))
    faces = edges = 0
    for axis in range(3):
        across = np.moveaxis(cells, axis, -1)
        faces += 2 * cubes - int(np.count_nonzero(across[..., 1:] & across[..., :-1]))
        around = np.pad(across, [(1, 1), (1, 1), (0, 0)])
        a, b, c, d = around[:-1, :-1], around[:-1, 1:], around[1:, :-1], around[1:, 1:]
        # An edge between two cubes that only touch there is two edges.
        edges += int(np.count_nonzero(a | b | c | d))
        edges += int(np.count_nonzero((a & d & ~b & ~c) | (b & c & ~a & ~d)))
    n = particles_per_edge - 1
    particles = vertices + edges * (n - 1) + faces * (n - 1) ** 2 + cubes * (n - 1) ** 3
    unit_edges = edges * n + faces * 2 * n * (n - 1) + cubes * 3 * n * (n - 1) ** 2
    unit_faces = faces * n**2 + cubes * 3 * n**2 * (n - 1)
    # Bend springs join consecutive structural ones, so there are fewer of them.
    # Each face of a cube is shared or exposed, and a closed surface of quads has about as many points as faces.
    exposed = 2 * faces - 6 * cubes
    # Each of the directions of springs makes about one span of each row of unit cells, or more where it is long.
    rows = np.count_nonzero(cells[:, :, 0]) + np.count_nonzero(cells[:, :, 1:] & ~cells[:, :, :-1])
    spans = len(DIRECTIONS) * (rows * n**2 + cubes * n**3 // MAX_SPAN)
    return particles, 2 * unit_edges + 2 * unit_faces + 4 * cubes * n**3, spans, exposed * n**2 + 2


@functools.cache
def corner_labels() -> tuple[np.ndarray, np.ndarray]:
    """Say which cells around a grid vertex share a particle, for each of the 256 patterns of occupied cells.

    Bit ``4 x + 2 y + z`` of a pattern stands for the cell on the (x, y, z) side of the vertex.

    Returns:
        labels: uint8 [256, 8], the particle of each cell, numbered from 0 in the order of the cells; 255 where empty.
        counts: uint8 [256], the number of particles.
    """
    labels = np.full((256, 8), 255, np.uint8)
    counts = np.zeros(256, np.uint8)
    for pattern in range(256):
        for start in range(8):
            if not pattern >> start & 1 or labels[pattern, start] != 255:
                continue
            front = [start]
            while front:
                cell = front.pop()
                labels[pattern, cell] = counts[pattern]
                # Cells share a face around the vertex when their numbers differ in one bit.
                front += [n for n in (cell ^ 1, cell ^ 2, cell ^ 4) if pattern >> n & 1 and labels[pattern, n] == 255]
            counts[pattern] += 1
    return labels, counts


def _vertex_patterns(units: np.ndarray) -> np.ndarray:
    """Return the pattern of occupied cells around each grid vertex, uint8 [nx + 1, ny + 1, nz + 1]."""
    nx, ny, nz = units.shape
    padded = np.pad(units, 1)
    pattern = np.zeros((nx + 1, ny + 1, nz + 1), np.uint8)
    for number, (x, y, z) in enumerate(CORNERS):
        pattern |= padded[x : x + nx + 1, y : y + ny + 1, z : z + nz + 1].astype(np.uint8) << np.uint8(number)
    return pattern


def _launch(kernel: wp.Kernel, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel that builds, always on the CPU."""
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu")


def _number_particles(cells: np.ndarray, refinement: int, materials: np.ndarray | None) -> tuple[Grid, int]:
    """Return the grid of the kernels, with its particles in scan order, and how many there are."""
    start_warp()
    labels, counts = corner_labels()
    nz = cells.shape[2]
    occupied = cells.any(axis=2)
    # From the first to the last occupied cell of each row of cells; an empty row begins above where it ends.
    lowest = np.where(occupied, cells.argmax(axis=2), nz)
    highest = np.where(occupied, nz - cells[:, :, ::-1].argmax(axis=2), 0)
    # A row of vertices has those of the four rows of cells around it.
    low = refinement * _reduce_around(np.minimum, lowest, refinement, nz)
    high = refinement * _reduce_around(np.maximum, highest, refinement, 0) + 1
    lengths = np.where(high > low, high - low, 0)
    vertex_count = int(lengths.sum())
    if vertex_count > MAX_VERTICES:
        raise SceneError(f"a grid of {vertex_count:,} vertices is more than the {MAX_VERTICES:,} that can be numbered")

    def array(data: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(data, dtype=dtype, device="cpu")

    grid = Grid()
    grid.cells = array(cells, wp.uint8)
    grid.refinement = refinement
    grid.labels = array(labels, wp.uint8)
    grid.row_start = array((np.cumsum(lengths) - lengths.ravel()).reshape(lengths.shape), wp.int32)
    grid.row_low, grid.row_high = array(low, wp.int32), array(low + lengths, wp.int32)
    grid.patterns = wp.empty(vertex_count, dtype=wp.uint8, device="cpu")
    grid.first = wp.empty(vertex_count, dtype=wp.int32, device="cpu")
    grid.material_count, grid.alike = 1, grid.patterns
    if materials is not None:
        grid.material_count = int(materials[cells].max()) + 1
        grid.materials = array(materials, wp.uint8)
        grid.alike = wp.empty(vertex_count, dtype=wp.uint8, device="cpu")
    _launch(find_patterns, lengths.shape, [grid, array(counts, wp.uint8)], [])
    # From how many particles each vertex has to how many there are before it.
    first = grid.first.numpy()
    last = int(first[-1])
    first[1:] = np.cumsum(first[:-1])
    first[0] = 0
    return grid, int(first[-1]) + last


def _reduce_around(reduce: np.ufunc, rows: np.ndarray, refinement: int, empty: int) -> np.ndarray:
    """Combine what is known of each row of cells, int [nx, ny], into rows of vertices, [refinement nx + 1, ...]."""
    for axis in (0, 1):
        rows = np.repeat(rows, refinement, axis=axis)
        rows = np.pad(rows, [(1, 1) if other == axis else (0, 0) for other in (0, 1)], constant_values=empty)
        low, high = (np.take(rows, np.arange(rows.shape[axis] - 1) + side, axis=axis) for side in (0, 1))
        rows = reduce(low, high)
    return rows


def _connect(grid: Grid, unit: float, weighted: bool) -> tuple[np.ndarray, SpringClasses]:
    """Return the springs as spans, int32 [span_count, 4], and their classes."""
    directions = wp.array(DIRECTIONS, dtype=wp.vec3i, device="cpu")
    kinds = wp.array(KINDS, dtype=wp.int32, device="cpu")
    spans, mixed = _collect(find_spans, len(KINDS), [grid, directions, kinds, weighted], wp.vec4i, vec8i)
    spans = order_spans(spans)
    used = np.zeros(MIXED + len(mixed), bool)
    if not weighted:
        used[np.add.outer(np.arange(grid.material_count) << MATERIAL_SHIFT, np.arange(4) << KIND_SHIFT)] = True
    used[spans[:, 3]] = True
    # Springs of one material have rows, too: one cell of it.
    pure = np.flatnonzero(used[:MIXED])
    rows = np.zeros((len(pure), MAX_MATERIALS), np.int32)
    rows[np.arange(len(pure)), pure >> MATERIAL_SHIFT] = pure % (1 << MATERIAL_SHIFT) | 1 << MATERIAL_SHIFT
    mixed, number = _distinct_rows(mixed)
    class_of_label = np.concatenate([np.cumsum(used[:MIXED]) - 1, len(pure) + number])
    spans[:, 3] = class_of_label[spans[:, 3]]
    rows = np.concatenate([rows, mixed])[:, : grid.material_count]
    return spans, _decode_classes(rows, unit, weighted)


def _distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows of a table of numbers below 2^16, and which of them each is.

    Going by columns takes a tenth of the time of comparing whole rows.
    """
    number = np.zeros(len(rows), np.int64)
    for column in rows.T:
        _, number = np.unique(number << 16 | column, return_inverse=True)
    _, first = np.unique(number, return_index=True)
    return rows[first], number


def _decode_classes(rows: np.ndarray, unit: float, weighted: bool) -> SpringClasses:
    """Return the classes of which there are rows of kernels/lattices.py, int [class_count, material_count]."""
    kinds = rows.max(axis=1) >> KIND_SHIFT & (1 << MATERIAL_SHIFT - KIND_SHIFT) - 1
    around = rows >> MATERIAL_SHIFT
    shares = around / around.sum(axis=1, keepdims=True)
    rest_lengths = REST_LENGTHS[kinds] * unit
    if not weighted:
        return SpringClasses(kinds, rest_lengths, shares)
    cells = rows >> CELLS_SHIFT & (1 << KIND_SHIFT - CELLS_SHIFT) - 1
    return SpringClasses(kinds, rest_lengths, shares, cells, rows & (1 << CELLS_SHIFT) - 1)


def _skin(grid: Grid, particle_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface particles, int32 [point_count], and the outward quads over them, int32 [face_count, 4]."""
    (quads,) = _collect(find_faces, 6, [grid], wp.vec4i)
    on_surface = np.zeros(particle_count, bool)
    on_surface[quads] = True
    point = np.cumsum(on_surface, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(on_surface).astype(np.int32), point[quads]


def _collect(kernel: wp.Kernel, dim: int, inputs: list[Any], *types: Any) -> list[np.ndarray]:
    """Return what the threads of a kernel find one after another, an array of each type: count first, then write."""
    starts, counts = (wp.zeros(len(types) * dim, dtype=wp.int32, device="cpu") for _ in range(2))
    _launch(kernel, dim, [*inputs, starts], [*(wp.empty(0, dtype=kind, device="cpu") for kind in types), counts])
    each = counts.numpy().reshape(len(types), dim)
    total = np.cumsum(each, axis=1)
    starts.assign((total - each).ravel())
    found = [wp.empty(int(count), dtype=kind, device="cpu") for count, kind in zip(total[:, -1], types, strict=True)]
    _launch(kernel, dim, [*inputs, starts], [*found, counts])
    return [array.numpy() for array in found]
