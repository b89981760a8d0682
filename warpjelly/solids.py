"""The shapes of a stage at one frame as VTK draws them: meshes, balls and tubes, in their materials."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from .colors import srgb_from_linear
from .looks import Texture
from .usdlooks import read_look

if TYPE_CHECKING:
    import pyvista as pv

# Linear grey of what has no colour.
_GREY = (0.4, 0.4, 0.4)


@dataclass(frozen=True)
class Solid:
    """What is drawn in one way."""

    surface: pv.PolyData
    """Places of the stage; without a texture, with the sRGB colour of each point as ``color``."""
    texture: pv.Texture | None = None
    """An image at its texture coordinates."""
    shows_force: bool = False
    """Whether its colours show forces."""


@dataclass(frozen=True)
class Drawn:
    """What is drawn of a stage."""

    solids: list[Solid] = field(default_factory=list)
    floors: list[pv.PolyData] = field(default_factory=list)
    """Single rectangles."""
    rooms: list[pv.PolyData] = field(default_factory=list)
    """Lines around what is inside."""


def shapes_in(stage: Usd.Stage, schema: Any) -> Iterator[Any]:
    """Yield the prims of a type."""
    return (schema(prim) for prim in stage.Traverse() if prim.IsA(schema))


def draw_stage(pyvista: Any, stage: Usd.Stage, frame: int) -> Drawn:
    """Return what is to be seen of a stage at a frame."""
    transforms = UsdGeom.XformCache(frame)
    drawn = Drawn()

    def placed(shape: Any, surface: pv.PolyData) -> pv.PolyData:
        return surface.transform(np.array(transforms.GetLocalToWorldTransform(shape.GetPrim())).T, inplace=False)

    for mesh in shapes_in(stage, UsdGeom.Mesh):
        for solid in _mesh_solids(pyvista, mesh, frame):
            surface = placed(mesh, solid.surface)
            if surface.n_cells == 1:
                drawn.floors.append(surface)
            else:
                drawn.solids.append(replace(solid, surface=surface))
    for sphere in shapes_in(stage, UsdGeom.Sphere):
        ball = pyvista.Sphere(radius=sphere.GetRadiusAttr().Get(frame), theta_resolution=96, phi_resolution=96)
        ball["color"] = _colors(sphere, frame, ball.n_points)
        drawn.solids.append(Solid(placed(sphere, ball)))
    for curves in shapes_in(stage, UsdGeom.BasisCurves):
        points = np.array(curves.GetPointsAttr().Get(frame)).reshape(-1, 3)
        lines = placed(curves, pyvista.line_segments_from_points(points))
        interpolation = curves.GetDisplayColorPrimvar().GetInterpolation()
        if interpolation == UsdGeom.Tokens.constant:
            drawn.rooms.append(lines)
            continue
        lines["color"] = _colors(curves, frame, len(points))
        tubes = lines.tube(radius=curves.GetWidthsAttr().Get(frame)[0] / 2, n_sides=12, capping=True)
        drawn.solids.append(Solid(tubes, shows_force=interpolation == UsdGeom.Tokens.vertex))
    for balls in shapes_in(stage, UsdGeom.Points):
        drawn.solids.append(Solid(placed(balls, _balls(pyvista, balls, frame)), shows_force=True))
    return drawn


def _balls(pyvista: Any, shape: UsdGeom.Points, frame: int) -> pv.PolyData:
    points = np.array(shape.GetPointsAttr().Get(frame)).reshape(-1, 3)
    cloud = pyvista.PolyData(points)
    cloud["color"] = _colors(shape, frame, len(points))
    ball = pyvista.Icosphere(radius=shape.GetWidthsAttr().Get(frame)[0] / 2, nsub=2)
    return cloud.glyph(geom=ball, scale=False, orient=False)


def _colors(shape: UsdGeom.Gprim, frame: int, count: int) -> np.ndarray:
    """Return the colour of every point, sRGB, uint8 [count, 3]; grey where the stage has none by point."""
    linear = UsdGeom.Primvar(shape.GetDisplayColorAttr()).ComputeFlattened(frame)
    colors = np.array([_GREY] if linear is None or not len(linear) else linear)
    if shape.GetPrim().IsA(UsdGeom.BasisCurves) and 2 * len(colors) == count:
        # A colour for each straight line, from one point to the next.
        colors = np.repeat(colors, 2, axis=0)
    return _bytes(colors if len(colors) in (1, count) else [_GREY], count)


def _bytes(linear: Any, count: int) -> np.ndarray:
    """Return colours as sRGB, uint8 [count, 3]; one stands for all."""
    colors = np.rint(srgb_from_linear(np.asarray(linear)) * 255).astype(np.uint8)
    return np.broadcast_to(colors, (count, 3)).copy()


def _mesh_solids(pyvista: Any, mesh: UsdGeom.Mesh, frame: int) -> Iterator[Solid]:
    """Yield the parts of a mesh that have different materials."""
    points = np.array(mesh.GetPointsAttr().Get(frame)).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(frame))
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(frame))
    subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    if not subsets:
        normals = mesh.GetNormalsAttr().Get(frame)
        by_corner = _by_corner(mesh, "normals", frame)
        if by_corner is None:
            surface = _polygons(pyvista, points, counts, corners)
            if normals is not None and len(normals) == len(points):
                surface.point_data.active_normals = np.array(normals)
            surface["color"] = _colors(mesh, frame, len(points))
            by_point = mesh.GetDisplayColorPrimvar().GetInterpolation() == UsdGeom.Tokens.vertex
            yield Solid(surface, shows_force=by_point)
            return
    # VTK has normals and texture coordinates for points alone, so every corner becomes one.
    own = np.full(len(counts), len(subsets))
    for number, subset in enumerate(subsets):
        own[np.array(subset.GetIndicesAttr().Get(), int)] = number
    colors, uvs = _colors(mesh, frame, len(points)), _by_corner(mesh, "st", frame)
    normals = _by_corner(mesh, "normals", frame)
    for number in np.unique(own).tolist():
        at = np.repeat(own == number, counts)
        surface = _polygons(pyvista, points[corners[at]], counts[own == number], np.arange(np.count_nonzero(at)))
        if normals is not None:
            surface.point_data.active_normals = normals[at]
        value = _diffuse(subsets[number].GetPrim()) if number < len(subsets) else None
        if isinstance(value, Texture) and uvs is not None:
            surface.active_texture_coordinates = _placed_uvs(value, uvs[at])
            yield Solid(surface, texture=_image(pyvista, value))
            continue
        shown = (
            colors[corners[at]] if value is None else _bytes(_GREY if isinstance(value, Texture) else value, at.sum())
        )
        surface["color"] = shown
        yield Solid(surface, shows_force=value is None)


def _polygons(pyvista: Any, points: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> pv.PolyData:
    # VTK wants each face's number of corners in front of them.
    return pyvista.PolyData(points, faces=np.insert(corners, np.cumsum(counts) - counts, counts))


def _by_corner(mesh: UsdGeom.Mesh, name: str, frame: int) -> np.ndarray | None:
    """Return what a primvar has at each corner, None if it has no such."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(name)
    if not primvar or primvar.GetInterpolation() != UsdGeom.Tokens.faceVarying:
        return None
    return np.array(primvar.ComputeFlattened(frame))


