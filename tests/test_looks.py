import base64
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from warpjelly.errors import SceneError
from warpjelly.looks import Look, Placing, Texture
from warpjelly.meshes import LoadedModel, load_model
from warpjelly.polygons import from_polygons, joined, placed
from warpjelly.readers.mtlfile import read_mtl
from warpjelly.stage.usdlooks import define_look
from warpjelly.stage.validate import stage_problems

# Images are kept as they are, so it does not matter what is in them.
RED, BLUE = b"\x89PNG red", b"\xff\xd8\xff another, blue image"

# A square and a triangle that share an edge, at which their UVs differ. Numbers are exact in float32.
POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0.5]], float)
COUNTS, CORNERS = [4, 3], [0, 1, 2, 3, 1, 4, 2]
UVS = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.25, 0], [0.5, 0.75], [0.25, 1]])
NORMALS = np.array([[0, 0, 1]] * 4 + [[0.6, 0, 0.8]] * 3)
# The same polygons from behind, each from its first corner on.
BEHIND = [0, 3, 2, 1, 4, 6, 5]


def assert_drawing(model: LoadedModel, *, order: list[int] | None = None) -> None:
    """Require the drawing to be the two polygons, with corners in an order, and its vertices those of the mesh."""
    drawing = model.drawing
    order = list(range(len(CORNERS))) if order is None else order
    np.testing.assert_array_equal(drawing.vertices, POINTS)
    np.testing.assert_array_equal(drawing.counts, COUNTS)
    np.testing.assert_array_equal(drawing.corners, np.array(CORNERS)[order])
    np.testing.assert_array_equal(drawing.uvs, UVS[order])
    # Unit vectors of float32, divided by a length that is 1 but for rounding.
    np.testing.assert_allclose(drawing.normals, NORMALS[order], rtol=0, atol=2.0**-23)
    np.testing.assert_array_equal(model.mesh.vertices, np.unique(POINTS, axis=0))


LINES = [*(f"v {x} {y} {z}" for x, y, z in POINTS), *(f"vt {u} {v}" for u, v in UVS)]
OBJ = """mtllib paint.mtl
v 9 9 9
LINES
vn 0 0 2
vn 0.6 0 0.8
o Big Thing
usemtl shiny red
f 2/1/1 3/2/1 4/3/1 5/4/1
g left upper
usemtl blue
f -4/-3/-1 -1/-2/-1 -3/-1/-1
f 2 3
""".replace("LINES", "\n".join(LINES))
MTL = """# by hand
newmtl shiny red
Kd 0.8 0.1 0.2
Ke 0 1 2
Ns 30
d 0.5
newmtl blue
Kd 1 1 1
Pr 0.25
Pm 1
Tr 0.25
Ns 30
map_Kd -s 2 2 -clamp on -o 0.5 images\\blue sky.png
map_d images/blue sky.png
norm bumps.png
newmtl unused
map_Kd none.png
"""


