"""Runs side by side: each is its own stage moved to its place, sound as a whole, and comparable."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pxr import Usd, UsdGeom, UsdLux, UsdShade
from stages import cube_surface, make_scene, moved_surface, start_stage, write_stage

from warpjelly.colors import LINEAR_TABLE, color_indices
from warpjelly.errors import InputError
from warpjelly.stage.common import color_by, corners_of
from warpjelly.stage.comparison import RUN, Compared, _cropped, write_comparison
from warpjelly.stage.prims import RUNS
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

FRAMES = 10
SURFACE = "bodies/cube/surface"


def write_clips(folder: Path, **changes: Any) -> Path:
    """Leave a stage in parts."""
    mesh = cube_surface(center=(0.4, 0.5, 0.0))
    writer = start_stage(folder, [mesh], make_scene(output={"format": "clips"}, **changes))
    for frame in range(FRAMES):
        writer.write_frame(frame, [moved_surface(mesh, frame)])
        if frame == 4:
            writer.flush()
    writer.finish()
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> list[Compared]:
    """Return runs that differ in place, length, frame rate, up axis and format."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ("plain", "fast", "upright"):
        (folder / name).mkdir()
    stages = [
        write_stage(folder / "plain" / "stage.usdc", frames=FRAMES),
        write_stage(folder / "fast" / "stage.usdc", make_scene(fps=60.0), frames=2 * FRAMES),
        write_stage(folder / "upright" / "stage.usdc", make_scene(up_axis="Z"), frames=FRAMES),
        write_clips(folder / "k0.1", fps=30.0),
        write_clips(folder / "k0_1"),
    ]
    return [
        Compared(path.parent.name if path.is_file() else path.name, path, {"number": i})
        for i, path in enumerate(stages)
    ]


@pytest.fixture(scope="module")
def comparison(runs) -> Path:
    """Return a comparison of them, two in a row."""
    path = runs[0].source.parents[1] / "comparison.usda"
    write_comparison(runs, path, columns=2)
    return path


