"""A stage as one page to look around in: it plays from disk in any browser, without a network.

The page is ``review.html``, a player in WebGL 2, with what it plays: a description in JSON, and arrays. Of each shape
there are, little endian, the triangles, uint32; positions at every frame, uint16 within the shape's box over all time;
and colours at every frame, uint8 into a palette. Positions and colours are stored as differences from the frame before,
and of the positions first all low bytes, then all high ones, which zlib makes the most of.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from types import EllipsisType
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdShade

from ..colors import SRGB_TABLE, srgb_from_linear
from ..errors import InputError
from ..looks import Texture
from ..pages import fill_page
from ..polygons import triangulate
from .eye import Eye
from .legends import legend_of
from .shown import is_collider, is_flat, is_floor, shapes_in
from .solids import colors_at, diffuse, looks_of, room_floor, subset_of_faces, texture_pixels

# More than that, no browser holds.
MAX_BYTES = 1_000_000_000
_BYTES_PER_POINT = 7
_BALL_SUBDIVISIONS = 4
# A mesh whose points would be more than so many times as many if they were split at edges is shaded flat.
_MOST_SPLIT = 1.5


@dataclass(frozen=True)
class _Shape:
    """A prim as the player draws it."""

    prim: Usd.Prim
    kind: str
    """surface, floor, lines (each from one point to the next) or balls."""
    points: Callable[[int], np.ndarray]
    """Places at a frame [point_count, 3], m, in the prim's own space."""
    triangles: np.ndarray
    """Points at the corners, int [triangle_count, 3]; none of lines and balls."""
    parts: list[dict[str, Any]]
    """Triangles in turn: how many, and their one colour or None."""
    chosen: np.ndarray | EllipsisType = ...
    """Which of the places and their colours are taken, and how often."""
    smooth: bool = True
    """Whether a surface looks smooth rather than flat between its edges."""
    width: float = 0.0
    """Of lines and balls, m."""


def review_page(
    stage: Usd.Stage, frames: Sequence[int], progress: Callable[[int, int], None] = lambda done, total: None
) -> str:
    """Return a page that plays frames of a stage.

    Args:
        stage: what to show.
        frames: their numbers, evenly spaced.
        progress: called after each shape with the number of shapes done and in all.

    Raises:
        InputError: the stage has nothing to show, or it is too much for a page.
    """
    total = sum(len(shape.GetPointsAttr().Get(frames[0]) or ()) for shape in shapes_in(stage, UsdGeom.PointBased))
    if total * len(frames) * _BYTES_PER_POINT > MAX_BYTES:
        raise InputError(
            f"{total:,} points in {len(frames)} frames are too much for a page, which holds "
            f"{MAX_BYTES // 1_000_000:,} MB: thin the frames with --every"
        )
    shapes = [*_surfaces(stage, frames[0]), *_spheres(stage), *_lines(stage, frames[0]), *_balls(stage, frames[0])]
    if not shapes:
        raise InputError("the stage has nothing to show")
    if not any(shape.kind == "floor" for shape in shapes):
        shapes += _room_floors(stage, frames[0])
    described, arrays = [], []
    for shape in shapes:
        description, data = _packed(shape, frames)
        described.append(description)
        arrays.append(data)
        progress(len(described), len(shapes))
    description = {
        "rate": stage.GetTimeCodesPerSecond(),
        "frames": list(frames),
        "up": [float(axis == UsdGeom.GetStageUpAxis(stage)) for axis in "XYZ"],
        "camera": _camera(stage, frames[0]),
        "legend": _legend(stage),
        "shapes": described,
    }
    default = stage.GetDefaultPrim()
    title = (Usd.ModelAPI(default).GetAssetName() if default else "") or "stage"
    packed = base64.b64encode(zlib.compress(b"".join(arrays), 9)).decode()
    return fill_page(__package__, "review.html", title=title, tables={"STAGE": description}, texts={"ARRAYS": packed})


