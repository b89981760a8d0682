"""The stage writer: what it writes is what was given, nothing is ever half-written, and any viewer shows it well."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from stages import cube_surface, make_scene, moved_surface, start_stage, write_stage

from warpjelly.colors import (
    COLOR_COUNT,
    LINEAR_TABLE,
    SRGB_TABLE,
    color_indices,
    linear_from_srgb,
    range_in_words,
    srgb_from_linear,
)
from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.shapes import ShapeFrame
from warpjelly.stage.histogram import ForceHistogram
from warpjelly.stage.stagefiles import find_stage, open_stage, progress
from warpjelly.stage.validate import stage_problems

FORMS = ["usdc", "clips"]
FLOORS = {
    "Y": [{"name": "floor", "type": "half_space", "normal": [0.0, 1.0, 0.0]}],
    "Z": [{"name": "floor", "type": "half_space", "normal": [0.0, 0.0, 1.0]}],
}


def surface_of(stage: Usd.Stage, body: str = "cube") -> UsdGeom.Mesh:
    """Return the surface of a body."""
    return UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/bodies/{body}/surface"))


def motion(frames: int = 10, center: tuple[float, float, float] = (0.0, 0.5, 0.0)) -> list[ShapeFrame]:
    """Return the frames that ``write_stage`` writes."""
    mesh = cube_surface(center=center)
    return [moved_surface(mesh, frame) for frame in range(frames)]


def write_clips(folder: Path, form: str, **output: object) -> Path:
    """Write the frames of ``motion`` by way of clips of three, and return the stage, in one file or in parts."""
    mesh = cube_surface(center=(0.0, 0.5, 0.0))
    writer = start_stage(folder, [mesh], make_scene(output={"format": form, **output}))
    for frame in range(10):
        writer.write_frame(frame, [moved_surface(mesh, frame)])
        if frame % 3 == 2:
            writer.flush()
    assert len(list((folder / "clips").glob("frames.*.usdc"))) == 3
    writer.finish()
    return find_stage(folder)


def seen(camera: UsdGeom.Camera, points: np.ndarray) -> np.ndarray:
    """Project points [n, 3]; within the picture and the clipping range, all that is returned is -1 to 1."""
    frustum = camera.GetCamera(Usd.TimeCode.Default()).frustum
    matrix = np.array(frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())
    clip = np.c_[points, np.ones(len(points))] @ matrix
    return clip[:, :3] / clip[:, 3:]


def test_colors_get_lighter_evenly() -> None:
    """Keep the colour map readable in grey: lightness rises from entry to entry, without jumps."""
    luminance = LINEAR_TABLE @ np.array([0.2126, 0.7152, 0.0722])
    steps = np.diff(116 * np.cbrt(luminance) - 16)
    assert steps.min() > 0
    assert steps.max() < 4 * steps.mean()


def test_color_encodings_are_inverse() -> None:
    """Decode what was encoded, and anchor the curve at the known mid grey."""
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(SRGB_TABLE)), SRGB_TABLE, atol=1e-6)
    assert linear_from_srgb(np.array(0.5)) == pytest.approx(0.21404, abs=1e-5)


def test_color_indices_cover_the_table() -> None:
    """Map the range onto the table and everything outside it, NaN and infinity too, onto its ends."""
    force = np.array([1.0, 2.0, 3.0, -5.0, 99.0, np.inf, np.nan], dtype=np.float32)
    indices = color_indices(force, (1.0, 3.0))
    assert indices.dtype == np.int32
    assert indices.tolist() == [0, 128, 255, 0, 255, 255, 255]


@pytest.mark.parametrize(
    ("force_range", "words"),
    [
        ((0.0, 220.0), ("0", "220")),
        ((9.9e-42, 4.68), ("0", "4.68")),
        ((0.0, 5.0), ("0", "5")),
        ((0.25, 12.5), ("0.25", "12.5")),
        ((217.64, 2204.1), ("218", "2,200")),
        ((0.000123, 0.0981), ("0.000123", "0.0981")),
        ((0.0, 999_960.0), ("0", "1e6")),
        ((1.96e-6, 3e-6), ("1.96e-6", "3e-6")),
        ((-3.0, 0.001), ("-3", "0")),
    ],
)
def test_forces_are_said_as_people_write_them(force_range: tuple[float, float], words: tuple[str, str]) -> None:
    """Round to three digits, without exponents of usual numbers, and call next to nothing 0."""
    assert range_in_words(force_range) == words


@pytest.mark.parametrize("form", FORMS)
def test_points_are_bit_exact_in_another_process(tmp_path: Path, form: str) -> None:
    """Read every array of every frame in a fresh process, bit for bit as written."""
    path = write_clips(tmp_path, form, velocities=True)
    script = (
        "import sys, numpy as np; from pxr import Usd\n"
        "stage = Usd.Stage.Open(sys.argv[1])\n"
        "p = stage.GetPrimAtPath('/World/bodies/cube/surface')\n"
        "names = ('points', 'normals', 'velocities')\n"
        "np.savez(sys.argv[2], **{f'{n}{t}': np.array(p.GetAttribute(n).Get(t)) for n in names for t in range(10)})\n"
    )
    subprocess.run([sys.executable, "-c", script, str(path), str(tmp_path / "read.npz")], check=True)
    with np.load(tmp_path / "read.npz") as read:
        for t, frame in enumerate(motion()):
            for name in ("points", "normals", "velocities"):
                assert read[f"{name}{t}"].tobytes() == getattr(frame, name).tobytes(), (name, t)


def test_rest_pose_is_the_default(tmp_path: Path) -> None:
    """Give readers without time the rest pose: points, normals, extent, resting colour."""
    rest = cube_surface(center=(0.0, 0.5, 0.0))
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    mesh = surface_of(stage)
    assert np.array(mesh.GetPointsAttr().Get()).tobytes() == rest.points.tobytes()
    assert np.array(mesh.GetNormalsAttr().Get()).tobytes() == rest.rest.normals.tobytes()
    assert np.array(mesh.GetExtentAttr().Get()).tolist() == [[-0.5, 0.0, -0.5], [0.5, 1.0, 0.5]]
    assert np.array_equal(mesh.GetFaceVertexIndicesAttr().Get(), rest.shape.corners)
    color = UsdGeom.Primvar(mesh.GetDisplayColorAttr()).ComputeFlattened()
    np.testing.assert_array_equal(color, np.tile(LINEAR_TABLE[0], (len(rest.points), 1)))


def test_only_what_moves_is_sampled(tmp_path: Path) -> None:
    """Write topology and the colour table once, and velocities only when asked for."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    mesh = surface_of(stage)
    sampled = {a.GetName() for a in mesh.GetPrim().GetAuthoredAttributes() if a.GetNumTimeSamples()}
    assert sampled == {"points", "normals", "extent", "primvars:displayColor:indices"}
    assert not mesh.GetVelocitiesAttr().HasAuthoredValue()
    assert len(mesh.GetDisplayColorAttr().Get()) == COLOR_COUNT


