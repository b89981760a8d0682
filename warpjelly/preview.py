"""Look at a stage without a USD viewer: its frames through its own camera as one PNG."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pxr import Usd, UsdGeom

from .colors import SRGB_TABLE, srgb_from_linear
from .errors import EnvironmentFailedError, InputError
from .files import whole_file
from .solids import Drawn, draw_stage, shapes_in
from .stagefiles import open_stage
from .validate import stage_problems

if TYPE_CHECKING:
    import pyvista as pv

MIN_SIZE, MAX_SIZE = 16, 8192
MAX_PIXELS = 100_000_000

_BACKGROUND = (0.93, 0.935, 0.95)
_FLOOR = (0.80, 0.81, 0.84)
_INK = (70, 74, 84)
_GAP = 4
# Directions towards the lights in the axes (right, up, backward) of the camera, and how strong they are.
_KEY, _KEY_STRENGTH = np.array([-0.45, 0.8, 0.45]), 0.7
_FILL, _FILL_STRENGTH = np.array([0.5, 0.1, 1.0]), 0.4
_RIM, _RIM_STRENGTH = np.array([0.5, 0.6, -0.8]), 0.35
# Jelly lets light through where it is thin, which is where one looks along its surface.
_LIGHT_STEP = "//VTK::Light::Impl"
_GLOW = f"{_LIGHT_STEP}\n  fragOutput0.rgb += 0.4 * pow(1.0 - abs(normalVCVSOutput.z), 2.0) * diffuseColor;\n"
# The floor is drawn as far as this from where the camera looks, in distances of the camera.
_FLOOR_REACH = 1.4
_FLOOR_PIXELS = 1536
_SHADOW_SOFTNESS = 0.012


def render_preview(
    source: Path, output: Path, *, frames: Sequence[int] | None = None, size: tuple[int, int] = (960, 540)
) -> None:
    """Render frames of a stage side by side into one PNG.

    Args:
        source: a stage file or a run directory.
        output: the PNG to make; it appears under its name only when it is complete.
        frames: numbers of the frames to show; None shows the one with the greatest forces, which is the moment of the
            hardest impact.
        size: width and height of each frame, pixels.

    Raises:
        InputError: the stage, the output name, a frame number or the size is wrong, or pyvista is not installed.
        EnvironmentFailedError: there is no offscreen OpenGL, or the file cannot be written.
    """
    if output.suffix.lower() != ".png":
        raise InputError(f"{output}: a preview is a PNG; choose a name that ends in .png")
    stage = open_stage(source)
    # Damage that only shows when values are read would otherwise come as whatever trips over it.
    if problems := stage_problems(source):
        raise InputError(f"{source}: the stage is not sound, so it cannot be shown: {problems[0]}")
    shown = _chosen_frames(stage, source, frames)
    if not all(MIN_SIZE <= side <= MAX_SIZE for side in size):
        raise InputError(f"size {size[0]}x{size[1]}: each side must be {MIN_SIZE} to {MAX_SIZE} pixels")
    if len(shown) * size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{len(shown)} frames of {size[0]}x{size[1]}: more than {MAX_PIXELS:,} pixels")
    pyvista = require_pyvista()
    panels, legend = [], False
    for frame in shown:
        drawn = draw_stage(pyvista, stage, frame)
        panels.append(_render(pyvista, stage, drawn, frame, size))
        legend = any(solid.shows_force for solid in drawn.solids)
    _save(_laid_out(stage, shown, panels, with_legend=legend), output)


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


def _chosen_frames(stage: Usd.Stage, source: Path, frames: Sequence[int] | None) -> list[int]:
    first, last = round(stage.GetStartTimeCode()), round(stage.GetEndTimeCode())
    if frames is None:
        return [_brightest_frame(stage, first, last)]
    for frame in frames:
        if not first <= frame <= last:
            raise InputError(f"{source}: no frame {frame}; frames are {first} to {last}")
    if not frames:
        raise InputError("no frame to show")
    return list(frames)


def _brightest_frame(stage: Usd.Stage, first: int, last: int) -> int:
    """Return the frame with the brightest bodies: along the colour map, that is the one with the greatest forces."""
    brightness = np.zeros(last - first + 1)
    for mesh in shapes_in(stage, UsdGeom.PointBased):
        primvar = UsdGeom.Primvar(mesh.GetDisplayColorAttr())
        if primvar.ValueMightBeTimeVarying():
            brightness += [np.sum(np.array(primvar.ComputeFlattened(t))[:, 1]) for t in range(first, last + 1)]
    return first + int(np.argmax(brightness))


def _render(pyvista: Any, stage: Usd.Stage, drawn: Drawn, frame: int, size: tuple[int, int]) -> np.ndarray:
    """Return the picture of one frame, uint8 [height, width, 3]."""
    solids, rooms = drawn.solids, drawn.rooms
    if not solids:
        raise InputError("the stage has nothing to show")

    plotter = pyvista.Plotter(off_screen=True, window_size=size, lighting="none")
    try:
        plotter.set_background(_BACKGROUND)
        axes = _aim(plotter, stage, frame, size)
        for direction, strength in ((_KEY, _KEY_STRENGTH), (_FILL, _FILL_STRENGTH), (_RIM, _RIM_STRENGTH)):
            light = pyvista.Light(light_type="scene light", intensity=strength)
            light.position, light.focal_point, light.positional = direction @ axes, (0, 0, 0), False
            plotter.add_light(light)
        for solid in solids:
            colors = {"scalars": "color", "rgb": True} if solid.texture is None else {"texture": solid.texture}
            actor = plotter.add_mesh(
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
        for room in rooms:
            plotter.add_mesh(room, color=(0.6, 0.62, 0.66), line_width=2, lighting=False)
        for floor in drawn.floors or [_room_floor(pyvista, stage, room) for room in rooms]:
            _add_floor(pyvista, plotter, floor, [solid.surface for solid in solids], _KEY / np.linalg.norm(_KEY) @ axes)
        plotter.enable_anti_aliasing("ssaa")
        return np.array(plotter.screenshot(return_img=True))
    finally:
        plotter.close()


def _aim(plotter: Any, stage: Usd.Stage, frame: int, size: tuple[int, int]) -> np.ndarray:
    """Look through the stage's camera; return its axes (right, up, backward) [3, 3]."""
    camera = next(shapes_in(stage, UsdGeom.Camera), None)
    if camera is None:
        raise InputError("the stage has no camera")
    view = camera.GetCamera(frame)
    matrix = np.array(view.transform)
    axes, position = matrix[:3, :3], matrix[3, :3]
    half_width, half_height = (
        aperture / (2 * view.focalLength) for aperture in (view.horizontalAperture, view.verticalAperture)
    )
    plotter.camera.position = position
    plotter.camera.focal_point = position - axes[2] * max(view.focusDistance, 1e-3)
    plotter.camera.up = axes[1]
    # In a picture of another shape, all that the camera sees stays visible.
    plotter.camera.view_angle = 2 * np.degrees(np.arctan(max(half_height, half_width * size[1] / size[0])))
    plotter.camera.clipping_range = (view.clippingRange.min, view.clippingRange.max)
    return axes


