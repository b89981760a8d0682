import csv
import ctypes
import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom
from world_files import WORLDS

import warpjelly as wj
from warpjelly import cli, plan
from warpjelly.meshes import EXTENSIONS, EXTRA_EXTENSIONS, load_mesh
from warpjelly.run import forecast
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

SCENES = Path(__file__).parent.parent / "scenes"
CUBE = str(SCENES / "jello_cube.toml")
TREE = SCENES / "models" / "tree.obj"

NOISE = np.random.default_rng(0).bytes(3000)

MODEL_SCENE = """
[materials.m]
[[bodies]]
type = "model"
material = "m"
file = "FILE"
resolution = 4
"""


@pytest.fixture
def warpjelly(monkeypatch, capfd):
    """Return a function that runs a command line and gives exit code, stdout and stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["warpjelly", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as exit_code:
            cli.main()
        captured = capfd.readouterr()
        return int(exit_code.value.code or 0), captured.out, captured.err

    yield call
    # It would write to a stream that is closed after the test.
    logging.getLogger("warpjelly").handlers = []


def header_of(shape: tuple[int, ...]) -> bytes:
    """Return the header of a NumPy file of bool."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|b1", "fortran_order": False, "shape": shape})
    return file.getvalue()


def one_line(stderr: str) -> str:
    """Return the only line of an error."""
    lines = stderr.strip().splitlines()
    assert len(lines) == 1, stderr
    assert lines[0].startswith("error: ")
    return lines[0]


