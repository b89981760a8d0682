"""What an interactive simulation starts from: the tables of a scene, which are changed as those of a scene file are."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..plan import Plan, plan_scene
from ..scene import Scene
from ..scenefile import entry_of, set_key, validate_scene
from ..scenewriter import FILE_KEYS
from ..stepping import capture_lock

Tables = dict[str, Any]

# What there is when no scene is given: the cube of the thesis "Gelatin Cubes" (USI, 2023) over a floor.
DEFAULT_TABLES: Tables = {
    "name": "jelly",
    "solver": {"dt": 5e-4},
    "materials": {
        "jelly": {
            "particle_mass": 0.01,
            "structural": {"stiffness": 100.0, "damping": 0.2},
            "shear": {"stiffness": 100.0, "damping": 0.2},
            "bend": {"stiffness": 100.0, "damping": 0.2},
        }
    },
    "bodies": [
        {
            "name": "cube",
            "type": "cube",
            "material": "jelly",
            "position": [0.0, 1.4, 0.0],
            "rotation": [0.0, 25.0, 10.0],
        }
    ],
    "colliders": [{"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [10.0, 10.0], "damping": 10.0}],
}
# Each change builds all bodies anew, which takes seconds for so many.
MOST_PARTICLES = 2_000_000
# What a new collider is unless something else is said of it, by type; directions and places are for Y up.
DEFAULT_COLLIDERS: dict[str, Tables] = {
    "plane": {"center": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]},
    "sphere": {"center": [0.0, 0.5, 0.0], "radius": 0.5},
    "half_space": {"center": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0]},
    "box": {"center": [0.0, 2.5, 0.0], "size": [5.0, 5.0, 5.0]},
}


@dataclass(frozen=True)
class SetUp:
    """A scene at time zero, as its tables, validated and planned. Set-ups are never changed: an edit makes another."""

    tables: Tables
    """What a scene file would say; not to be changed."""
    folder: Path
    """What relative paths in the tables are relative to."""
    scene: Scene
    """The same, validated."""
    plan: Plan
    """How its bodies are made."""

    @classmethod
    def of(cls, tables: Tables, folder: Path, known: Plan | None = None) -> SetUp:
        """Validate and plan tables.

        Args:
            tables: as from a scene file.
            folder: what relative paths are relative to.
            known: see ``plan_scene``.

        Raises:
            InputError: something is wrong with them; the message names the key and the value.
        """
        scene = validate_scene(tables, folder)
        if scene.output.over is not None:
            raise InputError("output.over: a run over a shot goes with `warpjelly run`, not with an interactive scene")
        # Voxelising launches kernels, which must not get into a graph that another thread captures.
        with capture_lock:
            plan = plan_scene(scene, known)
        if plan.particle_count > MOST_PARTICLES:
            raise InputError(
                f"{plan.particle_count:,} particles are more than the {MOST_PARTICLES:,} that can be changed while "
                "they move; lower the resolution or the particles per edge, or use `warpjelly run`"
            )
        return cls(tables, folder, scene, plan)

    @classmethod
    def from_scene(cls, scene: Scene) -> SetUp:
        """Return the set-up of a scene, without what it expects of itself: that belongs to the scene as it was.

        Raises:
            InputError: the scene cannot be built.
        """
        tables = scene.model_dump(mode="json", exclude_unset=True, exclude_none=True)
        tables.pop("expect", None)
        return cls.of(tables, Path.cwd())

    def edited(self, edit: Callable[[Tables], None]) -> SetUp:
        """Return the set-up whose tables were changed.

        Args:
            edit: changes a copy of the tables.

        Raises:
            InputError: what comes of it is no scene, or cannot be built.
        """
        tables = copy.deepcopy(self.tables)
        edit(tables)
        return SetUp.of(tables, self.folder, self.plan)

    def with_files(self, place: Callable[[Path], Path]) -> SetUp:
        """Return the set-up with its files elsewhere.

        Args:
            place: says for each file where it is.
        """

        def moved(node: Any) -> Any:
            if isinstance(node, list):
                return [moved(entry) for entry in node]
            if not isinstance(node, dict):
                return node
            return {
                key: str(place(Path(value))) if key in FILE_KEYS and isinstance(value, str) else moved(value)
                for key, value in node.items()
            }

        tables = self.scene.model_dump(mode="json", exclude_unset=True, exclude_none=True)
        return replace(self, tables=(files := moved(tables)), scene=validate_scene(files, self.folder))


def change_keys(tables: Tables, changes: Mapping[str, Any]) -> None:
    """Set values by dotted key; None for what is not said."""
    for key, value in changes.items():
        set_key(tables, key, value)


def change_material(tables: Tables, body: str, changes: Mapping[str, Any]) -> None:
    """Change the material of one body alone: what it shares with others becomes its own first."""
    entry = entry_named(tables, "bodies", body)
    name = entry["material"]
    users = list(_materials_in(tables))
    if users.count(name) > 1:
        own = free_name(body, [*tables["materials"], *users])
        tables["materials"][own] = copy.deepcopy(tables["materials"][name])
        entry["material"] = name = own
    change_keys(tables, {f"materials.{name}.{key}": value for key, value in changes.items()})


def add_entry(tables: Tables, kind: str, entry: Mapping[str, Any]) -> str:
    """Add a body or a collider, and return its name: that of the entry, or one that is free."""
    entries = tables.setdefault(kind, [])
    taken = [other["name"] for other in entries]
    added = {"name": free_name(str(entry.get("type", "entry")), taken), **copy.deepcopy(dict(entry))}
    entries.append(added)
    return str(added["name"])


def delete_entry(tables: Tables, kind: str, name: str) -> None:
    """Delete a body or a collider, and materials that nothing else is made of."""
    before = set(_materials_in(tables))
    tables[kind].remove(entry_named(tables, kind, name))
    if kind == "bodies" and not tables[kind]:
        raise InputError(f"bodies.{name}: the only body; add another one before it is deleted")
    for unused in before - set(_materials_in(tables)):
        del tables["materials"][unused]


def entry_named(tables: Tables, kind: str, name: str) -> Tables:
    """Return the table of a body or a collider.

    Raises:
        InputError: there is none of this name.
    """
    entries: list[Tables] = tables.get(kind, [])
    return entries[entry_of(entries, name, kind)]


def move_start(tables: Tables, name: str, displacement: Iterable[float]) -> None:
    """Move where a body starts by a displacement [3], m."""
    entry, by = entry_named(tables, "bodies", name), list(displacement)
    if "positions" in entry:
        entry["positions"] = [_sum(place, by) for place in entry["positions"]]
    else:
        entry["position"] = _sum(entry.get("position", [0.0, 0.0, 0.0]), by)


def _sum(a: Iterable[float], b: Iterable[float]) -> list[float]:
    return [float(p + q) for p, q in zip(a, b, strict=True)]


def free_name(wish: str, taken: Iterable[str]) -> str:
    """Return a name that is not taken: what is wished, or that with a number."""
    used = set(taken)
    return next(
        name for name in itertools.chain([wish], (f"{wish}_{i}" for i in itertools.count(2))) if name not in used
    )


def _materials_in(tables: Tables) -> Iterable[str]:
    """Yield the material of each body and region."""
    for body in tables["bodies"]:
        yield body["material"]
        for region in body.get("regions", []):
            yield region["material"]