def _room_floor(pyvista: Any, stage: Usd.Stage, room: pv.PolyData) -> pv.PolyData:
    """Return the rectangle at the bottom of a room that is drawn as its edges."""
    up = 2 if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else 1
    low, high = np.array(room.bounds).reshape(3, 2).T
    side, other = np.eye(3)[(up + 1) % 3] * (high - low), np.eye(3)[(up + 2) % 3] * (high - low)
    return pyvista.PolyData(np.array([low, low + side, low + side + other, low + other]), faces=[4, 0, 1, 2, 3])


def _add_floor(pyvista: Any, plotter: Any, floor: pv.PolyData, solids: list[pv.PolyData], to_light: np.ndarray) -> None:
    """Draw the part of a rectangle around the solids, if it is seen from its front."""
    corners = np.asarray(floor.points, dtype=np.float64)
    sides = corners[[1, 3]] - corners[0]
    plane = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    normal = np.cross(*plane)
    if (np.array(plotter.camera.position) - corners[0]) @ normal <= 0:
        return
    # From here on, positions on the floor are (along the first side, along the second), m.
    distance, middle = plotter.camera.distance, plane @ np.array(plotter.camera.focal_point)
    reach, softness = _FLOOR_REACH * distance, _SHADOW_SOFTNESS * distance
    start = np.maximum(plane @ corners[0], middle - reach)
    end = np.minimum(plane @ corners[2], middle + reach)
    if (start >= end).any():
        return
    pixel = float(np.max(end - start)) / _FLOOR_PIXELS
    width, height = np.maximum(np.ceil((end - start) / pixel), 2).astype(int)

    points = np.concatenate([_sampled(solid, pixel) for solid in solids])
    above = (points - corners[0]) @ normal
    steepness = float(to_light @ normal)
    light = np.ones((height, width), dtype=np.float32)
    # The light's shadow tells the height, the dark line of contact that there is none left.
    if steepness > 0.05:
        cast = (points - to_light * (above / steepness)[:, None])[above > 0] @ plane.T
        light -= 0.28 * _coverage(cast, start, pixel, light.shape, softness)
    touching = points[np.abs(above) < 2 * softness] @ plane.T
    light *= 1 - 0.45 * _coverage(touching, start, pixel, light.shape, softness)

    x, y = (start[i] + (np.arange(n) + 0.5) * pixel for i, n in enumerate((width, height)))
    step = _grid_step(distance)
    lines = [np.clip(1.5 - np.abs(at - np.round(at / step) * step) / pixel, 0, 1) for at in (x, y)]
    light *= 1 - 0.1 * np.maximum(lines[0][None], lines[1][:, None])
    away = np.hypot(x[None] - middle[0], y[:, None] - middle[1]) / reach
    fade = np.clip((away - 0.35) / 0.6, 0, 1)[..., None]
    fade = fade * fade * (3 - 2 * fade)
    tone = np.array(_FLOOR) * (0.72 + 0.35 * max(steepness, 0))
    colors = np.rint(np.clip(light[..., None] * tone * (1 - fade) + np.array(_BACKGROUND) * fade, 0, 1) * 255)

    at = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    drawn = corners[0] + (start + at * (end - start) - plane @ corners[0]) @ plane
    rectangle = pyvista.PolyData(drawn, faces=[4, 0, 1, 2, 3])
    rectangle.active_texture_coordinates = at.astype(np.float32)
    # A picture starts at its upper left, a texture at its lower left.
    texture = pyvista.numpy_to_texture(np.ascontiguousarray(colors.astype(np.uint8)[::-1]))
    texture.mipmap = texture.interpolate = True
    plotter.add_mesh(rectangle, texture=texture, lighting=False)


