"""What a model is read into: parts made of triangles, into which polygons are cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Part:
    """Triangles of a model file."""

    vertices: np.ndarray
    """Positions, float64 [vertex_count, 3]."""
    faces: np.ndarray
    """Vertices at the corners of each triangle, int64 [face_count, 3]; counterclockwise from outside."""


@dataclass(frozen=True)
class Model:
    """What a model file holds."""

    parts: list[Part]
    unit: float = 1.0
    """Metres per unit, 1 where the file does not say."""
    up_axis: str = ""
    """X, Y or Z; empty where the file does not say."""


def from_polygons(
    vertices: np.ndarray, counts: Sequence[int] | np.ndarray, corners: Sequence[int] | np.ndarray
) -> Part:
    """Make a part of polygons, given as in ``triangulate``.

    Raises:
        ValueError: a corner is at a vertex that does not exist.
    """
    corners = np.asarray(corners, np.int64)
    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise ValueError(f"a face has a vertex that does not exist; there are {len(vertices)}")
    return Part(vertices, triangulate(vertices, np.asarray(counts, np.int64), corners))


def placed(part: Part, matrix: np.ndarray) -> Part:
    """Move a part by a matrix for column vectors, [4, 4]; one that mirrors it turns its triangles round."""
    # Equal vertices must stay equal to the last bit, which matrix products do not promise.
    x, y, z = part.vertices.T[:, :, None]
    vertices = x * matrix[:3, 0] + y * matrix[:3, 1] + z * matrix[:3, 2] + matrix[:3, 3]
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    return Part(vertices, part.faces[:, ::-1] if mirrored else part.faces)


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Cut polygons with any number of corners into triangles that keep every edge and the orientation.

    Convex polygons become fans around their first corner. All others lose one ear after the other, seen along the
    axis that their normal is closest to. Polygons with fewer than three corners are left out.

    Args:
        points: where the corners are, [point_count, 3].
        counts: number of corners of each polygon, [polygon_count].
        indices: points at the corners, polygon after polygon, [corner_count].

    Returns:
        The points at the corners of each triangle, int64 [triangle_count, 3].
    """
    counts, indices = np.asarray(counts, np.int64), np.asarray(indices, np.int64)
    starts = np.cumsum(counts) - counts
    triangles = [np.zeros((0, 3), np.int64)]
    for count in np.unique(counts[counts >= 3]).tolist():
        polygons = indices[starts[counts == count, None] + np.arange(count)]
        if count == 3:
            triangles.append(polygons)
            continue
        corners = points[polygons]
        arms = corners[:, 1:] - corners[:, :1]
        normals = np.cross(arms[:, :-1], arms[:, 1:]).sum(axis=1)
        edges = np.roll(corners, -1, axis=1) - corners
        turns = np.einsum("ijk,ik->ij", np.cross(edges, np.roll(edges, -1, axis=1)), normals)
        convex = (turns >= 0).all(axis=1)
        fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)
        triangles.append(polygons[convex][:, fan].reshape(-1, 3))
        for k in np.flatnonzero(~convex):
            triangles.append(polygons[k][_cut_ears(_outline(corners[k], normals[k]))])
    return np.concatenate(triangles)


def _outline(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return a polygon as seen along an axis so that it runs counterclockwise, [corner_count, 2]."""
    axis = int(np.abs(normal).argmax())
    outline = corners[:, [(axis + 1) % 3, (axis + 2) % 3]]
    return outline if normal[axis] > 0 else outline * (1, -1)


def _cut_ears(outline: np.ndarray) -> np.ndarray:
    """Return the triangles of a simple polygon that runs counterclockwise, int [corner_count - 2, 3].

    A polygon that crosses itself may have no ear; what is left of it becomes a fan.
    """
    left, triangles = list(range(len(outline))), []
    here = misses = 0
    while len(left) > 3 and misses < len(left):
        ear = [left[here - 1], left[here], left[(here + 1) % len(left)]]
        if _is_ear(outline[ear], outline[left]):
            triangles.append(ear)
            del left[here]
            misses = 0
        else:
            here += 1
            misses += 1
        here %= len(left)
    return np.array(triangles + [[left[0], *left[k : k + 2]] for k in range(1, len(left) - 1)])


def _is_ear(ear: np.ndarray, corners: np.ndarray) -> bool:
    """Tell whether a triangle [3, 2] turns left and holds no corner of the polygon, not even on its edge."""
    edges = np.roll(ear, -1, axis=0) - ear
    if edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0] <= 0:
        return False
    others = corners[(corners[:, None] != ear).any(axis=2).all(axis=1)]
    away = others[:, None] - ear
    return not (edges[:, 0] * away[..., 1] - edges[:, 1] * away[..., 0] >= 0).all(axis=1).any()
