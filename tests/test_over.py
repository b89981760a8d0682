"""Runs over a shot: motion in the space and the time of its meshes, and nothing else of it touched."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel
from runs import samples_of
from shots import (
    CORNERS,
    DRIFT,
    END,
    FACES,
    FPS,
    FRAMES,
    HARD,
    OUTWARD,
    RATE,
    SMOOTH,
    START,
    UNIT,
    box,
    make_shot,
    shot_scene,
    shot_tables,
)

from warpjelly import plan
from warpjelly.errors import InputError
from warpjelly.previews.preview import render_preview
from warpjelly.run import forecast, simulate
from warpjelly.simulator import Simulator
from warpjelly.stage.pack import pack
from warpjelly.stage.stagefiles import open_stage, overridden, progress
from warpjelly.stage.validate import stage_problems

GRAVITY = np.array([0.0, 0.0, -9.81])
# What a run may say of a mesh.
WRITTEN = {"points", "extent", "primvars:normals", "primvars:normals:indices", "normals", "velocities", "accelerations"}
FINISHED = ["checkpoint.npz", "metrics.csv", "override.usdc", "run.json", "stage.usda"]
# So many substeps that a run takes a while, and that small cells are stable.
SLOW = {"solver__dt": 1e-4}
# A run like that with short clips in a process of its own: shot, run directory.
SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[3])
from shots import shot_scene
from warpjelly import plan
from warpjelly.run import simulate
plan.CLIP_FRAMES = 4
simulate(shot_scene(Path(sys.argv[1]), solver__dt=1e-4), output=sys.argv[2], device="cpu", resume=True)
"""


def fallen(frame: int, substeps: int, fps: float = FPS) -> np.ndarray:
    """Return how far a body fell that nothing touches, m: semi-implicit Euler sums g dt^2 (1 + 2 + ... + n)."""
    steps = frame * substeps
    return GRAVITY * (1 / (fps * substeps)) ** 2 * steps * (steps + 1) / 2


def world_of(stage: Usd.Stage, path: str, time: float) -> np.ndarray:
    """Return the matrix of a prim for row vectors, [4, 4]."""
    return np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(stage.GetPrimAtPath(path)))


