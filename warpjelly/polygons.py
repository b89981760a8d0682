"""What a model is read into: parts made of polygons, and how these are cut into triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from .looks import Look


@dataclass(frozen=True)
class Part:
    """Polygons of a model file, with all that they are drawn with."""

    vertices: np.ndarray
    """Positions, float64 [vertex_count, 3]."""
    counts: np.ndarray
    """Number of corners of each polygon, int64 [polygon_count]."""
    corners: np.ndarray
    """Vertex at each corner, polygon after polygon, int64 [corner_count]; counterclockwise from outside."""
    uvs: np.ndarray | None
    """Place in the textures at each corner, v upwards, float64 [corner_count, 2]; None where the file has none."""
    normals: np.ndarray | None
    """Normal at each corner, float64 [corner_count, 3]; None where the file has none."""
    looks: np.ndarray
    """Look of each polygon in the list of the model, -1 for none, int64 [polygon_count]."""
    groups: np.ndarray
    """What each polygon belongs to, in ``names``, int64 [polygon_count]."""
    names: tuple[tuple[str, ...], ...]
    """The names of each group: of objects, nodes, prims and materials."""

    def taken(self, polygons: np.ndarray) -> Part:
        """Return only the polygons where a mask, bool [polygon_count], is true."""
        corners = np.repeat(polygons, self.counts)
        return replace(
            self._with_corners(corners),
            counts=self.counts[polygons],
            looks=self.looks[polygons],
            groups=self.groups[polygons],
        )

    def turned_round(self) -> Part:
        """Return the polygons seen from behind; each still starts at its first corner."""
        starts, counts = np.repeat([np.cumsum(self.counts) - self.counts, self.counts], self.counts, axis=1)
        return self._with_corners(starts + (starts - np.arange(len(starts))) % counts)

    def _with_corners(self, chosen: np.ndarray) -> Part:
        """Return the part with other corners: a mask or a list of them."""
        uvs = None if self.uvs is None else self.uvs[chosen]
        normals = None if self.normals is None else self.normals[chosen]
        return replace(self, corners=self.corners[chosen], uvs=uvs, normals=normals)


@dataclass(frozen=True)
class MeshPrim:
    """A mesh of a USD stage as it is stored: with all its vertices, and all polygons as they run there."""

    path: str
    """Of the prim."""
    cage: Part
    """Placed; with normals only if they are drawn with."""


@dataclass(frozen=True)
class Model:
    """What a model file holds."""

    parts: list[Part]
    looks: list[Look] = field(default_factory=list)
    unit: float = 1.0
    """Metres per unit, 1 where the file does not say."""
    up_axis: str = ""
    """X, Y or Z; empty where the file does not say."""
    prims: list[MeshPrim] = field(default_factory=list)
    """Of a USD file, the mesh that each part is made from."""


def from_polygons(
    vertices: np.ndarray,
    counts: Sequence[int] | np.ndarray,
    corners: Sequence[int] | np.ndarray,
    *,
    uvs: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    looks: Sequence[int] | np.ndarray | int = -1,
    groups: Sequence[int] | np.ndarray | int = 0,
    names: Sequence[tuple[str, ...]] = ((),),
) -> Part:
    """Make a part of what its attributes are; one look or group stands for all polygons.

    Raises:
        ValueError: a corner is at a vertex that does not exist.
    """
    counts, corners = np.asarray(counts, np.int64), np.asarray(corners, np.int64)
    if len(corners) and (corners.min() < 0 or corners.max() >= len(vertices)):
        raise ValueError(f"a face has a vertex that does not exist; there are {len(vertices)}")
    return Part(
        np.asarray(vertices, float),
        counts,
        corners,
        None if uvs is None else np.asarray(uvs, float),
        None if normals is None else np.asarray(normals, float),
        np.broadcast_to(np.asarray(looks, np.int64), counts.shape),
        np.broadcast_to(np.asarray(groups, np.int64), counts.shape),
        tuple(names),
    )


def placed(part: Part, matrix: np.ndarray) -> Part:
    """Move a part by a matrix for column vectors, [4, 4]; one that mirrors it turns its polygons round."""
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    part = replace(part, vertices=moved(part.vertices, matrix))
    if part.normals is not None:
        a, b, c = matrix[:3, :3]
        # The inverse transpose times the determinant, which exists for flat ones, too.
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
        part = replace(part, normals=unit(part.normals @ cofactors.T * (-1.0 if mirrored else 1.0)))
    return part.turned_round() if mirrored else part


def moved(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Move points [count, 3] by a matrix for column vectors, [4, 4]; equal ones stay equal to the last bit."""
    # Matrix products do not promise that.
    x, y, z = points.T[:, :, None]
    result: np.ndarray = x * matrix[:3, 0] + y * matrix[:3, 1] + z * matrix[:3, 2] + matrix[:3, 3]
    return result


