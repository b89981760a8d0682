"""Scenes written as TOML read back as the same."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import make_scene

from warpjelly.errors import EnvironmentFailedError
from warpjelly.scenefile import load_scene
from warpjelly.scenewriter import format_tables, write_scene

SCENES = sorted((Path(__file__).parents[1] / "scenes").glob("*.toml"))

VALUES = st.recursive(
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text("aZ0_- é.\"'", max_size=5), inner, max_size=3),
)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_scene_reads_back(path: Path, tmp_path: Path) -> None:
    """Write what a scene says elsewhere, and read the same scene, with the same files."""
    scene = load_scene(path)
    copy = tmp_path / "further" / "down" / path.name
    copy.parent.mkdir(parents=True)
    write_scene(scene, copy)

    def resolved(node: object) -> object:
        if isinstance(node, dict):
            return {key: resolved(value) for key, value in node.items()}
        if isinstance(node, list):
            return [resolved(entry) for entry in node]
        return node.resolve() if isinstance(node, Path) else node

    assert resolved(load_scene(copy).model_dump()) == resolved(scene.model_dump())


@given(st.dictionaries(st.text(min_size=1, max_size=5), VALUES, max_size=4))
def test_any_tables_are_toml(tables: dict[str, object]) -> None:
    """Read back strings, numbers to the last bit, lists and tables of any kind."""
    # Those of this key are headed one by one.
    tables.pop("materials", None)
    assert tomllib.loads(format_tables(tables)) == tables


def test_materials_are_headed_one_by_one() -> None:
    """Give each material a table of its own, as people write scenes."""
    text = format_tables({"name": "a", "materials": {"soft": {"law": "hooke"}, "firm": {"shear": {"damping": 0.1}}}})
    assert text.splitlines() == [
        *('name = "a"', "", "[materials.soft]", 'law = "hooke"', "", "[materials.firm]", "shear = { damping = 0.1 }")
    ]


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    """Say that the scene cannot be written, and why."""
    with pytest.raises(EnvironmentFailedError, match="cannot write the scene: No such file or directory"):
        write_scene(make_scene(), tmp_path / "none" / "scene.toml")
