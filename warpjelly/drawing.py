"""A model as it is to be seen: its own polygons, and how they are shaded."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Faces that meet at a smaller angle than this, degrees, are one smooth surface, where a model has no normals.
CREASE_ANGLE = 40.0
# Normals of a model that differ by less than this, of unit length, are one.
NORMAL_STEP = 1e-4


@dataclass(frozen=True)
class Drawing:
    """Polygons in the frame of the body."""

    vertices: np.ndarray
    """Positions, float64 [vertex_count, 3], m."""
    counts: np.ndarray
    """Corners of each polygon, int [polygon_count]."""
    corners: np.ndarray
    """Vertex at each corner, counter-clockwise from outside, int [corner_count]."""
    normals: np.ndarray | None = None
    """The model's own normals at the corners, float [corner_count, 3]."""

    def shading(self) -> np.ndarray:
        """Say which corners share a normal, by number, int32 [corner_count].

        Corners in one place do where the model has the same normal for them; where it has none, if no crease is
        between them. So edges stay as hard or smooth as they are when the normals follow a motion.
        """
        # Formats that repeat vertices, for seams of textures, repeat them exactly.
        _, places = np.unique(self.vertices, axis=0, return_inverse=True)
        place = places.reshape(-1)[self.corners]
        if self.normals is not None:
            kept = np.rint(self.normals / NORMAL_STEP).astype(np.int64)
            keys = np.column_stack([place, kept])
            return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
        following = self._following()
        edges = np.sort(np.stack([place, place[following]], axis=1), axis=1)
        order = np.lexsort(edges.T)
        same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
        first, second = order[:-1][same], order[1:][same]
        face = np.repeat(np.arange(len(self.counts)), self.counts)
        outward = self._outward()
        flat = np.einsum("ij,ij->i", outward[face[first]], outward[face[second]]) > np.cos(np.radians(CREASE_ANGLE))
        # Neighbours pass along their edge in opposite directions.
        joined = flat & (place[first] == place[following[second]]) & (place[first] != place[second])
        first, second = first[joined], second[joined]
        one = np.concatenate([first, following[first]])
        other = np.concatenate([following[second], second])
        return _components(len(place), one, other)

    def _following(self) -> np.ndarray:
        """Return the next corner of each corner's polygon, int [corner_count]."""
        following = np.arange(len(self.corners)) + 1
        ends = np.cumsum(self.counts)
        following[ends - 1] = ends - self.counts
        return following

    def _outward(self) -> np.ndarray:
        """Return the normal of each polygon, float64 [polygon_count, 3], of unit length or zero."""
        starts = np.cumsum(self.counts) - self.counts
        at = self.vertices[self.corners] - np.repeat(self.vertices[self.corners[starts]], self.counts, axis=0)
        areas = np.add.reduceat(np.cross(at, at[self._following()]), starts, axis=0)
        lengths = np.linalg.norm(areas, axis=1, keepdims=True)
        return np.divide(areas, lengths, out=np.zeros_like(areas), where=lengths > 0)


def _components(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Number the parts of a graph of nodes and edges (one, other), int32 [count]."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[one], label[other])
        if (least == label[one]).all() and (least == label[other]).all():
            return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int32)
        np.minimum.at(label, one, least)
        np.minimum.at(label, other, least)
        label = label[label]
