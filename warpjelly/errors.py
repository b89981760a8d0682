"""What can go wrong, and the exit code of the command line that goes with it."""

from __future__ import annotations

import re
from collections.abc import Sequence


class WarpjellyError(Exception):
    """Base of every error that warpjelly raises on purpose; the message is one line for people."""

    exit_code = 4


class InputError(WarpjellyError):
    """The user's input is wrong: scene, model, arguments, a missing extra, output that exists."""

    exit_code = 2


class SceneError(InputError):
    """A scene that is valid by itself cannot be built or written; the message does not name its file."""


class DivergedError(WarpjellyError):
    """The simulation left the world; what was simulated before is kept."""

    exit_code = 3


class EnvironmentFailedError(WarpjellyError):
    """The machine said no: a full disk, a missing permission, a lost device."""

    exit_code = 4


def reason(error: Exception) -> str:
    """Return what an error of USD says first, without the place in USD's source that reports it."""
    said = re.search(r" : '(.*?)'\s*$", str(error), re.MULTILINE)
    return said[1] if said else " ".join(str(error).split())


def listed(names: Sequence[str], most: int) -> str:
    """Return names for a message, and how many more there are."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")
