"""The shapes of a stage at one frame as VTK draws them: meshes, balls and tubes, in their materials."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from ..colors import srgb_from_linear
from ..errors import InputError
from ..looks import Texture
from ..stage.usdlooks import read_look

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


def the_camera(stage: Usd.Stage) -> UsdGeom.Camera:
    """Return a stage's first camera."""
    camera = next(shapes_in(stage, UsdGeom.Camera), None)
    if camera is None:
        raise InputError("the stage has no camera")
    return camera


def room_floor(stage: Usd.Stage, points: np.ndarray) -> np.ndarray:
    """Return the corners [4, 3] of the rectangle at the bottom of a room, given points [n, 3] of its edges, m."""
    up = 2 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else 1
    low, high = points.min(axis=0), points.max(axis=0)
    side, other = np.eye(3)[(up + 1) % 3] * (high - low), np.eye(3)[(up + 2) % 3] * (high - low)
    return np.array([low, low + side, low + side + other, low + other])


class StageDrawing:
    """Draws the frames of a stage; materials are read once."""

    def __init__(self, pyvista: Any, stage: Usd.Stage) -> None:
        self._pyvista, self._stage = pyvista, stage
        self._looks: dict[Sdf.Path, tuple[Any, pv.Texture | None]] = {}
        self._images: dict[str, bytes] = {}

    def at(self, frame: int) -> Drawn:
        """Return what is to be seen at a frame; the shapes are as many, and in the same order, at each."""
        transforms = UsdGeom.XformCache(frame)
        drawn = Drawn()

        def placed(shape: Any, surface: pv.PolyData) -> pv.PolyData:
            matrix = np.array(transforms.GetLocalToWorldTransform(shape.GetPrim())).T
            return surface if (matrix == np.eye(4)).all() else surface.transform(matrix, inplace=False)

        for mesh in shapes_in(self._stage, UsdGeom.Mesh):
            alone = len(mesh.GetFaceVertexCountsAttr().Get(frame)) == 1
            for solid in self._mesh_solids(mesh, frame):
                surface = placed(mesh, solid.surface)
                if alone:
                    drawn.floors.append(surface)
                else:
                    drawn.solids.append(replace(solid, surface=surface))
        for sphere in shapes_in(self._stage, UsdGeom.Sphere):
            radius = sphere.GetRadiusAttr().Get(frame)
            ball = self._pyvista.Sphere(radius=radius, theta_resolution=96, phi_resolution=96)
            _color(ball, colors_at(sphere, frame, ball.n_points))
            drawn.solids.append(Solid(placed(sphere, ball)))
        for curves in shapes_in(self._stage, UsdGeom.BasisCurves):
            points = np.array(curves.GetPointsAttr().Get(frame)).reshape(-1, 3)
            lines = placed(curves, self._pyvista.line_segments_from_points(points))
            interpolation = curves.GetDisplayColorPrimvar().GetInterpolation()
            if interpolation == UsdGeom.Tokens.constant:
                drawn.rooms.append(lines)
                continue
            lines["color"] = colors_at(curves, frame, len(points))
            tubes = lines.tube(radius=curves.GetWidthsAttr().Get(frame)[0] / 2, n_sides=12, capping=True)
            drawn.solids.append(Solid(tubes, shows_force=interpolation == UsdGeom.Tokens.vertex))
        for balls in shapes_in(self._stage, UsdGeom.Points):
            drawn.solids.append(Solid(placed(balls, _balls(self._pyvista, balls, frame)), shows_force=True))
        return drawn

    def _mesh_solids(self, mesh: UsdGeom.Mesh, frame: int) -> Iterator[Solid]:
        """Yield the parts of a mesh that have different materials."""
        points = np.array(mesh.GetPointsAttr().Get(frame)).reshape(-1, 3)
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(frame))
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(frame))
        subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
        looks = looks_of(mesh, subsets)
        if not looks:
            normals = mesh.GetNormalsAttr().Get(frame)
            by_corner = _by_corner(mesh, "normals", frame)
            if by_corner is None:
                by_point = normals if normals is not None and len(normals) == len(points) else None
                surface = _shaded(_polygons(self._pyvista, points, counts, corners), by_point)
                _color(surface, colors_at(mesh, frame, len(points)))
                yield Solid(surface, shows_force=bool(mesh.GetDisplayColorPrimvar().GetTimeSamples()))
                return
        # VTK has normals and texture coordinates for points alone, so every corner becomes one.
        own = subset_of_faces(subsets, len(counts))
        colors, uvs = colors_at(mesh, frame, len(points)), _by_corner(mesh, "st", frame)
        normals = _by_corner(mesh, "normals", frame)
        for number in np.unique(own).tolist():
            at = np.repeat(own == number, counts)
            value, image = self._look(looks[number]) if number < len(looks) else (None, None)
            chosen, own_corners = corners[at], np.arange(np.count_nonzero(at))
            if normals is None and not isinstance(value, Texture):
                chosen, own_corners = np.unique(chosen, return_inverse=True)
            surface = _polygons(self._pyvista, points[chosen], counts[own == number], own_corners)
            surface = _shaded(surface, None if normals is None else normals[at])
            if isinstance(value, Texture) and uvs is not None:
                surface.active_texture_coordinates = _placed_uvs(value, uvs[at])
                yield Solid(surface, texture=image)
                continue
            plain = _GREY if isinstance(value, Texture) else value
            _color(surface, colors[chosen] if value is None else _bytes(plain, len(chosen)))
            yield Solid(surface, shows_force=value is None and bool(mesh.GetDisplayColorPrimvar().GetTimeSamples()))

    def _look(self, prim: Usd.Prim) -> tuple[Any, pv.Texture | None]:
        """Return the diffuse colour of a prim, and its image if it is a texture."""
        path = prim.GetPath()
        if path not in self._looks:
            value = diffuse(prim, self._images)
            self._looks[path] = value, _image(self._pyvista, value) if isinstance(value, Texture) else None
        return self._looks[path]