def test_run_writes_the_run_directory(warpjelly, tmp_path):
    """Run a scene and hold the JSON, the record, the metrics and the stage against each other."""
    code, out, err = warpjelly("run", CUBE, "--frames", 5, "-o", tmp_path / "a", "--json", "--device", "cpu")
    assert (code, err) == (0, "")
    record = json.loads(out)
    assert record.items() >= {"scene": "jello_cube", "frames": 5, "fps": 60.0, "particles": 512}.items()
    assert record.items() >= {"springs": 6220, "voxels": 1, "substeps": 34, "device": "cpu"}.items()
    assert record.items() >= {"precision": "float32", "diverged": False, "dt": 1 / (60 * 34)}.items()
    assert record["wall_seconds"] > 0
    assert record["springs_per_second"] > 0
    assert record["stage"] == str(tmp_path / "a" / "stage.usdc")
    assert record["run_dir"] == str(tmp_path / "a")
    assert json.loads((tmp_path / "a" / "run.json").read_text()) == record
    assert sorted(os.listdir(tmp_path / "a")) == ["checkpoint.npz", "metrics.csv", "run.json", "stage.usdc"]
    with open(tmp_path / "a" / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == [0, 1, 2, 3, 4]
    assert float(rows[4]["time"]) == pytest.approx(4 / 60)
    # Free fall: the velocity g t is exact in the scheme, and so is the kinetic energy of the 5.12 kg, but for rounding.
    assert float(rows[4]["kinetic"]) == pytest.approx(5.12 * (9.81 * 4 / 60) ** 2 / 2, rel=1e-4)


def test_run_and_the_python_interface_agree(warpjelly, tmp_path):
    """Write the same points as a Simulator driven by hand computes."""
    assert warpjelly("run", CUBE, "--frames", 3, "-o", tmp_path / "a", "--device", "cpu", "--quiet") == (0, "", "")
    sim = wj.Simulator(wj.load_scene(CUBE, frames=3), device="cpu")
    stage = Usd.Stage.Open(str(tmp_path / "a" / "stage.usdc"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/cube/surface"))
    for frame in range(3):
        if frame:
            sim.advance_frame()
        surface = sim.positions[sim.model.shapes[0].particles[:, 0]]
        np.testing.assert_array_equal(np.asarray(mesh.GetPointsAttr().Get(frame)), surface)
    assert stage.GetEndTimeCode() == 2


def test_steps_that_take_long_are_named():
    """Hear what a check is doing, so that a terminal can show it."""
    heard = []
    with cli._steps(heard.append):
        forecast(load_scene(SCENES / "tree_drop.toml"))
    assert heard == [
        "voxelising tree.obj at resolution 12",
        "building 'tree' of 485 particles",
        "finding the largest stable step",
        "measuring how long a frame takes",
    ]


def test_validate_lists_every_problem_and_exits_with_1(warpjelly, tmp_path):
    """Break a stage in two ways and find both."""
    warpjelly("run", CUBE, "--frames", 3, "-o", tmp_path, "--quiet")
    stage = Usd.Stage.Open(str(tmp_path / "stage.usdc"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/cube/surface"))
    points = np.array(mesh.GetPointsAttr().Get(1))
    points[0] = np.nan
    mesh.GetPointsAttr().Set(points, 1)
    stage.DefinePrim("/Elsewhere")
    stage.Save()
    code, out, _ = warpjelly("validate", tmp_path)
    assert code == 1
    assert "non-finite" in out
    assert "/Elsewhere" in out


def test_check_counts_what_run_builds(warpjelly):
    """Compare the figures of check with those of a run."""
    code, out, err = warpjelly("check", CUBE, "--json")
    assert (code, err) == (0, "")
    figures = json.loads(out)
    assert figures.items() >= {"particles": 512, "springs": 6220, "voxels": 1, "substeps": 34}.items()
    assert figures["memory_bytes"] > 0
    assert figures["seconds"] > 0
    code, out, _ = warpjelly("check", CUBE, "--set", "bodies.cube.particles_per_edge=5")
    assert code == 0
    assert re.search(r"particles +125$", out, re.MULTILINE)


def test_a_finished_run_is_kept_unless_forced(warpjelly, tmp_path):
    """Refuse to overwrite, and replace when told to."""
    assert warpjelly("run", CUBE, "--frames", 2, "-o", tmp_path)[0] == 0
    before = (tmp_path / "stage.usdc").read_bytes()
    code, _, err = warpjelly("run", CUBE, "--frames", 3, "-o", tmp_path)
    assert code == 2
    assert "--force" in one_line(err)
    assert (tmp_path / "stage.usdc").read_bytes() == before
    assert warpjelly("run", CUBE, "--frames", 3, "-o", tmp_path, "--force")[0] == 0
    assert Usd.Stage.Open(str(tmp_path / "stage.usdc")).GetEndTimeCode() == 2


def test_a_refused_scene_leaves_a_finished_run_alone(warpjelly, tmp_path):
    """Build before replacing anything, so that a typing error with --force costs nothing."""
    warpjelly("run", CUBE, "--frames", 2, "-o", tmp_path)
    before = (tmp_path / "stage.usdc").read_bytes()
    code, *_ = warpjelly("run", CUBE, "--force", "-o", tmp_path, "--set", "bodies.cube.particles_per_edge=4096")
    assert code == 2
    assert (tmp_path / "stage.usdc").read_bytes() == before


def test_a_run_that_diverges_keeps_what_came_before(warpjelly, tmp_path):
    """Exit with 3, name the particle, and leave a sound stage of the finite frames."""
    code, out, err = warpjelly("run", CUBE, "-o", tmp_path, "--json", "--set", "materials.jelly.shear.damping=5.0")
    assert code == 3
    warning, error = err.strip().splitlines()
    assert warning.startswith("warning: the time step")
    assert "particle" in one_line(error)
    assert "above the largest stable one" in error
    assert "'cube'" in err
    record = json.loads(out)
    assert record["diverged"] is True
    assert 1 <= record["frames"] < 300
    assert warpjelly("validate", tmp_path)[0] == 0
    assert json.loads((tmp_path / "run.json").read_text()) == record


def test_an_unforeseen_failure_keeps_the_frames(warpjelly, tmp_path, monkeypatch):
    """Lose the device in the middle of a run, and find a sound stage of the frames before."""
    advance = wj.Simulator.advance_frame

    def fail(sim: wj.Simulator) -> None:
        if sim.substep_count >= 3 * sim.substeps:
            raise RuntimeError("device lost")
        advance(sim)

    monkeypatch.setattr(wj.Simulator, "advance_frame", fail)
    code, _, err = warpjelly("run", CUBE, "-o", tmp_path)
    assert code == 4
    assert "device lost" in one_line(err)
    assert warpjelly("validate", tmp_path)[0] == 0
    assert open_stage(tmp_path).GetEndTimeCode() == 3
    # Without a record the run has not finished, but it is not overwritten either.
    monkeypatch.undo()
    code, _, err = warpjelly("run", CUBE, "-o", tmp_path)
    assert code == 2
    assert "holds an unfinished run (stage.usda, metrics.csv, checkpoint.npz)" in one_line(err)


def test_an_interrupted_run_keeps_its_frames(warpjelly, tmp_path, monkeypatch):
    """Exit with 130 after Ctrl-C and leave a sound stage of the frames before."""
    advance = wj.Simulator.advance_frame

    def interrupted(sim: wj.Simulator) -> None:
        if sim.substep_count >= 3 * sim.substeps:
            raise KeyboardInterrupt
        advance(sim)

    monkeypatch.setattr(wj.Simulator, "advance_frame", interrupted)
    code, out, err = warpjelly("run", CUBE, "-o", tmp_path, "--json")
    assert code == 130
    assert "interrupted after 4 of 300 frames" in one_line(err)
    assert json.loads(out)["interrupted"] is True
    assert json.loads((tmp_path / "run.json").read_text())["frames"] == 4
    assert warpjelly("validate", tmp_path)[0] == 0


def test_ctrl_c_is_told_wherever_it_comes(warpjelly, monkeypatch):
    """Interrupt what is no run and no batch yet: one line, and 130."""

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("warpjelly.scenefile.load_scene", interrupted)
    for command in ("run", "check"):
        assert warpjelly(command, CUBE) == (130, "", "error: interrupted\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run"], "'scene'"),
        (["run", "none.toml"], "none.toml"),
        (["run", CUBE, "--frames", "0"], "--frames"),
        (["run", CUBE, "--device", "cuda:9"], "cuda:9"),
        (["run", CUBE, "--colour", "rgb"], "--colour"),
        (["run", CUBE, "--set", "solver.dt"], "KEY=VALUE"),
        (["run", CUBE, "--set", "solver.dt=-1"], "solver.dt = -1"),
        (["run", CUBE, "--set", "bodies.cube.particles_per_edge=4096"], "arrays can hold"),
        (["run", CUBE, "--set", "materials.jelly.particle_mass=1e-300"], "particle_mass = 1e-300"),
        (["run", CUBE, "--set", "bodies.cube.velocity=[0.0, -1e12, 0.0]"], "bodies.0.velocity.1"),
        (["run", CUBE, "--set", "gravity=[0.0, -1e12, 0.0]"], "gravity.1"),
        (["run", CUBE, "--set", "fps=" + 5000 * "9"], "fps"),
        (["run", CUBE, "--set", "fps=" + 3000 * "["], "fps"),
        (["run", CUBE, "--set", "bodies.².size=3"], "no entry '²'"),
        (["fly"], "fly"),
        (["validate", "none.usdc"], "none.usdc"),
        (["preview", "none.usdc", "-o", "a.png"], "none.usdc"),
        (["preview", "none.usdc"], "output"),
        (["preview", "none.usdc", "-o", "a.png", "--size", "big"], "--size big"),
        (["preview", "none.usdc", "-o", "a.png", "--plots"], "none.usdc"),
        (["preview", "none.usdc", "-o", "a.png", "--plots", "--frame", "1"], "--frame"),
        (["preview", "none.usdc", "-o", "a.png", "--every", "0"], "--every"),
        (["preview", "none.usdc", "-o", "a.png", "--size", "²x3"], "--size ²x3"),
    ],
)
def test_wrong_arguments_exit_with_2_and_one_line(warpjelly, tmp_path, monkeypatch, arguments, said):
    """Refuse wrong arguments without a traceback and without leaving anything behind."""
    monkeypatch.chdir(tmp_path)
    code, out, err = warpjelly(*arguments)
    assert (code, out) == (2, "")
    assert said in one_line(err)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.obj", b"", "no triangles"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("nan.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("index.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "index.obj"),
        ("dot.obj", b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "dot.obj"),
        ("inf.obj", b"v 0 0 inf\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no cell of the grid"),
        *((f"empty{kind}", b"", "no triangles") for kind in (*EXTENSIONS, *EXTRA_EXTENSIONS)),
        *((f"noise{kind}", NOISE, f"noise{kind}") for kind in (*EXTENSIONS, *EXTRA_EXTENSIONS)),
        ("short.glb", trimesh.creation.box().export(file_type="glb")[:-9], "not a sound .glb file"),
        ("short.ply", trimesh.creation.box().export(file_type="ply")[:-9], "it ends too early"),
        ("short.stl", trimesh.creation.box().export(file_type="stl")[:-9], "not a sound .stl file"),
        ("words.stl", b"this is not a mesh", "not a sound .stl file"),
        ("empty.usda", b"#usda 1.0\n", "no mesh to be seen below /; there is none in this file"),
        ("model.xyz", b"0 0 0\n", "unknown mesh format '.xyz'"),
        ("huge.obj", b"v 0 0 0\nv 1e200 0 0\nv 0 1 0\nf 1 2 3\n", "m large"),
        ("tiny.obj", b"v 0 0 0\nv 1e-30 0 0\nv 0 1e-30 0\nf 1 2 3\n", "m large"),
    ],
)
def test_an_unusable_model_exits_with_2_and_one_line(warpjelly, tmp_path, name, content, said):
    """Refuse models without triangles, with broken numbers, or in no known format."""
    (tmp_path / name).write_bytes(content)
    scene = tmp_path / "scene.toml"
    scene.write_text(MODEL_SCENE.replace("FILE", name))
    code, out, err = warpjelly("run", scene, "-o", tmp_path / "out")
    assert (code, out) == (2, "")
    errors = [line for line in err.splitlines() if not line.startswith("warning: ")]
    assert said in one_line("\n".join(errors))
    assert not (tmp_path / "out").exists()


def test_a_scene_that_cannot_fit_is_refused_with_the_numbers(warpjelly, tmp_path, monkeypatch):
    """Estimate before allocating: the message has what is needed and what there is."""
    monkeypatch.setattr(plan, "memory_limit", lambda: 1e9)
    code, _, err = warpjelly("check", CUBE, "--set", "bodies.cube.particles_per_edge=300")
    assert code == 2
    assert "27,000,000 particles" in err
    assert one_line(err).startswith(f"error: {CUBE}: 27,000,000 particles")
    assert "of 1.0 GB" in err
    code, _, err = warpjelly("check", SCENES / "tree_drop.toml", "--set", "bodies.tree.resolution=4096")
    assert code == 2
    assert "bodies.tree: voxels at resolution 4,096 need about" in one_line(err)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("bodies.cube.pinned=[{indices=[2000]}]", "bodies.cube.pinned.0.indices: no particle 2000"),
        ("bodies.cube.particles_per_edge=4096", "particles are more than"),
        (
            "bodies.cube={name='cube', type='model', material='jelly', file='a.xyz', resolution=3}",
            "a.xyz: unknown mesh",
        ),
    ],
)
def test_a_scene_that_cannot_be_built_is_named(warpjelly, tmp_path, setting, said):
    """Name the scene file before what is wrong, in every command, and not before what is wrong elsewhere."""
    scene = tmp_path / "scene.toml"
    shutil.copy(CUBE, scene)
    (tmp_path / "a.xyz").write_text("0 0 0")
    for command in (["run"], ["check"], ["export-world", "-o", tmp_path / "a.w", "--force"]):
        code, _, err = warpjelly(command[0], scene, *command[1:], "--set", setting)
        assert code == 2
        assert one_line(err).startswith(f"error: {scene}: ")
        assert one_line(err).count(str(scene)) == 1
        assert said in err or command[0] == "export-world"
    code, _, err = warpjelly("check", scene, "--device", "cuda:9")
    assert (code, str(scene) in one_line(err)) == (2, False)


