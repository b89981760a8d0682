"""The tab of what the bodies collide with."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..scene import AnyCollider, BoxCollider, PlaneCollider, SphereCollider, plane_frame
from .controls import Controls, Form, Panel
from .gizmo import Gizmo
from .session import Session
from .snapshot import Snapshot
from .view import View, bounds_of

# What can be created, by what it is called in the page.
_TYPES = {"Plane": "plane", "Sphere": "sphere", "Half-space": "half_space", "Box": "box"}
_NONE = "none"
# Least edge of a new room, m; other objects are a quarter of that.
_ROOM = 4.0


class ObjectsPanel(Panel):
    """Controls of colliders.

    Args:
        controls: what makes them.
        session: whose colliders they are.
        view: what shows them.
        gizmo: makes arrows, given what moves the object.
        again: has everything shown again.
    """

    def __init__(
        self,
        controls: Controls,
        session: Session,
        view: View,
        gizmo: Callable[[Callable[[np.ndarray, np.ndarray], None]], Gizmo],
        again: Callable[[], None],
    ) -> None:
        self._controls, self._session, self._view, self._again = controls, session, view, again
        self.chosen = _NONE
        # The same as soon as it is there: an object that was just created is not yet in a snapshot.
        self._shown_object = _NONE
        self._gizmo = gizmo(self._moved)
        self._moving = False
        controls.buttons("Create", tuple(_TYPES), self._create, hint="Create an object where it is of use")
        self._which = controls.choice("Object", (_NONE,), self.choose, hint="The object that all below is about")
        controls.switch("Arrows", self._set_moving, hint="Drag the object by arrows in the view, and turn it by rings")
        with controls.folder("Object") as folder:
            self._form = Form(controls, folder)
        controls.button("Delete", lambda _: self._delete(), hint="Delete the object", icon="trash", color="red")
        self._list = controls.gui.add_html("")

    def refresh(self, snapshot: Snapshot) -> None:
        """Show what the set-up says."""
        colliders = {str(collider.name): collider for collider in snapshot.scene.colliders}
        wanted = [str(collider.name) for collider in self._session.scene.colliders]
        if (chosen := self.chosen) not in wanted:
            self.chosen = chosen = next(iter(wanted), _NONE)
        self._shown_object = chosen if chosen in colliders else _NONE
        self._controls.offer(self._which, (_NONE, *colliders), self._shown_object)
        collider = colliders.get(self._shown_object)
        kind = (collider.type if collider else _NONE,)
        self._form.show(kind, lambda: self._make(collider) if collider else None, snapshot)

    def draw(self, snapshot: Snapshot) -> None:
        """Put the arrows where the object is."""
        found = [collider for collider in snapshot.scene.colliders if collider.name == self._shown_object]
        self._view.chosen_collider = self._shown_object if self._moving else None
        if not found or not self._moving:
            self._gizmo.show(None)
            return
        collider = found[0]
        axes = None
        if isinstance(collider, PlaneCollider):
            axes, size = np.stack(collider.frame(), axis=1), 0.3 * min(collider.size)
        elif isinstance(collider, SphereCollider):
            size = 1.5 * collider.radius
        elif isinstance(collider, BoxCollider):
            size = 0.3 * min(collider.size)
        else:
            axes, size = np.stack(plane_frame(collider.normal, None), axis=1), 1.0
        self._gizmo.show(np.array(collider.center), size=size, axes=axes)

    def choose(self, name: str) -> None:
        """Let all below be about an object."""
        self.chosen = name
        self._again()

    # What is asked for.

    def _create(self, client: Any, which: str) -> None:
        kind = _TYPES[which]
        self.chosen = self._session.add_collider({"type": kind, **place_for(kind, self._session.latest())})

    def _delete(self) -> None:
        if self.chosen != _NONE:
            self._session.delete_collider(self.chosen)

    def _set_moving(self, on: bool) -> None:
        self._moving = on
        self._again()

    def _moved(self, place: np.ndarray, axes: np.ndarray) -> None:
        changes: dict[str, Any] = {"center": np.round(place, 4).tolist()}
        collider = self._of(self._session.scene)
        if not isinstance(collider, SphereCollider | BoxCollider):
            changes["normal"] = np.round(axes[:, 2], 6).tolist()
        if isinstance(collider, PlaneCollider):
            changes["tangent"] = np.round(axes[:, 0], 6).tolist()
        self._change_all(changes)

    def _change_all(self, changes: dict[str, Any]) -> None:
        self._session.change_all({f"colliders.{self.chosen}.{key}": value for key, value in changes.items()})

    def _turn(self, *, tilt: float | None = None, heading: float | None = None) -> None:
        """Turn the normal, by angles in degrees; what is not given stays."""
        scene = self._session.scene
        now = angles_of(self._of(scene).normal, scene.up)
        normal = normal_of(now[0] if tilt is None else tilt, now[1] if heading is None else heading, scene.up)
        changes: dict[str, Any] = {"normal": np.round(normal, 6).tolist()}
        if isinstance(self._of(scene), PlaneCollider):
            changes["tangent"] = None
        self._change_all(changes)

    def _of(self, scene: Any) -> Any:
        """Return the object as a set-up has it."""
        return next(collider for collider in scene.colliders if collider.name == self.chosen)

    def _seen(self, snapshot: Snapshot) -> Any:
        """Return the object that is shown as a snapshot has it."""
        return next(collider for collider in snapshot.scene.colliders if collider.name == self._shown_object)

    # Controls that depend on what the object is.

    def _make(self, collider: AnyCollider) -> None:
        controls, bind = self._controls, self._form.bind

        def change(key: str) -> Callable[[Any], None]:
            return lambda value: self._change_all({key: value})

        def read(key: str) -> Callable[[Snapshot], Any]:
            return lambda snapshot: getattr(self._seen(snapshot), key)

        bind(controls.vector("Centre, m", change("center"), hint="Where it is"), read("center"))
        if isinstance(collider, SphereCollider):
            bind(
                controls.number("Radius, m", change("radius"), hint="Of the sphere", step=0.05, low=0.01),
                read("radius"),
            )
        elif isinstance(collider, BoxCollider):
            bind(
                controls.vector("Edges, m", change("size"), hint="Of the room that bodies stay in", low=0.01),
                read("size"),
            )
        else:
            bind(
                controls.vector("Normal", self._set_normal, hint="Out of the front, perpendicular to it"),
                lambda snapshot: tuple(np.round(self._seen(snapshot).normal, 6).tolist()),
            )
            self._make_angle("tilt", 180.0, "Between the normal and upwards, degrees")
            self._make_angle("heading", 360.0, "Of the normal around the up axis, degrees")
        if isinstance(collider, PlaneCollider):
            bind(controls.vector("Sides, m", change("size"), hint="Of the rectangle", low=0.01, count=2), read("size"))

        def number(label: str, key: str, hint: str, step: float) -> None:
            def used(snapshot: Snapshot) -> float:
                return float(getattr(snapshot.scene.contact_of(self._seen(snapshot)), key))

            bind(controls.number(label, change(key), hint=hint, step=step, low=0.0), used)

        number("Stiffness, N/m", "stiffness", "How hard it pushes a particle out, by depth", 100.0)
        number("Friction at rest", "static_friction", "Largest friction, share of the normal force", 0.05)
        number("Friction in motion", "dynamic_friction", "At most that at rest", 0.05)

    def _make_angle(self, name: str, high: float, hint: str) -> None:
        made = self._controls.slider(
            f"{name.capitalize()}, °",
            lambda angle: self._turn(**{name: angle}),
            hint=hint,
            low=0.0,
            high=high,
            step=1.0,
            at=0.0,
        )
        self._form.bind(made, lambda snapshot: self._angle(snapshot, name))

    def _set_normal(self, normal: tuple[float, ...]) -> None:
        changes: dict[str, Any] = {"normal": list(normal)}
        if isinstance(self._of(self._session.scene), PlaneCollider):
            changes["tangent"] = None
        self._change_all(changes)

    def _angle(self, snapshot: Snapshot, name: str) -> float:
        tilt, heading = angles_of(self._seen(snapshot).normal, snapshot.scene.up)
        return round(tilt if name == "tilt" else heading, 1)


def place_for(kind: str, snapshot: Snapshot) -> dict[str, Any]:
    """Return where an object of a kind is created so that it touches no body, and how large, as in a scene."""
    up = snapshot.scene.up
    low, high = bounds_of(snapshot)
    middle = (low + high) / 2
    normal = np.eye(3)[up]
    if kind == "half_space":
        center = middle - normal * (middle[up] - min(low[up], 0.0))
        return {"center": _rounded(center), "normal": _rounded(normal)}
    if kind == "box":
        return {"center": _rounded(middle), "size": _rounded(np.maximum(2 * (high - low), _ROOM))}
    size = _ROOM / 4
    beside = middle.copy()
    # Where the controls are not.
    beside[0] = low[0] - size
    if kind == "sphere":
        return {"center": _rounded(beside), "radius": size / 2}
    return {"center": _rounded(beside), "normal": _rounded(normal), "size": [size, size]}


def _rounded(vector: np.ndarray) -> list[float]:
    return [float(x) for x in np.round(vector, 2)]


def angles_of(normal: Any, up: int) -> tuple[float, float]:
    """Return the tilt of a direction from the up axis, and its heading around that, degrees."""
    direction = np.array(normal, float) / np.linalg.norm(normal)
    ahead, aside = direction[(up + 1) % 3], direction[(up + 2) % 3]
    tilt = math.degrees(math.atan2(math.hypot(ahead, aside), direction[up]))
    return tilt, math.degrees(math.atan2(aside, ahead)) % 360.0


def normal_of(tilt: float, heading: float, up: int) -> np.ndarray:
    """Return the direction with a tilt and a heading, degrees; see ``angles_of``."""
    above, around = math.radians(tilt), math.radians(heading)
    direction = np.zeros(3)
    direction[up] = math.cos(above)
    direction[(up + 1) % 3] = math.sin(above) * math.cos(around)
    direction[(up + 2) % 3] = math.sin(above) * math.sin(around)
    return direction
