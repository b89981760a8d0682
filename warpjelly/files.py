"""Write files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


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
