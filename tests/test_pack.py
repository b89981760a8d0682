"""Packing: one self-contained file of any format from a run in any state, with all that the stage had."""

from __future__ import annotations

import logging
import shutil
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdUtils
from runs import samples_of
from stages import cube_surface, make_scene, moved_surface, start_stage, write_stage

from warpjelly import cli
from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.previews.preview import render_preview
from warpjelly.run import simulate
from warpjelly.scenefile import load_scene
from warpjelly.stage.pack import pack
from warpjelly.stage.stagefiles import open_stage, progress
from warpjelly.stage.validate import stage_problems

# Of images, only the first bytes are looked at.
IMAGES = {"red paint.png": b"\x89PNG red", "blue.png": b"\x89PNG blue"}
SUFFIXES = [".usdc", ".usda", ".usdz"]


def painted_scene(folder: Path) -> Path:
    """Write a scene of a box that is painted with images, and return its file."""
    corners = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    corners_of = [" ".join(f"{corner}/1" for corner in face.split()) for face in faces]
    lines = [*corners, "vt 0 0", "usemtl red", *(f"f {face}" for face in corners_of[:3])]
    lines += ["usemtl blue", *(f"f {face}" for face in corners_of[3:])]
    (folder / "box.obj").write_text("\n".join(["mtllib box.mtl", *lines]))
    (folder / "box.mtl").write_text("newmtl red\nmap_Kd red paint.png\nnewmtl blue\nmap_Kd blue.png\n")
    for name, data in IMAGES.items():
        (folder / name).write_bytes(data)
    scene = folder / "box.toml"
    scene.write_text(
        'frames = 4\n[materials.m]\n[[bodies]]\nname = "box"\ntype = "model"\nmaterial = "m"\nfile = "box.obj"\n'
        'resolution = 2\n[output]\nsurface = "model"\n'
    )
    return scene


@pytest.fixture(scope="module")
def painted(tmp_path_factory):
    """Return a folder with runs of the painted box: ``usdc`` and ``clips``."""
    folder = tmp_path_factory.mktemp("painted")
    for form in ("usdc", "clips"):
        scene = load_scene(painted_scene(folder), overrides={"output.format": form})
        simulate(scene, output=folder / form, device="cpu")
    return folder


def texture_bytes(path: Path) -> list[bytes]:
    """Return the contents of all files that a stage refers to."""
    _, assets, missing = UsdUtils.ComputeAllDependencies(str(path))
    assert missing == []
    if path.suffix == ".usdz":
        with zipfile.ZipFile(path) as archive:
            return sorted(archive.read(name) for name in archive.namelist() if not name.endswith(".usdc"))
    return sorted(Path(asset).read_bytes() for asset in assets)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("form", ["usdc", "clips"])
def test_a_packed_stage_has_all_of_it(tmp_path, painted, form, suffix):
    """Pack a run into a file elsewhere, and find every sample, material and texture in it, wherever it is moved."""
    output = tmp_path / "ä b" / f"packed{suffix}"
    pack(painted / form, output)
    moved = tmp_path / "moved"
    output.parent.rename(moved)
    output = moved / output.name
    expected = [output.name] if suffix == ".usdz" else [output.name, "packed_textures"]
    assert sorted(file.name for file in moved.iterdir()) == expected
    assert stage_problems(output) == []
    assert samples_of(output) == samples_of(painted / form)
    assert texture_bytes(output) == sorted(IMAGES.values())
    ours, theirs = open_stage(output), open_stage(painted / form)
    assert [str(prim.GetPath()) for prim in ours.Traverse()] == [str(prim.GetPath()) for prim in theirs.Traverse()]
    for key in ("defaultPrim", "metersPerUnit", "upAxis", "timeCodesPerSecond", "startTimeCode", "endTimeCode"):
        assert ours.GetMetadata(key) == theirs.GetMetadata(key)
    assert not ours.GetRootLayer().subLayerPaths
    assert not ours.GetDefaultPrim().HasAuthoredMetadata("clips")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_was_packed_can_be_packed_again(tmp_path, painted, suffix):
    """Go from each format to each other."""
    pack(painted / "usdc", tmp_path / f"first{suffix}")
    for other in SUFFIXES:
        pack(tmp_path / f"first{suffix}", tmp_path / f"second{other}")
        assert samples_of(tmp_path / f"second{other}") == samples_of(painted / "usdc")
        assert texture_bytes(tmp_path / f"second{other}") == sorted(IMAGES.values())


def test_an_unfinished_run_is_packed_with_one_range_of_colors(tmp_path):
    """Pack the frames of a run that is going on, all with the colours by the forces so far."""
    mesh = cube_surface(center=(0.0, 0.5, 0.0))
    writer = start_stage(tmp_path / "run", [mesh], make_scene())
    for frame in range(6):
        writer.write_frame(frame, [moved_surface(mesh, frame)])
        if frame % 2:
            writer.flush()
    pack(tmp_path / "run", tmp_path / "so_far.usdc")
    finished = write_stage(tmp_path / "finished.usdc", frames=6)
    assert samples_of(tmp_path / "so_far.usdc") == samples_of(finished)
    assert progress(open_stage(tmp_path / "so_far.usdc")) == (6, 48)
    assert stage_problems(tmp_path / "so_far.usdc") == []