def _coverage(
    points: np.ndarray, start: np.ndarray, pixel: float, shape: tuple[int, int], softness: float
) -> np.ndarray:
    """Return how much of each pixel of a floor points [n, 2] cover, float32 ``shape``, blurred by ``softness``, m."""
    from PIL import Image, ImageFilter

    at = np.floor((points - start) / pixel).astype(int)
    column, row = at[((at >= 0) & (at < shape[::-1])).all(axis=1)].T
    covered = np.zeros(shape, dtype=np.uint8)
    covered[row, column] = 255
    return np.asarray(Image.fromarray(covered).filter(ImageFilter.GaussianBlur(softness / pixel)), np.float32) / 255


def _sampled(solid: pv.PolyData, spacing: float) -> np.ndarray:
    """Return points [n, 3] all over a surface, about as dense as the spacing."""
    triangles = solid.triangulate()
    corners = np.asarray(triangles.points)[triangles.regular_faces]
    longest = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    count = int(np.clip(np.ceil(longest / spacing), 1, 64))
    u, v = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T / count
    return np.einsum("kc,tcd->tkd", np.stack([1 - u - v, u, v], axis=1), corners).reshape(-1, 3)


def _grid_step(distance: float) -> float:
    """Return the spacing of the floor's lines, m: a round number near a tenth of the camera's distance."""
    power = 10 ** np.floor(np.log10(distance / 10))
    return float(power * min((1, 2, 5, 10), key=lambda digit: abs(np.log(distance / 10 / power / digit))))


