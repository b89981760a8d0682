"""Scan conversion against an exact point-in-mesh test."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, Mesh64
from test_models import winding_numbers

from warpjelly import voxelize as voxelize_module
from warpjelly.cells import Cells
from warpjelly.errors import SceneError
from warpjelly.kernels.voxels import SUBCELLS
from warpjelly.meshes import load_mesh
from warpjelly.voxelize import (
    VoxelGrid,
    choose_method,
    find_pieces,
    keep_largest_piece,
    voxelize,
    voxelize_mesh,
    voxelize_on_grid,
)

MODELS = Path(__file__).parents[1] / "scenes" / "models"


def sign_of(*terms: int) -> int:
    """Return the sign of terms[0] + terms[1] e + terms[2] e^2 + ... for a vanishing e > 0."""
    return next((1 if term > 0 else -1 for term in terms if term), 0)


def find_inside(triangles: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Say which cell centres, shifted by (e, e^2, e^3), are inside integer triangles.

    Parity of the crossings of a ray towards +z, in Python's integers alone.
    """
    crossings = np.zeros(shape, int)
    for corners in triangles.tolist():
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
        ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        normal = (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)
        if normal[2] == 0:
            continue
        turn = 1 if normal[2] > 0 else -1
        ranges = []
        for axis in (0, 1):
            along = [corner[axis] for corner in corners]
            ranges.append(range(max(0, min(along) // SUBCELLS - 1), min(shape[axis], max(along) // SUBCELLS + 2)))
        for i, j in itertools.product(*ranges):
            px, py = (2 * i + 1) * SUBCELLS // 2, (2 * j + 1) * SUBCELLS // 2
            # The shifted centre is on one side of all three edges: (q - p) x (centre - p), shift terms in e and e^2.
            if not all(
                turn * sign_of((qx - sx) * (py - sy) - (qy - sy) * (px - sx), -(qy - sy), qx - sx) > 0
                for (sx, sy, _), (qx, qy, _) in itertools.pairwise([*corners, corners[0]])
            ):
                continue
            for k in range(shape[2]):
                pz = (2 * k + 1) * SUBCELLS // 2
                height = sum(n * d for n, d in zip(normal, (px - ax, py - ay, pz - az), strict=True))
                # Below the plane of the triangle: the ray up crosses it.
                crossings[i, j, k] += turn * sign_of(height, *normal) < 0
    return crossings % 2 == 1


def check(mesh: trimesh.Trimesh, resolution: int, device: str) -> VoxelGrid:
    """Voxelize a closed mesh, compare every cell with the exact test, and return the grid."""
    triangles = np.asarray(mesh.triangles)
    grid = voxelize(triangles, resolution, device=device)
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    size = (upper - lower).max()
    # The cubic grid is centred on the mesh and covers it; one rounding of each number.
    assert grid.cell_size == pytest.approx(size / resolution, rel=1e-15)
    scale = np.abs(triangles).max()
    np.testing.assert_allclose(
        grid.origin + np.array(grid.cells.shape) * grid.cell_size / 2, (lower + upper) / 2, rtol=0, atol=4e-16 * scale
    )
    assert (np.array(grid.cells.shape) * grid.cell_size >= (upper - lower) * (1 - 1e-8)).all()
    assert all((resolution - n) % 2 == 0 for n in grid.cells.shape)
    snapped = np.rint((triangles - grid.origin) * (SUBCELLS / grid.cell_size)).astype(np.int64)
    np.testing.assert_array_equal(grid.cells.dense(), find_inside(snapped, grid.cells.shape))
    assert grid.open_columns == 0
    return grid


def turned(mesh: trimesh.Trimesh, seed: int) -> trimesh.Trimesh:
    """Return a mesh turned at random."""
    mesh = mesh.copy()
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3)))
    return mesh


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the union of closed meshes."""
    solids = [
        Manifold(Mesh64(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.uint64))) for mesh in meshes
    ]
    united = sum(solids[1:], solids[0]).to_mesh64()
    return trimesh.Trimesh(united.vert_properties, united.tri_verts.astype(np.int64), process=False)


CLOSED = {
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=2),
    "box": lambda: trimesh.creation.box((3.0, 2.0, 1.0)),
    "turned box": lambda: turned(trimesh.creation.box((3.0, 2.0, 1.0)), 1),
    "turned box again": lambda: turned(trimesh.creation.box((1.0, 1.0, 5.0)), 2),
    "torus": lambda: turned(trimesh.creation.torus(2.0, 0.7, major_sections=16, minor_sections=8), 3),
    "capsule": lambda: turned(trimesh.creation.capsule(height=2.0, radius=0.8, count=[8, 8]), 4),
    "union": lambda: join(
        trimesh.creation.icosphere(subdivisions=1),
        turned(trimesh.creation.box((2.5, 0.6, 0.6)), 5),
        trimesh.creation.torus(1.2, 0.3, major_sections=12, minor_sections=6),
    ),
    "far from the origin": lambda: trimesh.creation.icosphere(subdivisions=1).apply_translation([1000.0, -500.0, 77.7]),
}


@pytest.mark.parametrize("resolution", [1, 5, 12])
@pytest.mark.parametrize("name", CLOSED)
def test_closed_meshes_match_the_exact_test(name: str, resolution: int, device: str) -> None:
    """Find the cells of closed meshes exactly, and no column open."""
    check(CLOSED[name](), resolution, device)


@pytest.mark.parametrize("seed", range(6))
def test_random_polyhedra_match_the_exact_test(seed: int, device: str) -> None:
    """Find the cells of random convex hulls and of their unions exactly."""
    rng = np.random.default_rng(seed)
    hulls = [Manifold.hull_points(rng.normal(size=(12, 3)) + rng.normal(size=3)) for _ in range(3)]
    united = (hulls[0] + hulls[1] + hulls[2]).to_mesh64()
    mesh = trimesh.Trimesh(united.vert_properties, united.tri_verts.astype(np.int64), process=False)
    assert check(mesh, 9, device).cells.count


@pytest.mark.parametrize("seed", range(6))
def test_meshes_match_the_exact_test_on_a_grid_of_another(seed: int, device: str) -> None:
    """Find the cells of a given grid in random hulls that are in it, around it or reach out of it on some sides."""
    rng = np.random.default_rng(seed)
    grid = voxelize(np.asarray(turned(trimesh.creation.box((5.0, 4.0, 3.0)), seed).triangles), 9, device=device)
    center = grid.origin + np.array(grid.cells.shape) / 2 * grid.cell_size
    found = []
    for size in (0.5, 2.0, 8.0):
        points = rng.normal(size=(10, 3)) * size + center + rng.normal(size=3)
        hull = Manifold.hull_points(points).to_mesh64()
        mesh = trimesh.Trimesh(hull.vert_properties, hull.tri_verts.astype(np.int64), process=False)
        cells, notes = voxelize_on_grid(mesh, grid, device=device)
        snapped = np.rint((np.asarray(mesh.triangles) - grid.origin) * (SUBCELLS / grid.cell_size)).astype(np.int64)
        np.testing.assert_array_equal(cells.dense(), find_inside(snapped, grid.cells.shape))
        assert notes == []
        found.append(cells.count)
    assert found[0] < found[2]
    # The hull with a hole: rays through it are left out of the vote, wherever it is, and all others are right.
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    voted, (note,) = voxelize_on_grid(mesh, grid, device=device)
    assert "not watertight; method vote" in note
    np.testing.assert_array_equal(voted.dense(), cells.dense())


@pytest.mark.parametrize("seed", range(6))
def test_vertices_on_cell_centres_match_the_exact_test(seed: int, device: str) -> None:
    """Find the cells exactly where vertices, edges and oblique faces run through cell centres."""
    rng = np.random.default_rng(100 + seed)
    # A frame of extent 8 centres the grid at resolution 8 on half-integer places: all vertices are centres of cells.
    points = rng.integers(0, 8, (14, 3)) + 0.5
    frame = np.array(list(itertools.product((0.0, 8.0), repeat=3)))
    solid = Manifold.hull_points(frame) - Manifold.hull_points(points)
    shell = solid.to_mesh64()
    mesh = trimesh.Trimesh(shell.vert_properties, shell.tri_verts.astype(np.int64), process=False)
    grid = check(mesh, 8, device)
    assert grid.cells.count < grid.cells.grid_size


def test_faces_on_cell_centres_keep_the_volume(device: str) -> None:
    """Count centres on the low faces of a box as inside and those on the high faces as outside."""
    # At resolution 4, [0.5, 3.5] of 4 cells along y and [0.5, 1.5] of 2 along z: faces on centres.
    grid = check(trimesh.creation.box((4.0, 3.0, 1.0)), 4, device)
    assert grid.cells.shape == (4, 4, 2)
    expected = np.zeros((4, 4, 2), bool)
    expected[:, :3, :1] = True
    np.testing.assert_array_equal(grid.cells.dense(), expected)


def test_steps_on_cell_centres_match_the_exact_test(device: str) -> None:
    """Find the cells of stairs whose every face lies on cell centres or between cells."""
    boxes = [trimesh.creation.box(bounds=[[0, 0, 0], [8 - k, 0.5 + k, 8]]) for k in range(0, 8, 2)]
    grid = check(join(*boxes, trimesh.creation.box(bounds=[[0, 0, 0], [0.5, 8, 8]])), 8, device)
    assert grid.cells.count
    assert grid.cells.count < grid.cells.grid_size


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("name", ["turned box", "torus", "union"])
def test_mirrored_mesh_gives_mirrored_cells(name: str, axis: int, device: str) -> None:
    """Mirror the cells along with the mesh, whichever way its triangles turn then."""
    triangles = np.asarray(CLOSED[name]().triangles)
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    plain, mirrored = voxelize(triangles, 12, device=device), voxelize(triangles * sign, 12, device=device)
    np.testing.assert_array_equal(np.flip(plain.cells.dense(), axis), mirrored.cells.dense())


def test_translated_mesh_gives_the_same_cells(device: str) -> None:
    """Leave the cells alone when the mesh moves, and move their origin along."""
    triangles = np.asarray(CLOSED["union"]().triangles)
    offset = np.array([64.0, -3.0, 0.125])
    plain, moved = voxelize(triangles, 12, device=device), voxelize(triangles + offset, 12, device=device)
    np.testing.assert_array_equal(plain.cells.dense(), moved.cells.dense())
    # Coordinates up to 66 are rounded to 7e-15.
    np.testing.assert_allclose(moved.origin, plain.origin + offset, rtol=0, atol=3e-14)


@pytest.mark.parametrize("name", ["tree", "coupler"])
@pytest.mark.parametrize("resolution", [24, 48])
def test_models_keep_their_volume(name: str, resolution: int, device: str) -> None:
    """Keep the volume of the committed models, up to half a cell all over their surface."""
    mesh = load_mesh(MODELS / f"{name}.obj")
    grid = voxelize(np.asarray(mesh.triangles), resolution, device=device)
    assert grid.open_columns == 0
    # Snapping a surface to cells moves each piece of it by at most half a cell along an axis, outwards or inwards.
    error = abs(grid.cells.count * grid.cell_size**3 - mesh.volume)
    assert error <= mesh.area * grid.cell_size / 2


def test_open_mesh_reports_its_open_columns(device: str) -> None:
    """Count the columns through the missing side of a box, and those through a hole of one triangle."""
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    triangles, outward = np.asarray(mesh.triangles), mesh.face_normals[:, 2]
    assert voxelize(triangles, 6, device=device).open_columns == 0
    # Without one side in z every column crosses the surface once; without the sides in z none does.
    for sign in (-1, 1):
        grid = voxelize(triangles[outward != sign], 6, device=device)
        assert grid.open_columns == 36
        # Rays come from below: what lacks its top is filled up to the end of the grid, what lacks its bottom is not.
        np.testing.assert_array_equal(grid.cells.dense(), np.full((6, 6, 6), sign == 1))
    assert voxelize(triangles[outward == 0], 6, device=device).open_columns == 0
    # A missing triangle leaves the columns of half the side open, with or without its diagonal.
    hole = np.delete(triangles, np.flatnonzero(outward == 1)[0], axis=0)
    assert voxelize(hole, 6, device=device).open_columns in (15, 21)


def count_windings(mesh: trimesh.Trimesh, grid: VoxelGrid) -> np.ndarray:
    """Return how often a closed mesh goes round each cell's centre, by solid angles, [x, y, z]."""
    centers = grid.origin + (np.stack(np.indices(grid.cells.shape), axis=-1).reshape(-1, 3) + 0.5) * grid.cell_size
    return np.rint(winding_numbers(mesh, centers)).astype(int).reshape(grid.cells.shape)


