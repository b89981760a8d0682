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
from collections.abc import Sequence
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
    find_alike,
    find_faces,
    find_spans,
    place_particles,
    vec8i,
)
from warpjelly.kernels.springs import MAX_SPAN

from .cells import Cells, is_last
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
# Spans that are taken apart at a time, where few of their springs are looked for.
_SPAN_BLOCK = 1 << 14


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

    places: np.ndarray
    """Where the particles rest, [particle_count, 3]: of cells, the vertices of the grid, int32; else float64, m."""
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
    def particle_count(self) -> int:
        """Number of particles."""
        return len(self.places)

    @property
    def spring_count(self) -> int:
        """Number of springs."""
        return int(self.spans[:, 2].sum(dtype=np.int64))

    @property
    def particles(self) -> np.ndarray:
        """Rest positions of all particles, float64 [particle_count, 3], m; of a large body, more than all the rest."""
        return self.positions(slice(None))

    def positions(self, particles: slice | np.ndarray) -> np.ndarray:
        """Return the rest positions of some particles, float64 [..., 3], m."""
        x = self.places[particles].astype(float)
        if self.grid is not None:
            # In place: at this size each temporary counts.
            x *= self.unit
            x += self.origin
        return x

    def grid_coordinates(self, points: np.ndarray) -> np.ndarray:
        """Return points in the frame of the body, [..., 3], m, in unit cells from the origin of its grid."""
        return (points - self.origin) / self.unit

    def springs(self) -> tuple[np.ndarray, np.ndarray]:
        """Take the spans apart: both ends of each spring, int32 [spring_count, 2], and its class, int32 [spring_count].

        It takes some ten times the memory of the lattice itself.
        """
        return _springs_of(self.spans)

    def springs_among(self, chosen: np.ndarray) -> np.ndarray:
        """Return both ends of each spring between chosen particles, bool [particle_count]: int32 [count, 2]."""
        found = [np.zeros((0, 2), np.int32)]
        for start in range(0, len(self.spans), _SPAN_BLOCK):
            ends, _ = _springs_of(self.spans[start : start + _SPAN_BLOCK])
            found.append(ends[chosen[ends].all(axis=1)])
        return np.concatenate(found)


