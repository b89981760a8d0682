"""Read a model file: all its objects, placed, as triangles to voxelise and as polygons to draw.

What a file or its format says about its unit and its up axis is applied: USD and COLLADA files say both, 3MF files say
their unit and have Z up, glTF is in metres with Y up. OBJ, STL, PLY and OFF say neither and are taken as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import util
from pathlib import Path

import numpy as np
import trimesh

from .errors import SceneError, listed
from .looks import Look
from .polygons import MeshPrim, Model, Part, from_polygons, joined, placed, triangulate
from .readers.gltffile import read_gltf
from .readers.polygonfiles import read_obj, read_off, read_ply
from .scene import USD_EXTENSIONS

# What can be read with nothing else installed, and what each other format needs besides.
EXTENSIONS = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf", *USD_EXTENSIONS)
EXTRA_EXTENSIONS = {".3mf": ("lxml", "networkx"), ".dae": ("collada",)}

# So many names of parts are listed where there are more.
_NAMED = 20
_READERS = {".obj": read_obj, ".ply": read_ply, ".off": read_off, ".glb": read_gltf, ".gltf": read_gltf}
_METERS_PER_3MF_UNIT = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}
# Rotations that turn one axis, pointing up, into another. What is to the right with X up is at -Y.
_TURNS = {
    ("X", "Y"): [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    ("X", "Z"): [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
    ("Y", "Z"): [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    ("Z", "Y"): [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}


@dataclass(frozen=True)
class LoadedModel:
    """A model in metres, upright: what is voxelised and what is drawn, from the same numbers."""

    path: Path
    """The file."""
    mesh: trimesh.Trimesh
    """All its triangles, with vertices that are equal made one."""
    mesh_polygons: np.ndarray
    """Polygon of the drawing that each triangle of the mesh is cut from, int64 [triangle_count]."""
    drawing: Part
    """All its polygons as the file has them."""
    looks: list[Look]
    """What the polygons look like, by the number that each has in the drawing."""
    prims: list[MeshPrim]
    """Of a USD file, the meshes that it is made from, in the same frame and unit."""

    def scaled(self, factor: float) -> LoadedModel:
        """Return the model made larger by a factor, from the origin."""
        mesh, drawing = self.mesh.copy(), replace(self.drawing, vertices=self.drawing.vertices * factor)
        mesh.vertices *= factor
        prims = [_cage_with(prim, prim.cage.vertices * factor) for prim in self.prims]
        return replace(self, mesh=mesh, drawing=drawing, prims=prims)

    def part(self, name: str) -> trimesh.Trimesh:
        """Return the mesh of the triangles of ``region`` alone."""
        return trimesh.Trimesh(self.mesh.vertices, self.mesh.faces[self.region(name)], process=False)

    def region(self, name: str) -> np.ndarray:
        """Return the triangles of the mesh that belong to an object, group, node, prim or material, int64 [count].

        Raises:
            SceneError: no triangle belongs to what is called so.
        """
        groups = [group for group, names in enumerate(self.drawing.names) if name in names]
        triangles = np.flatnonzero(np.isin(self.drawing.groups[self.mesh_polygons], groups))
        if not len(triangles):
            present = np.unique(self.drawing.groups).tolist()
            known = list(dict.fromkeys(known for group in present for known in self.drawing.names[group]))
            named = f"there are {listed(known, _NAMED)}" if known else "none of its parts has a name"
            raise SceneError(f"{self.path}: no part of the model is called '{name}'; {named}")
        return triangles


def load_mesh(path: Path, *, up_axis: str = "Y", prim: str | None = None) -> trimesh.Trimesh:
    """Read all triangles of a model file as one mesh: what ``load_model`` gives, without what it is drawn with."""
    return load_model(path, up_axis=up_axis, prim=prim).mesh


def load_model(path: Path, *, up_axis: str = "Y", prim: str | None = None, time: float | None = None) -> LoadedModel:
    """Read a model file: all its objects, placed, in metres where the file says its unit.

    Args:
        path: the file; its extension tells its format.
        up_axis: Y or Z; models that say which axis points up are turned so that this one does.
        prim: path of the prim below which the meshes of a USD file are read; its default prim if None.
        time: time code at which a USD file is read; at rest if None.

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
            model = _read(path, kind, prim, time)
    except OSError as error:
        raise SceneError(f"{path}: cannot read the mesh: {error.strerror or error}") from error
    except SceneError:
        raise
    # The readers raise whatever their parsing happens to trip over; all of it means that the file is broken.
    except Exception as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{path}: not a sound {path.suffix} file: {why}") from error
    with np.errstate(over="ignore", invalid="ignore"):
        return _loaded(path, model, up_axis)


