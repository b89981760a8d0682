"""The tab of the view: camera, light, ground and background."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .controls import Controls, Panel
from .session import Session
from .snapshot import Snapshot
from .surroundings import FIELD_OF_VIEW, PRESETS, look
from .view import View

_BACKGROUND = (238, 240, 244)
# Width over height of the view in a browser that did not yet say it.
_ASPECT = 1.1


class ViewPanel(Panel):
    """Controls of how everything looks.

    Args:
        controls: what makes them.
        session: what is looked at.
        view: what shows it.
        again: has everything shown again.
    """

    def __init__(self, controls: Controls, session: Session, view: View, again: Callable[[], None]) -> None:
        self._session, self._view, self._again = session, view, again
        self._up_axis = ""
        controls.buttons("Camera", tuple(PRESETS), self._look, hint="Look at all bodies from there")
        with controls.folder("Light"):
            light = lambda _: self._light()  # noqa: E731
            self._azimuth = controls.slider(
                "Direction, °", light, hint="Around the up axis", low=0.0, high=360.0, step=1.0, at=35.0
            )
            self._elevation = controls.slider(
                "Height, °", light, hint="Above the ground", low=5.0, high=90.0, step=1.0, at=50.0
            )
            self._sun = controls.slider(
                "Intensity", light, hint="Of the light that has a direction", low=0.0, high=6.0, step=0.1, at=2.2
            )
            self._sky = controls.slider(
                "Ambient", light, hint="Of light from everywhere", low=0.0, high=4.0, step=0.1, at=1.4
            )
            self._shadows = controls.switch("Shadows", self._set_shadows, hint="Let the light throw shadows", on=True)
        with controls.folder("Ground"):
            ground = lambda _: self._lay_ground()  # noqa: E731
            self._ground = controls.switch("Grid", ground, hint="Squares of a metre, halved", on=True)
            self._height = controls.number("Height, m", ground, hint="Along the up axis", step=0.1)
        controls.color("Background", view.stage.background, at=_BACKGROUND)
        view.stage.background(_BACKGROUND)

    def refresh(self, snapshot: Snapshot) -> None:
        """Turn light and ground where another axis points up."""
        if snapshot.scene.up_axis != self._up_axis:
            self._up_axis = snapshot.scene.up_axis
            self._light()
            self._lay_ground()

    def aim(self, camera: Any, preset: str = "Perspective") -> None:
        """Let a camera of viser's look at all bodies; that of browsers to come does not know how wide they are."""
        snapshot = self._session.latest()
        aspect = getattr(camera, "aspect", _ASPECT)
        position, target = look(preset, snapshot.scene.up_axis, self._view.seen(snapshot), aspect)
        camera.position, camera.look_at, camera.fov = position, target, FIELD_OF_VIEW

    def _look(self, client: Any, preset: str) -> None:
        up = [0.0, 0.0, 0.0]
        up[self._session.latest().scene.up] = 1.0
        client.camera.up_direction = tuple(up)
        self.aim(client.camera, preset)

    def _set_shadows(self, on: bool) -> None:
        self._light()
        # In three.js, meshes that are there when a light begins or ends to throw shadows may stay unseen afterwards.
        self._view.draw_anew()
        self._again()

    def _light(self) -> None:
        self._view.stage.light(
            azimuth=self._azimuth.value,
            elevation=self._elevation.value,
            sun=self._sun.value,
            sky=self._sky.value,
            shadows=self._shadows.value,
            up_axis=self._up_axis,
        )

    def _lay_ground(self) -> None:
        self._view.stage.ground(shown=self._ground.value, height=self._height.value, size=1.0, up_axis=self._up_axis)