def overlap() -> trimesh.Trimesh:
    """Return two balls that cut into each other, and a third one, inside out, in the first: windings 0, 1 and 2."""
    balls = [trimesh.creation.icosphere(subdivisions=2) for _ in range(3)]
    balls[1].apply_translation([0.9, 0.2, 0.1])
    balls[2].apply_scale(0.4).apply_translation([-0.4, 0.0, 0.0]).invert()
    return trimesh.util.concatenate(balls)


def test_winding_fills_what_any_surface_goes_round(device: str) -> None:
    """Fill the union of balls that overlap, less a hollow, where parity leaves the overlap empty."""
    mesh = overlap()
    grid = voxelize(np.asarray(mesh.triangles), 17, method="winding", device=device)
    windings = count_windings(mesh, grid)
    assert set(np.unique(windings)) == {0, 1, 2}
    np.testing.assert_array_equal(grid.cells.dense(), windings != 0)
    assert grid.open_columns == 0
    parity = voxelize(np.asarray(mesh.triangles), 17, device=device)
    np.testing.assert_array_equal(parity.cells.dense(), windings % 2 == 1)


def test_windings_count_both_ways_and_far(device: str) -> None:
    """Fill inside of balls within balls, whichever way they turn and however many there are."""
    balls = [trimesh.creation.icosphere(subdivisions=1, radius=radius) for radius in np.linspace(0.4, 1.0, 20)]
    for count in (1, 2, 7, 8, 16, 20):
        for turned_over in (False, True):
            mesh = trimesh.util.concatenate(balls[-count:])
            if turned_over:
                mesh.invert()
            grid = voxelize(np.asarray(mesh.triangles), 9, method="winding", device=device)
            windings = count_windings(mesh, grid)
            assert windings.min() == (-count if turned_over else 0)
            np.testing.assert_array_equal(grid.cells.dense(), windings != 0)


