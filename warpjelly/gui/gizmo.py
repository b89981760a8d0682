"""Arrows in the view by which something is moved."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from .requests import Requests


class Gizmo:
    """Arrows, and rings where something can be turned.

    Args:
        scene: viser's.
        path: of its node there.
        requests: where moving is asked for.
        moved: moves it: called with the place [3], m, and the axes [3, 3], by columns, that the arrows were dragged to.
    """

    def __init__(
        self, scene: Any, path: str, requests: Requests, moved: Callable[[np.ndarray, np.ndarray], None]
    ) -> None:
        self._node = scene.add_transform_controls(path, visible=False, depth_test=False, line_width=4.0)
        self._held = False

        # Not a plain function: those that viser calls in threads overtake each other.
        async def dragged(event: Any) -> None:
            self._held = event.phase != "end"
            if event.phase != "start":
                place, axes = np.array(self._node.position), _axes(self._node.wxyz)
                requests.ask(event.client, lambda: moved(place, axes), key=path)

        self._node.on_update(dragged)

    def show(self, place: np.ndarray | None, *, size: float = 1.0, axes: np.ndarray | None = None) -> None:
        """Put the arrows at a place [3], m, or nowhere, unless somebody drags them.

        Args:
            place: where.
            size: length of the arrows, m.
            axes: where what is moved can be turned, its axes [3, 3], by columns.
        """
        self._node.visible = place is not None
        if place is None or self._held:
            return
        self._node.scale, self._node.disable_rotations = size, axes is None
        self._node.position = place
        self._node.wxyz = _quaternion(np.eye(3) if axes is None else axes)


def _axes(wxyz: np.ndarray) -> np.ndarray:
    """Return the axes [3, 3], by columns, of a quaternion."""
    w, x, y, z = wxyz / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(axes: np.ndarray) -> np.ndarray:
    """Return the quaternion w, x, y, z of axes [3, 3], by columns, right-handed."""
    # The largest component first, so that nothing is divided by next to nothing.
    squares = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) @ np.diag(axes) + 1
    most = int(squares.argmax())
    a = axes
    rows = np.array(
        [
            [squares[0], a[2, 1] - a[1, 2], a[0, 2] - a[2, 0], a[1, 0] - a[0, 1]],
            [a[2, 1] - a[1, 2], squares[1], a[1, 0] + a[0, 1], a[0, 2] + a[2, 0]],
            [a[0, 2] - a[2, 0], a[1, 0] + a[0, 1], squares[2], a[2, 1] + a[1, 2]],
            [a[1, 0] - a[0, 1], a[0, 2] + a[2, 0], a[2, 1] + a[1, 2], squares[3]],
        ]
    )
    return np.asarray(rows[most] / np.linalg.norm(rows[most]))
