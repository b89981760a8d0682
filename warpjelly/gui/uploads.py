"""Model files that viewers send: checked by name and size, and kept until they are saved beside a scene."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from ..errors import EnvironmentFailedError, InputError
from ..scenefile import identifier

# More is refused, bytes.
MOST_BYTES = 200_000_000


class Uploads:
    """A folder of its own for files, removed when it is closed."""

    def __init__(self) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def add(self, name: str, content: bytes) -> Path:
        """Keep a file under a name that is safe and free, and return where it is.

        Raises:
            InputError: it is not the kind of file that models are in, empty, or too large.
            EnvironmentFailedError: it cannot be written.
        """
        # Reading models takes imports that take most of a second.
        from ..meshes import EXTENSIONS, EXTRA_EXTENSIONS

        suffix = Path(name).suffix.lower()
        if suffix not in (*EXTENSIONS, *EXTRA_EXTENSIONS):
            raise InputError(f"{name}: not a model file; models are {' '.join((*EXTENSIONS, *EXTRA_EXTENSIONS))}")
        if not content:
            raise InputError(f"{name}: the file is empty")
        if len(content) > MOST_BYTES:
            raise InputError(f"{name}: {len(content) / 1e6:.0f} MB; at most {MOST_BYTES / 1e6:.0f} MB can be sent")
        try:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="warpjelly_")
            # A folder for each, so that names need no numbers.
            path = Path(tempfile.mkdtemp(dir=self._folder.name)) / f"{identifier(Path(name).stem)}{suffix}"
            path.write_bytes(content)
        except OSError as error:
            raise EnvironmentFailedError(f"{name}: cannot keep the file: {error.strerror or error}") from error
        return path

    def has(self, path: Path) -> bool:
        """Say whether a file is one of these."""
        return self._folder is not None and Path(self._folder.name) in path.parents

    def close(self) -> None:
        """Remove all files."""
        if self._folder is not None:
            self._folder.cleanup()

    @staticmethod
    def copy(path: Path, folder: Path) -> Path:
        """Copy a file into a folder, which is made if missing, under a free name; one that is the same is taken.

        Raises:
            EnvironmentFailedError: it cannot be written.
        """
        try:
            folder.mkdir(parents=True, exist_ok=True)
            number = 1
            while True:
                target = folder / (path.name if number == 1 else f"{path.stem}_{number}{path.suffix}")
                if not target.exists():
                    shutil.copyfile(path, target)
                    return target
                if target.is_file() and target.read_bytes() == path.read_bytes():
                    return target
                number += 1
        except OSError as error:
            raise EnvironmentFailedError(f"{folder}: cannot copy {path.name}: {error.strerror or error}") from error
