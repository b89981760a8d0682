"""Read the meshes of a USD file as a model."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils

from .errors import SceneError, reason
from .polygons import Model, Part, from_polygons, placed

log = logging.getLogger("warpjelly")

# So many prims are named where there are more.
_NAMED = 5


def read_usd(path: Path, prim: str | None = None) -> Model:
    """Read all visible meshes below a prim of a USD file, at rest, in its own units and axes.

    At rest is the default value, or the first sample where there is none. Guides and proxies are left out, instances
    are read like what they stand for. Subdivision surfaces count as their cage, without the faces that are holes.

    Args:
        path: the file.
        prim: path of the prim; the default prim if None, or the whole stage where there is none.

    Raises:
        SceneError: the file is broken, there is no such prim, or no mesh below it.
    """
    # While this lives, USD prints nothing itself.
    silence = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        stage = Usd.Stage.Open(str(path))
        for error in stage.GetCompositionErrors()[:1]:
            log.warning("%s: the stage is not complete: %s", path, " ".join(str(error).split()))
        return _read_stage(path, stage, prim)
    except Tf.ErrorException as error:
        raise SceneError(f"{path}: not a readable USD file: {reason(error)}") from error
    finally:
        del silence


def _read_stage(path: Path, stage: Usd.Stage, prim: str | None) -> Model:
    root = _root(path, stage, prim)
    meshes, others = [], []
    for found in _drawn(root):
        if found.IsA(UsdGeom.Mesh):
            meshes.append(UsdGeom.Mesh(found))
        elif found.IsA(UsdGeom.Gprim) or found.IsA(UsdGeom.PointInstancer):
            others.append(found)
    if not meshes:
        raise SceneError(f"{path}: no mesh to be seen below {root.GetPath()}; {_known(stage)}")
    if others:
        named = [f"{other.GetTypeName()} {other.GetPath()}" for other in others]
        log.warning("%s: left out, because only meshes are read: %s", path, _listed(named))
    smooth = [mesh for mesh in meshes if _value(mesh.GetSubdivisionSchemeAttr()) != UsdGeom.Tokens.none]
    if smooth:
        log.warning(
            "%s: %d of %d meshes are subdivision surfaces; their cages are used", path, len(smooth), len(meshes)
        )
    unit = UsdGeom.GetStageMetersPerUnit(stage)
    if not (math.isfinite(unit) and unit > 0):
        raise SceneError(f"{path}: metersPerUnit is {unit:g}; it must be above 0")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        log.warning("%s: no metersPerUnit is given; a unit is %g m then", path, unit)
    matrices: dict[Sdf.Path, np.ndarray] = {}
    parts = [placed(_part(path, mesh), _matrix(mesh.GetPrim(), matrices)) for mesh in meshes]
    return Model(parts, unit, UsdGeom.GetStageUpAxis(stage))


def _root(path: Path, stage: Usd.Stage, prim: str | None) -> Usd.Prim:
    if prim is None:
        return stage.GetDefaultPrim() or stage.GetPseudoRoot()
    name = Sdf.Path(prim) if Sdf.Path.IsValidPathString(prim) else Sdf.Path.emptyPath
    if not (name.IsAbsolutePath() and name.IsAbsoluteRootOrPrimPath()):
        raise SceneError(f"{path}: '{prim}' is not the path of a prim; one looks like /World/thing")
    root = stage.GetPrimAtPath(prim)
    if not root:
        raise SceneError(f"{path}: no prim {prim}; {_known(stage)}")
    return root


def _drawn(root: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield what a viewer shows below a prim: defined, visible and for rendering."""
    if any(_hidden(parent) for parent in _ancestors(root)[1:]):
        return
    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if _hidden(prim):
            prims.PruneChildren()
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            # What is below are prototypes, which are not shown where they stand.
            prims.PruneChildren()
        imageable = UsdGeom.Imageable(prim)
        if not imageable or imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
            yield prim


def _hidden(prim: Usd.Prim) -> bool:
    imageable = UsdGeom.Imageable(prim)
    return bool(imageable) and _value(imageable.GetVisibilityAttr()) == UsdGeom.Tokens.invisible


def _ancestors(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return a prim and all above it, without the root of the stage."""
    found = []
    while prim and not prim.IsPseudoRoot():
        found.append(prim)
        prim = prim.GetParent()
    return found


def _time(attribute: Usd.Attribute) -> Usd.TimeCode:
    """Return when an attribute has its value at rest."""
    source = attribute.GetResolveInfo(Usd.TimeCode.Default()).GetSource()
    at_rest = source == Usd.ResolveInfoSourceDefault or not attribute.GetNumTimeSamples()
    return Usd.TimeCode.Default() if at_rest else Usd.TimeCode.EarliestTime()


def _value(attribute: Usd.Attribute) -> object:
    return attribute.Get(_time(attribute))


def _array(attribute: Usd.Attribute, dtype: type) -> np.ndarray:
    value = _value(attribute)
    return np.zeros(0, dtype) if value is None else np.asarray(value, dtype)


def _matrix(prim: Usd.Prim, known: dict[Sdf.Path, np.ndarray]) -> np.ndarray:
    """Return the matrix that takes a prim's points to the stage, for column vectors, [4, 4]."""
    if prim.IsPseudoRoot():
        return np.eye(4)
    path = prim.GetPath()
    if path not in known:
        local, above = Gf.Matrix4d(1.0), True
        if xformable := UsdGeom.Xformable(prim):
            above = not xformable.GetResetXformStack()
            # Rows times matrices: what is listed first acts last.
            for operation in xformable.GetOrderedXformOps():
                local = operation.GetOpTransform(_time(operation.GetAttr())) * local
        known[path] = (_matrix(prim.GetParent(), known) if above else np.eye(4)) @ np.array(local).T
    return known[path]


def _part(path: Path, mesh: UsdGeom.Mesh) -> Part:
    points = _array(mesh.GetPointsAttr(), float).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr(), int)
    corners = _array(mesh.GetFaceVertexIndicesAttr(), int)
    sound, why = UsdGeom.Mesh.ValidateTopology(corners.tolist(), counts.tolist(), len(points))
    if not sound:
        raise SceneError(f"{path}: {mesh.GetPath()}: {why}")
    if _value(mesh.GetSubdivisionSchemeAttr()) != UsdGeom.Tokens.none:
        solid = np.ones(len(counts), bool)
        solid[_array(mesh.GetHoleIndicesAttr(), int)] = False
        corners, counts = corners[np.repeat(solid, counts)], counts[solid]
    part = from_polygons(points, counts, corners)
    left_handed = _value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    return Part(part.vertices, part.faces[:, ::-1]) if left_handed else part


def _known(stage: Usd.Stage) -> str:
    """Say which meshes a stage has, whether they are seen or not."""
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    found = [str(prim.GetPath()) for prim in prims if prim.IsA(UsdGeom.Mesh)]
    return f"meshes in this file: {_listed(found)}" if found else "there is none in this file"


def _listed(names: list[str]) -> str:
    rest = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")
