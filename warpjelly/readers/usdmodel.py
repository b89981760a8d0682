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
from ..polygons import MeshPrim, Model, Part, from_polygons, moved, placed
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


def read_usd(path: Path, prim: str | None = None, *, time: float | None = None) -> Model:
    """Read all visible meshes below a prim of a USD file, in its own units and axes.

    Guides and proxies are left out, instances are read like what they stand for. Subdivision surfaces count as their
    cage, without the faces that are holes.

    Args:
        path: the file.
        prim: path of the prim; the default prim if None, or the whole stage where there is none.
        time: time code; at rest if None, which is the default value, or the first sample where there is none.

    Raises:
        SceneError: the file is broken, there is no such prim, or no mesh below it.
    """
    # While this lives, USD prints nothing itself.
    silence = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        stage = Usd.Stage.Open(str(path))
        for error in stage.GetCompositionErrors()[:1]:
            log.warning("%s: the stage is not complete: %s", path, " ".join(str(error).split()))
        return _StageReader(path, stage, time).read(prim)
    except Tf.ErrorException as error:
        raise SceneError(f"{path}: not a readable USD file: {reason(error)}") from error
    finally:
        del silence


class _StageReader:
    """Reads a stage at one time."""

    def __init__(self, path: Path, stage: Usd.Stage, time: float | None) -> None:
        self._path, self._stage, self._moment = path, stage, time
        self._looks = _Looks(path)
        self._matrices: dict[Sdf.Path, np.ndarray] = {}

    def read(self, prim: str | None) -> Model:
        """Return all meshes below a prim."""
        path, stage = self._path, self._stage
        root = _root(path, stage, prim)
        meshes, others = [], []
        for found in self._drawn(root):
            if found.IsA(UsdGeom.Mesh):
                meshes.append(UsdGeom.Mesh(found))
            elif found.IsA(UsdGeom.Gprim) or found.IsA(UsdGeom.PointInstancer):
                others.append(found)
        if not meshes:
            raise SceneError(f"{path}: no mesh to be seen below {root.GetPath()}; {_known(stage)}")
        if others:
            named = [f"{other.GetTypeName()} {other.GetPath()}" for other in others]
            log.warning("%s: left out, because only meshes are read: %s", path, listed(named, _NAMED))
        smooth = [mesh for mesh in meshes if self._is_smooth(mesh)]
        if smooth:
            log.warning(
                "%s: %d of %d meshes are subdivision surfaces; their cages are used", path, len(smooth), len(meshes)
            )
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        if not (math.isfinite(unit) and unit > 0):
            raise SceneError(f"{path}: metersPerUnit is {unit:g}; it must be above 0")
        if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
            log.warning("%s: no metersPerUnit is given; a unit is %g m then", path, unit)
        cages = [self._cage(mesh) for mesh in meshes]
        matrices = [self._matrix(mesh.GetPrim()) for mesh in meshes]
        parts = [
            placed(self._solid(mesh, cage), matrix) for mesh, cage, matrix in zip(meshes, cages, matrices, strict=True)
        ]
        prims = [self._prim(mesh, cage, matrix) for mesh, cage, matrix in zip(meshes, cages, matrices, strict=True)]
        return Model(parts, self._looks.found, unit, UsdGeom.GetStageUpAxis(stage), prims)

    def _drawn(self, root: Usd.Prim) -> Iterator[Usd.Prim]:
        """Yield what a viewer shows below a prim: defined, visible and for rendering."""
        if any(self._hidden(parent) for parent in _ancestors(root)[1:]):
            return
        prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
        for prim in prims:
            if self._hidden(prim):
                prims.PruneChildren()
                continue
            if prim.IsA(UsdGeom.PointInstancer):
                # What is below are prototypes, which are not shown where they stand.
                prims.PruneChildren()
            imageable = UsdGeom.Imageable(prim)
            if not imageable or imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
                yield prim

    def _hidden(self, prim: Usd.Prim) -> bool:
        imageable = UsdGeom.Imageable(prim)
        return bool(imageable) and self._value(imageable.GetVisibilityAttr()) == UsdGeom.Tokens.invisible

    def _time(self, attribute: Usd.Attribute) -> Usd.TimeCode:
        """Return when an attribute has its value."""
        if self._moment is not None:
            return Usd.TimeCode(self._moment)
        source = attribute.GetResolveInfo(Usd.TimeCode.Default()).GetSource()
        at_rest = source == Usd.ResolveInfoSourceDefault or not attribute.GetNumTimeSamples()
        return Usd.TimeCode.Default() if at_rest else Usd.TimeCode.EarliestTime()

    def _value(self, attribute: Usd.Attribute) -> object:
        return attribute.Get(self._time(attribute))

    def _array(self, attribute: Usd.Attribute, dtype: type) -> np.ndarray:
        value = self._value(attribute)
        return np.zeros(0, dtype) if value is None else np.asarray(value, dtype)

    def _matrix(self, prim: Usd.Prim) -> np.ndarray:
        """Return the matrix that takes a prim's points to the stage, for column vectors, [4, 4]."""
        if prim.IsPseudoRoot():
            return np.eye(4)
        known, path = self._matrices, prim.GetPath()
        if path not in known:
            local, above = Gf.Matrix4d(1.0), True
            if xformable := UsdGeom.Xformable(prim):
                above = not xformable.GetResetXformStack()
                # Rows times matrices: what is listed first acts last.
                for operation in xformable.GetOrderedXformOps():
                    local = operation.GetOpTransform(self._time(operation.GetAttr())) * local
            known[path] = (self._matrix(prim.GetParent()) if above else np.eye(4)) @ np.array(local).T
        return known[path]

    def _is_smooth(self, mesh: UsdGeom.Mesh) -> bool:
        return self._value(mesh.GetSubdivisionSchemeAttr()) != UsdGeom.Tokens.none

    def _cage(self, mesh: UsdGeom.Mesh) -> Part:
        """Return the polygons of a mesh as they are stored."""
        points = self._array(mesh.GetPointsAttr(), float).reshape(-1, 3)
        counts = self._array(mesh.GetFaceVertexCountsAttr(), int)
        corners = self._array(mesh.GetFaceVertexIndicesAttr(), int)
        sound, why = UsdGeom.Mesh.ValidateTopology(corners.tolist(), counts.tolist(), len(points))
        if not sound:
            raise SceneError(f"{self._path}: {mesh.GetPath()}: {why}")
        part = from_polygons(points, counts, corners)
        return replace(part, uvs=self._uvs(mesh, part), normals=self._normals(mesh, part))

    def _prim(self, mesh: UsdGeom.Mesh, cage: Part, matrix: np.ndarray) -> MeshPrim:
        # Which normals are equal is all that counts of them, and subdivision makes its own.
        normals = None if self._is_smooth(mesh) else cage.normals
        return MeshPrim(str(mesh.GetPath()), replace(cage, vertices=moved(cage.vertices, matrix), normals=normals))

    def _solid(self, mesh: UsdGeom.Mesh, cage: Part) -> Part:
        """Return the polygons of a mesh that are seen, from outside, with what they belong to."""
        part = self._grouped(mesh, cage)
        if self._is_smooth(mesh):
            solid = np.ones(len(cage.counts), bool)
            solid[self._array(mesh.GetHoleIndicesAttr(), int)] = False
            part = part.taken(solid)
        left_handed = self._value(mesh.GetOrientationAttr()) == UsdGeom.Tokens.leftHanded
        return part.turned_round() if left_handed else part

    def _uvs(self, mesh: UsdGeom.Mesh, part: Part) -> np.ndarray | None:
        """Return the primvar st at the corners, or the first other one that has UVs."""
        found = [
            primvar
            for primvar in UsdGeom.PrimvarsAPI(mesh).FindPrimvarsWithInheritance()
            if primvar.HasValue() and primvar.GetTypeName() in _UV_TYPES
        ]
        plain = Sdf.ValueTypeNames.Float2Array
        found.sort(key=lambda primvar: (primvar.GetPrimvarName() != "st", primvar.GetTypeName() == plain))
        return self._primvar_at_corners(found[0], part) if found else None

    def _normals(self, mesh: UsdGeom.Mesh, part: Part) -> np.ndarray | None:
        primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar(UsdGeom.Tokens.normals)
        if primvar and primvar.HasValue():
            return self._primvar_at_corners(primvar, part)
        attribute = mesh.GetNormalsAttr()
        return self._at_corners(attribute, self._array(attribute, float), mesh.GetNormalsInterpolation(), part)

    def _primvar_at_corners(self, primvar: UsdGeom.Primvar, part: Part) -> np.ndarray | None:
        attribute = primvar.GetAttr()
        values = primvar.ComputeFlattened(self._time(attribute))
        values = np.zeros(0) if values is None else np.asarray(values, float)
        return self._at_corners(attribute, values, primvar.GetInterpolation(), part)

    def _at_corners(
        self, attribute: Usd.Attribute, values: np.ndarray, interpolation: str, part: Part
    ) -> np.ndarray | None:
        """Return the values at the corners; None if there are none, after a warning if there are too few."""
        places = {
            UsdGeom.Tokens.constant: np.zeros(len(part.corners), int),
            UsdGeom.Tokens.uniform: np.repeat(np.arange(len(part.counts)), part.counts),
            UsdGeom.Tokens.faceVarying: np.arange(len(part.corners)),
        }.get(interpolation, part.corners)
        if not attribute.HasValue():
            return None
        if len(values) <= places.max(initial=-1):
            log.warning("%s: %s has too few values; left out", self._path, attribute.GetPath())
            return None
        return values[places]

    def _grouped(self, mesh: UsdGeom.Mesh, part: Part) -> Part:
        """Return a part with what its polygons belong to: prims, subsets and materials."""
        prims = _ancestors(mesh.GetPrim())[::-1]
        names = [tuple(name for prim in prims for name in (str(prim.GetPath()), prim.GetName()))]
        groups, chosen = np.zeros(len(part.counts), np.int64), np.full(len(part.counts), -1)
        for prim, faces, bound in self._pieces(mesh, len(part.counts)):
            own: tuple[str, ...] = () if prim == mesh.GetPrim() else (str(prim.GetPath()), prim.GetName())
            if bound:
                chosen[faces], material_names = self._looks.number(prim)
                own += material_names
            # What is in several subsets belongs to a group with the names of all of them.
            before, inverse = np.unique(groups[faces], return_inverse=True)
            groups[faces] = len(names) + inverse
            names += [(*names[group], *own) for group in before]
        return replace(part, looks=chosen, groups=groups, names=tuple(names))

    def _pieces(self, mesh: UsdGeom.Mesh, face_count: int) -> Iterator[tuple[Usd.Prim, np.ndarray, bool]]:
        """Yield what faces belong to: the prim, its faces, int64 [count], and whether they have its material."""
        bare = np.ones(face_count, bool)
        for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
            faces = self._array(subset.GetIndicesAttr(), int)
            faces = faces[(faces >= 0) & (faces < face_count)]
            if len(faces) and self._value(subset.GetElementTypeAttr()) == UsdGeom.Tokens.face:
                bound = subset.GetFamilyNameAttr().Get() == UsdShade.Tokens.materialBind
                bare[faces] &= not bound
                yield subset.GetPrim(), faces, bound
        if bare.any():
            yield mesh.GetPrim(), np.flatnonzero(bare), True


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


def _ancestors(prim: Usd.Prim) -> list[Usd.Prim]:
    """Return a prim and all above it, without the root of the stage."""
    found = []
    while prim and not prim.IsPseudoRoot():
        found.append(prim)
        prim = prim.GetParent()
    return found


def _known(stage: Usd.Stage) -> str:
    """Say which meshes a stage has, whether they are seen or not."""
    prims = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    found = [str(prim.GetPath()) for prim in prims if prim.IsA(UsdGeom.Mesh)]
    return f"meshes in this file: {listed(found, _NAMED)}" if found else "there is none in this file"
