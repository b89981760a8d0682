"""What a stage contains: the bodies as they are at rest, and their samples at each frame.

Everything is below ``/World``. Topology, the colour table, looks and lights are written once; points, normals, extents
and colour indices at every frame. How that gets to the disk is ``stagewriter.py``'s.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from warpjelly.kernels.lattices import BEND, FACE_SHEAR, STRUCTURAL

from ..colors import COLOR_MAP, KIND_COLORS, LINEAR_TABLE, color_indices
from ..scene import Scene
from ..shapes import SPRINGS, SURFACE, Shape, ShapeFrame
from .prims import (
    BODIES,
    COLLIDER_GREY,
    LIGHTS,
    LOOKS,
    WORLD,
    bind_look,
    define_balls,
    define_mesh,
    define_segments,
    facing,
    integers,
    matrix,
    vectors,
)
from .usdlooks import define_look

if TYPE_CHECKING:
    from ..meshes import LoadedModel

FORCE = "primvars:force"
NORMALS = "primvars:normals"
COLOR = "primvars:displayColor"
COLOR_INDICES = "primvars:displayColor:indices"

_KEY_DIRECTION = (-0.6, 1.2, 0.5)
_FILL_DIRECTION = (1.0, 0.4, 0.3)
_KIND_NAMES = {"structural": STRUCTURAL, "shear": FACE_SHEAR, "bend": BEND}


def set_metadata(stage: Usd.Stage, scene: Scene) -> None:
    """Say what units, axes and time codes mean; each layer that is opened by itself has to."""
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, scene.up_axis)
    stage.SetTimeCodesPerSecond(scene.fps)
    stage.SetFramesPerSecond(scene.fps)


def define_rest(
    stage: Usd.Stage,
    *,
    scene: Scene,
    shapes: Sequence[Shape],
    rest: Sequence[ShapeFrame],
    provenance: Mapping[str, object],
    texture_folder: Path,
) -> None:
    """Write all that does not depend on the motion, with the rest pose for applications that ask for no time.

    Args:
        stage: an empty stage, which is saved beside the folder of textures.
        scene: what is simulated.
        shapes: what is shown.
        rest: a sample of each.
        provenance: where the result comes from (versions, device, resolved scene ...), kept as custom data of
            ``/World``; what USD cannot store as it is becomes JSON.
        texture_folder: where images of models are written.
    """
    _define_world(stage, scene, provenance)
    _define_looks(stage)
    define_lights(stage, scene.up_axis)
    for shape, sample in zip(shapes, rest, strict=True):
        prim = _define_shape(stage, shape, sample, scene)
        if shape.model is not None:
            _define_model(prim, shape.body, shape.model, scene, texture_folder)


def legend(shapes: Iterable[Shape], force_range: tuple[float, float]) -> dict[str, object]:
    """Return what colours mean, as custom data of ``/World``; forces in N."""
    meaning = {"quantity": "force", "unit": "N", "range": Gf.Vec2d(*force_range), "colorMap": COLOR_MAP}
    shown = {kind for shape in shapes if shape.kinds is not None for kind in np.unique(shape.kinds).tolist()}
    if shown:
        named = {name: kind for name, kind in _KIND_NAMES.items() if kind in shown}
        meaning["springs"] = {name: Gf.Vec3d(*KIND_COLORS[kind].tolist()) for name, kind in named.items()}
    return meaning


def declare_samples(layer: Sdf.Layer, shapes: Iterable[Shape], scene: Scene, *, forces: bool) -> None:
    """Declare in an empty layer what varies from frame to frame, with or without the forces on points."""
    types = Sdf.ValueTypeNames
    for shape in shapes:
        prim = Sdf.CreatePrimInLayer(layer, shape_path(shape))
        varying = {"points": types.Point3fArray, "extent": types.Float3Array}
        if name := normals_name(shape):
            varying[name] = types.Normal3fArray
        if scene.output.velocities:
            varying["velocities"] = types.Vector3fArray
        if shape.shows_force and scene.output.color == "rgb":
            varying[COLOR] = types.Color3fArray
        elif shape.shows_force:
            varying[COLOR_INDICES] = types.IntArray
        if forces:
            varying[FORCE] = types.FloatArray
        for name, kind in varying.items():
            Sdf.AttributeSpec(prim, name, kind)


def author_sample(layer: Sdf.Layer, time: float, shape: Shape, sample: ShapeFrame) -> np.ndarray:
    """Write what is declared of a shape at a time code, but for colours; return its extent [2, 3]."""
    if sample.points.shape != (len(shape.particles), 3):
        raise ValueError(f"{shape.body}: points {sample.points.shape} for a shape of {len(shape.particles)}")
    points = vectors(sample.points)
    samples = {"points": points, "extent": _extent(shape, points)}
    if name := normals_name(shape):
        samples[name] = vectors(sample.normals)
    prim = layer.GetPrimAtPath(shape_path(shape))
    if "velocities" in prim.properties:
        samples["velocities"] = vectors(sample.velocities)
    if FORCE in prim.properties:
        samples[FORCE] = Vt.FloatArray.FromNumpy(np.ascontiguousarray(sample.forces, np.float32))
    for name, value in samples.items():
        layer.SetTimeSample(prim.path.AppendProperty(name), time, value)
    return np.array(samples["extent"])


def author_colors(
    layer: Sdf.Layer, time: float, shape: Shape, forces: np.ndarray, force_range: tuple[float, float]
) -> None:
    """Write the colours of a shape at a time code, as they are declared; none where they don't show forces.

    Args:
        layer: where the samples of the shape are declared.
        time: the time code.
        shape: the shape.
        forces: magnitudes [point_count], N.
        force_range: forces at both ends of the colour map, N.
    """
    for name in (COLOR, COLOR_INDICES):
        if layer.GetAttributeAtPath(path := shape_path(shape).AppendProperty(name)):
            layer.SetTimeSample(path, time, _colors(name, forces, force_range))


def colors_in_range(
    clip: Sdf.Layer, attribute: Sdf.Path, time: float, force_range: tuple[float, float]
) -> Vt.IntArray | Vt.Vec3fArray | None:
    """Return the sample of an attribute with other forces at both ends of the colours; None where forces are not kept.

    Args:
        clip: has the samples.
        attribute: one of them, colours or not.
        time: when.
        force_range: forces at both ends of the colour map, N.
    """
    if attribute.name not in (COLOR, COLOR_INDICES):
        return None
    forces = clip.QueryTimeSample(attribute.GetPrimPath().AppendProperty(FORCE), time)
    return None if forces is None else _colors(attribute.name, np.asarray(forces), force_range)


def _colors(name: str, forces: np.ndarray, force_range: tuple[float, float]) -> Vt.IntArray | Vt.Vec3fArray:
    """Return colours as an attribute has them: plain, or as indices into the colour table."""
    indices = color_indices(forces, force_range)
    return Vt.IntArray.FromNumpy(indices) if name == COLOR_INDICES else Vt.Vec3fArray.FromNumpy(LINEAR_TABLE[indices])


def shape_path(shape: Shape) -> Sdf.Path:
    """Return where a shape is in the stage."""
    if shape.prim is not None:
        return Sdf.Path(shape.prim)
    return BODIES.AppendChild(shape.body).AppendChild(shape.name)


def _extent(shape: Shape, points: Vt.Vec3fArray) -> Vt.Vec3fArray:
    if shape.name == SURFACE:
        return UsdGeom.PointBased.ComputeExtent(points)
    if shape.name == SPRINGS:
        return UsdGeom.Curves.ComputeExtent(points, [shape.width])
    return UsdGeom.Points.ComputeExtent(points, Vt.FloatArray(len(points), shape.width))


def normals_name(shape: Shape) -> str | None:
    """Return the attribute with the normals, if any: those that corners choose from have indices, as a primvar."""
    if shape.corner_normals is not None:
        return NORMALS
    return "normals" if shape.name == SURFACE and shape.prim is None else None


def _define_world(stage: Usd.Stage, scene: Scene, provenance: Mapping[str, object]) -> None:
    set_metadata(stage, scene)
    world = UsdGeom.Xform.Define(stage, WORLD).GetPrim()
    stage.SetDefaultPrim(world)
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    Usd.ModelAPI(world).SetAssetName(scene.name)
    world.SetCustomDataByKey("provenance", {key: storable(value) for key, value in provenance.items()})
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, BODIES)).SetKind(Kind.Tokens.group)


def storable(value: object) -> object:
    """Return what stands for a value in custom data: itself, or JSON where USD cannot store it."""
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, str | bool | int | float) else json.dumps(value, default=str)


def _define_looks(stage: Usd.Stage) -> None:
    UsdGeom.Scope.Define(stage, LOOKS)
    color3f, number = Sdf.ValueTypeNames.Color3f, Sdf.ValueTypeNames.Float

    def surface(name: str, roughness: float, clearcoat: float) -> UsdShade.Shader:
        material = UsdShade.Material.Define(stage, LOOKS.AppendChild(name))
        shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("roughness", number).Set(roughness)
        shader.CreateInput("clearcoat", number).Set(clearcoat)
        shader.CreateInput("clearcoatRoughness", number).Set(0.1)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        return shader

    jelly = surface("jelly", roughness=0.35, clearcoat=0.5)
    reader = UsdShade.Shader.Define(stage, LOOKS.AppendPath("jelly/color"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(*LINEAR_TABLE[0].tolist()))
    result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    jelly.CreateInput("diffuseColor", color3f).ConnectToSource(result)

    collider = surface("collider", roughness=0.8, clearcoat=0.0)
    collider.CreateInput("diffuseColor", color3f).Set(Gf.Vec3f(COLLIDER_GREY))


def define_lights(stage: Usd.Stage, up_axis: str) -> None:
    """Light a stage from all around, and from the upper left and the right."""
    UsdGeom.Xform.Define(stage, LIGHTS)
    dome = UsdLux.DomeLight.Define(stage, LIGHTS.AppendChild("sky"))
    dome.CreateIntensityAttr(0.5)
    for name, direction, intensity, angle in (
        ("key", _KEY_DIRECTION, 2.0, 6.0),
        ("fill", _FILL_DIRECTION, 0.4, 30.0),
    ):
        light = UsdLux.DistantLight.Define(stage, LIGHTS.AppendChild(name))
        light.CreateIntensityAttr(intensity)
        light.CreateAngleAttr(angle)
        # Normalised, the intensity means the same in renderers with and without soft shadows.
        light.CreateNormalizeAttr(True)
        light.MakeMatrixXform().Set(matrix(facing(direction, up_axis), np.zeros(3)))


def _define_shape(stage: Usd.Stage, shape: Shape, rest: ShapeFrame, scene: Scene) -> UsdGeom.PointBased:
    path = shape_path(shape)
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, path.GetParentPath())).SetKind(Kind.Tokens.component)
    prim: UsdGeom.PointBased
    if shape.name == SURFACE:
        prim = define_mesh(stage, path, rest.points, shape.counts, shape.corners)
        prim.CreateDoubleSidedAttr(shape.double_sided)
        _define_normals(prim, shape, rest.normals)
    elif shape.name == SPRINGS:
        prim = define_segments(stage, path, rest.points, width=shape.width)
    else:
        prim = define_balls(stage, path, rest.points, width=shape.width)
    bind_look(prim, "jelly")
    if scene.output.velocities:
        prim.CreateVelocitiesAttr()
    if scene.output.forces:
        force = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(FORCE, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        force.Set(Vt.FloatArray.FromNumpy(rest.forces))
    if shape.kinds is not None:
        _set_colors(prim, UsdGeom.Tokens.uniform, KIND_COLORS, shape.kinds, scene)
    else:
        _set_colors(prim, UsdGeom.Tokens.vertex, LINEAR_TABLE, np.zeros(len(rest.points), np.int32), scene)
    return prim


def _define_model(mesh: UsdGeom.Mesh, body: str, model: LoadedModel, scene: Scene, texture_folder: Path) -> None:
    """Give a mesh the UVs and the materials of the model whose polygons it has."""
    part = model.drawing
    if part.uvs is not None:
        uvs = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
        )
        uvs.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(part.uvs, np.float32)))
    if scene.output.look == "force":
        return
    for number in np.unique(part.looks[part.looks >= 0]).tolist():
        look, faces = model.looks[number], np.flatnonzero(part.looks == number)
        # Names of different bodies and of one file may be alike, and need not be such that USD allows.
        name = Tf.MakeValidIdentifier(f"{body}_{number}_{look.name}")
        material = define_look(mesh.GetPrim().GetStage(), LOOKS.AppendChild(name), look, texture_folder)
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(name, integers(faces))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def _set_colors(prim: UsdGeom.Gprim, interpolation: str, table: np.ndarray, indices: np.ndarray, scene: Scene) -> None:
    color = prim.CreateDisplayColorPrimvar(interpolation)
    if scene.output.color == "rgb":
        color.Set(vectors(table[indices]))
    else:
        color.Set(vectors(table))
        color.SetIndices(integers(indices))


def _define_normals(mesh: UsdGeom.Mesh, shape: Shape, normals: np.ndarray) -> None:
    if shape.corner_normals is None:
        mesh.CreateNormalsAttr(vectors(normals))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    else:
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying
        )
        primvar.Set(vectors(normals))
        primvar.SetIndices(integers(shape.corner_normals))
