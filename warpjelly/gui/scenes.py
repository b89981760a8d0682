"""The tab of files: scenes to open and save, runs to record, pictures to take."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..scenefile import identifier
from ..worldfile import SUFFIX
from .controls import Controls, Panel, note
from .session import Session
from .snapshot import Snapshot

# For how long a browser may draw a picture, s.
_PATIENCE = 30.0
_RECORD, _STOP = "Record", "Stop recording"


class ScenesPanel(Panel):
    """Controls of files.

    Args:
        controls: what makes them.
        session: whose set-up is opened, saved and recorded.
        scenes: folder with scenes to open.
        folder: where scenes and runs are written to.
        opened: called when a scene was opened.
    """

    def __init__(
        self, controls: Controls, session: Session, scenes: Path, folder: Path, opened: Callable[[], None]
    ) -> None:
        self._session, self._scenes, self._folder, self._opened = session, scenes, folder, opened
        name = session.scene.name
        with controls.folder("Open"):
            self._found = controls.gui.add_dropdown("Scene", ("",), hint=f"In {scenes} and {folder}")
            controls.button("Open", self._open, hint="Instead of all that is here", icon="folder-open")
            self._missing = controls.gui.add_html("")
        with controls.folder("Save"):
            self._name = controls.text("Name", hint=f"Of a file in {folder}; `warpjelly run` reproduces it", at=name)
            controls.button(
                "Save the scene", self._save, hint="As it is set up now, at time zero", icon="device-floppy"
            )
        with controls.folder("Record"):
            self._run = controls.text("Run", hint=f"Name of a folder in {folder}, with a USD stage", at=f"{name}_run")
            self._record = controls.toggle(
                _RECORD, self._toggle, hint="Write a USD stage from here on", icon="player-record", color="red"
            )
            self._recorded = controls.gui.add_html("")
        self._replace = controls.gui.add_checkbox("Replace", False, hint="What is there already, of the same name")
        controls.button("Take a picture", self._take_picture, hint="A PNG, as large as the view", icon="camera")
        self._list()

    def follow(self, snapshot: Snapshot) -> None:
        """Show how the recording goes."""
        going = snapshot.recording
        self._record.label = _RECORD if going is None else _STOP
        self._record.icon = "player-record" if going is None else "player-stop"
        self._recorded.content = "" if going is None else note(f"{going.frames} frames in {going.folder}")

    def refresh(self, snapshot: Snapshot) -> None:
        """Show what there is to open."""
        self._list()

    def _list(self) -> None:
        """List scenes to open, by their paths in the folders."""
        names = tuple(self._files())
        where = " or ".join(dict.fromkeys(map(str, (self._scenes, self._folder))))
        self._missing.content = "" if names else note(f"no scene in {where}; save one, or start where some are")
        if names and self._found.options != names:
            self._found.options = names

    def _files(self) -> dict[str, Path]:
        folders = dict.fromkeys((self._scenes, self._folder))
        found = [path for folder in folders if folder.is_dir() for path in sorted(folder.iterdir())]
        return {str(path): path for path in found if path.suffix.lower() in (".toml", SUFFIX) and path.is_file()}

    def _open(self, client: Any) -> None:
        path = self._files().get(self._found.value)
        if path is None:
            raise InputError(f"no scene to open in {self._scenes} or {self._folder}")
        # Of a large scene it takes a while.
        telling = client.add_notification("Opening", str(path), loading=True, with_close_button=False)
        try:
            self._session.open(path)
        finally:
            telling.remove()
        self._name_after_scene()
        self._opened()

    def _name_after_scene(self) -> None:
        """Suggest to save and record the scene under its name."""
        name = self._session.scene.name
        self._name.value, self._run.value = name, f"{name}_run"

    def _save(self, client: Any) -> None:
        path = self._folder / f"{self._identifier(self._name.value)}.toml"
        self._require_new(path)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._session.save(path, force=self._replace.value)
        self._list()

    def _toggle(self, meant: str) -> None:
        if meant == _STOP:
            self._session.stop_recording()
        else:
            folder = self._folder / self._identifier(self._run.value)
            self._require_new(folder)
            self._session.record(folder, force=self._replace.value)

    def _require_new(self, path: Path) -> None:
        """Refuse what is there already, in words of the page."""
        if path.exists() and not self._replace.value:
            raise InputError(f"{path}: there already; choose another name, or tick Replace")

    @staticmethod
    def _identifier(name: str) -> str:
        """Return the name of a file, which leads to no other folder."""
        if identifier(name) != name:
            raise InputError(f"{name!r}: a name has letters, digits and _, and does not start with a digit")
        return name

    def _take_picture(self, client: Any) -> None:
        import imageio.v3

        camera = client.camera
        width, height = camera.image_width, camera.image_height
        try:
            picture = client.get_render(height, width, transport_format="png", timeout=_PATIENCE)
        except (TimeoutError, RuntimeError) as error:
            raise InputError(f"the browser gave no picture: {error}") from error
        content = io.BytesIO()
        imageio.v3.imwrite(content, np.ascontiguousarray(picture), extension=".png")
        client.send_file_download(f"{self._session.scene.name}.png", content.getvalue(), save_immediately=True)
