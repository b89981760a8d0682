"""Previews: the right frame through the stage's camera, in the stage's colours, or one clear line."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import cube_surface, make_scene, moved_surface, start_stage, write_stage

from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.previews.preview import render_preview
from warpjelly.previews.view import View
from warpjelly.stage.stagefiles import open_stage

SIZE = (320, 180)


def pixels(path: Path) -> np.ndarray:
    """Return a picture, float [height, width, 3] in 0 to 1."""
    from PIL import Image

    with Image.open(path) as picture:
        assert picture.format == "PNG"
        return np.asarray(picture.convert("RGB")) / 255


def colorful(picture: np.ndarray) -> np.ndarray:
    """Return which pixels show jelly, bool [height, width]: floor, colliders and background are nearly grey."""
    return np.ptp(picture, axis=2) > 0.2


def projected(path: Path, frame: int, size: tuple[int, int]) -> np.ndarray:
    """Return where the stage's camera sees the points of the cube, (column, row) [n, 2] in pixels."""
    stage = Usd.Stage.Open(str(path))
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(frame).frustum
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/bodies/cube/surface")).GetPointsAttr().Get(frame))
    clip = np.c_[points, np.ones(len(points))] @ np.array(
        frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    )
    x, y = (clip[:, :2] / clip[:, 3:]).T
    return np.stack([(x + 1) / 2 * size[0], (1 - y) / 2 * size[1]], axis=1)


FLOOR = {"Y": [0.0, 1.0, 0.0], "Z": [0.0, 0.0, 1.0]}