def _surfaces(stage: Usd.Stage, frame: int) -> Iterator[_Shape]:
    images: dict[str, bytes] = {}
    for mesh in shapes_in(stage, UsdGeom.Mesh):
        points, counts = mesh.GetPointsAttr(), np.array(mesh.GetFaceVertexCountsAttr().Get(frame))
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(frame))
        chosen, corners, smooth = _split_at_edges(mesh, corners, frame)
        triangles, faces = triangulate(np.array(points.Get(frame)).reshape(-1, 3)[chosen], counts, corners)
        subsets = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
        own = subset_of_faces(subsets, len(counts))
        colors = [*(_plain_color(prim, images) for prim in looks_of(mesh, subsets)), None]
        order = np.argsort(own[faces], kind="stable")
        numbers, sizes = np.unique(own[faces], return_counts=True)
        parts = [
            {"count": size, "color": colors[number]}
            for number, size in zip(numbers.tolist(), sizes.tolist(), strict=True)
        ]
        kind = "floor" if is_floor(mesh) else "surface"
        yield _Shape(mesh.GetPrim(), kind, points.Get, triangles[order], parts, chosen, smooth)


def _split_at_edges(
    mesh: UsdGeom.Mesh, corners: np.ndarray, frame: int
) -> tuple[np.ndarray | EllipsisType, np.ndarray, bool]:
    """Split points where a mesh has several normals: return which are taken, the corners, and whether it is smooth.

    The player computes a normal for each point. A mesh with edges everywhere stays as it is and is shaded flat, which
    is smaller.
    """
    normals = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if not normals:
        return ..., corners, not is_flat(mesh)
    if not normals.IsIndexed() or normals.GetInterpolation() != UsdGeom.Tokens.faceVarying:
        return ..., corners, False
    pairs = np.stack([corners, np.array(normals.GetIndices(frame))], axis=1)
    found, own = np.unique(pairs, axis=0, return_inverse=True)
    if len(found) > _MOST_SPLIT * len(mesh.GetPointsAttr().Get(frame)):
        return ..., corners, False
    return found[:, 0], own.ravel(), True


def _spheres(stage: Usd.Stage) -> Iterator[_Shape]:
    from trimesh.creation import icosphere

    for sphere in shapes_in(stage, UsdGeom.Sphere):
        ball = icosphere(subdivisions=_BALL_SUBDIVISIONS)
        points, parts = partial(_swollen, ball.vertices, sphere), [{"count": len(ball.faces), "color": None}]
        yield _Shape(sphere.GetPrim(), "surface", points, ball.faces, parts)


def _swollen(unit_ball: np.ndarray, sphere: UsdGeom.Sphere, frame: int) -> np.ndarray:
    return unit_ball * sphere.GetRadiusAttr().Get(frame)


def _lines(stage: Usd.Stage, frame: int) -> Iterator[_Shape]:
    for curves in shapes_in(stage, UsdGeom.BasisCurves):
        width = curves.GetWidthsAttr().Get(frame)[0]
        yield _Shape(curves.GetPrim(), "lines", curves.GetPointsAttr().Get, np.empty((0, 3)), [], width=width)


def _room_floors(stage: Usd.Stage, frame: int) -> Iterator[_Shape]:
    """Yield the bottoms of rooms that are drawn as their edges."""
    for curves in shapes_in(stage, UsdGeom.BasisCurves):
        if is_collider(curves):
            corners = room_floor(stage, np.array(curves.GetPointsAttr().Get(frame), float).reshape(-1, 3))
            triangles, parts = np.array([[0, 1, 2], [0, 2, 3]]), [{"count": 2, "color": None}]
            yield _Shape(curves.GetPrim(), "floor", partial(_still, corners), triangles, parts)


def _still(points: np.ndarray, frame: int) -> np.ndarray:
    return points


def _balls(stage: Usd.Stage, frame: int) -> Iterator[_Shape]:
    for balls in shapes_in(stage, UsdGeom.Points):
        width = balls.GetWidthsAttr().Get(frame)[0]
        yield _Shape(balls.GetPrim(), "balls", balls.GetPointsAttr().Get, np.empty((0, 3)), [], width=width)


