"""What stages of several runs need in common to be compared: a box that all move in, and one range of forces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from pxr import Usd, UsdGeom

from ..colors import COLOR_COUNT, LINEAR_TABLE, color_indices
from .prims import BODIES, COLLIDERS, WORLD, vectors

ForceRange = tuple[float, float]

# In diagonals of the motion: a ball beyond that stands for the ground.
_LARGE_BALL = 2.0


def corners_of(bounds: np.ndarray) -> np.ndarray:
    """Return the corners [8, 3] of a box from its lowest and highest one [2, 3]."""
    return np.array(list(np.ndindex(2, 2, 2))) * (bounds[1] - bounds[0]) + bounds[0]


def union(boxes: Iterable[np.ndarray]) -> np.ndarray:
    """Return the box [2, 3] around boxes [2, 3], float64."""
    whole = np.array(list(boxes), np.float64)
    return np.stack([whole[:, 0].min(axis=0), whole[:, 1].max(axis=0)])


def motion_bounds(stage: Usd.Stage) -> np.ndarray | None:
    """Return the box [2, 3] around the bodies at all frames, and around rooms, and balls not much larger than that, m.

    None where the stage has no bodies where runs have them.
    """
    boxes = []
    for prim in Usd.PrimRange(stage.GetPrimAtPath(BODIES)) if stage.GetPrimAtPath(BODIES) else ():
        if prim.IsA(UsdGeom.Boundable):
            extent = UsdGeom.Boundable(prim).GetExtentAttr()
            boxes += [np.array(extent.Get(time)) for time in extent.GetTimeSamples() or [Usd.TimeCode.Default()]]
    if not boxes:
        return None
    motion = union(boxes)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    colliders = stage.GetPrimAtPath(COLLIDERS)
    for prim in colliders.GetChildren() if colliders else ():
        found = cache.ComputeWorldBound(prim).ComputeAlignedRange()
        box = np.array([found.GetMin(), found.GetMax()])
        small = np.linalg.norm(np.ptp(box, axis=0)) <= _LARGE_BALL * np.linalg.norm(np.ptp(motion, axis=0))
        if prim.IsA(UsdGeom.BasisCurves) or (prim.IsA(UsdGeom.Sphere) and small):
            boxes.append(box)
    return union(boxes)


def force_range(stage: Usd.Stage) -> ForceRange | None:
    """Return the forces at both ends of a stage's colours, N; None where it does not say."""
    world = stage.GetPrimAtPath(WORLD)
    legend = world.GetCustomDataByKey("legend") if world else None
    return tuple(legend["range"]) if legend else None


def widest(ranges: Sequence[ForceRange]) -> ForceRange:
    """Return the range of forces that contains all of some."""
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def color_by(root: Usd.Prim, own: ForceRange, shared: ForceRange, frames: Sequence[int] = ()) -> None:
    """Let the colours below a prim show forces by another range, in the layer that is edited.

    What is above a run's own range, which its colours cut off there, stays cut off.

    Args:
        root: of the prims.
        own: forces at both ends of the colours so far, N.
        shared: what they are to be, N.
        frames: where colours are stored for each frame, and not as indices into a table, those at which they are
            changed.
    """
    forces = own[0] + (own[1] - own[0]) * np.arange(COLOR_COUNT) / (COLOR_COUNT - 1)
    table = LINEAR_TABLE[color_indices(forces, shared)]
    for prim in Usd.PrimRange(root):
        if not prim.IsA(UsdGeom.PointBased):
            continue
        color = UsdGeom.Gprim(prim).GetDisplayColorPrimvar()
        if color.GetInterpolation() != UsdGeom.Tokens.vertex:
            continue
        if color.IsIndexed():
            color.Set(vectors(table))
            continue
        # Green rises all along the colour map. The first sample that is set hides those of weaker layers.
        for frame, green in {frame: np.array(color.Get(frame))[:, 1] for frame in frames}.items():
            entries = np.rint(np.interp(green, LINEAR_TABLE[:, 1], np.arange(COLOR_COUNT))).astype(int)
            color.Set(vectors(table[entries]), frame)
