"""Lattices against a builder made of dictionaries."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from reference import build, name_particles, unit_cells
from worlds import make_scene, make_voxels

from warpjelly.cells import Cells
from warpjelly.kernels.springs import MAX_SPAN
from warpjelly.lattice import Lattice, build_lattice, corner_labels, count_lattice
from warpjelly.scene import Output
from warpjelly.shapes import shapes_of
from warpjelly.simulator import Simulator

# Powers of two for edges and origin: positions in the grid come back exactly.
ORIGIN = np.array([0.5, -2.0, 8.0])


def build_on_grid(cells: np.ndarray, particles_per_edge: int = 2) -> tuple[Lattice, np.ndarray]:
    """Return a lattice of unit edge 1/4 m and the grid coordinates of its particles."""
    lattice = build_lattice(
        Cells.of(cells), origin=ORIGIN, cell_size=0.25 * (particles_per_edge - 1), particles_per_edge=particles_per_edge
    )
    vertices = (lattice.particles - ORIGIN) / 0.25
    np.testing.assert_array_equal(vertices, np.rint(vertices))
    return lattice, vertices.astype(int)


def check(cells: np.ndarray, particles_per_edge: int) -> None:
    """Compare particles, springs and surface of a grid with the dictionaries, and its counts with all of them."""
    lattice, vertices = build_on_grid(cells, particles_per_edge)
    expected = build(cells, particles_per_edge)
    units = unit_cells(cells, particles_per_edge)

    # The same particles, none twice, in scan order (z fastest).
    keys = name_particles(vertices, *lattice.springs())
    assert keys == expected.keys
    assert [len(key[1]) for key in keys] == lattice.cell_counts[0].tolist()
    assert lattice.cell_counts.sum() == 8 * len(units)

    # The same springs, none twice in either direction.
    springs, kinds = lattice.springs()
    ends = [frozenset((keys[i], keys[j])) for i, j in springs]
    assert Counter(zip(ends, kinds.tolist(), strict=True)) == Counter(expected.springs.items())

    # Planned before built: particles and the surface exactly, springs never too few.
    counts = count_lattice(Cells.of(cells), particles_per_edge=particles_per_edge)
    assert counts.particles == len(lattice.particles)
    assert counts.spring_bound >= lattice.spring_count == len(springs)
    assert counts.skin == len(lattice.surface_particles)
    (shown,) = shapes_of("body", lattice, Output())
    assert counts.sides == len(shown.particles)

    check_surface(lattice, vertices, units)


def check_surface(lattice: Lattice, vertices: np.ndarray, units: set[tuple[int, int, int]]) -> None:
    """Find the skin closed, outward and made of the exposed faces alone."""
    quads = lattice.surface_particles[lattice.surface_quads]
    exposed = [
        (unit, axis, sign)
        for unit, axis, sign in itertools.product(units, range(3), (-1, 1))
        if tuple(int(c) for c in np.add(unit, sign * np.eye(3, dtype=int)[axis])) not in units
    ]
    assert len(quads) == len(exposed)
    # Every directed edge meets its reverse.
    edges = Counter((int(q[k]), int(q[(k + 1) % 4])) for q in quads for k in range(4))
    assert all(edges[b, a] == count for (a, b), count in edges.items())
    # Area vectors, halves of the diagonals' cross products, point out of an occupied cell into an empty one.
    corners = vertices[quads]
    area = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]) // 2
    inner = (corners.sum(axis=1) - 2 * area - 2) // 4
    found = Counter(
        (tuple(int(c) for c in cell), int(np.flatnonzero(a)[0]), int(a.sum()))
        for cell, a in zip(inner, area, strict=True)
    )
    assert found == Counter(exposed)
    # Volume by the divergence theorem: 1/3 of the sum of (centre . area), here in integers.
    assert (corners.sum(axis=1) * area).sum() == 12 * len(units)
    # Only particles that some exposed face has, each once, ascending.
    np.testing.assert_array_equal(lattice.surface_particles, np.unique(quads))
    assert len(np.unique(lattice.surface_quads)) == len(lattice.surface_particles)
    assert (lattice.cell_counts[0, lattice.surface_particles] < 8).all()


def test_cube_of_8_has_the_known_counts() -> None:
    """Count the particles and springs of the 8x8x8 cube."""
    lattice, _ = build_on_grid(np.ones((1, 1, 1), bool), 8)
    # n^3 particles; 3 n^2 (n-1) structural, 6 n (n-1)^2 and 4 (n-1)^3 shear, 3 n^2 (n-2) bend springs.
    assert len(lattice.particles) == 512
    assert np.bincount(lattice.springs()[1]).tolist() == [1344, 2352, 1372, 1152]


@pytest.mark.parametrize("particles_per_edge", [2, 3])
def test_all_corner_patterns_match_the_reference(particles_per_edge: int) -> None:
    """Build every occupied pattern of 2x2x2 cells like the dictionaries do."""
    for pattern in range(1, 256):
        check(np.array([pattern >> bit & 1 for bit in range(8)], bool).reshape(2, 2, 2), particles_per_edge)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    cells=arrays.arrays(bool, st.tuples(*[st.integers(1, 4)] * 3)).filter(np.any),
    particles_per_edge=st.sampled_from([2, 2, 3]),
)
def test_drawn_grids_match_the_reference(cells: np.ndarray, particles_per_edge: int) -> None:
    """Build grids that hypothesis draws like the dictionaries do."""
    check(cells, particles_per_edge)


@pytest.mark.parametrize("particles_per_edge", [2, 3, 4])
def test_random_grids_match_the_reference(particles_per_edge: int) -> None:
    """Build half-filled random grids, with all their edge and corner contacts, like the dictionaries do."""
    rng = np.random.default_rng(particles_per_edge)
    for density in (0.3, 0.5, 0.8):
        check(rng.random((4, 4, 4)) < density, particles_per_edge)


@pytest.mark.parametrize(("offset", "shared"), [((1, 0, 0), 4), ((1, 1, 0), 0), ((1, 1, 1), 0)])
def test_only_faces_join_cubes(offset: tuple[int, int, int], shared: int) -> None:
    """Share the particles of a common face, but not those of a common edge or corner."""
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = cells[offset] = True
    lattice, _ = build_on_grid(cells)
    assert len(lattice.particles) == 16 - shared
    reached = {0}
    springs, _ = lattice.springs()
    while grown := {int(p) for s in springs if reached & set(s.tolist()) for p in s} - reached:
        reached |= grown
    assert len(reached) == (12 if shared else 8)


@pytest.mark.parametrize("particles_per_edge", [3, 4])
def test_many_particles_per_edge_are_a_finer_grid(particles_per_edge: int) -> None:
    """Build cubes of many particles per edge as the grid of their unit cells."""
    cells = np.random.default_rng(7).random((3, 2, 4)) < 0.6
    coarse, vertices = build_on_grid(cells, particles_per_edge)
    fine, fine_vertices = build_on_grid(np.kron(cells, np.ones([particles_per_edge - 1] * 3, bool)).astype(bool))
    np.testing.assert_array_equal(vertices, fine_vertices)
    for field in ("spans", "cell_counts", "surface_particles", "surface_quads"):
        np.testing.assert_array_equal(getattr(coarse, field), getattr(fine, field))
    assert coarse.unit == fine.unit


def test_particles_are_in_scan_order() -> None:
    """Number the particles of a box with z fastest and x slowest."""
    _, vertices = build_on_grid(np.ones((2, 3, 4), bool))
    np.testing.assert_array_equal(vertices, list(itertools.product(range(3), range(4), range(5))))


def test_spring_bound_is_close_for_a_solid() -> None:
    """Bound the springs of a solid of 8^3 cubes within 10 %."""
    cells = np.ones((8, 8, 8), bool)
    lattice, _ = build_on_grid(cells)
    assert lattice.spring_count <= count_lattice(Cells.of(cells)).spring_bound <= 1.1 * lattice.spring_count


def test_corner_table_lists_connected_cells() -> None:
    """Label the cells around a vertex alike exactly where a chain of faces joins them."""
    labels, counts = corner_labels()
    for pattern in range(256):
        cells = np.array([pattern >> bit & 1 for bit in range(8)], bool)
        assert ((labels[pattern] == 255) == ~cells).all()
        assert sorted(set(labels[pattern][cells].tolist())) == list(range(counts[pattern]))
        # Transitive closure of "both occupied and one bit apart" by repeated squaring: chains have at most 7 links.
        near = np.array([[cells[a] and cells[b] and (a ^ b).bit_count() <= 1 for b in range(8)] for a in range(8)])
        joined = np.linalg.matrix_power(near.astype(int), 8) > 0
        same = (labels[pattern][:, None] == labels[pattern]) & cells[:, None] & cells
        np.testing.assert_array_equal(same, joined)


def expand(spans: np.ndarray) -> Counter[tuple[int, int, int]]:
    """Return the (i, j, class) of every spring of some spans."""
    return Counter((int(i) + s, int(j) + s, int(kind)) for i, j, count, kind in spans for s in range(count))


def test_spans_are_long_and_in_order() -> None:
    """Find spans by ascending first particle, none longer than MAX_SPAN nor shorter than it needs to be."""
    rng = np.random.default_rng(3)
    # The last has runs longer than a span can be.
    for cells in (rng.random((4, 4, 4)) < 0.5, np.ones((1, 1, 1), bool), np.ones((1, 2, 2 * MAX_SPAN + 3), bool)):
        lattice, _ = build_on_grid(cells)
        spans = lattice.spans
        assert 1 <= spans[:, 2].min() <= spans[:, 2].max() <= MAX_SPAN
        assert (np.diff(spans[:, 0]) >= 0).all()
        ends, kinds = lattice.springs()
        assert expand(spans) == Counter(zip(*ends.T.tolist(), kinds.tolist(), strict=True))
    # Rows of 132 particles along z, 6 of them.
    assert sorted(spans[spans[:, 1] - spans[:, 0] == 1, 2]) == [3] * 6 + [MAX_SPAN] * 12


def test_spans_of_a_model_stay_within_bodies() -> None:
    """Find the springs of several bodies in the spans of the model, each with its body's particles and classes."""
    rng = np.random.default_rng(4)
    grids = [rng.random((3, 3, 3)) < 0.6 for _ in range(3)]
    simulator = Simulator(make_scene(bodies=[make_voxels(grid) for grid in grids]), device="cpu")
    expected: Counter[tuple[int, int, int]] = Counter()
    first = 0
    for number, grid in enumerate(grids):
        lattice, _ = build_on_grid(grid)
        assert simulator.model.bodies[number].particles == slice(first, first + len(lattice.particles))
        ends, kinds = lattice.springs()
        for (i, j), kind in zip(ends.tolist(), kinds.tolist(), strict=True):
            expected[first + i, first + j, 4 * number + kind] += 1
        first += len(lattice.particles)
    assert expand(simulator.model.spans.numpy()) == expected
    assert simulator.model.spring_count == expected.total()