@pytest.mark.parametrize(("output", "expected"), [("file", 2), ("file/below", 4)])
def test_an_output_that_cannot_be_written_is_refused(warpjelly, tmp_path, output, expected):
    """Say in one line which folder cannot be written."""
    (tmp_path / "file").write_text("")
    code, out, err = warpjelly("run", CUBE, "--frames", 2, "-o", tmp_path / output)
    assert (code, out) == (expected, "")
    assert str(tmp_path / output) in one_line(err)
    assert (tmp_path / "file").read_text() == ""


def test_a_full_disk_exits_with_4(tmp_path):
    """Limit the size of files and require one clear line and no half stage."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000));"
        "from warpjelly import cli; cli.main()"
    )
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    # A run before warms the kernel cache, which must not fill the disk, and leaves a stage that has to survive.
    cli_run = [
        sys.executable,
        "-m",
        "warpjelly.cli",
        "run",
        CUBE,
        "--frames",
        "2",
        "-o",
        str(tmp_path / "out"),
        "--quiet",
    ]
    assert subprocess.run(cli_run, check=False).returncode == 0
    before = (tmp_path / "out" / "stage.usdc").read_bytes()
    arguments = ["run", CUBE, "--frames", "30", "-o", str(tmp_path / "out"), "--device", "cpu", "--force"]
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == 4, done.stderr
    assert str(tmp_path / "out") in one_line(done.stderr)
    assert (tmp_path / "out" / "stage.usdc").read_bytes() == before
    assert not (tmp_path / "out" / "run.json").exists()


def test_an_open_mesh_is_used_with_a_warning(warpjelly, tmp_path):
    """Warn of a mesh that is not watertight, and go on."""
    faces = ["1 3 2", "2 3 4", "5 6 7", "6 8 7", "1 2 5", "2 6 5", "3 7 4", "4 7 8", "1 5 3", "3 5 7"]
    vertices = [f"v {x} {y} {z}" for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    (tmp_path / "open.obj").write_text("\n".join([*vertices, *(f"f {face}" for face in faces)]))
    scene = tmp_path / "scene.toml"
    scene.write_text(MODEL_SCENE.replace("FILE", "open.obj"))
    code, _, err = warpjelly("check", scene)
    assert err.startswith("warning: ")
    assert "the mesh is not watertight; method vote: inside is where most of three axes say so" in err
    assert code in (0, 2)


def test_a_body_that_starts_in_a_collider_is_warned_of(warpjelly, tmp_path):
    """Warn of the depth at the start, and go on."""
    arguments = ["--frames", 2, "-o", tmp_path, "--set", "bodies.cube.position=[0.0, 0.3, 0.0]"]
    code, _, err = warpjelly("run", CUBE, *arguments, "--set", "bodies.cube.rotation=[0.0, 0.0, 0.0]")
    assert code == 0
    assert "warning: body 'cube' starts 0.2 m deep in a collider" in err


def test_voxelize_says_what_a_model_becomes(warpjelly, tmp_path):
    """Report figures of a model, and write a grid that makes the same body as the model."""
    grid = tmp_path / "tree.npz"
    code, out, err = warpjelly("voxelize", TREE, "--resolution", 12, "-o", grid, "--json")
    assert (code, err) == (0, "")
    figures = json.loads(out)
    assert list(figures) == [
        *("voxels", "particles", "springs", "pieces", "watertight", "method", "volume", "mesh_volume", "warnings")
    ]
    assert (figures["pieces"], figures["watertight"], figures["method"], figures["warnings"]) == (1, True, "parity", [])
    # The faces of the tree lie between cells at this resolution; the file keeps six decimals.
    assert figures["volume"] == pytest.approx(figures["mesh_volume"], rel=1e-4)
    bodies = [
        {"type": "model", "file": str(TREE), "resolution": 12, "material": "jelly"},
        {"type": "voxels", "file": str(grid), "material": "jelly"},
        {"type": "voxels", "file": str(grid), "cell_size": 1 / 6, "material": "jelly"},
    ]
    of_model, of_grid, twice = (
        wj.Simulator(Scene.model_validate({"materials": {"jelly": {}}, "bodies": [body]}), device="cpu")
        for body in bodies
    )
    assert len(of_model.positions) == figures["particles"]
    assert of_model.model.spring_count == figures["springs"]
    np.testing.assert_array_equal(of_grid.positions, of_model.positions)
    # A float32 each.
    np.testing.assert_allclose(twice.positions, 2 * of_model.positions, rtol=0, atol=1e-6)
    code, out, err = warpjelly("voxelize", TREE, "-n", 12, "-o", grid)
    assert (code, out) == (2, "")
    assert "there already" in one_line(err)
    code, out, _ = warpjelly("voxelize", TREE, "-n", 12, "-o", grid, "--force")
    assert code == 0
    assert f"voxels     {figures['voxels']:>13,} of 8 x 12 x 8, 0.08333 m each" in out


def test_voxelize_makes_a_stage_of_the_voxels(warpjelly, tmp_path):
    """Write the voxels as a sound stage, with a face for each that has no neighbour."""
    stage = tmp_path / "voxels.usdc"
    code, out, err = warpjelly("voxelize", TREE, "-n", 12, "-o", stage)
    assert (code, err) == (0, "")
    assert f"stage: {stage}" in out
    assert stage_problems(stage) == []
    opened = Usd.Stage.Open(str(stage))
    mesh = UsdGeom.Mesh(opened.GetPrimAtPath("/World/bodies/model/surface"))
    counts, points = mesh.GetFaceVertexCountsAttr().Get(), np.array(mesh.GetPointsAttr().Get())
    assert set(counts) == {4}
    assert warpjelly("voxelize", TREE, "-n", 12, "-o", stage)[0] == 2
    # All faces are squares of an edge of a twelfth, and shaped like the model, which lies on cell boundaries.
    quads = points[np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)]
    np.testing.assert_allclose(np.linalg.norm(quads[:, 1] - quads[:, 0], axis=1), 1 / 12, rtol=1e-5)
    assert len(quads) / 144 == pytest.approx(load_mesh(TREE).area, rel=1e-4)
    # Nothing was simulated: there are no forces to show, and the edges of the voxels have a colour of their own.
    assert not mesh.GetDisplayColorPrimvar().GetTimeSamples()
    edges = UsdGeom.BasisCurves(opened.GetPrimAtPath("/World/bodies/model/springs"))
    assert len(np.unique(edges.GetDisplayColorPrimvar().ComputeFlattened(), axis=0)) == 1


def test_voxelize_looks_below_a_prim(warpjelly, tmp_path):
    """Voxelize the body of a stage without the ground it lies on."""
    assert warpjelly("run", CUBE, "--frames", 1, "-o", tmp_path)[0] == 0
    code, out, _ = warpjelly("voxelize", tmp_path / "stage.usdc", "-n", 4, "--prim", "/World/bodies/cube", "--json")
    assert code == 0
    assert json.loads(out)["voxels"] >= 8


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nothing.obj", "-n", 4], "nothing.obj: no such file"),
        ([TREE, "-n", 4, "-o", "grid.obj"], "grid.obj: a grid is written as .npz, a stage of the voxels as .usdc"),
        ([TREE, "-n", 0], "--resolution"),
        ([TREE, "-n", 4, "-o", "nowhere/grid.npz"], "nowhere/grid.npz: cannot write the grid"),
    ],
)
def test_voxelize_refuses_in_one_line(warpjelly, tmp_path, monkeypatch, arguments, said):
    """Refuse what is no model, no resolution or no place for a grid."""
    monkeypatch.chdir(tmp_path)
    code, out, err = warpjelly("voxelize", *arguments)
    assert (code, out) == (4 if "nowhere" in said else 2, "")
    assert said in err


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"cells": np.zeros((2, 2, 2), bool)}, "none of its cells is occupied"),
        ({"cells": np.ones((2, 2), bool)}, "cells must be [x, y, z]"),
        ({"other": np.ones((2, 2, 2), bool)}, "cells"),
        ({"cells": np.ones((1, 1, 1), bool), "cell_size": np.nan}, "must be lengths"),
        ({"cells": np.ones((1, 1, 1), bool), "origin": [0.0, np.inf, 0.0]}, "must be lengths"),
        ({"cells": np.ones((1, 1, 1), bool), "origin": [0.0, 0.0]}, "origin must have 3 numbers, not [2]"),
        ({"cells": np.ones((1, 1, 1), bool), "origin": np.zeros(10**6)}, "origin has 1000000 numbers; there may be 3"),
        ({"cells": np.ones((1, 1, 1), bool), "cell_size": [0.1, 0.2]}, "cell_size has 2 numbers; there may be 1"),
        ({"cells": np.array([[[None]]], dtype=object)}, "cells must be numbers, not object"),
        ({"cells": np.array([[["a"]]])}, "cells must be numbers"),
        ({"cells": np.full((2, 2, 2), np.nan)}, "some are NaN"),
        ({"cells": np.ones((2, 0, 2), bool)}, "cells must be [x, y, z], not [2, 0, 2]"),
    ],
)
def test_a_broken_grid_is_refused_in_one_line(warpjelly, tmp_path, arrays, said):
    """Refuse files of grids without cells, or with places and sizes that cannot be."""
    np.savez(tmp_path / "grid.npz", **arrays)
    scene = tmp_path / "scene.toml"
    scene.write_text('[materials.jelly]\n[[bodies]]\ntype = "voxels"\nmaterial = "jelly"\nfile = "grid.npz"\n')
    code, out, err = warpjelly("check", scene)
    assert (code, out) == (2, "")
    assert said in one_line(err)
    assert "grid.npz" in err


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (None, "not a zip file"),
        (b"noise", "reading magic string"),
        (header_of((1 << 20, 1 << 20, 1 << 10)) + bytes(100), "there may be 8,589,934,592"),
        (header_of((1, 1, 1 << 32)) + bytes(100), "it ends too early"),
        (header_of((1 << 32, 1, 1)) + bytes(100), "it ends too early"),
    ],
)
def test_a_grid_that_promises_too_much_is_refused_at_once(warpjelly, tmp_path, entry, said):
    """Refuse files that are no archive, that lie about their size, and those whose cells are too many to read."""
    (tmp_path / "grid.npz").write_bytes(NOISE)
    if entry is not None:
        with zipfile.ZipFile(tmp_path / "grid.npz", "w") as archive:
            archive.writestr("cells.npy", entry)
    scene = tmp_path / "scene.toml"
    scene.write_text('[materials.jelly]\n[[bodies]]\ntype = "voxels"\nmaterial = "jelly"\nfile = "grid.npz"\n')
    code, out, err = warpjelly("check", scene)
    assert (code, out) == (2, "")
    assert said in one_line(err)


@pytest.mark.parametrize("kind", ["obj", "npz"])
def test_a_folder_is_no_file(warpjelly, tmp_path, kind):
    """Say that what should be a model or a grid is a folder."""
    (tmp_path / f"thing.{kind}").mkdir()
    scene = tmp_path / "scene.toml"
    text = MODEL_SCENE.replace("FILE", f"thing.{kind}")
    scene.write_text(text if kind == "obj" else text.replace('"model"', '"voxels"').replace("resolution = 4", ""))
    code, out, err = warpjelly("check", scene)
    assert (code, out) == (2, "")
    assert "it is a folder, not a file" in one_line(err)
    code, _, err = warpjelly("voxelize", tmp_path / f"thing.{kind}", "-n", 4)
    assert (code, one_line(err)) == (2, f"error: {tmp_path / f'thing.{kind}'}: it is a folder, not a file")


def test_a_model_without_voxels_names_a_resolution_that_has_some(warpjelly, tmp_path):
    """Say from which resolution on a thin plate has voxels, and find some there; a sheet has none but with its key."""
    plate = trimesh.creation.box((1.0, 0.9, 0.05)).apply_translation([0.0, 0.0, 0.07])
    plate.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0]))
    plate.export(tmp_path / "plate.ply")
    code, _, err = warpjelly("voxelize", tmp_path / "plate.ply", "-n", 2)
    found = re.search(r"resolution (\d+) has some, and keep_thin_parts fills", one_line(err))
    assert (code, bool(found)) == (2, True)
    assert warpjelly("voxelize", tmp_path / "plate.ply", "-n", found[1])[0] == 0
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    code, _, err = warpjelly("voxelize", tmp_path / "flat.obj", "-n", 4)
    assert (code, "has some" in err) == (2, False)
    assert warpjelly("voxelize", tmp_path / "flat.obj", "-n", 4, "--keep-thin-parts")[0] == 0


def test_check_says_where_in_a_shot_a_run_goes(warpjelly):
    """Print the meshes and the time codes of a run over a shot."""
    code, out, _ = warpjelly("check", SCENES / "dessert_shot.toml")
    assert code == 0
    assert "over       /shot/dessert/jelly, /shot/dessert/cherry\n" in out
    assert "1001 to 1036, its time codes\n" in out


def test_check_names_the_memory_of_the_largest_bodies(warpjelly, tmp_path):
    """Share the estimate of memory among bodies, the largest first."""
    code, out, _ = warpjelly("check", SCENES / "pile.toml", "--json")
    figures = json.loads(out)
    shares = figures["body_memory_bytes"]
    assert (code, len(shares)) == (0, 10)
    assert 0 < sum(shares.values()) < figures["memory_bytes"]
    code, out, _ = warpjelly("check", SCENES / "pile.toml")
    assert len(re.findall(r"^ +[0-9.]+ GB of it for '", out, re.MULTILINE)) == 3


def test_a_plane_that_faces_away_is_warned_of(warpjelly, tmp_path):
    """Warn of a plane above whose back a body starts, but not of a shelf above a body."""
    scene = tmp_path / "scene.toml"
    found = {}
    for height, normal in ((1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)):
        lines = [
            "[materials.jelly]",
            "[[bodies]]",
            'type = "cube"',
            'material = "jelly"',
            f"position = [0, {height}, 0]",
        ]
        lines += ["[[colliders]]", 'type = "plane"', f"normal = [0, {normal}, 0]", "size = [4.0, 4.0]"]
        scene.write_text("\n".join(lines))
        code, _, err = warpjelly("check", scene)
        assert code == 0
        found[height, normal] = "body 'cube_0' starts behind plane 'plane_0'" in err
    assert found == {(1.0, -1.0): True, (1.0, 1.0): False, (-1.0, 1.0): False}


def test_a_body_that_ends_inside_out_is_warned_of(warpjelly, tmp_path):
    """Warn of a cube whose sides fly through each other, and not of one that is turned by half a turn."""
    scene = tmp_path / "scene.toml"
    for mirrored in (True, False):
        positions = [[x - 0.5, y - 0.5, z - 0.5] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
        velocities = [[-6.0 * x, 0.0, 0.0 if mirrored else -6.0 * z] for x, _, z in positions]
        lines = ["duration = 0.5", "gravity = [0, 0, 0]", "[materials.soft]"]
        lines += [f"{kind} = {{stiffness = 0.001, damping = 0.0}}" for kind in ("structural", "shear", "bend")]
        lines += ["[[bodies]]", 'type = "cube"', "particles_per_edge = 2", 'material = "soft"']
        lines += [f"positions = {positions}", f"velocities = {velocities}"]
        scene.write_text("\n".join(lines))
        code, _, err = warpjelly("run", scene, "-o", tmp_path / f"out_{mirrored}")
        assert code == 0
        assert ("'cube_0': inside out at the end" in err) == mirrored


def test_a_body_that_ends_deep_in_a_collider_is_warned_of(warpjelly, tmp_path):
    """Warn of a cube that is too heavy for the floor it lies in, with its depth, and not of a light one."""
    # At rest each of the 9 particles below carries three of the weight, m g: k depth = 3 m g.
    lines = ["duration = 1.0", "[materials.jelly]", 'law = "hooke"', "particle_mass = {mass}"]
    lines += [f"{kind} = {{{{stiffness = 1e5, damping = 100.0}}}}" for kind in ("structural", "shear", "bend")]
    lines += ["[solver]", "dt = 2e-4", "[contact]", "damping = 40.0", "[[bodies]]", 'name = "block"', 'type = "cube"']
    lines += ["particles_per_edge = 3", "size = 0.2", 'material = "jelly"', "position = [0.0, 0.1, 0.0]"]
    lines += ["[[colliders]]", 'type = "half_space"', "normal = [0.0, 1.0, 0.0]"]
    scene = tmp_path / "scene.toml"
    for mass, deep in ((10.0, True), (1.0, False)):
        scene.write_text("\n".join(lines).format(mass=mass))
        code, _, err = warpjelly("run", scene, "-o", tmp_path / f"out_{deep}")
        assert code == 0
        assert ("'block' is 0.1" in err and "deep in a collider at the end, 1." in err) == deep


def test_bodies_that_start_in_each_other_are_warned_of(warpjelly, tmp_path):
    """Warn of bodies nearer than a unit cell, with the overlap of their balls, and not of those a cell apart."""
    cube = ["[[bodies]]", 'type = "cube"', 'material = "jelly"', "particles_per_edge = 3"]
    scene = tmp_path / "scene.toml"
    found = {}
    for away in (1.3, 1.5):
        scene.write_text("\n".join(["[materials.jelly]", *cube, *cube, f"position = [{away}, 0.0, 0.0]"]))
        code, _, err = warpjelly("check", scene)
        assert code == 0
        # Unit cells of 0.5 m.
        found[away] = "'cube_0', 'cube_1' start too close together: the balls" in err and "by up to 0.2 m" in err
    assert found == {1.3: True, 1.5: False}


def test_a_plane_through_a_body_is_warned_of(warpjelly, tmp_path):
    """Warn of a plane that cuts a body, with the depth, unless the body is beside, in front or wholly behind."""
    lines = ["[materials.jelly]", "[[bodies]]", 'type = "cube"', 'material = "jelly"', "particles_per_edge = 3"]
    lines += ["position = [HERE, 0.0]", "[[colliders]]", 'type = "plane"', 'name = "table"', "normal = [0.0, 2.0, 0.0]"]
    lines += ["tangent = [1.0, 0.0, 0.0]", "size = [2.0, 2.0]", "threshold = 0.1"]
    scene = tmp_path / "scene.toml"
    found = {}
    for here in ("0.0, 0.2", "0.0, 0.6", "0.0, -0.6", "2.0, 0.2"):
        scene.write_text("\n".join(lines).replace("HERE", here))
        code, _, err = warpjelly("check", scene)
        assert code == 0
        found[here] = "body 'cube_0' starts across plane 'table', 0.3 m deep: what is deeper than its threshold" in err
    assert found == {"0.0, 0.2": True, "0.0, 0.6": False, "0.0, -0.6": False, "2.0, 0.2": False}


@pytest.mark.parametrize("form", ["usdc", "clips"])
def test_paths_with_spaces_and_other_letters_work(warpjelly, tmp_path, form):
    """Read a scene and a model from a folder with spaces and non-ASCII letters, and do there what can be done."""
    folder = tmp_path / "süße Würfel 方"
    folder.mkdir()
    shutil.copy(TREE, folder / "Bäumchen 1.obj")
    scene, run = folder / "Szene – 1.toml", folder / "Lauf [1] #2"
    scene.write_text(MODEL_SCENE.replace("FILE", "Bäumchen 1.obj") + f'[output]\nformat = "{form}"\n')
    assert warpjelly("run", scene, "--frames", 2, "-o", run)[::2] == (0, "")
    assert warpjelly("run", scene, "--frames", 4, "-o", run, "--resume", "--set", "output.format=" + form)[0] == 0
    assert warpjelly("validate", run) == (0, f"{run}: sound\n", "")
    for name in ("gepackt ü.usdc", "gepackt ü.usda", "gepackt ü.usdz"):
        assert warpjelly("pack", run, "-o", folder / name) == (0, f"stage: {folder / name}\n", "")
        assert warpjelly("validate", folder / name) == (0, f"{folder / name}: sound\n", "")
        assert Usd.Stage.Open(str(folder / name)).GetEndTimeCode() == 3
    assert warpjelly("preview", run, "-o", folder / "Ansicht ö.html")[0] == 0
    assert (folder / "Ansicht ö.html").stat().st_size > 10_000


@pytest.mark.parametrize("form", ["usdc", "clips"])
def test_a_stage_may_stand_for_its_run_directory(warpjelly, tmp_path, form):
    """Take a stage where a run directory is meant, and say what is wrong where a scene or a folder is meant."""
    run, setting = tmp_path / "run", f"output.format={form}"
    assert warpjelly("run", CUBE, "--frames", 3, "-o", run, "--set", setting)[0] == 0
    stage = run / ("stage.usdc" if form == "usdc" else "stage.usda")
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}
    assert warpjelly("validate", stage) == (0, f"{stage}: sound\n", "")
    outputs: dict[str, list[bytes]] = {"a.usdc": [], "a.html": []}
    for source in (run, stage):
        assert warpjelly("pack", source, "-o", tmp_path / "a.usdc", "--force")[0] == 0
        assert warpjelly("preview", source, "-o", tmp_path / "a.html", "--force")[0] == 0
        for name, contents in outputs.items():
            contents.append((tmp_path / name).read_bytes())
    assert all(one == other for one, other in outputs.values())
    for scene in (stage, run):
        code, out, err = warpjelly("run", scene, "-o", tmp_path / "new")
        assert (code, out) == (2, "")
        assert one_line(err).endswith("a scene is a .toml or a .w file, which names models and is not one itself")
    for option in ("--resume", "--force"):
        code, out, err = warpjelly("run", CUBE, "--frames", 4, "-o", stage, "--set", setting, option)
        assert (code, out) == (2, "")
        assert one_line(err) == f"error: {stage}: cannot write the run: it is a file; choose a folder with -o"
    assert not (tmp_path / "new").exists()
    assert {file: file.read_bytes() for file in run.rglob("*") if file.is_file()} == before


# The command line, for several lines of arguments.
COMMANDS = """
import shlex, sys
from warpjelly import cli
for line in sys.argv.pop().splitlines():
    sys.argv = ["warpjelly", *shlex.split(line)]
    try:
        cli.main()
    except SystemExit as ended:
        print(ended.code)
