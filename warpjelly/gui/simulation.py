"""The tab that plays the simulation, and says how fast it goes, how stable it is and where its energy is."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from ..scene import MAX_STEP, MIN_STEP, Solver
from .controls import Controls, Panel, note
from .session import Session
from .snapshot import Snapshot

_SPEEDS = {"1/10 of real time": 0.1, "1/4 of real time": 0.25, "1/2 of real time": 0.5, "real time": 1.0}
_SPEEDS |= {"2 x real time": 2.0, "as fast as it goes": 1000.0}
_PLAY, _PAUSE = "Play", "Pause"
_INTEGRATORS = ("explicit_euler", "semi_implicit_euler", "rk2", "rk4")
# The plot has at most so many points, and is drawn anew after so long, s.
_POINTS, _PLOT_EVERY = 300, 0.5
_LINES = {"total": "#222222", "kinetic": "#e66c5c", "elastic": "#bc3587", "gravity": "#3f7fd0", "contact": "#888888"}
_GOOD, _WARNING = "#2b8a3e", "#c92a2a"


class SimulationPanel(Panel):
    """Controls of time and of the solver.

    Args:
        controls: what makes them.
        session: what they are for.
    """

    def __init__(self, controls: Controls, session: Session) -> None:
        self._controls, self._session = controls, session
        self._plot_until = 0.0
        self._play = controls.toggle(
            _PLAY, self._toggle, hint="Let time go on, or hold it", icon="player-play", color="grape"
        )
        controls.buttons(
            "Time", ("Step", "Reset"), self._jump, hint="Go on by one step of the solver; go back to time zero"
        )
        self._speed = controls.choice("Speed", tuple(_SPEEDS), self._set_speed, hint="Simulated time over real time")
        self._figures = controls.gui.add_html("")
        with controls.folder("Solver"):
            self._integrator = controls.choice(
                "Integrator",
                _INTEGRATORS,
                lambda name: session.change("solver.integrator", name),
                hint="How time advances: rk2 and rk4 take two and four times as long a step",
            )
            self._automatic = controls.switch(
                "Choose step",
                lambda on: session.change("solver.dt", "auto" if on else Solver.model_fields["dt"].default),
                hint="Take a safe share of the largest stable step",
            )
            self._step = controls.number(
                "Step, ms",
                lambda step: session.change("solver.dt", step / 1e3),
                hint="Time step. The one used is the largest below it that divides a frame",
                step=0.1,
                low=1e3 * MIN_STEP,
                high=1e3 * MAX_STEP,
            )
            self._stability = controls.gui.add_html("")
        with controls.folder("Energy, J"):
            self._plot = controls.gui.add_uplot(
                self._history(),
                series=(
                    {"label": "s"},
                    *(
                        {"label": name, "stroke": color, "width": 1.5, "points": {"show": False}}
                        for name, color in _LINES.items()
                    ),
                ),
                scales={"x": {"time": False}},
                height=190,
            )

    def refresh(self, snapshot: Snapshot) -> None:
        """Show what the set-up says."""
        solver = snapshot.scene.solver
        self._controls.put(self._integrator, solver.integrator)
        self._controls.put(self._automatic, solver.dt == "auto")
        self._controls.put(self._step, 1e3 * (snapshot.dt if solver.dt == "auto" else solver.dt))
        self._step.disabled = solver.dt == "auto"

    def follow(self, snapshot: Snapshot) -> None:
        """Show how it goes."""
        self._play.label = _PAUSE if snapshot.playing else _PLAY
        self._play.icon = "player-pause" if snapshot.playing else "player-play"
        speed = min(_SPEEDS, key=lambda name: abs(np.log(_SPEEDS[name] / self._session.speed)))
        self._controls.put(self._speed, speed)
        rows = [
            ("time", f"{snapshot.time:.3f} s"),
            ("speed", f"{snapshot.real_time:.2f} x real time" if snapshot.playing else "held"),
            ("substeps", f"{snapshot.substeps_per_second:,.0f} /s"),
            ("particles", f"{snapshot.particles:,}, springs {snapshot.springs:,}"),
        ]
        self._figures.content = _table(rows)
        self._stability.content = _stability(snapshot)
        if (now := time.monotonic()) >= self._plot_until:
            self._plot_until = now + _PLOT_EVERY
            self._plot.data = self._history()

    def _toggle(self, meant: str) -> None:
        if meant == _PLAY:
            self._session.play()
        else:
            self._session.pause()

    def _jump(self, client: Any, which: str) -> None:
        if which == "Step":
            self._session.step()
        else:
            self._session.reset()

    def _set_speed(self, name: str) -> None:
        self._session.speed = _SPEEDS[name]

    def _history(self) -> tuple[np.ndarray, ...]:
        """Return times and energies for the plot."""
        history = self._session.history()
        every = -(-len(history) // _POINTS) or 1
        chosen = history[::-1][::every][::-1]
        rows = [(e.time, e.total, e.kinetic, e.elastic, e.potential, e.contact) for e in chosen]
        return tuple(np.array(rows, float).reshape(-1, 1 + len(_LINES)).T)


def _table(rows: list[tuple[str, str]]) -> str:
    cells = "".join(f'<tr><td style="opacity:0.6;padding-right:1em">{a}</td><td>{b}</td></tr>' for a, b in rows)
    return f'<table style="margin:0 0.6em;font-size:0.9em">{cells}</table>'


def _stability(snapshot: Snapshot) -> str:
    """Say how the step used compares with the largest stable one."""
    used, limits = f"step used {1e3 * snapshot.dt:.4g} ms", snapshot.limits
    if limits is None:
        return note(f"{used}; the largest stable one is not known")
    bounds = [(limits.springs, "of the springs"), (limits.contact, "in contact")]
    stable = [f"{1e3 * limit:.4g} ms {where}" if limit else f"none {where}" for limit, where in bounds]
    line = note(f"{used}; largest stable: {', '.join(stable)}", _GOOD if limits.warning is None else _WARNING)
    return line + (note(limits.warning, _WARNING) if limits.warning else "")
