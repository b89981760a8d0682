"""What can go wrong, and the exit code of the command line that goes with it."""

from __future__ import annotations

import difflib
import os
import re
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path

# What Warp says where the system has no memory for an array.
NO_MEMORY = "Failed to allocate"
# Exit code of what was interrupted: that of a shell's Ctrl-C.
INTERRUPTED = 130


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


def verdict(error: BaseException) -> tuple[str, int]:
    """Return what to tell people of whatever went wrong, in one line, and the exit code."""
    if isinstance(error, WarpjellyError):
        message, code = str(error), error.exit_code
    elif isinstance(error, KeyboardInterrupt):
        message, code = "interrupted", INTERRUPTED
    elif isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and str(error).startswith(NO_MEMORY)):
        message = "out of memory; lower the resolution or the particles per edge"
        code = EnvironmentFailedError.exit_code
    elif isinstance(error, OSError):
        message, code = str(error), EnvironmentFailedError.exit_code
    else:
        place = traceback.extract_tb(error.__traceback__)[-1]
        message = (
            f"internal error: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno}); please "
            "report it as CONTRIBUTING.md says, with the output of a run with WARPJELLY_TRACEBACK=1"
        )
        code = EnvironmentFailedError.exit_code
        if os.environ.get("WARPJELLY_TRACEBACK"):
            traceback.print_exception(error)
    return " ".join(message.split()), code


def reason(error: Exception) -> str:
    """Return what an error of USD says first, without the place in USD's source that reports it."""
    said = re.search(r" : '(.*?)'\s*$", str(error), re.MULTILINE)
    return said[1] if said else " ".join(str(error).split())


def listed(names: Sequence[str], most: int) -> str:
    """Return names for a message, and how many more there are."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


def suggestion(word: str, known: Iterable[str], what: str = "known") -> str:
    """Return what may have been meant by a word that is not known, or all that is."""
    close = difflib.get_close_matches(word, known := list(known), n=1)
    return f"did you mean '{close[0]}'?" if close else f"{what}: {', '.join(known)}"