@pytest.mark.parametrize("color", ["indexed", "rgb"])
def test_colors_are_the_forces(tmp_path: Path, color: str) -> None:
    """Colour every point of every frame by its force, whichever way colours are stored."""
    scene = make_scene(output={"color": color, "force_range": (1.0, 8.0)})
    stage = open_stage(write_stage(tmp_path / "stage.usdc", scene))
    mesh = surface_of(stage)
    primvar = UsdGeom.Primvar(mesh.GetDisplayColorAttr())
    assert primvar.IsIndexed() == (color == "indexed")
    for t, frame in enumerate(motion()):
        share = np.clip((frame.forces.astype(np.float64) - 1.0) / 7.0, 0, 1)
        expected = np.stack([np.interp(share, np.linspace(0, 1, COLOR_COUNT), c) for c in LINEAR_TABLE.T], axis=1)
        # Half an entry of the table is the rounding that indices cost.
        half_entry = np.abs(np.diff(LINEAR_TABLE, axis=0)).max() / 2
        np.testing.assert_allclose(primvar.ComputeFlattened(t), expected, atol=half_entry + 1e-6)


def test_extents_hold_the_points(tmp_path: Path) -> None:
    """Write the exact extent of every frame."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    mesh = surface_of(stage)
    for t, frame in enumerate(motion()):
        extent = np.array(mesh.GetExtentAttr().Get(t))
        np.testing.assert_array_equal(extent, [frame.points.min(axis=0), frame.points.max(axis=0)])


def test_automatic_range_is_the_runs_percentiles(tmp_path: Path) -> None:
    """Stretch colours from the 1st to the 99th percentile of the whole run and say so in the legend."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    legend = stage.GetDefaultPrim().GetCustomDataByKey("legend")
    expected = np.percentile(np.concatenate([frame.forces for frame in motion()]), (1, 99))
    np.testing.assert_allclose(legend["range"], expected, rtol=2**-9)
    assert legend["unit"] == "N"
    indices = UsdGeom.Primvar(surface_of(stage).GetDisplayColorAttr()).GetIndicesAttr()
    for t, frame in enumerate(motion()):
        np.testing.assert_array_equal(indices.Get(t), color_indices(frame.forces, tuple(legend["range"])))