def _balls(pyvista: Any, shape: UsdGeom.Points, frame: int) -> pv.PolyData:
    points = np.array(shape.GetPointsAttr().Get(frame)).reshape(-1, 3)
    cloud = pyvista.PolyData(points)
    cloud["color"] = colors_at(shape, frame, len(points))
    ball = pyvista.Icosphere(radius=shape.GetWidthsAttr().Get(frame)[0] / 2, nsub=2)
    return cloud.glyph(geom=ball, scale=False, orient=False)


def _color(surface: pv.PolyData, colors: np.ndarray) -> None:
    """Give a surface the sRGB colour of each point, uint8 [point_count, 3]."""
    surface.point_data.set_scalars(colors, "color")


def colors_at(shape: UsdGeom.Gprim, frame: int, count: int) -> np.ndarray:
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


def _polygons(pyvista: Any, points: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> pv.PolyData:
    # VTK wants each face's number of corners in front of them.
    return pyvista.PolyData(points, faces=np.insert(corners, np.cumsum(counts) - counts, counts))


def _shaded(surface: pv.PolyData, normals: Any) -> pv.PolyData:
    """Give a surface its normals at the points [point_count, 3]; without some, those of a smooth surface."""
    if normals is None:
        return surface.compute_normals(cell_normals=False, consistent_normals=False, auto_orient_normals=False)
    surface.point_data.active_normals = np.array(normals)
    return surface


def _by_corner(mesh: UsdGeom.Mesh, name: str, frame: int) -> np.ndarray | None:
    """Return what a primvar has at each corner, None if it has no such."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(name)
    if not primvar or primvar.GetInterpolation() != UsdGeom.Tokens.faceVarying:
        return None
    return np.array(primvar.ComputeFlattened(frame))


def subset_of_faces(subsets: Sequence[UsdGeom.Subset], face_count: int) -> np.ndarray:
    """Return which subset each face is in, int [face_count]; where it is in none, the number of subsets."""
    own = np.full(face_count, len(subsets))
    for number, subset in enumerate(subsets):
        own[np.array(subset.GetIndicesAttr().Get(), int)] = number
    return own


def looks_of(mesh: UsdGeom.Mesh, subsets: Sequence[UsdGeom.Subset]) -> list[Usd.Prim]:
    """Return what has the materials of a mesh: its subsets, and itself for all other faces if it has no colours."""
    own = [] if mesh.GetDisplayColorAttr().HasAuthoredValue() else [mesh.GetPrim()]
    return [*(subset.GetPrim() for subset in subsets), *own]


def diffuse(prim: Usd.Prim, images: dict[str, bytes]) -> Any:
    """Return the diffuse colour of a prim's material: linear, or a texture; None where it has no look of its own.

    Args:
        prim: what has the material.
        images: what was read of images so far, by path; what is read now is added.
    """
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    look = read_look(Path(prim.GetStage().GetRootLayer().realPath), material, images) if material else None
    # What a UsdPreviewSurface is unless told otherwise.
    return None if look is None else look.inputs.get("diffuseColor", (0.18, 0.18, 0.18))


def _placed_uvs(texture: Texture, uvs: np.ndarray) -> np.ndarray:
    """Scale, turn and move UVs [count, 2] as the texture says."""
    placing = texture.placing
    angle = np.radians(placing.rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return ((uvs * placing.scale) @ turn.T + placing.translation).astype(np.float32)


def texture_pixels(texture: Texture) -> np.ndarray:
    """Return the colours of a texture, sRGB, uint8 [height, width, 3], from its upper left on."""
    try:
        from PIL import Image
    except ImportError as error:
        raise InputError("textures need Pillow: pip install 'warpjelly[preview]'") from error
    try:
        with Image.open(BytesIO(texture.data)) as picture:
            pixels = np.asarray(picture.convert("RGB")) / 255.0
    except OSError as error:
        raise InputError(f"the texture {texture.name} is not an image that can be read") from error
    if not texture.srgb:
        pixels = srgb_from_linear(pixels)
    scaled = np.clip(pixels * texture.scale[:3] + texture.bias[:3], 0.0, 1.0)
    return np.rint(scaled * 255).astype(np.uint8)


def _image(pyvista: Any, texture: Texture) -> pv.Texture:
    image = pyvista.numpy_to_texture(texture_pixels(texture))
    image.repeat = texture.wrap[0] == "repeat"
    image.mipmap = image.interpolate = True
    return image
