"""The three-dimensional part of the page: what a snapshot shows, and bodies that are pulled with the mouse."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ..colors import range_in_words
from ..shapes import Shape
from ..stage.histogram import ForceHistogram
from .drawing import STEP_COLORS, Drawing, Edges, ForceRange, drawing
from .requests import Requests
from .session import Session
from .snapshot import Snapshot
from .surroundings import Colliders, Stage, in_view

# The range of colours is found anew after so long, s.
_RANGE_EVERY = 0.5
_PULL_COLOR = (30, 110, 220)


class View:
    """What is shown of a session in three dimensions.

    Args:
        server: viser's.
        session: whose bodies are pulled.
        requests: where pulling is asked for.
    """

    def __init__(self, server: Any, session: Session, requests: Requests) -> None:
        self._server, self._session, self._requests = server, session, requests
        self.stage = Stage(server.scene)
        self._colliders = Colliders(server.scene)
        self._pull = server.scene.add_line_segments(
            "/pull", np.zeros((1, 2, 3)), _PULL_COLOR, thickness=3.0, thickness_units="screen", visible=False
        )
        self._shapes: tuple[Shape, ...] = ()
        self._drawings: list[Drawing] = []
        self._edges: list[Edges | None] = []
        self._forces = ForceHistogram()
        self._range: ForceRange = (0.0, 1.0)
        self._range_until = 0.0
        self._time = 0.0
        self._up_axis = ""
        self.colored = True
        """Whether colours show forces."""
        self.edged = False
        """Whether edges of faces are drawn."""
        self.chosen_collider: str | None = None

    @property
    def left_out(self) -> int:
        """How many springs and particles are not drawn, since they are too many."""
        return sum(each.left_out for each in self._drawings)

    def draw_anew(self) -> None:
        """Draw everything anew with the next snapshot."""
        self._shapes = ()

    def show(self, snapshot: Snapshot) -> None:
        """Draw a snapshot."""
        if snapshot.scene.up_axis != self._up_axis:
            self._up_axis = snapshot.scene.up_axis
            self._server.scene.set_up_direction(f"+{self._up_axis.lower()}")
        if not _alike(self._shapes, snapshot.shapes):
            self._begin(snapshot)
        self._shapes = snapshot.shapes
        colors = self._color_range(snapshot)
        with self._server.atomic():
            for shape, each, frame in zip(snapshot.shapes, self._drawings, snapshot.frames, strict=True):
                each.show(frame, colors if shape.shows_force else None)
            self._show_edges(snapshot)
            self._colliders.show(snapshot.scene, bounds_of(snapshot), self.chosen_collider)
            self._show_pull(snapshot)

    def seen(self, snapshot: Snapshot) -> np.ndarray:
        """Return what a camera should see of a snapshot, [count, 3], m."""
        return in_view(snapshot.scene, bounds_of(snapshot))

    def legend(self) -> str:
        """Return the legend of the colours, HTML; empty where they show nothing."""
        if not self.colored or not any(shape.shows_force for shape in self._shapes):
            return ""
        low, high = range_in_words(self._range)
        steps = "".join(f'<span style="flex:1;background:rgb{tuple(color)}"></span>' for color in STEP_COLORS.tolist())
        return (
            f'<div style="margin:0.2em 0.6em"><div style="display:flex;height:0.9em">{steps}</div>'
            '<div style="display:flex;justify-content:space-between;font-size:0.8em">'
            f"<span>{low}</span><span>force on a particle, N</span><span>{high}</span></div></div>"
        )

    def _begin(self, snapshot: Snapshot) -> None:
        """Draw other shapes than before."""
        for each in [*self._drawings, *filter(None, self._edges)]:
            each.remove()
        self._edges = [None] * len(snapshot.shapes)
        self._drawings = [
            drawing(
                self._server.scene, f"/bodies/{shape.body}/{shape.name}_{number}", shape, frame, self._puller(shape)
            )
            for number, (shape, frame) in enumerate(zip(snapshot.shapes, snapshot.frames, strict=True))
        ]
        self._forces, self._range_until = ForceHistogram(), 0.0

    def _show_edges(self, snapshot: Snapshot) -> None:
        for number, (shape, frame) in enumerate(zip(snapshot.shapes, snapshot.frames, strict=True)):
            edges = self._edges[number]
            if self.edged and len(shape.counts):
                if edges is None:
                    path = f"/bodies/{shape.body}/edges_{number}"
                    edges = self._edges[number] = Edges(self._server.scene, path, shape, frame)
                edges.show(frame, None)
            elif edges is not None:
                edges.remove()
                self._edges[number] = None

    def _show_pull(self, snapshot: Snapshot) -> None:
        """Draw a line from what is grabbed to where it is wanted."""
        self._pull.visible = snapshot.pull is not None
        if snapshot.pull is not None:
            self._pull.points = np.array([[snapshot.pull.point, snapshot.pull.hand]], np.float32)

    def _color_range(self, snapshot: Snapshot) -> ForceRange | None:
        """Return the forces at both ends of the colours: as the scene says, or what was seen since the start."""
        if not self.colored:
            return None
        given = snapshot.scene.output.force_range
        if given != "auto":
            self._range = given
            return given
        if snapshot.time < self._time:
            self._forces, self._range_until = ForceHistogram(), 0.0
        new, self._time = snapshot.time != self._time or not self._range_until, snapshot.time
        # What is held is not shown again.
        if new and ((now := time.monotonic()) >= self._range_until or not snapshot.playing):
            for shape, frame in zip(snapshot.shapes, snapshot.frames, strict=True):
                if shape.shows_force:
                    self._forces.add(frame.forces)
            self._range, self._range_until = self._forces.color_range(), now + _RANGE_EVERY
        return self._range

    def _puller(self, shape: Shape) -> Any:
        """Return what is called when somebody drags a shape."""

        # Not a plain function: those that viser calls in threads overtake each other.
        async def pulled(event: Any) -> None:
            client, at = event.client, event.end_position
            if event.phase == "start":
                grabbed = event.start_position
                self._requests.ask(client, lambda: self._session.grab(shape.body, grabbed))
            elif event.phase == "update":
                self._requests.ask(client, lambda: self._session.drag(at), key=("drag", event.client_id))
            else:
                self._requests.ask(client, self._session.release)

        return pulled


def bounds_of(snapshot: Snapshot) -> np.ndarray:
    """Return the box around all that is shown of the bodies, float64 [2, 3], m."""
    points = np.concatenate([frame.points for frame in snapshot.frames])
    return np.stack([points.min(axis=0), points.max(axis=0)]).astype(float)


def _alike(before: tuple[Shape, ...], after: tuple[Shape, ...]) -> bool:
    """Say whether shapes differ in nothing that is drawn but where their points are."""

    def same(a: Shape, b: Shape) -> bool:
        return a is b or (
            (a.body, a.name, a.width, a.double_sided) == (b.body, b.name, b.width, b.double_sided)
            and len(a.particles) == len(b.particles)
            and (a.kinds is None) == (b.kinds is None)
            and np.array_equal(a.counts, b.counts)
            and np.array_equal(a.corners, b.corners)
        )

    return len(before) == len(after) and all(map(same, before, after))