def merged(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return one mesh of several, with vertices that are equal made one, as models are read."""
    mesh = trimesh.util.concatenate(meshes)
    vertices, number = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return trimesh.Trimesh(vertices, number.reshape(-1)[mesh.faces], process=False)


def block(lower: list[float], upper: list[float]) -> trimesh.Trimesh:
    """Return a box between two corners."""
    return trimesh.creation.box(bounds=[lower, upper])


def with_faces(mesh: trimesh.Trimesh, faces: np.ndarray) -> trimesh.Trimesh:
    """Return a mesh with other triangles."""
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def turn_over(mesh: trimesh.Trimesh, chosen: slice) -> trimesh.Trimesh:
    """Return a mesh of which some triangles are turned over."""
    faces = np.array(mesh.faces)
    faces[chosen] = faces[chosen, ::-1]
    return with_faces(mesh, faces)


def with_slivers(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh with triangles of two corners in one place, as a ball of quads has them at its poles."""
    faces = np.asarray(mesh.faces)
    return with_faces(mesh, np.concatenate([faces, faces[:, [0, 0, 1]]]))


BALL = CLOSED["sphere"]()
TOUCHING = [block([0, 0, 0], [1, 1, 1]), block([1, 1, 0], [2, 2, 1]), block([2, 1, 0], [3, 2, 1])]
ROD = block([0.5, 0.25, 0.25], [0.75, 3, 0.75])


@pytest.mark.parametrize(
    ("mesh", "method", "faults"),
    [
        (trimesh.creation.box(), "parity", []),
        (CLOSED["union"](), "parity", []),
        (turn_over(trimesh.creation.box(), slice(None)), "parity", ["is inside out"]),
        (overlap(), "winding", ["intersects itself"]),
        (merged(*TOUCHING), "parity", []),
        (merged(*TOUCHING, ROD), "winding", ["intersects itself"]),
        (with_slivers(BALL), "parity", []),
        (turn_over(BALL, slice(5, 6)), "parity", ["has triangles that are turned over"]),
        (turn_over(merged(*TOUCHING), slice(3, 4)), "parity", ["has triangles that are turned over"]),
        (with_faces(BALL, BALL.faces[1:]), "vote", ["is not watertight"]),
    ],
    ids=[
        *("box", "union", "inside out", "overlap", "touching", "touching and overlap", "slivers"),
        *("a triangle turned over", "touching and turned over", "open"),
    ],
)
def test_the_method_suits_the_mesh(mesh: trimesh.Trimesh, method: str, faults: list[str], device: str) -> None:
    """Choose the method by what is wrong with a mesh, and say what that is."""
    assert choose_method(mesh, device=device) == (method, faults)


@pytest.mark.parametrize(
    ("mesh", "sound"),
    [
        (turn_over(BALL, slice(5, 6)), BALL),
        (turn_over(BALL, slice(None, None, 2)), BALL),
        (with_slivers(BALL), BALL),
        (merged(*TOUCHING, ROD), join(*TOUCHING, ROD)),
    ],
    ids=["a triangle turned over", "half of them", "slivers", "touching and overlap"],
)
def test_closed_meshes_with_faults_are_filled_as_without(
    mesh: trimesh.Trimesh, sound: trimesh.Trimesh, device: str
) -> None:
    """Fill what a mesh encloses, however its triangles turn and whatever touches."""
    cells = [voxelize_mesh(one, 16, device=device)[0].cells.dense() for one in (mesh, sound)]
    np.testing.assert_array_equal(*cells)


@pytest.mark.parametrize(
    "is_missing",
    [
        lambda normals: normals[:, 2] == 1,
        lambda normals: np.abs(normals[:, 0]) == 1,
        lambda normals: np.isin(np.arange(12), [np.argmax(normals[:, 0]), np.argmax(normals[:, 1])]),
    ],
    ids=["a side", "opposite sides", "halves of two sides"],
)
def test_a_vote_fills_a_mesh_with_holes(is_missing, device: str) -> None:
    """Fill a box that lacks triangles like the whole one."""
    box = trimesh.creation.box((3.0, 2.0, 4.0))
    triangles = np.asarray(box.triangles)
    whole = voxelize(triangles, 8, device=device)
    holed = voxelize(triangles[~is_missing(np.rint(box.face_normals))], 8, method="vote", device=device)
    np.testing.assert_array_equal(holed.cells.dense(), whole.cells.dense())


def test_too_many_ties_are_refused(device: str, monkeypatch) -> None:
    """Refuse a box of three sides at a resolution at which all its cells would be looked at one by one."""
    box = trimesh.creation.box()
    triangles = np.asarray(box.triangles)[np.rint(box.face_normals).max(axis=1) > 0]
    assert 0 < voxelize(triangles, 8, method="vote", device=device).cells.count < 8**3
    monkeypatch.setattr(voxelize_module, "MAX_TIES", 500)
    with pytest.raises(SceneError, match="open around 512 cells, more than 500"):
        voxelize(triangles, 8, method="vote", device=device)


@pytest.mark.parametrize("seed", range(3))
def test_thin_parts_of_any_slope_are_kept(seed: int, device: str) -> None:
    """Keep every cell that triangles of any slope pass through, as sampled points say, with none occupied around it."""
    rng = np.random.default_rng(seed)
    blades = [turned(trimesh.creation.box(size), seed) for size in ((6.0, 4.0, 1e-3), (5.0, 1e-3, 1e-3))]
    triangles = np.concatenate([np.asarray(mesh.triangles) for mesh in blades])
    plain = voxelize(triangles, 13, method="winding", device=device)
    kept = voxelize(triangles, 13, method="winding", keep_thin_parts=True, device=device).cells.dense()
    weights = rng.dirichlet((1.0, 1.0, 1.0), (len(triangles), 20000))
    points = np.einsum("tpc,tck->tpk", weights, triangles).reshape(-1, 3)
    passed = np.unique(np.floor((points - plain.origin) / plain.cell_size).astype(int), axis=0)
    dense = plain.cells.dense()
    near = np.zeros(np.add(dense.shape, 2), bool)
    for x, y, z in itertools.product(range(3), repeat=3):
        near[x : x + dense.shape[0], y : y + dense.shape[1], z : z + dense.shape[2]] |= dense
    inside = ((passed >= 0) & (passed < dense.shape)).all(axis=1)
    far = passed[inside & ~near[tuple((passed + 1).clip(0, np.array(near.shape) - 1).T)]]
    assert len(far) > 50
    assert kept[tuple(far.T)].all()


def test_a_vote_is_within_the_winding_number_of_a_broken_scan(device: str) -> None:
    """Fill a ball that lacks a tenth of its triangles, up to cells whose solid angle leaves it open."""
    mesh = trimesh.creation.icosphere(subdivisions=3)
    kept = np.random.default_rng(2).random(len(mesh.faces)) > 0.1
    broken = trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False)
    grid, notes = voxelize_mesh(broken, 20, device=device)
    assert grid.method == "vote"
    assert "not watertight" in notes[0]
    whole = voxelize(np.asarray(mesh.triangles), 20, device=device)
    centers = grid.origin + (np.argwhere(grid.cells.dense() != whole.cells.dense()) + 0.5) * grid.cell_size
    # Where a ray along each axis sees no hole, parity is right; the rest is at holes, near the surface.
    assert (np.abs(np.linalg.norm(centers, axis=1) - 1) < 0.25).all()
    assert len(centers) < 0.03 * whole.cells.count


