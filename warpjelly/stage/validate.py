"""Is a stage sound? USD's own validators, and what they miss: every array of every shape at every time sample."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdShade, UsdUtils, UsdValidation

from ..errors import reason
from .comparison import RUN
from .stagefiles import open_stage, overridden, silent_usd

# The newest crate version that common viewers open.
MAX_CRATE_VERSION = (0, 8, 0)

_METADATA = ("metersPerUnit", "upAxis", "startTimeCode", "endTimeCode", "timeCodesPerSecond", "framesPerSecond")
_EXTENT_TOLERANCE = 1e-5


def stage_problems(path: Path) -> list[str]:
    """Return what is wrong with a stage file or the stage of a run directory, one line each; none if it is sound.

    A problem that several samples share is listed once, with the first of them. Of a shot that a run has written over
    only the meshes that it has moved are looked at, and what USD's own validators do not say of the shot alone.

    Raises:
        InputError: there is no such file, or it is not a USD file.
    """
    stage = open_stage(path)
    found: list[str] = []
    over = overridden(stage)
    try:
        with silent_usd():
            for check in (_layers, _own_problems, _metadata, _over_shapes) if over else _CHECKS:
                found += check(stage)
    except Tf.ErrorException as error:
        found.append(f"the file is damaged: {reason(error)}")
    return found


def _shapes(stage: Usd.Stage) -> Iterator[str]:
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim):
            yield from _summed_up(prim, _shape(stage, prim))


def _over_shapes(stage: Usd.Stage) -> Iterator[str]:
    for path in overridden(stage):
        prim = stage.GetPrimAtPath(path)
        if not prim.IsA(UsdGeom.Mesh):
            yield f"{path}: no mesh is there any more, so its motion is not seen"
            continue
        times = UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples()
        problems = ((time, problem) for time in times for problem in _sample(UsdGeom.Mesh(prim), Usd.TimeCode(time)))
        yield from _summed_up(prim, problems)


def _summed_up(prim: Usd.Prim, problems: Iterable[tuple[float | None, str]]) -> Iterator[str]:
    """List each of the problems of a prim once, with the first of the samples that have it."""
    samples_with: dict[str, list[float | None]] = {}
    for time, problem in problems:
        samples_with.setdefault(problem, []).append(time)
    for problem, times in samples_with.items():
        yield f"{prim.GetPath()}: {problem}{_located(times)}"


def _located(times: list[float | None]) -> str:
    """Say at which samples a problem shows; None stands for the prim as a whole."""
    if times[0] is None:
        return ""
    where = " at rest" if np.isnan(times[0]) else f" at time {times[0]:g}"
    return where + (f" and {len(times) - 1} more" if len(times) > 1 else "")


def _files(stage: Usd.Stage) -> Iterator[str]:
    """Check the files that the stage is made of: format version, and paths that break when the stage moves."""
    yield from _sound_files(stage.GetUsedLayers())


def _layers(stage: Usd.Stage) -> Iterator[str]:
    """Check the files of a run over a shot, but not those of the shot."""
    folder = Path(stage.GetRootLayer().realPath).parent
    yield from _sound_files(layer for layer in stage.GetUsedLayers() if folder in Path(layer.realPath).parents)


def _sound_files(layers: Iterable[Sdf.Layer]) -> Iterator[str]:
    for layer in layers:
        if not layer.realPath:
            continue
        with open(layer.realPath, "rb") as file:
            header = file.read(11)
        version = tuple(header[8:11])
        if header.startswith(b"PXR-USDC") and version > MAX_CRATE_VERSION:
            newest = ".".join(map(str, MAX_CRATE_VERSION))
            yield f"{layer.GetDisplayName()}: crate version {'.'.join(map(str, version))} is newer than {newest}"
        for asset in _asset_paths(layer):
            if Path(asset).is_absolute():
                yield f"{layer.GetDisplayName()}: absolute asset path {asset}"


def _asset_paths(layer: Sdf.Layer) -> set[str]:
    found: set[str] = set()

    def note(asset: str) -> str:
        found.add(asset)
        return asset

    # The only call that visits every kind of asset path changes them as it goes, hence the copy.
    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    UsdUtils.ModifyAssetPaths(copy, note)
    return found


def _usd_validators(stage: Usd.Stage) -> Iterator[str]:
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    for error in context.Validate(stage):
        if not error.HasNoError():
            yield f"{error.GetMessage()} ({error.GetIdentifier()})"


def _own_problems(stage: Usd.Stage) -> Iterator[str]:
    """Return what USD says of a run over a shot, but not of the shot alone."""
    root = stage.GetRootLayer()
    known = set()
    for path in root.subLayerPaths[-1:]:
        shot = Sdf.Layer.FindOrOpen(root.ComputeAbsolutePath(path))
        # Some of the problems name the stage.
        known = {problem.replace(shot.identifier, root.identifier) for problem in _usd_validators(Usd.Stage.Open(shot))}
    yield from (problem for problem in _usd_validators(stage) if problem not in known)


def _metadata(stage: Usd.Stage) -> Iterator[str]:
    for key in _METADATA:
        if not stage.HasAuthoredMetadata(key):
            yield f"stage: {key} is not authored"
    if stage.GetTimeCodesPerSecond() <= 0:
        yield f"stage: timeCodesPerSecond is {stage.GetTimeCodesPerSecond():g}"
    if stage.GetStartTimeCode() > stage.GetEndTimeCode():
        yield f"stage: starts at {stage.GetStartTimeCode():g}, after its end at {stage.GetEndTimeCode():g}"


def _structure(stage: Usd.Stage) -> Iterator[str]:
    default = stage.GetDefaultPrim()
    if not default:
        yield "stage: no default prim"
    for prim in stage.GetPseudoRoot().GetChildren():
        if default and prim != default:
            yield f"{prim.GetPath()}: beside the default prim, so references lose it"
    if not any(prim.IsA(UsdGeom.Camera) for prim in stage.Traverse()):
        yield "stage: no camera"


def _shape(stage: Usd.Stage, prim: Usd.Prim) -> Iterator[tuple[float | None, str]]:
    """Yield (time, problem) for one shape; time is None for the whole prim and NaN for rest (default) values."""
    gprim = UsdGeom.Gprim(prim)
    if (
        not UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        and not gprim.GetDisplayColorAttr().HasAuthoredValue()
    ):
        yield None, "neither material nor displayColor"
    points_attribute = UsdGeom.PointBased(prim).GetPointsAttr() if prim.IsA(UsdGeom.PointBased) else None
    if points_attribute and points_attribute.Get() is None:
        yield None, "no rest (default) points"
    if prim.IsA(UsdGeom.Mesh) and UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none:
        yield None, "subdivisionScheme is not none"
    times = points_attribute.GetTimeSamples() if points_attribute else []
    if times:
        yield from _sampling(stage, prim, times)
    for code in [Usd.TimeCode.Default(), *map(Usd.TimeCode, times)]:
        for problem in _sample(gprim, code):
            yield code.GetValue(), problem


def _sampling(stage: Usd.Stage, prim: Usd.Prim, times: list[float]) -> Iterator[tuple[None, str]]:
    start, end = _time_range(stage, prim)
    if times[0] > start or times[-1] < end:
        yield None, f"samples {times[0]:g} to {times[-1]:g} do not cover the time range {start:g} to {end:g}"
    steps = np.diff(times)
    if steps.size and np.ptp(steps) > 1e-6:
        yield None, "samples are not evenly spaced"
    for attribute in prim.GetAuthoredAttributes():
        own = attribute.GetTimeSamples()
        if own and own != times:
            yield None, f"{attribute.GetName()} and points are sampled at different times"


def _time_range(stage: Usd.Stage, prim: Usd.Prim) -> tuple[float, float]:
    """Return the first and last time code at which a shape moves: those of its run, where a stage has several."""
    while prim:
        if run := prim.GetCustomDataByKey(RUN):
            return run["startTimeCode"], run["endTimeCode"]
        prim = prim.GetParent()
    return stage.GetStartTimeCode(), stage.GetEndTimeCode()


def _sample(gprim: UsdGeom.Gprim, code: Usd.TimeCode) -> Iterator[str]:
    """Check the arrays of a shape at one time against each other."""
    prim = gprim.GetPrim()
    if not prim.IsA(UsdGeom.PointBased):
        yield from _extent(gprim, code)
        return
    shape = UsdGeom.PointBased(prim)
    points = shape.GetPointsAttr().Get(code)
    if points is None:
        # The missing rest points are reported for the prim as a whole.
        return
    if not np.isfinite(np.asarray(points)).all():
        yield "non-finite points"
    else:
        yield from _extent(gprim, code)
    face_count = corner_count = 0
    if prim.IsA(UsdGeom.Mesh):
        mesh = UsdGeom.Mesh(prim)
        counts, indices = mesh.GetFaceVertexCountsAttr().Get(code), mesh.GetFaceVertexIndicesAttr().Get(code)
        if counts is None or indices is None:
            yield "no topology"
            return
        sound, why = UsdGeom.Mesh.ValidateTopology(indices, counts, len(points))
        if not sound:
            yield f"topology: {why}"
        face_count, corner_count = len(counts), len(indices)
    sizes = {
        UsdGeom.Tokens.constant: 1,
        UsdGeom.Tokens.uniform: face_count,
        UsdGeom.Tokens.vertex: len(points),
        UsdGeom.Tokens.varying: len(points),
        UsdGeom.Tokens.faceVarying: corner_count,
    }
    # Curves have other counts of uniform values; of them, only what goes by points is checked.
    checked = sizes if prim.IsA(UsdGeom.Mesh) else {UsdGeom.Tokens.vertex: len(points)}
    for name, attribute, interpolation in (
        ("normals", shape.GetNormalsAttr(), shape.GetNormalsInterpolation()),
        ("velocities", shape.GetVelocitiesAttr(), UsdGeom.Tokens.vertex),
    ):
        array = attribute.Get(code)
        if array is None:
            continue
        if interpolation in checked and len(array) != checked[interpolation]:
            yield f"{len(array)} {name} ({interpolation}) where there should be {checked[interpolation]}"
        if not np.isfinite(np.asarray(array)).all():
            yield f"non-finite {name}"
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithAuthoredValues():
        yield from _primvar(primvar, code, checked)


def _extent(gprim: UsdGeom.Gprim, code: Usd.TimeCode) -> Iterator[str]:
    extent = gprim.GetExtentAttr().Get(code)
    expected = UsdGeom.Boundable.ComputeExtentFromPlugins(gprim, code)
    if extent is None:
        yield "no extent"
    elif len(extent) != 2 or not np.allclose(
        np.asarray(extent), np.asarray(expected), rtol=_EXTENT_TOLERANCE, atol=_EXTENT_TOLERANCE
    ):
        yield "wrong extent"


def _primvar(primvar: UsdGeom.Primvar, code: Usd.TimeCode, sizes: dict[str, int]) -> Iterator[str]:
    name, values = primvar.GetPrimvarName(), primvar.Get(code)
    # A single value that is not an array is constant and has nothing to get wrong.
    if values is None or not primvar.GetTypeName().isArray:
        return
    table = np.asarray(values)
    if np.issubdtype(table.dtype, np.floating) and not np.isfinite(table).all():
        yield f"non-finite {name}"
    count = len(table)
    if primvar.IsIndexed():
        indices = np.asarray(primvar.GetIndices(code))
        if indices.size and not (indices.min() >= 0 and indices.max() < len(table)):
            yield f"{name} has indices outside its {len(table)} values"
        count = len(indices)
    interpolation = primvar.GetInterpolation()
    if interpolation in sizes and count != sizes[interpolation] * primvar.GetElementSize():
        yield f"{count} {name} ({interpolation}) where there should be {sizes[interpolation]}"


_CHECKS = (_files, _usd_validators, _metadata, _structure, _shapes)
