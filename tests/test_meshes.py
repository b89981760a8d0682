import importlib.util
import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom

import warpjelly as wj
from warpjelly.errors import SceneError
from warpjelly.meshes import load_mesh
from warpjelly.plan import plan_scene
from warpjelly.polygons import triangulate


@dataclass(frozen=True)
class Solid:
    """A closed solid with polygons of several lengths, what it measures and where it is."""

    points: np.ndarray
    faces: list[list[int]]
    volume: float
    area: float

    @property
    def counts(self) -> list[int]:
        """Return the number of corners of each face."""
        return [len(face) for face in self.faces]

    @property
    def corners(self) -> list[int]:
        """Return the corners of all faces."""
        return [corner for face in self.faces for corner in face]

    def moved(self, *by: float) -> "Solid":
        """Return the solid elsewhere."""
        return replace(self, points=self.points + np.array(by))

    @property
    def bounds(self) -> np.ndarray:
        """Return the lowest and the highest corner."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


def prism(outline: Sequence[tuple[float, float]], height: float) -> Solid:
    """Return an upright prism whose caps are polygons, counterclockwise from above, and whose sides are quads."""
    plane = np.array(outline, float)
    n, ahead = len(plane), np.roll(plane, -1, axis=0)
    points = np.concatenate([np.c_[plane, np.zeros(n)], np.c_[plane, np.full(n, height)]])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    base = float((plane[:, 0] * ahead[:, 1] - plane[:, 1] * ahead[:, 0]).sum() / 2)
    border = float(np.linalg.norm(ahead - plane, axis=1).sum())
    faces = [list(range(n))[::-1], list(range(n, 2 * n)), *sides]
    return Solid(points, faces, base * height, 2 * base + border * height)


# Two-pronged, with a straight corner: no fan is inside it, wherever it starts. Its coordinates are not round numbers.
FORK = prism([(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (2, 1), (1, 1), (1, 2), (0, 2)], 2.0)
TURN = trimesh.transformations.euler_matrix(0.3, -0.7, 1.1)[:3, :3]
FORK = replace(FORK, points=FORK.points @ TURN.T + (0.1, 0.2, -0.3))
# Largest rounding error of its coordinates, which are below 8, in files of float32.
FLOAT32 = 2.0**-22


def triangles_of(solid: Solid) -> trimesh.Trimesh:
    """Return a solid as a mesh of triangles."""
    return trimesh.Trimesh(solid.points, triangulate(solid.points, solid.counts, solid.corners)[0], process=False)


def assert_same(mesh: trimesh.Trimesh, solid: Solid, error: float, factor: float = 1.0) -> None:
    """Require a closed mesh to be a solid times a factor, but for an error of its coordinates."""
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    np.testing.assert_allclose(mesh.bounds, solid.bounds * factor, rtol=0, atol=error * factor)
    assert mesh.volume == pytest.approx(solid.volume * factor**3, rel=0, abs=solid.area * error * factor**3)
    # Moving the corners of an outline changes the area by no more than the edges are long; there are 100 units of them.
    assert mesh.area == pytest.approx(solid.area * factor**2, rel=0, abs=100 * error * factor**2)


def obj_text(solid: Solid, first: int | None = 1) -> str:
    """Return an OBJ object whose vertices are numbered from ``first`` on, or backwards if None."""
    start = -len(solid.points) if first is None else first
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in solid.points.tolist()]
    lines += ["f " + " ".join(str(start + corner) for corner in face) for face in solid.faces]
    return "\n".join(lines) + "\n"


def write_obj(path: Path, solid: Solid) -> None:
    """Write texture and normal indices, a material, an unused vertex, a continued line and CRLF."""
    text = obj_text(solid).replace("f ", "f \\\n").replace(" ", "/1/1 ").replace("v/1/1 ", "v ")
    text = "\n".join(line.replace("/1/1", "") if line.startswith("v") else line for line in text.split("\n"))
    text = "mtllib none.mtl\no thing\nvt 0 0\nvn 0 0 1\nusemtl red\n" + text.replace("f/1/1 ", "f ") + "v 99 99 nan\n"
    path.write_bytes(text.replace("\n", "\r\n").encode())


def write_off(path: Path, solid: Solid) -> None:
    """Write comments, colours and an unused vertex."""
    lines = ["COFF # comment", "", f"{len(solid.points) + 1} {len(solid.faces)} 0"]
    lines += [f"{x!r} {y!r} {z!r} 255 0 0 255" for x, y, z in [*solid.points.tolist(), (99.0, 99.0, 99.0)]]
    lines += [" ".join(map(str, [len(face), *face])) + " 0.5 0.5 0.5 # face" for face in solid.faces]
    path.write_text("\n".join(lines))


def write_ply(path: Path, solid: Solid, order: str = "<") -> None:
    """Write more properties than needed, before and behind, an element more and an unused vertex."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian", "=": "ascii"}[order]
    number = "double" if order == "=" else "float"
    header = ["ply", f"format {name} 1.0", "comment made by hand", f"element vertex {len(solid.points) + 1}"]
    header += ["property uchar red", *(f"property {number} {axis}" for axis in "xyz")]
    header += ["element edge 1", "property int vertex1", f"element face {len(solid.faces)}", "property float quality"]
    header += ["property list uchar int vertex_indices", "property uchar flags", "end_header", ""]
    records = [("Bfff", [7, *point]) for point in [*solid.points.tolist(), (99.0, 99.0, 99.0)]] + [("i", [3])]
    records += [(f"fB{len(face)}iB", [0.5, len(face), *face, 1]) for face in solid.faces]
    if order == "=":
        body = "\n".join(" ".join(map(repr, values)) for _, values in records).encode()
    else:
        body = b"".join(struct.pack(order + kinds, *values) for kinds, values in records)
    path.write_bytes("\n".join(header).encode() + body)


