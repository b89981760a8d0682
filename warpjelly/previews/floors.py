"""Floors as pictures: a grid of lines, the shadows of what is above, and a far end that fades into the background."""

from __future__ import annotations

from typing import Any

import numpy as np

BACKGROUND = (0.93, 0.935, 0.95)

_FLOOR = (0.80, 0.81, 0.84)
# The floor is drawn as far as this from where the camera looks, in distances of the camera.
_REACH = 1.4
_PIXELS = 1536
# No pixel of a floor is smaller than so many of the picture's, where the camera looks.
_FINENESS = 1.5
_SHADOW_SOFTNESS = 0.012
# How much the light's shadow takes away, and the dark line of contact.
_SHADOW, _CONTACT = 0.28, 0.45
# A shadow ends this far from its edge, in softnesses; it is blurred in pixels so many times as wide as the floor's.
_SHADOW_END = 3
_COARSENESS = 3


class Floor:
    """The part of a rectangle around what the camera looks at."""

    def __init__(self, pyvista: Any, corners: np.ndarray, camera: Any, to_light: np.ndarray, height: int) -> None:
        """Lay out a floor.

        Args:
            pyvista: the module.
            corners: of the rectangle, in turn around its front, float64 [4, 3], m.
            camera: pyvista's.
            to_light: unit vector [3].
            height: of the picture, pixels.
        """
        sides = corners[[1, 3]] - corners[0]
        self._corner, self._to_light = corners[0], to_light
        self._plane = sides / np.linalg.norm(sides, axis=1, keepdims=True)
        self._normal = np.cross(*self._plane)
        # From here on, positions on the floor are (along the first side, along the second), m.
        middle, reach = self._plane @ np.array(camera.focal_point), _REACH * camera.distance
        self._softness = _SHADOW_SOFTNESS * camera.distance
        start = np.maximum(self._plane @ corners[0], middle - reach)
        end = np.minimum(self._plane @ corners[2], middle + reach)
        self.seen = bool((np.array(camera.position) - corners[0]) @ self._normal > 0 and (start < end).all())
        if not self.seen:
            return
        shown = float(2 * camera.distance * np.tan(np.radians(camera.view_angle / 2)))
        pixel = max(float(np.max(end - start)) / _PIXELS, _FINENESS * shown / height)
        self.shadow_pixel = _COARSENESS * pixel
        columns, rows = np.maximum(np.ceil((end - start) / pixel), 2).astype(int).tolist()
        self._start = start

        x, y = (start[i] + (np.arange(n) + 0.5) * pixel for i, n in enumerate((columns, rows)))
        step = _grid_step(camera.distance)
        lines = [np.clip(1.5 - np.abs(at - np.round(at / step) * step) / pixel, 0, 1) for at in (x, y)]
        fade = np.clip((np.hypot(x[None] - middle[0], y[:, None] - middle[1]) / reach - 0.35) / 0.6, 0, 1)
        self._fade = (fade * fade * (3 - 2 * fade)).astype(np.float32)
        self._light = (1 - 0.1 * np.maximum(lines[0][None], lines[1][:, None])).astype(np.float32)
        self._tone = np.array(_FLOOR, np.float32) * np.float32(0.72 + 0.35 * max(self._steepness, 0))

        at = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        drawn = corners[0] + (start + at * (end - start) - self._plane @ corners[0]) @ self._plane
        self.rectangle = pyvista.PolyData(drawn, faces=[4, 0, 1, 2, 3])
        self.rectangle.active_texture_coordinates = at.astype(np.float32)
        self._bare = self._colored(np.s_[:, :], self._light)
        self._image = pyvista.ImageData(dimensions=(columns, rows, 1))
        self._image.point_data["color"] = self._bare.reshape(-1, 3).copy()
        self._shown = np.asarray(self._image.point_data["color"]).reshape(rows, columns, 3)
        self._shaded = np.s_[0:0, 0:0]
        self.texture = pyvista.Texture(self._image)
        self.texture.mipmap = self.texture.interpolate = True

    @property
    def _steepness(self) -> float:
        return float(self._to_light @ self._normal)

    def shade(self, points: np.ndarray) -> None:
        """Draw the shadows of points [n, 3], m, instead of those before."""
        above = (points - self._corner) @ self._normal
        # The light's shadow tells the height, the dark line of contact that there is none left.
        shadows = [(_CONTACT, points[np.abs(above) < 2 * self._softness] @ self._plane.T)]
        if self._steepness > 0.05:
            cast = points - self._to_light * (above / self._steepness)[:, None]
            shadows.append((_SHADOW, cast[above > 0] @ self._plane.T))
        self._shown[self._shaded] = self._bare[self._shaded]
        low, high = self._box(np.concatenate([places for _, places in shadows]))
        (left, bottom), (right, top) = low * _COARSENESS, high * _COARSENESS
        self._shaded = np.s_[bottom:top, left:right]
        light = self._light[self._shaded].copy()
        if light.size:
            for strength, places in shadows:
                light *= 1 - strength * self._coverage(places, low, high)[: light.shape[0], : light.shape[1]]
            self._shown[self._shaded] = self._colored(self._shaded, light)
        self._image.GetPointData().GetScalars().Modified()
        self._image.Modified()

    def _colored(self, box: tuple[slice, slice], light: np.ndarray) -> np.ndarray:
        """Return the colours of a part of the floor, uint8 [height, width, 3], in a light [height, width]."""
        fade = self._fade[box][..., None]
        colors = light[..., None] * self._tone * (1 - fade) + np.array(BACKGROUND, np.float32) * fade
        return np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)

    def _box(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the end (column, row) of the shadow's pixels that places [n, 2], m, can reach."""
        if not len(places):
            return np.zeros(2, int), np.zeros(2, int)
        margin = _SHADOW_END * self._softness
        ends = (np.array([places.min(axis=0) - margin, places.max(axis=0) + margin]) - self._start) / self.shadow_pixel
        low, high = np.clip(ends, 0, np.array(self._fade.shape[::-1]) / _COARSENESS)
        return np.floor(low).astype(int), np.ceil(high).astype(int)

    def _coverage(self, places: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return how much places [n, 2], m, cover, blurred, of each of the floor's pixels from ``low`` to ``high``."""
        from PIL import Image, ImageFilter

        at = np.floor((places - self._start) / self.shadow_pixel).astype(int)
        column, row = (at[((at >= low) & (at < high)).all(axis=1)] - low).T
        covered = np.zeros((high - low)[::-1], dtype=np.uint8)
        covered[row, column] = 255
        blurred = Image.fromarray(covered).filter(ImageFilter.GaussianBlur(self._softness / self.shadow_pixel))
        fine = blurred.resize((_COARSENESS * (high - low)).tolist(), Image.Resampling.BILINEAR)
        return np.asarray(fine, np.float32) / 255


def _grid_step(distance: float) -> float:
    """Return the spacing of the floor's lines, m: a round number near a tenth of the camera's distance."""
    power = 10 ** np.floor(np.log10(distance / 10))
    return float(power * min((1, 2, 5, 10), key=lambda digit: abs(np.log(distance / 10 / power / digit))))