def test_obj_keeps_what_it_is_drawn_with(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Read seams, numbers that count back, lengths of normals, objects, groups and materials."""
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "paint.mtl").write_text(MTL.replace("none.png", "bumps.png"))
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "blue sky.png").write_bytes(BLUE)
    (tmp_path / "bumps.png").write_bytes(RED)
    model = load_model(tmp_path / "a.obj")
    assert_drawing(model)
    assert [model.drawing.names[group] for group in model.drawing.groups] == [
        ("Big Thing", "shiny red"),
        ("Big Thing", "left", "upper", "blue"),
    ]
    placing = Placing(0.0, (2.0, 2.0), (0.5, 0.0))
    sky = Texture("blue sky.png", BLUE, srgb=True, wrap=("clamp", "clamp"), placing=placing)
    bumps = Texture("bumps.png", RED, scale=(2, 2, 2, 1), bias=(-1, -1, -1, 0))
    assert [model.looks[look] for look in model.drawing.looks] == [
        Look(
            "shiny red",
            # A highlight as wide as with the exponent 30: 2 / 32 to the power of 1/4.
            {"diffuseColor": (0.8, 0.1, 0.2), "emissiveColor": (0, 1, 2), "roughness": 0.5, "opacity": 0.5},
        ),
        Look(
            "blue",
            {"diffuseColor": sky, "roughness": 0.25, "metallic": 1.0, "opacity": sky.of("a"), "normal": bumps},
        ),
    ]
    assert len(model.looks) == 2
    assert not caplog.records


@pytest.mark.parametrize("name", ["Big Thing", "upper", "blue"])
def test_a_region_is_found_by_name(tmp_path: Path, name: str) -> None:
    """Find the triangles of an object, a group and a material, and list the names where there is none."""
    (tmp_path / "a.obj").write_text(OBJ)
    model = load_model(tmp_path / "a.obj")
    triangles = model.region(name)
    areas = model.mesh.area_faces[triangles]
    # The square is cut in two; the triangle has the sides (0, 1, 0) and (1, 0.5, 0.5).
    slope = 0.5 * np.sqrt(1.25)
    expected = [0.5, 0.5, slope] if name == "Big Thing" else [slope]
    np.testing.assert_allclose(np.sort(areas), np.sort(expected), rtol=1e-15)
    with pytest.raises(SceneError) as caught:
        model.region("green")
    assert str(caught.value) == (
        f"{tmp_path / 'a.obj'}: no part of the model is called 'green'; "
        "there are Big Thing, shiny red, left, upper, blue"
    )


def test_names_are_said_to_be_missing(tmp_path: Path) -> None:
    """Say that a model without names has none."""
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3")
    with pytest.raises(SceneError, match=r"called 'a'; none of its parts has a name$"):
        load_model(tmp_path / "a.obj").region("a")


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({}, "the materials of paint.mtl cannot be read: No such file or directory"),
        (
            {"paint.mtl": "newmtl blue\nmap_Kd words.png", "words.png": "not an image"},
            "the texture words.png is left out: it is not an image",
        ),
        ({"paint.mtl": "newmtl blue\nmap_Kd -bm 1 none.png"}, "the texture none.png cannot be read: No such file"),
        ({"paint.mtl": "newmtl blue\nmap_Kd"}, "paint.mtl: the texture . cannot be read: Is a directory"),
        ({"paint.mtl": f"newmtl blue\nmap_Kd {'a' * 300}.png"}, "cannot be read: File name too long"),
        ({"paint.mtl": "newmtl blue\nmap_Kd a\0b.png"}, "the texture a?b.png cannot be read: embedded null byte"),
        ({"paint.mtl": "newmtl blue\nmap_Kd -o 0.5 1e-05 -2E3 none.png"}, "the texture none.png cannot be read"),
        ({"paint.mtl": "newmtl blue\nKd red"}, "paint.mtl: material blue: cannot read 'kd red'"),
        ({"paint.mtl": "newmtl blue\nd"}, "paint.mtl: material blue: cannot read 'd'"),
        ({"paint.mtl": "newmtl blue"}, "a.obj: materials that are in none of its files: shiny red"),
    ],
)
def test_what_is_missing_of_materials_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, files: dict[str, str], said: str
) -> None:
    """Warn of files that are missing and of what cannot be read, and read the rest."""
    (tmp_path / "a.obj").write_text(OBJ)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    model = load_model(tmp_path / "a.obj")
    assert_drawing(model)
    assert [look.inputs for look in model.looks] == [{}] * ("paint.mtl" in files)
    assert said in caplog.text


@pytest.mark.parametrize(
    ("statements", "inputs"),
    [
        ("d 0.25", {"opacity": 0.25}),
        ("Tr 0.25", {"opacity": 0.75}),
        ("d 0.25\nTr 0.5", {"opacity": 0.25}),
        ("Kd 0.5", {"diffuseColor": (0.5, 0.5, 0.5)}),
        ("Ns 30\nPr 0.125", {"roughness": 0.125}),
    ],
)
def test_mtl_values_are_inputs(tmp_path: Path, statements: str, inputs: dict[str, object]) -> None:
    """Read opacities either way round, greys, and one of two statements for the same."""
    (tmp_path / "a.mtl").write_text(f"newmtl paint\n{statements}\n")
    assert read_mtl(tmp_path / "a.obj", tmp_path / "a.mtl") == [Look("paint", inputs)]


@pytest.mark.parametrize(("name", "said"), [("a" * 300, "File name too long"), ("a\0b", "embedded null byte")])
def test_a_name_that_no_file_has_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, said: str
) -> None:
    """Read a model whose file of materials has a name that is too long, or none at all."""
    (tmp_path / "a.obj").write_text(OBJ.replace("paint.mtl", name))
    assert_drawing(load_model(tmp_path / "a.obj"))
    assert said in caplog.text


def test_byte_order_marks_are_passed_over(tmp_path: Path) -> None:
    """Read text files as some editors save them, the first lines of which count, too."""
    triangle = "0 0 0\n1 0 0\n0 1 0\n"
    files = {
        "a.obj": "".join(f"v {line}\n" for line in triangle.splitlines()) + "mtllib a.mtl\nusemtl red\nf 1 2 3\n",
        "a.mtl": "newmtl red\nKd 1 0 0\n",
        "a.off": f"OFF\n3 1 0\n{triangle}3 0 1 2\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
    for name in ("a.obj", "a.off"):
        np.testing.assert_array_equal(load_model(tmp_path / name).drawing.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert load_model(tmp_path / "a.obj").looks == [Look("red", {"diffuseColor": (1.0, 0.0, 0.0)})]


def test_corners_without_uvs_and_normals(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Fill gaps with UVs of 0 and normals of the polygon, and warn of numbers that are out of range."""
    triangle = "v 0 0 0\nv 0 2 0\nv 0 0 3\nvt 0.5\nvn 1 0 0\n"
    (tmp_path / "a.obj").write_text(triangle + "f 1/1/1 3/1 2//9\nf 1/7 2/7 3/-2")
    drawing = load_model(tmp_path / "a.obj").drawing
    np.testing.assert_array_equal(drawing.uvs, [[0.5, 0], [0.5, 0], *[[0, 0]] * 4])
    np.testing.assert_array_equal(drawing.normals, [[1, 0, 0], *[[-1, 0, 0]] * 2, *[[1, 0, 0]] * 3])
    assert "3 corners have texture coordinates that do not exist" in caplog.text
    assert "1 corners have normals that do not exist" in caplog.text


def test_a_mirror_turns_polygons_round() -> None:
    """Keep UVs and normals at their corners, and normals upright on what is stretched."""
    part = from_polygons(POINTS, COUNTS, CORNERS, uvs=UVS, normals=NORMALS, looks=[3, 4], groups=[0, 1], names=[(), ()])
    moved = placed(part, np.array([[-2, 0, 0, 5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    np.testing.assert_array_equal(moved.vertices, POINTS * (-2, 1, 1) + (5, 0, 0))
    np.testing.assert_array_equal(moved.counts, COUNTS)
    np.testing.assert_array_equal(moved.corners, np.array(CORNERS)[BEHIND])
    np.testing.assert_array_equal(moved.uvs, UVS[BEHIND])
    np.testing.assert_array_equal(moved.looks, [3, 4])
    slanted = np.array([-0.6 / 2, 0, 0.8]) / np.hypot(0.3, 0.8)
    np.testing.assert_allclose(moved.normals, [[0, 0, 1]] * 4 + [slanted] * 3, rtol=0, atol=1e-15)


def test_a_flat_matrix_keeps_normals_sound() -> None:
    """Flatten a slanted polygon: its normal is that of the plane."""
    moved = placed(from_polygons(POINTS, COUNTS, CORNERS, normals=NORMALS), np.diag([1.0, 1.0, 0.0, 1.0]))
    np.testing.assert_allclose(joined([moved]).normals, [[0, 0, 1]] * 7, rtol=0, atol=1e-15)


def test_parts_are_joined() -> None:
    """Join a part that has everything with one that has nothing, and drop what no polygon uses."""
    full = from_polygons(POINTS, COUNTS, CORNERS, uvs=UVS, normals=NORMALS, looks=1, names=[("a",)])
    plain = from_polygons(POINTS[[2, 1, 0, 3]], [2, 3], [0, 1, 0, 1, 2], groups=[0, 1], names=[("b",), ("c",)])
    whole = joined([full, plain])
    np.testing.assert_array_equal(whole.vertices, np.concatenate([POINTS, POINTS[[2, 1, 0]]]))
    np.testing.assert_array_equal(whole.corners, [*CORNERS, 5, 6, 7])
    np.testing.assert_array_equal(whole.counts, [4, 3, 3])
    np.testing.assert_array_equal(whole.uvs, [*UVS, *[[0, 0]] * 3])
    np.testing.assert_allclose(whole.normals, [*NORMALS, *[[0, 0, -1]] * 3], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(whole.looks, [1, 1, -1])
    assert [whole.names[group] for group in whole.groups] == [("a",), ("a",), ("c",)]
    assert joined([plain]).uvs is None
    assert joined([plain]).normals is None


@pytest.mark.parametrize("uv_names", ["s t", "u v", "texture_u texture_v", ""])
def test_ply_keeps_uvs_and_normals(tmp_path: Path, uv_names: str) -> None:
    """Read them by all of the names that programs give them."""
    names = ["x", "y", "z", "nx", "ny", "nz", *uv_names.split()]
    # Vertices cannot have two UVs, so each corner is one.
    rows = np.concatenate([POINTS[CORNERS], NORMALS, UVS], axis=1)[:, : len(names)]
    header = ["ply", "format ascii 1.0", "element vertex 7", *(f"property float {name}" for name in names)]
    header += ["element face 2", "property list uchar int vertex_indices", "end_header"]
    (tmp_path / "a.ply").write_text(
        "\n".join([*header, *(" ".join(map(str, row)) for row in rows), "4 0 1 2 3\n3 4 5 6"])
    )
    drawing = load_model(tmp_path / "a.ply").drawing
    np.testing.assert_array_equal(drawing.vertices, POINTS[CORNERS])
    np.testing.assert_allclose(drawing.normals, NORMALS, rtol=0, atol=1e-15)
    if uv_names:
        np.testing.assert_array_equal(drawing.uvs, UVS)
    else:
        assert drawing.uvs is None


# The corners of the polygons as triangles.
TRIANGLES = [0, 1, 2, 0, 2, 3, 4, 5, 6]
GLTF_TYPES = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}


def gltf(arrays: dict[str, np.ndarray], primitives: list[dict[str, object]], **more: object) -> tuple[dict, bytes]:
    """Return the JSON and the bytes of a glTF file of one mesh; it names arrays where glTF has their numbers."""
    names, views, accessors, data = list(arrays), [], [], b""
    for array in arrays.values():
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[array.shape[1] if array.ndim == 2 else 1]
        accessors.append({"bufferView": len(views) - 1, "componentType": GLTF_TYPES[array.dtype.str[1:]],
                          "count": len(array), "type": kind})  # fmt: skip
        data += array.tobytes() + bytes(-array.nbytes % 4)
    mesh = [
        {
            "attributes": {kind: names.index(name) for kind, name in primitive["attributes"].items()},
            **{key: value for key, value in primitive.items() if key != "attributes"},
            **({"indices": names.index(primitive["indices"])} if "indices" in primitive else {}),
        }
        for primitive in primitives
    ]
    views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(RED)})
    data += RED
    header = {"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data)}], "bufferViews": views,
              "accessors": accessors, "meshes": [{"name": "shape", "primitives": mesh}], "nodes": [{"mesh": 0}],
              "scenes": [{"nodes": [0]}], **more}  # fmt: skip
    return header, data


def write_gltf(path: Path, header: dict, data: bytes) -> None:
    """Write a file of JSON, with its bytes beside it, or a GLB file."""
    if path.suffix == ".gltf":
        path.with_name("some data.bin").write_bytes(data)
        buffers = [{"byteLength": len(data), "uri": "some%20data.bin"}]
        path.write_text(json.dumps({**header, "buffers": buffers}))
        return
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + b"JSON" + text + struct.pack("<I", len(data)) + b"BIN\0" + data
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body)


def gltf_arrays() -> dict[str, np.ndarray]:
    """Return the polygons, mirrored, as glTF has them: v points down."""
    return {
        "points": (POINTS[CORNERS] * (-1, 1, 1)).astype("<f4"),
        "normals": (NORMALS * (-1, 1, 1)).astype("<f4"),
        "uvs": np.c_[UVS[:, 0], 1 - UVS[:, 1]].astype("<f4"),
        "square": np.array(TRIANGLES[:6], "<u1"),
        "triangle": np.array(TRIANGLES[6:], "<u4"),
    }


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_gltf_keeps_what_it_is_drawn_with(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    """Read a mirrored node, both materials, images in the file, as text and beside it, and how they are wrapped."""
    (tmp_path / "blue sky.jpg").write_bytes(BLUE)
    text = "data:image/png;base64," + base64.b64encode(BLUE).decode()
    attributes = {"POSITION": "points", "NORMAL": "normals", "TEXCOORD_0": "uvs"}
    transform = {"offset": [0.25, 0.5], "scale": [2, 4], "rotation": np.pi / 2}
    header, data = gltf(
        gltf_arrays(),
        [
            {"attributes": attributes, "indices": "square", "material": 0},
            {"attributes": attributes, "indices": "triangle", "material": 1},
        ],
        nodes=[{"name": "top", "children": [1]}, {"name": "side", "mesh": 0, "scale": [-1, 1, 1]}],
        images=[
            {"bufferView": 5, "mimeType": "image/png", "name": "red.png"},
            {"uri": "blue%20sky.jpg"},
            {"uri": text},
        ],
        samplers=[{"wrapS": 33071, "wrapT": 33648}],
        textures=[{"source": 0, "sampler": 0}, {"source": 1}, {"source": 2}],
        materials=[
            {
                "name": "paint",
                "alphaMode": "MASK",
                "pbrMetallicRoughness": {
                    "baseColorFactor": [1, 0.5, 0.25, 0.5],
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.5,
                    "roughnessFactor": 0.75,
                    "metallicRoughnessTexture": {"index": 1, "extensions": {"KHR_texture_transform": transform}},
                },
                "normalTexture": {"index": 2, "scale": 0.5},
                "occlusionTexture": {"index": 1, "strength": 0.25},
                "emissiveTexture": {"index": 1},
                "emissiveFactor": [0, 0.5, 1],
                "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
            },
            {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0.5]}, "alphaMode": "BLEND"},
        ],
    )
    write_gltf(tmp_path / name, header, data)
    model = load_model(tmp_path / name)
    # Each corner is a vertex, as glTF has it; triangles are turned round by the mirror.
    order = [0, 2, 1, 0, 3, 2, 4, 6, 5]
    drawing = model.drawing
    np.testing.assert_array_equal(drawing.vertices[drawing.corners], POINTS[CORNERS][order])
    np.testing.assert_array_equal(drawing.uvs, UVS[order])
    np.testing.assert_allclose(drawing.normals, NORMALS[order], rtol=0, atol=2.0**-23)
    np.testing.assert_array_equal(drawing.counts, [3, 3, 3])
    np.testing.assert_array_equal(drawing.looks, [0, 0, 1])
    assert [drawing.names[group] for group in drawing.groups] == [
        *[("top", "side", "shape", "paint")] * 2,
        ("top", "side", "shape"),
    ]
    red = Texture("red.png", RED, srgb=True, wrap=("clamp", "mirror"), scale=(1, 0.5, 0.25, 0.5))
    sky = Texture("blue sky.jpg", BLUE)
    # In glTF (u, v) becomes (0.25 - 4 v, 0.5 + 2 u); with v upwards, 1 - v, that is (4 v - 3.75, 0.5 - 2 u).
    placing = Placing(-90.0, (2.0, 4.0), (-3.75, 0.5))
    surface = model.looks[0].inputs["roughness"]
    np.testing.assert_allclose(surface.placing.translation, placing.translation, rtol=0, atol=1e-15)
    surface = replace(sky, scale=(1, 0.75, 0.5, 1), placing=surface.placing)
    assert model.looks[0].name == "paint"
    assert model.looks[0].inputs == {
        "diffuseColor": red,
        "opacity": red.of("a"),
        "opacityThreshold": 0.5,
        "roughness": surface.of("g"),
        "metallic": surface.of("b"),
        "normal": Texture("image_2.png", BLUE, scale=(1, 1, 2, 1), bias=(-0.5, -0.5, -1, 0)),
        "occlusion": replace(sky.of("r"), scale=(0.25,) * 4, bias=(0.75,) * 4),
        "emissiveColor": replace(sky, srgb=True, scale=(0, 2, 4, 1)),
    }
    assert surface.placing == replace(placing, translation=surface.placing.translation)
    assert model.looks[1] == Look(
        "material_1", {"diffuseColor": (1, 0, 0), "opacity": 0.5, "roughness": 1.0, "metallic": 1.0}
    )
    assert not caplog.records


def test_gltf_arrays_are_read_as_they_are_stored(tmp_path: Path) -> None:
    """Read strips, fans, no indices, lines, steps between values, shares of 65535, and values that replace others."""
    arrays = {
        "points": np.c_[UVS[[0, 1, 3, 2]], POINTS[[0, 1, 3, 2]]].astype("<f4"),
        "uvs": (np.c_[UVS[[0, 1, 3, 2], 0], 1 - UVS[[0, 1, 3, 2], 1]] * 65535).astype("<u2"),
        "around": np.array([0, 1, 3, 2], "<u2"),
        "rows": np.array([2], "<u1"),
        "values": np.array([[0, 3, 0]], "<f4"),
    }
    both = {"POSITION": "points", "TEXCOORD_0": "uvs"}
    header, data = gltf(
        {name: array if name != "points" else array[:, 2:].copy() for name, array in arrays.items()},
        [
            {"attributes": both, "mode": 5},
            {"attributes": both, "indices": "around", "mode": 6},
            {"attributes": both, "mode": 1},
            {"attributes": both},
        ],
    )
    # Points lie where they did, behind the UVs of each.
    start = len(data)
    data += arrays["points"].tobytes()
    header["bufferViews"].append({"buffer": 0, "byteOffset": start, "byteLength": 80, "byteStride": 20})
    header["accessors"][0] |= {"bufferView": len(header["bufferViews"]) - 1, "byteOffset": 8}
    header["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 3, "componentType": GLTF_TYPES["u1"]},
        "values": {"bufferView": 4},
    }
    header["accessors"][1]["normalized"] = True
    write_gltf(tmp_path / "a.glb", header, data)
    drawing = load_model(tmp_path / "a.glb").drawing
    order = [0, 1, 2, 1, 3, 2, 1, 3, 0, 3, 2, 0, 0, 1, 2]
    points = np.where(np.arange(4)[:, None] == 2, (0, 3, 0), POINTS[[0, 1, 3, 2]])
    np.testing.assert_array_equal(drawing.vertices[drawing.corners], points[order])
    np.testing.assert_array_equal(drawing.uvs, UVS[[0, 1, 3, 2]][order])


@pytest.mark.parametrize(
    ("use", "said"),
    [
        ({"index": 0}, "material m has no baseColorTexture"),
        ({"index": 1}, "the texture none.png cannot be read: No such file or directory"),
        ({"index": 2, "texCoord": 1}, "its emissiveTexture is left out, because it has other UVs"),
    ],
)
def test_gltf_textures_that_cannot_be_had_are_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, use: dict[str, object], said: str
) -> None:
    """Read the rest of the material."""
    header, data = gltf(
        gltf_arrays(),
        [{"attributes": {"POSITION": "points"}, "indices": "square", "material": 0}],
        images=[{"uri": "none.png"}, {"uri": "data:image/png;base64,"}],
        textures=[{}, {"source": 0}, {"source": 1}],
        materials=[
            {
                "name": "m",
                "pbrMetallicRoughness": {"baseColorTexture": use, "baseColorFactor": [1, 0.5, 0, 1]},
                "emissiveTexture": {"index": 2},
                "emissiveFactor": [1, 0, 0],
            }
        ],
    )
    write_gltf(tmp_path / "a.glb", header, data)
    model = load_model(tmp_path / "a.glb")
    assert said in caplog.text
    if "texCoord" in use:
        assert model.looks[0].inputs["emissiveColor"] == (1, 0, 0)
    else:
        assert model.looks[0].inputs["diffuseColor"] == (1, 0.5, 0)


