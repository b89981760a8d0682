"""The shot that a run writes over: where its time and its space are, and which of its meshes can be written over."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdSkel, UsdUtils

from .errors import SceneError, reason
from .scene import ModelBody, Scene

# Transforms that squeeze space by more than this share have no inverse to speak of.
_LEAST_SQUEEZE = 1e-9


class Shot:
    """The stage of ``output.over``, never written to.

    Args:
        scene: names it.

    Raises:
        SceneError: it cannot be read, or has another axis up than the scene.
    """

    def __init__(self, scene: Scene) -> None:
        assert scene.output.over is not None
        self.path: Path = scene.output.over
        # While this lives, USD prints nothing itself; reading the meshes warns of what is missing.
        silence = UsdUtils.CoalescingDiagnosticDelegate()
        try:
            # Shots are large, and of all but the bodies nothing is needed.
            prims = [Sdf.Path(str(body.prim)) for body in scene.bodies if isinstance(body, ModelBody) and body.prim]
            mask = Usd.StagePopulationMask(
                [prim for prim in prims if prim.IsAbsolutePath() and prim.IsAbsoluteRootOrPrimPath()]
            )
            self.stage = Usd.Stage.OpenMasked(str(self.path), mask)
            # USD shares what it has read of a file within a process, even after the file was replaced.
            self.stage.Reload()
        except Tf.ErrorException as error:
            raise SceneError(f"{self.path}: not a readable USD file: {reason(error)}") from error
        finally:
            del silence
        if (up := UsdGeom.GetStageUpAxis(self.stage)) != scene.up_axis:
            raise SceneError(
                f'up_axis = "{scene.up_axis}": the shot, {self.path}, has {up} up; with output.over both must agree, '
                "so that a place is the same in both"
            )
        self._fps = scene.fps
        self.start = self.stage.GetStartTimeCode() if scene.output.start is None else scene.output.start
        """Time code of frame 0."""
        self.unit = UsdGeom.GetStageMetersPerUnit(self.stage)
        """Metres per unit."""

    def time(self, frame: float) -> float:
        """Return the time code of a frame, or of a moment between two."""
        return float(self.start + frame * self.stage.GetTimeCodesPerSecond() / self._fps)

    def frame(self, time: float) -> int:
        """Return the frame nearest to a time code."""
        return round((time - self.start) * self._fps / self.stage.GetTimeCodesPerSecond())

    def after(self, frame_count: int) -> tuple[float, float] | None:
        """Return the time codes where so many frames and where the shot end, if the shot is longer."""
        last, end = self.time(frame_count - 1), self.stage.GetEndTimeCode()
        return (last, end) if last < end else None

    def time_range(self, frame_count: int) -> tuple[float, float]:
        """Return the first and the last time code of the shot and so many frames."""
        first, last = self.start, self.time(max(frame_count - 1, 0))
        if self.stage.HasAuthoredTimeCodeRange():
            first, last = min(first, self.stage.GetStartTimeCode()), max(last, self.stage.GetEndTimeCode())
        return first, last

    def mesh(self, path: str) -> UsdGeom.Mesh:
        """Return a mesh of the shot."""
        return UsdGeom.Mesh(self.stage.GetPrimAtPath(path))

    def matrix(self, path: str, frame: float) -> np.ndarray:
        """Return what takes the points of a prim to the scene at a frame, for column vectors, [4, 4]; m."""
        world = UsdGeom.XformCache(self.time(frame)).GetLocalToWorldTransform(self.stage.GetPrimAtPath(path))
        return np.diag([self.unit] * 3 + [1.0]) @ np.array(world).T

    def moves(self, path: str) -> bool:
        """Say whether the place of a prim changes with time."""
        prim = self.stage.GetPrimAtPath(path)
        while prim and not prim.IsPseudoRoot():
            xformable = UsdGeom.Xformable(prim)
            if xformable and xformable.TransformMightBeTimeVarying():
                return True
            prim = Usd.Prim() if xformable and xformable.GetResetXformStack() else prim.GetParent()
        return False

    def require_mesh(self, path: str, body: str, frame_count: int) -> None:
        """Refuse a mesh that cannot be written over.

        Args:
            path: of its prim.
            body: name of the body that it belongs to.
            frame_count: number of frames that are to be written.

        Raises:
            SceneError: it is none of its own, deforms otherwise, or has no space of its own.
        """
        if why := self._obstacle(path, frame_count):
            raise SceneError(f"bodies.{body}.prim: {path} of {self.path} {why}")

    def _obstacle(self, path: str, frame_count: int) -> str | None:
        mesh = self.mesh(path)
        if mesh.GetPrim().IsInstanceProxy():
            return "is part of an instance, whose meshes are shared: set instanceable = false on the instance first"
        if _is_skinned(mesh.GetPrim()):
            return "is deformed by a skeleton, which would deform the result again: bake it into points first"
        for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()):
            if attribute.GetNumTimeSamples() > 1:
                return f"changes its polygons with time ({attribute.GetName()}), and a body keeps them"
        frames = range(frame_count) if self.moves(path) else range(1)
        for frame in frames:
            squeeze = np.linalg.svd(self.matrix(path, frame)[:3, :3], compute_uv=False)
            if not (math.isfinite(squeeze[0]) and squeeze[-1] > _LEAST_SQUEEZE * squeeze[0]):
                return f"is made flat by its transform at time code {self.time(frame):g}, where points have no place"
        return None


def _is_skinned(prim: Usd.Prim) -> bool:
    joints = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(UsdSkel.Tokens.primvarsSkelJointIndices)
    bound = joints or UsdSkel.BindingAPI(prim).GetBlendShapesAttr().HasAuthoredValue()
    return bool(bound and UsdSkel.Root.Find(prim))