def files(folder: Path) -> list[str]:
    """Return what is in a folder but for the lock, which ends with the process that holds it."""
    return sorted(set(os.listdir(folder)) - {"run.lock"})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return the directory of a finished run, with the shot in a folder beside it."""
    folder = tmp_path_factory.mktemp("over") / "production"
    (folder / "shots").mkdir(parents=True)
    shot = make_shot(folder / "shots" / "shot.usda")
    simulate(shot_scene(shot, output__forces=True), output=folder / "runs" / "drop", device="cpu")
    return folder / "runs" / "drop"


def shot_of(run: Path) -> Path:
    """Return the shot of a run."""
    return run.parents[1] / "shots" / "shot.usda"


@pytest.mark.parametrize("moving", [False, True])
def test_a_falling_body_is_where_the_motion_takes_it(tmp_path, moving):
    """Map the analytic fall into the space of each mesh and find the points there, to the rounding of float32."""
    shot = make_shot(tmp_path / "shot.usda", moving=moving)
    scene = shot_scene(shot, output__velocities=True)
    simulate(scene, output=tmp_path / "run", device="cpu")
    substeps = scene.substeps_for(scene.solver.dt)
    before, after = Usd.Stage.Open(str(shot)), open_stage(tmp_path / "run")
    for path in (HARD, SMOOTH):
        mesh = UsdGeom.Mesh(after.GetPrimAtPath(path))
        times = mesh.GetPointsAttr().GetTimeSamples()
        assert times == [START + frame * RATE / FPS for frame in range(FRAMES)]
        rest = np.array(UsdGeom.Mesh(before.GetPrimAtPath(path)).GetPointsAttr().Get(), float)
        start = np.c_[rest, np.ones(len(rest))] @ world_of(before, path, START)
        for frame, code in enumerate(times):
            world, points = world_of(before, path, code), np.array(mesh.GetPointsAttr().Get(code), float)
            moved = start + np.append(fallen(frame, substeps) / UNIT, 0.0)
            expected = (moved @ np.linalg.inv(world))[:, :3]
            # Places are rounded in the scene, half a bit of the greatest coordinate once and, for the sum of weighted
            # differences, about as much again; then as they are stored.
            stretch = np.linalg.norm(np.linalg.inv(world[:3, :3]), 2)
            tolerance = 2**-23 * (np.abs(moved).max() * stretch * 3**0.5 + np.abs(expected).max())
            assert np.abs(points - expected).max() <= tolerance
            assert np.array_equal(mesh.GetExtentAttr().Get(code), np.float32([points.min(axis=0), points.max(axis=0)]))
            speed = GRAVITY * frame / FPS / UNIT - (DRIFT if moving else 0.0)
            found = np.array(mesh.GetVelocitiesAttr().Get(code), float)
            np.testing.assert_allclose(
                found,
                (speed @ np.linalg.inv(world[:3, :3]))[None] * np.ones((len(rest), 1)),
                atol=2e-6 * max(1.0, np.abs(speed).max()) * stretch,
            )


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("left_handed", [False, True])
def test_authored_normals_follow_the_motion(tmp_path, mirrored, left_handed):
    """Find the normals of a hard box outwards in its own space, in the order of its corners, and old ones blocked."""
    shot = make_shot(tmp_path / "shot.usda", mirrored=mirrored, left_handed=left_handed)
    simulate(shot_scene(shot, frames=3), output=tmp_path / "run", device="cpu")
    stage = open_stage(tmp_path / "run")
    hard, smooth = (UsdGeom.Mesh(stage.GetPrimAtPath(path)) for path in (HARD, SMOOTH))
    primvar = UsdGeom.PrimvarsAPI(hard).GetPrimvar("normals")
    assert primvar.GetInterpolation() == "faceVarying"
    outward = OUTWARD.reshape(6, 4, 3)[:, ::-1].reshape(-1, 3) if left_handed else OUTWARD
    for code in [Usd.TimeCode.Default(), *map(Usd.TimeCode, primvar.GetTimeSamples())]:
        # Area vectors of rounded points; the box is thinnest by a factor of six to its places.
        np.testing.assert_allclose(primvar.ComputeFlattened(code), outward, atol=1e-4)
    # Subdivision makes its own normals, and what moved as the shot said moves no more.
    assert not smooth.GetNormalsAttr().HasAuthoredValue()
    assert not hard.GetVelocitiesAttr().HasAuthoredValue()
    assert not hard.GetAccelerationsAttr().HasAuthoredValue()
    assert stage_problems(tmp_path / "run") == []


def test_all_else_of_the_shot_stays(run):
    """Find every other value, the materials, the time and the units as in the shot, whose file has not changed."""
    before, after = Usd.Stage.Open(str(shot_of(run))), open_stage(run)
    assert [prim.GetPath() for prim in before.TraverseAll()] == [prim.GetPath() for prim in after.TraverseAll()]
    for prim in before.TraverseAll():
        now = after.GetPrimAtPath(prim.GetPath())
        assert now.GetTypeName() == prim.GetTypeName()
        assert now.GetAppliedSchemas() == prim.GetAppliedSchemas()
        for prop in prim.GetAuthoredProperties():
            same = now.GetProperty(prop.GetName())
            if isinstance(prop, Usd.Relationship):
                assert same.GetTargets() == prop.GetTargets()
            elif prop.GetName() not in WRITTEN or str(prim.GetPath()) not in (HARD, SMOOTH):
                assert same.GetTimeSamples() == prop.GetTimeSamples()
                for code in [Usd.TimeCode.Default(), *map(Usd.TimeCode, prop.GetTimeSamples())]:
                    assert same.Get(code) == prop.Get(code)
    bound = [
        UsdShade.MaterialBindingAPI(after.GetPrimAtPath(path)).ComputeBoundMaterial()[0].GetPath()
        for path in (HARD, f"{HARD}/top", SMOOTH)
    ]
    assert bound == ["/set/looks/red", "/set/looks/blue", "/set/looks/blue"]
    for key in ("metersPerUnit", "upAxis", "timeCodesPerSecond", "framesPerSecond", "startTimeCode", "endTimeCode"):
        assert after.GetMetadata(key) == before.GetMetadata(key)
    assert after.GetDefaultPrim().GetPath() == "/set"
    assert after.GetRootLayer().customLayerData["department"] == "layout"


def test_only_overs_are_written(run, tmp_path):
    """Find nothing but opinions over the two meshes in what was written, and the shot the same to the byte."""
    layer = Sdf.Layer.FindOrOpen(str(run / "override.usdc"))
    found: list[Sdf.Path] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, found.append)
    prims = [path for path in found if path.IsPrimPath()]
    assert all(layer.GetPrimAtPath(path).specifier == Sdf.SpecifierOver for path in prims)
    assert {str(path) for path in prims} == {"/set", "/set/rig", "/set/rig/inner", HARD, SMOOTH}
    written = {(str(path.GetPrimPath()), path.name) for path in found if path.IsPrimPropertyPath()}
    assert {path for path, _ in written} == {HARD, SMOOTH}
    assert {name for _, name in written} == (WRITTEN | {"primvars:force"})
    assert len(Sdf.Layer.FindOrOpen(str(run / "stage.usda")).rootPrims) == 0
    fresh = make_shot(tmp_path / "shot.usda")
    assert hashlib.sha256(shot_of(run).read_bytes()).digest() == hashlib.sha256(fresh.read_bytes()).digest()
    assert files(run) == FINISHED
    stage = open_stage(run)
    force = UsdGeom.Primvar(stage.GetAttributeAtPath(f"{HARD}.primvars:force"))
    assert force.GetInterpolation() == "vertex"
    assert len(force.Get(START)) == 8


def test_it_opens_elsewhere_and_later(run, tmp_path):
    """Open the stage in another process, after its folder has moved together with the shot's, and under an offset."""
    moved = tmp_path / "moved"
    shutil.copytree(run.parents[1], moved)
    script = (
        "import sys; from pxr import Usd; stage = Usd.Stage.Open(sys.argv[1]);"
        f"print(stage.GetAttributeAtPath('{HARD}.points').Get({START + 5})[0], bool(stage.GetPrimAtPath('/set/sun')))"
    )
    command = [sys.executable, "-c", script, str(moved / "runs" / "drop" / "stage.usda")]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    stage = open_stage(run)
    expected = stage.GetAttributeAtPath(f"{HARD}.points").Get(START + 5)
    assert said == f"{expected[0]} True\n"

    later = Sdf.Layer.CreateAnonymous(".usda")
    later.timeCodesPerSecond = RATE
    later.subLayerPaths.append(str(run / "stage.usda"))
    later.subLayerOffsets[0] = Sdf.LayerOffset(100.0)
    assert Usd.Stage.Open(later).GetAttributeAtPath(f"{HARD}.points").Get(START + 105) == expected