def _laid_out(stage: Usd.Stage, frames: list[int], panels: list[np.ndarray], *, with_legend: bool) -> Any:
    """Return the panels side by side with the time below each and the legend beside the last."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = panels[0].shape[:2]
    picture = Image.new("RGB", (len(panels) * (width + _GAP) - _GAP, height), "white")
    draw = ImageDraw.Draw(picture)
    text = max(10, round(height / 34))
    font = ImageFont.load_default(text)
    for i, (frame, panel) in enumerate(zip(frames, panels, strict=True)):
        left = i * (width + _GAP)
        picture.paste(Image.fromarray(panel), (left, 0))
        label = f"{frame / stage.GetTimeCodesPerSecond():.3f} s   frame {frame}"
        draw.text((left + text, height - text), label, fill=_INK, font=font, anchor="ls")

    legend = stage.GetDefaultPrim().GetCustomDataByKey("legend") if stage.GetDefaultPrim() else None
    if legend and height >= 120:
        if with_legend:
            _draw_force_legend(picture, draw, font, legend, width)
        _draw_spring_legend(picture, draw, font, legend.get("springs", {}))
    return picture


def _draw_force_legend(picture: Any, draw: Any, font: Any, legend: Mapping[str, Any], width: int) -> None:
    """Draw the colour map of forces into the lower right corner; a frame is ``width`` pixels wide."""
    from PIL import Image

    text, height = font.size, picture.height
    low, high = (f"{force:.2g}" for force in legend["range"])
    caption = f"{legend['quantity']}, {legend['unit']}"
    # The bar is as wide as its captions need, a line's height between them; the middle one is centred.
    needed = font.getlength(caption) + 2 * max(font.getlength(low), font.getlength(high)) + 2 * text
    bar = Image.fromarray(np.rint(SRGB_TABLE[None] * 255).astype(np.uint8))
    bar = bar.resize((max(width // 5, round(needed)), max(text // 2, 4)))
    left, top = picture.width - bar.width - text, height - 2 * text - bar.height - 2
    picture.paste(bar, (left, top))
    for x, label, anchor in (
        (left, low, "ls"),
        (left + bar.width / 2, caption, "ms"),
        (left + bar.width, high, "rs"),
    ):
        draw.text((x, height - text), label, fill=_INK, font=font, anchor=anchor)


def _draw_spring_legend(picture: Any, draw: Any, font: Any, colors: Mapping[str, Any]) -> None:
    """Name the kinds of springs in their colours, linear, in the upper right corner."""
    text, right = font.size, picture.width - font.size
    for name, color in reversed(list(colors.items())):
        draw.text((right, 2 * text), name, fill=_INK, font=font, anchor="rs")
        right -= round(font.getlength(name)) + text // 2
        shown = np.rint(srgb_from_linear(np.array(color)) * 255).astype(int)
        draw.rectangle([right - text // 2, 2 * text - text // 2, right, 2 * text], fill=tuple(shown.tolist()))
        right -= 3 * text // 2


def _save(picture: Any, output: Path) -> None:
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as unfinished:
            picture.save(unfinished, format="PNG")
    except OSError as error:
        raise EnvironmentFailedError(f"{output}: cannot write the preview: {error.strerror or error}") from error
