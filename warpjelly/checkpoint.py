"""Save what changes in a run, and go on from there, bit for bit."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import platform
import zipfile
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .files import whole_file
from .model import State
from .readers.companions import files_of
from .scene import Scene
from .simulator import Simulator

# Of a scene, what may change between checkpoint and resumption: how long it is, and what is measured.
_FREE_KEYS = ("frames", "duration", "expect")
# What decides the last bits of a result besides the scene.
_PACKAGES = ("warpjelly", "warp-lang", "numpy")
# A value in a message is cut to this length.
_SHOWN = 60


@dataclass(frozen=True)
class Checkpoint:
    """A run after some frames."""

    frame_count: int
    """Frames that were finished; the state is that of the last of them."""
    scene: dict[str, Any]
    """What the scene says, by dotted key; see ``scene_keys``."""
    origin: dict[str, str]
    """What decides the last bits besides the scene; see ``origin_of``."""
    arrays: dict[str, np.ndarray]
    """What changes, by owner and name: ``state.x``, ``stage.bounds`` ..."""

    def part(self, owner: str) -> dict[str, np.ndarray]:
        """Return the arrays of one owner by their own names."""
        return {key.partition(".")[2]: array for key, array in self.arrays.items() if key.startswith(f"{owner}.")}

    def save(self, path: Path) -> None:
        """Write the file, which is either complete or as it was before.

        Raises:
            OSError: it cannot be written.
        """
        about = {"frame_count": self.frame_count, "scene": self.scene, "origin": self.origin}
        with whole_file(path) as unfinished:
            np.savez(unfinished, allow_pickle=False, about=np.array(json.dumps(about)), **self.arrays)


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        InputError: the file is not one.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = dict(data)
        about = json.loads(str(arrays.pop("about")))
        return Checkpoint(about["frame_count"], about["scene"], about["origin"], arrays)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a checkpoint that can be read: {error}; start anew with --force") from error


def state_arrays(sim: Simulator) -> dict[str, np.ndarray]:
    """Return all that changes in a simulation; on the CPU as views, which change with it."""
    return {field.name: getattr(sim.state, field.name).numpy() for field in fields(State)}


def restore_state(sim: Simulator, arrays: Mapping[str, np.ndarray]) -> None:
    """Put a simulation that was just built where another one was.

    Raises:
        InputError: the arrays are of another simulation.
    """
    for field in fields(State):
        array, saved = getattr(sim.state, field.name), arrays.get(field.name)
        shape = array.numpy().shape
        if saved is None or saved.shape != shape or saved.dtype != array.numpy().dtype:
            found = "missing" if saved is None else f"{saved.dtype} {saved.shape}"
            raise InputError(
                f"the checkpoint is of another simulation: {field.name} is {found}, not {array.numpy().dtype} {shape}; "
                "start anew with --force"
            )
        if array.size:
            array.assign(saved)
    sim.substep_count = int(arrays["step"][0])


def scene_keys(scene: Scene) -> dict[str, Any]:
    """Return what a scene says by dotted key, entries of lists by their names; of files, their names and contents."""
    resolved = scene.model_dump(mode="json", exclude_none=True)
    # All bodies from one shot name the same files, which may be large.
    contents = cache(_contents)
    return dict(_flattened({key: value for key, value in resolved.items() if key not in _FREE_KEYS}, contents))


def _flattened(
    node: Mapping[str, Any], contents: Callable[[Path], dict[str, str]], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, contents, f"{prefix}{key}.")
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            named = {str(entry.get("name", number)): entry for number, entry in enumerate(value)}
            yield from _flattened(named, contents, f"{prefix}{key}.")
        elif key in ("file", "grid", "over"):
            for name, content in contents(Path(value)).items():
                yield f"{prefix}{key}{name}", content
        else:
            yield f"{prefix}{key}", value


def _contents(path: Path) -> dict[str, str]:
    """Return the content of a file, whose key is empty, and of files that it names, whose keys are their names."""
    folder, digests = path.parent.resolve(), defaultdict[str, list[str]](list)
    for file in files_of(path):
        # Where a model has moved with all that is beside it, nothing has changed.
        place = file.parent.resolve() / file.name
        name = place.relative_to(folder).as_posix() if place.is_relative_to(folder) else file.name
        about = os.stat(file)
        digests[name].append(_digest(file, about.st_size, about.st_mtime_ns)[:16])
    return {
        "" if name == path.name else f" {name}": f"{name} (SHA-256 {', '.join(found)})"
        for name, found in digests.items()
    }


@functools.lru_cache(maxsize=1000)
def _digest(path: Path, size: int, time: int) -> str:
    """Return the SHA-256 of a file; the runs of a batch share models. A file that has changed has another time."""
    with open(path, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def scene_hash(scene: Scene) -> str:
    """Return what tells the results of a scene, made by this version, from any others; the name does not matter."""
    keys = {key: value for key, value in scene_keys(scene).items() if key != "name"}
    expect = scene.expect.model_dump(mode="json", exclude_none=True)
    told = {"scene": keys, "frames": scene.frame_count, "expect": expect, "version": version_of("warpjelly")}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


@functools.cache
def version_of(package: str) -> str:
    """Return the version of an installed package; looking for it takes milliseconds."""
    return metadata.version(package)


def origin_of(device: str) -> dict[str, str]:
    """Return what decides the last bits of a result besides the scene."""
    versions = {name: version_of(name) for name in _PACKAGES}
    return {"device": device, "machine": platform.machine(), **versions}


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Say what differs, one line for each key."""
    keys = sorted({*old, *new}, key=lambda key: [*new, *old].index(key))
    return [f"{key} was {_shown(old, key)} and is {_shown(new, key)}" for key in keys if old.get(key) != new.get(key)]


def _shown(values: Mapping[str, Any], key: str) -> str:
    text = json.dumps(values[key], ensure_ascii=False) if key in values else "not set"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
