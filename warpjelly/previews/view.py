"""A stage through its own camera, rendered by VTK one frame after the other."""

from __future__ import annotations

import importlib
import os
import sys
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pxr import Usd

from ..errors import EnvironmentFailedError, InputError
from .eye import Eye
from .floors import BACKGROUND, Floor
from .solids import Drawn, Solid, StageDrawing, room_floor

if TYPE_CHECKING:
    import pyvista as pv

# Directions towards the lights in the axes (right, up, backward) of the camera, and how strong they are.
_KEY = np.array([-0.45, 0.8, 0.45])
_LIGHTS = ((_KEY, 0.7), (np.array([0.5, 0.1, 1.0]), 0.4), (np.array([0.5, 0.6, -0.8]), 0.35))
# Points of a solid that throw shadows, at most about.
_MAX_SAMPLES = 1_000_000
# Jelly lets light through where it is thin, which is where one looks along its surface.
_LIGHT_STEP = "//VTK::Light::Impl"
_GLOW = f"{_LIGHT_STEP}\n  fragOutput0.rgb += 0.4 * pow(1.0 - abs(normalVCVSOutput.z), 2.0) * diffuseColor;\n"


def require_pyvista() -> Any:
    """Import pyvista and make sure that it can render, since VTK crashes the process where it cannot."""
    if sys.platform == "linux":
        # Otherwise VTK first tries to reach an X server.
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    try:
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
        from vtkmodules.vtkRenderingCore import vtkRenderWindow

        # This registers the window classes among which VTK chooses.
        importlib.import_module("vtkmodules.vtkRenderingOpenGL2")
    except ImportError as error:
        raise InputError("previews need pyvista: pip install 'warpjelly[preview]'") from error
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    window = vtkRenderWindow().GetClassName()
    vtkLogger.SetStderrVerbosity(verbosity)
    # This is what VTK falls back on when neither EGL nor an X server answers.
    if window == "vtkOSOpenGLRenderWindow":
        raise EnvironmentFailedError("no offscreen OpenGL: apt install libegl1 libgl1-mesa-dri")
    return pyvista


