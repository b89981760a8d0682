"""The stage writer: a run as one USD file that any viewer, renderer or DCC application plays.

Everything is below ``/World``. Topology, the colour table, looks, lights, colliders and the camera are written once;
points, normals, extents and colour indices at every frame. Opinions are gathered in a layer in memory; the file
appears under its name only when it is complete.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from warpjelly.kernels.lattices import BEND, FACE_SHEAR, STRUCTURAL

from .colors import COLOR_MAP, KIND_COLORS, LINEAR_TABLE, color_indices
from .errors import EnvironmentFailedError, InputError, reason
from .files import whole_file
from .scene import BoxCollider, HalfSpaceCollider, PlaneCollider, Scene, SphereCollider, plane_frame
from .shapes import SPRINGS, SURFACE, Shape, ShapeFrame
from .usdlooks import define_look

if TYPE_CHECKING:
    from .meshes import LoadedModel

STAGE_NAME = "stage.usdc"
TEXTURES_NAME = "textures"

_WORLD = Sdf.Path("/World")
_BODIES = _WORLD.AppendChild("bodies")
_COLLIDERS = _WORLD.AppendChild("colliders")
_LOOKS = _WORLD.AppendChild("looks")
_LIGHTS = _WORLD.AppendChild("lights")
_CAMERA = _WORLD.AppendChild("camera")

# The camera has a 50 mm lens and a 36 mm wide 16:9 film back, and looks slightly down from the right. Directions are
# for Y up.
_FOCAL_LENGTH, _APERTURE = 50.0, (36.0, 20.25)
_CAMERA_DIRECTION = (0.6, 0.45, 1.0)
# Share of the frame that the motion may fill, from the centre to the edge.
_FRAME_FILL = 0.92
_KEY_DIRECTION = (-0.6, 1.2, 0.5)
_FILL_DIRECTION = (1.0, 0.4, 0.3)
_KIND_NAMES = {"structural": STRUCTURAL, "shear": FACE_SHEAR, "bend": BEND}
# Linear grey of everything that is not jelly.
_COLLIDER_GREY = 0.4
# Edge of the square that stands for an infinite wall, in diagonals of the motion.
_WALL_SIZE = 20.0
# Forces that vary by less than this share of their value are one force and rounding: no range to stretch colours over.
_FLAT_RANGE = 1e-2


class StageWriter:
    """Writes the frames of a run into one stage file."""

    def __init__(
        self,
        path: Path,
        *,
        scene: Scene,
        shapes: Sequence[Shape],
        rest: Sequence[ShapeFrame],
        provenance: Mapping[str, object],
    ) -> None:
        """Prepare a stage; but for textures, no file is made before ``close``.

        Args:
            path: the stage file to make, ``.usdc``; its folder is made if missing.
            scene: what was simulated.
            shapes: what is shown.
            rest: a sample of each, for applications that ask for no time.
            provenance: where the result comes from (versions, device, resolved scene ...), kept as custom data of
                ``/World``; what USD cannot store as it is becomes JSON.

        Raises:
            EnvironmentFailedError: the folder cannot be made or written to.
        """
        self._path = path
        _require_writable(path.parent)
        self._scene = scene
        self._shapes = list(shapes)
        self._layer = Sdf.Layer.CreateAnonymous(".usdc")
        self._frame_count = 0
        self._closed = False
        self._bounds = np.concatenate([sample.points for sample in rest]).astype(np.float64)
        self._bounds = np.stack([self._bounds.min(axis=0), self._bounds.max(axis=0)])
        self._rest_center = self._bounds.mean(axis=0)
        # With an automatic range, colours have to wait for the last frame.
        self._kept_forces: list[list[np.ndarray]] = []

        stage = Usd.Stage.Open(self._layer)
        _define_world(stage, scene, provenance)
        _define_looks(stage)
        _define_lights(stage, scene)
        for shape, sample in zip(shapes, rest, strict=True):
            prim = _define_shape(stage, shape, sample, scene)
            if shape.model is not None:
                _define_model(prim, shape.body, shape.model, scene, path.parent / TEXTURES_NAME)

    def write_frame(self, index: int, samples: Sequence[ShapeFrame]) -> None:
        """Add one sample.

        Args:
            index: number of the frame and its time code; frames arrive in order from 0.
            samples: one for each shape, in the order of the shapes.
        """
        if index != self._frame_count:
            raise ValueError(f"frame {index} written where frame {self._frame_count} is due")
        for shape, sample in zip(self._shapes, samples, strict=True):
            extent = _author_sample(self._layer, index, shape, sample, self._scene.output.velocities)
            self._bounds[0] = np.minimum(self._bounds[0], extent[0])
            self._bounds[1] = np.maximum(self._bounds[1], extent[1])
        if self._scene.output.force_range == "auto":
            self._kept_forces.append([np.array(sample.forces, dtype=np.float32) for sample in samples])
        else:
            for shape, sample in zip(self._shapes, samples, strict=True):
                self._author_colors(index, shape, sample.forces, self._scene.output.force_range)
        self._frame_count += 1

    def close(self) -> None:
        """Complete the stage with what depends on the whole run and make the file; a second call does nothing.

        Raises:
            EnvironmentFailedError: the file cannot be written; one that was there before is untouched.
        """
        if self._closed:
            return
        force_range = self._scene.output.force_range
        if force_range == "auto":
            force_range = _automatic_range(self._kept_forces)
            for index, kept in enumerate(self._kept_forces):
                for shape, forces in zip(self._shapes, kept, strict=True):
                    self._author_colors(index, shape, forces, force_range)
            self._kept_forces.clear()
        stage = Usd.Stage.Open(self._layer)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(max(self._frame_count - 1, 0))
        legend = {"quantity": "force", "unit": "N", "range": Gf.Vec2d(*force_range), "colorMap": COLOR_MAP}
        if any(shape.kinds is not None for shape in self._shapes):
            legend["springs"] = {name: Gf.Vec3d(*KIND_COLORS[kind].tolist()) for name, kind in _KIND_NAMES.items()}
        stage.GetDefaultPrim().SetCustomDataByKey("legend", legend)
        _define_colliders(stage, self._scene, self._bounds, self._rest_center)
        _define_camera(stage, self._scene, self._bounds)
        _export(self._layer, self._path)
        self._closed = True

    def _author_colors(self, index: int, shape: Shape, forces: np.ndarray, force_range: tuple[float, float]) -> None:
        if shape.kinds is not None:
            return
        indices = color_indices(forces, force_range)
        primvar = _shape_path(shape).AppendProperty("primvars:displayColor")
        if self._scene.output.color == "rgb":
            self._layer.SetTimeSample(primvar, index, Vt.Vec3fArray.FromNumpy(LINEAR_TABLE[indices]))
        else:
            path = primvar.GetPrimPath().AppendProperty("primvars:displayColor:indices")
            self._layer.SetTimeSample(path, index, Vt.IntArray.FromNumpy(indices))


def write_still(path: Path, *, scene: Scene, shapes: Sequence[Shape], rest: Sequence[ShapeFrame]) -> None:
    """Write shapes that do not move as a stage of one frame; the arguments are those of ``StageWriter``.

    Raises:
        EnvironmentFailedError: the file cannot be written.
    """
    writer = StageWriter(path, scene=scene, shapes=shapes, rest=rest, provenance={})
    writer.write_frame(0, rest)
    writer.close()


def open_stage(source: Path) -> Usd.Stage:
    """Open a stage file, or the stage of a run directory.

    Raises:
        InputError: there is none, or it is not a USD file.
    """
    path = source / STAGE_NAME if source.is_dir() else source
    if not path.is_file():
        raise InputError(f"{source}: {f'no {STAGE_NAME} in this directory' if source.is_dir() else 'no such file'}")
    try:
        return Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise InputError(f"{path}: not a readable USD file: {reason(error)}") from error


def _vectors(array: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(array, dtype=np.float32))


def _integers(array: np.ndarray) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(array, dtype=np.int32).ravel())


def _shape_path(shape: Shape) -> Sdf.Path:
    return _BODIES.AppendChild(shape.body).AppendChild(shape.name)


def _author_sample(layer: Sdf.Layer, index: int, shape: Shape, sample: ShapeFrame, with_velocities: bool) -> np.ndarray:
    """Write a shape at one frame; return its extent [2, 3], m."""
    if sample.points.shape != (len(shape.particles), 3):
        raise ValueError(f"{shape.body}: points {sample.points.shape} for a shape of {len(shape.particles)}")
    points = _vectors(sample.points)
    samples = {"points": points, "extent": _extent(shape, points)}
    if shape.name == SURFACE:
        samples[_normals_name(shape)] = _vectors(sample.normals)
    if with_velocities:
        samples["velocities"] = _vectors(sample.velocities)
    for name, value in samples.items():
        layer.SetTimeSample(_shape_path(shape).AppendProperty(name), index, value)
    return np.array(samples["extent"])


def _extent(shape: Shape, points: Vt.Vec3fArray) -> Vt.Vec3fArray:
    if shape.name == SURFACE:
        return UsdGeom.PointBased.ComputeExtent(points)
    if shape.name == SPRINGS:
        return UsdGeom.Curves.ComputeExtent(points, [shape.width])
    return UsdGeom.Points.ComputeExtent(points, Vt.FloatArray(len(points), shape.width))


def _normals_name(shape: Shape) -> str:
    """Return the attribute that holds the normals: those that corners choose from have indices, as a primvar."""
    return "normals" if shape.corner_normals is None else "primvars:normals"


def _define_world(stage: Usd.Stage, scene: Scene, provenance: Mapping[str, object]) -> None:
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, scene.up_axis)
    stage.SetTimeCodesPerSecond(scene.fps)
    stage.SetFramesPerSecond(scene.fps)
    world = UsdGeom.Xform.Define(stage, _WORLD).GetPrim()
    stage.SetDefaultPrim(world)
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    Usd.ModelAPI(world).SetAssetName(scene.name)
    world.SetCustomDataByKey("provenance", {key: _storable(value) for key, value in provenance.items()})
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, _BODIES)).SetKind(Kind.Tokens.group)


def _storable(value: object) -> object:
    if isinstance(value, np.generic):
        value = value.item()
    return value if isinstance(value, str | bool | int | float) else json.dumps(value, default=str)


def _define_looks(stage: Usd.Stage) -> None:
    UsdGeom.Scope.Define(stage, _LOOKS)
    color3f, number = Sdf.ValueTypeNames.Color3f, Sdf.ValueTypeNames.Float

    def surface(name: str, roughness: float, clearcoat: float) -> UsdShade.Shader:
        material = UsdShade.Material.Define(stage, _LOOKS.AppendChild(name))
        shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
        shader.CreateIdAttr("UsdPreviewSurface")
        shader.CreateInput("roughness", number).Set(roughness)
        shader.CreateInput("clearcoat", number).Set(clearcoat)
        shader.CreateInput("clearcoatRoughness", number).Set(0.1)
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        return shader

    jelly = surface("jelly", roughness=0.35, clearcoat=0.5)
    reader = UsdShade.Shader.Define(stage, _LOOKS.AppendPath("jelly/color"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    reader.CreateInput("fallback", Sdf.ValueTypeNames.Float3).Set(Gf.Vec3f(*LINEAR_TABLE[0].tolist()))
    result = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    jelly.CreateInput("diffuseColor", color3f).ConnectToSource(result)

    collider = surface("collider", roughness=0.8, clearcoat=0.0)
    collider.CreateInput("diffuseColor", color3f).Set(Gf.Vec3f(_COLLIDER_GREY))


def _define_lights(stage: Usd.Stage, scene: Scene) -> None:
    UsdGeom.Xform.Define(stage, _LIGHTS)
    dome = UsdLux.DomeLight.Define(stage, _LIGHTS.AppendChild("sky"))
    dome.CreateIntensityAttr(0.5)
    for name, direction, intensity, angle in (
        ("key", _KEY_DIRECTION, 2.0, 6.0),
        ("fill", _FILL_DIRECTION, 0.4, 30.0),
    ):
        light = UsdLux.DistantLight.Define(stage, _LIGHTS.AppendChild(name))
        light.CreateIntensityAttr(intensity)
        light.CreateAngleAttr(angle)
        # Normalised, the intensity means the same in renderers with and without soft shadows.
        light.CreateNormalizeAttr(True)
        light.MakeMatrixXform().Set(_matrix(_facing(direction, scene), np.zeros(3)))


def _define_shape(stage: Usd.Stage, shape: Shape, rest: ShapeFrame, scene: Scene) -> UsdGeom.PointBased:
    path = _shape_path(shape)
    Usd.ModelAPI(UsdGeom.Xform.Define(stage, path.GetParentPath())).SetKind(Kind.Tokens.component)
    prim: UsdGeom.PointBased
    if shape.name == SURFACE:
        prim = _define_mesh(stage, path, rest.points, shape.counts, shape.corners)
        prim.CreateDoubleSidedAttr(shape.double_sided)
        _define_normals(prim, shape, rest.normals)
    elif shape.name == SPRINGS:
        prim = _define_segments(stage, path, rest.points, width=shape.width)
    else:
        prim = _define_balls(stage, path, rest.points, width=shape.width)
    _bind(prim, "jelly")
    if scene.output.velocities:
        prim.CreateVelocitiesAttr()
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
        material = define_look(mesh.GetPrim().GetStage(), _LOOKS.AppendChild(name), look, texture_folder)
        subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset(name, _integers(faces))
        UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material)


def _set_colors(prim: UsdGeom.Gprim, interpolation: str, table: np.ndarray, indices: np.ndarray, scene: Scene) -> None:
    color = prim.CreateDisplayColorPrimvar(interpolation)
    if scene.output.color == "rgb":
        color.Set(_vectors(table[indices]))
    else:
        color.Set(_vectors(table))
        color.SetIndices(_integers(indices))


def _define_normals(mesh: UsdGeom.Mesh, shape: Shape, normals: np.ndarray) -> None:
    if shape.corner_normals is None:
        mesh.CreateNormalsAttr(_vectors(normals))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    else:
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying
        )
        primvar.Set(_vectors(normals))
        primvar.SetIndices(_integers(shape.corner_normals))


def _define_mesh(
    stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, counts: np.ndarray, corners: np.ndarray
) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    mesh.CreateDoubleSidedAttr(False)
    mesh.CreateFaceVertexCountsAttr(_integers(counts))
    mesh.CreateFaceVertexIndicesAttr(_integers(corners))
    mesh.CreatePointsAttr(_vectors(points))
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    return mesh


def _bind(shape: UsdGeom.Gprim, look: str) -> None:
    material = UsdShade.Material.Get(shape.GetPrim().GetStage(), _LOOKS.AppendChild(look))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)


def _define_colliders(stage: Usd.Stage, scene: Scene, bounds: np.ndarray, rest_center: np.ndarray) -> None:
    """Draw what the bodies collide with; infinite walls reach well around the motion, bounds [2, 3], m."""
    UsdGeom.Xform.Define(stage, _COLLIDERS)
    diagonal = _diagonal(bounds)
    for collider in scene.colliders:
        path = _COLLIDERS.AppendChild(collider.name)
        shape: UsdGeom.Gprim
        if isinstance(collider, PlaneCollider):
            shape = _define_rectangle(stage, path, np.array(collider.center), collider.frame(), collider.size)
        elif isinstance(collider, HalfSpaceCollider):
            tangent, bitangent, normal = plane_frame(collider.normal, None)
            if (rest_center - collider.center) @ normal < 0:
                # Seen from behind, a wall is culled: its front has to face the bodies.
                tangent, bitangent, normal = bitangent, tangent, -normal
            middle = bounds.mean(axis=0)
            center = middle - normal * ((middle - collider.center) @ normal)
            size = (_WALL_SIZE * diagonal, _WALL_SIZE * diagonal)
            shape = _define_rectangle(stage, path, center, (tangent, bitangent, normal), size)
        elif isinstance(collider, SphereCollider):
            shape = UsdGeom.Sphere.Define(stage, path)
            shape.CreateRadiusAttr(collider.radius)
            shape.CreateExtentAttr(_vectors(np.array([[-collider.radius] * 3, [collider.radius] * 3])))
            shape.AddTranslateOp().Set(Gf.Vec3d(*collider.center))
        else:
            shape = _define_edges(stage, path, collider, width=diagonal / 300)
        shape.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(_COLLIDER_GREY)])
        _bind(shape, "collider")


def _define_rectangle(
    stage: Usd.Stage,
    path: Sdf.Path,
    center: np.ndarray,
    frame: tuple[np.ndarray, np.ndarray, np.ndarray],
    size: tuple[float, float],
) -> UsdGeom.Mesh:
    tangent, bitangent, normal = frame
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    points = center + corners @ np.stack([tangent, bitangent])
    mesh = _define_mesh(stage, path, points, np.array([4]), np.arange(4))
    mesh.CreateNormalsAttr(_vectors(np.tile(normal, (4, 1))))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return mesh


def _define_edges(stage: Usd.Stage, path: Sdf.Path, box: BoxCollider, *, width: float) -> UsdGeom.BasisCurves:
    """Draw a room as its twelve edges, so that what is inside stays visible."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    first, second = np.nonzero(np.abs(corners[:, None] - corners).sum(axis=2) == 1)
    edges = np.stack([first, second], axis=1)[first < second]
    points = np.array(box.center) + (corners[edges.ravel()] - 0.5) * box.size
    return _define_segments(stage, path, points, width=width)


