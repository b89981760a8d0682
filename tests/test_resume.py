"""Runs that are killed, interrupted, out of room or continued lose nothing, and end in the same result to the bit."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from runs import CLIP_FRAMES, samples_of, small_scene, start_run

from warpjelly import plan
from warpjelly.background import Background
from warpjelly.checkpoint import Checkpoint, differences, load_checkpoint, scene_keys
from warpjelly.errors import EnvironmentFailedError, InputError, SceneError
from warpjelly.readers.companions import files_of
from warpjelly.run import RunEndedError, simulate
from warpjelly.scene import Scene
from warpjelly.stage.stagefiles import open_stage, progress
from warpjelly.stage.validate import stage_problems

KILLS = int(os.environ.get("WARPJELLY_KILLS", "5"))
FINISHED = ["checkpoint.npz", "metrics.csv", "run.json", "stage.usdc"]


@pytest.fixture(scope="module", autouse=True)
def short_clips():
    """Write clips of few frames in this process, too."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "CLIP_FRAMES", CLIP_FRAMES)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory, short_clips):
    """Return the directory of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("whole")
    simulate(small_scene(), output=folder, device="cpu")
    return folder


def legend_of(folder: Path) -> dict[str, object]:
    """Return what the colours of a stage mean."""
    stage = open_stage(folder)
    return stage.GetDefaultPrim().GetCustomDataByKey("legend")


def assert_same_result(folder: Path, whole: Path) -> None:
    """Hold a run directory against that of the undisturbed run: all that is in the stage, metrics and outcomes."""
    assert sorted(os.listdir(folder)) == sorted(os.listdir(whole)) == FINISHED
    assert samples_of(folder) == samples_of(whole)
    ours, theirs = (open_stage(source) for source in (folder, whole))
    assert ours.GetEndTimeCode() == theirs.GetEndTimeCode()
    assert legend_of(folder) == legend_of(whole)
    assert (
        ours.GetPrimAtPath("/World/camera").GetAttribute("xformOp:transform").Get()
        == theirs.GetPrimAtPath("/World/camera").GetAttribute("xformOp:transform").Get()
    )
    assert stage_problems(folder) == []
    assert (folder / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    records = [json.loads((source / "run.json").read_text()) for source in (folder, whole)]
    assert records[0]["expect"] == records[1]["expect"]
    assert records[0]["frames"] == records[1]["frames"]


def assert_good_beginning(folder: Path, whole: Path) -> int:
    """Hold the stage of an unfinished run against the undisturbed one; return how many frames it has."""
    assert stage_problems(folder) == []
    stage = open_stage(folder)
    found = progress(stage)
    assert found is not None
    frames, total = found
    assert total == 120
    assert stage.GetEndTimeCode() == max(frames - 1, 0)
    expected = samples_of(whole, colors=False)
    samples = samples_of(folder, colors=False)
    assert samples == {key: value for key, value in expected.items() if key[1] < frames}
    return frames


def wait_for_start(folder: Path, process: subprocess.Popen[str]) -> None:
    """Wait until a process has the lock of a run directory, which has its number then, or ends."""
    lock = folder / "run.lock"
    while process.poll() is None and not (lock.exists() and lock.read_text() == str(process.pid)):
        time.sleep(0.001)


def wait_for(folder: Path, process: subprocess.Popen[str], frames: int) -> None:
    """Wait until a run has so many frames in its metrics, or ends."""
    metrics = folder / "metrics.csv"
    while process.poll() is None and not (metrics.exists() and metrics.read_bytes().count(b"\n") > frames):
        time.sleep(0.001)


def test_a_killed_run_goes_on_as_if_nothing_had_been(tmp_path, whole):
    """Kill a run at random moments, find only good samples each time, and in the end the same result to the bit."""
    rng, folder, kills, seconds = random.Random(0), tmp_path / "run", 0, 1.0
    while kills < KILLS:
        process = start_run(folder, "--resume")
        wait_for_start(folder, process)
        began = time.monotonic()
        try:
            # Half of them early, so that much is left for the next.
            process.wait(rng.choice([0.2, 1.0]) * rng.random() * seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
            if (folder / "stage.usda").exists():
                assert_good_beginning(folder, whole)
            elif (folder / "stage.usdc").exists():
                assert samples_of(folder) == samples_of(whole)
            continue
        _, err = process.communicate()
        assert process.returncode == 0, err
        seconds = time.monotonic() - began
        assert_same_result(folder, whole)
        folder = tmp_path / f"run_{kills}"
    simulate(small_scene(), output=folder, device="cpu", resume=True)
    assert_same_result(folder, whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_goes_on_as_if_nothing_had_been(tmp_path, whole, number):
    """Send Ctrl-C or a termination, find all frames that were finished, and go on to the same result to the bit."""
    process = start_run(tmp_path)
    wait_for(tmp_path, process, 10)
    process.send_signal(number)
    out, err = process.communicate()
    assert process.returncode == 130, err
    frames = assert_good_beginning(tmp_path, whole)
    assert err == f"error: interrupted after {frames} of 120 frames, which are in {tmp_path}; go on with --resume\n"
    assert f"stage: {tmp_path / 'stage.usda'}" in out
    assert json.loads((tmp_path / "run.json").read_text())["frames"] == frames
    assert load_checkpoint(tmp_path / "checkpoint.npz").frame_count == frames
    command = [sys.executable, "-m", "warpjelly.cli", "validate", tmp_path]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said == f"{tmp_path}: sound; the run is not finished: {frames} of 120 frames\n"
    with pytest.raises(InputError, match=r"an unfinished run .*--resume"):
        simulate(small_scene(), output=tmp_path, device="cpu")
    run = simulate(small_scene(), output=tmp_path, device="cpu", resume=True)
    assert run.record["resumed_from"] == frames
    assert_same_result(tmp_path, whole)


# Room for clips and checkpoints, but not for all metrics; and for all but the stage in one file.
@pytest.mark.parametrize("limit", [30_000, 100_000])
def test_a_full_disk_keeps_what_is_there(tmp_path, whole, limit):
    """Fail writes in the middle of a run or while it is packed, say so in one line, and go on when there is room."""
    process = start_run(tmp_path, limit=limit)
    _, err = process.communicate()
    assert process.returncode == 4
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    frames = assert_good_beginning(tmp_path, whole) if limit < 100_000 else 120
    assert err.endswith(f"File too large; {frames} of 120 frames are kept; go on with --resume\n"), err
    assert 0 < frames
    assert not list(tmp_path.rglob("*.tmp.*"))
    simulate(small_scene(), output=tmp_path, device="cpu", resume=True)
    assert_same_result(tmp_path, whole)


def test_one_run_at_a_time_writes_into_a_directory(tmp_path):
    """Refuse a second run into a directory, whatever is asked for, and allow it when the first was killed."""
    process = start_run(tmp_path, "--set=duration=1000.0")
    wait_for(tmp_path, process, 1)
    for options in ({}, {"force": True}, {"resume": True}):
        with pytest.raises(InputError, match=f"process {process.pid} is writing into this folder"):
            simulate(small_scene(), output=tmp_path, device="cpu", **options)
    process.kill()
    process.communicate()
    assert (tmp_path / "run.lock").exists()
    simulate(small_scene(), output=tmp_path, device="cpu", force=True)
    assert sorted(os.listdir(tmp_path)) == FINISHED


def test_a_finished_run_is_returned(tmp_path, whole):
    """Return what came of a finished run without touching it."""
    before = {file: file.stat().st_mtime_ns for file in whole.iterdir()}
    run = simulate(small_scene(), output=whole, device="cpu", resume=True)
    assert run.record == json.loads((whole / "run.json").read_text())
    assert [outcome.as_dict() for outcome in run.outcomes] == run.record["expect"]
    assert {file: file.stat().st_mtime_ns for file in whole.iterdir()} == before


@pytest.mark.parametrize("settings", [{"output__force_range": (0.0, 2.0)}, {"output__forces": True}])
@pytest.mark.parametrize("form", ["usdc", "clips"])
def test_a_finished_run_goes_on_with_more_frames(tmp_path, settings, form):
    """Add frames to a finished run and get the samples of one that was longer from the start."""
    short, long = (small_scene(duration=seconds, output__format=form, **settings) for seconds in (0.2, 0.5))
    simulate(short, output=tmp_path / "a", device="cpu")
    run = simulate(long, output=tmp_path / "a", device="cpu", resume=True)
    simulate(long, output=tmp_path / "b", device="cpu")
    assert run.record["resumed_from"] == 12
    assert open_stage(tmp_path / "a").GetEndTimeCode() == 29
    assert samples_of(tmp_path / "a") == samples_of(tmp_path / "b")
    assert (tmp_path / "a" / "metrics.csv").read_bytes() == (tmp_path / "b" / "metrics.csv").read_bytes()
    assert run.record["expect"] == json.loads((tmp_path / "b" / "run.json").read_text())["expect"]
    assert stage_problems(tmp_path / "a") == []


@pytest.mark.parametrize("form", ["usdc", "clips"])
def test_colors_keep_their_range_where_forces_are_gone(tmp_path, form, caplog):
    """Add frames to a finished run whose forces were not kept, in colours of the same range, and say so."""
    short, long = (small_scene(duration=seconds, output__format=form) for seconds in (0.2, 0.5))
    simulate(short, output=tmp_path, device="cpu")
    legend = legend_of(tmp_path)
    colors = {key: value for key, value in samples_of(tmp_path).items() if "displayColor" in key[0]}
    simulate(long, output=tmp_path, device="cpu", resume=True)
    assert "colours keep the range of the first 12 frames" in caplog.text
    assert legend_of(tmp_path) == legend
    assert samples_of(tmp_path).items() >= colors.items()
    assert open_stage(tmp_path).GetEndTimeCode() == 29
    assert stage_problems(tmp_path) == []


def test_fewer_frames_than_there_are_is_refused(tmp_path):
    """Say how many frames there are where fewer are asked for."""
    simulate(small_scene(duration=0.1), output=tmp_path, device="cpu")
    with pytest.raises(InputError, match="has 6 frames already, more than the 3 asked for"):
        simulate(small_scene(duration=0.05), output=tmp_path, device="cpu", resume=True)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"solver__dt": 2.5e-4}, "solver.dt was 0.0005 and is 0.00025;"),
        ({"solver__precision": "float64", "solver__dt": 2.5e-4}, r"and is 0.00025 \(and 1 more\);"),
        ({"bodies__cube__position": [0.0, 2.0, 0.0]}, r"bodies.cube.position was \[0.0, 1.4, 0.0\] and is \[0.0, 2.0,"),
        ({"contact": {"pulls": True}}, "contact.pulls was false and is true;"),
        ({"output__format": "clips"}, 'output.format was "usdc" and is "clips";'),
        ({"gravity": [0.0, -1.0, 0.0]}, r"gravity was not set and is \[0.0, -1.0, 0.0\];"),
    ],
)
def test_another_scene_does_not_go_on(whole, settings, said):
    """Refuse to go on with a changed scene, and say what differs."""
    with pytest.raises(InputError, match=f"the scene is not that of the run: .*{said}"):
        simulate(small_scene(**settings), output=whole, device="cpu", resume=True)


def test_another_model_does_not_go_on(tmp_path):
    """Refuse to go on when a model file has changed, and go on when it has only moved."""

    def scene(folder: str, size: int) -> Path:
        (tmp_path / folder).mkdir(exist_ok=True)
        corners = [f"v {x} {y} {z}" for x in (0, size) for y in (0, 1) for z in (0, 1)]
        faces = ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
        (tmp_path / folder / "box.obj").write_text("\n".join([*corners, *faces]))
        file = tmp_path / folder / "scene.toml"
        body = '[[bodies]]\ntype = "model"\nmaterial = "m"\nfile = "box.obj"\nresolution = 2\n'
        file.write_text(f'name = "box"\nframes = 3\n[materials.m]\n{body}')
        return file

    from warpjelly.scenefile import load_scene

    simulate(load_scene(scene("a", 1)), output=tmp_path / "out", device="cpu")
    moved = load_scene(scene("b", 1), frames=4)
    assert simulate(moved, output=tmp_path / "out", device="cpu", resume=True).record["resumed_from"] == 3
    with pytest.raises(InputError, match=r'bodies.model_0.file was "box.obj \(SHA-256 .*\)" and is "box.obj \(SHA'):
        simulate(load_scene(scene("b", 2)), output=tmp_path / "out", device="cpu", resume=True)


def write_models(folder: Path) -> None:
    """Write a box in each format that names other files, and those; images as far as they are looked at."""
    folder.mkdir()
    box = trimesh.creation.box()
    for name, data in box.export(file_type="gltf").items():
        (folder / name.replace("gltf_buffer_", "box data ").replace("model", "box")).write_bytes(
            data.replace(b"gltf_buffer_", b"box%20data%20")
        )
    header = json.loads((folder / "box.gltf").read_text())
    (folder / "box.gltf").write_text(json.dumps(header | {"images": [{"uri": "gltf.png"}]}))
    (folder / "box.obj").write_text(f"mtllib box.mtl\n{box.export(file_type='obj', include_normals=False)}")
    (folder / "box.mtl").write_text("newmtl red\nmap_Kd -s 2 2 2 images\\mtl.png\n")
    images = b"<library_images><image id='a'><init_from>dae.png</init_from></image></library_images></COLLADA>"
    (folder / "box.dae").write_bytes(box.export(file_type="dae").replace(b"</COLLADA>", images))
    usda = "#usda 1.0\n"
    texture = 'def Shader "s" {\n asset inputs:file = @usd.png@\n}'
    (folder / "box.usda").write_text(f"{usda}(subLayers = [@sub.usda@])\n{texture}")
    (folder / "sub.usda").write_text(f'{usda}def Xform "x" (references = @part.usda@</mesh>) {{}}')
    (folder / "part.usda").write_text(f'{usda}def Mesh "mesh" {{}}')
    (folder / "images").mkdir()
    for name in ("gltf.png", "images/mtl.png", "dae.png", "usd.png"):
        (folder / name).write_bytes(b"\x89PNG")
    np.savez(folder / "grid.npz", cells=np.ones((2, 2, 2), bool))


@pytest.mark.parametrize(
    ("model", "changed"),
    [
        ("box.gltf", ["", " box data 0.bin", " box data 1.bin", " gltf.png"]),
        ("box.obj", ["", " box.mtl", " images/mtl.png"]),
        ("box.dae", ["", " dae.png"]),
        ("box.usda", ["", " part.usda", " sub.usda", " usd.png"]),
    ],
)
def test_all_files_of_a_model_are_compared(tmp_path, model, changed):
    """Find which file has changed of those that a model is read from, and nothing where all of them have moved."""
    write_models(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")

    def keys(folder: str) -> dict[str, Any]:
        region = {"material": "m", "grid": "grid.npz"}
        body = {"name": "box", "type": "model", "material": "m", "file": model, "resolution": 2, "regions": [region]}
        data = {"materials": {"m": {}}, "bodies": [body], "frames": 3}
        return scene_keys(Scene.model_validate(data, context={"folder": tmp_path / folder}))

    before = keys("a")
    assert before == keys("b")
    files = {f"bodies.box.file{name}": tmp_path / "b" / (name.strip() or model) for name in changed}
    files["bodies.box.regions.0.grid"] = tmp_path / "b" / "grid.npz"
    assert {key for key in before if key.startswith(("bodies.box.file", "bodies.box.regions.0.grid"))} == files.keys()
    for key, file in files.items():
        content = file.read_bytes()
        if file.suffix == ".npz":
            np.savez(file, cells=np.eye(2, dtype=bool)[None])
        else:
            file.write_bytes(content + b" ")
        assert [said.split(" was ")[0] for said in differences(before, keys("b"))] == [key]
        file.write_bytes(content)


@pytest.mark.parametrize(
    ("model", "content"),
    [
        ("a.obj", "mtllib gone.mtl " + 300 * "a"),
        ("a.obj", "mtllib a\0b"),
        ("a.gltf", '{"images": [{"uri": "gone.png"}, {"uri": "data:,"}, {"bufferView": 0}], "buffers": [{}]}'),
        ("a.dae", "<init_from>gone.png</init_from><init_from/>"),
        ("a.usda", '#usda 1.0\n(subLayers = [@gone.usda@])\ndef Shader "s" {\n asset inputs:file = @gone.png@\n}'),
        ("a.stl", "no other files"),
    ],
)
def test_missing_files_of_a_model_are_passed_over(tmp_path, capfd, model, content):
    """Leave what is missing to the reader of the model, which says so, also names that no file can have."""
    (tmp_path / model).write_text(content)
    assert files_of(tmp_path / model) == [tmp_path / model]
    assert capfd.readouterr().err == ""


def test_a_broken_model_does_not_go_on(tmp_path):
    """Say in one line that a model is broken of which nobody knows what it was read from."""
    write_models(tmp_path / "a")
    (tmp_path / "a" / "box.gltf").write_text("{")
    with pytest.raises(SceneError, match=r"box\.gltf: not a sound \.gltf file: ") as caught:
        files_of(tmp_path / "a" / "box.gltf")
    assert "\n" not in str(caught.value)


def test_other_versions_are_warned_of(tmp_path, caplog):
    """Go on after a change of what decides the last bits, with a warning that names it."""
    simulate(small_scene(duration=0.1), output=tmp_path, device="cpu")
    path = tmp_path / "checkpoint.npz"
    old = load_checkpoint(path)
    Checkpoint(old.frame_count, old.scene, old.origin | {"warp-lang": "0.1"}, old.arrays).save(path)
    simulate(small_scene(duration=0.2), output=tmp_path, device="cpu", resume=True)
    assert 'last bits may differ: warp-lang was "0.1" and is ' in caplog.text


def test_broken_checkpoints_are_refused_in_one_line(tmp_path):
    """Refuse a checkpoint that is missing, is none, or has other arrays, and metrics that lack rows."""
    simulate(small_scene(duration=0.1), output=tmp_path, device="cpu")
    path, longer = tmp_path / "checkpoint.npz", small_scene(duration=0.2)
    good = load_checkpoint(path)

    def refused(said: str) -> None:
        with pytest.raises(InputError, match=said) as caught:
            simulate(longer, output=tmp_path, device="cpu", resume=True)
        assert "\n" not in str(caught.value)

    path.unlink()
    refused("checkpoint.npz: missing")
    for content in (b"", b"nonsense", b"PK\x03\x04 broken"):
        path.write_bytes(content)
        refused("not a checkpoint that can be read")
    np.savez(path, x=np.zeros(3))
    refused("not a checkpoint that can be read")
    arrays = good.arrays | {"state.x": np.zeros((3, 5), np.float32)}
    Checkpoint(good.frame_count, good.scene, good.origin, arrays).save(path)
    refused("the checkpoint is of another simulation: x is float32")
    good.save(path)
    (tmp_path / "metrics.csv").write_text("frame\r\n0\r\n")
    refused("metrics.csv: has fewer than 6 frames")


def test_a_run_that_diverged_is_not_gone_on_with(tmp_path):
    """Tell again that a run diverged, with what it left."""
    scene = small_scene(materials__jelly__shear__damping=50.0)
    with pytest.raises(RunEndedError) as first:
        simulate(scene, output=tmp_path, device="cpu")
    assert sorted(os.listdir(tmp_path))[-3:] == FINISHED[-3:]
    with pytest.raises(RunEndedError) as again:
        simulate(scene, output=tmp_path, device="cpu", resume=True)
    assert (first.value.exit_code, again.value.exit_code) == (3, 3)
    assert again.value.run.record == first.value.run.record


def test_resume_starts_where_nothing_is(tmp_path, whole):
    """Start a run that is to be resumed where there is none, in a folder whose name has spaces and other letters."""
    folder = tmp_path / "süße Würfel 方"
    simulate(small_scene(), output=folder, device="cpu", resume=True)
    assert_same_result(folder, whole)


def test_resume_and_force_exclude_each_other(tmp_path):
    """Refuse to go on with a run and replace it at the same time."""
    with pytest.raises(InputError, match="give one of them"):
        simulate(small_scene(), output=tmp_path, resume=True, force=True)


def test_a_directory_without_permission_is_reported(tmp_path, monkeypatch):
    """Say in one line that a directory cannot be written to, as whoever may not."""
    # Permissions don't bind root, under which tests may run.
    tmp_path.chmod(0o555)
    scene, user = small_scene(), os.geteuid()
    monkeypatch.chdir(tmp_path)
    if user == 0:
        os.seteuid(65534)
    try:
        with pytest.raises(EnvironmentFailedError, match="cannot write the run: Permission denied"):
            simulate(scene, output=".", device="cpu")
    finally:
        os.seteuid(user)


def test_clips_are_as_good_as_one_file(tmp_path, whole):
    """Leave the parts where asked for, with the colours and all else of the packed stage."""
    simulate(small_scene(output__format="clips"), output=tmp_path, device="cpu")
    names = ["checkpoint.npz", "clips", "geometry.usdc", "metrics.csv", "run.json", "stage.usda"]
    assert sorted(os.listdir(tmp_path)) == names
    assert len(list((tmp_path / "clips").iterdir())) == 120 // CLIP_FRAMES + 1
    assert samples_of(tmp_path) == samples_of(whole)
    assert stage_problems(tmp_path) == []
    assert progress(open_stage(tmp_path)) is None


def test_jobs_in_the_background_are_done_in_order():
    """Do jobs in order while few wait, tell what one raises, and start none after it."""
    done, go_on = [], threading.Event()

    def wait_and_note(number: int) -> None:
        go_on.wait()
        if number == 3:
            raise ValueError("no third")
        done.append(number)

    with Background(2) as background:
        background.submit(wait_and_note, 1)
        background.submit(wait_and_note, 2)
        assert done == []
        go_on.set()
        background.submit(wait_and_note, 3)
        background.submit(wait_and_note, 4)
        for _ in range(2):
            with pytest.raises(ValueError, match="no third"):
                background.join()
    assert done == [1, 2]