@pytest.mark.parametrize("force", [0.0, 0.0981])
def test_equal_forces_have_one_color(tmp_path: Path, force: float) -> None:
    """Don't stretch colours over rounding when all forces are equal, as in free fall, or zero."""
    rng = np.random.default_rng(0)
    mesh = cube_surface()
    writer = start_stage(tmp_path, [mesh])
    for t in range(3):
        frame = moved_surface(mesh, t)
        noisy = (force * (1 + 1e-4 * rng.standard_normal(len(mesh.points)))).astype(np.float32)
        writer.write_frame(t, [ShapeFrame(frame.points, frame.normals, frame.velocities, noisy)])
    writer.finish()
    stage = open_stage(tmp_path / "stage.usdc")
    primvar = UsdGeom.Primvar(surface_of(stage).GetDisplayColorAttr())
    assert all(max(primvar.GetIndices(t)) <= 1 for t in range(3))


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_camera_sees_every_corner_at_every_frame(tmp_path: Path, up_axis: str) -> None:
    """Frame the whole motion: nothing leaves the picture or the clipping range, and it fills most of it."""
    scene = make_scene(up_axis=up_axis, colliders=FLOORS[up_axis])
    stage = open_stage(write_stage(tmp_path / "stage.usdc", scene))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera"))
    mesh = surface_of(stage)
    projected = np.concatenate([seen(camera, np.array(mesh.GetPointsAttr().Get(t))) for t in range(10)])
    assert np.abs(projected).max() < 1
    assert np.abs(projected[:, :2]).max() > 0.75
    view = camera.GetCamera(Usd.TimeCode.Default()).frustum
    up = Gf.Vec3d(0, 1, 0) if up_axis == "Y" else Gf.Vec3d(0, 0, 1)
    assert view.ComputeUpVector() * up > 0.8
    assert view.ComputeViewDirection() * up < -0.2


def test_camera_includes_a_ball_close_by(tmp_path: Path) -> None:
    """Keep the ball that a body falls on in the picture, but not a planet that it stands on."""
    balls = [
        {"name": "ball", "type": "sphere", "center": [1.5, 0.3, 0.0], "radius": 0.5},
        {"name": "planet", "type": "sphere", "center": [0.0, -1000.0, 0.0], "radius": 1000.0},
    ]
    stage = open_stage(write_stage(tmp_path / "stage.usdc", make_scene(colliders=balls)))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera"))
    corners = np.array(balls[0]["center"]) + 0.5 * (2 * np.array(list(np.ndindex(2, 2, 2))) - 1)
    assert np.abs(seen(camera, corners)).max() < 1
    assert camera.GetCamera(Usd.TimeCode.Default()).frustum.GetPosition().GetLength() < 20


