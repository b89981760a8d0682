"""Read the triangles of a model file: all its objects, placed, in one mesh.

What a file or its format says about its unit and its up axis is applied: USD and COLLADA files say both, 3MF files say
their unit and have Z up, glTF is in metres with Y up. OBJ, STL, PLY and OFF say neither and are taken as they are.
"""

from __future__ import annotations

import json
from importlib import util
from pathlib import Path

import numpy as np
import trimesh

from .errors import SceneError
from .polygonfiles import read_obj, read_off, read_ply
from .polygons import Model, Part, from_polygons, placed
from .scene import USD_EXTENSIONS

# What can be read with nothing else installed, and what each other format needs besides.
EXTENSIONS = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf", *USD_EXTENSIONS)
EXTRA_EXTENSIONS = {".3mf": ("lxml", "networkx"), ".dae": ("collada",)}

_POLYGON_READERS = {".obj": read_obj, ".ply": read_ply, ".off": read_off}
_METERS_PER_3MF_UNIT = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}
# Extensions of glTF without which its coordinates mean something else.
_GLTF_COMPRESSION = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"}
# Rotations that turn one axis, pointing up, into another. What is to the right with X up is at -Y.
_TURNS = {
    ("X", "Y"): [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    ("X", "Z"): [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    ("Y", "Z"): [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    ("Z", "Y"): [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}


def load_mesh(path: Path, *, up_axis: str = "Y", prim: str | None = None) -> trimesh.Trimesh:
    """Read all triangles of a model file as one mesh, in metres where the file says its unit.

    Args:
        path: the file; its extension tells its format.
        up_axis: Y or Z; models that say which axis points up are turned so that this one does.
        prim: path of the prim below which the meshes of a USD file are read; its default prim if None.

    Raises:
        SceneError: the file has an unknown extension, needs packages that are missing, cannot be read, or holds no
            triangles of finite size.
    """
    kind = path.suffix.lower()
    if kind not in (*EXTENSIONS, *EXTRA_EXTENSIONS):
        known = " ".join((*EXTENSIONS, *EXTRA_EXTENSIONS))
        raise SceneError(f"{path}: unknown mesh format '{path.suffix}'; known: {known}")
    if not all(map(util.find_spec, EXTRA_EXTENSIONS.get(kind, ()))):
        raise SceneError(f"{path}: {kind} files need more packages: pip install 'warpjelly[formats]'")
    try:
        with open(path, "rb") as file:
            empty = not file.read(1)
        if empty:
            raise SceneError(f"{path}: the file is empty; it has no triangles")
        # A coordinate may be too large to compute with; that it is not finite then is found below.
        with np.errstate(over="ignore", invalid="ignore"):
            model = _read(path, kind, prim)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the mesh: {error.strerror or error}") from error
    except SceneError:
        raise
    # The readers raise whatever their parsing happens to trip over; all of it means that the file is broken.
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{path}: not a sound {path.suffix} file: {why}") from error
    return _joined(path, model, up_axis)


def _read(path: Path, kind: str, prim: str | None) -> Model:
    if kind in USD_EXTENSIONS:
        from .usdmodel import read_usd

        return read_usd(path, prim)
    if kind in _POLYGON_READERS:
        return Model([_POLYGON_READERS[kind](path)])
    if kind == ".dae":
        return _read_dae(path)
    if kind in (".glb", ".gltf"):
        _refuse_compressed(path)
    # Meshes are placed by the nodes of a scene, some of them more than once.
    scene = trimesh.load_scene(path, process=False)
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            parts.append(placed(Part(np.asarray(mesh.vertices), np.asarray(mesh.faces)), matrix))
    if kind == ".3mf":
        # The reader says "millimeters" where the file says nothing.
        unit = str(scene.metadata["units"]).replace("millimeters", "millimeter")
        return Model(parts, _METERS_PER_3MF_UNIT[unit], "Z")
    return Model(parts, up_axis="Y" if kind in (".glb", ".gltf") else "")


def _refuse_compressed(path: Path) -> None:
    """Refuse glTF files whose meshes are compressed, which would be read as something else.

    Raises:
        ValueError: they are, or the file is no glTF.
    """
    data = path.read_bytes()
    if data.startswith(b"glTF"):
        # The header and the length and type of the first chunk, which is the text.
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    needed = _GLTF_COMPRESSION.intersection(json.loads(data).get("extensionsRequired", []))
    if needed:
        raise ValueError(f"its meshes are compressed with {min(needed)}; save it without")


def _joined(path: Path, model: Model, up_axis: str) -> trimesh.Trimesh:
    """Make one mesh of the parts of a model, in metres."""
    if not sum(len(part.faces) for part in model.parts):
        raise SceneError(f"{path}: the mesh has no triangles")
    offsets = np.cumsum([0, *(len(part.vertices) for part in model.parts)])
    faces = np.concatenate([part.faces + offset for part, offset in zip(model.parts, offsets, strict=False)])
    vertices = np.concatenate([part.vertices for part in model.parts])
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SceneError(f"{path}: the mesh has faces with vertices that do not exist")
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    faces = (np.cumsum(used) - 1)[faces]
    with np.errstate(over="ignore"):
        vertices = vertices[used] * model.unit
        extent = np.ptp(vertices, axis=0).max()
    if not np.isfinite(extent):
        raise SceneError(f"{path}: the mesh has coordinates that are not finite numbers")
    if not extent > 0:
        raise SceneError(f"{path}: the mesh has no size; all its vertices coincide")
    if turn := _TURNS.get((model.up_axis, up_axis)):
        vertices = vertices @ np.array(turn, float).T
    # Formats that repeat the vertices of every triangle would never be watertight otherwise. They repeat them exactly.
    vertices, number = np.unique(vertices, axis=0, return_inverse=True)
    return trimesh.Trimesh(vertices, number.reshape(-1)[faces], process=False)


def _read_dae(path: Path) -> Model:
    """Read the polygons of a COLLADA file, placed by its scene."""
    import collada

    ignored = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    document = collada.Collada(str(path), ignore=ignored)
    if document.scene is None:
        raise SceneError(f"{path}: the mesh has no triangles; the file has no scene")
    parts = []
    for geometry in document.scene.objects("geometry"):
        for primitive in geometry.original.primitives:
            if isinstance(primitive, collada.polylist.Polylist):
                counts = primitive.vcounts
            elif isinstance(primitive, collada.triangleset.TriangleSet):
                counts = np.full(len(primitive), 3)
            else:
                continue
            if len(counts):
                vertices = np.asarray(primitive.vertex, float)
                part = from_polygons(vertices, counts, np.asarray(primitive.vertex_index).ravel())
                parts.append(placed(part, np.asarray(geometry.matrix, float)))
    unit = document.assetInfo.unitmeter
    return Model(parts, 1.0 if unit is None else unit, document.assetInfo.upaxis[0])