def _define_segments(stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, *, width: float) -> UsdGeom.BasisCurves:
    """Draw straight lines, each from one point to the next of the points, [2 line_count, 3], m."""
    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr(_integers(np.full(len(points) // 2, 2)))
    curves.CreatePointsAttr(_vectors(points))
    curves.CreateWidthsAttr([width])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    curves.CreateExtentAttr(UsdGeom.Curves.ComputeExtent(curves.GetPointsAttr().Get(), [width]))
    return curves


def _define_balls(stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, *, width: float) -> UsdGeom.Points:
    balls = UsdGeom.Points.Define(stage, path)
    balls.CreatePointsAttr(_vectors(points))
    # One for all would do, but then USD cannot compute extents.
    balls.CreateWidthsAttr(Vt.FloatArray(len(points), width))
    balls.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    balls.CreateExtentAttr(UsdGeom.Points.ComputeExtent(balls.GetPointsAttr().Get(), balls.GetWidthsAttr().Get()))
    return balls


def _define_camera(stage: Usd.Stage, scene: Scene, bounds: np.ndarray) -> None:
    """Place a camera that sees the whole motion, bounds [2, 3], m, and the balls close to it."""
    diagonal = _diagonal(bounds)
    low, high = bounds.copy()
    for collider in scene.colliders:
        if isinstance(collider, SphereCollider) and collider.radius < diagonal:
            center = np.array(collider.center)
            if np.linalg.norm(center - np.clip(center, *bounds)) < collider.radius + diagonal / 2:
                low = np.minimum(low, center - collider.radius)
                high = np.maximum(high, center + collider.radius)
    axes = _facing(_CAMERA_DIRECTION, scene)
    x, y, z = axes @ np.array(list(np.ndindex(2, 2, 2)) * (high - low) + low).T
    # In the axes of the camera, a corner is seen from (X, Y, Z) while |x - X| <= s (Z - z), with s the slope of the
    # frustum's sides; the closest place that sees all follows from the outermost corner on each side.
    placed = []
    for across, aperture in ((x, _APERTURE[0]), (y, _APERTURE[1])):
        slope = _FRAME_FILL * aperture / (2 * _FOCAL_LENGTH)
        right, left = np.max(across + slope * z), np.max(-across + slope * z)
        placed.append(((right - left) / 2, (right + left) / (2 * slope)))
    back = max(placed[0][1], placed[1][1], z.max() + 1e-3)
    distance = back - (z.max() + z.min()) / 2

    camera = UsdGeom.Camera.Define(stage, _CAMERA)
    camera.CreateFocalLengthAttr(_FOCAL_LENGTH)
    camera.CreateHorizontalApertureAttr(_APERTURE[0])
    camera.CreateVerticalApertureAttr(_APERTURE[1])
    camera.CreateFocusDistanceAttr(distance)
    camera.CreateClippingRangeAttr(Gf.Vec2f(min(distance / 100, (back - z.max()) / 2), distance * 100))
    camera.MakeMatrixXform().Set(_matrix(axes, axes.T @ np.array([placed[0][0], placed[1][0], back])))


def _diagonal(bounds: np.ndarray) -> float:
    return max(float(np.linalg.norm(bounds[1] - bounds[0])), 1e-3)


def _facing(direction: tuple[float, float, float], scene: Scene) -> np.ndarray:
    """Return the axes (right, up, backward) [3, 3] of a camera or light that looks from a direction."""
    x, y, z = direction
    backward = np.array([x, y, z] if scene.up_axis == "Y" else [x, -z, y])
    backward /= np.linalg.norm(backward)
    right = np.cross(np.eye(3)[scene.up], backward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(backward, right), backward])


def _matrix(axes: np.ndarray, position: np.ndarray) -> Gf.Matrix4d:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = axes, position
    return Gf.Matrix4d(matrix.tolist())


def _automatic_range(frames: Sequence[Sequence[np.ndarray]]) -> tuple[float, float]:
    """Return the 1st to 99th percentile of all forces, N; never an empty range."""
    forces = [force for frame in frames for force in frame]
    if not forces:
        return 0.0, 1.0
    low, high = np.percentile(np.concatenate(forces), (1, 99), overwrite_input=True).tolist()
    if high - low <= _FLAT_RANGE * high:
        return low, (2 * high if high > 0 else 1.0)
    return low, high


def _require_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot make this directory: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise EnvironmentFailedError(f"{folder}: no permission to write in this directory")


def _export(layer: Sdf.Layer, path: Path) -> None:
    """Write a layer to a file that is either complete or, under its final name, not there at all."""
    try:
        with whole_file(path) as unfinished:
            if not layer.Export(str(unfinished)):
                raise EnvironmentFailedError(f"{path}: cannot write the stage")
    except Tf.ErrorException as error:
        raise EnvironmentFailedError(f"{path}: cannot write the stage: {reason(error)}") from error
    except OSError as error:
        raise EnvironmentFailedError(f"{path}: cannot write the stage: {error.strerror}") from error