def joined(parts: Sequence[Part]) -> Part:
    """Make one part of several, without polygons of fewer than three corners and vertices of no polygon.

    Where only some corners have UVs, those of the others are 0. Where only some have normals, which are made as long
    as 1, the others get that of their polygon.
    """
    parts = [part.taken(part.counts >= 3) for part in parts]
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    corners = np.concatenate([part.corners + start for part, start in zip(parts, starts, strict=False)])
    first_groups = np.cumsum([0, *(len(part.names) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    used = np.zeros(len(vertices), bool)
    used[corners] = True
    whole = Part(
        vertices[used],
        np.concatenate([part.counts for part in parts]),
        (np.cumsum(used) - 1)[corners],
        _filled([part.uvs for part in parts], parts, 2),
        _filled([part.normals for part in parts], parts, 3),
        np.concatenate([part.looks for part in parts]),
        np.concatenate([part.groups + first for part, first in zip(parts, first_groups, strict=False)]),
        tuple(names for part in parts for names in part.names),
    )
    return whole if whole.normals is None else replace(whole, normals=_sound_normals(whole, whole.normals))


def _filled(arrays: Sequence[np.ndarray | None], parts: Sequence[Part], width: int) -> np.ndarray | None:
    """Concatenate what parts have at their corners, with 0 for those that have nothing and for what is no number."""
    if all(array is None for array in arrays):
        return None
    blanks = [np.zeros((len(part.corners), width)) for part in parts]
    whole = np.concatenate([blank if array is None else array for array, blank in zip(arrays, blanks, strict=True)])
    return np.where(np.isfinite(whole), whole, 0.0)


def _sound_normals(part: Part, normals: np.ndarray) -> np.ndarray:
    """Return normals of length 1, with that of the polygon where there is none."""
    normals = unit(normals)
    missing = ~normals.any(axis=1)
    if missing.any():
        planes = area_vectors(part.vertices, part.counts, part.corners)
        normals[missing] = np.repeat(unit(planes), part.counts, axis=0)[missing]
    return normals


def area_vectors(points: np.ndarray, counts: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the normals of polygons, twice as long as they are large, [polygon_count, 3].

    Args:
        points: [point_count, 3].
        counts: number of corners of each polygon, at least 3.
        corners: point at each corner, polygon after polygon, counterclockwise from outside.
    """
    if not len(counts):
        return np.zeros((0, 3))
    starts = np.cumsum(counts) - counts
    at = points[corners]
    arms = at - np.repeat(at[starts], counts, axis=0)
    turns = np.cross(arms[:-1], arms[1:])
    # What turns from the last corner of a polygon to the first one of the next is 0, whose arm is.
    return np.add.reduceat(np.concatenate([turns, np.zeros((1, 3))]), starts)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Make vectors [count, 3] as long as 1, but for those of no length."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)


def triangulate(points: np.ndarray, counts: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut polygons with any number of corners into triangles that keep every edge and the orientation.

    Convex polygons become fans around their first corner. All others lose one ear after the other, seen along the
    axis that their normal is closest to. Polygons with fewer than three corners are left out.

    Args:
        points: where the corners are, [point_count, 3].
        counts: number of corners of each polygon, [polygon_count].
        indices: points at the corners, polygon after polygon, [corner_count].

    Returns:
        The points at the corners of each triangle, int64 [triangle_count, 3], and the polygon that each is cut from,
        int64 [triangle_count].
    """
    counts, indices = np.asarray(counts, np.int64), np.asarray(indices, np.int64)
    starts = np.cumsum(counts) - counts
    triangles, sources = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for count in np.unique(counts[counts >= 3]).tolist():
        numbers = np.flatnonzero(counts == count)
        polygons = indices[starts[numbers, None] + np.arange(count)]
        if count == 3:
            triangles.append(polygons)
            sources.append(numbers)
            continue
        corners = points[polygons]
        arms = corners[:, 1:] - corners[:, :1]
        normals = np.cross(arms[:, :-1], arms[:, 1:]).sum(axis=1)
        edges = np.roll(corners, -1, axis=1) - corners
        turns = np.einsum("ijk,ik->ij", np.cross(edges, np.roll(edges, -1, axis=1)), normals)
        convex = (turns >= 0).all(axis=1)
        fan = np.stack([np.zeros(count - 2, np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)
        triangles.append(polygons[convex][:, fan].reshape(-1, 3))
        triangles += [polygons[k][_cut_ears(_outline(corners[k], normals[k]))] for k in np.flatnonzero(~convex)]
        # Each has as many triangles as it has corners, but for two.
        sources.append(np.repeat(np.concatenate([numbers[convex], numbers[~convex]]), count - 2))
    return np.concatenate(triangles), np.concatenate(sources)


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
