"""Runs side by side in one stage, which refers to theirs."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Kind, Tf, Usd, UsdGeom

from ..errors import InputError
from ..files import whole_file
from .common import ForceRange, color_by, corners_of, force_range, motion_bounds, union, widest
from .prims import BODIES, CAMERA, COLLIDERS, LIGHTS, RUNS, WORLD, facing, vectors
from .stagefiles import failed_write, find_stage, open_stage
from .surroundings import aim_camera
from .usd import define_lights

RUN = "run"
"""Custom data of each run's prim: its name, its parameters, and the time codes at which it starts and ends."""

# Space between runs, as a share of the box that each of them moves in.
_GAP = 0.2
# Higher above than the camera of a single run, so that no row hides the one behind.
_CAMERA_DIRECTION = (0.1, 0.75, 1.0)


@dataclass(frozen=True)
class Compared:
    """A run to be compared."""

    name: str
    source: Path
    """Run directory or stage."""
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Read:
    """What a comparison has to know of a run's stage."""

    path: Path
    bounds: np.ndarray
    """Of its motion, in its own axes [2, 3], m."""
    up_axis: str
    rate: float
    """Time codes per second."""
    codes: tuple[float, float]
    """The first and the last one."""
    legend: dict[str, Any]
    force_range: ForceRange | None


def write_comparison(runs: Sequence[Compared], output: Path, *, columns: int | None = None) -> None:
    """Write a stage that shows runs side by side, all starting at once.

    Each run is its own stage, moved by its place in the grid and otherwise where it was: rows from the back to the
    front, one column beside the other. There are one camera and one set of lights; floors end at the edge of their
    place; and colours mean the same force in all runs, but for those that were written with ``color = "rgb"``.

    Args:
        runs: what to show.
        output: the file to make, .usda; it refers to the stages by relative paths.
        columns: runs in a row; as the parameters suggest unless given.

    Raises:
        InputError: there is nothing to compare, or what is to be compared is not the stage of a run.
        EnvironmentFailedError: the file cannot be written.
    """
    if output.suffix.lower() != ".usda":
        raise InputError(f"{output}: a comparison is a file that ends in .usda")
    if len(runs) < 2:
        raise InputError("a comparison takes at least two runs")
    read = [_read(run) for run in runs]
    up_axis, rate = read[0].up_axis, max(each.rate for each in read)
    turns = [_turn(each.up_axis, up_axis) for each in read]
    # All places are alike, so that runs that start at the same place do so here, too.
    place = union(_turned(each.bounds, turn) for each, turn in zip(read, turns, strict=True))
    offsets = _grid(len(runs), columns or _columns(runs), place, up_axis)
    ranges = [each.force_range for each in read if each.force_range is not None]
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as unfinished:
            stage = Usd.Stage.CreateNew(str(unfinished))
            _define_world(stage, output, up_axis, rate)
            names: set[str] = set()
            for run, each, turn, offset in zip(runs, read, turns, offsets, strict=True):
                prim = _refer(stage, _identifier(run.name, names), each, turn, offset, unfinished.parent)
                prim.SetDisplayName(run.name)
                start, end = (code * rate / each.rate for code in each.codes)
                told = {"name": run.name, "parameters": json.dumps(run.parameters, default=str)}
                prim.SetCustomDataByKey(RUN, {**told, "startTimeCode": start, "endTimeCode": end})
                _crop_floors(prim, _turned(_cell(place, up_axis), turn.T))
                if each.force_range is not None:
                    color_by(prim, each.force_range, widest(ranges))
            stage.SetStartTimeCode(min(each.codes[0] * rate / each.rate for each in read))
            stage.SetEndTimeCode(max(each.codes[1] * rate / each.rate for each in read))
            if ranges:
                meaning = {**read[0].legend, "range": Gf.Vec2d(*widest(ranges))}
                stage.GetPrimAtPath(WORLD).SetCustomDataByKey("legend", meaning)
            seen = [
                corners_of(_turned(each.bounds, turn)) + offset
                for each, turn, offset in zip(read, turns, offsets, strict=True)
            ]
            camera = UsdGeom.Camera.Define(stage, CAMERA)
            aim_camera(camera, facing(_CAMERA_DIRECTION, up_axis), np.concatenate(seen))
            define_lights(stage, up_axis)
            stage.GetRootLayer().Save()
    except (Tf.ErrorException, OSError) as error:
        raise failed_write(output, error) from error


def require_comparable(run: Compared) -> None:
    """Raise InputError where a run cannot be read, or has no world of its own."""
    _read(run)


def _read(run: Compared) -> _Read:
    stage = open_stage(run.source)
    world, bounds = stage.GetPrimAtPath(WORLD), motion_bounds(stage)
    if bounds is None:
        raise InputError(
            f"{run.source}: has no bodies below {BODIES}, as no run over a shot has, so it cannot be compared"
        )
    return _Read(
        path=find_stage(run.source),
        bounds=bounds,
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        rate=stage.GetTimeCodesPerSecond(),
        codes=(stage.GetStartTimeCode(), stage.GetEndTimeCode()),
        legend=world.GetCustomDataByKey("legend") or {},
        force_range=force_range(stage),
    )