def _read(path: Path, kind: str, prim: str | None, time: float | None) -> Model:
    # These take long to import, and COLLADA's reader may not be installed.
    if kind in USD_EXTENSIONS:
        from .readers.usdmodel import read_usd

        return read_usd(path, prim, time=time)
    if kind == ".dae":
        from .readers.daefile import read_dae

        return read_dae(path)
    return _READERS.get(kind, _read_triangles)(path)


def _read_triangles(path: Path) -> Model:
    """Read an STL or a 3MF file, which have triangles without UVs and materials."""
    # Meshes are placed by the nodes of a scene, some of them more than once.
    scene = trimesh.load_scene(path, process=False)
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            faces = np.asarray(mesh.faces)
            part = from_polygons(mesh.vertices, np.full(len(faces), 3), faces.ravel(), names=[(node, name)])
            parts.append(placed(part, matrix))
    if path.suffix.lower() != ".3mf":
        # Of what it cannot make out the reader says nothing.
        if not any(len(part.counts) for part in parts):
            raise ValueError("no triangles can be read from it; it may be cut off, or of another format")
        return Model(parts)
    # The reader says "millimeters" where the file says nothing.
    unit = str(scene.metadata["units"]).replace("millimeters", "millimeter")
    return Model(parts, [], _METERS_PER_3MF_UNIT[unit], "Z")


def _loaded(path: Path, model: Model, up_axis: str) -> LoadedModel:
    """Make one drawing and one mesh of the parts of a model, in metres."""
    if not any((part.counts >= 3).any() for part in model.parts):
        raise SceneError(f"{path}: the mesh has no triangles")
    drawing = joined(model.parts)
    vertices = drawing.vertices * model.unit
    extent = np.ptp(vertices, axis=0).max()
    if not np.isfinite(extent):
        raise SceneError(f"{path}: the mesh has coordinates that are not finite numbers")
    if not extent > 0:
        raise SceneError(f"{path}: the mesh has no size; all its vertices coincide")
    normals = drawing.normals
    prims = [_cage_with(prim, prim.cage.vertices * model.unit) for prim in model.prims]
    if rows := _TURNS.get((model.up_axis, up_axis)):
        turn = np.array(rows, float).T
        vertices = vertices @ turn
        normals = None if normals is None else normals @ turn
        prims = [_cage_with(prim, prim.cage.vertices @ turn) for prim in prims]
    used = np.unique(drawing.looks[drawing.looks >= 0])
    # The last one, which -1 means, stays -1.
    look_numbers = np.full(len(model.looks) + 1, -1)
    look_numbers[used] = np.arange(len(used))
    drawing = replace(drawing, vertices=vertices, normals=normals, looks=look_numbers[drawing.looks])
    triangles, polygons = triangulate(vertices, drawing.counts, drawing.corners)
    # Formats that repeat the vertices of every triangle would never be watertight otherwise. They repeat them exactly.
    vertices, number = np.unique(vertices, axis=0, return_inverse=True)
    mesh = trimesh.Trimesh(vertices, number.reshape(-1)[triangles], process=False)
    return LoadedModel(path, mesh, polygons, drawing, [model.looks[number] for number in used], prims)


def _cage_with(prim: MeshPrim, vertices: np.ndarray) -> MeshPrim:
    """Return a mesh with its vertices, [vertex_count, 3], elsewhere."""
    return replace(prim, cage=replace(prim.cage, vertices=vertices))
