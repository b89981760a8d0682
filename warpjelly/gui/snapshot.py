"""What a session shows of itself at a moment, for viewers in other threads."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..model import Body
from ..scene import Scene
from ..shapes import Shape, ShapeFrame


@dataclass(frozen=True)
class Energies:
    """What there is of energy at a time, J."""

    time: float
    """Simulated time, s."""
    kinetic: float
    elastic: float
    potential: float
    """Of gravity, zero at the origin."""
    contact: float
    """Stored in penetrated colliders and overlapping particles."""

    @property
    def total(self) -> float:
        """All of it, J."""
        return self.kinetic + self.elastic + self.potential + self.contact


@dataclass(frozen=True)
class Limits:
    """The largest stable time step of a set-up with its integrator."""

    springs: float | None
    """Of the springs alone, s; None where no step is stable."""
    contact: float | None
    """If each particle touched the worst collider, a safe bound, s; None where no step is stable."""
    warning: str | None
    """What to warn of, where the time step is above a limit."""


@dataclass(frozen=True)
class Pull:
    """What is grabbed, and how it is pulled."""

    body: str
    point: np.ndarray
    """Where what was grabbed is now, float64 [3], m."""
    hand: np.ndarray
    """Where it is wanted, float64 [3], m."""
    force: np.ndarray
    """On the body, float64 [3], N."""


@dataclass(frozen=True)
class Recorded:
    """How far a recording is."""

    folder: Path
    """The run directory."""
    frames: int
    """Samples so far."""


@dataclass(frozen=True)
class Message:
    """Something that people should know."""

    number: int
    """Ascending from 1."""
    level: str
    """info, warning or error."""
    text: str


@dataclass(frozen=True)
class Snapshot:
    """What a session shows at a moment; immutable, and so are its arrays."""

    revision: int
    """Ascending with each set-up: where it is the same, so are scene, shapes (topology) and bodies."""
    scene: Scene
    """The set-up that is simulated."""
    bodies: tuple[Body, ...]
    """Names of the bodies, and their particles."""
    shapes: tuple[Shape, ...]
    """What is shown, prim by prim; what stays the same."""
    frames: tuple[ShapeFrame, ...]
    """A sample of each shape."""
    centers: Mapping[str, np.ndarray]
    """Centre of mass of each body, float64 [3], m."""
    time: float
    """Simulated time, s."""
    dt: float
    """The time step used, s."""
    playing: bool
    diverged: bool
    """Whether the simulation left the world; then this is the last good moment, until a reset or an edit."""
    energies: Energies
    """As last measured, which may be some moments earlier."""
    substeps_per_second: float
    """While it plays; else 0."""
    real_time: float
    """Simulated over real time, as reached; 0 unless it plays."""
    particles: int
    springs: int
    pull: Pull | None
    """What is grabbed, if anything is."""
    recording: Recorded | None
    """Of the recording that is going, if one is."""
    number: int = 0
    """Ascending from 1 with each snapshot."""
    limits: Limits | None = None
    """None while they are looked for, and where that would take too long."""
    messages: tuple[Message, ...] = ()
    """The last ones, oldest first."""