def _turn(own: str, shared: str) -> np.ndarray:
    """Return the rotation [3, 3] about x, of columns, that turns one up axis into another."""
    if own == shared:
        return np.eye(3)
    return np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]] if own == "Z" else [[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)


def _turned(bounds: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return a box [2, 3] after a quarter turn."""
    return np.sort(bounds @ turn.T, axis=0)


def _grid(count: int, columns: int, place: np.ndarray, up_axis: str) -> np.ndarray:
    """Return how much each run is moved [count, 3], m."""
    across, towards = np.array([1.0, 0, 0]), np.array([0, 0, 1.0] if up_axis == "Y" else [0, -1.0, 0])
    step = (1 + _GAP) * np.ptp(place, axis=0)
    row, column = np.divmod(np.arange(count), columns)
    return np.outer(column, across * step) + np.outer(row, towards * step)


def _columns(runs: Sequence[Compared]) -> int:
    """Return a number of columns, about that of rows; the last parameter goes through its values in a row if it can."""
    wanted = math.sqrt(len(runs))
    last = next(reversed(list(runs[0].parameters)), None)
    values = len({json.dumps(run.parameters.get(last), default=str) for run in runs}) if last else 1
    fitting = [count for count in range(values, len(runs) + 1, values) if len(runs) % count == 0]
    best = min(fitting, key=lambda count: abs(math.log(count / wanted)), default=0)
    return best if last and wanted / 2 <= best <= 2 * wanted else math.ceil(wanted)


def _cell(place: np.ndarray, up_axis: str) -> np.ndarray:
    """Return the box [2, 3] that belongs to each run: its place, half the gaps around it, and what is below it, m."""
    size = np.ptp(place, axis=0)
    margin = _GAP / 2 * size
    margin["XYZ".index(up_axis)] = 0.0
    cell = np.stack([place[0] - margin, place[1] + margin])
    cell[0, "XYZ".index(up_axis)] -= np.linalg.norm(size)
    return cell


def _define_world(stage: Usd.Stage, output: Path, up_axis: str, rate: float) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    world = UsdGeom.Xform.Define(stage, WORLD).GetPrim()
    stage.SetDefaultPrim(world)
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    Usd.ModelAPI(world).SetAssetName(output.stem)
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, RUNS)).SetKind(Kind.Tokens.group)


def _identifier(name: str, taken: set[str]) -> str:
    """Return a name for the prim of a run, and note that it is taken."""
    made = valid = Tf.MakeValidIdentifier(name)
    number = 1
    while made in taken:
        number += 1
        made = f"{valid}_{number}"
    taken.add(made)
    return made


def _refer(stage: Usd.Stage, name: str, read: _Read, turn: np.ndarray, offset: np.ndarray, folder: Path) -> Usd.Prim:
    """Bring the stage of a run in, without its camera and lights; USD itself converts time codes of other rates."""
    shape = UsdGeom.Xform.Define(stage, RUNS.AppendChild(name))
    try:
        asset = Path(os.path.relpath(read.path.resolve(), folder.resolve())).as_posix()
    except ValueError as error:
        raise InputError(f"{read.path}: is on another drive than the comparison") from error
    shape.GetPrim().GetReferences().AddReference(asset if asset.startswith("..") else f"./{asset}")
    shape.AddTranslateOp().Set(Gf.Vec3d(*offset.tolist()))
    if (angle := np.degrees(np.arctan2(turn[2, 1], turn[1, 1]))) != 0:
        shape.AddRotateXOp().Set(angle)
    for path in (CAMERA, LIGHTS):
        stage.OverridePrim(path.ReplacePrefix(WORLD, shape.GetPath())).SetActive(False)
    return shape.GetPrim()


def _crop_floors(run: Usd.Prim, cell: np.ndarray) -> None:
    """Let the rectangles that a run collides with end at the edge of its cell [2, 3], in its own axes, m."""
    colliders = run.GetPrimAtPath(COLLIDERS.MakeRelativePath(WORLD))
    for prim in colliders.GetChildren() if colliders else ():
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        cropped = _cropped(np.array(mesh.GetPointsAttr().Get(), np.float64), cell)
        if cropped is None:
            prim.SetActive(False)
        else:
            mesh.GetPointsAttr().Set(vectors(cropped))
            mesh.GetExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))


def _cropped(corners: np.ndarray, box: np.ndarray) -> np.ndarray | None:
    """Return the smallest rectangle [4, 3] along the sides of another that has all of it that is in a box [2, 3].

    None if nothing is.
    """
    inside = corners
    for axis in range(3):
        inside = _clipped(inside, inside[:, axis] - box[0, axis])
        inside = _clipped(inside, box[1, axis] - inside[:, axis])
    if len(inside) < 3:
        return None
    sides = corners[[1, 3]] - corners[0]
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    at = (inside - corners[0]) @ sides.T
    (left, bottom), (right, top) = at.min(axis=0), at.max(axis=0)
    return corners[0] + np.array([[left, bottom], [right, bottom], [right, top], [left, top]]) @ sides


def _clipped(polygon: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the part of a convex polygon [n, 3] where a depth, linear in space and given at its corners, is > 0."""
    kept = []
    for i, (corner, own) in enumerate(zip(polygon, depth, strict=True)):
        before = depth[i - 1]
        if (own > 0) != (before > 0):
            kept.append(corner + (polygon[i - 1] - corner) * (own / (own - before)))
        if own > 0:
            kept.append(corner)
    return np.array(kept).reshape(-1, 3)
