"""How the polygons of a model are shaded, so that hard edges stay hard and smooth ones smooth when it moves."""

from __future__ import annotations

import numpy as np

from .polygons import Part, area_vectors, unit

# Faces that meet at a smaller angle than this, degrees, are one smooth surface, where a model has no normals.
CREASE_ANGLE = 40.0
# Normals of a model that differ by less than this, of unit length, are one.
NORMAL_STEP = 1e-4


def shared_normals(part: Part) -> np.ndarray:
    """Say which corners of polygons share a normal, by number, int32 [corner_count].

    Corners in one place do where the model has the same normal for them; where it has none, if no crease is between
    them.
    """
    # Formats that repeat vertices, for seams of textures, repeat them exactly.
    _, places = np.unique(part.vertices, axis=0, return_inverse=True)
    place = places.reshape(-1)[part.corners]
    if part.normals is not None:
        keys = np.column_stack([place, np.rint(part.normals / NORMAL_STEP).astype(np.int64)])
        return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int32)
    following = _following(part)
    edges = np.sort(np.stack([place, place[following]], axis=1), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    first, second = order[:-1][same], order[1:][same]
    face = np.repeat(np.arange(len(part.counts)), part.counts)
    outward = unit(area_vectors(part.vertices, part.counts, part.corners))
    flat = np.einsum("ij,ij->i", outward[face[first]], outward[face[second]]) > np.cos(np.radians(CREASE_ANGLE))
    # Neighbours pass along their edge in opposite directions.
    joined = flat & (place[first] == place[following[second]]) & (place[first] != place[second])
    first, second = first[joined], second[joined]
    one = np.concatenate([first, following[first]])
    other = np.concatenate([following[second], second])
    return components(len(place), one, other)


def _following(part: Part) -> np.ndarray:
    """Return the next corner of each corner's polygon, int [corner_count]."""
    following = np.arange(len(part.corners)) + 1
    ends = np.cumsum(part.counts)
    following[ends - 1] = ends - part.counts
    return following


def components(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Number the parts of a graph of nodes and edges (one, other), int32 [count]."""
    label = np.arange(count)
    while True:
        least = np.minimum(label[one], label[other])
        if (least == label[one]).all() and (least == label[other]).all():
            return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int32)
        np.minimum.at(label, one, least)
        np.minimum.at(label, other, least)
        label = label[label]
