"""Write files that are there whole or not at all, and folders that one process at a time writes to."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from .errors import InputError

LOCK_NAME = "run.lock"


def refuse_to_replace(path: Path, *, force: bool) -> None:
    """Raise InputError where a file is there already, unless it may be replaced, or a folder."""
    if path.is_dir():
        raise InputError(f"{path}: it is a folder; choose the name of a file")
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
    renamed, and its new name before the block ends, so that even a power loss leaves either the old file or the new
    one, and nothing that is written afterwards without what came before. After an exception nothing is left.
    """
    unfinished = unfinished_name(path)
    try:
        yield unfinished
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
        _sync_names(path.parent)
    finally:
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


def remove_file(path: Path) -> None:
    """Remove a file, if there is one; it is gone from the disk, too, before anything that is removed afterwards."""
    path.unlink(missing_ok=True)
    _sync_names(path.parent)


def _sync_names(folder: Path) -> None:
    """Bring the names of the files in a folder to the disk, as far as system and file system can."""
    if sys.platform == "win32":
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        # A folder that may not be listed, or a file system without this.
        if error.errno not in (errno.EACCES, errno.EINVAL, errno.ENOTSUP):
            raise


def unfinished_name(path: Path) -> Path:
    """Return the name that a whole file has until it is whole."""
    return path.with_name(f"{path.stem}.tmp{path.suffix}")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for it out of a folder. The lock ends with its process, however that ends.

    Raises:
        InputError: another process has the lock.
        OSError: the folder cannot be written to.
    """
    if sys.platform == "win32":
        yield
        return
    import fcntl

    path = folder / LOCK_NAME
    with ExitStack() as opened:
        while True:
            file = opened.enter_context(open(path, "a+", encoding="ascii"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                raise InputError(f"{folder}: process {file.read() or '?'} is writing into this folder") from error
            # Whoever had the lock before may just have removed the file, and a third process have made another one.
            if path.exists() and os.stat(path).st_ino == os.fstat(file.fileno()).st_ino:
                break
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        # Where other machines see the folder, they are to see this, too.
        os.fsync(file.fileno())
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def wait_for_lock(folder: Path, patience: float) -> None:
    """Wait until no other process has the lock of a folder, or the folder is not there.

    Args:
        folder: the folder.
        patience: for so long at most, s.

    Raises:
        InputError: then, another process still has the lock.
    """
    until = time.monotonic() + patience
    while (folder / LOCK_NAME).exists():
        try:
            with locked(folder):
                return
        except InputError:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)