def write_ply_text(path: Path, solid: Solid) -> None:
    """Write a text file."""
    write_ply(path, solid, "=")


def write_ply_big_endian(path: Path, solid: Solid) -> None:
    """Write bytes the other way round."""
    write_ply(path, solid, ">")


def write_by_trimesh(path: Path, solid: Solid) -> None:
    """Write triangles."""
    triangles_of(solid).export(path)


def write_stl_text(path: Path, solid: Solid) -> None:
    """Write a text file of two objects."""
    mesh = triangles_of(solid)
    halves = mesh.submesh([range(10), range(10, len(mesh.faces))], repair=False)
    path.write_text("\n".join(trimesh.exchange.stl.export_stl_ascii(half) for half in halves))


def write_gltf(path: Path, solid: Solid) -> None:
    """Write a text file with a binary one beside it."""
    for name, data in trimesh.Scene(triangles_of(solid)).export(file_type="gltf").items():
        (path if name.endswith(".gltf") else path.with_name(name)).write_bytes(data)


def dae_text(solid: Solid, nodes: str, unit: float = 1.0, up_axis: str = "Y_UP") -> str:
    """Return a COLLADA file of one geometry, called "solid"."""
    numbers = " ".join(map(repr, solid.points.ravel().tolist()))
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00Z</created><modified>2020-01-01T00:00:00Z</modified>
<unit name="u" meter="{unit!r}"/><up_axis>{up_axis}</up_axis></asset>
<library_geometries><geometry id="solid"><mesh>
<source id="points"><float_array id="numbers" count="{3 * len(solid.points)}">{numbers}</float_array>
<technique_common><accessor source="#numbers" count="{len(solid.points)}" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
</source><vertices id="vertices"><input semantic="POSITION" source="#points"/></vertices>
<polylist count="{len(solid.faces)}"><input semantic="VERTEX" source="#vertices" offset="0"/>
<vcount>{" ".join(map(str, solid.counts))}</vcount><p>{" ".join(map(str, solid.corners))}</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""


