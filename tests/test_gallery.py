"""The stages of all scenes before independent judges: validators, and a reader that shares no code with USD's own."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import lightusd
import numpy as np
import pytest
import usd_validation_nvidia as nvidia
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from runs import samples_of
from stages import write_stage

from warpjelly.run import RunEndedError, simulate
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.stage.pack import FORMATS, pack
from warpjelly.stage.stagefiles import find_stage, open_stage
from warpjelly.stage.validate import stage_problems

SCENES = Path(__file__).parent.parent / "scenes"
NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))
FRAMES = 4
# The scene that is there to diverge, after 31 frames; its stage has those before.
DIVERGES = "broken_damping"
SURFACE = "/World/bodies/cube/surface"

# The colour table is stored once and most frames show some of its colours only, which these two rules take for waste.
DISABLED_RULES = {"IndexedPrimvarChecker", "UnusedPrimvarChecker"}


def scene_of(name: str) -> Scene:
    """Return a scene with as many frames as are looked at."""
    return load_scene(SCENES / f"{name}.toml", frames=60 if name == DIVERGES else FRAMES)


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run each scene for a moment, and return the folder of the run directories."""
    folder = tmp_path_factory.mktemp("gallery")
    for name in NAMES:
        try:
            simulate(scene_of(name), output=folder / name, device="cpu")
        except RunEndedError:
            assert name == DIVERGES
    return folder


@pytest.fixture(scope="module")
def validator() -> nvidia.ValidationEngine:
    """Return NVIDIA's validator without the rules that don't apply."""
    engine = nvidia.ValidationEngine()
    disabled = [rule for rule in engine.initialized_rules if rule.__name__ in DISABLED_RULES]
    assert len(disabled) == len(DISABLED_RULES)
    for rule in disabled:
        engine.disable_rule(rule)
    return engine


def found_by(validator: nvidia.ValidationEngine, path: Path) -> list[str]:
    """Return what NVIDIA's validator says of a stage, warnings too."""
    return [f"{issue.rule.__name__}: {issue.message}" for issue in validator.validate(str(path)).issues()]


def differences(light: lightusd.Stage, stage: Usd.Stage) -> Iterator[str]:
    """Yield where lightusd has not what USD has: units, axes, times, prims, and every attribute at every time."""
    for what, read, expected in (
        ("metersPerUnit", light.meters_per_unit, UsdGeom.GetStageMetersPerUnit(stage)),
        ("upAxis", light.up_axis, UsdGeom.GetStageUpAxis(stage)),
        ("startTimeCode", light.start_time, stage.GetStartTimeCode()),
        ("endTimeCode", light.end_time, stage.GetEndTimeCode()),
        ("timeCodesPerSecond", light.time_codes_per_second, stage.GetTimeCodesPerSecond()),
        ("framesPerSecond", light.frames_per_second, stage.GetFramesPerSecond()),
        ("defaultPrim", light.default_prim_path, stage.GetDefaultPrim().GetName()),
        ("warnings", light.warnings(), ""),
        ("prims", [prim.path for prim in light], [str(prim.GetPath()) for prim in stage.Traverse()]),
    ):
        if read != expected:
            yield what
    for prim in stage.Traverse():
        if (read := light.get_prim_at(str(prim.GetPath()))) is None:
            continue
        relationships = {name: read.relationship(name).targets for name in read.relationships}
        own = {each.GetName(): tuple(map(str, each.GetTargets())) for each in prim.GetAuthoredRelationships()}
        names = sorted(attribute.GetName() for attribute in prim.GetAuthoredAttributes())
        if (read.type_name, relationships, sorted(read.attributes)) != (prim.GetTypeName(), own, names):
            yield str(prim.GetPath())
            continue
        for attribute in map(prim.GetAttribute, names):
            if not _reads_alike(read.attribute(attribute.GetName()), attribute):
                yield str(attribute.GetPath())


def _reads_alike(read: lightusd.Attribute, attribute: Usd.Attribute) -> bool:
    """Say whether an attribute has the same type, connections, times, and value at rest and at each time."""
    times = attribute.GetTimeSamples()
    if (
        read.type_name != str(attribute.GetTypeName())
        or read.connections != tuple(map(str, attribute.GetConnections()))
        or list(read.timesamples.times if read.has_timesamples else ()) != times
    ):
        return False
    codes = [(None, Usd.TimeCode.Default()), *((time, Usd.TimeCode(time)) for time in times)]
    # Of an output that is only connected there is no value.
    values = [(time, value) for time, code in codes if (value := attribute.Get(code)) is not None]
    return all(np.array_equal(np.ravel(read.get(time=time)), _in_a_row(value)) for time, value in values)


