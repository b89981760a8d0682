"""Which shapes of a stage previews show: all that runs write, and of shots what has the same form."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from ..stage.prims import COLLIDERS, RUNS, WORLD

# More paths than these are not listed.
_LISTED = 3


def shapes_in(stage: Usd.Stage, schema: Any) -> Iterator[Any]:
    """Yield the shapes of a type that are shown; they are the same at each frame."""
    return (schema(prim) for prim in _seen(stage) if prim.IsA(schema) and _can_be_shown(prim))


def left_out(stage: Usd.Stage) -> str:
    """Name the shapes to be seen that previews cannot show; nothing if there are none."""
    paths = [f"{prim.GetPath()} ({prim.GetTypeName()})" for prim in _seen(stage) if not _can_be_shown(prim)]
    more = [f"{len(paths) - _LISTED} more"] if len(paths) > _LISTED else []
    return ", ".join([*paths[:_LISTED], *more])


def is_collider(shape: UsdGeom.Gprim) -> bool:
    """Say whether a shape stands for what the bodies of a run collide with."""
    path = shape.GetPath()
    if path.HasPrefix(RUNS):
        path = path.ReplacePrefix(path.GetPrefixes()[RUNS.pathElementCount], WORLD)
    return bool(path.HasPrefix(COLLIDERS))


def is_floor(mesh: UsdGeom.Mesh) -> bool:
    """Say whether a mesh is a rectangle that bodies collide with."""
    return is_collider(mesh) and len(mesh.GetFaceVertexCountsAttr().Get(Usd.TimeCode.EarliestTime())) == 1


def corner_normals(mesh: UsdGeom.Mesh, frame: int) -> np.ndarray | None:
    """Return the normals at the corners of the faces [corner_count, 3], None if there are none but by point."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")
    if primvar and primvar.HasValue():
        by_corner = primvar.GetInterpolation() == UsdGeom.Tokens.faceVarying
        return np.array(primvar.ComputeFlattened(frame)) if by_corner else None
    by_corner = mesh.GetNormalsInterpolation() == UsdGeom.Tokens.faceVarying
    normals = mesh.GetNormalsAttr().Get(frame) if by_corner else None
    return None if normals is None else np.array(normals)


def is_flat(mesh: UsdGeom.Mesh) -> bool:
    """Say whether the faces of a mesh look flat: it is of polygons, and no normals say otherwise."""
    has_normals = mesh.GetNormalsAttr().HasValue() or UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals").HasValue()
    return not has_normals and mesh.GetSubdivisionSchemeAttr().Get() == UsdGeom.Tokens.none


def _seen(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    """Yield the shapes, those of instances too, without what is hidden all the time or stands in for others."""
    prims = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)))
    for prim in prims:
        imageable = UsdGeom.Imageable(prim)
        if imageable and _is_hidden(imageable):
            prims.PruneChildren()
            continue
        instancer = prim.IsA(UsdGeom.PointInstancer)
        if instancer:
            # What it repeats is not seen where it is itself.
            prims.PruneChildren()
        if (instancer or prim.IsA(UsdGeom.Gprim)) and imageable.ComputePurpose() in (
            UsdGeom.Tokens.default_,
            UsdGeom.Tokens.render,
        ):
            yield prim


def _is_hidden(prim: UsdGeom.Imageable) -> bool:
    visibility = prim.GetVisibilityAttr()
    if visibility.ValueMightBeTimeVarying():
        return False
    return bool(visibility.Get(Usd.TimeCode.EarliestTime()) == UsdGeom.Tokens.invisible)


def _can_be_shown(prim: Usd.Prim) -> bool:
    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        topology = (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr())
        still = all(_has_some(each) and not each.ValueMightBeTimeVarying() for each in topology)
        return still and mesh.GetPointsAttr().HasValue()
    if prim.IsA(UsdGeom.BasisCurves):
        curves = UsdGeom.BasisCurves(prim)
        counts = curves.GetCurveVertexCountsAttr()
        straight = curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear and _has_some(counts)
        if not (straight and (np.array(counts.Get(Usd.TimeCode.EarliestTime())) == 2).all()):
            return False
        return curves.GetPointsAttr().HasValue() and _has_some(curves.GetWidthsAttr())
    if prim.IsA(UsdGeom.Points):
        return UsdGeom.Points(prim).GetPointsAttr().HasValue() and _has_some(UsdGeom.Points(prim).GetWidthsAttr())
    return bool(prim.IsA(UsdGeom.Sphere))


def _has_some(attribute: Usd.Attribute) -> bool:
    values = attribute.Get(Usd.TimeCode.EarliestTime())
    return values is not None and len(values) > 0
