import runpy
from pathlib import Path

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold, Mesh64

MODELS = Path(__file__).parents[1] / "scenes" / "models"
EXTENTS = {
    "tree": ([-1 / 3, 0.0, -1 / 3], [1 / 3, 1.0, 1 / 3]),
    "coupler": ([-0.25, -0.3, -0.25], [0.25, 0.3, 0.25]),
    "skeleton": ([-0.203787, 0.005585, -0.300405], [0.203787, 0.958402, 0.399619]),
    "creature": ([-0.379493, 0.0, -0.584952], [0.379493, 1.0, 0.482]),
}


def load(name: str) -> trimesh.Trimesh:
    """Read a model as it is written, without merging, repair or a split by materials."""
    lines = [line.split() for line in (MODELS / f"{name}.obj").read_text().splitlines()]
    vertices, faces = ([line[1:] for line in lines if line[0] == key] for key in "vf")
    return trimesh.Trimesh(np.array(vertices, float), np.array(faces, int) - 1, process=False)


def solid(name: str) -> Manifold:
    """Return the solid that a model bounds."""
    mesh = load(name)
    return Manifold(Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))


def winding_numbers(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """Return 1 inside and 0 outside: the signed solid angle of all triangles over 4 pi.

    tan(angle / 2) = a . (b x c) / (|a||b||c| + a.b |c| + b.c |a| + c.a |b|), Van Oosterom and Strackee 1983.
    """
    a, b, c = np.moveaxis(mesh.triangles - points[:, None, None], 2, 0)
    la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
    ab, bc, ca = (np.einsum("...i,...i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    triple = np.einsum("...i,...i", a, np.cross(b, c))
    return np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=-1) / (2 * np.pi)


def test_models_are_what_the_script_makes(tmp_path: Path) -> None:
    """Make the committed models again, byte for byte."""
    runpy.run_path(str(MODELS / "make_models.py"))["write_models"](tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        path.name: path.read_bytes() for path in MODELS.iterdir() if path.suffix in (".obj", ".mtl", ".usda")
    }


@pytest.mark.parametrize("name", EXTENTS)
def test_model_is_one_closed_solid(name: str) -> None:
    """Find each model closed, outward-oriented and in one piece."""
    mesh = load(name)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.area_faces.min() > 0
    assert len(solid(name).decompose()) == 1


@pytest.mark.parametrize("name", EXTENTS)
def test_model_has_its_size(name: str) -> None:
    """Find each model as large as its scenes expect."""
    # The files keep six decimals.
    np.testing.assert_allclose(load(name).bounds, EXTENTS[name], rtol=0, atol=5e-7)


@pytest.mark.parametrize(
    ("point", "inside"),
    [
        pytest.param([0.0, -0.29, 0.0], 0, id="bore, lower end"),
        pytest.param([0.0, 0.0, 0.0], 0, id="bore, middle"),
        pytest.param([0.0, 0.29, 0.0], 0, id="bore, upper end"),
        pytest.param([0.19, -0.27, 0.0], 1, id="lower hub"),
        pytest.param([0.0, 0.27, 0.19], 1, id="upper hub"),
        pytest.param([0.0, 0.0, -0.19], 0, id="slit"),
        pytest.param([0.0, 0.0, 0.19], 1, id="beam"),
    ],
)
def test_coupler_is_bored_and_slit(point: list[float], inside: int) -> None:
    """Find the coupler's bore and slit open and its wall solid."""
    # A winding number is an integer: the tolerance covers the rounding of 2316 arctangents.
    (winding,) = winding_numbers(load("coupler"), np.array([point]))
    assert winding == pytest.approx(inside, abs=1e-9)


def test_tree_faces_lie_on_cell_boundaries() -> None:
    """Find every vertex of the tree on a corner of the 12-cell grid centred on it."""
    cells = load("tree").vertices * 12
    # The files keep six decimals: half of the last one, times 12.
    np.testing.assert_allclose(cells, np.round(cells), rtol=0, atol=6e-6)


def test_coupler_survives_20_cells() -> None:
    """Keep two cells or more in every beam and every gap of each column of the wall."""
    centers = (np.arange(20) + 0.5) * 0.03 - 0.3
    mesh = load("coupler")
    columns = [(x, z) for x in centers for z in centers if 0.14 < np.hypot(x, z) < 0.24]
    for x, z in columns:
        inside = winding_numbers(mesh, np.array([(x, y, z) for y in centers])) > 0.5
        runs = np.diff(np.flatnonzero(np.diff(inside)), prepend=-1, append=len(inside) - 1)
        assert runs.min() >= 2
        assert len(runs) >= 5, "the slit winds at least twice around the axis"


def test_creature_stands_on_four_feet() -> None:
    """Find four flat feet below the creature, and its middle above them."""
    mesh = load("creature")
    centers = mesh.triangles_center[mesh.triangles[:, :, 1].max(axis=1) == 0.0]
    quarters = {(x > 0, z > mesh.center_mass[2]) for x, _, z in centers}
    assert len(quarters) == 4
    assert centers[:, 2].min() < mesh.center_mass[2] < centers[:, 2].max()
    assert abs(mesh.center_mass[0]) < 1e-3


def test_creature_has_a_material_on_every_part() -> None:
    """Find triangles of each material where its part is, and a colour for it."""
    obj, mtl = (
        [line.split() for line in (MODELS / f"creature.{end}").read_text().splitlines()] for end in ("obj", "mtl")
    )
    colored = [line[1] for line in mtl if line[0] == "newmtl"]
    used: dict[str, set[int]] = {}
    for key, *values in obj:
        if key == "usemtl":
            used[values[0]] = set()
        elif key == "f":
            next(reversed(used.values())).update(int(value) - 1 for value in values)
    assert list(used) == colored
    bounds = {name: load("creature").vertices[sorted(corners)] for name, corners in used.items()}
    low = {name: points.min(axis=0) for name, points in bounds.items()}
    high = {name: points.max(axis=0) for name, points in bounds.items()}
    assert high["hoof"][1] < 0.15
    assert low["horn"][1] > 0.8
    assert low["eye"][2] > 0.25
    assert low["pupil"][2] > low["eye"][2]
    assert low["nose"][2] > low["pupil"][2]


def test_skeleton_is_inside_of_the_creature() -> None:
    """Leave flesh around all bones: none comes out of the skin, and they are a fifth of the volume."""
    bones, body = solid("skeleton"), solid("creature")
    assert (bones - body).volume() == pytest.approx(0.0, abs=1e-12)
    assert 0.15 < bones.volume() / body.volume() < 0.25