def write_dae(path: Path, solid: Solid) -> None:
    """Write polygons."""
    path.write_text(dae_text(solid, '<node><instance_geometry url="#solid"/></node>'))


def define_mesh(stage: Usd.Stage, path: str, solid: Solid) -> UsdGeom.Mesh:
    """Put a solid into a stage."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreatePointsAttr([Gf.Vec3f(*point) for point in [*solid.points.tolist(), (99.0, 99.0, 99.0)]])
    mesh.CreateFaceVertexCountsAttr(solid.counts)
    mesh.CreateFaceVertexIndicesAttr(solid.corners)
    return mesh


def new_stage(meters_per_unit: float = 1.0, up_axis: str = "Y") -> Usd.Stage:
    """Return an empty stage with the default prim /World."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    return stage


def write_usd(path: Path, solid: Solid) -> None:
    """Write polygons."""
    stage = new_stage()
    define_mesh(stage, "/World/solid", solid)
    stage.Export(str(path))


def write_usdz(path: Path, solid: Solid) -> None:
    """Write a package with a layer in it."""
    write_usd(path.with_suffix(".usdc"), solid)
    with Sdf.ZipFileWriter.CreateNew(str(path)) as package:
        package.AddFile(str(path.with_suffix(".usdc")), "solid.usdc")


@pytest.mark.parametrize(
    ("name", "write", "error"),
    [
        ("a.obj", write_obj, 0.0),
        ("a.OBJ", write_obj, 0.0),
        ("a.off", write_off, 0.0),
        ("a.ply", write_ply, FLOAT32),
        ("text.ply", write_ply_text, 0.0),
        ("big.ply", write_ply_big_endian, FLOAT32),
        ("trimesh.ply", write_by_trimesh, FLOAT32),
        ("a.stl", write_by_trimesh, FLOAT32),
        ("text.stl", write_stl_text, 1e-7),
        ("a.glb", write_by_trimesh, FLOAT32),
        ("a.gltf", write_gltf, FLOAT32),
        ("a.dae", write_dae, FLOAT32),
        ("a.usda", write_usd, FLOAT32),
        ("a.usdc", write_usd, FLOAT32),
        ("a.usd", write_usd, FLOAT32),
        ("a.usdz", write_usdz, FLOAT32),
    ],
)
def test_each_format_gives_the_solid_back(
    tmp_path: Path, name: str, write: Callable[[Path, Solid], None], error: float
) -> None:
    """Read polygons with three to nine corners and find volume, area and bounds of the solid, and it closed."""
    write(tmp_path / name, FORK)
    # Sums of products of float64 round by some 1e-15 of their value.
    assert_same(load_mesh(tmp_path / name), FORK, error + 1e-14)


@pytest.mark.parametrize(("unit", "meters"), [("millimeter", 1e-3), ("inch", 0.0254), (None, 1e-3)])
def test_3mf_says_its_unit_and_has_z_up(tmp_path: Path, unit: str | None, meters: float) -> None:
    """Read two placed objects, one mirrored, in metres, and turned where the scene has Y up."""
    mesh = triangles_of(FORK)
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirror[0, 3] = 20.0
    scene = trimesh.Scene({"fork": mesh})
    scene.graph.update("again", geometry="fork", matrix=mirror)
    scene.export(tmp_path / "trimesh.3mf")
    with zipfile.ZipFile(tmp_path / "trimesh.3mf") as old, zipfile.ZipFile(tmp_path / "a.3mf", "w") as new:
        for name in old.namelist():
            data = old.read(name)
            said = b"" if unit is None else f'unit="{unit}"'.encode()
            new.writestr(name, data.replace(b'unit="millimeter"', said))
    both = np.concatenate([FORK.points, FORK.points * (-1, 1, 1) + (20, 0, 0)])
    found = load_mesh(tmp_path / "a.3mf", up_axis="Z")
    np.testing.assert_allclose(found.vertices.min(axis=0), both.min(axis=0) * meters, rtol=1e-6)
    np.testing.assert_allclose(found.vertices.max(axis=0), both.max(axis=0) * meters, rtol=1e-6)
    assert found.volume == pytest.approx(2 * FORK.volume * meters**3, rel=1e-6)
    assert found.is_watertight
    turned = load_mesh(tmp_path / "a.3mf", up_axis="Y")
    np.testing.assert_allclose(turned.vertices.min(axis=0)[1], both.min(axis=0)[2] * meters, rtol=1e-6)
    np.testing.assert_allclose(turned.vertices.max(axis=0)[2], -both.min(axis=0)[1] * meters, rtol=1e-6)


