"""Read a scene file: TOML or a CMU world, overrides, and errors that people can act on."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from .errors import InputError
from .scene import Scene, Table
from .worldfile import SUFFIX, read_world, settle_time


def load_scene(path: str | Path, *, overrides: Mapping[str, Any] | None = None, frames: int | None = None) -> Scene:
    """Read and validate a scene file.

    Args:
        path: TOML file, or a jello cube world, .w.
        overrides: values by dotted key, for example ``{"solver.dt": 5e-4, "bodies.0.size": 2.0}``; an entry of a list
            goes by its number or its name. ``frames`` comes instead of ``duration``, and the other way round.
        frames: number of samples, instead of the scene's frames or duration. What the scene expects of itself goes with
            its own length, and is left out.

    Raises:
        InputError: the file cannot be read, or is not what its name says; the message names the file and the key and
            value, or the line.
    """
    path, overrides = Path(path), overrides or {}
    if path.suffix.lower() == SUFFIX:
        data = read_world(path)
        overrides = settle_time(path, data, overrides)
    else:
        data = read_toml(path)
    for length, other in (("frames", "duration"), ("duration", "frames")):
        if length in overrides:
            data.pop(other, None)
    for key, value in overrides.items():
        try:
            set_key(data, key, value)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    if frames is not None:
        data.pop("duration", None)
        data["frames"] = frames
        data.pop("expect", None)
    data.setdefault("name", identifier(path.stem))
    return read_scene(data, path)


def read_scene(data: dict[str, Any], path: Path) -> Scene:
    """Validate the tables of a scene.

    Args:
        data: tables and values by key, as from a scene file.
        path: the file that errors name, and that relative paths are relative to.

    Raises:
        InputError: as for ``load_scene``.
    """
    try:
        return validate_scene(data, path.parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def validate_scene(data: Mapping[str, Any], folder: Path) -> Scene:
    """Validate the tables of a scene whose relative paths are relative to a folder.

    Raises:
        InputError: something is wrong with them; the message names the key and the value.
    """
    try:
        return Scene.model_validate(data, context={"folder": folder})
    except ValidationError as error:
        # Here, because it imports this module.
        from .batch.sweep import is_sweep

        what = "a sweep, whose runs are done by 'warpjelly batch'" if is_sweep(data) else explain(error, Scene)
        raise InputError(what) from error


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        InputError: it cannot be read, or is not TOML.
    """
    hint = ""
    if path.suffix.lower() != ".toml":
        hint = "; a scene is a .toml or a .w file, which names models and is not one itself"
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file: {error.reason} at byte {error.start}{hint}") from error
    # TOML's own errors are among these, and numbers of thousands of digits.
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}{hint}") from error
    except RecursionError as error:
        raise InputError(f"{path}: not valid TOML: lists or tables are nested too deep") from error
    except OSError as error:
        raise InputError(f"{path}: cannot read the scene: {error.strerror}{hint}") from error