def _in_a_row(value: object) -> np.ndarray:
    return np.ravel(value.path if isinstance(value, Sdf.AssetPath) else value)


@pytest.mark.parametrize("name", NAMES)
def test_the_stage_of_every_scene_is_sound(gallery: Path, validator: nvidia.ValidationEngine, name: str) -> None:
    """Find no problem with the project's own checks, nor with NVIDIA's but those that a shot had before."""
    assert stage_problems(gallery / name) == []
    shot = scene_of(name).output.over
    assert found_by(validator, find_stage(gallery / name)) == ([] if shot is None else found_by(validator, shot))


@pytest.mark.parametrize("name", NAMES)
def test_another_reader_reads_the_same(gallery: Path, tmp_path: Path, name: str) -> None:
    """Read a packed stage with lightusd: the same values as with USD everywhere, at every time."""
    pack(gallery / name, tmp_path / "packed.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "packed.usdc"))
    assert list(differences(lightusd.load(str(tmp_path / "packed.usdc")), stage)) == []
    times = {time for prim in stage.Traverse() for each in prim.GetAttributes() for time in each.GetTimeSamples()}
    frames = json.loads((gallery / name / "run.json").read_text())["frames"]
    assert times >= {stage.GetStartTimeCode() + frame for frame in range(frames)} > {stage.GetStartTimeCode()}


@pytest.mark.parametrize("name", NAMES)
def test_a_stage_says_where_it_comes_from(gallery: Path, name: str) -> None:
    """Find scene, versions and device in the record and in the stage alike, and the same scene in them again."""
    record = json.loads((gallery / name / "run.json").read_text())
    stage = open_stage(gallery / name)
    # Over a shot nothing but a layer is the run's own.
    noted = [layer.customLayerData.get("warpjelly", {}).get("provenance") for layer in stage.GetUsedLayers()]
    stored = stage.GetDefaultPrim().GetCustomDataByKey("provenance") or next(filter(None, noted))
    assert {key: json.loads(stored[key]) for key in ("resolved_scene", "versions")}.items() <= record.items()
    assert (stored["device"], stored["machine"]) == (record["device"], record["machine"]) == ("cpu", platform.machine())
    assert record["versions"]["warp-lang"] == metadata.version("warp-lang")
    scene = Scene.model_validate(record["resolved_scene"])
    assert scene.model_dump(mode="json", exclude={"gravity"}) == scene_of(name).model_dump(
        mode="json", exclude={"gravity"}
    )
    np.testing.assert_array_equal(scene.gravity_vector, scene_of(name).gravity_vector)


def test_a_run_is_repeated_from_its_record(gallery: Path, tmp_path: Path) -> None:
    """Simulate what the record says, and get the same stage to the bit."""
    record = json.loads((gallery / "creature_drop" / "run.json").read_text())
    simulate(Scene.model_validate(record["resolved_scene"]), output=tmp_path, device=record["device"])
    assert samples_of(tmp_path) == samples_of(gallery / "creature_drop")


@pytest.mark.parametrize("suffix", FORMATS)
def test_another_reader_reads_every_format(gallery: Path, tmp_path: Path, suffix: str) -> None:
    """Read the scene with materials and a model's surface in each format of packed stages."""
    pack(gallery / "creature_drop", tmp_path / f"packed{suffix}")
    stage = Usd.Stage.Open(str(tmp_path / f"packed{suffix}"))
    assert list(differences(lightusd.load(str(tmp_path / f"packed{suffix}")), stage)) == []


def change_first(name: str, time: float | None) -> Callable[[Usd.Stage], object]:
    """Return a change of the least that an array of the cube's surface can change by, at one time."""

    def change(stage: Usd.Stage) -> None:
        attribute = stage.GetPrimAtPath(SURFACE).GetAttribute(name)
        code = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
        values = np.array(attribute.Get(code))
        first = values.reshape(-1)[:1]
        first[:] = first + 1 if first.dtype.kind == "i" else np.nextafter(first, np.float32(np.inf))
        attribute.Set(values, code)

    return change


def surface_of(stage: Usd.Stage) -> UsdGeom.Mesh:
    """Return the surface of the cube."""
    return UsdGeom.Mesh.Get(stage, SURFACE)


CHANGES: dict[str, tuple[Callable[[Usd.Stage], object], str]] = {
    "point": (change_first("points", 3), f"{SURFACE}.points"),
    "rest point": (change_first("points", None), f"{SURFACE}.points"),
    "normal": (change_first("normals", 9), f"{SURFACE}.normals"),
    "extent": (change_first("extent", 0), f"{SURFACE}.extent"),
    "corner": (change_first("faceVertexIndices", None), f"{SURFACE}.faceVertexIndices"),
    "face": (change_first("faceVertexCounts", None), f"{SURFACE}.faceVertexCounts"),
    "colour": (change_first("primvars:displayColor:indices", 5), f"{SURFACE}.primvars:displayColor:indices"),
    "time": (lambda stage: surface_of(stage).GetPointsAttr().ClearAtTime(4), f"{SURFACE}.points"),
    "units": (lambda stage: UsdGeom.SetStageMetersPerUnit(stage, 0.01), "metersPerUnit"),
    "axis": (lambda stage: UsdGeom.SetStageUpAxis(stage, "Z"), "upAxis"),
    "end": (lambda stage: stage.SetEndTimeCode(8), "endTimeCode"),
    "rate": (lambda stage: stage.SetTimeCodesPerSecond(25), "timeCodesPerSecond"),
    "type": (lambda stage: stage.GetPrimAtPath(SURFACE).SetTypeName("Points"), SURFACE),
    "target": (
        lambda stage: UsdShade.MaterialBindingAPI(surface_of(stage)).GetDirectBindingRel().SetTargets(["/World/looks"]),
        SURFACE,
    ),
    "connection": (
        lambda stage: stage.GetAttributeAtPath("/World/looks/jelly.outputs:surface").SetConnections(["/World.x"]),
        "/World/looks/jelly.outputs:surface",
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_differs_is_found(tmp_path: Path, change: str) -> None:
    """Compare a stage with one that differs in the least possible, and find just that."""
    make, expected = CHANGES[change]
    path = write_stage(tmp_path / "stage.usdc")
    changed = Usd.Stage.Open(Sdf.Layer.OpenAsAnonymous(str(path)))
    make(changed)
    changed.GetRootLayer().Export(str(tmp_path / "changed.usdc"))
    assert list(differences(lightusd.load(str(path)), Usd.Stage.Open(str(path)))) == []
    assert list(differences(lightusd.load(str(tmp_path / "changed.usdc")), Usd.Stage.Open(str(path)))) == [expected]


DEFECTS: dict[str, Callable[[Usd.Stage], object]] = {
    "KindChecker": lambda stage: Usd.ModelAPI(stage.GetDefaultPrim()).SetKind("component"),
    "ExtentsChecker": lambda stage: surface_of(stage).GetExtentAttr().Set([Gf.Vec3f(-9), Gf.Vec3f(9)], 3),
    "NormalsValidChecker": lambda stage: surface_of(stage).GetNormalsAttr().Set([Gf.Vec3f(0)] * 98, 0),
    "ValidateTopologyChecker": lambda stage: surface_of(stage).GetFaceVertexIndicesAttr().Set([0, 1, 2, 3]),
    "UsdMaterialBindingApi": lambda stage: surface_of(stage).GetPrim().RemoveAppliedSchema("MaterialBindingAPI"),
    "DefaultPrimChecker": lambda stage: stage.ClearDefaultPrim(),
    "StageMetadataChecker": lambda stage: stage.ClearMetadata("upAxis"),
}


@pytest.mark.parametrize("rule", DEFECTS)
def test_what_is_broken_is_found(tmp_path: Path, validator: nvidia.ValidationEngine, rule: str) -> None:
    """Break a stage, and have the rule of NVIDIA's validator that is about it say so."""
    stage = Usd.Stage.Open(str(write_stage(tmp_path / "stage.usdc")))
    assert found_by(validator, tmp_path / "stage.usdc") == []
    DEFECTS[rule](stage)
    stage.Save()
    assert any(said.startswith(f"{rule}: ") for said in found_by(validator, tmp_path / "stage.usdc"))