def _plain_color(prim: Usd.Prim, images: dict[str, bytes]) -> list[float] | None:
    """Return the one colour of a prim's material, sRGB: that of a texture is its mean; None without a look."""
    value = diffuse(prim, images)
    if value is None:
        return None
    if isinstance(value, Texture):
        return (texture_pixels(value).mean(axis=(0, 1)) / 255).tolist()
    return srgb_from_linear(np.asarray(value)).tolist()


def _packed(shape: _Shape, frames: Sequence[int]) -> tuple[dict[str, Any], bytes]:
    """Return the description of a shape and its arrays."""
    places = []
    for frame in frames:
        matrix = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(shape.prim))
        points = np.array(shape.points(frame), np.float32).reshape(-1, 3)[shape.chosen]
        places.append((points @ matrix[:3, :3] + matrix[3, :3]).astype(np.float32))
    positions = _once_if_still(np.stack(places))
    low = positions.min(axis=(0, 1), initial=np.inf)
    size = np.maximum(positions.max(axis=(0, 1), initial=-np.inf) - low, 1e-9)
    steps = _differences(np.rint((positions - low) / size * 65535).astype(np.uint16))

    gprim, count = UsdGeom.Gprim(shape.prim), len(shape.points(frames[0]))
    varies = UsdGeom.Primvar(gprim.GetDisplayColorAttr()).ValueMightBeTimeVarying()
    colored = frames if varies else frames[:1]
    palette, indices = _palette([colors_at(gprim, frame, count)[shape.chosen] for frame in colored])
    description = {
        "kind": shape.kind,
        "points": positions.shape[1],
        "triangles": len(shape.triangles),
        "parts": shape.parts,
        "smooth": shape.smooth,
        "width": shape.width,
        "low": low.tolist(),
        "size": size.tolist(),
        "moves": len(positions) > 1,
        "recolors": len(indices) > 1,
        "palette": palette.ravel().tolist(),
    }
    arrays = (
        shape.triangles.astype("<u4"),
        (steps & 0xFF).astype(np.uint8),
        (steps >> 8).astype(np.uint8),
        _differences(indices),
    )
    return description, b"".join(array.tobytes() for array in arrays)


def _palette(colors: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return at most 256 colours, uint8 [n, 3], and which each point has, uint8 [frame_count, point_count].

    Args:
        colors: at each frame, sRGB, uint8 [point_count, 3]; where there are too many, their lowest bits are left out.
    """
    codes = np.stack(colors).astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    found, indices = np.unique(codes, return_inverse=True)
    mask = 0xFF
    while len(found) > 256:
        mask = (mask << 1) & 0xFF
        found, indices = np.unique(codes & (mask << 16 | mask << 8 | mask), return_inverse=True)
    palette = np.stack([found >> 16, found >> 8 & 0xFF, found & 0xFF], axis=1)
    return palette.astype(np.uint8), _once_if_still(indices.reshape(codes.shape).astype(np.uint8))


def _once_if_still(frames: np.ndarray) -> np.ndarray:
    """Return frames [frame_count, ...], of which the first stands for all if they are equal."""
    return frames[:1] if (frames == frames[0]).all() else frames


def _differences(frames: np.ndarray) -> np.ndarray:
    """Return the first frame and what each next one adds, modulo the integers' range."""
    return np.concatenate([frames[:1], np.diff(frames, axis=0)])


def _camera(stage: Usd.Stage, frame: int) -> dict[str, Any]:
    """Return where the stage's camera is, where it looks, its axes, and the slopes of what it sees."""
    view = Eye(stage).at(frame)
    matrix = np.array(view.transform)
    return {
        "position": matrix[3, :3].tolist(),
        "target": (matrix[3, :3] - matrix[2, :3] * view.focusDistance).tolist(),
        "axes": matrix[:3, :3].tolist(),
        "slopes": [aperture / (2 * view.focalLength) for aperture in (view.horizontalAperture, view.verticalAperture)],
    }


def _legend(stage: Usd.Stage) -> dict[str, Any] | None:
    """Return what the colours mean, in sRGB."""
    if (legend := legend_of(stage)) is None:
        return None
    return asdict(legend) | {"colors": np.rint(SRGB_TABLE[::15] * 255).astype(int).tolist()}
