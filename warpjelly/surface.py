"""What a frame shows of a body, on its way from the simulator to the stage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SurfaceMesh:
    """What stays the same over a run."""

    body: str
    """Name of the body."""
    points: np.ndarray
    """Rest positions, float32 [point_count, 3], m."""
    normals: np.ndarray
    """Rest normals, float32 [point_count, 3], unit length."""
    quads: np.ndarray
    """Corners of each face, counter-clockwise from outside, int32 [face_count, 4]. A body without faces shows its
    springs: the points are the two ends of each, one after another."""
    double_sided: bool = False
    """Whether the faces are seen from both sides."""


@dataclass(frozen=True)
class SurfaceFrame:
    """One sample."""

    points: np.ndarray
    """float32 [point_count, 3], m."""
    normals: np.ndarray
    """float32 [point_count, 3], unit length."""
    velocities: np.ndarray
    """float32 [point_count, 3], m/s."""
    forces: np.ndarray
    """Magnitude of the total force on each particle, float32 [point_count], N."""