def test_gltf_says_which_file_is_missing(tmp_path: Path) -> None:
    """Name the model and the file that its arrays are in."""
    header, _ = gltf(gltf_arrays(), [])
    (tmp_path / "a.gltf").write_text(json.dumps({**header, "buffers": [{"byteLength": 9, "uri": "gone.bin"}]}))
    with pytest.raises(SceneError, match=r"a\.gltf: not a sound \.gltf file: gone\.bin cannot be read: No such file"):
        load_model(tmp_path / "a.gltf")


def new_stage() -> tuple[Usd.Stage, UsdGeom.Mesh]:
    """Return a sound stage with the two polygons, without UVs and normals."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Y")
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(0)
    stage.SetTimeCodesPerSecond(24)
    stage.SetFramesPerSecond(24)
    UsdGeom.Camera.Define(stage, "/World/camera")
    mesh = UsdGeom.Mesh.Define(stage, "/World/thing")
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreatePointsAttr([Gf.Vec3f(*point) for point in POINTS.tolist()])
    mesh.CreateFaceVertexCountsAttr(COUNTS)
    mesh.CreateFaceVertexIndicesAttr(CORNERS)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    return stage, mesh


def add_uvs(mesh: UsdGeom.Mesh, name: str = "st", *, indexed: bool = False) -> None:
    """Give a mesh the UVs, at its corners."""
    kind = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    values, indices = np.unique(UVS, axis=0, return_inverse=True) if indexed else (UVS, None)
    primvar.Set([Gf.Vec2f(*value) for value in values.tolist()])
    if indexed:
        primvar.SetIndices(indices.reshape(-1).tolist())


def add_normals(mesh: UsdGeom.Mesh) -> None:
    """Give a mesh the normals, one for each polygon."""
    mesh.CreateNormalsAttr([Gf.Vec3f(*NORMALS[0]), Gf.Vec3f(*NORMALS[-1])])
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.uniform)


SKY = Texture("sky.png", BLUE, srgb=True, wrap=("clamp", "mirror"), scale=(1, 0.5, 0.25, 0.5))
LOOKS = [
    Look("plain", {"diffuseColor": (1, 0.5, 0.25), "roughness": 0.25, "useSpecularWorkflow": 1, "ior": 1.25}),
    Look(
        "painted",
        {
            "diffuseColor": SKY,
            "opacity": SKY.of("a"),
            "opacityThreshold": 0.5,
            "emissiveColor": replace(SKY, placing=Placing(90.0, (2, 0.5), (0.25, 1))),
            "roughness": Texture("red.png", RED, "g", bias=(0, 0.5, 0, 0)),
            "metallic": Texture("red.png", RED, "b", bias=(0, 0.5, 0, 0)),
            "occlusion": Texture("red.png", RED, "r", wrap=("useMetadata", "black")),
            "normal": Texture("sky.png", BLUE, scale=(2, 2, 2, 1), bias=(-1, -1, -1, 0)),
        },
    ),
]


def write_looks(folder: Path) -> Path:
    """Write a stage with a polygon in each look."""
    stage, mesh = new_stage()
    add_uvs(mesh)
    for number, look in enumerate(LOOKS):
        material = define_look(stage, Sdf.Path(f"/World/looks/{look.name}"), look, folder / "textures")
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, f"part{number}", "face", [number], "materialBind", "partition")
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.Export(str(folder / "a.usda"))
    return folder / "a.usda"


@pytest.mark.parametrize("packed", [False, True])
def test_looks_are_written_and_read_back(
    tmp_path: Path, packed: bool, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture
) -> None:
    """Write every kind of input, find nothing wrong with the stage, and read the same, out of a package, too."""
    file = write_looks(tmp_path)
    assert stage_problems(file) == []
    assert {file.name: file.read_bytes() for file in (tmp_path / "textures").iterdir()} == {
        "sky.png": BLUE,
        "red.png": RED,
    }
    if packed:
        package = tmp_path / "packed" / "a.usdz"
        package.parent.mkdir()
        assert UsdUtils.CreateNewUsdzPackage(str(file), str(package))
        file = package
    model = load_model(file)
    assert model.looks == LOOKS
    np.testing.assert_array_equal(model.drawing.looks, [0, 1])
    np.testing.assert_array_equal(model.drawing.uvs, UVS)
    assert len(model.region("part0")) == len(model.region("/World/looks/plain")) == 2
    assert len(model.region("painted")) == 1
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_color_spaces_are_those_of_inputs_unless_given(tmp_path: Path) -> None:
    """Take images for colours as sRGB, and others as they are."""
    file = write_looks(tmp_path)
    text = file.read_text().replace('sourceColorSpace = "sRGB"', 'sourceColorSpace = "auto"')
    file.write_text(text.replace('sourceColorSpace = "raw"', 'sourceColorSpace = "auto"'))
    (look,) = [look for look in load_model(file).looks if look.name == "painted"]
    textures = {name: value for name, value in look.inputs.items() if isinstance(value, Texture)}
    colors = {"diffuseColor", "emissiveColor", "specularColor"}
    assert {name for name, texture in textures.items() if texture.srgb} == colors & textures.keys()
    assert len({texture.srgb for texture in textures.values()}) == 2


def test_images_are_written_once_under_safe_names(tmp_path: Path) -> None:
    """Share files that are equal, and tell apart those that only have the same name."""
    stage, _ = new_stage()
    names = ["a b/../c.png", "c.png", "other.png", ".ä", "a b/../c.png"]
    for number, (name, data) in enumerate(zip(names, [RED, BLUE, RED, b"3", b"4"], strict=True)):
        look = Look("m", {"diffuseColor": Texture(name, data)})
        define_look(stage, Sdf.Path(f"/World/m{number}"), look, tmp_path / "textures")
    written = {file.name: file.read_bytes() for file in (tmp_path / "textures").iterdir()}
    assert written == {"a_b_.._c.png": RED, "c.png": BLUE, "_": b"3", "a_b_.._c_1.png": b"4"}
    used = [stage.GetAttributeAtPath(f"/World/m{k}/diffuseColor_texture.inputs:file").Get().path for k in range(5)]
    assert used == [f"./textures/{name}" for name in ("a_b_.._c.png", "c.png", "a_b_.._c.png", "_", "a_b_.._c_1.png")]


@pytest.mark.parametrize("left_handed", [False, True])
@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("name", ["st", "UVMap"])
def test_usd_keeps_uvs_and_normals(tmp_path: Path, name: str, indexed: bool, left_handed: bool) -> None:
    """Read UVs by any name, with numbers or without, and polygons that are seen from behind."""
    stage, mesh = new_stage()
    if name == "UVMap":
        # Not what it is called, but its type says that it is a UV.
        other = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("a", Sdf.ValueTypeNames.Float2Array, UsdGeom.Tokens.constant)
        other.Set([Gf.Vec2f(7, 7)])
    add_uvs(mesh, name, indexed=indexed)
    add_normals(mesh)
    if left_handed:
        mesh.CreateOrientationAttr("leftHanded")
    stage.Export(str(tmp_path / "a.usda"))
    model = load_model(tmp_path / "a.usda")
    assert_drawing(model, order=BEHIND if left_handed else None)
    assert model.drawing.names[model.drawing.groups[0]] == ("/World", "World", "/World/thing", "thing")


@pytest.mark.parametrize("interpolation", ["constant", "uniform", "vertex", "varying", "faceVarying"])
def test_usd_normals_of_any_interpolation(tmp_path: Path, interpolation: str) -> None:
    """Give each corner its own, and prefer the primvar to the attribute."""
    stage, mesh = new_stage()
    add_normals(mesh)
    places = {
        "constant": [0] * 7,
        "uniform": [0] * 4 + [1] * 3,
        "vertex": CORNERS,
        "varying": CORNERS,
        "faceVarying": range(7),
    }[interpolation]
    values = np.random.default_rng(1).normal(size=(max(places) + 1, 3)).astype(np.float32)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, interpolation)
    primvar.Set([Gf.Vec3f(*value) for value in values.tolist()])
    stage.Export(str(tmp_path / "a.usda"))
    expected = values.astype(float) / np.linalg.norm(values.astype(float), axis=1, keepdims=True)
    normals = load_model(tmp_path / "a.usda").drawing.normals
    np.testing.assert_allclose(normals, expected[list(places)], rtol=0, atol=1e-15)


def test_usd_that_is_not_sound_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Leave out UVs that are too few, materials of other kinds and images that are missing."""
    stage, mesh = new_stage()
    add_uvs(mesh)
    UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Set([Gf.Vec2f(0, 0)])
    look = Look("painted", {"diffuseColor": SKY, "roughness": 0.25})
    painted = define_look(stage, Sdf.Path("/World/painted"), look, tmp_path / "textures")
    other = UsdShade.Material.Define(stage, "/World/other")
    for number, material in enumerate((painted, other)):
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, f"part{number}", "face", [number, 9], "materialBind")
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)
    stage.Export(str(tmp_path / "a.usda"))
    (tmp_path / "textures" / "sky.png").unlink()
    model = load_model(tmp_path / "a.usda")
    assert model.drawing.uvs is None
    assert model.looks == [Look("painted", {"roughness": 0.25})]
    np.testing.assert_array_equal(model.drawing.looks, [0, -1])
    assert len(model.region("other")) == 1
    for said in (
        "/World/thing.primvars:st has too few values; left out",
        "material /World/other is left out, because it is not a UsdPreviewSurface",
        "/World/painted/diffuseColor_texture: the texture ./textures/sky.png is missing",
    ):
        assert said in caplog.text


