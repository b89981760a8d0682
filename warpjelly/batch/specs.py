"""What the SPECs of a batch name: scene files, folders of them, sweeps, and scenes made in Python."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..scene import Scene
from ..scenefile import identifier, load_scene, read_toml
from ..worldfile import SUFFIX
from .sweep import MAX_NAME, Sweep, is_sweep, read_sweep, run_names

Spec = str | Path | Sweep | Mapping[str, Scene]
"""A scene file, a folder of them, a sweep file; a sweep; or scenes by the names of their runs."""

_SUFFIXES = (".toml", SUFFIX)
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+=,-]*")
# What a batch keeps beside its runs, and what some systems take for devices.
RECORD_NAME, TABLE_NAME = "batch.json", "batch.csv"
PAGE_NAME, COMPARISON_NAME = "index.html", "comparison.usda"
_RESERVED = {RECORD_NAME, TABLE_NAME, PAGE_NAME, COMPARISON_NAME, "run.lock"}
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{number}" for port in ("com", "lpt") for number in range(1, 10))}


@dataclass(frozen=True)
class Entry:
    """One run that a batch is to have."""

    name: str
    """Of its run directory."""
    source: str
    """The SPEC or the file that it is from."""
    scene: Scene | None
    """What it simulates; None where there is no such scene."""
    problem: str | None = None
    """What is wrong, then."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """What distinguishes it from other runs of its sweep, by name."""


def read_specs(
    specs: Sequence[Spec], *, overrides: Mapping[str, Any] | None = None, frames: int | None = None
) -> list[Entry]:
    """Find out which runs a batch is to have, in order.

    A scene that is not sound becomes an entry that says why, unless all are like that.

    Args:
        specs: see ``Spec``.
        overrides: values by dotted key, for all runs; see ``load_scene``.
        frames: number of samples of all runs, as for ``load_scene``.

    Raises:
        InputError: a SPEC is not there, a sweep is not sound, no scene is, or a name cannot be that of a folder or
            is that of two runs.
    """
    overrides = dict(overrides or {})
    entries = [entry for spec in specs for entry in _entries_of(spec, overrides, frames)]
    if not entries:
        raise InputError("nothing to run: name a scene file, a folder of scene files or a sweep file")
    entries = _told_apart(entries)
    for entry in entries:
        if why := _unusable(entry.name):
            raise InputError(f"{entry.source}: a run cannot be called '{entry.name}': {why}")
    if problems := [entry.problem for entry in entries if entry.problem is not None]:
        others = f" (and {len(problems) - 1} other runs are not sound)" if len(problems) > 1 else ""
        if len(problems) == len(entries):
            raise InputError(f"{problems[0]}{others}")
    return entries


def default_output(specs: Sequence[Spec], entries: Sequence[Entry]) -> Path:
    """Return the folder of a batch that was not told where to go: that of the only sweep file or folder of scenes."""
    name = "batch"
    if len(specs) == 1 and isinstance(specs[0], str | Path):
        path = Path(specs[0]).resolve()
        # A scene by itself has its run directory there.
        name = path.name if path.is_dir() else path.stem if entries[0].parameters else name
    return Path("outputs") / name


def _entries_of(spec: Spec, overrides: dict[str, Any], frames: int | None) -> Iterator[Entry]:
    if isinstance(spec, Mapping):
        for name, scene in spec.items():
            yield Entry(name, "scenes", scene)
    elif isinstance(spec, Sweep):
        yield from _entries_of_sweep(spec, "sweep", overrides, frames)
    elif (path := Path(spec)).is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES and file.is_file())
        if not files:
            raise InputError(f"{path}: no scene in this folder; scenes are {' and '.join(_SUFFIXES)} files")
        for file in files:
            yield from _entries_of_file(file, overrides, frames)
    else:
        if not path.is_file():
            raise InputError(f"{path}: no such file or folder")
        yield from _entries_of_file(path, overrides, frames)


def _entries_of_file(path: Path, overrides: dict[str, Any], frames: int | None) -> Iterator[Entry]:
    try:
        swept = path.suffix.lower() != SUFFIX and is_sweep(read_toml(path))
        scene = None if swept else load_scene(path, overrides=overrides, frames=frames)
    except InputError as error:
        yield Entry(identifier(path.stem), str(path), None, str(error))
        return
    if scene is not None:
        yield Entry(scene.name, str(path), scene)
    else:
        yield from _entries_of_sweep(read_sweep(path), str(path), overrides, frames)


def _entries_of_sweep(sweep: Sweep, source: str, overrides: dict[str, Any], frames: int | None) -> Iterator[Entry]:
    for key in [*overrides, *(("frames", "duration") if frames is not None else ())]:
        if name := sweep.varied_by(key):
            raise InputError(f"{source}: {key}: the sweep varies it ('{name}'), so it cannot be set as well")
    try:
        names = run_names(sweep)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    for name, row in zip(names, sweep.rows(), strict=True):
        scene, problem = None, None
        try:
            scene = load_scene(sweep.base, overrides=sweep.overrides(row, overrides), frames=frames)
        except InputError as error:
            problem = f"{source}: {error}"
        yield Entry(name, source, scene, problem, row)


def _told_apart(entries: list[Entry]) -> list[Entry]:
    """Put the name of the folder, or of the sweep, before names that several runs have.

    Raises:
        InputError: that does not tell them apart.
    """
    for attempt in range(2):
        seen: dict[str, list[Entry]] = {}
        for entry in entries:
            # Some file systems make no difference between upper and lower case.
            seen.setdefault(entry.name.casefold(), []).append(entry)
        alike = [group for group in seen.values() if len(group) > 1]
        if not alike:
            break
        first, second, *_ = alike[0]
        if attempt:
            raise InputError(
                f"two runs are called '{first.name}', of {first.source} and of {second.source}; rename one"
            )
        doubled = {id(entry) for group in alike for entry in group}
        entries = [
            replace(entry, name=f"{_origin(entry)}_{entry.name}") if id(entry) in doubled else entry
            for entry in entries
        ]
    return entries


def _origin(entry: Entry) -> str:
    path = Path(entry.source).resolve()
    return identifier(path.stem if entry.parameters else path.parent.name)


def _unusable(name: str) -> str | None:
    """Say why a run directory cannot have a name."""
    if re.search(r"[/\\]", name) or name in (".", ".."):
        return "its folder would not be in that of the batch; names have no / or \\"
    if not _NAME.fullmatch(name) or name.endswith("."):
        return "names are of letters without accents, digits and _ . + - = , and begin with one of the first three"
    if len(name) > MAX_NAME:
        return f"names have at most {MAX_NAME} characters"
    if name.casefold() in _RESERVED or name.casefold().split(".")[0] in _DEVICES:
        return "this name is reserved"
    return None
