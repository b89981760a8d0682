"""What is seldom meant of how a scene starts: bodies in colliders or in each other, and planes through bodies."""

from __future__ import annotations

import logging

import numpy as np

from .scene import PlaneCollider
from .simulator import Simulator

log = logging.getLogger("warpjelly")

# A body that starts deeper than this in a collider or in another body, in unit cells, is thrown out of it.
DEEP_START = 0.05


def warn_of_deep_starts(sim: Simulator) -> None:
    """Warn of each body that starts deep in a collider, behind a plane, or in another body, before the first step."""
    measured = sim.diagnostics()
    positions = sim.positions
    planes = [collider for collider in sim.scene.colliders if isinstance(collider, PlaneCollider)]
    for body, depth in zip(sim.model.bodies, measured["penetrations"], strict=True):
        cuts = [(_cut_depth(plane, positions[body.particles]), plane) for plane in planes]
        deepest, plane = max(cuts, key=lambda cut: cut[0], default=(0.0, None))
        if plane is not None and deepest > plane.threshold:
            log.warning(
                "body '%s' starts across plane '%s', %.3g m deep: what is deeper than its threshold of %.3g m stays "
                "behind it",
                *(body.name, plane.name, deepest, plane.threshold),
            )
        elif depth > DEEP_START * body.unit:
            log.warning("body '%s' starts %.3g m deep in a collider and will be thrown out of it", body.name, depth)
        for plane in planes:
            if _falls_off_the_back(plane, positions[body.particles], sim.scene.gravity_vector):
                log.warning(
                    "body '%s' starts behind plane '%s', which stops only what comes from the side of its normal: "
                    "turn the normal round to catch the body",
                    *(body.name, plane.name),
                )
    overlapping = [
        (body.name, overlap)
        for body, overlap in zip(sim.model.bodies, measured["overlaps"], strict=True)
        if overlap > DEEP_START * body.unit
    ]
    if overlapping:
        log.warning(
            "bodies %s start too close together: the balls around their particles overlap by up to %.3g m and are "
            "pushed apart, or stuck where one body is inside the other; move them, or lower soft_contact.radius",
            *(", ".join(f"'{name}'" for name, _ in overlapping), max(overlap for _, overlap in overlapping)),
        )


def _heights(plane: PlaneCollider, points: np.ndarray) -> np.ndarray:
    """Return the heights in front of a plane of those points [count, 3] that are over its rectangle, m."""
    tangent, bitangent, normal = plane.frame()
    local = points - np.array(plane.center)
    a, b = plane.size
    return local[(np.abs(local @ tangent) <= a / 2) & (np.abs(local @ bitangent) <= b / 2)] @ normal


def _cut_depth(plane: PlaneCollider, points: np.ndarray) -> float:
    """Return how far points [count, 3] reach behind the rectangle of a plane [m]; 0 if none is in front of it too."""
    height = _heights(plane, points)
    return float(-height.min()) if len(height) and height.min() < 0.0 < height.max() else 0.0


def _falls_off_the_back(plane: PlaneCollider, points: np.ndarray, gravity: np.ndarray) -> bool:
    """Say whether points [count, 3] are behind the rectangle of a plane, and gravity [3] pulls them towards it."""
    _, _, normal = plane.frame()
    height = _heights(plane, points)
    return len(height) > 0 and height.max() < 0.0 and float(gravity @ normal) > 0.0