def test_usd_inputs_are_found_through_the_material(tmp_path: Path) -> None:
    """Read a number and the name of an image that the material's own inputs give to its shaders."""
    stage, mesh = new_stage()
    look = Look("m", {"diffuseColor": SKY, "roughness": 0.5})
    material = define_look(stage, Sdf.Path("/World/m"), look, tmp_path / "textures")
    for shader, name, kind, value in (
        ("surface", "roughness", Sdf.ValueTypeNames.Float, 0.75),
        ("diffuseColor_texture", "file", Sdf.ValueTypeNames.Asset, "./red.png"),
    ):
        given = material.CreateInput(name, kind)
        given.Set(value)
        UsdShade.Shader.Get(stage, f"/World/m/{shader}").GetInput(name).ConnectToSource(given)
    (tmp_path / "red.png").write_bytes(RED)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.Export(str(tmp_path / "a.usda"))
    expected = Look("m", {"diffuseColor": replace(SKY, name="red.png", data=RED), "roughness": 0.75})
    assert load_model(tmp_path / "a.usda").looks == [expected]


def test_usd_inputs_of_another_type_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Take colours of double precision, and warn of a text for a number and of a colour that a shader computes."""
    stage, mesh = new_stage()
    material = define_look(stage, Sdf.Path("/World/m"), Look("m", {"metallic": 0.5}), tmp_path / "textures")
    surface = UsdShade.Shader.Get(stage, "/World/m/surface")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3d).Set(Gf.Vec3d(0.1, 0.2, 0.3))
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Token).Set("rough")
    reader = UsdShade.Shader.Define(stage, "/World/m/reader")
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    glow = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(glow)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.Export(str(tmp_path / "a.usda"))
    assert load_model(tmp_path / "a.usda").looks == [Look("m", {"metallic": 0.5, "diffuseColor": (0.1, 0.2, 0.3)})]
    assert "/World/m/surface.inputs:roughness is of another type; left out" in caplog.text
    assert "/World/m/reader is left out, because it is not a UsdUVTexture" in caplog.text


def test_instances_share_looks(tmp_path: Path) -> None:
    """Read the looks of a file that is instanced twice once."""
    write_looks(tmp_path)
    stage = Usd.Stage.CreateNew(str(tmp_path / "b.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for k in range(2):
        copy = UsdGeom.Xform.Define(stage, f"/World/copy{k}")
        copy.GetPrim().GetReferences().AddReference("./a.usda")
        copy.GetPrim().SetInstanceable(True)
    stage.Save()
    model = load_model(tmp_path / "b.usda")
    assert model.looks == LOOKS
    np.testing.assert_array_equal(model.drawing.looks, [0, 1, 0, 1])
    assert len(model.region("/World/copy1")) == len(model.region("World")) / 2 == 3
    assert len(model.region("/World/copy1/looks/plain")) == 2


def test_groups_of_overlapping_subsets_have_all_names(tmp_path: Path) -> None:
    """Find a polygon by each of the subsets that it is in."""
    stage, mesh = new_stage()
    for name, faces in (("all", [0, 1]), ("one", [1]), ("none", [])):
        UsdGeom.Subset.CreateGeomSubset(mesh, name, "face", faces)
    stage.Export(str(tmp_path / "a.usda"))
    model = load_model(tmp_path / "a.usda")
    assert [len(model.region(name)) for name in ("all", "/World/thing/one", "thing")] == [3, 1, 3]
    with pytest.raises(SceneError, match="called 'none'"):
        model.region("none")


DAE = f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00Z</created><modified>2020-01-01T00:00:00Z</modified><up_axis>Y_UP</up_axis></asset>
<library_images><image id="sky"><init_from>./blue%20sky.png</init_from></image></library_images>
<library_effects>
<effect id="e1"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>sky</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="common"><phong><emission><color>0 0.5 1 1</color></emission>
<diffuse><texture texture="t" texcoord="UV"/></diffuse><shininess><float>30</float></shininess></phong></technique>
</profile_COMMON></effect>
<effect id="e2"><profile_COMMON><technique sid="common"><lambert><diffuse><color>1 0.5 0.25 1</color></diffuse>
<transparent><color>1 1 1 0.5</color></transparent><transparency><float>0.5</float></transparency></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m1" name="paint"><instance_effect url="#e1"/></material>
<material id="m2"><instance_effect url="#e2"/></material></library_materials>
<library_geometries><geometry id="shape" name="the shape"><mesh>
<source id="p"><float_array id="pa" count="15">{" ".join(map(str, (POINTS * (-1, 1, 1)).ravel()))}</float_array>
<technique_common><accessor source="#pa" count="5" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<source id="n"><float_array id="na" count="21">{" ".join(map(str, (NORMALS * (-1, 1, 1)).ravel()))}</float_array>
<technique_common><accessor source="#na" count="7" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<source id="u"><float_array id="ua" count="14">{" ".join(map(str, UVS.ravel()))}</float_array>
<technique_common><accessor source="#ua" count="7" stride="2"><param name="S" type="float"/>
<param name="T" type="float"/>
</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist material="one" count="1"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#n" offset="1"/><input semantic="TEXCOORD" source="#u" offset="2"/>
<vcount>4</vcount><p>0 0 0 1 1 1 2 2 2 3 3 3</p></polylist>
<triangles material="two" count="1"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#n" offset="1"/><input semantic="TEXCOORD" source="#u" offset="2"/>
<p>1 4 4 4 5 5 2 6 6</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node id="n1" name="top"><node id="n2"><scale>-1 1 1</scale>
<instance_geometry url="#shape"><bind_material><technique_common><instance_material symbol="one" target="#m1"/>
<instance_material symbol="two" target="#m2"/></technique_common></bind_material></instance_geometry>
</node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""


def test_dae_keeps_what_it_is_drawn_with(tmp_path: Path) -> None:
    """Read polygons and triangles below a node that mirrors them, and their effects."""
    (tmp_path / "a.dae").write_text(DAE)
    (tmp_path / "blue sky.png").write_bytes(BLUE)
    model = load_model(tmp_path / "a.dae")
    drawing = model.drawing
    np.testing.assert_array_equal(drawing.counts, COUNTS)
    np.testing.assert_array_equal(drawing.vertices[drawing.corners], POINTS[CORNERS][BEHIND])
    np.testing.assert_array_equal(drawing.uvs, UVS[BEHIND])
    np.testing.assert_allclose(drawing.normals, NORMALS[BEHIND], rtol=0, atol=2.0**-23)
    assert [drawing.names[group] for group in drawing.groups] == [
        ("top", "n1", "n2", "the shape", "shape", "paint", "m1"),
        ("top", "n1", "n2", "the shape", "shape", "m2"),
    ]
    paint, clear = (model.looks[look] for look in drawing.looks)
    sky = Texture("blue sky.png", BLUE, srgb=True)
    assert paint == Look("paint", {"diffuseColor": sky, "emissiveColor": (0, 0.5, 1), "roughness": 0.5})
    assert clear.name == "m2"
    assert (clear.inputs["diffuseColor"], clear.inputs["opacity"]) == ((1, 0.5, 0.25), 0.25)


def test_dae_opacity_is_that_of_its_mode(tmp_path: Path) -> None:
    """Read an opacity that is what the mean of a colour leaves over."""
    color = "<transparent><color>1 1 1 0.5</color>"
    assert color in DAE
    text = DAE.replace(color, '<transparent opaque="RGB_ZERO"><color>0.5 0.25 0 1</color>')
    (tmp_path / "a.dae").write_text(text)
    (look,) = [look for look in load_model(tmp_path / "a.dae").looks if look.name == "m2"]
    # A transparency of 0.5 times the mean, 0.25.
    assert look.inputs["opacity"] == 0.875


def test_parts_of_a_3mf_have_names(tmp_path: Path) -> None:
    """Find the triangles of one of two objects by its name."""
    boxes = {"small": trimesh.creation.box(), "large": trimesh.creation.icosphere(subdivisions=0, radius=9.0)}
    trimesh.Scene(boxes).export(tmp_path / "a.3mf")
    model = load_model(tmp_path / "a.3mf")
    assert [len(model.region(name)) for name in boxes] == [12, 20]
    assert model.drawing.uvs is None
    assert model.looks == []


def test_normals_are_turned_upright(tmp_path: Path) -> None:
    """Turn normals as points where the scene has another axis up."""
    stage, mesh = new_stage()
    add_normals(mesh)
    stage.Export(str(tmp_path / "a.usda"))
    drawing = load_model(tmp_path / "a.usda", up_axis="Z").drawing
    x, y, z = np.float32(NORMALS).astype(float).T
    np.testing.assert_allclose(drawing.normals, np.c_[x, -z, y], rtol=0, atol=2.0**-23)
