"""Prims of the stage and where they are: meshes, straight lines and balls as every part of a stage draws them."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

WORLD = Sdf.Path("/World")
BODIES = WORLD.AppendChild("bodies")
COLLIDERS = WORLD.AppendChild("colliders")
# In a comparison, the worlds of the runs.
RUNS = WORLD.AppendChild("runs")
LOOKS = WORLD.AppendChild("looks")
LIGHTS = WORLD.AppendChild("lights")
CAMERA = WORLD.AppendChild("camera")

# Linear grey of everything that is not jelly.
COLLIDER_GREY = 0.4


def vectors(array: np.ndarray) -> Vt.Vec3fArray:
    """Return vectors [count, 3] as USD stores them, float32; a copy."""
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(array, dtype=np.float32))


def integers(array: np.ndarray) -> Vt.IntArray:
    """Return whole numbers of any shape as USD stores them, int32 in a row; a copy."""
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(array, dtype=np.int32).ravel())


def define_mesh(
    stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, counts: np.ndarray, corners: np.ndarray
) -> UsdGeom.Mesh:
    """Draw polygons that are seen from their fronts.

    Args:
        stage: where.
        path: of the prim.
        points: [point_count, 3], m.
        counts: corners of each face, [face_count].
        corners: point at each corner, counter-clockwise from outside, [corner_count].
    """
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    mesh.CreateDoubleSidedAttr(False)
    mesh.CreateFaceVertexCountsAttr(integers(counts))
    mesh.CreateFaceVertexIndicesAttr(integers(corners))
    mesh.CreatePointsAttr(vectors(points))
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    return mesh


def define_segments(stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, *, width: float) -> UsdGeom.BasisCurves:
    """Draw straight lines, each from one point to the next of the points, [2 line_count, 3], m."""
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr(integers(np.full(len(points) // 2, 2)))
    curves.CreatePointsAttr(vectors(points))
    curves.CreateWidthsAttr([width])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateExtentAttr(UsdGeom.Curves.ComputeExtent(curves.GetPointsAttr().Get(), [width]))
    return curves


def define_balls(stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, *, width: float) -> UsdGeom.Points:
    """Draw balls around points [count, 3], m."""
    balls = UsdGeom.Points.Define(stage, path)
    balls.CreatePointsAttr(vectors(points))
    # One for all would do, but then USD cannot compute extents.
    balls.CreateWidthsAttr(Vt.FloatArray(len(points), width))
    balls.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    balls.CreateExtentAttr(UsdGeom.Points.ComputeExtent(balls.GetPointsAttr().Get(), balls.GetWidthsAttr().Get()))
    return balls


def bind_look(shape: UsdGeom.Gprim, look: str) -> None:
    """Give a shape one of the stage's own looks, which may be in another of its layers."""
    binding = UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).GetPrim()
    binding.CreateRelationship(UsdShade.Tokens.materialBinding, custom=False).SetTargets([LOOKS.AppendChild(look)])


def facing(direction: tuple[float, float, float], up_axis: str) -> np.ndarray:
    """Return the axes (right, up, backward) [3, 3] of what looks from a direction, which is given for Y up."""
    x, y, z = direction
    backward = np.array([x, y, z] if up_axis == "Y" else [x, -z, y])
    backward /= np.linalg.norm(backward)
    right = np.cross(np.eye(3)["XYZ".index(up_axis)], backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward])


def matrix(axes: np.ndarray, position: np.ndarray) -> Gf.Matrix4d:
    """Return the transform to axes [3, 3], by rows, at a position [3], m."""
    rows = np.eye(4)
    rows[:3, :3], rows[3, :3] = axes, position
    return Gf.Matrix4d(rows.tolist())