def test_stages_of_others_are_packed_too(tmp_path):
    """Join a stage that refers to another one into one file."""
    write_stage(tmp_path / "part.usdc", frames=3)
    stage = Usd.Stage.CreateNew(str(tmp_path / "whole.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.DefinePrim("/Scene/thing").GetReferences().AddReference("./part.usdc")
    stage.SetDefaultPrim(stage.GetPrimAtPath("/Scene"))
    stage.Save()
    pack(tmp_path / "whole.usda", tmp_path / "out" / "packed.usdc")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["packed.usdc"]
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out" / "packed.usdc"))
    assert layer.GetCompositionAssetDependencies() == []
    points = layer.QueryTimeSample("/Scene/thing/bodies/cube/surface.points", 2)
    assert np.array(points).tobytes() == moved_surface(cube_surface(center=(0.0, 0.5, 0.0)), 2).points.tobytes()


def test_a_missing_texture_is_warned_of(tmp_path, painted, caplog):
    """Pack without a texture that is gone, and say so."""
    shutil.copytree(painted / "usdc", tmp_path / "run")
    (tmp_path / "run" / "textures" / "blue.png").unlink()
    with caplog.at_level(logging.WARNING):
        pack(tmp_path / "run", tmp_path / "packed.usdc")
    assert "./textures/blue.png is missing, and not packed" in caplog.text


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ("a.obj", "a.obj: a stage is packed into a file that ends in .usdc, .usda, .usdz"),
        ("stage.usda", "this name belongs to the stage"),
        ("stage.usdc", "this name belongs to the stage"),
        ("geometry.usdc", "this name belongs to the stage"),
    ],
)
def test_unusable_outputs_are_refused(tmp_path, painted, output, said):
    """Refuse other formats, and names that would damage the run."""
    with pytest.raises(InputError, match=said):
        pack(painted / "clips", painted / "clips" / output)


def test_a_place_that_cannot_be_written_is_reported(tmp_path, painted):
    """Say in one line that the output cannot be made, and leave nothing."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EnvironmentFailedError, match="cannot write the stage") as caught:
        pack(painted / "usdc", tmp_path / "file" / "packed.usdz")
    assert "\n" not in str(caught.value)
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("name", "damage", "said"),
    [
        ("geometry.usdc", Path.unlink, r"not complete: Could not load sublayer @.*geometry\.usdc@"),
        ("clips/frames.000000.usdc", Path.unlink, r"frames\.000000\.usdc: no such file"),
        (
            "clips/frames.000000.usdc",
            lambda file: file.write_bytes(file.read_bytes()[:900]),
            r"frames\.000000\.usdc: not a readable USD file: Sdf crate file corrupt",
        ),
    ],
)
def test_an_incomplete_stage_is_refused(tmp_path, painted, capfd, name, damage, said):
    """Say in one line, and no other, which part is missing or damaged, whatever looks at the stage; leave nothing."""
    shutil.copytree(painted / "clips", tmp_path / "run")
    damage(tmp_path / "run" / name)
    with pytest.raises(InputError, match=said) as caught:
        pack(tmp_path / "run", tmp_path / "packed.usdc")
    assert "\n" not in str(caught.value)
    assert len(stage_problems(tmp_path / "run")) > 0
    with pytest.raises(InputError, match="the stage is not sound, so it cannot be shown: ") as caught:
        render_preview(tmp_path / "run", tmp_path / "page.html")
    assert "\n" not in str(caught.value)
    assert [file.name for file in tmp_path.iterdir()] == ["run"]
    # USD prints by itself what it stumbles over.
    assert capfd.readouterr().err == ""


def test_the_command_packs(tmp_path, painted, monkeypatch, capfd):
    """Pack from the command line, and keep a file that is there unless forced."""

    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["warpjelly", "pack", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_code:
            cli.main()
        captured = capfd.readouterr()
        return int(exit_code.value.code or 0), captured.out + captured.err

    output = tmp_path / "packed.usdz"
    assert call(painted / "usdc", "-o", output) == (0, f"stage: {output}\n")
    code, said = call(painted / "usdc", "-o", output)
    assert (code, said.count("\n")) == (2, 1)
    assert "--force" in said
    assert call(painted / "usdc", "-o", output, "--force")[0] == 0
    code, said = call(tmp_path / "nothing", "-o", tmp_path / "a.usdc")
    assert (code, said) == (2, f"error: {tmp_path / 'nothing'}: no such file\n")
    logging.getLogger("warpjelly").handlers = []