"""


def drop_rights() -> None:
    """Take from the next program the right of root to write wherever it likes; others don't have it."""
    pr_capbset_drop, cap_dac_override = 24, 1
    ctypes.CDLL(None).prctl(pr_capbset_drop, cap_dac_override, 0, 0, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="the rights of root are dropped as Linux does")
def test_a_read_only_folder_exits_with_4(warpjelly, tmp_path):
    """Refuse to write into and below a folder that is read-only in one line each, and leave it as it was."""
    folder = tmp_path / "locked"
    assert warpjelly("run", CUBE, "--frames", 2, "-o", folder, "--quiet")[0] == 0
    before = {file: file.read_bytes() for file in folder.iterdir()}
    lines = [
        f"run {CUBE} --frames 4 -o {folder}/below",
        f"run {CUBE} --frames 4 -o {folder} --force",
        f"run {CUBE} --frames 4 -o {folder} --resume",
        f"pack {folder} -o {folder}/packed.usdz",
        f"preview {folder} -o {folder}/page.html",
        f"validate {folder}",
    ]
    folder.chmod(0o555)
    try:
        command = [sys.executable, "-c", COMMANDS, "\n".join(lines)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=drop_rights)
    finally:
        folder.chmod(0o755)
    assert done.stdout.splitlines() == ["4"] * 5 + [f"{folder}: sound", "0"], done.stderr
    errors = done.stderr.splitlines()
    assert len(errors) == 5, done.stderr
    for said in errors:
        assert said.startswith(f"error: {folder}")
        assert said.endswith(("Permission denied", "no permission to write in this directory"))
    assert {file: file.read_bytes() for file in folder.iterdir()} == before


