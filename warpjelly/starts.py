"""What is seldom meant of how a scene starts: bodies in colliders or in each other, and planes through bodies."""

from __future__ import annotations

import logging
import math

import numpy as np

from .placing import BLOCK
from .scene import PlaneCollider
from .simulator import Simulator

log = logging.getLogger("warpjelly")

# A body that starts deeper than this in a collider or in another body, in unit cells, is thrown out of it.
DEEP_START = 0.05


def warn_of_deep_starts(sim: Simulator) -> None:
    """Warn of each body that starts deep in a collider, behind a plane, or in another body, before the first step."""
    measured = sim.diagnostics()
    x = sim.state.x.numpy()
    planes = [collider for collider in sim.scene.colliders if isinstance(collider, PlaneCollider)]
    for body, depth in zip(sim.model.bodies, measured["penetrations"], strict=True):
        heights = [(*_height_range(plane, x[:, body.particles]), plane) for plane in planes]
        cuts = [(-least, plane) for least, greatest, plane in heights if least < 0.0 < greatest]
        deepest, plane = max(cuts, key=lambda cut: cut[0], default=(0.0, None))
        if plane is not None and deepest > plane.threshold:
            log.warning(
                "body '%s' starts across plane '%s', %.3g m deep: what is deeper than its threshold of %.3g m stays "
                "behind it",
                *(body.name, plane.name, deepest, plane.threshold),
            )
        elif depth > DEEP_START * body.unit:
            log.warning("body '%s' starts %.3g m deep in a collider and will be thrown out of it", body.name, depth)
        for least, greatest, plane in heights:
            if least <= greatest < 0.0 < sim.scene.gravity_vector @ plane.frame()[2]:
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


def _height_range(plane: PlaneCollider, x: np.ndarray) -> tuple[float, float]:
    """Return the least and greatest height in front of a plane of those points [3, count] that are over its rectangle.

    Where none is, the least is infinity and the greatest its opposite.
    """
    frame = np.array(plane.frame())
    reach = np.array(plane.size)[:, None] / 2
    least, greatest = math.inf, -math.inf
    for start in range(0, x.shape[1], BLOCK):
        local = frame @ (x[:, start : start + BLOCK] - np.array(plane.center)[:, None])
        height = local[2, (np.abs(local[:2]) <= reach).all(axis=0)]
        least, greatest = min(least, height.min(initial=least)), max(greatest, height.max(initial=greatest))
    return float(least), float(greatest)