class View:
    """Renders frames of a stage. What does not change from frame to frame is made once; use it in a ``with`` block."""

    def __init__(self, size: tuple[int, int]) -> None:
        """Open a window; ``look_at`` a stage then.

        Args:
            size: width and height, pixels.

        Raises:
            InputError: pyvista is not installed.
            EnvironmentFailedError: there is no offscreen OpenGL.
        """
        self._pyvista, self._size = require_pyvista(), size
        self._plotter = self._pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
        self._plotter.set_background(BACKGROUND)
        self._lights = [self._pyvista.Light(light_type="scene light", intensity=strength) for _, strength in _LIGHTS]
        for light in self._lights:
            light.positional = False
            self._plotter.add_light(light)
        self._plotter.enable_anti_aliasing("ssaa")

    def look_at(self, stage: Usd.Stage) -> None:
        """Render this stage from now on."""
        self._stage, self._eye = stage, Eye(stage)
        self._drawing = StageDrawing(self._pyvista, stage)
        self._plotter.clear_actors()
        self._actors: list[Any] = []
        self._floors: list[Floor] = []
        # Where the floors are and what from they are seen.
        self._floors_for = b""
        self.shows_force = False

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free the window."""
        self._plotter.close()

    def render(self, frame: int) -> np.ndarray:
        """Return the picture of a frame, uint8 [height, width, 3]."""
        drawn = self._drawing.at(frame)
        if not drawn.solids:
            raise InputError("the stage has nothing to show")
        axes = self._aim(frame)
        for light, (direction, _) in zip(self._lights, _LIGHTS, strict=True):
            light.position, light.focal_point = direction @ axes, (0, 0, 0)
        if self._actors:
            for actor, solid in zip(self._actors, drawn.solids, strict=True):
                actor.mapper.dataset = solid.surface
        else:
            self._actors = [self._added(solid) for solid in drawn.solids]
            for room in drawn.rooms:
                self._plotter.add_mesh(room, color=(0.6, 0.62, 0.66), line_width=2, lighting=False)
        self._lay_floors(drawn, _KEY / np.linalg.norm(_KEY) @ axes)
        self.shows_force = any(solid.shows_force for solid in drawn.solids)
        self._plotter.render()
        return np.array(self._plotter.screenshot(return_img=True))

    def _added(self, solid: Solid) -> Any:
        colors = {"scalars": "color", "rgb": True} if solid.texture is None else {"texture": solid.texture}
        actor = self._plotter.add_mesh(
            solid.surface,
            **colors,
            smooth_shading=True,
            split_sharp_edges=False,
            ambient=0.6,
            diffuse=0.55,
            specular=0.4,
            specular_power=30,
        )
        actor.GetShaderProperty().AddFragmentShaderReplacement(_LIGHT_STEP, True, _GLOW, False)
        return actor

    def _aim(self, frame: int) -> np.ndarray:
        """Look through the camera; return its axes (right, up, backward) [3, 3]."""
        view, camera = self._eye.at(frame), self._plotter.camera
        matrix = np.array(view.transform)
        axes, position = matrix[:3, :3], matrix[3, :3]
        half_width, half_height = (
            aperture / (2 * view.focalLength) for aperture in (view.horizontalAperture, view.verticalAperture)
        )
        camera.position = position
        camera.focal_point = position - axes[2] * view.focusDistance
        camera.up = axes[1]
        # In a picture of another shape, all that the camera sees stays visible.
        width, height = self._size
        camera.view_angle = 2 * np.degrees(np.arctan(max(half_height, half_width * height / width)))
        camera.clipping_range = (view.clippingRange.min, view.clippingRange.max)
        return axes

    def _lay_floors(self, drawn: Drawn, to_light: np.ndarray) -> None:
        """Draw the floors with the shadows of the solids; they are only made anew where they or the camera move."""
        camera = self._plotter.camera
        corners = [np.asarray(floor.points, np.float64) for floor in drawn.floors]
        if not corners:
            corners = [room_floor(self._stage, np.asarray(room.points, np.float64)) for room in drawn.rooms]
        seen_from = np.array([camera.position, camera.focal_point])
        if (made_for := np.concatenate([*corners, seen_from]).tobytes()) != self._floors_for:
            self._floors_for = made_for
            for number in range(len(self._floors)):
                self._plotter.remove_actor(f"floor {number}")
            made = [Floor(self._pyvista, each, camera, to_light, self._size[1]) for each in corners]
            self._floors = [floor for floor in made if floor.seen]
            for number, floor in enumerate(self._floors):
                self._plotter.add_mesh(
                    floor.rectangle, texture=floor.texture, lighting=False, name=f"floor {number}", reset_camera=False
                )
        # Floors of several runs side by side have pixels of one size.
        for pixel in {floor.shadow_pixel for floor in self._floors}:
            throwing = np.concatenate([_sampled(solid.surface, pixel) for solid in drawn.solids])
            for floor in self._floors:
                if floor.shadow_pixel == pixel:
                    floor.shade(throwing)


def _sampled(solid: pv.PolyData, spacing: float) -> np.ndarray:
    """Return points [n, 3] all over a surface, about as dense as the spacing."""
    triangles = solid.triangulate()
    corners = np.asarray(triangles.points)[triangles.regular_faces]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    # Each triangle gets about half the square of this count; the tubes of springs have very many.
    most = min(64.0, np.sqrt(2 * _MAX_SAMPLES / len(corners)))
    count = int(np.clip(np.ceil(longest / spacing), 1, max(most, 1)))
    u, v = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T / count
    return np.einsum("kc,tcd->tkd", np.stack([1 - u - v, u, v], axis=1), corners).reshape(-1, 3)