def points_of(stage: Usd.Stage, path: str, time: float) -> np.ndarray:
    """Return the points of a mesh in world space [point_count, 3], m."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    matrix = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(mesh.GetPrim()))
    return np.array(mesh.GetPointsAttr().Get(time)) @ matrix[:3, :3] + matrix[3, :3]


# The quarter turn that brings z up to y up.
UPRIGHT = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_each_run_is_where_it_was_and_its_place_in_the_grid(runs, comparison) -> None:
    """Compare all points, at frames and halfway between, with those of the run, turned, and moved by whole places."""
    assert stage_problems(comparison) == []
    stage = open_stage(comparison)
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Y")
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode()) == (60.0, 0.0)
    # The last frame of the longest run, in seconds: 9 / 24 of 10 frames at 24 a second, above 19 / 60.
    assert stage.GetEndTimeCode() == pytest.approx(9 / 24 * 60)
    prims = stage.GetPrimAtPath(RUNS).GetChildren()
    assert [prim.GetName() for prim in prims] == ["plain", "fast", "upright", "k0_1", "k0_1_2"]
    assert [prim.GetCustomDataByKey(RUN)["name"] for prim in prims] == [run.name for run in runs]
    turns = [UPRIGHT if run.name == "upright" else np.eye(3) for run in runs]
    everywhere = []
    for run, turn in zip(runs, turns, strict=True):
        own = open_stage(run.source)
        ends = range(round(own.GetEndTimeCode()) + 1)
        everywhere += [points_of(own, f"/World/{SURFACE}", frame) @ turn.T for frame in ends]
    size = np.ptp(np.concatenate(everywhere), axis=0)
    for number, (run, turn, prim) in enumerate(zip(runs, turns, prims, strict=True)):
        own = open_stage(run.source)
        row, column = divmod(number, 2)
        place = 1.2 * size * [column, 0, row]
        for code in np.arange(0, own.GetEndTimeCode() + 0.25, 0.5):
            found = points_of(stage, f"{prim.GetPath()}/{SURFACE}", code * 60 / own.GetTimeCodesPerSecond())
            expected = points_of(own, f"/World/{SURFACE}", code) @ turn.T + place
            # Rounding of float32 points and extents of some metres.
            np.testing.assert_allclose(found, expected, atol=2e-6)


def test_there_is_one_camera_that_sees_all_and_one_set_of_lights(runs, comparison) -> None:
    """Find all corners of the motion of all runs in the picture, and no camera or light of theirs."""
    stage = open_stage(comparison)
    cameras = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert [str(prim.GetPath()) for prim in cameras] == ["/World/camera"]
    lights = [str(prim.GetPath()) for prim in stage.Traverse() if prim.HasAPI(UsdLux.LightAPI)]
    assert sorted(lights) == ["/World/lights/fill", "/World/lights/key", "/World/lights/sky"]
    frustum = UsdGeom.Camera(cameras[0]).GetCamera(0).frustum
    for prim in stage.GetPrimAtPath(RUNS).GetChildren():
        path = f"{prim.GetPath()}/{SURFACE}"
        assert UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()[0]
        for time in np.linspace(0, stage.GetEndTimeCode(), 7):
            points = points_of(stage, path, time)
            for corner in corners_of(np.array([points.min(axis=0), points.max(axis=0)])):
                assert frustum.Intersects(corner.tolist())


def test_floors_end_at_the_edge_of_their_place(runs, comparison) -> None:
    """Find the floors, 10 m wide, side by side without a gap or an overlap."""
    stage = open_stage(comparison)
    boxes = []
    for prim in stage.GetPrimAtPath(RUNS).GetChildren():
        if prim.GetName() != "upright":
            corners = points_of(stage, f"{prim.GetPath()}/colliders/floor", 0)
            np.testing.assert_allclose(corners[:, 1], 0.0, atol=1e-9)
            boxes.append([corners.min(axis=0), corners.max(axis=0)])
    plain, fast, other, _ = boxes
    assert fast[0][0] == pytest.approx(plain[1][0], abs=1e-5)
    np.testing.assert_allclose(np.subtract(*fast), np.subtract(*plain), atol=1e-5)
    assert other[0][2] == pytest.approx(plain[1][2], abs=1e-5)


def test_colors_mean_the_same_force_in_all_runs(tmp_path) -> None:
    """Hold colours against the forces that they show, up to the rounding to 256 colours in both ranges."""
    runs, forces = [], []
    for name, limits in (("weak", [0.0, 8.0]), ("strong", [1.0, 20.0])):
        (tmp_path / name).mkdir()
        scene = make_scene(output={"force_range": limits, "forces": True})
        runs.append(Compared(name, write_stage(tmp_path / name / "stage.usdc", scene)))
        own = open_stage(runs[-1].source)
        primvars = UsdGeom.PrimvarsAPI(own.GetPrimAtPath(f"/World/{SURFACE}"))
        # What a run's own range cuts off stays cut off.
        forces.append(np.clip(np.array(primvars.GetPrimvar("force").Get(7)), *limits))
    write_comparison(runs, tmp_path / "c.usda")
    stage = open_stage(tmp_path / "c.usda")
    assert tuple(stage.GetPrimAtPath("/World").GetCustomDataByKey("legend")["range"]) == (0.0, 20.0)
    for run, force in zip(runs, forces, strict=True):
        shown = UsdGeom.Gprim(stage.GetPrimAtPath(f"{RUNS}/{run.name}/{SURFACE}")).GetDisplayColorPrimvar()
        colors = np.array(shown.ComputeFlattened(7))
        entries = np.abs(colors[:, None] - LINEAR_TABLE[None]).sum(axis=2).argmin(axis=1)
        assert np.abs(entries - color_indices(force, (0.0, 20.0))).max() <= 1
        assert np.ptp(entries) > 20


def test_colors_stored_frame_by_frame_are_changed_alike(tmp_path) -> None:
    """Bring a stage with plain colours into another range at some frames: the same colours as with a table."""
    found = []
    for color in ("rgb", "indexed"):
        stage = open_stage(write_stage(tmp_path / f"{color}.usdc", make_scene(output={"color": color})))
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            own = tuple(stage.GetPrimAtPath("/World").GetCustomDataByKey("legend")["range"])
            color_by(stage.GetPseudoRoot(), own, (0.0, 2 * own[1]), [3, 7])
        shown = UsdGeom.Gprim(stage.GetPrimAtPath(f"/World/{SURFACE}")).GetDisplayColorPrimvar()
        found.append([np.array(shown.ComputeFlattened(frame)) for frame in (3, 7)])
    np.testing.assert_allclose(found[0], found[1], atol=1e-7)


def test_the_folder_may_be_moved(runs, comparison, tmp_path) -> None:
    """Open a copy elsewhere, which refers to nothing but what was copied with it."""
    moved = tmp_path / "moved, to a påth"
    shutil.copytree(comparison.parent, moved)
    stage = open_stage(moved / comparison.name)
    assert stage_problems(moved / comparison.name) == []
    files = [Path(layer.realPath) for layer in stage.GetUsedLayers() if layer.realPath]
    assert len(files) > len(runs)
    assert all(file.is_relative_to(moved) for file in files)


@given(
    turn=st.floats(0, 6.3),
    tilt=st.floats(-3.1, 3.1),
    roll=st.floats(-1.5, 1.5),
    size=st.floats(0.1, 30),
    shift=st.floats(-2, 2),
)
def test_cropped_rectangles_keep_what_is_in_the_box(turn, tilt, roll, size, shift) -> None:
    """Crop rectangles at all angles: none grows, nothing in the box is lost, and each side touches what is kept."""
    box = np.array([[-1.0, -0.5, -1.5], [1.0, 2.0, 0.5]])
    c, s = np.cos([turn, tilt, roll]), np.sin([turn, tilt, roll])
    axes = np.array([[c[0], 0, s[0]], [0, 1, 0], [-s[0], 0, c[0]]]) @ [[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]]
    axes = axes @ [[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]]
    sides = axes[:2] * [[size], [size / 2]]
    origin = shift - sides.sum(axis=0) / 2
    corners = origin + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ sides
    share = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 61)]), axis=-1).reshape(-1, 2)
    points = origin + share @ sides
    inside = ((points > box[0]) & (points < box[1])).all(axis=1)
    cropped = _cropped(corners, box)
    if cropped is None:
        assert not inside.any()
        return
    at = (cropped - origin) @ np.linalg.inv(np.stack([*sides, np.cross(*sides)]))
    np.testing.assert_allclose(at[:, 2], 0, atol=1e-6)
    low, high = at[0, :2], at[2, :2]
    np.testing.assert_allclose(at[[1, 3], :2], [[high[0], low[1]], [low[0], high[1]]], atol=1e-9)
    assert (low >= -1e-9).all()
    assert (high <= 1 + 1e-9).all()
    assert (share[inside] >= low - 1e-9).all()
    assert (share[inside] <= high + 1e-9).all()


def test_columns_follow_the_last_parameter(runs, tmp_path) -> None:
    """Put all values of the last parameter into each row, where that makes about as many rows as columns.

    Where runs are missing, there are no whole rows.
    """
    source = runs[0].source
    swept = [Compared(f"r{i}", source, {"a": i // 3, "b": i % 3}) for i in range(12)]
    write_comparison([swept[0], swept[1], swept[3]], tmp_path / "few.usda")
    assert [len(set(column)) for column in _places(tmp_path / "few.usda").T.tolist()] == [2, 1, 2]
    write_comparison(swept, tmp_path / "c.usda")
    assert [len(set(column)) for column in _places(tmp_path / "c.usda").T.tolist()] == [3, 1, 4]


def _places(path: Path) -> np.ndarray:
    """Return where the runs of a comparison are [count, 3], m."""
    stage = open_stage(path)
    runs = stage.GetPrimAtPath(RUNS).GetChildren()
    places = [UsdGeom.Xformable(prim).GetLocalTransformation().ExtractTranslation() for prim in runs]
    return np.array(places).round(6)


@pytest.mark.parametrize(
    ("count", "name", "message"),
    [(1, "c.usda", "at least two runs"), (2, "c.usdc", "ends in .usda"), (0, "c.usda", "at least two runs")],
)
def test_what_cannot_be_compared_is_refused(runs, tmp_path, count, name, message) -> None:
    """Refuse single runs and other formats in one line."""
    with pytest.raises(InputError, match=message):
        write_comparison(runs[:count], tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_stages_without_bodies_are_refused(runs, tmp_path) -> None:
    """Name the stage that is not one of a run."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "other.usda"))
    UsdGeom.Xform.Define(stage, "/World")
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"other.usda: has no bodies"):
        write_comparison([runs[0], Compared("other", tmp_path / "other.usda")], tmp_path / "c.usda")