def test_thin_parts_are_counted_and_kept_on_request(device: str) -> None:
    """Lose a fin much thinner than a cell, say by how many triangles, and keep it as the cells it passes through."""
    fin = trimesh.creation.box(bounds=[[1.0, -0.02, -0.5], [3.0, 0.02, 0.5]])
    mesh = join(trimesh.creation.box((2.2, 2.0, 2.0)), fin)
    triangles = np.asarray(mesh.triangles)
    plain = voxelize(triangles, 10, device=device)
    assert not plain.cells.dense()[6:].any()
    # The fin's twelve triangles but for those hidden in the block; the cut may have split some.
    beyond = triangles[:, :, 0].max(axis=1) > 1.1 + 2 * plain.cell_size
    assert 6 <= plain.thin_triangles <= beyond.sum()
    kept = voxelize(triangles, 10, keep_thin_parts=True, device=device)
    assert kept.thin_triangles == plain.thin_triangles
    added = np.argwhere(kept.cells.dense() & ~plain.cells.dense())
    assert (kept.cells.dense() >= plain.cells.dense()).all()
    low = kept.origin + added * kept.cell_size
    assert (low[:, 1] <= 0.02).all()
    assert (low[:, 1] + kept.cell_size >= -0.02).all()
    assert (low[:, 0] >= 1.1 - kept.cell_size).all()
    # In one piece, up to the end of the fin.
    assert kept.cells.dense().any(axis=(1, 2)).all()
    assert len(kept.piece_sizes) == 1


