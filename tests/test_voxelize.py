"""Scan conversion against an exact point-in-mesh test."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, Mesh64

from warpjelly.kernels.voxels import SUBCELLS
from warpjelly.meshes import load_mesh
from warpjelly.voxelize import VoxelGrid, voxelize

MODELS = Path(__file__).parents[1] / "scenes" / "models"


def sign_of(*terms: int) -> int:
    """Return the sign of terms[0] + terms[1] e + terms[2] e^2 + ... for a vanishing e > 0."""
    return next((1 if term > 0 else -1 for term in terms if term), 0)


def find_inside(triangles: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Say which cell centres, shifted by (e, e^2, e^3), are inside integer triangles.

    Parity of the crossings of a ray towards +z, another one than the product's, in Python's integers alone.
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
    np.testing.assert_array_equal(grid.cells, find_inside(snapped, grid.cells.shape))
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
    assert check(mesh, 9, device).cells.any()


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
    assert not grid.cells.all()


def test_faces_on_cell_centres_keep_the_volume(device: str) -> None:
    """Count centres on the low faces of a box as inside and those on the high faces as outside."""
    # At resolution 4, [0.5, 3.5] of 4 cells along y and [0.5, 1.5] of 2 along z: faces on centres.
    grid = check(trimesh.creation.box((4.0, 3.0, 1.0)), 4, device)
    assert grid.cells.shape == (4, 4, 2)
    expected = np.zeros((4, 4, 2), bool)
    expected[:, :3, :1] = True
    np.testing.assert_array_equal(grid.cells, expected)


def test_steps_on_cell_centres_match_the_exact_test(device: str) -> None:
    """Find the cells of stairs whose every face lies on cell centres or between cells."""
    boxes = [trimesh.creation.box(bounds=[[0, 0, 0], [8 - k, 0.5 + k, 8]]) for k in range(0, 8, 2)]
    grid = check(join(*boxes, trimesh.creation.box(bounds=[[0, 0, 0], [0.5, 8, 8]])), 8, device)
    assert grid.cells.any()
    assert not grid.cells.all()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("name", ["turned box", "torus", "union"])
def test_mirrored_mesh_gives_mirrored_cells(name: str, axis: int, device: str) -> None:
    """Mirror the cells along with the mesh, whichever way its triangles turn then."""
    triangles = np.asarray(CLOSED[name]().triangles)
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)
    plain, mirrored = voxelize(triangles, 12, device=device), voxelize(triangles * sign, 12, device=device)
    np.testing.assert_array_equal(np.flip(plain.cells, axis), mirrored.cells)


def test_translated_mesh_gives_the_same_cells(device: str) -> None:
    """Leave the cells alone when the mesh moves, and move their origin along."""
    triangles = np.asarray(CLOSED["union"]().triangles)
    offset = np.array([64.0, -3.0, 0.125])
    plain, moved = voxelize(triangles, 12, device=device), voxelize(triangles + offset, 12, device=device)
    np.testing.assert_array_equal(plain.cells, moved.cells)
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
    error = abs(np.count_nonzero(grid.cells) * grid.cell_size**3 - mesh.volume)
    assert error <= mesh.area * grid.cell_size / 2


def test_open_mesh_reports_its_open_columns(device: str) -> None:
    """Count the columns through the missing side of a box, and those through a hole of one triangle."""
    mesh = trimesh.creation.box((1.0, 1.0, 1.0))
    triangles, outward = np.asarray(mesh.triangles), mesh.face_normals[:, 0]
    assert voxelize(triangles, 6, device=device).open_columns == 0
    # Without one side in x every column crosses the surface once; without the sides in x none does.
    for sign in (-1, 1):
        assert voxelize(triangles[outward != sign], 6, device=device).open_columns == 36
    assert voxelize(triangles[outward == 0], 6, device=device).open_columns == 0
    # A missing triangle leaves the columns of half the side open, with or without its diagonal.
    hole = np.delete(triangles, np.flatnonzero(outward == 1)[0], axis=0)
    assert voxelize(hole, 6, device=device).open_columns in (15, 21)
