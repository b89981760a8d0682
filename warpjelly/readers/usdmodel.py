"""Read the meshes of a USD file as a model."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils

from ..errors import SceneError, listed, reason
from ..looks import Look
from ..polygons import Model, Part, from_polygons, placed
from ..stage.usdlooks import read_look

log = logging.getLogger("warpjelly")

_UV_TYPES = {
    Sdf.ValueTypeNames.TexCoord2fArray,
    Sdf.ValueTypeNames.TexCoord2dArray,
    Sdf.ValueTypeNames.TexCoord2hArray,
    Sdf.ValueTypeNames.Float2Array,
}
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
        log.warning("%s: left out, because only meshes are read: %s", path, listed(named, _NAMED))
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
    looks = _Looks(path)
    parts = [placed(_part(path, mesh, looks), _matrix(mesh.GetPrim(), matrices)) for mesh in meshes]
    return Model(parts, looks.found, unit, UsdGeom.GetStageUpAxis(stage))


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


class _Looks:
    """The looks of a file, each of which is read once."""

    def __init__(self, path: Path) -> None:
        self.found: list[Look] = []
        self._path = path
        self._numbers: dict[Sdf.Path, int] = {}
        self._images: dict[str, bytes] = {}

    def number(self, prim: Usd.Prim) -> tuple[int, tuple[str, ...]]:
        """Return which look a prim has, -1 if none, and the names of its material."""
        bound = UsdShade.MaterialBindingAPI(prim)
        material = bound.ComputeBoundMaterial(UsdShade.Tokens.preview)[0]
        material = material or bound.ComputeBoundMaterial(UsdShade.Tokens.full)[0]
        if not material:
            return -1, ()
        found = material.GetPrim()
        path = (found.GetPrimInPrototype() if found.IsInstanceProxy() else found).GetPath()
        if path not in self._numbers:
            look = read_look(self._path, material, self._images)
            self._numbers[path] = len(self.found) if look else -1
            self.found += [look] if look else []
        return self._numbers[path], (str(found.GetPath()), found.GetName())


def _part(path: Path, mesh: UsdGeom.Mesh, looks: _Looks) -> Part:
    points = _array(mesh.GetPointsAttr(), float).reshape(-1, 3)
    counts = _array(mesh.GetFaceVertexCountsAttr(), int)
    corners = _array(mesh.GetFaceVertexIndicesAttr(), int)
    sound, why = UsdGeom.Mesh.ValidateTopology(corners.tolist(), counts.tolist(), len(points))
    if not sound:
        raise SceneError(f"{path}: {mesh.GetPath()}: {why}")
    part = from_polygons(points, counts, corners)
    part = replace(part, uvs=_uvs(path, mesh, part), normals=_normals(path, mesh, part))
    part = _grouped(mesh, part, looks)
    if _value(mesh.GetSubdivisionSchemeAttr()) != UsdGeom.Tokens.none:
        solid = np.ones(len(counts), bool)
        solid[_array(mesh.GetHoleIndicesAttr(), int)] = False
        part = part.taken(solid)
    left_handed = _value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
    return part.turned_round() if left_handed else part


def _uvs(path: Path, mesh: UsdGeom.Mesh, part: Part) -> np.ndarray | None:
    """Return the primvar st at the corners, or the first other one that has UVs."""
    found = [
        primvar
        for primvar in UsdGeom.PrimvarsAPI(mesh).FindPrimvarsWithInheritance()
        if primvar.HasValue() and primvar.GetTypeName() in _UV_TYPES
    ]
    plain = Sdf.ValueTypeNames.Float2Array
    found.sort(key=lambda primvar: (primvar.GetPrimvarName() != "st", primvar.GetTypeName() == plain))
    return _primvar_at_corners(path, found[0], part) if found else None


def _normals(path: Path, mesh: UsdGeom.Mesh, part: Part) -> np.ndarray | None:
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(UsdGeom.Tokens.normals)
    if primvar and primvar.HasValue():
        return _primvar_at_corners(path, primvar, part)
    attribute = mesh.GetNormalsAttr()
    return _at_corners(path, attribute, _array(attribute, float), mesh.GetNormalsInterpolation(), part)


def _primvar_at_corners(path: Path, primvar: UsdGeom.Primvar, part: Part) -> np.ndarray | None:
    attribute = primvar.GetAttr()
    values = primvar.ComputeFlattened(_time(attribute))
    values = np.zeros(0) if values is None else np.asarray(values, float)
    return _at_corners(path, attribute, values, primvar.GetInterpolation(), part)


def _at_corners(
    path: Path, attribute: Usd.Attribute, values: np.ndarray, interpolation: str, part: Part
) -> np.ndarray | None:
    """Return the values of an attribute at the corners; None if it has none, after a warning if there are too few."""
    places = {
        UsdGeom.Tokens.constant: np.zeros(len(part.corners), int),
        UsdGeom.Tokens.uniform: np.repeat(np.arange(len(part.counts)), part.counts),
        UsdGeom.Tokens.faceVarying: np.arange(len(part.corners)),
    }.get(interpolation, part.corners)
    if not attribute.HasValue():
        return None
    if len(values) <= places.max(initial=-1):
        log.warning("%s: %s has too few values; left out", path, attribute.GetPath())
        return None
    return values[places]


def _grouped(mesh: UsdGeom.Mesh, part: Part, looks: _Looks) -> Part:
    """Return a part with what its polygons belong to: prims, subsets and materials."""
    prims = _ancestors(mesh.GetPrim())[::-1]
    names = [tuple(name for prim in prims for name in (str(prim.GetPath()), prim.GetName()))]
    groups, chosen = np.zeros(len(part.counts), np.int64), np.full(len(part.counts), -1)
    for prim, faces, bound in _pieces(mesh, len(part.counts)):
        own: tuple[str, ...] = () if prim == mesh.GetPrim() else (str(prim.GetPath()), prim.GetName())
        if bound:
            chosen[faces], material_names = looks.number(prim)
            own += material_names
        # What is in several subsets belongs to a group with the names of all of them.
        before, inverse = np.unique(groups[faces], return_inverse=True)
        groups[faces] = len(names) + inverse
        names += [(*names[group], *own) for group in before]
    return replace(part, looks=chosen, groups=groups, names=tuple(names))


def _pieces(mesh: UsdGeom.Mesh, face_count: int) -> Iterator[tuple[Usd.Prim, np.ndarray, bool]]:
    """Yield what faces belong to: the prim, its faces, int64 [count], and whether they have its material."""
    bare = np.ones(face_count, bool)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        faces = _array(subset.GetIndicesAttr(), int)
        faces = faces[(faces >= 0) & (faces < face_count)]
        if len(faces) and _value(subset.GetElementTypeAttr()) == UsdGeom.Tokens.face:
            bound = subset.GetFamilyNameAttr().Get() == UsdShade.Tokens.materialBind
            bare[faces] &= not bound
            yield subset.GetPrim(), faces, bound
    if bare.any():
        yield mesh.GetPrim(), np.flatnonzero(bare), True


def _known(stage: Usd.Stage) -> str:
    """Say which meshes a stage has, whether they are seen or not."""
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    found = [str(prim.GetPath()) for prim in prims if prim.IsA(UsdGeom.Mesh)]
    return f"meshes in this file: {listed(found, _NAMED)}" if found else "there is none in this file"
