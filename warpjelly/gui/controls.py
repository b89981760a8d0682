"""Controls of the page whose changes are requests, and which show what the scene says."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from .requests import PAUSE, Requests
from .snapshot import Snapshot

# Digits behind the point that a number can have; what is shown has as many as it needs.
_DIGITS = 7


class Controls:
    """Makes controls in the page.

    A control that somebody changes asks for what it is for. What the page itself puts into one asks for nothing.

    Args:
        gui: viser's.
        requests: where changes are asked for.
    """

    def __init__(self, gui: Any, requests: Requests) -> None:
        self.gui = gui
        self._requests = requests

    def folder(self, label: str | None, *, opened: bool = True) -> AbstractContextManager[Any]:
        """Make a group of controls, to be used as a context; without a label nothing is seen of it."""
        folder: AbstractContextManager[Any] = self.gui.add_folder(label, expand_by_default=opened)
        return folder

    def number(
        self,
        label: str,
        apply: Callable[[float], None],
        *,
        hint: str,
        step: float,
        low: float | None = None,
        high: float | None = None,
    ) -> Any:
        """Make a number that is typed or stepped."""
        start = 0.0 if low is None else low
        made = self.gui.add_number(label, float(start), min=low, max=high, step=step, hint=hint)
        made.precision = _DIGITS
        return self._asking(made, apply, PAUSE)

    def slider(
        self, label: str, apply: Callable[[float], None], *, hint: str, low: float, high: float, step: float, at: float
    ) -> Any:
        """Make a number on a scale."""
        return self._asking(self.gui.add_slider(label, low, high, step, at, hint=hint), apply, PAUSE / 4)

    def whole(self, label: str, apply: Callable[[int], None], *, hint: str, low: int, high: int) -> Any:
        """Make a whole number on a scale, which grows where more is shown."""
        return self._asking(self.gui.add_slider(label, low, high, 1, low, hint=hint), apply, PAUSE)

    def vector(
        self,
        label: str,
        apply: Callable[[tuple[float, ...]], None],
        *,
        hint: str,
        low: float | None = None,
        count: int = 3,
    ) -> Any:
        """Make two or three numbers."""
        make = {2: self.gui.add_vector2, 3: self.gui.add_vector3}[count]
        start = 0.0 if low is None else low
        made = make(label, (start,) * count, min=None if low is None else (low,) * count, step=0.1, hint=hint)
        made.precision = _DIGITS
        return self._asking(made, apply, PAUSE)

    def text(self, label: str, *, hint: str, at: str) -> Any:
        """Make a text, which asks for nothing by itself."""
        return self.gui.add_text(label, at, hint=hint)

    def switch(self, label: str, apply: Callable[[bool], None], *, hint: str, on: bool = False) -> Any:
        """Make a box to tick."""
        return self._asking(self.gui.add_checkbox(label, on, hint=hint), apply, 0.0)

    def choice(self, label: str, options: Sequence[str], apply: Callable[[str], None], *, hint: str) -> Any:
        """Make a list to choose one from."""
        return self._asking(self.gui.add_dropdown(label, tuple(options) or ("",), hint=hint), apply, 0.0)

    def color(self, label: str, apply: Callable[[tuple[int, int, int]], None], *, at: tuple[int, int, int]) -> Any:
        """Make a colour."""
        return self._asking(self.gui.add_rgb(label, at), apply, PAUSE / 4)

    def button(
        self, label: str, action: Callable[[Any], None], *, hint: str, icon: Any = None, color: Any = None
    ) -> Any:
        """Make a button; its action is given the client whose it was pressed in."""
        made = self.gui.add_button(label, hint=hint, icon=icon, color=color)
        made.on_click(lambda event: self._requests.ask(event.client, lambda: action(event.client)))
        return made

    def toggle(self, label: str, action: Callable[[str], None], *, hint: str, icon: Any, color: Any) -> Any:
        """Make a button whose label says what it does; its action is given what it said when it was pressed."""
        made = self.gui.add_button(label, hint=hint, icon=icon, color=color)

        def pressed(event: Any) -> None:
            meant = made.label
            self._requests.ask(event.client, lambda: action(meant))

        made.on_click(pressed)
        return made

    def buttons(self, label: str, options: Sequence[str], action: Callable[[Any, str], None], *, hint: str) -> Any:
        """Make buttons in a row; the action is given the client and which one was pressed."""
        made = self.gui.add_button_group(label, tuple(options), hint=hint)

        def pressed(event: Any) -> None:
            option = event.target.value
            self._requests.ask(event.client, lambda: action(event.client, option))

        made.on_click(pressed)
        return made

    def on_upload(self, button: Any, apply: Callable[[str, bytes], None]) -> None:
        """Let a button for uploads ask for something, with the name and the content of a file."""

        def uploaded(event: Any) -> None:
            name, content = event.target.value.name, event.target.value.content
            self._requests.ask(event.client, lambda: apply(name, content))

        button.on_upload(uploaded)

    def put(self, control: Any, value: Any) -> None:
        """Show a value in a control, unless what somebody put there is still to be done."""
        if self._requests.awaits(id(control)):
            return
        if isinstance(value, int | float) and (getattr(control, "max", None) or value) < value:
            control.max = value
        control.value = value

    def offer(self, control: Any, options: Sequence[str], chosen: str) -> None:
        """Show a list in a control, and what is chosen of it."""
        if control.options != tuple(options):
            control.options = tuple(options)
        self.put(control, chosen)

    def _asking(self, control: Any, apply: Callable[[Any], None], pause: float) -> Any:
        def changed(event: Any) -> None:
            # Without a client, it was the page itself.
            if event.client is not None:
                value = event.target.value
                self._requests.ask(event.client, lambda: apply(value), key=id(control), pause=pause)

        control.on_update(changed)
        return control


def note(text: str, color: str = "inherit") -> str:
    """Return a line of small print between controls, HTML."""
    return f'<p style="margin:0.2em 0.6em;font-size:0.85em;color:{color}">{html.escape(text)}</p>'


class Panel:
    """A tab of the page."""

    def refresh(self, snapshot: Snapshot) -> None:
        """Show what the set-up says, after it changed."""

    def follow(self, snapshot: Snapshot) -> None:
        """Show what changes while it plays, some times a second."""

    def draw(self, snapshot: Snapshot) -> None:
        """Draw in the view what belongs to the tab."""


class Form:
    """Controls that are there for some things and not for others.

    Args:
        controls: what puts values into them.
        folder: viser's, which holds them.
    """

    def __init__(self, controls: Controls, folder: Any) -> None:
        self._controls, self._folder = controls, folder
        self._kind: tuple[Any, ...] | None = None
        self._bound: list[tuple[Any, Callable[[Snapshot], Any]]] = []

    def show(self, kind: tuple[Any, ...], make: Callable[[], None], snapshot: Snapshot) -> None:
        """Show what a set-up says, in controls that are made anew where the kind of thing is another.

        Args:
            kind: of thing.
            make: makes its controls, and binds each.
            snapshot: whose set-up it is.
        """
        if kind != self._kind:
            for control, _ in self._bound:
                control.remove()
            self._bound, self._kind = [], kind
            with self._folder:
                make()
        for control, read in self._bound:
            self._controls.put(control, read(snapshot))

    def bind(self, control: Any, read: Callable[[Snapshot], Any]) -> None:
        """Say what a control shows."""
        self._bound.append((control, read))