def test_rgb_colours_are_stored_on_request(warpjelly, tmp_path):
    """Store plain colours per point with --color rgb, and indices without."""
    for option, indexed in (("rgb", False), ("indexed", True)):
        warpjelly("run", CUBE, "--frames", 2, "-o", tmp_path / option, "--color", option)
        stage = Usd.Stage.Open(str(tmp_path / option / "stage.usdc"))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/cube/surface"))
        assert UsdGeom.Primvar(mesh.GetDisplayColorAttr()).IsIndexed() is indexed


def test_a_world_runs_and_comes_back(warpjelly, tmp_path):
    """Run a world, export it again, keep what is there unless forced, and refuse a bad one with its line."""
    world = tmp_path / "left.w"
    world.write_text(WORLDS["left"].text())
    settings = ["--frames", 3, "--json"]
    code, out, err = warpjelly("run", world, *settings, "-o", tmp_path / "run")
    assert (code, err) == (0, "")
    record = json.loads(out)
    assert (record["fps"], record["substeps"], record["dt"], record["precision"]) == (2000.0, 1, 0.0005, "float64")
    assert warpjelly("validate", tmp_path / "run")[0] == 0
    code, out, err = warpjelly("export-world", world, "-o", tmp_path / "again.w")
    assert (code, err) == (0, "")
    assert wj.load_scene(tmp_path / "again.w").bodies == wj.load_scene(world).bodies
    code, _, err = warpjelly("export-world", world, "-o", tmp_path / "again.w")
    assert code == 2
    assert "--force" in one_line(err)
    assert warpjelly("export-world", world, "-o", tmp_path / "again.w", "--force")[0] == 0
    code, _, err = warpjelly("export-world", CUBE, "-o", tmp_path / "cube.w")
    assert code == 2
    assert "solver.integrator" in one_line(err)
    world.write_text("RK4\n0.0005")
    code, _, err = warpjelly("run", world)
    assert code == 2
    assert f"{world}: line 2: the file ends here" in one_line(err)


