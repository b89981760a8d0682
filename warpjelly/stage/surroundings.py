"""What surrounds the bodies and depends on how far they move: what they collide with, and the camera."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from ..scene import BoxCollider, HalfSpaceCollider, PlaneCollider, Scene, SphereCollider, plane_frame
from .common import corners_of
from .prims import (
    CAMERA,
    COLLIDER_GREY,
    COLLIDERS,
    bind_look,
    define_mesh,
    define_segments,
    facing,
    matrix,
    vectors,
)

# The camera has a 50 mm lens and a 36 mm wide 16:9 film back, and looks slightly down from the right. Directions are
# for Y up.
FOCAL_LENGTH, APERTURE = 50.0, (36.0, 20.25)
_CAMERA_DIRECTION = (0.6, 0.45, 1.0)
# Share of the frame that the motion may fill, from the centre to the edge.
_FRAME_FILL = 0.92
# Edge of the square that stands for an infinite wall, in diagonals of the motion.
_WALL_SIZE = 20.0


def define_colliders(stage: Usd.Stage, scene: Scene, bounds: np.ndarray, rest_center: np.ndarray) -> None:
    """Draw what the bodies collide with; infinite walls reach well around the motion, bounds [2, 3], m."""
    UsdGeom.Xform.Define(stage, COLLIDERS)
    diagonal = _diagonal(bounds)
    for collider in scene.colliders:
        path = COLLIDERS.AppendChild(collider.name)
        shape: UsdGeom.Gprim
        if isinstance(collider, PlaneCollider):
            shape = _define_rectangle(stage, path, np.array(collider.center), collider.frame(), collider.size)
        elif isinstance(collider, HalfSpaceCollider):
            tangent, bitangent, normal = plane_frame(collider.normal, None)
            if (rest_center - collider.center) @ normal < 0:
                # Seen from behind, a wall is culled: its front has to face the bodies.
                tangent, bitangent, normal = bitangent, tangent, -normal
            middle = bounds.mean(axis=0)
            center = middle - normal * ((middle - collider.center) @ normal)
            size = (_WALL_SIZE * diagonal, _WALL_SIZE * diagonal)
            shape = _define_rectangle(stage, path, center, (tangent, bitangent, normal), size)
        elif isinstance(collider, SphereCollider):
            shape = UsdGeom.Sphere.Define(stage, path)
            shape.CreateRadiusAttr(collider.radius)
            shape.CreateExtentAttr(vectors(np.array([[-collider.radius] * 3, [collider.radius] * 3])))
            shape.AddTranslateOp().Set(Gf.Vec3d(*collider.center))
        else:
            shape = _define_edges(stage, path, collider, width=diagonal / 300)
        shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(COLLIDER_GREY)])
        bind_look(shape, "collider")


def _define_rectangle(
    stage: Usd.Stage,
    path: Sdf.Path,
    center: np.ndarray,
    frame: tuple[np.ndarray, np.ndarray, np.ndarray],
    size: tuple[float, float],
) -> UsdGeom.Mesh:
    tangent, bitangent, normal = frame
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    points = center + corners @ np.stack([tangent, bitangent])
    mesh = define_mesh(stage, path, points, np.array([4]), np.arange(4))
    mesh.CreateNormalsAttr(vectors(np.tile(normal, (4, 1))))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return mesh


def _define_edges(stage: Usd.Stage, path: Sdf.Path, box: BoxCollider, *, width: float) -> UsdGeom.BasisCurves:
    """Draw a room as its twelve edges, so that what is inside stays visible."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    first, second = np.nonzero(np.abs(corners[:, None] - corners).sum(axis=2) == 1)
    edges = np.stack([first, second], axis=1)[first < second]
    points = np.array(box.center) + (corners[edges.ravel()] - 0.5) * box.size
    return define_segments(stage, path, points, width=width)


def define_camera(stage: Usd.Stage, scene: Scene, bounds: np.ndarray) -> None:
    """Place a camera that sees the whole motion, bounds [2, 3], m, and the balls close to it."""
    diagonal = _diagonal(bounds)
    low, high = bounds.copy()
    for collider in scene.colliders:
        if isinstance(collider, SphereCollider) and collider.radius < diagonal:
            center = np.array(collider.center)
            if np.linalg.norm(center - np.clip(center, *bounds)) < collider.radius + diagonal / 2:
                low = np.minimum(low, center - collider.radius)
                high = np.maximum(high, center + collider.radius)
    corners = corners_of(np.stack([low, high]))
    aim_camera(UsdGeom.Camera.Define(stage, CAMERA), camera_axes(scene.up_axis), corners)


def aim_camera(camera: UsdGeom.Camera, axes: np.ndarray, points: np.ndarray) -> None:
    """Place a camera with given axes [3, 3] as close as it sees all points [count, 3], m."""
    position, distance, clipping = framing(axes, points)
    camera.CreateFocalLengthAttr(FOCAL_LENGTH)
    camera.CreateHorizontalApertureAttr(APERTURE[0])
    camera.CreateVerticalApertureAttr(APERTURE[1])
    camera.CreateFocusDistanceAttr(distance)
    camera.CreateClippingRangeAttr(Gf.Vec2f(*clipping))
    camera.MakeMatrixXform().Set(matrix(axes, position))


def camera_axes(up_axis: str) -> np.ndarray:
    """Return the axes (right, up, backward) [3, 3] of the camera of a run's stage."""
    return facing(_CAMERA_DIRECTION, up_axis)


def framing(axes: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, float, tuple[float, float]]:
    """Return where a camera sees all points, how far away their middle is, and what to clip at.

    Args:
        axes: of the camera (right, up, backward), [3, 3].
        points: [count, 3], m.
    """
    x, y, z = axes @ points.T
    # In the axes of the camera, a corner is seen from (X, Y, Z) while |x - X| <= s (Z - z), with s the slope of the
    # frustum's sides; the closest place that sees all follows from the outermost corner on each side.
    placed = []
    for across, aperture in ((x, APERTURE[0]), (y, APERTURE[1])):
        slope = _FRAME_FILL * aperture / (2 * FOCAL_LENGTH)
        right, left = np.max(across + slope * z), np.max(-across + slope * z)
        placed.append(((right - left) / 2, (right + left) / (2 * slope)))
    back = max(placed[0][1], placed[1][1], z.max() + 1e-3)
    distance = back - (z.max() + z.min()) / 2
    clipping = (min(distance / 100, (back - z.max()) / 2), distance * 100)
    return axes.T @ np.array([placed[0][0], placed[1][0], back]), distance, clipping


def _diagonal(bounds: np.ndarray) -> float:
    return max(float(np.linalg.norm(bounds[1] - bounds[0])), 1e-3)
