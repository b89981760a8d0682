"""Where a stage is looked at from: its first camera, or one that sees all that was moved."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Usd, UsdGeom

from ..stage.common import corners_of
from ..stage.prims import matrix
from ..stage.stagefiles import overridden
from ..stage.surroundings import APERTURE, FOCAL_LENGTH, camera_axes, framing


class Eye:
    """What a stage is seen through. Shots may leave out the camera, and cameras what they focus on."""

    def __init__(self, stage: Usd.Stage) -> None:
        prims = stage.Traverse()
        self._camera = next((UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)), None)
        self._stage = stage
        self._bounds: np.ndarray | None = None

    def at(self, frame: int) -> Gf.Camera:
        """Return the camera at a frame; its ``focusDistance``, positive, is as far away as what is looked at."""
        camera = self._framing() if self._camera is None else self._camera.GetCamera(frame)
        if camera.focusDistance <= 0:
            view = np.array(camera.transform)
            low, high = self._moved()
            away = float(((low + high) / 2 - view[3, :3]) @ -view[2, :3])
            camera.focusDistance = max(away, float(np.linalg.norm(high - low)) / 2, 1e-3)
        return camera

    def _framing(self) -> Gf.Camera:
        """Return a camera like that of stages of our own."""
        axes = camera_axes(UsdGeom.GetStageUpAxis(self._stage))
        position, distance, clipping = framing(axes, corners_of(self._moved()))
        camera = Gf.Camera(matrix(axes, position))
        camera.horizontalAperture, camera.verticalAperture = APERTURE
        camera.focalLength, camera.focusDistance = FOCAL_LENGTH, distance
        camera.clippingRange = Gf.Range1f(*clipping)
        return camera

    def _moved(self) -> np.ndarray:
        """Return the box [2, 3] around what a run has moved over all time; of other stages, around everything."""
        if self._bounds is None:
            root = self._stage.GetPseudoRoot()
            prims = [self._stage.GetPrimAtPath(path) for path in overridden(self._stage)] or [root]
            purposes = [UsdGeom.Tokens.default_, UsdGeom.Tokens.render]
            seen = Gf.Range3d()
            for frame in range(round(self._stage.GetStartTimeCode()), round(self._stage.GetEndTimeCode()) + 1):
                cache = UsdGeom.BBoxCache(frame, purposes, useExtentsHint=False)
                for prim in prims:
                    seen.UnionWith(cache.ComputeWorldBound(prim).ComputeAlignedRange())
            self._bounds = np.zeros((2, 3)) if seen.IsEmpty() else np.array([seen.GetMin(), seen.GetMax()])
        return self._bounds