def test_objects_of_an_obj_are_joined(tmp_path: Path) -> None:
    """Read three objects whose vertices are numbered forwards or backwards, in several materials."""
    parts = [FORK.moved(shift, 0, 0) for shift in (0.0, 10.0, 20.0)]
    text = "o a\n" + obj_text(parts[0]) + "o b\nusemtl red\n" + obj_text(parts[1], None)
    text += "g c\nusemtl blue\n" + obj_text(parts[2], 1 + 2 * len(FORK.points))
    (tmp_path / "a.obj").write_text(text)
    mesh = load_mesh(tmp_path / "a.obj")
    assert_same(mesh, Solid(np.concatenate([part.points for part in parts]), [], 3 * FORK.volume, 3 * FORK.area), 1e-13)
    assert len(mesh.vertices) == 3 * len(FORK.points)


def test_nodes_of_a_gltf_are_applied(tmp_path: Path) -> None:
    """Read one mesh that nested nodes place twice, turned and mirrored, and turn it where the scene has Z up."""
    first = trimesh.transformations.compose_matrix(scale=[2, 2, 2], angles=[0.5, 0, 0], translate=[10, 0, 0])
    second = np.diag([1.0, -1.0, 1.0, 1.0])
    second[1, 3] = -10.0
    scene = trimesh.Scene({"fork": triangles_of(FORK)})
    scene.graph.update("parent", matrix=first)
    scene.graph.update("child", frame_from="parent", geometry="fork", matrix=second)
    scene.export(tmp_path / "a.glb")
    placed = (FORK.points @ second[:3, :3].T + second[:3, 3]) @ first[:3, :3].T + first[:3, 3]
    both = np.concatenate([FORK.points, placed])
    # Matrices are written in float64, points in float32; here they are below 32, four times those of the fork.
    mesh = load_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(mesh.bounds, [both.min(axis=0), both.max(axis=0)], rtol=0, atol=4 * FLOAT32)
    assert mesh.volume == pytest.approx(9 * FORK.volume, rel=1e-6)
    assert mesh.is_watertight
    turned = load_mesh(tmp_path / "a.glb", up_axis="Z")
    assert turned.bounds[0, 2] == mesh.bounds[0, 1]
    assert turned.bounds[0, 1] == -mesh.bounds[1, 2]


