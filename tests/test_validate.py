"""Validation: silent about sound stages, and one clear line for each planted defect."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from stages import cube_surface, make_scene, write_stage

from warpjelly.errors import InputError
from warpjelly.stage.validate import stage_problems

SURFACE = "/World/bodies/cube/surface"


def defective(path: Path, plant: Callable[[Usd.Stage], None]) -> list[str]:
    """Plant a defect in a sound stage and return the problems that are found."""
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    layer.TransferContent(Sdf.Layer.FindOrOpen(str(write_stage(path.with_name("sound.usdc")))))
    plant(Usd.Stage.Open(layer))
    layer.Export(str(path))
    return stage_problems(path)


def attribute(stage: Usd.Stage, name: str) -> Usd.Attribute:
    """Return an attribute of the cube's surface."""
    return stage.GetPrimAtPath(SURFACE).GetAttribute(name)


def set_first(name: str, value: object, time: float | None = 3) -> Callable[[Usd.Stage], None]:
    """Return a defect: one element of an array replaced at one time."""

    def plant(stage: Usd.Stage) -> None:
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        array = attribute(stage, name).Get(code)
        array[0] = value
        attribute(stage, name).Set(array, code)

    return plant


def shorten(name: str, time: float | None = 3) -> Callable[[Usd.Stage], None]:
    """Return a defect: an array that lacks its last element at one time."""

    def plant(stage: Usd.Stage) -> None:
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        array = attribute(stage, name).Get(code)
        attribute(stage, name).Set(array[:-1], code)

    return plant


def edit(change: Callable[[Usd.Stage], object]) -> Callable[[Usd.Stage], None]:
    """Return a defect made by an expression."""
    return lambda stage: change(stage) and None


