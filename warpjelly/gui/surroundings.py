"""What is around the bodies in the page: colliders, ground, light, background, and from where they are looked at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..scene import AnyCollider, BoxCollider, HalfSpaceCollider, PlaneCollider, Scene, SphereCollider, plane_frame
from ..stage.common import corners_of
from ..stage.prims import facing
from ..stage.surroundings import APERTURE, FOCAL_LENGTH, framing

# Walls are light, so that shadows show; rounder things are darker, so that they stand out from walls.
_WALL, _BALL, _CHOSEN = (205, 208, 214), (120, 145, 175), (95, 160, 245)
# Edge of the square that stands for an infinite wall, in diagonals of what is in view.
_WALL_SIZE = 20.0
_EDGE_PIXELS = 2.5
# The ground is drawn so much higher, m, that it is not hidden in a floor at the same height.
_LIFT = 4e-3
# From where a preset looks, for Y up; straight from above is nearly so, as up would be nowhere.
PRESETS = {
    "Perspective": (0.6, 0.45, 1.0),
    "Front": (0.0, 0.0, 1.0),
    "Right": (1.0, 0.0, 0.0),
    "Top": (0.0, 1.0, 1e-3),
}
# How much farther away than a camera of a run's stage, at least: what is seen may move, and windows may be narrow.
_ROOM_AROUND = 1.6
# Vertical field of view of the camera of stages, rad.
FIELD_OF_VIEW = 2 * math.atan(APERTURE[1] / (2 * FOCAL_LENGTH))


class Colliders:
    """What the bodies collide with, as nodes by name; those that stay are changed, not made anew."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._nodes: dict[str, tuple[str, Any]] = {}

    def show(self, scene: Scene, bounds: np.ndarray, chosen: str | None) -> None:
        """Draw the colliders of a scene; infinite walls reach well around bounds, [2, 3], m."""
        for name in self._nodes.keys() - {collider.name for collider in scene.colliders}:
            self._nodes.pop(name)[1].remove()
        for collider in scene.colliders:
            kind, node = self._nodes.get(str(collider.name), ("", None))
            if kind != collider.type:
                if node is not None:
                    node.remove()
                node = self._made(collider)
                self._nodes[str(collider.name)] = (collider.type, node)
            plain = _WALL if isinstance(collider, PlaneCollider | HalfSpaceCollider) else _BALL
            color = _CHOSEN if collider.name == chosen else plain
            if isinstance(collider, SphereCollider):
                node.radius, node.position, node.color = collider.radius, collider.center, color
            elif isinstance(collider, BoxCollider):
                node.points = _edges(collider)
                node.colors = np.array(color, np.uint8)
            else:
                node.vertices, node.color = _square(collider, bounds), color

    def _made(self, collider: AnyCollider) -> Any:
        path = f"/colliders/{collider.name}"
        if isinstance(collider, SphereCollider):
            return self._scene.add_icosphere(path, collider.radius, subdivisions=4)
        if isinstance(collider, BoxCollider):
            return self._scene.add_line_segments(
                path, _edges(collider), _BALL, thickness=_EDGE_PIXELS, thickness_units="screen"
            )
        triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
        # It is wide and flat: it gets shadows, and throws none.
        return self._scene.add_mesh_simple(
            path, np.zeros((4, 3), np.float32), triangles, side="double", cast_shadow=False
        )


def _square(collider: PlaneCollider | HalfSpaceCollider, bounds: np.ndarray) -> np.ndarray:
    """Return the corners [4, 3] of a plane, or of what is shown of an infinite wall, m."""
    center = np.array(collider.center)
    if isinstance(collider, PlaneCollider):
        tangent, bitangent, _ = collider.frame()
        size: Any = collider.size
    else:
        tangent, bitangent, normal = plane_frame(collider.normal, None)
        middle = bounds.mean(axis=0)
        center = middle - normal * ((middle - center) @ normal)
        size = _WALL_SIZE * max(float(np.linalg.norm(bounds[1] - bounds[0])), 1e-3)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * size
    return np.asarray(center + corners @ np.stack([tangent, bitangent]), np.float32)