def _springs_of(spans: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take spans apart: both ends of each spring, int32 [spring_count, 2], and its class, int32 [spring_count]."""
    counts = spans[:, 2]
    first = np.cumsum(counts, dtype=np.int64) - counts
    place = np.arange(counts.sum(dtype=np.int64)) - np.repeat(first, counts)
    ends = np.repeat(spans[:, :2], counts, axis=0)
    ends += place[:, None].astype(np.int32)
    return ends, np.repeat(spans[:, 3], counts)


def build_lattice(
    cells: Cells,
    *,
    origin: np.ndarray,
    cell_size: float,
    particles_per_edge: int = 2,
    weighted: bool = False,
    materials: Sequence[Cells] = (),
) -> Lattice:
    """Join the occupied cells of a grid into one lattice.

    Args:
        cells: occupied jelly cubes; at least one.
        origin: lowest corner of the grid, [3], m.
        cell_size: edge of a jelly cube, m.
        particles_per_edge: particles along an edge of each jelly cube, at least 2.
        weighted: tell springs apart by how many cells contain them, too; otherwise the classes of each material are the
            four kinds.
        materials: jelly cubes of each material, at most MAX_MATERIALS; each cube has one. Of one material if empty.

    Raises:
        SceneError: the grid has more vertices than can be numbered.
    """
    unit = cell_size / (particles_per_edge - 1)
    parts = particles_per_edge - 1
    grid, particle_count = _number_particles(cells.refined(parts), [part.refined(parts) for part in materials])
    vertices = wp.empty(particle_count, dtype=wp.vec3i, device="cpu")
    cell_counts = wp.zeros((grid.material_count, particle_count), dtype=wp.uint8, device="cpu")
    _launch(place_particles, len(grid.run_row), [grid], [vertices, cell_counts])
    spans, classes = _connect(grid, unit, weighted)
    surface_particles, surface_quads = _skin(grid, particle_count)
    return Lattice(
        places=vertices.numpy(),
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


@dataclass(frozen=True)
class LatticeCounts:
    """What ``build_lattice`` would make."""

    particles: int
    spring_bound: int
    """No more springs than this; close for thick bodies."""
    span_estimate: int
    """About as many spans of springs as this."""
    skin: int
    """Number of particles on the surface."""
    sides: int
    """The same, each once for each direction of faces that it is a corner of."""


def count_lattice(cells: Cells, *, particles_per_edge: int = 2, materials: Sequence[Cells] = ()) -> LatticeCounts:
    """Count what ``build_lattice`` would make without making it, from the corners, edges and faces of the jelly cubes.

    Args:
        cells: occupied jelly cubes.
        particles_per_edge: particles along an edge of each jelly cube, at least 2.
        materials: jelly cubes of each material, as for ``build_lattice``.
    """
    vertices = _Vertices(cells)
    seen = np.bincount(vertices.patterns, vertices.lengths, minlength=256).astype(np.int64)
    every, skin, sides, (faces, cubes) = np.tensordot(seen, _pattern_parts(), 1).tolist()
    n = particles_per_edge - 1
    corners, edges = every
    unit_edges = edges * n + faces * 2 * n * (n - 1) + cubes * 3 * n * (n - 1) ** 2
    unit_faces = faces * n**2 + cubes * 3 * n**2 * (n - 1)
    # Each face of a cube is shared or exposed.
    exposed = (2 * faces - 6 * cubes) * (n - 1) ** 2
    # Each of the directions of springs makes about one span of each row of unit cells alike, or more where it is long.
    lengths = np.concatenate([np.diff(part.edges)[::2] for part in materials or [cells]]) * n + 1
    return LatticeCounts(
        particles=corners + edges * (n - 1) + faces * (n - 1) ** 2 + cubes * (n - 1) ** 3,
        # Bend springs join consecutive structural ones, so there are fewer of them.
        spring_bound=2 * unit_edges + 2 * unit_faces + 4 * cubes * n**3,
        span_estimate=len(DIRECTIONS) * int((-(-lengths // MAX_SPAN)).sum()) * n**2,
        skin=skin[0] + skin[1] * (n - 1) + exposed,
        sides=sides[0] + sides[1] * (n - 1) + exposed,
    )


# Bits of the numbers of cells around a vertex, which stand for the axes x, y and z.
_AXES = (4, 2, 1)


def _joined_cells(pattern: int, axes: Sequence[int]) -> list[list[int]]:
    """Return the cells of a pattern in groups that are connected through faces across some axes.

    Groups are in the order of their first cells. Cells share a face when their numbers differ in one bit.
    """
    groups: list[list[int]] = []
    left = [cell for cell in range(8) if pattern >> cell & 1]
    while left:
        group = [left.pop(0)]
        for cell in group:
            near = [cell ^ axis for axis in axes if cell ^ axis in left]
            group += near
            left = [other for other in left if other not in near]
        groups.append(group)
    return groups


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
        groups = _joined_cells(pattern, _AXES)
        for number, group in enumerate(groups):
            labels[pattern, group] = number
        counts[pattern] = len(groups)
    return labels, counts


@functools.cache
def _pattern_parts() -> np.ndarray:
    """Count parts of jelly cubes by the vertex that they begin at, for each pattern, int64 [256, 4, 2].

    Corners and edges: all, those of exposed faces, and the same for each direction of such faces; faces and cubes.
    Edges, faces and cubes begin at their lowest vertex. An edge between two cubes that only touch there is two edges.
    """
    parts = np.zeros((256, 4, 2), np.int64)
    for pattern in range(256):
        parts[pattern, :3, 0] = _count_groups(pattern, _AXES)
        for axis in _AXES:
            above = sum(1 << cell for cell in range(8) if cell & axis and pattern >> cell & 1)
            parts[pattern, :3, 1] += _count_groups(above, [other for other in _AXES if other != axis])
            # The face across this axis lies between the last cell and the one below it.
            parts[pattern, 3, 0] += (pattern >> 7 | pattern >> (7 - axis)) & 1
        parts[pattern, 3, 1] = pattern >> 7
    return parts


def _count_groups(pattern: int, axes: Sequence[int]) -> tuple[int, int, int]:
    """Count groups of joined cells: all, those with exposed faces across some axes, and the directions of these."""
    groups = _joined_cells(pattern, axes)
    directions = [
        {(axis, cell & axis) for cell in group for axis in axes if not pattern >> (cell ^ axis) & 1} for group in groups
    ]
    return len(groups), sum(map(bool, directions)), sum(map(len, directions))


class _Vertices:
    """The vertices of occupied cells, as stretches along z of vertices with the same cells around them."""

    def __init__(self, cells: Cells) -> None:
        """Find them: what is occupied of the four rows of cells around a row of vertices changes seldom."""
        nx, ny, nz = cells.shape
        self.shape = (nx + 1, ny + 1, nz + 1)
        row, z = np.divmod(cells.edges, nz + 1)
        # Of the row of vertices at the low corner; a vertex is at a place as high as the lower face of a cell.
        place = (row + row // ny) * (nz + 1) + z
        # Where a row of cells changes on the (x, y) side of a row of vertices, as 4 place + 2 x + y.
        rows_up = np.array([(1 - x) * (ny + 1) + (1 - y) for x in (0, 1) for y in (0, 1)])
        changes = ((4 * (nz + 1) * rows_up + np.arange(4))[:, None] + 4 * place).ravel()
        # In place, and in few bytes: at this size each temporary counts.
        changes.sort()
        rows_after = np.bitwise_xor.accumulate(np.uint8(1) << (changes & 3).astype(np.uint8))
        changes >>= 2
        last = is_last(changes)
        places, above = changes[last], rows_after[last]
        del changes, rows_after, last
        below = np.concatenate([[np.uint8(0)], above[:-1]])[: len(above)]
        # Bit 2 x + y of what is occupied above is bit 4 x + 2 y + 1 of a pattern, and of what is below 4 x + 2 y.
        spread = np.array([sum((rows >> side & 1) << 2 * side for side in range(4)) for rows in range(16)], np.uint8)
        self.patterns = np.stack([spread[below] | spread[above] << 1, 3 * spread[above]], axis=1).ravel()
        """Occupied cells around the vertices of each stretch, uint8 [stretch_count]."""
        lengths = np.ones((len(places), 2), np.int32)
        lengths[:, 1] = np.where(above > 0, np.diff(places, append=0) - 1, 0)
        self.lengths = lengths.ravel()
        """Number of vertices of each stretch, int32 [stretch_count]."""
        self.run_row, self.run_low = np.divmod(places[below == 0], nz + 1)
        self.run_high = places[above == 0] % (nz + 1) + 1
        """Rows of the runs of vertices that touch cells, and the z where they begin and end, int64 [run_count]."""
        run_lengths = self.run_high - self.run_low
        self.run_start = np.cumsum(run_lengths) - run_lengths
        """Number of vertices before each run, int64 [run_count]."""

    def number(self, materials: Sequence[Cells]) -> np.ndarray:
        """Return the number of the material of the cell above each vertex, int8 [vertex_count]; 0 without a cell."""
        change = np.zeros(self.lengths.sum(dtype=np.int64), np.int8)
        height = self.shape[2]
        first_places = self.run_row * height + self.run_low
        for number, cells in enumerate(materials):
            row, *ends = cells.runs()
            row += row // cells.shape[1]
            for z, step in zip(ends, (number, -number), strict=True):
                place = row * height + z
                run = np.searchsorted(first_places, place, side="right") - 1
                change[self.run_start[run] + place - first_places[run]] += step
        return np.cumsum(change, dtype=np.int8, out=change)


def _launch(kernel: wp.Kernel, dim: Any, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel that builds, always on the CPU."""
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu")


def _number_particles(units: Cells, materials: Sequence[Cells]) -> tuple[Grid, int]:
    """Return the grid of the kernels, with its particles in scan order, and how many there are."""
    start_warp()
    labels, counts = corner_labels()
    vertices = _Vertices(units)
    vertex_count = int(vertices.lengths.sum(dtype=np.int64))
    if vertex_count > MAX_VERTICES:
        raise SceneError(f"a grid of {vertex_count:,} vertices is more than the {MAX_VERTICES:,} that can be numbered")

    def array(data: np.ndarray, dtype: Any = wp.int32) -> wp.array:
        return wp.array(data, dtype=dtype, device="cpu")

    rows = vertices.shape[0] * vertices.shape[1]
    patterns = np.repeat(vertices.patterns, vertices.lengths)
    # From how many particles each vertex has to how many there are before it.
    first = counts.astype(np.int32)[patterns]
    last = int(first[-1])
    np.cumsum(first[:-1], dtype=np.int32, out=first[1:])
    first[0] = 0
    grid = Grid()
    grid.labels, grid.shape = array(labels, wp.uint8), wp.vec3i(*vertices.shape)
    grid.row_start = array(np.searchsorted(vertices.run_row, np.arange(rows + 1)))
    grid.run_row, grid.run_low, grid.run_high = map(array, (vertices.run_row, vertices.run_low, vertices.run_high))
    grid.run_start = array(vertices.run_start)
    grid.patterns, grid.first = array(patterns, wp.uint8), array(first)
    grid.material_count, grid.alike = max(1, len(materials)), grid.patterns
    if len(materials) > 1:
        grid.materials = array(vertices.number(materials), wp.uint8)
        grid.alike = wp.empty_like(grid.patterns)
        _launch(find_alike, len(grid.run_row), [grid], [])
    return grid, int(first[-1]) + last


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