@pytest.mark.parametrize("fps", [24.0, 60.0, 29.97])
def test_time_codes_are_frame_numbers(tmp_path: Path, fps: float) -> None:
    """Sample at 0, 1, 2 ... whatever the frame rate, and say how fast to play."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc", make_scene(fps=fps), frames=7))
    assert surface_of(stage).GetPointsAttr().GetTimeSamples() == [0, 1, 2, 3, 4, 5, 6]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 6)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == fps


def test_stage_says_what_it_is(tmp_path: Path) -> None:
    """Write units, up axis, kinds, name and provenance, of which USD cannot store all as it is."""
    provenance = {"seed": 7, "deterministic": True, "dt": 1e-3, "scene": {"a": [1, None]}, "steps": np.int64(2**40)}
    mesh = cube_surface()
    writer = start_stage(tmp_path, [mesh], provenance=provenance)
    writer.finish()
    stage = open_stage(tmp_path / "stage.usdc")
    world = stage.GetDefaultPrim()
    assert world.GetPath() == "/World"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert Usd.ModelAPI(world).GetAssetName() == "test"
    assert Usd.ModelAPI(stage.GetPrimAtPath("/World/bodies/cube")).IsModel()
    assert world.GetCustomDataByKey("provenance") == {
        "seed": 7,
        "deterministic": True,
        "dt": 1e-3,
        "scene": '{"a": [1, null]}',
        "steps": 2**40,
    }


def test_jelly_shows_its_colors(tmp_path: Path) -> None:
    """Bind a material that reads displayColor, so that renderers show the forces."""
    stage = open_stage(write_stage(tmp_path / "stage.usdc"))
    material = UsdShade.MaterialBindingAPI(surface_of(stage)).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0]
    reader = UsdShade.Shader(shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
    assert reader.GetInput("varname").Get() == "displayColor"


def test_colliders_are_drawn_where_they_are(tmp_path: Path) -> None:
    """Draw each kind of collider in place, walls with their front towards the bodies."""
    colliders = [
        {"name": "table", "type": "plane", "center": [0.0, -0.5, 0.0], "normal": [0.0, 2.0, 0.0], "size": [4.0, 2.0],
         "tangent": [1.0, 0.0, 0.0]},
        {"name": "ceiling", "type": "half_space", "center": [0.0, 3.0, 0.0], "normal": [0.0, 1.0, 0.0]},
        {"name": "ball", "type": "sphere", "center": [2.0, 0.5, 0.0], "radius": 0.5},
        {"name": "room", "type": "box", "center": [0.0, 2.0, 0.0], "size": [4.0, 5.0, 6.0]},
    ]  # fmt: skip
    path = write_stage(tmp_path / "stage.usdc", make_scene(colliders=colliders))
    assert stage_problems(path) == []
    stage = open_stage(path)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])

    def bounds(name: str) -> np.ndarray:
        box = cache.ComputeWorldBound(stage.GetPrimAtPath(f"/World/colliders/{name}")).ComputeAlignedRange()
        return np.array([box.GetMin(), box.GetMax()])

    np.testing.assert_allclose(bounds("table"), [[-2, -0.5, -1], [2, -0.5, 1]], atol=1e-6)
    np.testing.assert_allclose(bounds("ball"), [[1.5, 0, -0.5], [2.5, 1, 0.5]], atol=1e-6)
    np.testing.assert_allclose(bounds("room"), [[-2, -0.5, -3], [2, 4.5, 3]], atol=0.02)
    ceiling = bounds("ceiling")
    assert ceiling[0, 1] == ceiling[1, 1] == 3
    assert (ceiling[1] - ceiling[0])[[0, 2]].min() > 10
    for name, up in (("table", 1), ("ceiling", -1)):
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/colliders/{name}"))
        a, b, c = np.array(mesh.GetPointsAttr().Get())[list(mesh.GetFaceVertexIndicesAttr().Get())[:3]]
        assert np.sign(np.cross(b - a, c - b)[1]) == up, name
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), [[0, up, 0]] * 4, atol=1e-6)


def test_several_bodies_keep_apart(tmp_path: Path) -> None:
    """Write each body under its own name."""
    meshes = [cube_surface("left", center=(-1.0, 0.5, 0.0)), cube_surface("right", count=3, center=(1.0, 0.5, 0.0))]
    path = write_stage(tmp_path / "stage.usdc", meshes=meshes)
    assert stage_problems(path) == []
    stage = open_stage(path)
    for mesh in meshes:
        read = np.array(surface_of(stage, mesh.shape.body).GetPointsAttr().Get(4))
        assert read.tobytes() == moved_surface(mesh, 4).points.tobytes()


@pytest.mark.parametrize("output", [{}, {"color": "rgb", "velocities": True}, {"force_range": (0.0, 5.0)}])
@pytest.mark.parametrize("frames", [0, 1, 4])
def test_stage_is_sound_after_any_number_of_frames(tmp_path: Path, frames: int, output: dict[str, object]) -> None:
    """Close into a sound stage however early a run ends."""
    path = write_stage(tmp_path / "stage.usdc", make_scene(output=output), frames=frames)
    assert stage_problems(path) == []
    assert open_stage(path).GetEndTimeCode() == max(frames - 1, 0)


def test_buffers_may_be_reused(tmp_path: Path) -> None:
    """Copy what a frame holds, since the simulator writes the next frame into the same arrays."""
    mesh = cube_surface()
    frame = ShapeFrame(*(np.zeros_like(mesh.points) for _ in range(3)), np.zeros(len(mesh.points), np.float32))
    writer = start_stage(tmp_path, [mesh])
    for t in range(3):
        frame.points[:] = t + mesh.points
        frame.forces[:] = t
        writer.write_frame(t, [frame])
    writer.finish()
    stage = open_stage(tmp_path / "stage.usdc")
    surface = surface_of(stage)
    for t in range(3):
        np.testing.assert_array_equal(surface.GetPointsAttr().Get(t), t + mesh.points)
    indices = UsdGeom.Primvar(surface.GetDisplayColorAttr()).GetIndicesAttr()
    assert [indices.Get(t)[0] for t in range(3)] == [0, 128, 255]


def test_frames_out_of_order_are_refused(tmp_path: Path) -> None:
    """Refuse a frame that skips a number and a surface of another size."""
    mesh = cube_surface()
    writer = start_stage(tmp_path, [mesh])
    with pytest.raises(ValueError, match="frame 1 written where frame 0 is due"):
        writer.write_frame(1, [moved_surface(mesh, 1)])
    with pytest.raises(ValueError, match="cube: points"):
        writer.write_frame(0, [moved_surface(cube_surface(count=3), 0)])


def test_a_stage_can_be_opened_from_the_start(tmp_path: Path) -> None:
    """Find the rest pose after a process that was killed before a clip was written, and the frames of clips after."""
    script = (
        "import os, sys; sys.path.insert(0, sys.argv[2])\n"
        "from pathlib import Path\n"
        "from stages import *\n"
        "mesh, clips = cube_surface(center=(0.0, 0.5, 0.0)), int(sys.argv[3])\n"
        "writer = start_stage(Path(sys.argv[1]), [mesh])\n"
        "for frame in range(9):\n"
        "    writer.write_frame(frame, [moved_surface(mesh, frame)])\n"
        "    if frame % 3 == 2 and frame < 3 * clips:\n"
        "        writer.flush()\n"
        "os._exit(9)\n"
    )
    write_stage(tmp_path / "stage.usdc", frames=3)
    before = (tmp_path / "stage.usdc").read_bytes()
    for clips in (0, 1, 2):
        command = [sys.executable, "-c", script, str(tmp_path), str(Path(__file__).parent), str(clips)]
        assert subprocess.run(command, check=False).returncode == 9
        assert stage_problems(tmp_path) == []
        stage = open_stage(tmp_path)
        points = surface_of(stage).GetPointsAttr()
        assert points.GetTimeSamples() == list(range(3 * clips))
        for t in range(3 * clips):
            assert np.array(points.Get(t)).tobytes() == motion()[t].points.tobytes()
        assert np.array(points.Get()).tobytes() == cube_surface(center=(0.0, 0.5, 0.0)).points.tobytes()
        assert progress(stage) == (3 * clips, 48)
        # What was there before stays until the new one is whole.
        assert (tmp_path / "stage.usdc").read_bytes() == before


@pytest.mark.parametrize("form", FORMS)
def test_between_frames_points_are_interpolated(tmp_path: Path, form: str) -> None:
    """Give the mean of two frames half way between them, also where one ends a clip and the other starts the next."""
    stage = open_stage(write_clips(tmp_path, form))
    points = surface_of(stage).GetPointsAttr()
    for t in range(9):
        middle = (motion()[t].points + motion()[t + 1].points) / 2
        # One float32 rounding each.
        np.testing.assert_allclose(points.Get(t + 0.5), middle, rtol=0, atol=2e-7)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 100.0), (2.0, -3.5), (0.5, 7.25)])
@pytest.mark.parametrize("form", FORMS)
def test_a_shot_may_use_the_stage_at_another_time(tmp_path: Path, form: str, scale: float, offset: float) -> None:
    """Refer to the stage with an offset and a scale of time: frame t is at scale t + offset, to the bit."""
    path = write_clips(tmp_path / "run", form)
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.SetTimeCodesPerSecond(make_scene().fps)
    references = shot.DefinePrim("/Set/jelly").GetReferences()
    references.AddReference(f"./run/{path.name}", layerOffset=Sdf.LayerOffset(offset, scale))
    shot.Save()
    shot, stage = Usd.Stage.Open(str(tmp_path / "shot.usda")), open_stage(path)
    mesh = UsdGeom.Mesh.Get(shot, "/Set/jelly/bodies/cube/surface")
    indices, own = (UsdGeom.Primvar(one.GetDisplayColorAttr()).GetIndicesAttr() for one in (mesh, surface_of(stage)))
    assert mesh.GetPointsAttr().GetTimeSamples() == [scale * t + offset for t in range(10)]
    for t, frame in enumerate(motion()):
        time = scale * t + offset
        assert np.array(mesh.GetPointsAttr().Get(time)).tobytes() == frame.points.tobytes()
        assert np.array(mesh.GetNormalsAttr().Get(time)).tobytes() == frame.normals.tobytes()
        assert np.array_equal(indices.Get(time), own.Get(t))
    middle = (motion()[2].points + motion()[3].points) / 2
    # One float32 rounding each.
    np.testing.assert_allclose(mesh.GetPointsAttr().Get(scale * 2.5 + offset), middle, rtol=0, atol=2e-7)
    # Before the first frame and after the last one nothing moves.
    assert np.array(mesh.GetPointsAttr().Get(offset - 5)).tobytes() == motion()[0].points.tobytes()
    assert np.array(mesh.GetPointsAttr().Get(scale * 9 + offset + 5)).tobytes() == motion()[9].points.tobytes()


def test_colors_of_clips_get_one_range_in_the_end(tmp_path: Path) -> None:
    """Colour clips by the forces so far, and all of them by those of the whole run when it has finished."""
    mesh = cube_surface(center=(0.0, 0.5, 0.0))
    for form in ("clips", "usdc"):
        writer = start_stage(tmp_path / form, [mesh], make_scene(output={"format": form}))
        for frame in range(10):
            writer.write_frame(frame, [moved_surface(mesh, frame)])
            writer.flush()
            stage = open_stage(tmp_path / form)
            shown = UsdGeom.Primvar(surface_of(stage).GetDisplayColorAttr()).GetIndices(frame)
            so_far = stage.GetDefaultPrim().GetCustomDataByKey("legend")["range"]
            np.testing.assert_array_equal(shown, color_indices(motion()[frame].forces, tuple(so_far)))
        writer.finish()
        stage = open_stage(tmp_path / form)
        final = stage.GetDefaultPrim().GetCustomDataByKey("legend")["range"]
        expected = np.percentile(np.concatenate([frame.forces for frame in motion()]), (1, 99))
        np.testing.assert_allclose(final, expected, rtol=2**-9)
        indices = UsdGeom.Primvar(surface_of(stage).GetDisplayColorAttr()).GetIndicesAttr()
        for t, frame in enumerate(motion()):
            np.testing.assert_array_equal(indices.Get(t), color_indices(frame.forces, tuple(final)))
        assert not surface_of(stage).GetPrim().HasAttribute("primvars:force")
        assert stage_problems(tmp_path / form) == []


@pytest.mark.parametrize("form", FORMS)
def test_forces_are_written_on_request(tmp_path: Path, form: str) -> None:
    """Write the force on each point at every frame where asked for."""
    mesh = cube_surface(center=(0.0, 0.5, 0.0))
    writer = start_stage(tmp_path, [mesh], make_scene(output={"format": form, "forces": True}))
    for frame in range(4):
        writer.write_frame(frame, [moved_surface(mesh, frame)])
    writer.finish()
    stage = open_stage(tmp_path)
    primvar = UsdGeom.PrimvarsAPI(surface_of(stage)).GetPrimvar("force")
    assert primvar.GetInterpolation() == "vertex"
    for t in range(4):
        assert np.array(primvar.Get(t)).tobytes() == motion()[t].forces.tobytes()
    assert stage_problems(tmp_path) == []


def test_percentiles_are_close_to_those_of_all_forces() -> None:
    """Find percentiles of forces of very different magnitudes to a share of 2^-9."""
    rng = np.random.default_rng(0)
    for spread in (0.0, 0.1, 1.0, 5.0):
        for count in (1, 2, 100, 30_000):
            forces = np.exp(rng.normal(0.0, spread, count)).astype(np.float32)
            forces[rng.random(count) < 0.02] = 0.0
            histogram = ForceHistogram()
            for part in np.array_split(forces, 3):
                histogram.add(part)
            histogram.add(np.float32([np.nan, np.inf]))
            for percent in (1, 50, 99):
                assert histogram.percentile(percent) == pytest.approx(np.percentile(forces, percent), rel=2**-9)
            again = ForceHistogram()
            again.restore(histogram.arrays())
            assert again.color_range() == histogram.color_range()


def test_unwritable_places_are_reported_at_once(tmp_path: Path) -> None:
    """Say before simulating, in one line, that the folder cannot be made."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(EnvironmentFailedError, match="cannot make this directory") as caught:
        start_stage(tmp_path / "file" / "run", [cube_surface()])
    assert "\n" not in str(caught.value)


