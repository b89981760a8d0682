"""Write a scene as a scene file."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .errors import EnvironmentFailedError, InputError
from .files import refuse_to_replace, whole_file
from .scene import Scene

# Lists that would make a line longer than this have an entry a line.
_WIDTH = 120
# Keys of a scene that name files.
FILE_KEYS = ("file", "grid", "over")


def write_scene(scene: Scene, path: str | Path, *, force: bool = False) -> None:
    """Write what a scene says as TOML; ``load_scene`` reads the same again. Files are named relative to the new one.

    Args:
        scene: what to write.
        path: file to write, .toml.
        force: replace a file that is there already.

    Raises:
        InputError: the name has another ending, or the file exists.
        EnvironmentFailedError: the file cannot be written.
    """
    path = Path(path)
    require_scene_file(path, force=force)
    # Resolved, as the system finds what is above a folder that is a link.
    data = _relative(scene.model_dump(mode="json", exclude_unset=True, exclude_none=True), path.parent.resolve())
    try:
        with whole_file(path) as unfinished:
            unfinished.write_text(format_tables(data), encoding="utf-8", newline="\n")
    except OSError as error:
        raise EnvironmentFailedError(f"{path}: cannot write the scene: {error.strerror or error}") from error


def require_scene_file(path: Path, *, force: bool) -> None:
    """Raise InputError where a name is not that of a scene file, or there is one already that may not be replaced."""
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: a scene file ends in .toml")
    refuse_to_replace(path, force=force)


def format_tables(data: Mapping[str, Any]) -> str:
    """Return the tables of a scene as TOML: values, then tables, then lists of tables."""
    tables = {key: value for key, value in data.items() if isinstance(value, Mapping)}
    lists = {key: value for key, value in data.items() if _is_list_of_tables(value)}
    lines = _lines({key: value for key, value in data.items() if key not in tables | lists})
    for key, table in tables.items():
        # Materials are tables by name.
        named = (
            {f"{key}.{_key(name)}": entry for name, entry in table.items()}
            if key == "materials"
            else {_key(key): table}
        )
        for header, entry in named.items():
            lines += ["", f"[{header}]", *_lines(entry)]
    for key, entries in lists.items():
        for entry in entries:
            lines += ["", f"[[{_key(key)}]]", *_lines(entry)]
    return "\n".join(lines).lstrip("\n") + "\n"


def _relative(node: Any, folder: Path) -> Any:
    """Name the files in tables relative to a folder."""
    if isinstance(node, list):
        return [_relative(entry, folder) for entry in node]
    if not isinstance(node, Mapping):
        return node
    return {
        key: Path(os.path.relpath(Path(value).resolve(), folder)).as_posix()
        if key in FILE_KEYS and isinstance(value, str)
        else _relative(value, folder)
        for key, value in node.items()
    }


def _is_list_of_tables(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(isinstance(entry, Mapping) for entry in value)


def _lines(table: Mapping[str, Any]) -> list[str]:
    return [f"{_key(key)} = {_value(value, len(key) + 3)}" for key, value in table.items()]


def _key(key: str) -> str:
    bare = key.isascii() and all(c.isalnum() or c in "_-" for c in key) and key
    return key if bare else _text(key)


def _value(value: Any, used: int = 0) -> str:
    """Write a value, on one line if it fits behind so many characters."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        # The shortest decimals that read back as the same number.
        return repr(value)
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items())
        return f"{{ {inside} }}" if inside else "{}"
    entries = [_value(entry) for entry in value]
    line = f"[{', '.join(entries)}]"
    return line if used + len(line) <= _WIDTH else "[\n" + "".join(f"    {entry},\n" for entry in entries) + "]"


def _text(text: str) -> str:
    # As in JSON, but for one control character that JSON leaves as it is.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
