"""Read the meshes and materials of a glTF or GLB file, placed by the nodes of its scene.

Libraries for meshes drop some of what models are drawn with: UVs without a material, wrap modes, images as they are
stored, or normalised and sparse values. The format is plain JSON with arrays beside it, so it is read here.
"""

from __future__ import annotations

import base64
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from trimesh.transformations import quaternion_matrix

from ..looks import Images, Look, Placing, Texture, Value
from ..polygons import Model, Part, from_polygons, placed

log = logging.getLogger("warpjelly")

# Extensions without which the coordinates of a mesh are missing.
_COMPRESSIONS = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"}
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_WRAPS = {33071: "clamp", 33648: "mirror"}
_SUFFIXES = {"image/png": ".png", "image/jpeg": ".jpg"}
_SRGB = {"baseColorTexture", "emissiveTexture"}


@dataclass(frozen=True)
class _File:
    """A glTF file."""

    path: Path
    header: dict[str, Any]
    """Its JSON."""
    buffers: list[bytes]
    """What its arrays are in."""
    images: Sequence[tuple[str, bytes] | None] = ()
    """Name and content of its images; None where one cannot be read."""

    def all(self, kind: str) -> list[dict[str, Any]]:
        """Return all buffers, nodes, meshes, ... of the file."""
        return self.header.get(kind, [])


def read_gltf(path: Path) -> Model:
    """Read all triangles of the default scene of a glTF or GLB file.

    Raises:
        ValueError: its meshes are compressed, or it is no glTF file.
    """
    header, body = _header(path)
    needed = _COMPRESSIONS.intersection(header.get("extensionsRequired", []))
    if needed:
        raise ValueError(f"its meshes are compressed with {min(needed)}; save it without")
    uris = [buffer.get("uri") for buffer in header.get("buffers", [])]
    file = _File(path, header, [body if uri is None else _content(path, uri) for uri in uris])
    file = replace(file, images=[_image(file, image, number) for number, image in enumerate(file.all("images"))])
    parts = [
        placed(part, matrix)
        for mesh, matrix, names in _placements(file)
        for primitive in mesh["primitives"]
        if (part := _part(file, primitive, (*names, *_names(mesh))))
    ]
    looks = [_look(file, material, number) for number, material in enumerate(file.all("materials"))]
    return Model(parts, looks, up_axis="Y")


def gltf_addresses(path: Path) -> list[str]:
    """Return the paths of all files that a glTF or GLB file names."""
    header, _ = _header(path)
    uris = [item.get("uri", "data:") for kind in ("buffers", "images") for item in header.get(kind, [])]
    return [unquote(uri) for uri in uris if not uri.startswith("data:")]


