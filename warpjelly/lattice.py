"""Occupancy grid -> particles, springs and surface of one body, in NumPy.

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

# Kinds of spring classes, in order: rest lengths 1, sqrt(2), sqrt(3) and 2 unit cells.
STRUCTURAL, FACE_SHEAR, BODY_SHEAR, BEND = range(4)
REST_LENGTHS = np.sqrt([1.0, 2.0, 3.0, 4.0])

# The 13 directions of springs within a unit cell: one of each opposite pair, by kind.
DIRECTIONS = [(dx, dy, dz) for dx in (-1, 0, 1) for dy in (-1, 0, 1) for dz in (-1, 0, 1) if (dx, dy, dz) > (0, 0, 0)]
# Corners of a cell as (x, y, z) bits; a corner's number is 4 x + 2 y + z. Cells around a vertex are numbered alike.
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]


@dataclass(frozen=True)
class SpringClasses:
    """What the springs of a body have in common, whatever its material: a row for each distinct combination."""

    kinds: np.ndarray
    """STRUCTURAL, FACE_SHEAR, BODY_SHEAR or BEND, int [class_count]."""
    rest_lengths: np.ndarray
    """float64 [class_count], m."""
    cells: np.ndarray | None = None
    """How many occupied unit cells contain the spring, int [class_count]; of a bend spring, the fewer of those of the
    two structural springs under it. None where it was not asked for."""
    bends: np.ndarray | None = None
    """Sum of ``cells`` of the bend springs over a structural spring, int [class_count]."""


@dataclass(frozen=True)
class Lattice:
    """One body at rest, in its own frame; a network or a cloth has no cells, and 0 where they are counted."""

    particles: np.ndarray
    """Rest positions, float64 [particle_count, 3], m."""
    springs: np.ndarray
    """Both ends, int32 [spring_count, 2], kind by kind."""
    spring_classes: np.ndarray
    """Row of each spring in ``classes``, int [spring_count]."""
    classes: SpringClasses
    cell_counts: np.ndarray
    """How many occupied unit cells share each particle, 1 to 8, int32 [particle_count]."""
    unit: float
    """Edge of a unit cell, m; without cells, the shortest rest length."""
    surface_particles: np.ndarray
    """Particle of each point that is shown, int32 [point_count]: those on the surface, ascending; or, where there are
    no faces, both ends of each spring, one after another."""
    surface_quads: np.ndarray
    """Outward faces, counter-clockwise from outside, indices into surface_particles, int32 [face_count, 4]."""
    double_sided: bool = False
    """Whether the faces are seen from both sides."""

    @property
    def spring_kinds(self) -> np.ndarray:
        """STRUCTURAL, FACE_SHEAR, BODY_SHEAR or BEND, int [spring_count]."""
        return self.classes.kinds[self.spring_classes]


def build_lattice(
    cells: np.ndarray, *, origin: np.ndarray, cell_size: float, particles_per_edge: int = 2, weighted: bool = False
) -> Lattice:
    """Join the occupied cells of a grid into one lattice.

    Args:
        cells: occupied jelly cubes, bool [nx, ny, nz]; at least one.
        origin: lowest corner of the grid, [3], m.
        cell_size: edge of a jelly cube, m.
        particles_per_edge: particles along an edge of each jelly cube, at least 2.
        weighted: tell springs apart by how many cells contain them, too; otherwise there are four classes, the kinds.
    """
    refinement = particles_per_edge - 1
    units = cells
    for axis in range(3):
        units = np.repeat(units, refinement, axis=axis)
    unit = cell_size / refinement
    corner_particles, particles, cell_counts = _share_corners(units)
    springs, spring_classes, classes = _connect(units, corner_particles, len(particles), unit, weighted)
    surface_particles, surface_quads = _skin(units, corner_particles, len(particles))
    return Lattice(
        particles=np.asarray(origin, float) + unit * particles,
        springs=springs,
        spring_classes=spring_classes,
        classes=classes,
        cell_counts=cell_counts,
        unit=unit,
        surface_particles=surface_particles,
        surface_quads=surface_quads,
    )


def count_lattice(cells: np.ndarray, *, particles_per_edge: int = 2) -> tuple[int, int, int]:
    """Count what ``build_lattice`` would make without making it, from the corners, edges and faces of the jelly cubes.

    Args:
        cells: occupied jelly cubes, bool [nx, ny, nz].
        particles_per_edge: particles along an edge of each jelly cube, at least 2.

    Returns:
        The number of particles, exact; an upper bound of the number of springs, close for thick bodies; about the
        number of points on the surface.
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
    return particles, 2 * unit_edges + 2 * unit_faces + 4 * cubes * n**3, exposed * n**2 + 2


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