@pytest.mark.parametrize(
    ("axis", "turn"),
    [
        ("X_UP", [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
        ("Y_UP", np.eye(3)),
        ("Z_UP", [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    ],
)
def test_dae_says_unit_up_axis_and_nodes(tmp_path: Path, axis: str, turn: np.ndarray) -> None:
    """Read nested nodes in inches with any axis up."""
    inner = '<node><scale>-1 1 1</scale><instance_geometry url="#solid"/></node>'
    (tmp_path / "a.dae").write_text(
        dae_text(FORK, f"<node><translate>1 2 3</translate>{inner}</node><node/><node>{inner}</node>", 0.0254, axis)
    )
    points = np.concatenate([FORK.points * (-1, 1, 1) + (1, 2, 3), FORK.points * (-1, 1, 1)]) @ np.transpose(turn)
    mesh = load_mesh(tmp_path / "a.dae")
    np.testing.assert_allclose(mesh.bounds / 0.0254, [points.min(axis=0), points.max(axis=0)], rtol=0, atol=2 * FLOAT32)
    assert mesh.volume == pytest.approx(2 * FORK.volume * 0.0254**3, rel=1e-6)
    assert mesh.is_watertight
    upright = load_mesh(tmp_path / "a.dae", up_axis="Z").vertices
    np.testing.assert_array_equal(
        np.unique(upright * (1, -1, 1), axis=0), np.unique(mesh.vertices[:, [0, 2, 1]], axis=0)
    )


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say what to install where the packages for a format are missing."""
    write_dae(tmp_path / "a.dae", FORK)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SceneError, match=r"a.dae: .dae files need more packages: pip install 'warpjelly\[formats\]'$"):
        load_mesh(tmp_path / "a.dae")


def test_a_stage_is_read_below_a_prim(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Read what is seen below the default prim, below another prim, or alone."""
    stage = new_stage()
    for k, path in enumerate(
        ("/World/a/one", "/World/a/two", "/World/b", "/World/hidden/c", "/Other/d", "/World/guide")
    ):
        mesh = define_mesh(stage, path, FORK.moved(10 * k, 0, 0))
        if path == "/World/guide":
            mesh.CreatePurposeAttr("guide")
    UsdGeom.Imageable(UsdGeom.Xform.Define(stage, "/World/hidden")).MakeInvisible()
    UsdGeom.Scope.Define(stage, "/World/empty")
    UsdGeom.Sphere.Define(stage, "/World/ball")
    file = tmp_path / "a.usda"
    stage.Export(str(file))
    for prim, count in ((None, 3), ("/", 4), ("/World/a", 2), ("/World/a/two", 1), ("/Other", 1)):
        assert load_mesh(file, prim=prim).volume == pytest.approx(count * FORK.volume, rel=1e-6)
    assert "left out, because only meshes are read: Sphere /World/ball" in caplog.text
    for prim, said in (
        ("/World/hidden/c", "no mesh to be seen below /World/hidden/c; meshes in this file: /World/a/one, "),
        ("/World/empty", "and 1 more"),
        ("/World/none", "no prim /World/none; meshes in this file"),
        ("World/a", "'World/a' is not the path of a prim"),
        ("/World//a", "'/World//a' is not the path of a prim"),
        ("/World/b.points", "'/World/b.points' is not the path of a prim"),
        ("", "'' is not the path of a prim"),
    ):
        with pytest.raises(SceneError) as caught:
            load_mesh(file, prim=prim)
        assert said in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scene_up", ["Y", "Z"])
@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_a_stage_is_placed(tmp_path: Path, up_axis: str, scene_up: str) -> None:
    """Apply nested transforms, a reset of them, a mirror, samples, unit and up axis."""
    stage = new_stage(0.01, up_axis)
    world = UsdGeom.Xform(stage.GetDefaultPrim())
    world.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    world.AddRotateXOp().Set(90.0)
    world.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    define_mesh(stage, "/World/a", FORK).AddTranslateOp().Set(Gf.Vec3d(5, 0, 0), 3.0)
    reset = define_mesh(stage, "/World/b", FORK)
    reset.SetResetXformStack(True)
    mirror = reset.AddScaleOp()
    mirror.Set(Gf.Vec3f(1, 1, -1))
    mirror.Set(Gf.Vec3f(7, 7, 7), 1.0)
    stage.Export(str(tmp_path / "a.usda"))
    x, y, z = 2 * FORK.moved(5, 0, 0).points.T
    points = np.concatenate([np.stack([x + 1, 2 - z, 3 + y], axis=1), FORK.points * (1, 1, -1)]) * 0.01
    x, y, z = points.T
    points = {"YY": points, "ZZ": points, "YZ": np.c_[x, -z, y], "ZY": np.c_[x, z, -y]}[up_axis + scene_up]
    mesh = load_mesh(tmp_path / "a.usda", up_axis=scene_up)
    # Coordinates below 32 units.
    np.testing.assert_allclose(mesh.bounds, [points.min(axis=0), points.max(axis=0)], rtol=0, atol=0.04 * FLOAT32)
    assert mesh.volume == pytest.approx((8 + 1) * FORK.volume * 0.01**3, rel=1e-6)
    assert mesh.is_watertight


def test_the_rest_of_a_stage_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Prefer default values to samples and the first sample to nothing; turn left-handed meshes; leave holes out."""
    stage = new_stage()
    sampled = UsdGeom.Mesh(define_mesh(stage, "/World/sampled", FORK))
    points = sampled.GetPointsAttr().Get()
    sampled.GetPointsAttr().Clear()
    sampled.GetPointsAttr().Set(points, 4.0)
    sampled.GetPointsAttr().Set([point * 2 for point in points], 5.0)
    default = define_mesh(stage, "/World/default", FORK)
    default.GetPointsAttr().Set([point * 2 for point in points], 0.0)
    left = define_mesh(stage, "/World/left", replace(FORK, faces=[face[::-1] for face in FORK.faces]))
    left.CreateOrientationAttr("leftHanded")
    smooth = define_mesh(stage, "/World/smooth", replace(FORK, faces=[*FORK.faces, [0, 1, 2]]))
    smooth.GetSubdivisionSchemeAttr().Clear()
    smooth.CreateHoleIndicesAttr([len(FORK.faces)])
    stage.Export(str(tmp_path / "a.usdc"))
    mesh = load_mesh(tmp_path / "a.usdc")
    # All are in the same place, so their vertices are shared.
    assert len(mesh.vertices) == len(FORK.points)
    assert mesh.volume == pytest.approx(4 * FORK.volume, rel=1e-6)
    assert "1 of 4 meshes are subdivision surfaces; their cages are used" in caplog.text


def test_instances_in_a_stage_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Read two instances of a referenced file; warn of a reference that is missing, of no unit, and of instancers."""
    write_usd(tmp_path / "part.usda", FORK)
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    for k in range(2):
        copy = UsdGeom.Xform.Define(stage, f"/World/copy{k}")
        copy.AddTranslateOp().Set(Gf.Vec3d(10 * k, 0, 0))
        copy.GetPrim().GetReferences().AddReference("./part.usda")
        copy.GetPrim().SetInstanceable(True)
    UsdGeom.PointInstancer.Define(stage, "/World/many")
    define_mesh(stage, "/World/many/prototype", FORK)
    stage.DefinePrim("/World/gone")
    stage.Save()
    del stage
    file = tmp_path / "a.usda"
    file.write_text(file.read_text().replace('def "gone"', 'def "gone" (references = @gone.usda@)'))
    mesh = load_mesh(file)
    assert mesh.volume == pytest.approx(2 * FORK.volume * 0.01**3, rel=1e-6)
    assert mesh.extents[0] == pytest.approx(0.1 + np.ptp(FORK.points[:, 0]) * 0.01)
    assert "PointInstancer /World/many" in caplog.text
    assert "not complete: Could not open asset @gone.usda@" in caplog.text
    assert "no metersPerUnit is given; a unit is 0.01 m then" in caplog.text
    assert load_mesh(file, prim="/World/copy1/solid").volume == pytest.approx(FORK.volume * 0.01**3, rel=1e-6)


BROKEN_MESH = """#usda 1.0
(
    metersPerUnit = 1
)
def Mesh "m"
{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, NUMBER)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, INDEX]
}
"""


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        *((f"empty{kind}", "", "empty") for kind in (".obj", ".stl", ".ply", ".off", ".glb", ".3mf", ".dae", ".usda")),
        *((f"empty{kind}", "", "empty") for kind in (".usd", ".usdc", ".usdz")),
        *((f"words{kind}", "no mesh", f"words{kind}: ") for kind in (".stl", ".ply", ".off", ".glb", ".gltf", ".3mf")),
        *((f"words{kind}", "no mesh", f"words{kind}: ") for kind in (".dae", ".usd", ".usda", ".usdc", ".usdz")),
        ("index.obj", "v 0 0 0\nf 1 2 3", "a face has a vertex that does not exist; there are 1"),
        ("back.obj", "v 0 0 0\nf -1 -2 -3", "a face has a vertex that does not exist"),
        ("zero.obj", "v 0 0 0\nf 0 1 2", "line 2: vertices are numbered from 1"),
        ("word.obj", "v 0 0 zero", "line 1: could not convert"),
        ("short.off", "OFF\n3 1 0\n0 0 0\n", "ends before its 3 vertices"),
        ("face.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1", "fewer vertices than it says"),
        ("index.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3", "a face has a vertex that does not exist"),
        ("nan.usda", BROKEN_MESH.replace("NUMBER", "nan").replace("INDEX", "2"), "not finite"),
        ("index.usda", BROKEN_MESH.replace("NUMBER", "0").replace("INDEX", "7"), "index.usda: /m: "),
        ("none.usda", '#usda 1.0\ndef Xform "World"\n{\n}\n', "no mesh to be seen below /; there is none"),
        ("unit.usda", BROKEN_MESH.replace("= 1\n", "= -1\n"), "unit.usda: "),
        ("large.obj", "v -1e308 0 0\nv 1e308 0 0\nv 0 1 0\nf 1 2 3", "not finite"),
        ("points.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
         "property float z\nend_header\n1 2 3\n", "no triangles"),
        ("short.ply", "ply\nformat binary_little_endian 1.0\nelement vertex 9\nproperty float x\nend_header\n1234",
         "ends too early"),
        ("draco.gltf", '{"extensionsRequired": ["KHR_draco_mesh_compression"]}', "KHR_draco_mesh_compression; save it"),
        ("format.ply", "ply\nformat strange 1.0\nend_header\n", "its format is unknown"),
    ],
)  # fmt: skip
def test_a_broken_file_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture, name: str, content: str, said: str
) -> None:
    """Name the file and what is wrong with it, and print nothing besides."""
    (tmp_path / name).write_text(content)
    with pytest.raises(SceneError) as caught:
        load_mesh(tmp_path / name)
    assert said in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("kind", "write"),
    [
        (".ply", write_ply),
        (".stl", write_by_trimesh),
        (".glb", write_by_trimesh),
        (".usdc", write_usd),
        (".usdz", write_usdz),
    ],
)
def test_a_file_that_is_cut_short_is_refused(tmp_path: Path, kind: str, write: Callable[[Path, Solid], None]) -> None:
    """Cut files at several places."""
    file = tmp_path / f"whole{kind}"
    write(file, FORK)
    data = file.read_bytes()
    for size in (1, len(data) // 4, len(data) // 2, 3 * len(data) // 4):
        file = tmp_path / f"cut{size}{kind}"
        file.write_bytes(data[:size])
        with pytest.raises(SceneError):
            load_mesh(file)


@pytest.mark.parametrize("count", [4, 5, 8, 40, 300])
@pytest.mark.parametrize("seed", range(4))
def test_polygons_are_cut_into_triangles_inside(count: int, seed: int) -> None:
    """Cut spiky polygons of any orientation in space into triangles that all turn the same way and fill them."""
    generator = np.random.default_rng(seed)
    angles = np.sort(generator.uniform(0, 2 * np.pi, count))
    outline = generator.uniform(0.2, 1.0, (count, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    normal = generator.normal(size=3)
    across = np.linalg.svd(normal[None])[2][1:]
    points = outline @ across
    triangles, sources = triangulate(points, np.array([count]), np.arange(count))
    np.testing.assert_array_equal(sources, 0)
    assert len(triangles) == count - 2
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    areas = np.cross(b - a, c - a) @ np.cross(*across) / 2
    ahead = np.roll(outline, -1, axis=0)
    area = (outline[:, 0] * ahead[:, 1] - outline[:, 1] * ahead[:, 0]).sum() / 2
    # Triangles as thin as rounding may turn either way.
    assert areas.min() > -1e-15
    assert areas.sum() == pytest.approx(area, rel=1e-12)


@pytest.mark.parametrize(
    "outline",
    [
        [(0, 0), (2, 0), (2, 2), (1, 1), (0, 3)],
        [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 1)],
    ],
    ids=["a corner on a diagonal", "corners on edges"],
)
def test_no_triangle_is_flat_where_corners_are_in_line(outline: list[tuple[int, int]]) -> None:
    """Cut polygons, from every corner on, where three corners in a line would make a triangle without a size."""
    for first in range(len(outline)):
        points = np.array([(x, y, 0.0) for x, y in outline[first:] + outline[:first]])
        triangles, _ = triangulate(points, np.array([len(points)]), np.arange(len(points)))
        a, b, c = np.moveaxis(points[triangles], 1, 0)
        assert np.cross(b - a, c - a)[:, 2].min() > 0


def model_scene(tmp_path: Path, **keys: object) -> wj.Scene:
    """Return a scene with one model."""
    body = {"type": "model", "material": "m", "resolution": 8, **keys}
    (tmp_path / "scene.toml").write_text("[materials.m]\n[[bodies]]\n" + toml(body))
    return wj.load_scene(tmp_path / "scene.toml")


def toml(table: dict[str, object]) -> str:
    """Return a table as TOML."""
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


@pytest.mark.parametrize("size", [1e-4, 0.5, 300.0])
def test_fit_gives_the_model_its_size(tmp_path: Path, size: float) -> None:
    """Make the largest extent of a model this long, about the origin of its file."""
    (tmp_path / "a.obj").write_text(obj_text(FORK))
    plan = plan_scene(model_scene(tmp_path, file="a.obj", fit=size))
    factor = size / np.ptp(FORK.points, axis=0).max()
    lattice = plan.bodies[0].build()
    scaled = plan_scene(model_scene(tmp_path, file="a.obj", scale=factor)).bodies[0].build()
    np.testing.assert_allclose(lattice.particles, scaled.particles, rtol=1e-6, atol=1e-6 * size)


def test_a_stage_in_a_scene_with_z_up_is_turned(tmp_path: Path) -> None:
    """Take the up axis from the scene and the prim from the body."""
    stage = new_stage(1.0, "Y")
    define_mesh(stage, "/World/a", prism([(0, 0), (1, 0), (1, 1), (0, 1)], 2.0))
    define_mesh(stage, "/World/b", FORK)
    stage.Export(str(tmp_path / "a.usda"))
    scene = model_scene(tmp_path, file="a.usda", prim="/World/a")
    for up_axis, size in (("Y", [1, 1, 2]), ("Z", [1, 2, 1])):
        lattice = plan_scene(scene.model_copy(update={"up_axis": up_axis})).bodies[0].build()
        np.testing.assert_allclose(np.ptp(lattice.particles, axis=0), size, rtol=1e-6)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"fit": 1.0, "scale": 1.0}, "bodies.0.fit = 1.0: give scale or fit, not both"),
        ({"fit": 0.0}, "bodies.0.fit = 0.0"),
        ({"prim": "/World"}, 'bodies.0.prim = "/World": only USD files have prims: .usd .usda .usdc .usdz'),
    ],
)
def test_keys_that_do_not_go_together_are_refused(tmp_path: Path, keys: dict[str, object], said: str) -> None:
    """Name the key."""
    (tmp_path / "a.obj").write_text(obj_text(FORK))
    with pytest.raises(wj.InputError) as caught:
        model_scene(tmp_path, file="a.obj", **keys)
    assert said in str(caught.value)
