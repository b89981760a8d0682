"""Synthetic surfaces and stages: a cube's skin that falls, squashes and drifts, without a simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from warpjelly.scene import Scene
from warpjelly.shapes import SURFACE, Shape, ShapeFrame
from warpjelly.stage.stagefiles import STAGE_NAME
from warpjelly.stage.stagewriter import StageWriter


@dataclass(frozen=True)
class Surface:
    """A shape and its sample at rest."""

    shape: Shape
    rest: ShapeFrame

    @property
    def points(self) -> np.ndarray:
        """Rest positions, float32 [point_count, 3], m."""
        return self.rest.points


def cube_surface(body: str = "cube", count: int = 5, center: tuple[float, float, float] = (0.0, 1.0, 0.0)) -> Surface:
    """Return the skin of a cube of edge 1 m with ``count`` points along an edge."""
    axis = np.linspace(-0.5, 0.5, count)
    lattice = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    ids = np.arange(count**3).reshape(count, count, count)
    quads = []
    for k in range(3):
        for end in (0, -1):
            face = ids.take(end, axis=k)
            quad = np.stack([face[:-1, :-1], face[1:, :-1], face[1:, 1:], face[:-1, 1:]], axis=-1).reshape(-1, 4)
            # The other two axes (i, j) span a right-handed frame with +k except for k = 1.
            quads.append(quad if (end == -1) != (k == 1) else quad[:, ::-1])
    used, corners = np.unique(np.concatenate(quads), return_inverse=True)
    points = lattice[used]
    normals = np.where(np.abs(points) == 0.5, np.sign(points), 0.0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    everyone = np.arange(len(points), dtype=np.int32)[:, None]
    quads = corners.reshape(-1, 4).astype(np.int32)
    shape = Shape(
        body=body,
        name=SURFACE,
        particles=everyone,
        weights=np.ones(everyone.shape, np.float32),
        counts=np.full(len(quads), 4, np.int32),
        corners=quads.ravel(),
    )
    rest = ShapeFrame(
        points=(points + center).astype(np.float32),
        normals=normals.astype(np.float32),
        velocities=np.zeros(points.shape, np.float32),
        forces=np.zeros(len(points), np.float32),
    )
    return Surface(shape, rest)


def moved_surface(mesh: Surface, frame: int, up: int = 1) -> ShapeFrame:
    """Return the surface at a frame: lower, flatter, wider and more strained with every frame, always above 0."""
    share = frame / 10
    scale = np.full(3, 1 + 0.2 * share)
    scale[up] = 1 - 0.3 * share
    points = mesh.points * scale.astype(np.float32)
    points[:, (up + 1) % 3] += np.float32(0.07 * frame)
    height = points[:, up] - points[:, up].min()
    velocities = np.tile(np.float32([0.1, -0.2, 0.3]) * frame, (len(points), 1))
    # Different at every point, so that percentiles differ from the least and the greatest.
    forces = (frame * (1.5 - height) + 0.5 + mesh.points @ [0.1, 0.05, 0.02]).astype(np.float32)
    return ShapeFrame(points=points, normals=mesh.rest.normals, velocities=velocities, forces=forces)


def make_scene(**changes: Any) -> Scene:
    """Return a valid scene of one cube and a floor, with top-level keys replaced."""
    data: dict[str, Any] = {
        "name": "test",
        "fps": 24.0,
        "materials": {"jelly": {}},
        "bodies": [{"name": "cube", "type": "cube", "material": "jelly"}],
        "colliders": [{"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [10.0, 10.0]}],
    }
    return Scene.model_validate({**data, **changes})


def start_stage(
    folder: Path, meshes: Sequence[Surface], scene: Scene | None = None, provenance: Mapping[str, object] | None = None
) -> StageWriter:
    """Return a writer for a stage of surfaces in a run directory."""
    return StageWriter(
        folder,
        scene=scene or make_scene(),
        shapes=[mesh.shape for mesh in meshes],
        rest=[mesh.rest for mesh in meshes],
        provenance=provenance or {},
    )


def write_stage(path: Path, scene: Scene | None = None, frames: int = 10, meshes: list[Surface] | None = None) -> Path:
    """Write a stage of the synthetic motion and return its path."""
    scene = scene or make_scene()
    center = (0.0, 0.5, 0.0) if scene.up_axis == "Y" else (0.0, 0.0, 0.5)
    meshes = meshes or [cube_surface(center=center)]
    with TemporaryDirectory(dir=path.parent) as folder:
        writer = start_stage(Path(folder), meshes, scene, {"version": "0", "scene": {"name": scene.name}})
        for frame in range(frames):
            writer.write_frame(frame, [moved_surface(mesh, frame, scene.up) for mesh in meshes])
        writer.finish()
        (Path(folder) / STAGE_NAME).replace(path)
    return path