@pytest.mark.parametrize("seed", range(8))
def test_pieces_match_a_flood_fill(seed: int) -> None:
    """Find the pieces of random grids, by falling size, as a flood through faces does."""
    rng = np.random.default_rng(seed)
    cells = rng.random(rng.integers(1, 9, 3)) < rng.choice([0.2, 0.4, 0.6, 1.0])
    cells[0, 0, 0] = True
    label = np.where(cells, 0, -1)
    sizes = []
    for cell in np.argwhere(cells):
        if label[tuple(cell)] == 0:
            sizes.append(0)
            front = [tuple(int(c) for c in cell)]
            while front:
                at = front.pop()
                if all(0 <= c < n for c, n in zip(at, cells.shape, strict=True)) and label[at] == 0:
                    label[at] = len(sizes)
                    sizes[-1] += 1
                    front += [tuple(np.add(at, sign * np.eye(3, dtype=int)[k])) for k in range(3) for sign in (-1, 1)]
    _, found = find_pieces(Cells.of(cells))
    assert found.tolist() == sorted(sizes, reverse=True)
    grid = VoxelGrid(Cells.of(cells), np.zeros(3), 1.0, "parity", 0, 0, found)
    largest = keep_largest_piece(grid).cells.dense()
    assert np.count_nonzero(largest) == max(sizes)
    (number,) = set(np.unique(label[largest]))
    np.testing.assert_array_equal(largest, label == number)


def test_all_that_is_wrong_is_said_at_once(device: str) -> None:
    """Say everything that is wrong with a mesh at once, and keep its largest piece alone where asked to."""
    apart = trimesh.creation.box((0.5, 0.5, 0.5)).apply_translation([3.0, 0.0, 0.0])
    mesh = trimesh.util.concatenate([overlap(), apart])
    grid, notes = voxelize_mesh(mesh, 30, device=device)
    assert [note.split(",")[0].split(":")[0] for note in notes] == [
        "the mesh intersects itself; method winding",
        "it has 2 pieces that no face joins",
    ]
    alone, _ = voxelize_mesh(mesh, 30, pieces="largest", device=device)
    assert grid.piece_sizes.tolist() == [alone.cells.count, 3 * 3 * 4]