def test_doctor_names_versions_devices_and_extras(warpjelly):
    """Show what is there, and what a missing extra is called."""
    code, out, err = warpjelly("doctor")
    assert (code, err) == (0, "")
    for part in ("warpjelly", "warp-lang", "usd-core", "cpu", "preview", "memory"):
        assert part in out


def test_help_teaches_every_command(warpjelly, monkeypatch):
    """Show help for the program and each command, and the version."""
    code, out, _ = warpjelly("--help")
    assert code == 0
    for command in ("run", "check", "validate", "preview", "bench", "doctor"):
        assert command in out
        assert warpjelly(command, "--help")[0] == 0
    # Paragraphs are as wide as the terminal, and the example of a sweep has its lines.
    monkeypatch.setenv("COLUMNS", "80")
    shown = [line.strip() for line in warpjelly("batch", "--help")[1].splitlines()]
    assert 'base = "cube.toml"' in shown
    written = shown[shown.index("Simulate many scenes, or one scene with many values of some keys.") + 2 :]
    paragraph = written[: written.index("")]
    # Each line but the last has no room for the next word; the frame takes two of 80.
    for line, after in pairwise(paragraph):
        assert len(line) + 1 + len(after.split()[0]) > 78
    assert warpjelly("--version")[1].startswith("warpjelly ")


