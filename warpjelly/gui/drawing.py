"""Bodies as the page draws them: surfaces, springs and particles that move, plainly or in the colours of forces.

A mesh of viser has one colour, and keeps its buffers when its points move. So a surface in the colours of forces is
some meshes, one for each of a few colours, and faces go from one to another as forces change.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from ..colors import COLOR_COUNT, KIND_COLORS, LINEAR_TABLE, SRGB_TABLE, color_indices, linear_from_srgb
from ..polygons import triangulate
from ..shapes import PARTICLES, SPRINGS, Shape, ShapeFrame

# How many colours a surface has, and so how many meshes; the legend has as many steps.
STEPS = 32
# At most as many lines and balls of a body are drawn, evenly chosen: a browser does not draw more in time.
MOST_LINES, MOST_BALLS = 20_000, 50_000
# Jelly where colours do not show forces, sRGB.
PLAIN = (205, 66, 140)
_EDGE_COLOR, _EDGE_PIXELS = (60, 20, 45), 1.0

ForceRange = tuple[float, float]
Grabbed = Callable[[Any], Any]


def _bytes(colors: np.ndarray) -> np.ndarray:
    return np.rint(255 * colors).astype(np.uint8)


# sRGB, uint8, [COLOR_COUNT, 3]; of the steps, from their middles, [STEPS, 3].
_TABLE = _bytes(SRGB_TABLE)
STEP_COLORS = _TABLE[((np.arange(STEPS) + 0.5) * COLOR_COUNT / STEPS).astype(int)]
# Lines whose ends have colours of their own take them linear, as three.js computes.
_LINE_TABLE, _LINE_KINDS = _bytes(LINEAR_TABLE), _bytes(KIND_COLORS)
_LINE_PLAIN = _bytes(linear_from_srgb(np.array(PLAIN) / 255))
# What a mesh without triangles has.
_NO_POINTS, _NO_TRIANGLES = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)


class Drawing(Protocol):
    """Something in the page that follows a shape."""

    left_out: int
    """How many of its lines or balls are not drawn."""

    def show(self, frame: ShapeFrame, force_range: ForceRange | None) -> None:
        """Draw a sample, in the colours of forces between two, N, or plainly."""

    def remove(self) -> None:
        """Take it out of the page."""


class Surface:
    """Faces of a body, which can be dragged.

    Args:
        scene: viser's.
        path: of its nodes there.
        shape: what is drawn.
        start: its first sample, by which polygons are cut into triangles.
        grabbed: called with viser's events where somebody drags it.
    """

    left_out = 0

    def __init__(self, scene: Any, path: str, shape: Shape, start: ShapeFrame, grabbed: Grabbed) -> None:
        self._scene, self._path, self._grabbed = scene, path, grabbed
        self._side = "double" if shape.double_sided else "front"
        triangles, self._faces = triangulate(start.points, shape.counts, shape.corners)
        self._triangles = triangles.astype(np.uint32)
        self._counts, self._corners = shape.counts, shape.corners
        self._face_of_corner = np.repeat(np.arange(len(shape.counts)), shape.counts)
        self._meshes: list[Any] = []
        self._colored = False

    def show(self, frame: ShapeFrame, force_range: ForceRange | None) -> None:
        """Draw a sample."""
        if not self._meshes or self._colored != (force_range is not None):
            self.remove()
            self._colored = force_range is not None
            colors = STEP_COLORS if self._colored else np.array([PLAIN])
            self._meshes = [self._mesh(number, color) for number, color in enumerate(colors)]
            if not self._colored:
                self._meshes[0].faces = self._triangles
        if force_range is None:
            self._meshes[0].vertices = frame.points
            return
        colors = color_indices(frame.forces, force_range)
        # By faces: where triangles of one face had different colours, borders between colours would be jagged.
        sums = np.bincount(self._face_of_corner, colors[self._corners], minlength=len(self._counts))
        steps = (sums * STEPS / (np.maximum(self._counts, 1) * COLOR_COUNT)).astype(int)[self._faces]
        order = np.argsort(steps.astype(np.uint8), kind="stable")
        ends = np.cumsum(np.bincount(steps, minlength=STEPS))
        number = np.zeros(len(frame.points), np.uint32)
        for mesh, triangles in zip(self._meshes, np.split(self._triangles[order], ends[:-1]), strict=True):
            used = np.zeros(len(frame.points), bool)
            used[triangles] = True
            number[used] = np.arange(np.count_nonzero(used))
            mesh.vertices = frame.points[used] if len(triangles) else _NO_POINTS
            mesh.faces = number[triangles] if len(triangles) else _NO_TRIANGLES

    def remove(self) -> None:
        """Take it out of the page."""
        for mesh in self._meshes:
            mesh.remove()
        self._meshes = []

    def _mesh(self, number: int, color: np.ndarray) -> Any:
        # Copies, as viser writes later values into the arrays that a node was made with.
        mesh = self._scene.add_mesh_simple(
            f"{self._path}/{number}",
            _NO_POINTS.copy(),
            _NO_TRIANGLES.copy(),
            color=tuple(color.tolist()),
            side=self._side,
        )
        mesh.on_drag("left")(self._grabbed)
        return mesh


class Edges:
    """The edges of the faces of a body."""

    def __init__(self, scene: Any, path: str, shape: Shape, start: ShapeFrame) -> None:
        after = np.arange(1, len(shape.corners) + 1)
        last = np.cumsum(shape.counts) - 1
        after[last] = last - shape.counts + 1
        # Points of a surface that is hard at its edges are there several times.
        places = np.unique(start.points, axis=0, return_inverse=True)[1].ravel()
        ends = np.stack([shape.corners, shape.corners[after]], axis=1)
        _, first = np.unique(np.sort(places[ends], axis=1), axis=0, return_index=True)
        chosen = _evenly(len(first), MOST_LINES)
        self._ends = ends[first[chosen]]
        self.left_out = len(first) - len(chosen)
        self._lines = scene.add_line_segments(
            path, start.points[self._ends], _EDGE_COLOR, thickness=_EDGE_PIXELS, thickness_units="screen"
        )

    def show(self, frame: ShapeFrame, force_range: ForceRange | None) -> None:
        """Draw a sample."""
        self._lines.points = frame.points[self._ends]

    def remove(self) -> None:
        """Take it out of the page."""
        self._lines.remove()


class Springs:
    """The springs of a body."""

    def __init__(self, scene: Any, path: str, shape: Shape, start: ShapeFrame) -> None:
        count = len(start.points) // 2
        self._chosen = _evenly(count, MOST_LINES)
        self.left_out = count - len(self._chosen)
        self._kinds = (
            None if shape.kinds is None else np.repeat(_LINE_KINDS[shape.kinds[self._chosen]][:, None], 2, axis=1)
        )
        points = self._of(start.points)
        self._lines = scene.add_line_segments(path, points, self._plain(points), thickness=shape.width)

    def show(self, frame: ShapeFrame, force_range: ForceRange | None) -> None:
        """Draw a sample."""
        self._lines.points = points = self._of(frame.points)
        if self._kinds is None:
            forces = self._of(frame.forces)
            self._lines.colors = (
                self._plain(points) if force_range is None else _LINE_TABLE[color_indices(forces, force_range)]
            )

    def remove(self) -> None:
        """Take it out of the page."""
        self._lines.remove()

    def _of(self, values: np.ndarray) -> np.ndarray:
        """Return what both ends of the springs have that are drawn, [count, 2, ...]."""
        return values.reshape(-1, 2, *values.shape[1:])[self._chosen]

    def _plain(self, points: np.ndarray) -> np.ndarray:
        return self._kinds if self._kinds is not None else np.full(points.shape, _LINE_PLAIN)


class Balls:
    """The particles of a body."""

    def __init__(self, scene: Any, path: str, shape: Shape, start: ShapeFrame) -> None:
        self._chosen = _evenly(len(start.points), MOST_BALLS)
        self.left_out = len(start.points) - len(self._chosen)
        points = start.points[self._chosen]
        colors = np.full(points.shape, PLAIN, np.uint8)
        self._cloud = scene.add_point_cloud(
            path, points, colors, point_size=shape.width, point_shape="circle", precision="float32"
        )

    def show(self, frame: ShapeFrame, force_range: ForceRange | None) -> None:
        """Draw a sample."""
        self._cloud.points = points = frame.points[self._chosen]
        self._cloud.colors = (
            np.full(points.shape, PLAIN, np.uint8)
            if force_range is None
            else _TABLE[color_indices(frame.forces[self._chosen], force_range)]
        )

    def remove(self) -> None:
        """Take it out of the page."""
        self._cloud.remove()


def drawing(scene: Any, path: str, shape: Shape, start: ShapeFrame, grabbed: Grabbed) -> Drawing:
    """Return what draws a shape."""
    if shape.name == SPRINGS:
        return Springs(scene, path, shape, start)
    if shape.name == PARTICLES:
        return Balls(scene, path, shape, start)
    return Surface(scene, path, shape, start, grabbed)


def _evenly(count: int, most: int) -> np.ndarray:
    """Return numbers below a count, as many as there are or as are to be at most."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)