def _diffuse(prim: Usd.Prim) -> Any:
    """Return the diffuse colour of a prim's material: linear, or a texture; None where it has no look of its own."""
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    look = read_look(Path(prim.GetStage().GetRootLayer().realPath), material, {}) if material else None
    # What a UsdPreviewSurface is unless told otherwise.
    return None if look is None else look.inputs.get("diffuseColor", (0.18, 0.18, 0.18))


def _placed_uvs(texture: Texture, uvs: np.ndarray) -> np.ndarray:
    """Scale, turn and move UVs [count, 2] as the texture says."""
    placing = texture.placing
    angle = np.radians(placing.rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return ((uvs * placing.scale) @ turn.T + placing.translation).astype(np.float32)


def _image(pyvista: Any, texture: Texture) -> pv.Texture:
    from PIL import Image

    with Image.open(BytesIO(texture.data)) as picture:
        pixels = np.asarray(picture.convert("RGB")) / 255.0
    if not texture.srgb:
        pixels = srgb_from_linear(pixels)
    scaled = np.clip(pixels * texture.scale[:3] + texture.bias[:3], 0.0, 1.0)
    # A picture starts at its upper left, a texture at its lower left.
    image = pyvista.numpy_to_texture(np.ascontiguousarray(np.rint(scaled * 255).astype(np.uint8)[::-1]))
    image.repeat = texture.wrap[0] == "repeat"
    image.mipmap = image.interpolate = True
    return image