DEFECTS = {
    "nan point": (set_first("points", Gf.Vec3f(float("nan"))), "non-finite points at time 3"),
    "nan rest point": (set_first("points", Gf.Vec3f(float("inf")), None), "non-finite points at rest"),
    "nan normal": (set_first("normals", Gf.Vec3f(float("nan"))), "non-finite normals at time 3"),
    "wrong extent": (set_first("extent", Gf.Vec3f(-9, -9, -9)), "wrong extent at time 3"),
    "wrong rest extent": (set_first("extent", Gf.Vec3f(-9, -9, -9), None), "wrong extent at rest"),
    "no extent": (edit(lambda s: s.GetPrimAtPath(SURFACE).RemoveProperty("extent")), "no extent"),
    "short normals": (shorten("normals"), "97 normals (vertex) where there should be 98 at time 3"),
    "short velocities": (
        edit(lambda s: UsdGeom.Mesh.Get(s, SURFACE).CreateVelocitiesAttr(Vt.Vec3fArray(5))),
        "5 velocities (vertex) where there should be 98",
    ),
    "short indices": (shorten("primvars:displayColor:indices"), "97 displayColor (vertex) where there should be 98"),
    "index too large": (
        set_first("primvars:displayColor:indices", 256),
        "displayColor has indices outside its 256 values at time 3",
    ),
    "negative index": (set_first("primvars:displayColor:indices", -1), "indices outside"),
    "nan color": (set_first("primvars:displayColor", Gf.Vec3f(float("nan")), None), "non-finite displayColor"),
    "corner outside": (set_first("faceVertexIndices", 98, None), "topology: "),
    "faces without corners": (shorten("faceVertexIndices", None), "topology: "),
    "no topology": (edit(lambda s: attribute(s, "faceVertexCounts").Clear()), "no topology"),
    "no rest points": (edit(lambda s: attribute(s, "points").ClearDefault()), "no rest (default) points"),
    "missing sample": (edit(lambda s: attribute(s, "points").ClearAtTime(4)), "samples are not evenly spaced"),
    "missing last sample": (
        edit(lambda s: attribute(s, "points").ClearAtTime(9)),
        "samples 0 to 8 do not cover the time range 0 to 9",
    ),
    "missing normals sample": (
        edit(lambda s: attribute(s, "normals").ClearAtTime(4)),
        "normals and points are sampled at different times",
    ),
    "subdivision": (
        edit(lambda s: attribute(s, "subdivisionScheme").Set("catmullClark")),
        "subdivisionScheme is not none",
    ),
    "no metres": (edit(lambda s: s.ClearMetadata("metersPerUnit")), "metersPerUnit is not authored"),
    "no up axis": (edit(lambda s: s.ClearMetadata("upAxis")), "upAxis is not authored"),
    "no rate": (edit(lambda s: s.ClearMetadata("timeCodesPerSecond")), "timeCodesPerSecond is not authored"),
    "no end": (edit(lambda s: s.ClearMetadata("endTimeCode")), "endTimeCode is not authored"),
    "ends before start": (edit(lambda s: s.SetStartTimeCode(20)), "starts at 20, after its end at 9"),
    "stopped": (edit(lambda s: s.SetTimeCodesPerSecond(0)), "timeCodesPerSecond is 0"),
    "no default prim": (edit(lambda s: s.ClearDefaultPrim()), "no default prim"),
    "prim outside": (edit(lambda s: UsdGeom.Xform.Define(s, "/Stray")), "/Stray: beside the default prim"),
    "no camera": (edit(lambda s: s.RemovePrim("/World/camera")), "no camera"),
    "no look": (
        edit(
            lambda s: [
                s.GetPrimAtPath("/World/colliders/floor").RemoveProperty(name)
                for name in ("material:binding", "primvars:displayColor")
            ]
        ),
        "/World/colliders/floor: neither material nor displayColor",
    ),
    "absolute path": (
        edit(
            lambda s: (
                s.GetPrimAtPath("/World/lights/sky")
                .GetAttribute("inputs:texture:file")
                .Set(Sdf.AssetPath("/home/someone/sky.exr"))
            )
        ),
        "absolute asset path /home/someone/sky.exr",
    ),
    "binding without schema": (
        edit(lambda s: s.GetPrimAtPath(SURFACE).RemoveAppliedSchema("MaterialBindingAPI")),
        "MaterialBindingAPI",
    ),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_defect_is_found(tmp_path: Path, defect: str) -> None:
    """Find the planted defect and say it in one line."""
    plant, expected = DEFECTS[defect]
    problems = defective(tmp_path / "stage.usdc", plant)
    assert any(expected in problem for problem in problems), problems
    assert not any("\n" in problem for problem in problems)


def test_shared_problems_are_listed_once(tmp_path: Path) -> None:
    """Report a defect of many samples as one line that counts them."""

    def plant(stage: Usd.Stage) -> None:
        for time in range(2, 8):
            set_first("points", Gf.Vec3f(float("nan")), time)(stage)

    problems = defective(tmp_path / "stage.usdc", plant)
    assert problems == [f"{SURFACE}: non-finite points at time 2 and 5 more"]


def test_newer_crates_are_found(tmp_path: Path) -> None:
    """Report a file version that common viewers cannot open."""
    layer = Sdf.Layer.FindOrOpen(str(write_stage(tmp_path / "sound.usdc")))
    header = bytearray((tmp_path / "sound.usdc").read_bytes())
    assert tuple(header[8:11]) <= (0, 8, 0)
    del layer
    header[9] = 10
    (tmp_path / "newer.usdc").write_bytes(header)
    assert any("crate version 0.10" in problem for problem in stage_problems(tmp_path / "newer.usdc"))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"up_axis": "Z", "colliders": [{"name": "wall", "type": "half_space", "normal": [0.0, 1.0, 3.0]}]},
        {"output": {"color": "rgb", "velocities": True}},
    ],
)
def test_sound_stages_have_no_problems(tmp_path: Path, changes: dict[str, object]) -> None:
    """Say nothing about what the stage writer makes, given as a file or as its directory."""
    path = write_stage(tmp_path / "stage.usdc", make_scene(**changes))
    assert stage_problems(path) == []
    assert stage_problems(tmp_path) == []


def test_text_stages_are_read_too(tmp_path: Path) -> None:
    """Check the same stage as text."""
    Usd.Stage.Open(str(write_stage(tmp_path / "a.usdc", meshes=[cube_surface()]))).Export(str(tmp_path / "b.usda"))
    assert stage_problems(tmp_path / "b.usda") == []


def test_what_is_not_a_stage_is_refused(tmp_path: Path) -> None:
    """Raise the one-line error for a missing file, a text file and a directory without a stage."""
    (tmp_path / "text.usdc").write_text("hello")
    for source in (tmp_path / "none.usdc", tmp_path / "text.usdc", tmp_path):
        with pytest.raises(InputError):
            stage_problems(source)


def test_a_damaged_stage_is_not_sound(tmp_path: Path) -> None:
    """Flip bytes in the middle of a crate file, and find it damaged instead of failing."""
    path = write_stage(tmp_path / "stage.usdc")
    data = bytearray(path.read_bytes())
    for position in range(len(data) // 2, 3 * len(data) // 4, 7):
        data[position] ^= 0xFF
    path.write_bytes(data)
    assert stage_problems(path)
