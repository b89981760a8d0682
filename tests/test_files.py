"""Files that are there whole or not at all."""

from __future__ import annotations

import errno
import os
import stat
import sys
from pathlib import Path

import pytest

from warpjelly.files import whole_file

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be synced")


def test_a_power_loss_leaves_the_old_file_or_the_new_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bring data, name and then the folder to the disk, in this order, and only then let go."""
    done: list[object] = []
    sync, replace = os.fsync, os.replace

    def note_sync(descriptor: int) -> None:
        status = os.fstat(descriptor)
        done.append("folder" if stat.S_ISDIR(status.st_mode) else status.st_size)
        sync(descriptor)

    def note_replace(source: Path, target: Path) -> None:
        done.append(target.name)
        replace(source, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_replace)
    with whole_file(tmp_path / "a.txt") as unfinished:
        unfinished.write_text("four")
        assert done == []
    assert done == [4, "a.txt", "folder"]
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(("code", "fails"), [(errno.EINVAL, False), (errno.EIO, True)])
def test_folders_that_cannot_be_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, fails: bool) -> None:
    """Do without where the file system has no such thing, but not where the disk fails."""

    def refuse(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", refuse)
    try:
        with whole_file(tmp_path / "a.txt") as unfinished:
            unfinished.write_text("all")
    except OSError as error:
        assert (fails, error.errno) == (True, code)
    else:
        assert not fails
    assert (tmp_path / "a.txt").read_text() == "all"


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    """Keep what was there, and nothing else, where writing fails."""
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(ZeroDivisionError), whole_file(tmp_path / "a.txt") as unfinished:
        unfinished.write_text("new")
        raise ZeroDivisionError
    assert (tmp_path / "a.txt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