def test_a_folder_without_permission_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Say before simulating that the folder is read-only."""
    # Permissions don't bind root, under which tests may run, so the answer of the system is what is replaced.
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(EnvironmentFailedError, match="no permission"):
        start_stage(tmp_path, [cube_surface()])


@pytest.mark.skipif(sys.platform == "win32", reason="limits on file sizes are POSIX")
def test_a_full_disk_is_reported_and_keeps_what_is_there(tmp_path: Path) -> None:
    """Raise the one-line error, keep the frames before and the previous stage, and leave no half-written file."""
    write_stage(tmp_path / "stage.usdc", frames=2)
    before = (tmp_path / "stage.usdc").read_bytes()
    # A limit on the size of files fails writes as a full disk does. Clips of one frame fit, a clip of three does not.
    script = (
        "import resource, signal, sys; sys.path.insert(0, sys.argv[2])\n"
        "from stages import *\n"
        "from warpjelly.errors import EnvironmentFailedError\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
        "mesh = cube_surface(count=33)\n"
        "writer = start_stage(Path(sys.argv[1]), [mesh])\n"
        "try:\n"
        "    for frame in range(5):\n"
        "        writer.write_frame(frame, [moved_surface(mesh, frame)])\n"
        "        if frame < 2 or frame == 4:\n"
        "            writer.flush()\n"
        "except EnvironmentFailedError as error:\n"
        "    print(error)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path), str(Path(__file__).parent)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.count("\n") == 1
    assert "frames.000002.usdc: cannot write the stage: " in said
    assert (tmp_path / "stage.usdc").read_bytes() == before
    assert not list(tmp_path.rglob("*.tmp.*"))
    assert stage_problems(tmp_path) == []
    assert progress(open_stage(tmp_path)) == (2, 48)


@pytest.mark.skipif(sys.platform == "win32", reason="limits on file sizes are POSIX")
def test_memory_does_not_grow_with_the_frames(tmp_path: Path) -> None:
    """Write ten times as many frames of 10,000 points, and pack them, with the same memory."""
    script = (
        "import resource, sys; sys.path.insert(0, sys.argv[2])\n"
        "from stages import *\n"
        "mesh = cube_surface(count=41)\n"
        "writer = start_stage(Path(sys.argv[1]), [mesh])\n"
        "for frame in range(int(sys.argv[3])):\n"
        "    writer.write_frame(frame, [moved_surface(mesh, frame % 10)])\n"
        "    if frame % writer.clip_length == writer.clip_length - 1:\n"
        "        writer.flush()\n"
        "writer.finish()\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    peaks = []
    for frames in (50, 500):
        command = [sys.executable, "-c", script, str(tmp_path / str(frames)), str(Path(__file__).parent), str(frames)]
        peaks.append(int(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        (tmp_path / str(frames) / "stage.usdc").unlink()
    # In memory 450 more frames would be as much again.
    assert peaks[1] < 1.1 * peaks[0]


def test_opening_names_what_is_wrong(tmp_path: Path) -> None:
    """Tell a missing file, a directory without a stage and a file that is not USD apart, in one line each."""
    text = tmp_path / "text.usdc"
    text.write_text("not a crate " * 20)
    for source, what in (
        (tmp_path / "none.usdc", "no such file"),
        (tmp_path, "no stage.usdc or stage.usda in this directory"),
        (text, "not a readable USD file"),
    ):
        with pytest.raises(InputError, match=what) as caught:
            open_stage(source)
        assert "\n" not in str(caught.value)
