"""Read the meshes and materials of a COLLADA file, placed by its scene."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import unquote

import collada
import numpy as np
from collada.material import OPAQUE_MODE, Effect, Map, Material
from collada.scene import Node, SceneNode

from ..errors import SceneError
from ..looks import Images, Look, Texture, Value, shininess_roughness
from ..polygons import Model, Part, from_polygons, placed


def read_dae(path: Path) -> Model:
    """Read all polygons of the scene of a COLLADA file.

    Raises:
        SceneError: it has no scene.
    """
    ignored = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    document = collada.Collada(str(path), ignore=ignored)
    if document.scene is None:
        raise SceneError(f"{path}: the mesh has no triangles; the file has no scene")
    looks: dict[str, Look] = {}
    images = Images(path)
    parts = [
        part
        for geometry, names in _placements(document.scene.nodes, np.eye(4), ())
        for primitive in geometry.original.primitives
        if (part := _part(geometry, primitive, names, looks, images))
    ]
    unit = document.assetInfo.unitmeter
    return Model(parts, list(looks.values()), 1.0 if unit is None else unit, document.assetInfo.upaxis[0])


def _placements(
    nodes: Iterable[SceneNode], matrix: np.ndarray, names: tuple[str, ...]
) -> Iterator[tuple[collada.geometry.BoundGeometry, tuple[str, ...]]]:
    """Yield each placed geometry with the names and ids of the nodes above it and of itself."""
    for node in nodes:
        if isinstance(node, Node):
            yield from _placements(node.children, matrix @ node.matrix, (*names, *_names(node)))
        else:
            for geometry in node.objects("geometry", matrix):
                yield geometry, (*names, *_names(geometry.original))


def _names(item: Node | collada.geometry.Geometry | Material) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for name in (item.name, item.id) if name))


def _part(
    geometry: collada.geometry.BoundGeometry,
    primitive: collada.primitive.Primitive,
    names: tuple[str, ...],
    looks: dict[str, Look],
    images: Images,
) -> Part | None:
    """Return the polygons of a primitive, and add its look to the others; None if it has points or lines."""
    if isinstance(primitive, collada.polylist.Polylist):
        counts = primitive.vcounts
    elif isinstance(primitive, collada.triangleset.TriangleSet):
        counts = np.full(len(primitive), 3)
    else:
        return None
    if not len(counts):
        return None
    number = -1
    if node := geometry.materialnodebysymbol.get(primitive.material):
        material = node.target
        if material.id not in looks:
            looks[material.id] = Look(material.name or material.id, _inputs(material.effect, images))
        number = list(looks).index(material.id)
        names = (*names, *_names(material))
    uvs = normals = None
    if primitive.texcoordset:
        uvs = primitive.texcoordset[0][primitive.texcoord_indexset[0].ravel(), :2]
    if primitive.normal is not None:
        normals = primitive.normal[primitive.normal_index.ravel()]
    corners = np.asarray(primitive.vertex_index).ravel()
    part = from_polygons(primitive.vertex, counts, corners, uvs=uvs, normals=normals, looks=number, names=[names])
    return placed(part, np.asarray(geometry.matrix, float))


def _inputs(effect: Effect, images: Images) -> dict[str, Value]:
    inputs: dict[str, Value] = {}
    for name, value in (("diffuseColor", effect.diffuse), ("emissiveColor", effect.emission)):
        if isinstance(value, Map):
            if texture := _texture(images, value):
                inputs[name] = texture
        elif value is not None:
            inputs[name] = tuple(value[:3])
    if effect.shadingtype in ("phong", "blinn") and isinstance(effect.shininess, float):
        inputs["roughness"] = shininess_roughness(effect.shininess)
    clear, share = effect.transparent, effect.transparency
    if isinstance(clear, Map) and effect.opaque_mode == OPAQUE_MODE.A_ONE:
        if texture := _texture(images, clear):
            inputs["opacity"] = texture.of("a")
    elif isinstance(clear, tuple) and isinstance(share, float):
        inputs["opacity"] = (
            clear[3] * share if effect.opaque_mode == OPAQUE_MODE.A_ONE else 1.0 - share * sum(clear[:3]) / 3.0
        )
    return inputs


def _texture(images: Images, use: Map) -> Texture | None:
    image = images.read(unquote(use.sampler.surface.image.path.removeprefix("file://")))
    return Texture(*image, srgb=True) if image else None