def _header(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON of a file and the bytes behind it.

    Raises:
        ValueError: the file is cut off.
    """
    data = path.read_bytes()
    if not data.startswith(b"glTF"):
        return json.loads(data), b""
    length = int.from_bytes(data[8:12], "little")
    if len(data) < max(length, 20):
        raise ValueError(f"it is cut off: {len(data):,} of {max(length, 20):,} bytes")
    # A header, a chunk of text and one of bytes; each chunk starts with its length and type.
    end = 20 + int.from_bytes(data[12:16], "little")
    return json.loads(data[20:end]), data[end + 8 :]


def _content(path: Path, uri: str) -> bytes:
    """Return what is at an address: in it, or in a file beside the model."""
    if uri.startswith("data:"):
        return base64.b64decode(uri.split(",", 1)[1])
    try:
        return (path.parent / unquote(uri)).read_bytes()
    except OSError as error:
        raise ValueError(f"{uri} cannot be read: {error.strerror}") from error


def _names(item: dict[str, Any]) -> tuple[str, ...]:
    return (str(item["name"]),) if "name" in item else ()


def _placements(file: _File) -> Iterator[tuple[dict[str, Any], np.ndarray, tuple[str, ...]]]:
    """Yield each mesh of the scene with its matrix for column vectors, [4, 4], and the names of all nodes above it."""
    nodes, scenes = file.all("nodes"), file.all("scenes")
    below = {child for node in nodes for child in node.get("children", [])}
    roots = [number for number in range(len(nodes)) if number not in below]
    if scenes:
        roots = scenes[file.header.get("scene", 0)].get("nodes", [])

    def visit(number: int, matrix: np.ndarray, names: tuple[str, ...]) -> Iterator:
        node = nodes[number]
        matrix, names = matrix @ _matrix(node), (*names, *_names(node))
        if "mesh" in node:
            yield file.all("meshes")[node["mesh"]], matrix, names
        for child in node.get("children", []):
            yield from visit(child, matrix, names)

    for root in roots:
        yield from visit(root, np.eye(4), ())


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = quaternion_matrix([w, x, y, z])
    matrix[:3, :3] *= node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _part(file: _File, primitive: dict[str, Any], names: tuple[str, ...]) -> Part | None:
    """Return the triangles of a primitive; None if it has points or lines."""
    attributes = primitive["attributes"]
    vertices = _values(file, attributes["POSITION"])
    order = np.arange(len(vertices))
    if "indices" in primitive:
        order = _values(file, primitive["indices"]).ravel().astype(np.int64)
    first = np.arange(max(len(order) - 2, 0))
    match primitive.get("mode", 4):
        case 4:  # triangles
            corners = order[: len(order) // 3 * 3]
        case 5:  # a strip, of which every second triangle would turn the other way
            odd = first % 2
            corners = order[np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)].ravel()
        case 6:  # a fan
            corners = order[np.stack([first + 1, first + 2, 0 * first], axis=1)].ravel()
        case _:
            return None
    material = primitive.get("material", -1)
    if material >= 0:
        names = (*names, *_names(file.all("materials")[material]))
    part = from_polygons(vertices, np.full(len(corners) // 3, 3), corners, looks=material, names=[names])
    uvs = normals = None
    if (uv_name := f"TEXCOORD_{_uv_set(file, material)}") in attributes:
        # Their v points down in the image.
        uvs = (_values(file, attributes[uv_name]) * (1, -1) + (0, 1))[part.corners]
    if "NORMAL" in attributes:
        normals = _values(file, attributes["NORMAL"])[part.corners]
    return replace(part, uvs=uvs, normals=normals)


def _values(file: _File, number: int) -> np.ndarray:
    """Return the values of an accessor, float64 [count, width]."""
    accessor = file.all("accessors")[number]
    count, width, kind = accessor["count"], _WIDTHS[accessor["type"]], accessor["componentType"]
    values = np.zeros((count, width))
    if "bufferView" in accessor:
        values[:] = _elements(file, accessor, count, width, kind)
    if sparse := accessor.get("sparse"):
        changed, others = sparse["indices"], sparse["values"]
        rows = _elements(file, changed, sparse["count"], 1, changed["componentType"]).ravel()
        values[rows] = _elements(file, others, sparse["count"], width, kind)
    if accessor.get("normalized"):
        values = np.maximum(values / np.iinfo(_DTYPES[kind]).max, -1.0)
    return values


def _elements(file: _File, place: dict[str, Any], count: int, width: int, kind: int) -> np.ndarray:
    """Return what is at a place of a view, [count, width]."""
    view, dtype = file.all("bufferViews")[place["bufferView"]], np.dtype(_DTYPES[kind])
    start = view.get("byteOffset", 0) + place.get("byteOffset", 0)
    stride = view.get("byteStride", width * dtype.itemsize)
    return np.ndarray((count, width), dtype, file.buffers[view["buffer"]], start, (stride, dtype.itemsize))


def _maps(material: dict[str, Any]) -> dict[str, Any]:
    """Return all that a material has, in one table."""
    return {**material.get("pbrMetallicRoughness", {}), **material}


def _uv_set(file: _File, material: int) -> int:
    """Return which of the sets of UVs a material uses: that of its color, or else of its first texture."""
    maps = _maps(file.all("materials")[material]) if material >= 0 else {}
    uses = [maps[kind] for kind in ("baseColorTexture", *maps) if kind in maps and kind.endswith("Texture")]
    return uses[0].get("texCoord", 0) if uses else 0


def _look(file: _File, material: dict[str, Any], number: int) -> Look:
    name, maps = material.get("name", f"material_{number}"), _maps(material)
    textures = {
        kind: texture
        for kind, use in maps.items()
        if kind.endswith("Texture") and (texture := _texture(file, name, kind, use, _uv_set(file, number)))
    }
    return Look(name, {**_base(maps, textures), **_surface(maps, textures), **_light(maps, textures)})


def _base(maps: dict[str, Any], textures: dict[str, Texture]) -> dict[str, Value]:
    """Return color and opacity, which is 1 unless the material says that its alpha counts."""
    factor, mode = tuple(maps.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))), maps.get("alphaMode", "OPAQUE")
    inputs: dict[str, Value] = {"diffuseColor": factor[:3], "opacity": factor[3]}
    if color := textures.get("baseColorTexture"):
        color = replace(color, scale=factor)
        inputs = {"diffuseColor": color, "opacity": color.of("a")}
    if mode == "MASK":
        inputs["opacityThreshold"] = maps.get("alphaCutoff", 0.5)
    return {"diffuseColor": inputs["diffuseColor"]} if mode == "OPAQUE" else inputs


def _surface(maps: dict[str, Any], textures: dict[str, Texture]) -> dict[str, Value]:
    """Return roughness, metallic and normal."""
    metallic, roughness = maps.get("metallicFactor", 1.0), maps.get("roughnessFactor", 1.0)
    inputs: dict[str, Value] = {"roughness": roughness, "metallic": metallic}
    if both := textures.get("metallicRoughnessTexture"):
        both = replace(both, scale=(1.0, roughness, metallic, 1.0))
        inputs = {"roughness": both.of("g"), "metallic": both.of("b")}
    if bumps := textures.get("normalTexture"):
        across = maps["normalTexture"].get("scale", 1.0)
        scale, bias = (2.0 * across, 2.0 * across, 2.0, 1.0), (-across, -across, -1.0, 0.0)
        inputs["normal"] = replace(bumps, scale=scale, bias=bias)
    return inputs


def _light(maps: dict[str, Any], textures: dict[str, Texture]) -> dict[str, Value]:
    """Return what shines, and what little light from around reaches."""
    inputs: dict[str, Value] = {}
    strength = maps.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    red, green, blue = (strength * part for part in maps.get("emissiveFactor", (0.0, 0.0, 0.0)))
    if red or green or blue:
        glow = textures.get("emissiveTexture")
        inputs["emissiveColor"] = replace(glow, scale=(red, green, blue, 1.0)) if glow else (red, green, blue)
    if shade := textures.get("occlusionTexture"):
        share = maps["occlusionTexture"].get("strength", 1.0)
        inputs["occlusion"] = replace(shade.of("r"), scale=(share,) * 4, bias=(1.0 - share,) * 4)
    return inputs


def _texture(file: _File, material: str, kind: str, use: dict[str, Any], uv_set: int) -> Texture | None:
    """Return the texture that a material uses as one kind; None, after a warning, if there is none to be had."""
    if use.get("texCoord", 0) != uv_set:
        log.warning("%s: material %s: its %s is left out, because it has other UVs", file.path, material, kind)
        return None
    texture = file.all("textures")[use["index"]]
    source = texture.get("source", -1)
    found = file.images[source] if source >= 0 else None
    if found is None:
        log.warning("%s: material %s has no %s", file.path, material, kind)
        return None
    sampler = file.all("samplers")[texture["sampler"]] if "sampler" in texture else {}
    along_u, along_v = (_WRAPS.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT"))
    placing = _placing(use.get("extensions", {}).get("KHR_texture_transform", {}))
    return Texture(found[0], found[1], srgb=kind in _SRGB, wrap=(along_u, along_v), placing=placing)


def _placing(transform: dict[str, Any]) -> Placing:
    """Return the transform of a texture for a v that points up instead of down."""
    turn, (x, y) = transform.get("rotation", 0.0), transform.get("offset", (0.0, 0.0))
    along_u, along_v = transform.get("scale", (1.0, 1.0))
    return Placing(
        -math.degrees(turn),
        (along_u, along_v),
        (x - math.sin(turn) * along_v, 1.0 - y - math.cos(turn) * along_v),
    )


def _image(file: _File, image: dict[str, Any], number: int) -> tuple[str, bytes] | None:
    """Return the name and the content of an image file."""
    name = image.get("name") or f"image_{number}"
    suffix = _SUFFIXES.get(image.get("mimeType", ""), "")
    if "bufferView" in image:
        view = file.all("bufferViews")[image["bufferView"]]
        start = view.get("byteOffset", 0)
        return name.removesuffix(suffix) + suffix, file.buffers[view["buffer"]][start : start + view["byteLength"]]
    uri = image.get("uri", "")
    if uri.startswith("data:"):
        suffix = _SUFFIXES.get(uri[5:].split(";")[0].split(",")[0], "")
        return name.removesuffix(suffix) + suffix, _content(file.path, uri)
    return Images(file.path).read(unquote(uri))
