"""Write files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import InputError


def refuse_to_replace(path: Path, *, force: bool) -> None:
    """Raise InputError where a file is there already, unless it may be replaced."""
    if path.exists() and not force:
        raise InputError(f"{path}: there already; choose another name, or replace it with --force")


def missing(path: Path) -> str | None:
    """Say why a file cannot be read, unless there is one."""
    if path.is_file():
        return None
    return "it is a folder, not a file" if path.is_dir() else "no such file"


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a temporary name beside a file; what was written there gets the file's name when the block ends well.

    The name keeps the extension, from which writers tell the format. The data is on the disk before the file is
    renamed, so that even a power loss leaves either the old file or the new one. After an exception nothing is left.
    """
    unfinished = path.with_name(f"{path.stem}.tmp{path.suffix}")
    try:
        yield unfinished
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)
