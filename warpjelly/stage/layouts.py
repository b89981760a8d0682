"""Where a run is in USD: in a world of its own, or over meshes of a shot."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from ..polygons import unit
from ..scene import Scene
from ..shapes import Shape, ShapeFrame
from ..shot import Shot
from .prims import WORLD, integers, vectors
from .stagefiles import OVER_NAME, STAGE_NAME, TEXTURES_NAME, remove_notes, set_note
from .surroundings import define_camera, define_colliders
from .usd import FORCE, NORMALS, author_sample, declare_samples, define_rest, legend, set_metadata, shape_path, storable

# What a root does not take from that of the shot, which is in the stage with all that it says itself.
_OF_THE_LAYER = ("subLayers", "subLayerOffsets", "layerRelocates", "comment", "documentation")
# What a mesh may say that its old motion or shape is in, and that is not true of the new one.
_DEFORMED = ("normals", NORMALS, f"{NORMALS}:indices", "velocities", "accelerations")


class Layout(Protocol):
    """Where the shapes of a run are, in time and space, and what is around them."""

    whole_name: str
    """Name of the file that has all samples in the end."""
    clip_prims: list[Sdf.Path]
    """Below which value clips have samples, each prim for itself."""
    under: list[str]
    """Paths of the layers below those of the run."""
    shows_force: bool
    """Whether shapes have the colours of forces."""

    def time(self, frame: int) -> float:
        """Return the time code of a frame."""

    def frame(self, time: float) -> int:
        """Return the frame of a time code."""

    def set_metadata(self, layer: Sdf.Layer) -> None:
        """Say what units, axes and time codes of a layer mean."""

    def define_rest(
        self, layer: Sdf.Layer, rest: Sequence[ShapeFrame], provenance: Mapping[str, object], folder: Path
    ) -> None:
        """Write all that does not depend on the motion into an empty layer, and textures below a folder."""

    def define_motion(self, stage: Usd.Stage, frame_count: int, force_range: tuple[float, float]) -> None:
        """Write what depends on the frames so far, but for samples; forces are those at both ends of the colours, N."""

    def author(self, layer: Sdf.Layer, frame: int, shape: Shape, sample: ShapeFrame) -> None:
        """Write the sample of a shape at a frame, but for colours."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of what another layout needs to go on from here."""

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on from where another layout was."""


def layout_of(scene: Scene, shapes: Sequence[Shape], rest: Sequence[ShapeFrame], folder: Path) -> Layout:
    """Return the layout that a scene asks for.

    Args:
        scene: what is simulated.
        shapes: what is shown.
        rest: a sample of each.
        folder: the run directory.
    """
    return World(scene, shapes, rest) if scene.output.over is None else Over(scene, shapes, folder)


class World:
    """A stage of its own: everything below /World, in metres, a time code for each frame."""

    whole_name = STAGE_NAME
    shows_force = True

    def __init__(self, scene: Scene, shapes: Sequence[Shape], rest: Sequence[ShapeFrame]) -> None:
        self.clip_prims = [WORLD]
        self.under: list[str] = []
        self._scene, self._shapes = scene, shapes
        points = np.concatenate([sample.points for sample in rest]).astype(np.float64)
        # The lowest and the highest corner of the box around all samples, m.
        self._bounds = np.stack([points.min(axis=0), points.max(axis=0)])
        self._rest_center = self._bounds.mean(axis=0)

    def time(self, frame: int) -> float:
        """Return the time code of a frame: its number."""
        return float(frame)

    def frame(self, time: float) -> int:
        """Return the frame of a time code."""
        return round(time)

    def set_metadata(self, layer: Sdf.Layer) -> None:
        """Say what units, axes and time codes of a layer mean."""
        set_metadata(Usd.Stage.Open(layer), self._scene)
        layer.defaultPrim = WORLD.name

    def define_rest(
        self, layer: Sdf.Layer, rest: Sequence[ShapeFrame], provenance: Mapping[str, object], folder: Path
    ) -> None:
        """Write topology, rest pose, looks and lights."""
        define_rest(
            Usd.Stage.Open(layer),
            scene=self._scene,
            shapes=self._shapes,
            rest=rest,
            provenance=provenance,
            texture_folder=folder / TEXTURES_NAME,
        )

    def define_motion(self, stage: Usd.Stage, frame_count: int, force_range: tuple[float, float]) -> None:
        """Write time range, legend, colliders and camera."""
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(max(frame_count - 1, 0))
        stage.OverridePrim(WORLD).SetCustomDataByKey("legend", legend(self._shapes, force_range))
        define_colliders(stage, self._scene, self._bounds, self._rest_center)
        define_camera(stage, self._scene, self._bounds)

    def author(self, layer: Sdf.Layer, frame: int, shape: Shape, sample: ShapeFrame) -> None:
        """Write the sample of a shape at a frame, but for colours."""
        extent = author_sample(layer, frame, shape, sample)
        self._bounds[0] = np.minimum(self._bounds[0], extent[0])
        self._bounds[1] = np.maximum(self._bounds[1], extent[1])

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the bounds so far."""
        return {"bounds": self._bounds.copy()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over bounds."""
        self._bounds = arrays["bounds"].copy()


class Over:
    """Opinions over meshes of a shot, in the space of each, its unit and its time; nothing else, and no new prim."""

    whole_name = OVER_NAME
    shows_force = False

    def __init__(self, scene: Scene, shapes: Sequence[Shape], folder: Path) -> None:
        self.clip_prims = [shape_path(shape) for shape in shapes]
        self._scene, self._shapes = scene, shapes
        self._shot = Shot(scene)
        self.under = [_path_between(folder, self._shot.path)]
        self._moving = {str(path) for path in self.clip_prims if self._shot.moves(str(path))}

    def time(self, frame: int) -> float:
        """Return the time code of a frame in the shot."""
        return self._shot.time(frame)

    def frame(self, time: float) -> int:
        """Return the frame of a time code of the shot."""
        return self._shot.frame(time)

    def set_metadata(self, layer: Sdf.Layer) -> None:
        """Make a layer mean as a stage what the shot does."""
        shot = self._shot.stage.GetRootLayer().pseudoRoot
        for key in shot.ListInfoKeys():
            if key not in _OF_THE_LAYER:
                layer.pseudoRoot.SetInfo(key, shot.GetInfo(key))
        # Of a run that this one goes over.
        remove_notes(layer)
        # What the shot leaves to defaults is said: a sublayer and its root have the same time only where both say so.
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageMetersPerUnit(stage, self._shot.unit)
        UsdGeom.SetStageUpAxis(stage, self._scene.up_axis)
        stage.SetTimeCodesPerSecond(self._shot.stage.GetTimeCodesPerSecond())
        stage.SetFramesPerSecond(self._shot.stage.GetFramesPerSecond())
        set_note(layer, "over", Vt.StringArray([str(path) for path in self.clip_prims]))

    def define_rest(
        self, layer: Sdf.Layer, rest: Sequence[ShapeFrame], provenance: Mapping[str, object], folder: Path
    ) -> None:
        """Declare what varies, with the normals at the start, and block what would not fit the motion."""
        self.set_metadata(layer)
        set_note(layer, "provenance", {key: storable(value) for key, value in provenance.items()})
        declare_samples(layer, self._shapes, self._scene, forces=self._scene.output.forces)
        for shape, sample in zip(self._shapes, rest, strict=True):
            prim = layer.GetPrimAtPath(shape_path(shape))
            if shape.corner_normals is not None:
                prim.properties[NORMALS].SetInfo("interpolation", UsdGeom.Tokens.faceVarying)
                prim.properties[NORMALS].default = vectors(self._placed(shape, 0, sample).normals)
                indices = Sdf.AttributeSpec(prim, f"{NORMALS}:indices", Sdf.ValueTypeNames.IntArray)
                indices.default = integers(shape.corner_normals)
            for attribute in self._shot.mesh(str(prim.path)).GetPrim().GetAuthoredAttributes():
                if attribute.GetName() in _DEFORMED and attribute.GetName() not in prim.properties:
                    Sdf.AttributeSpec(prim, attribute.GetName(), attribute.GetTypeName()).default = Sdf.ValueBlock()
            if self._scene.output.forces:
                prim.properties[FORCE].SetInfo("interpolation", UsdGeom.Tokens.vertex)

    def define_motion(self, stage: Usd.Stage, frame_count: int, force_range: tuple[float, float]) -> None:
        """Write the time range: that of the shot, and longer if there are more frames."""
        first, last = self._shot.time_range(frame_count)
        stage.SetStartTimeCode(first)
        stage.SetEndTimeCode(last)

    def author(self, layer: Sdf.Layer, frame: int, shape: Shape, sample: ShapeFrame) -> None:
        """Write the sample of a shape at a frame in the space of its mesh then."""
        author_sample(layer, self.time(frame), shape, self._placed(shape, frame, sample))

    def arrays(self) -> dict[str, np.ndarray]:
        """Return nothing: all that is written of a frame follows from it alone."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take nothing over."""

    def _placed(self, shape: Shape, frame: int, sample: ShapeFrame) -> ShapeFrame:
        """Return what is written of a sample in the space of its mesh at a frame, velocities per second."""
        path = str(shape_path(shape))
        matrix = self._shot.matrix(path, frame)
        inverse, points = np.linalg.inv(matrix), sample.points.astype(float)
        placed = replace(sample, points=_moved(points, inverse))
        if self._scene.output.velocities:
            velocities = _turned(sample.velocities, inverse)
            if path in self._moving:
                # What stands still in the scene moves against a space that moves.
                before, after = (np.linalg.inv(self._shot.matrix(path, frame + half)) for half in (-0.5, 0.5))
                velocities += (_moved(points, after) - _moved(points, before)) * self._scene.fps
            placed = replace(placed, velocities=velocities)
        if shape.corner_normals is not None:
            # Areas turn by the inverse transpose, and change sides where space is mirrored.
            left_handed = self._shot.mesh(path).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
            side = np.sign(np.linalg.det(matrix[:3, :3])) * (-1.0 if left_handed else 1.0)
            placed = replace(placed, normals=unit(_turned(sample.normals, matrix.T)) * side)
        return placed


def _moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Move points [count, 3] by a matrix for column vectors, [4, 4]."""
    moved = _turned(points, matrix)
    moved += matrix[:3, 3]
    return moved


def _turned(vectors: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return what a matrix for column vectors, [4, 4], makes of directions [count, 3]."""
    # Matrix products would share this among threads that wait for each other where others work.
    turned: np.ndarray = np.einsum("ij,kj->ki", matrix[:3, :3], vectors)
    return turned


def _path_between(folder: Path, file: Path) -> str:
    """Return the path of a file from a folder, as USD has it; whole where there is none from there."""
    try:
        return Path(os.path.relpath(file, folder.absolute())).as_posix()
    except ValueError:
        # On Windows, another drive.
        return file.as_posix()