def test_tools_take_it(run, tmp_path):
    """Find it sound, show it through the shot's camera, and pack it into one file with the same samples."""
    assert stage_problems(run) == []
    pack(run, tmp_path / "packed.usdz")
    assert stage_problems(tmp_path / "packed.usdz") == []
    assert samples_of(tmp_path / "packed.usdz") == samples_of(run)
    render_preview(run, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size > 10_000
    shutil.copytree(run, tmp_path / "alone")
    for tool in (stage_problems, lambda source: pack(source, tmp_path / "alone.usdc")):
        with pytest.raises(
            InputError, match=r"shot\.usda is missing; a run over a shot and the shot have to move together"
        ):
            tool(tmp_path / "alone")


@pytest.mark.egl
def test_a_picture_shows_the_materials_of_the_shot(run, tmp_path):
    """See the box in the red and the blue that it is bound to."""
    from PIL import Image

    render_preview(run, tmp_path / "picture.png", frames=[1003], size=(320, 180))
    pixels = np.array(Image.open(tmp_path / "picture.png")).astype(int)
    assert ((pixels[..., 0] > 150) & (pixels[..., 1:] < 110).all(axis=2)).sum() > 50
    assert ((pixels[..., 2] > 150) & (pixels[..., :2] < 110).all(axis=2)).sum() > 50


def test_a_damaged_sample_is_found(run, tmp_path):
    """Find a point that is no number, and an extent that does not fit, in the override layer."""
    shutil.copytree(run.parents[1], tmp_path / "copy")
    broken = tmp_path / "copy" / "runs" / "drop"
    layer = Sdf.Layer.FindOrOpen(str(broken / "override.usdc"))
    points = layer.QueryTimeSample(f"{HARD}.points", START)
    points[0] = (np.nan, 0, 0)
    layer.SetTimeSample(f"{HARD}.points", START, points)
    layer.SetTimeSample(f"{SMOOTH}.extent", START, [(0, 0, 0), (1, 1, 1)])
    layer.Save()
    assert stage_problems(broken) == [f"{SMOOTH}: wrong extent at time 1001", f"{HARD}: non-finite points at time 1001"]


def test_a_body_starts_as_the_shot_has_it_then(tmp_path):
    """Take points and places at the time code of the start, and samples after the shot's end along."""
    shot = make_shot(tmp_path / "shot.usda", moving=True)
    stage = Usd.Stage.Open(str(shot))
    attribute = UsdGeom.Mesh(stage.GetPrimAtPath(HARD)).GetPointsAttr()
    points = np.array(attribute.Get())
    attribute.Set(points, START)
    attribute.Set(points * 2, START + 10)
    stage.GetRootLayer().Save()
    sim = Simulator(shot_scene(shot, output__start=START + 5), device="cpu")
    [_, sample] = sim.shapes()
    world = world_of(stage, HARD, START + 5)
    np.testing.assert_allclose(sample.points, (points * 1.5 @ world[:3, :3] + world[3, :3]) * UNIT, atol=1e-6)
    simulate(shot_scene(shot, output__start=START + 5, frames=20), output=tmp_path / "run", device="cpu")
    stage = open_stage(tmp_path / "run")
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (START, END)
    simulate(shot_scene(shot, output__start=START + 5, frames=49), output=tmp_path / "longer", device="cpu")
    assert open_stage(tmp_path / "longer").GetEndTimeCode() == START + 5 + 48 * RATE / FPS


@pytest.fixture
def short_clips(monkeypatch):
    """Write clips of few frames in this process, too."""
    monkeypatch.setattr(plan, "CLIP_FRAMES", 4)


def test_a_killed_run_goes_on_as_if_nothing_had_been(tmp_path, short_clips):
    """Kill a run after its first and its fourth clip, find only good samples each time, and in the end the same."""
    shot = make_shot(tmp_path / "shot.usda", moving=True)
    simulate(shot_scene(shot, **SLOW), output=tmp_path / "whole", device="cpu")
    whole, folder = samples_of(tmp_path / "whole"), tmp_path / "run"
    command = [sys.executable, "-c", SCRIPT, str(shot), str(folder), str(Path(__file__).parent)]
    for clips in (1, 4):
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        while process.poll() is None and not (folder / "clips" / f"frames.{4 * clips:06d}.usdc").exists():
            time.sleep(0.001)
        process.kill()
        process.communicate()
        assert stage_problems(folder) == []
        frames, total = progress(open_stage(folder)) or (0, 0)
        assert 4 * clips <= frames < total == FRAMES
        moved = {key: value for key, value in samples_of(folder).items() if "/rig/" in key[0]}
        last = START + (frames - 1) * RATE / FPS
        assert moved == {key: value for key, value in whole.items() if "/rig/" in key[0] and key[1] <= last}
    simulate(shot_scene(shot, **SLOW), output=folder, device="cpu", resume=True)
    assert samples_of(folder) == whole
    assert files(folder) == FINISHED
    assert (folder / "stage.usda").read_bytes() == (tmp_path / "whole" / "stage.usda").read_bytes()


def test_a_finished_run_goes_on(tmp_path, short_clips):
    """Add frames to a finished run, in one layer or in clips, as if it had been as long from the start."""
    shot = make_shot(tmp_path / "shot.usda")
    simulate(shot_scene(shot), output=tmp_path / "whole", device="cpu")
    for layout in ("usdc", "clips"):
        folder = tmp_path / layout
        simulate(shot_scene(shot, frames=10, output__format=layout), output=folder, device="cpu")
        simulate(shot_scene(shot, output__format=layout), output=folder, device="cpu", resume=True)
        assert samples_of(folder) == samples_of(tmp_path / "whole")
        assert stage_problems(folder) == []
    assert files(tmp_path / "usdc") == FINISHED
    assert files(tmp_path / "clips") == ["checkpoint.npz", "clips", "geometry.usdc", *FINISHED[1:2], *FINISHED[3:]]
    assert overridden(open_stage(tmp_path / "clips")) == [SMOOTH, HARD]


def test_one_kind_of_run_replaces_the_other(tmp_path):
    """Leave nothing of a stage of its own when it is replaced by one over a shot, and the other way round."""
    shot = make_shot(tmp_path / "shot.usda")
    alone = shot_scene(shot, output={}, frames=3)
    simulate(shot_scene(shot, frames=3), output=tmp_path / "run", device="cpu")
    simulate(alone, output=tmp_path / "run", device="cpu", force=True)
    assert files(tmp_path / "run") == ["checkpoint.npz", "metrics.csv", "run.json", "stage.usdc"]
    simulate(shot_scene(shot, frames=3), output=tmp_path / "run", device="cpu", force=True)
    assert files(tmp_path / "run") == FINISHED


def test_a_run_goes_over_another(tmp_path):
    """Move one mesh over a run that moved the other, and find both motions and the shot."""
    shot = make_shot(tmp_path / "shot.usda")
    simulate(shot_scene(shot, bodies__0__prim=HARD, **SLOW), output=tmp_path / "first", device="cpu")
    first = tmp_path / "first" / "stage.usda"
    simulate(shot_scene(first, bodies__0__prim=SMOOTH, **SLOW), output=tmp_path / "second", device="cpu")
    before, after = samples_of(tmp_path / "first"), samples_of(tmp_path / "second")
    moved = {key: value for key, value in before.items() if key[0].startswith(HARD)}
    assert moved.items() <= after.items()
    times = [START + frame * RATE / FPS for frame in range(FRAMES)]
    assert [code for path, code in after if path == f"{SMOOTH}.points"] == times
    assert stage_problems(tmp_path / "second") == []


@pytest.mark.parametrize("options", [{}, {"force": True}, {"resume": True}])
def test_a_shot_is_not_replaced(tmp_path, options):
    """Refuse to write a run into the folder of the shot, whose names the run's own may be."""
    shot = make_shot(tmp_path / "stage.usda")
    content = shot.read_bytes()
    with pytest.raises(InputError, match=r"the shot of output\.over is in this folder; choose another with -o"):
        simulate(shot_scene(shot), output=tmp_path, device="cpu", **options)
    assert shot.read_bytes() == content
    assert os.listdir(tmp_path) == ["stage.usda"]


def test_a_bare_shot_will_do(tmp_path):
    """Take what a shot leaves out as USD does: centimetres, y up, 24 time codes a second from 0; miss a camera."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "bare.usda"))
    box(stage, "/box", FACES, (50, 50, 50))
    stage.GetRootLayer().Save()
    scene = shot_scene(tmp_path / "bare.usda", up_axis="Y", bodies__0__prim="/box", frames=6, fps=24.0, **SLOW)
    simulate(scene, output=tmp_path / "run", device="cpu")
    points = [(y, code) for (path, code), y in samples_of(tmp_path / "run").items() if path == "/box.points"]
    assert [code for _, code in points] == [0, 1, 2, 3, 4, 5]
    moved = np.frombuffer(points[-1][0], np.float32).reshape(-1, 3) - CORNERS * 50
    drop = fallen(5, scene.substeps_for(1e-4), fps=24.0)[2] / 0.01
    np.testing.assert_allclose(moved, [[0, drop, 0]] * 8, atol=2e-5)
    assert stage_problems(tmp_path / "run") == []
    with pytest.raises(InputError, match="the stage has no camera"):
        render_preview(tmp_path / "run", tmp_path / "page.html")
    stage = Usd.Stage.Open(str(tmp_path / "bare.usda"))
    UsdGeom.Camera.Define(stage, "/camera").AddTranslateOp().Set(Gf.Vec3d(0, 0, 300))
    stage.GetRootLayer().Save()
    render_preview(tmp_path / "run", tmp_path / "page.html")


def test_check_says_where_it_will_be(tmp_path, caplog):
    """Name the meshes and the time codes, and warn of a shot that goes on after the simulation."""
    figures = forecast(shot_scene(make_shot(tmp_path / "shot.usda")), device="cpu")
    last = START + (FRAMES - 1) * RATE / FPS
    assert figures["over"] == {
        "shot": str(tmp_path / "shot.usda"),
        "meshes": [SMOOTH, HARD],
        "time_codes": [START, last],
    }
    json.dumps(figures)
    assert f"the simulation ends at time code {last:g} and the shot at 1015" in caplog.text


NETWORK = {"type": "network", "material": "jelly", "points": [[0.0, 0.0, 0.0]]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"bodies__0": NETWORK},
            r"bodies\.0\.type = \"network\": with output\.over each body is a model from the shot",
        ),
        ({"bodies__0__prim": None}, r"bodies\.0\.prim: missing; with output\.over"),
        ({"bodies__0__scale": 2.0}, r"bodies\.0\.scale = 2\.0: does not go with output\.over"),
        ({"bodies__0__fit": 2.0}, r"bodies\.0\.fit = 2\.0: does not go with output\.over"),
        ({"bodies__0__file": "other.usda"}, r"bodies\.0\.file = .*each body is a part of the shot"),
        ({"output__look": "force"}, r"output\.look = \"force\": does not go with over"),
        ({"output__show": ["springs"]}, r"output\.show = \[\"springs\"\]: does not go with over"),
        ({"output__surface": "voxels"}, r"output\.surface = \"voxels\": does not go with over"),
        ({"output__over": None, "output__start": 3.0}, r"output\.start = 3\.0: goes with over"),
        ({"output__over": "drop.obj"}, r"output\.over = .*must be a USD stage"),
        ({"output__over": "nothing.usda"}, r"output\.over = .*no such file"),
        ({"up_axis": "Y"}, r"up_axis = \"Y\": the shot, .* has Z up"),
        ({"bodies__0__prim": "rig"}, r"'rig' is not the path of a prim"),
        (
            {"bodies__0__prim": "/set/nothing"},
            r"no prim /set/nothing; meshes in this file: /set/rig/inner/smooth, /set/rig/hard",
        ),
    ],
)
def test_what_does_not_go_with_a_shot_is_refused(tmp_path, changes, said):
    """Say in one line which key does not fit, and what does."""
    shot = make_shot(tmp_path / "shot.usda")
    shutil.copy(shot, tmp_path / "other.usda")
    (tmp_path / "drop.obj").write_text("v 0 0 0\n")
    with pytest.raises(InputError, match=said) as caught:
        Simulator(shot_scene(shot, **changes), device="cpu")
    assert "\n" not in str(caught.value)


def instance(stage: Usd.Stage) -> None:
    """Make the meshes those of an instance."""
    stage.DefinePrim("/set/copy").GetReferences().AddInternalReference("/set/rig")
    stage.GetPrimAtPath("/set/copy").SetInstanceable(True)


def skin(stage: Usd.Stage) -> None:
    """Let a skeleton deform a mesh."""
    UsdSkel.Root.Define(stage, "/set")
    binding = UsdSkel.BindingAPI.Apply(stage.GetPrimAtPath(SMOOTH))
    binding.CreateJointIndicesPrimvar(True, 1).Set([0])


def animate_topology(stage: Usd.Stage) -> None:
    """Give a mesh other polygons later."""
    counts = UsdGeom.Mesh(stage.GetPrimAtPath(SMOOTH)).GetFaceVertexCountsAttr()
    for code in (START, END):
        counts.Set(counts.Get(), code)


def flatten(stage: Usd.Stage) -> None:
    """Squeeze a mesh to a plane later."""
    scale = UsdGeom.Xformable(stage.GetPrimAtPath("/set/rig/inner")).AddScaleOp()
    scale.Set(Gf.Vec3f(1, 1, 1), START)
    scale.Set(Gf.Vec3f(1, 0, 1), START + 5)


def lose_a_point(stage: Usd.Stage) -> None:
    """Put the point without a face nowhere."""
    points = UsdGeom.Mesh(stage.GetPrimAtPath(SMOOTH)).GetPointsAttr()
    points.Set([*points.Get()[:8], Gf.Vec3f(np.nan)])


@pytest.mark.parametrize(
    ("change", "prim", "said"),
    [
        (
            instance,
            "/set/copy",
            r"bodies\.rig\.prim: /set/copy/inner/smooth of .* is part of an instance.*instanceable = false",
        ),
        (skin, "/set/rig", rf"{SMOOTH} of .* is deformed by a skeleton.*bake it"),
        (animate_topology, "/set/rig", rf"{SMOOTH} of .* changes its polygons with time \(faceVertexCounts\)"),
        (flatten, "/set/rig", rf"{SMOOTH} of .* is made flat by its transform at time code 1006"),
        (lose_a_point, "/set/rig", rf"{SMOOTH} has coordinates that are not finite"),
    ],
)
def test_meshes_that_cannot_be_written_over_are_refused(tmp_path, change, prim, said):
    """Name the mesh, say what is in the way, and what to do."""
    shot = make_shot(tmp_path / "shot.usda")
    stage = Usd.Stage.Open(str(shot))
    change(stage)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=said) as caught:
        Simulator(shot_scene(shot, bodies__0__prim=prim), device="cpu")
    assert "\n" not in str(caught.value)


def test_a_mesh_belongs_to_one_body(tmp_path):
    """Refuse a body whose mesh is part of another one."""
    shot = make_shot(tmp_path / "shot.usda")
    tables = shot_tables(shot)
    bodies = [*tables["bodies"], {**tables["bodies"][0], "name": "hard", "prim": HARD}]
    with pytest.raises(InputError, match=rf"bodies\.hard\.prim: {HARD} of .* belongs to 'rig' too"):
        Simulator(shot_scene(shot, bodies=bodies), device="cpu")


def test_a_changed_shot_is_not_gone_on_with(tmp_path):
    """Refuse to go on over a shot that is not the one of the run any more."""
    shot = make_shot(tmp_path / "shot.usda")
    simulate(shot_scene(shot, frames=3), output=tmp_path / "run", device="cpu")
    stage = Usd.Stage.Open(str(shot))
    stage.SetEndTimeCode(2000)
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match=r"the scene is not that of the run: .*shot\.usda \(SHA-256"):
        simulate(shot_scene(shot, frames=6), output=tmp_path / "run", device="cpu", resume=True)
