"""A small shot: two meshes to drop, below transforms and beside all that a run has to leave alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from warpjelly.scene import Scene
from warpjelly.scenefile import read_scene

UNIT, RATE, START, END = 0.0254, 25.0, 1001.0, 1015.0
FPS, FRAMES = 60.0, 30
HARD, SMOOTH = "/set/rig/hard", "/set/rig/inner/smooth"
# A box with corners all round it, counterclockwise from outside.
CORNERS = np.array(list(np.ndindex(2, 2, 2)), float) - 0.5
FACES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
OUTWARD = np.repeat([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], 4, axis=0)
DRIFT = np.array([3.0, -1.0, 0.5])  # of the parent, units per second


def make_shot(path: Path, *, moving: bool = False, mirrored: bool = False, left_handed: bool = False) -> Path:
    """Write a shot in inches, z up, at 25 time codes a second from 1001 to 1015.

    Args:
        path: the file to make.
        moving: whether the parent of the meshes drifts.
        mirrored: whether it mirrors them.
        left_handed: whether the faces of the hard mesh run clockwise, as it says then.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, UNIT)
    UsdGeom.SetStageUpAxis(stage, "Z")
    stage.SetTimeCodesPerSecond(RATE)
    stage.SetFramesPerSecond(RATE)
    stage.SetStartTimeCode(START)
    stage.SetEndTimeCode(END)
    stage.GetRootLayer().customLayerData = {"department": "layout"}
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/set").GetPrim())
    rig = UsdGeom.Xform.Define(stage, "/set/rig")
    place = rig.AddTranslateOp()
    place.Set(Gf.Vec3d(40, -20, 90))
    if moving:
        for time in (START - 50, END + 50):
            offset = DRIFT * (time - START) / RATE
            place.Set(Gf.Vec3d(*(np.array([40, -20, 90]) + offset).tolist()), time)
    rig.AddRotateXYZOp().Set(Gf.Vec3f(20, -35, 50))
    rig.AddScaleOp().Set(Gf.Vec3f(-2 if mirrored else 2, 3, 0.5))
    UsdGeom.Xform.Define(stage, "/set/rig/inner").AddTranslateOp().Set(Gf.Vec3d(1, 2, 30))
    looks = [_look(stage, name, color) for name, color in (("red", (1, 0, 0)), ("blue", (0, 0, 1)))]

    hard = box(stage, HARD, FACES[:, ::-1] if left_handed else FACES, (8, 6, 30))
    hard.CreateSubdivisionSchemeAttr("none")
    normals = OUTWARD.reshape(6, 4, 3)[:, ::-1].reshape(-1, 3) if left_handed else OUTWARD
    primvar = UsdGeom.PrimvarsAPI(hard).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "faceVarying")
    primvar.Set(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
    hard.CreateVelocitiesAttr([(1, 2, 3)] * 8)
    hard.CreateAccelerationsAttr([(1, 2, 3)] * 8)
    if left_handed:
        hard.CreateOrientationAttr("leftHanded")
    UsdGeom.PrimvarsAPI(hard).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set([(0.5, 0.25)] * 8)
    UsdShade.MaterialBindingAPI.Apply(hard.GetPrim()).Bind(looks[0])
    subset = UsdShade.MaterialBindingAPI(hard).CreateMaterialBindSubset("top", [1])
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(looks[1])

    smooth = box(stage, SMOOTH, FACES, (6, 6, 24), lone=True)
    smooth.CreateNormalsAttr([(0, 0, 1)] * 9)
    UsdShade.MaterialBindingAPI.Apply(smooth.GetPrim()).Bind(looks[1])

    other = box(stage, "/set/other", FACES, (1, 1, 1))
    other.GetPointsAttr().Set(other.GetPointsAttr().Get(), 1003)
    camera = UsdGeom.Camera.Define(stage, "/set/camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(40, -300, 135))
    camera.AddRotateXOp().Set(80)
    camera.CreateClippingRangeAttr(Gf.Vec2f(1, 10000))
    UsdLux.DistantLight.Define(stage, "/set/sun").CreateIntensityAttr(3)
    stage.GetRootLayer().Save()
    return path


def box(stage: Usd.Stage, path: str, faces: np.ndarray, size: Any, *, lone: bool = False) -> UsdGeom.Mesh:
    """Define a box; with ``lone``, it has one point more, which belongs to no face."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    points = np.concatenate([CORNERS * size, [[0.0, 0.0, 0.0]] if lone else np.zeros((0, 3))])
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr(faces.ravel().tolist())
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    return mesh


def _look(stage: Usd.Stage, name: str, color: tuple[float, float, float]) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, f"/set/looks/{name}")
    shader = UsdShade.Shader.Define(stage, f"/set/looks/{name}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def shot_tables(shot: Path, **changes: Any) -> dict[str, Any]:
    """Return the tables of a scene in which the rig of a shot just falls, with dotted keys (dots as __) set."""
    tables: dict[str, Any] = {
        "name": "drop",
        "up_axis": "Z",
        "fps": FPS,
        "frames": FRAMES,
        "solver": {"precision": "float64"},
        "materials": {"jelly": {}},
        "bodies": [
            {
                "name": "rig",
                "type": "model",
                "file": str(shot),
                "prim": "/set/rig",
                "resolution": 12,
                "material": "jelly",
            }
        ],
        "output": {"over": str(shot)},
    }
    for key, value in changes.items():
        *parents, last = [int(part) if part.isdigit() else part for part in key.split("__")]
        node: Any = tables
        for parent in parents:
            node = node[parent]
        if value is None:
            del node[last]
        else:
            node[last] = value
    return tables


def shot_scene(shot: Path, **changes: Any) -> Scene:
    """Return that scene, validated."""
    return read_scene(shot_tables(shot, **changes), shot.with_name("drop.toml"))