def _edges(box: BoxCollider) -> np.ndarray:
    """Return the twelve edges of a room, float32 [12, 2, 3], m."""
    corners = np.array(list(np.ndindex(2, 2, 2)))
    first, second = np.nonzero(np.abs(corners[:, None] - corners).sum(axis=2) == 1)
    ends = np.stack([first, second], axis=1)[first < second]
    return np.asarray(np.array(box.center) + (corners[ends] - 0.5) * box.size, np.float32)


def in_view(scene: Scene, bodies: np.ndarray) -> np.ndarray:
    """Return what a camera should see, the corners of boxes, [count, 3], m.

    Args:
        scene: its colliders are seen where they are near.
        bodies: box around the bodies, [2, 3], m.
    """
    diagonal = float(np.linalg.norm(bodies[1] - bodies[0]))
    middle = bodies.mean(axis=0)
    seen = [corners_of(bodies)]
    for collider in scene.colliders:
        center = np.array(collider.center)
        if isinstance(collider, BoxCollider | SphereCollider):
            half = np.array(collider.size) / 2 if isinstance(collider, BoxCollider) else np.full(3, collider.radius)
            away = np.linalg.norm(np.maximum(np.abs(middle - center) - half, 0.0))
            if np.linalg.norm(half) < 5 * diagonal and away < 5 * diagonal:
                seen.append(corners_of(np.stack([center - half, center + half])))
        else:
            # Where the bodies would land on it, if that is not far away.
            normal = plane_frame(collider.normal, None)[2]
            foot = middle - normal * ((middle - center) @ normal)
            if np.linalg.norm(foot - middle) < 5 * diagonal:
                seen.append(corners_of(bodies + (foot - middle)))
    return np.concatenate(seen)


def look(preset: str, up_axis: str, points: np.ndarray, aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where a camera stands that looks from a preset, and what it looks at, m.

    Args:
        preset: of the presets.
        up_axis: of the scene.
        points: what the camera sees, [count, 3], m.
        aspect: width over height of what it sees them in.
    """
    axes = facing(PRESETS[preset], up_axis)
    position, distance, _ = framing(axes, points)
    target = position - distance * axes[2]
    return target + max(_ROOM_AROUND, APERTURE[0] / APERTURE[1] / aspect) * (position - target), target


class Stage:
    """Ground, light and background."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        self._sun = scene.add_light_directional("/light/sun", cast_shadow=True)
        self._sky = scene.add_light_ambient("/light/sky")
        self._ground: Any = None

    def light(self, *, azimuth: float, elevation: float, sun: float, sky: float, shadows: bool, up_axis: str) -> None:
        """Light the scene by a sun, in degrees around the up axis and above the ground, and evenly by the sky."""
        around, above = math.radians(azimuth), math.radians(elevation)
        level = math.cos(above)
        direction = (level * math.sin(around), math.sin(above), level * math.cos(around))
        self._sun.position = tuple(10 * facing(direction, up_axis)[2])
        self._sun.intensity, self._sun.cast_shadow = sun, shadows
        self._sky.intensity = sky

    def ground(self, *, shown: bool, height: float, size: float, up_axis: str) -> None:
        """Draw the ground as a grid of squares, halved by thinner lines, or not."""
        if self._ground is not None:
            self._ground.remove()
            self._ground = None
        if shown:
            position = np.zeros(3)
            position["XYZ".index(up_axis)] = height + _LIFT
            self._ground = self._scene.add_grid(
                "/ground",
                infinite_grid=True,
                plane="xz" if up_axis == "Y" else "xy",
                cell_size=size / 2,
                section_size=size,
                fade_distance=30 * size,
                shadow_opacity=0.2,
                position=tuple(position),
            )

    def background(self, color: tuple[int, int, int]) -> None:
        """Show one colour behind everything, sRGB, 0 to 255."""
        self._scene.set_background_image(np.full((4, 4, 3), color, np.uint8), format="png")