def set_key(data: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key in the tables of a scene, making tables on the way; see ``load_scene``.

    Raises:
        InputError: the key leads nowhere.
    """
    *parents, last = key.split(".")
    node: Any = data
    for part in parents:
        if isinstance(node, list):
            node = node[entry_of(node, part, key)]
        elif isinstance(node, dict):
            node = node.setdefault(part, {})
        else:
            raise InputError(f"{key}: '{part}' is inside a value that is not a table")
    if isinstance(node, list):
        node[entry_of(node, last, key)] = value
    elif isinstance(node, dict):
        node[last] = value
    else:
        raise InputError(f"{key}: '{last}' is inside a value that is not a table")


def entry_of(entries: list[Any], part: str, key: str) -> int:
    """Return the position of a list entry given by its number or its name, also one that it gets for having none.

    Raises:
        InputError: there is none; the message names the key that asks for it.
    """
    names = [
        entry.get("name", f"{entry.get('type')}_{i}") if isinstance(entry, dict) else None
        for i, entry in enumerate(entries)
    ]
    if part in names:
        return names.index(part)
    if part in (numbers := [str(i) for i in range(len(entries))]):
        return numbers.index(part)
    known = [" to ".join(dict.fromkeys(numbers[:1] + numbers[-1:])), *names]
    raise InputError(f"{key}: no entry '{part}'; entries: {', '.join(filter(None, known)) or 'none'}")


def identifier(text: str) -> str:
    """Turn a file name into a valid name of a scene."""
    name = "".join(c if c.isascii() and (c.isalnum() or c == "_") else "_" for c in text)[:63]
    return name if name and not name[0].isdigit() else f"_{name}"


# What pydantic says in terms of Python, in terms of a scene.
_WORDS = {
    "tuple_type": "must be a list of numbers",
    "list_type": "must be a list",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "string_pattern_mismatch": "must be letters, digits and _, and not start with a digit",
    "too_short": "must not be empty",
}


def explain(error: ValidationError, root: type[Table]) -> str:
    """Say in one line what is wrong first with a file of such tables: key, value, what is allowed."""
    problems = error.errors(include_url=False)
    first = problems[0]
    context = first.get("ctx", {})
    value = first["input"]
    key = _key(first["loc"])
    what = _WORDS.get(first["type"], first["msg"]).replace("Input should", "must").replace("Value should", "must")
    if first["type"] == "too_long":
        what = f"must have at most {context['max_length']} entries"
    # Of a key that may be one of several things, all were tried.
    tried = [problem for problem in problems[1:] if _key(problem["loc"]) == key]
    if value is not None and not isinstance(value, Mapping):
        for problem in tried:
            what += ", or " + problem["msg"].removeprefix("Input should be ")
    if first["type"] == "list_type" and first["loc"][-1] in ("bodies", "colliders", "fields", "pinned", "regions"):
        header = ".".join(part for part in key.split(".") if not part.isdigit())
        what += f"; its tables are headed [[{header}]], with two brackets"
    if first["type"] in ("unknown_key", "scene"):
        key = ".".join(filter(None, [key, context["key"]]))
    if first["type"] == "unknown_key":
        message = f"{key}: unknown key; {what}"
    elif first["type"] == "missing" and isinstance(first["loc"][-1], int):
        *parents, _ = first["loc"]
        lacking = sum(problem["type"] == "missing" and list(problem["loc"][:-1]) == parents for problem in problems)
        needed = f"must have {len(value) + lacking} entries, not {len(value)}"
        return f"{_key(tuple(parents))} = {_shown(value)}: {needed}{_described(tuple(parents), root)}"
    elif first["type"] == "missing":
        message = f"{key}: missing; this key is required{_described(first['loc'], root)}"
    elif first["type"] == "union_tag_not_found":
        message = f"{key}.type: missing; this key is required"
    elif first["type"] == "union_tag_invalid":
        message = f"{key}.type = {context['tag']!r}: must be one of {context['expected_tags']}"
    elif first["type"] == "scene":
        message = f"{key} = {_shown(context['value'])}: {what}" if context["value"] is not None else f"{key}: {what}"
    elif isinstance(value, Mapping):
        message = f"{key}: {what}"
    else:
        message = f"{key} = {_shown(value)}: {what}{_described(first['loc'], root)}"
    others = len(problems) - 1 - len(tried)
    return message + (f" (and {others} more)" if others else "")


def _key(location: tuple[int | str, ...]) -> str:
    """Return the dotted key of an error, without the tags that pydantic adds for entries of lists and unions."""
    parts = [str(part) for part in location]
    if len(parts) > 2 and parts[0] in ("bodies", "colliders", "fields"):
        del parts[2]
    return ".".join(part for part in parts if "[" not in part and not part.startswith(("literal", "constrained")))


def _described(location: tuple[int | str, ...], root: type[Table]) -> str:
    """Return the description of the field at an error, in brackets."""
    tables = [root]
    description = None
    for part in location:
        if fields := [table.model_fields[part] for table in tables if part in table.model_fields]:
            description = fields[0].description
            tables = [table for field in fields for table in _tables_in(field.annotation)]
        elif tagged := [table for table in tables if part in _tags(table)]:
            tables = tagged
    return f" ({description})" if description else ""


def _tables_in(annotation: Any) -> list[type[Table]]:
    """Return the tables that a field's annotation mentions."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables_in(part)]


def _tags(table: type[Table]) -> tuple[str, ...]:
    """Return the values of ``type`` that select a table."""
    return get_args(table.model_fields["type"].annotation) if "type" in table.model_fields else ()


def _shown(value: Any) -> str:
    """Write a value as TOML would, cut when long."""
    try:
        text = json.dumps(value, ensure_ascii=False, default=str)
    # Numbers of thousands of digits and tables of thousands of levels.
    except (ValueError, RecursionError):
        text = "..."
    return text if len(text) <= 80 else text[:77] + "..."