@pytest.mark.egl
@pytest.mark.parametrize("up_axis", ["Y", "Z"])
@pytest.mark.parametrize("frame", [0, 9])
def test_body_appears_where_the_camera_sees_it(tmp_path: Path, up_axis: str, frame: int) -> None:
    """Show jelly exactly where the stage's own camera projects it."""
    floor = [{"name": "floor", "type": "half_space", "normal": FLOOR[up_axis]}]
    path = write_stage(tmp_path / "stage.usdc", make_scene(up_axis=up_axis, colliders=floor))
    render_preview(path, tmp_path / "p.png", frames=[frame], size=SIZE)
    picture = pixels(tmp_path / "p.png")
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    # The legend in the lower right corner is as colourful as jelly.
    shown = colorful(picture[: SIZE[1] * 5 // 6])
    expected = projected(path, frame, SIZE)
    rows, columns = np.nonzero(shown)
    found = np.array([columns.min(), columns.max() + 1, rows.min()])
    wanted = np.array([expected[:, 0].min(), expected[:, 0].max(), expected[:, 1].min()])
    np.testing.assert_allclose(found, wanted, atol=3)
    inside = expected.mean(axis=0).astype(int)
    assert shown[inside[1], inside[0]]


@pytest.mark.egl
def test_colors_follow_the_forces(tmp_path: Path) -> None:
    """Show the same shape raspberry where forces are low and yellow where they are high."""
    hues = []
    for force_range in ((100.0, 200.0), (0.0, 1e-3)):
        path = write_stage(tmp_path / "stage.usdc", make_scene(output={"force_range": force_range}))
        render_preview(path, tmp_path / "p.png", frames=[5], size=SIZE, force=True)
        picture = pixels(tmp_path / "p.png")[: SIZE[1] * 5 // 6]
        hues.append(picture[colorful(picture)].mean(axis=0))
    low, high = hues
    assert low[1] < 0.7 * low[0] and low[2] > low[1]
    assert high[1] > 0.7 * high[0] and high[2] < 0.5 * high[1]


@pytest.mark.egl
def test_shadow_falls_on_the_floor(tmp_path: Path) -> None:
    """Darken the floor below the body, so that height and contact can be judged."""
    floor = [{"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [10.0, 10.0]}]
    darkened = []
    for name, center in (("far", -20.0), ("on", 0.0)):
        floor[0]["center"] = [0.0, center, 0.0]
        path = write_stage(tmp_path / f"{name}.usdc", make_scene(colliders=floor))
        render_preview(path, tmp_path / f"{name}.png", frames=[0], size=SIZE)
        picture = pixels(tmp_path / f"{name}.png")
        dark = ~colorful(picture) & (picture.max(axis=2) < 0.65)
        darkened.append(dark[: SIZE[1] * 5 // 6].sum())
    far, on = darkened
    assert on > far + 300


@pytest.mark.egl
def test_frames_stand_side_by_side(tmp_path: Path) -> None:
    """Lay several frames out in a row, each of the size asked for."""
    path = write_stage(tmp_path / "stage.usdc")
    render_preview(tmp_path, tmp_path / "deep" / "row.png", frames=[0, 4, 9], size=(200, 150))
    picture = pixels(tmp_path / "deep" / "row.png")
    assert picture.shape == (150, 3 * 200 + 2 * 4, 3)
    panels = [picture[:, i * 204 : i * 204 + 200] for i in range(3)]
    assert all(colorful(panel).sum() > 1000 for panel in panels)
    assert np.abs(panels[0] - panels[2]).mean() > 0.02
    assert [file.name for file in (tmp_path / "deep").iterdir()] == ["row.png"]
    assert path.exists()


@pytest.mark.egl
@pytest.mark.parametrize("color", ["indexed", "rgb"])
def test_hardest_impact_is_the_default(tmp_path: Path, color: str) -> None:
    """Show the frame with the greatest forces unless told otherwise."""
    mesh = cube_surface()
    writer = start_stage(tmp_path, [mesh], make_scene(output={"color": color}))
    for frame, force in enumerate((1.0, 2.0, 5.0, 2.0, 3.0)):
        forces = np.full(len(mesh.points), force, dtype=np.float32)
        writer.write_frame(frame, [replace(moved_surface(mesh, frame), forces=forces)])
    writer.finish()
    render_preview(tmp_path, tmp_path / "default.png", size=SIZE)
    render_preview(tmp_path, tmp_path / "hardest.png", frames=[2], size=SIZE)
    np.testing.assert_array_equal(pixels(tmp_path / "default.png"), pixels(tmp_path / "hardest.png"))


@pytest.mark.egl
def test_no_frame_shows_those_before(tmp_path: Path) -> None:
    """Render a frame after others, and after another stage, exactly as by itself, its shadow included."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    other = open_stage(write_stage(tmp_path / "other.usdc", meshes=[cube_surface(count=3, center=(2.0, 1.0, 0.0))]))
    with View(SIZE) as view:
        view.look_at(stage)
        after = [view.render(frame) for frame in (9, 0, 4)][-1]
        view.look_at(other)
        view.render(0)
        view.look_at(stage)
        np.testing.assert_array_equal(view.render(4), after)
    with View(SIZE) as view:
        view.look_at(stage)
        np.testing.assert_array_equal(view.render(4), after)


def frames_of(movie: Path) -> np.ndarray:
    """Return the frames of a movie, float [frame_count, height, width, 3] in 0 to 1, decoded by ffmpeg."""
    from imageio_ffmpeg import read_frames

    reader = read_frames(str(movie))
    width, height = next(reader)["size"]
    return np.array([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]) / 255


@pytest.mark.egl
def test_movie_shows_every_frame_in_real_time(tmp_path: Path) -> None:
    """Make an MP4 that every browser plays, of even size, with the frames' pictures, as long as the motion."""
    from imageio_ffmpeg import read_frames

    path, movie, done = write_stage(tmp_path / "stage.usdc"), tmp_path / "m.mp4", []
    render_preview(path, movie, size=(321, 179), progress=lambda count, total: done.append((count, total)))
    about = next(read_frames(str(movie)))
    assert (about["codec"], about["pix_fmt"].partition("(")[0]) == ("h264", "yuv420p")
    assert (about["size"], about["fps"]) == ((322, 180), 24.0)
    assert about["duration"] == pytest.approx(10 / 24, abs=0.02)
    assert done == [(count, 10) for count in range(1, 11)]
    shown = frames_of(movie)
    assert len(shown) == 10
    for frame in (0, 9):
        render_preview(path, tmp_path / f"{frame}.png", frames=[frame], size=(322, 180))
        assert np.abs(shown[frame] - pixels(tmp_path / f"{frame}.png")).mean() < 0.02
    assert np.abs(shown[0] - shown[9]).mean() > 0.05


@pytest.mark.egl
def test_thinned_movie_keeps_its_pace(tmp_path: Path) -> None:
    """Show every third frame from the first to the last asked for, each for three frames' time, in a WebP for ever."""
    from PIL import Image

    path = write_stage(tmp_path / "stage.usdc")
    render_preview(path, tmp_path / "m.webp", frames=[1, 8], every=3, size=(160, 90))
    with Image.open(tmp_path / "m.webp") as movie:
        assert (movie.format, movie.size, movie.n_frames, movie.info["loop"]) == ("WEBP", (160, 90), 3, 0)
        durations = []
        for number in range(movie.n_frames):
            movie.seek(number)
            movie.load()
            durations.append(movie.info["duration"])
    np.testing.assert_allclose(durations, 3 / 24 * 1000, atol=1)


def test_more_frames_than_movies_show_are_refused(tmp_path: Path) -> None:
    """Say how to thin the frames of a stage that has very many a second."""
    path = write_stage(tmp_path / "stage.usdc", make_scene(fps=2000.0))
    with pytest.raises(InputError, match=r"1000 frames a second .* --every 17"):
        render_preview(path, tmp_path / "m.webp", every=2)


@pytest.mark.egl
def test_failing_encoder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say in one line that ffmpeg failed and why, and leave no movie behind."""
    import imageio_ffmpeg

    encoder = tmp_path / "ffmpeg"
    encoder.write_text("#!/bin/sh\necho no space >&2\nexit 1\n")
    encoder.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(encoder))
    path = write_stage(tmp_path / "stage.usdc")
    with pytest.raises(EnvironmentFailedError, match=r"m\.mp4: cannot write the preview: ffmpeg: no space"):
        render_preview(path, tmp_path / "m.mp4", size=SIZE)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["ffmpeg", "stage.usdc"]


@pytest.mark.egl
def test_all_colliders_are_drawn(tmp_path: Path) -> None:
    """Draw balls, ramps and rooms without a word on the terminal, and the rest pose of an empty run."""
    colliders = [
        {"name": "ball", "type": "sphere", "center": [1.5, 0.5, 0.0], "radius": 0.5},
        {"name": "ramp", "type": "plane", "center": [-1.5, 0.0, 0.0], "normal": [1.0, 1.0, 0.0], "size": [2.0, 1.0]},
        {"name": "room", "type": "box", "size": [6.0, 6.0, 6.0]},
    ]
    path = write_stage(tmp_path / "stage.usdc", make_scene(colliders=colliders), frames=0)
    script = (
        "import sys; from pathlib import Path; from warpjelly.previews.preview import render_preview\n"
        "render_preview(Path(sys.argv[1]), Path(sys.argv[2]), size=(160, 90))"
    )
    command = [sys.executable, "-c", script, str(path), str(tmp_path / "p.png")]
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    assert process.stdout + process.stderr == ""
    assert len(np.unique(pixels(tmp_path / "p.png").reshape(-1, 3), axis=0)) > 100


@pytest.mark.egl
def test_unwritable_output_is_reported(tmp_path: Path) -> None:
    """Say in one line that the picture cannot be written."""
    path = write_stage(tmp_path / "stage.usdc")
    with pytest.raises(EnvironmentFailedError, match="cannot write the preview"):
        render_preview(path, path / "p.png", frames=[0], size=(32, 32))


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is how Linux renders offscreen")
def test_missing_egl_is_explained(tmp_path: Path) -> None:
    """Say what to install instead of crashing where no OpenGL driver answers."""
    pytest.importorskip("pyvista")
    path = write_stage(tmp_path / "stage.usdc", frames=1)
    script = (
        "import sys; from pathlib import Path; from warpjelly.previews.preview import render_preview\n"
        "from warpjelly.errors import EnvironmentFailedError\n"
        "try:\n"
        "    render_preview(Path(sys.argv[1]), Path(sys.argv[2]), size=(160, 90))\n"
        "except EnvironmentFailedError as error:\n"
        "    print(error)\n"
    )
    environment = {**os.environ, "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    command = [sys.executable, "-c", script, str(path), str(tmp_path / "p.png")]
    said = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    assert "apt install libegl1 libgl1-mesa-dri" in said.stdout
    assert said.stdout.count("\n") == 1
    assert said.stderr == ""


@pytest.mark.parametrize(
    ("output", "frames", "size", "what"),
    [
        ("p.jpg", None, SIZE, r"ends in \.png, \.mp4"),
        ("p.mp4", [1], SIZE, "first to the second of two --frame"),
        ("p.mp4", [5, 3], SIZE, "first to the second of two --frame"),
        ("p.webp", [1, 10], SIZE, "no frame 10; frames are 0 to 9"),
        ("p.png", [10], SIZE, "no frame 10; frames are 0 to 9"),
        ("p.png", [0, -1], SIZE, "no frame -1; frames are 0 to 9"),
        ("p.png", [], SIZE, "no frame to show"),
        ("p.png", [0], (0, 90), "size 0x90: each side must be 16 to 8192 pixels"),
        ("p.png", [0] * 10, (8000, 8000), "10 frames of 8000x8000: more than"),
    ],
)
def test_wrong_arguments_are_explained(
    tmp_path: Path, output: str, frames: list[int] | None, size: tuple[int, int], what: str
) -> None:
    """Refuse what cannot be shown, saying what can."""
    path = write_stage(tmp_path / "stage.usdc")
    with pytest.raises(InputError, match=what):
        render_preview(path, tmp_path / output, frames=frames, size=size)
    assert not (tmp_path / output).exists()


@pytest.mark.parametrize(("output", "every"), [("p.png", 2), ("p.mp4", 0)])
def test_wrong_thinning_is_explained(tmp_path: Path, output: str, every: int) -> None:
    """Refuse to thin single frames, and by nothing."""
    with pytest.raises(InputError, match="every"):
        render_preview(write_stage(tmp_path / "stage.usdc"), tmp_path / output, every=every)


def test_file_that_is_there_is_kept(tmp_path: Path) -> None:
    """Refuse to replace a file unless told to."""
    (tmp_path / "p.png").write_text("mine")
    with pytest.raises(InputError, match=r"p\.png: there already; .*--force"):
        render_preview(write_stage(tmp_path / "stage.usdc"), tmp_path / "p.png")
    assert (tmp_path / "p.png").read_text() == "mine"


@pytest.mark.parametrize(("module", "output"), [("pyvista", "p.png"), ("imageio_ffmpeg", "p.mp4")])
def test_missing_extra_is_explained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, output: str) -> None:
    """Name the extra that brings what is missing, before anything is rendered."""
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=r"pip install 'warpjelly\[preview\]'"):
        render_preview(write_stage(tmp_path / "stage.usdc"), tmp_path / output)


def test_missing_stage_is_explained(tmp_path: Path) -> None:
    """Refuse a directory without a stage."""
    with pytest.raises(InputError, match=r"no stage\.usdc or stage\.usda in this directory"):
        render_preview(tmp_path, tmp_path / "p.png")