def _share_corners(units: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number the particles.

    Returns:
        The particle of each corner of each unit cell, int32 [8, nx, ny, nz], -1 in empty cells; the grid coordinates of
        each particle, int32 [particle_count, 3]; the number of cells that share it, int32 [particle_count].
    """
    nx, ny, nz = units.shape
    labels, counts = corner_labels()
    pattern = _vertex_patterns(units)
    count_at = counts[pattern]
    first = np.cumsum(count_at, dtype=np.int32).reshape(count_at.shape) - count_at.astype(np.int32)
    vertices = np.argwhere(count_at > 0).astype(np.int32)
    particles = np.repeat(vertices, count_at[count_at > 0], axis=0)

    corner_particles = np.full((8, nx, ny, nz), -1, np.int32)
    for number, (x, y, z) in enumerate(CORNERS):
        at = (slice(x, x + nx), slice(y, y + ny), slice(z, z + nz))
        # The cell that has the vertex at its corner (x, y, z) lies on the opposite side of it.
        label = labels[pattern[at], 7 - number]
        corner_particles[number] = np.where(units, first[at] + label, -1)
    cell_counts = np.bincount(corner_particles[corner_particles >= 0], minlength=len(particles)).astype(np.int32)
    return corner_particles, particles, cell_counts


def _connect(
    units: np.ndarray, corner_particles: np.ndarray, particle_count: int, unit: float, weighted: bool
) -> tuple[np.ndarray, np.ndarray, SpringClasses]:
    """Return the springs, int32 [spring_count, 2], kind by kind; the class of each, int [spring_count]; the classes."""
    springs: list[list[np.ndarray]] = [[], [], [], []]
    labels: list[list[np.ndarray]] = [[], [], [], []]
    for direction in DIRECTIONS:
        kind = int(np.abs(direction).sum()) - 1
        found, counts = _springs_along(direction, units.shape, corner_particles, weighted)
        springs[kind].append(found)
        labels[kind].append(_label(kind, counts))
        if kind == STRUCTURAL:
            under = _bend_springs(found, particle_count)
            springs[BEND].append(np.stack([found[under[:, 0], 0], found[under[:, 1], 1]], axis=1))
            if weighted:
                fewer = counts[under].min(axis=1)
                labels[BEND].append(_label(BEND, fewer))
                for end in (0, 1):
                    over = np.bincount(under[:, end], fewer, minlength=len(found))
                    labels[kind][-1] += over.astype(np.uint16)
    ends = np.concatenate([part for parts in springs for part in parts])
    if not weighted:
        kinds = np.repeat(np.arange(4, dtype=np.uint8), [sum(map(len, parts)) for parts in springs])
        return ends, kinds, SpringClasses(np.arange(4), REST_LENGTHS * unit)
    parts = [part for parts in labels for part in parts]
    used = np.zeros(1 << 10, bool)
    for part in parts:
        used |= np.bincount(part, minlength=len(used)) > 0
    row = (np.cumsum(used) - 1).astype(np.uint8)
    label = np.flatnonzero(used)
    classes = SpringClasses(label >> 8, REST_LENGTHS[label >> 8] * unit, label >> 5 & 7, label & 31)
    return ends, np.concatenate([row[part] for part in parts]), classes


def _label(kind: int, cells: np.ndarray) -> np.ndarray:
    """Return one number for the kind and the cells of springs, uint16; its last 5 bits are left for the bend springs.

    At most 4 cells contain a spring, and at most 4 bend springs, each with at most 4 cells, run over a structural one.
    """
    return np.uint16(kind << 8) | cells.astype(np.uint16) << np.uint16(5)


def _springs_along(
    direction: tuple[int, int, int], shape: tuple[int, ...], corner_particles: np.ndarray, counted: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the springs in one direction, int32 [count, 2], in scan order of the vertices they start from.

    Up to four cells hold a spring's place, and each names its own pair of particles: mostly the same one. The second
    array says how many cells do, uint8 [count]; it is empty unless ``counted``.
    """
    nx, ny, nz = shape
    candidates: list[tuple[Any, np.ndarray, np.ndarray]] = []
    for number, corner in enumerate(CORNERS):
        target = (corner[0] + direction[0], corner[1] + direction[1], corner[2] + direction[2])
        if target in CORNERS:
            at = tuple(slice(c, c + n) for c, n in zip(corner, shape, strict=True))
            candidates.append((at, corner_particles[number], corner_particles[CORNERS.index(target)]))
    pairs = np.full((nx + 1, ny + 1, nz + 1, len(candidates), 2), -1, np.int32)
    counts = np.ones(pairs.shape[:-1] if counted else 0, np.uint8)
    for slot, (at, start, end) in enumerate(candidates):
        repeated = np.zeros(shape, bool)
        for earlier in range(slot):
            same = (pairs[(*at, earlier, 0)] == start) & (pairs[(*at, earlier, 1)] == end)
            repeated |= same
            if counted:
                counts[(*at, earlier)] += same
        pairs[(*at, slot, 0)] = np.where(repeated, -1, start)
        pairs[(*at, slot, 1)] = np.where(repeated, -1, end)
    flat = pairs.reshape(-1, 2)
    found = flat[:, 0] >= 0
    return flat[found], counts.reshape(-1)[found] if counted else counts


def _bend_springs(structural: np.ndarray, particle_count: int) -> np.ndarray:
    """Return the pairs of consecutive structural springs along one axis that bend springs span, int32 [count, 2].

    A particle has at most two springs towards one side: where cells that meet in it only along an edge part.
    """
    first, second = structural.T
    number = np.arange(len(structural), dtype=np.int32)
    following = np.full((particle_count, 2), -1, np.int32)
    # Written in reverse, the earlier of two springs wins the first column; the other one goes to the second.
    following[first[::-1], 0] = number[::-1]
    other = following[first, 0] != number
    following[first[other], 1] = number[other]

    under = np.full((particle_count, 4, 2), -1, np.int32)
    ends = np.full((particle_count, 4), -1, np.int32)
    for slot in range(4):
        near = following[:, slot // 2]
        far = np.where(near >= 0, following[second[near], slot % 2], -1)
        end = np.where(far >= 0, second[far], -1)
        # Two ways around a gap may lead to the same end; one spring is enough.
        fresh = (end >= 0) & (end[:, None] != ends[:, :slot]).all(axis=1)
        ends[fresh, slot] = end[fresh]
        under[fresh, slot, 0] = near[fresh]
        under[fresh, slot, 1] = far[fresh]
    flat = under.reshape(-1, 2)
    return flat[flat[:, 0] >= 0]


def _skin(units: np.ndarray, corner_particles: np.ndarray, particle_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface particles, int32 [point_count], and the outward quads over them, int32 [face_count, 4]."""
    padded = np.pad(units, 1)
    faces = []
    for axis in range(3):
        # The other two axes, in the order that makes their cross product point along +axis.
        u, w = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            beyond = [slice(1, -1)] * 3
            beyond[axis] = slice(2, None) if side else slice(0, -2)
            exposed = units & ~padded[tuple(beyond)]
            around = [(0, 0), (1, 0), (1, 1), (0, 1)] if side else [(0, 0), (0, 1), (1, 1), (1, 0)]
            corners = []
            for along_u, along_w in around:
                bits = [0, 0, 0]
                bits[axis], bits[u], bits[w] = side, along_u, along_w
                corners.append(corner_particles[CORNERS.index((bits[0], bits[1], bits[2]))][exposed])
            faces.append(np.stack(corners, axis=1))
    quads = np.concatenate(faces)
    on_surface = np.zeros(particle_count, bool)
    on_surface[quads] = True
    point = np.cumsum(on_surface, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(on_surface).astype(np.int32), point[quads].astype(np.int32)
