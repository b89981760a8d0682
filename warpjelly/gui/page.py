"""The page: tabs of controls and a view, which any number of browsers share."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import Any

from .bodies import BodiesPanel
from .controls import Controls
from .gizmo import Gizmo
from .objects import ObjectsPanel
from .requests import Requests
from .scenes import ScenesPanel
from .session import Session
from .simulation import SimulationPanel
from .snapshot import Snapshot
from .view import View
from .viewing import ViewPanel

log = logging.getLogger("warpjelly")

# Figures are shown anew after so long, s: quicker ones cannot be read.
_FOLLOW_EVERY = 0.2
# What was asked for without a change of the simulation is shown after so long at most, s.
_LATENCY = 0.05
# Drawing takes at most this share of the time of its thread.
_SHARE = 0.5
# Raspberry, as jelly is.
_BRAND = (174, 44, 116)
_COLORS = {"info": "blue", "warning": "yellow", "error": "red"}


class Page:
    """Everything that browsers show of a session.

    It shows; what is simulated, and how, the session knows.

    Args:
        server: viser's.
        session: what is shown and changed.
        scenes: folder with scenes to open, and models in its folder ``models``.
        folder: where scenes, runs and models from browsers are written to.
    """

    def __init__(self, server: Any, session: Session, *, scenes: Path, folder: Path) -> None:
        self._server, self._session = server, session
        self._again = threading.Event()
        self._closing = False
        self._told = 0
        self.failure: Exception | None = None
        """What ended drawing, if something did."""
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_BRAND, control_width="large")
        server.gui.set_panel_label("warpjelly")
        # Beside the view, so that it hides nothing.
        server.gui.main_panel.dock_right()
        self._requests = Requests(self._refuse)
        controls = Controls(server.gui, self._requests)
        self.view = View(server, session, self._requests)
        tabs = server.gui.add_tab_group()

        def gizmo(name: str) -> Any:
            return lambda moved: Gizmo(server.scene, f"/gizmo/{name}", self._requests, moved)

        with tabs.add_tab("Play"):
            self.simulation = SimulationPanel(controls, session)
        with tabs.add_tab("Bodies"):
            self.bodies = BodiesPanel(
                controls, session, self.view, gizmo("body"), (scenes / "models", folder / "models"), self._again.set
            )
        with tabs.add_tab("Objects"):
            self.objects = ObjectsPanel(controls, session, self.view, gizmo("object"), self._again.set)
        with tabs.add_tab("View"):
            self.viewing = ViewPanel(controls, session, self.view, self._again.set)
        with tabs.add_tab("Files"):
            self.scenes = ScenesPanel(controls, session, scenes, folder, self._aim_all)
        self._panels = (self.simulation, self.bodies, self.objects, self.viewing, self.scenes)
        self._show(session.latest(), anew=True)
        self.viewing.aim(server.initial_camera)
        self._thread = threading.Thread(target=self._follow, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End drawing."""
        self._closing = True
        self._thread.join()
        self._requests.stop()

    def _follow(self) -> None:
        """Show snapshots as they come."""
        number = revision = 0
        figures_until = 0.0
        try:
            while not self._closing:
                snapshot = self._session.wait_for_newer(number, _LATENCY)
                again = self._again.is_set()
                if snapshot is None and not again:
                    continue
                self._again.clear()
                snapshot = snapshot or self._session.latest()
                began = time.monotonic()
                anew = again or snapshot.revision != revision
                self._show(snapshot, anew=anew, figures=anew or began >= figures_until or not snapshot.playing)
                if began >= figures_until:
                    figures_until = began + _FOLLOW_EVERY
                number, revision = snapshot.number, snapshot.revision
                # Who is slower than this gets fewer frames, not late ones.
                time.sleep((time.monotonic() - began) * (1 - _SHARE) / _SHARE)
        except Exception as error:
            self.failure = error

    def _show(self, snapshot: Snapshot, *, anew: bool, figures: bool = True) -> None:
        for panel in self._panels if anew else ():
            panel.refresh(snapshot)
        for panel in self._panels:
            panel.draw(snapshot)
        self.view.show(snapshot)
        for panel in self._panels if figures else ():
            panel.follow(snapshot)
        for message in snapshot.messages:
            if message.number > self._told:
                self._told = message.number
                self._tell(message.level, message.text)

    def _tell(self, level: str, text: str) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(level.capitalize(), text, color=_COLORS[level], auto_close_seconds=15.0)

    def _refuse(self, client: Any, text: str) -> None:
        """Tell who asked for something why it was not done, and show again what is."""
        client.add_notification("Not done", text, color="red", auto_close_seconds=15.0)
        self._again.set()

    def _aim_all(self) -> None:
        """Let all cameras look at the bodies of a scene that was opened."""
        for client in self._server.get_clients().values():
            self.viewing.aim(client.camera)
        self.viewing.aim(self._server.initial_camera)