def test_an_internal_error_says_where_to_report_it(warpjelly, monkeypatch):
    """Turn an unexpected exception into one line and exit code 4."""

    def fail(*arguments: object, **options: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("warpjelly.scenefile.load_scene", fail)
    code, _, err = warpjelly("check", CUBE)
    assert code == 4
    assert "internal error: ZeroDivisionError" in one_line(err)
    assert "CONTRIBUTING.md" in err


@pytest.mark.egl
def test_preview_makes_a_picture_of_a_run(warpjelly, tmp_path):
    """Render two frames of a real run side by side."""
    warpjelly("run", CUBE, "--frames", 3, "-o", tmp_path / "run")
    picture = tmp_path / "a.png"
    code, out, _ = warpjelly("preview", tmp_path / "run", "-o", picture, "--frame", 0, "--frame", 2, "--size", "64x48")
    assert code == 0
    assert str(picture) in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    code, _, err = warpjelly("preview", tmp_path / "run", "-o", picture, "--frame", 2)
    assert code == 2
    assert "--force" in one_line(err)
    code, _, err = warpjelly("preview", tmp_path / "run", "-o", picture, "--frame", 3, "--force")
    assert code == 2
    assert "0 to 2" in one_line(err)
    for name, option in (("r.html", "--every=2"), ("p.png", "--plots")):
        code, out, err = warpjelly("preview", tmp_path / "run", "-o", tmp_path / name, option)
        assert (code, err) == (0, "")
        assert re.fullmatch(rf"preview: .*{name} \([0-9.]+ MB\)\n", out)
