"""Sweep files and other SPECs of a batch: which runs they name, and what is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from warpjelly.batch.specs import default_output, read_specs
from warpjelly.batch.sweep import Sweep, read_sweep, run_names
from warpjelly.errors import InputError
from warpjelly.scenefile import load_scene

SCENES = Path(__file__).parents[1] / "scenes"
CUBE = SCENES / "jello_cube.toml"
STIFFNESS = "materials.jelly.structural.stiffness"
DAMPING = "materials.jelly.structural.damping"


def write_sweep(folder: Path, text: str) -> Path:
    """Write a sweep file over the scene of the jello cube."""
    path = folder / "sweep.toml"
    path.write_text(f"base = '{CUBE}'\n{text}")
    return path


def rows(text: str, folder: Path) -> list[dict[str, object]]:
    """Return the values of the parameters of each run."""
    return list(read_sweep(write_sweep(folder, text)).rows())


def test_a_product_has_every_combination_and_a_zip_one_run_per_place(tmp_path):
    """Combine two and three values in both ways; the last parameter changes fastest."""
    vary = f'[vary]\n"{STIFFNESS}" = [10, 20]\n"{DAMPING}" = [0.1, 0.2, 0.3]\n'
    pairs = [tuple(row.values()) for row in rows(vary, tmp_path)]
    assert pairs == [(10, 0.1), (10, 0.2), (10, 0.3), (20, 0.1), (20, 0.2), (20, 0.3)]
    pairs = [tuple(row.values()) for row in rows('combine = "zip"\n' + vary.replace("10, 20", "1, 2, 3"), tmp_path)]
    assert pairs == [(1, 0.1), (2, 0.2), (3, 0.3)]


def test_ranges_have_both_ends_and_equal_steps_or_ratios(tmp_path):
    """Compare with the steps by hand; whole numbers stay whole, and steps have no digits of rounding."""
    assert [row["x"] for row in rows("[vary]\nx = { range = [0.1, 0.7], count = 7 }", tmp_path)] == [
        *(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
    ]
    assert [row["x"] for row in rows("[vary]\nx = { log_range = [1.0, 1000.0], count = 4 }", tmp_path)] == [
        1,
        10,
        100,
        1000,
    ]
    whole = [row["x"] for row in rows("[vary]\nx = { range = [8, 32], count = 4 }", tmp_path)]
    assert whole == [8, 16, 24, 32]
    assert all(isinstance(value, int) for value in whole)


def test_draws_follow_their_distributions_and_seeds(tmp_path):
    """Draw a thousand of each kind, twice.

    The mean of n draws with standard deviation s is within 5 s / sqrt(n) of the expected one, but for one time in a
    million.
    """
    kinds = {
        "uniform": ([2.0, 4.0], lambda x: x, 3.0, 2.0 / 12**0.5, (2.0, 4.0)),
        "log_uniform": ([1e-2, 1e2], np.log10, 0.0, 4.0 / 12**0.5, (1e-2, 1e2)),
        "normal": ([5.0, 2.0], lambda x: x, 5.0, 2.0, (-np.inf, np.inf)),
        "integers": ([1, 6], lambda x: x, 3.5, (35 / 12) ** 0.5, (1, 6)),
    }
    for kind, (pair, measure, mean, deviation, (least, most)) in kinds.items():
        text = f"[vary]\nx = {{ {kind} = {pair}, count = 1000 }}"
        drawn = [row["x"] for row in rows(f"seed = 3\n{text}", tmp_path)]
        assert drawn == [row["x"] for row in rows(f"seed = 3\n{text}", tmp_path)]
        assert drawn != [row["x"] for row in rows(f"seed = 4\n{text}", tmp_path)]
        assert least <= min(drawn) <= max(drawn) <= most
        measured = measure(np.array(drawn, float))
        assert abs(measured.mean() - mean) < 5 * deviation / 1000**0.5
        # The relative error of the deviation of n draws is 1 / sqrt(2 n) for the normal law, and less for the others.
        assert measured.std() == pytest.approx(deviation, rel=5 / 2000**0.5)
    assert set(drawn) == {1, 2, 3, 4, 5, 6}


def test_a_parameter_more_leaves_the_draws_of_the_others_alone(tmp_path):
    """Add a parameter before, and more draws after: the first ones stay."""
    few = [row["x"] for row in rows("[vary]\nx = { uniform = [0.0, 1.0], count = 3 }", tmp_path)]
    text = 'combine = "zip"\n[vary]\na = { uniform = [0.0, 1.0] }\nx = { uniform = [0.0, 1.0], count = 5 }'
    more = rows(text, tmp_path)
    assert [row["x"] for row in more][:3] == few
    assert [row["a"] for row in more] != [row["x"] for row in more]


def test_several_keys_get_one_value_and_settings_go_to_all_runs(tmp_path):
    """Vary the stiffness of all springs together, under a name, with another duration for all."""
    kinds = ("structural", "shear", "bend")
    keys = [f"materials.jelly.{kind}.stiffness" for kind in kinds]
    text = f"[set]\nduration = 0.5\nsolver.dt = 1e-3\n[vary.k]\nkeys = {keys}\nvalues = [10, 20]\n"
    entries = read_specs([write_sweep(tmp_path, text)], overrides={"solver.dt": 2e-3})
    assert [entry.name for entry in entries] == ["k-10", "k-20"]
    for entry, stiffness in zip(entries, (10, 20), strict=True):
        assert entry.parameters == {"k": stiffness}
        assert entry.scene is not None
        jelly = entry.scene.materials["jelly"]
        assert [getattr(jelly, kind).stiffness for kind in kinds] == [stiffness] * 3
        # What is asked for beside the sweep comes before what the sweep sets.
        assert (entry.scene.duration, entry.scene.solver.dt) == (0.5, 2e-3)


def test_runs_are_the_scenes_that_load_scene_gives(tmp_path):
    """Compare every scene of a sweep with the base and the same overrides, also entries of lists and whole vectors."""
    text = '[vary]\n"bodies.cube.position.1" = [1.5, 2.0]\n"bodies.0.rotation" = [[0.0, 0.0, 0.0], [0.0, 45.0, 0.0]]\n'
    for entry in read_specs([write_sweep(tmp_path, text)]):
        assert entry.scene == load_scene(CUBE, overrides=entry.parameters)


def test_a_sweep_expects_what_it_says_instead_of_its_base(tmp_path):
    """Expect what the sweep names alone, or, where it has no such table, what the base expects."""
    vary = f'[vary]\n"{STIFFNESS}" = [10, 20]\n'
    for text, expected in (
        ("", ["rest_height", "speed", "shape_error", "bounce"]),
        ("[expect]\nbounce.min = 0.1\n", ["bounce"]),
        ("[expect]\n", []),
    ):
        for entry in read_specs([write_sweep(tmp_path, text + vary)]):
            assert [key for key, _, _ in entry.scene.expect.items()] == expected


def test_frames_and_durations_replace_each_other(tmp_path):
    """Give the length of runs in the other unit than the base, whose own length it replaces."""
    vary = f'[vary]\n"{STIFFNESS}" = [10]\n'
    (entry,) = read_specs([write_sweep(tmp_path, "[set]\nframes = 7\n" + vary)])
    assert entry.scene.frame_count == 7
    with pytest.raises(InputError, match="frames"):
        load_scene(CUBE, overrides={"frames": 7, "duration": 1.0})


def test_names_are_made_from_values(tmp_path):
    """Make names by default, by the sweep's own text, and by number where values do not tell runs apart."""

    def names(text: str) -> list[str]:
        return run_names(read_sweep(write_sweep(tmp_path, text)))

    vary = f'[vary]\n"{STIFFNESS}" = [10, 20.5]\n"bodies.0.position.1" = [1]\n'
    assert names(vary) == ["stiffness-10_position.1-1", "stiffness-20.5_position.1-1"]
    both = f'[vary]\n"{STIFFNESS}" = [10]\n"materials.jelly.shear.stiffness" = [3]\n'
    assert names(both) == ["structural.stiffness-10_shear.stiffness-3"]
    assert names('name = "k{' + STIFFNESS + ':06.2f}_{number}"\n' + vary) == ["k010.00_1", "k020.50_2"]
    assert names('name = "{number}_{number:03}"\n[vary]\nx = { range = [1, 10], count = 10 }')[::9] == [
        "01_001",
        "10_010",
    ]
    assert names('[vary]\n"bodies.0.file" = ["../a/b.obj", "a b.obj"]') == ["file-.._a_b.obj", "file-a_b.obj"]
    assert names('[vary]\n"bodies.0.file" = ["a/b.obj", "a b.obj"]') == ["run_1", "run_2"]
    assert names('[vary]\n"bodies.0.file" = ["a.obj", "A.obj"]') == ["run_1", "run_2"]
    assert names(f'[vary]\n"{STIFFNESS}" = {{ range = [1, 10000], count = 10000 }}')[-1] == "stiffness-10000"
    assert names("[vary]\nx = [" + ", ".join(f"'{'x' * 99}{i:02}'" for i in range(12)) + "]")[-1] == "run_12"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[vary]\nx = 3", "vary.x = 3: give a list of values"),
        ("[vary]\nx = []", "vary.x.values = []: must not be empty"),
        ("[vary]\nx = { range = [1, 2] }", "vary.x.count: missing"),
        ("[vary]\nx = { range = [2, 1], count = 3 }", "vary.x.range = [2.0, 1.0]: the first number must be below"),
        ("[vary]\nx = { rnge = [1, 2], count = 3 }", "vary.x.rnge: unknown key; did you mean 'range'?"),
        ("[vary]\nx = { log_range = [0, 2], count = 3 }", "vary.x.log_range.0 = 0: must be greater than 0"),
        ("[vary]\nx = { uniform = [0, 2], range = [0, 2], count = 3 }", "give one of values, range"),
        ("[vary]\nx = { values = [1], count = 3 }", "vary.x.count = 3"),
        ("[vary]\nx = { uniform = [0, 2], count = 0 }", "vary.x.count = 0"),
        ("[vary]\nx = { range = [0, 2], count = 1 }", "vary.x.count = 1: a range has both its ends"),
        ('combine = "zip"\n[vary]\nx = { log_range = [1, 2] }\ny = [1]', "vary.x.count = 1: a range has both its ends"),
        ("[vary]\nx = [1, nan]", "vary.x.values.1 = NaN: no scene takes numbers that are not finite"),
        ("[vary]\nx = [[1, { y = -inf }]]", "vary.x.values.0 = "),
        ("[vary]\nx = { range = [0, 2], count = 10000 }\ny = [1, 2]", "makes 20,000 runs"),
        ('combine = "zip"\n[vary]\nx = [1, 2]\ny = [1, 2, 3]', "x has 2, y has 3"),
        ('combine = "zip"\n[vary]\nx = { uniform = [0, 1] }', "vary.x.count: missing"),
        ('combine = "sum"\n[vary]\nx = [1]', "combine = \"sum\": must be 'product' or 'zip'"),
        ("[vary]\nx = [1]\n[vary.y]\nkeys = ['x']\nvalues = [1]", "is what 'x' varies, too"),
        ("[vary]\nx = [1]\n[set]\nx = 1", "set.x = 1: is what 'x' varies"),
        ("[vary]\nx = [[1, 2]]\n[set]\nx.0 = 1", "set.x.0 = 1: is what 'x' varies"),
        ('[vary]\n"x.0" = [1]\n"x" = [[1, 2]]', "vary.x.0 = \"x.0\": is a part of what 'x' varies"),
        ("", "vary: missing; this key is required"),
        ("[vary]", "vary"),
        ("sed = 3\n[vary]\nx = [1]", "sed: unknown key; did you mean 'seed'?"),
        ('name = "{y}"\n[vary]\nx = [1]', "name = \"{y}\": no parameter 'y'; known: x, number"),
        ('name = "{x"\n[vary]\nx = [1]', 'name = "{x"'),
        ('name = "{number}"\n[vary]\nnumber = [1]', "{number} is that of the run"),
        ('name = "{x!r}"\n[vary]\nx = [1]', "{x} takes no conversion"),
        ('name = "{x:d}"\n[vary]\nx = [0.5]', "{x:d} cannot write 0.5"),
        ('name = "a"\n[vary]\nx = [1, 2]', "2 runs are called 'a'"),
        ('name = "../{x}"\n[vary]\nx = [1]', "cannot be called '../1': its folder would not be in that of the batch"),
        ('name = "/elsewhere/{x}"\n[vary]\nx = [1]', "cannot be called '/elsewhere/1'"),
        ('name = "a\\\\{x}"\n[vary]\nx = [1]', "its folder would not be in that of the batch"),
        ('name = "..{x}"\n[vary]\nx = [""]', "cannot be called '..'"),
        ('name = "{x}"\n[vary]\nx = ["a."]', "names are of letters"),
        ('name = ".{x}"\n[vary]\nx = [1]', "names are of letters"),
        ('name = "b{x}"\n[vary]\nx = ["atch.json"]', "'batch.json': this name is reserved"),
        ('name = "Index.{x}"\n[vary]\nx = ["html"]', "this name is reserved"),
        ('name = "aux.{x}"\n[vary]\nx = [1]', "this name is reserved"),
        ('name = "' + 200 * "a" + '{x}"\n[vary]\nx = [1]', "at most 100 characters"),
    ],
)
def test_wrong_sweeps_get_one_line(tmp_path, text, said):
    """Name the file, the key and the value, and say what is allowed."""
    path = write_sweep(tmp_path, text)
    with pytest.raises(InputError) as error:
        read_specs([path])
    assert str(error.value).startswith(f"{path}: ")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_base_that_is_not_there_or_a_key_that_no_run_can_have_is_refused(tmp_path):
    """Refuse sweeps of which no run is sound, by what is wrong with the first, and settings of what is varied."""
    path = tmp_path / "sweep.toml"
    path.write_text('base = "nothing.toml"\n[vary]\nx = [1, 2]')
    with pytest.raises(InputError, match=r"nothing.toml: cannot read .* \(and 1 other runs are not sound\)"):
        read_specs([path])
    path = write_sweep(tmp_path, '[vary]\n"solver.precison" = [1e-3, 2e-3]')
    with pytest.raises(InputError, match=r"jello_cube.toml: solver.precison: unknown key; did you mean 'precision'\?"):
        read_specs([path])
    path = write_sweep(tmp_path, '[vary]\n"solver.dt" = [1e-3, 2e-3]')
    with pytest.raises(InputError, match=r"sweep.toml: solver.dt: the sweep varies it"):
        read_specs([path], overrides={"solver.dt": 1e-4})
    path = write_sweep(tmp_path, '[vary]\nduration = [1.0, 2.0]\n"bodies.cube.position" = [[0.0, 2.0, 0.0]]')
    for asked in ({"frames": 3}, {"overrides": {"duration": 3.0}}, {"overrides": {"bodies.cube.position.1": 3.0}}):
        with pytest.raises(InputError, match=r"sweep.toml: (duration|bodies.cube.position.1): the sweep varies it"):
            read_specs([path], **asked)


def test_one_wrong_value_is_a_problem_of_its_run_alone(tmp_path):
    """Keep the sound runs of a sweep, and say of the other what is wrong."""
    sound, wrong = read_specs([write_sweep(tmp_path, f'[vary]\n"{STIFFNESS}" = [10, -1]')])
    assert sound.problem is None
    assert wrong.scene is None
    assert f"{STIFFNESS} = -1: must be greater than or equal to 0" in str(wrong.problem)


def test_folders_give_their_scenes_and_equal_names_get_their_folders(tmp_path):
    """Read a folder with two scenes, a sweep and other files; then scenes of the same name in two folders."""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cube.toml").write_text(CUBE.read_text())
    (tmp_path / "a" / "broken.toml").write_text("materials.m = {}\nbodies = 3")
    (tmp_path / "a" / "notes.txt").write_text("no scene")
    write_sweep(tmp_path / "a", '[vary]\n"solver.dt" = [1e-3, 2e-3]')
    broken, cube, *swept = read_specs([tmp_path / "a"])
    assert (broken.name, cube.name, [entry.name for entry in swept]) == ("broken", "cube", ["dt-0.001", "dt-0.002"])
    assert "bodies = 3: must be a list" in str(broken.problem)
    cubes = read_specs([tmp_path / "a" / "cube.toml", tmp_path / "b" / "cube.toml"])
    assert [entry.name for entry in cubes] == ["a_cube", "b_cube"]
    (tmp_path / "b" / "cube.toml").write_text("name = 'CUBE'\n" + CUBE.read_text())
    cubes = read_specs([tmp_path / "a" / "cube.toml", tmp_path / "b" / "cube.toml"])
    assert [entry.name for entry in cubes] == ["a_cube", "b_CUBE"]
    with pytest.raises(InputError, match="two runs are called 'a_cube'"):
        read_specs([tmp_path / "a" / "cube.toml"] * 2)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no scene in this folder"):
        read_specs([tmp_path / "empty"])
    with pytest.raises(InputError, match="no such file or folder"):
        read_specs([tmp_path / "nothing"])


def test_sweeps_and_scenes_can_be_made_in_python():
    """Give a sweep and scenes by name instead of files."""
    sweep = Sweep(base=CUBE, vary={"solver.dt": [1e-3, 2e-3]})
    scene = load_scene(CUBE)
    entries = read_specs([sweep, {"whole": scene}])
    assert [entry.name for entry in entries] == ["dt-0.001", "dt-0.002", "whole"]
    assert entries[2].scene is scene
    whole = {"bodies.cube.position": [0.0, 1.0, 0.0]}
    sweep = Sweep(base=CUBE, vary={"bodies.cube.position.1": [2.0, 3.0]}, set=whole)
    places = [entry.scene.bodies[0].position for entry in read_specs([sweep]) if entry.scene is not None]
    assert [list(place) for place in places] == [[0.0, 2.0, 0.0], [0.0, 3.0, 0.0]]
    # What a run changes of it stays with the run.
    assert sweep.set == {"bodies.cube.position": [0.0, 1.0, 0.0]}
    with pytest.raises(InputError, match=r"cannot be called '\.\./x'"):
        read_specs([{"../x": scene}])


def test_a_batch_goes_where_its_only_sweep_or_folder_says(tmp_path):
    """Find the default folder for a sweep, a folder, a scene and two of them."""
    sweep = write_sweep(tmp_path, "[vary]\n'solver.dt' = [1e-3]")
    for specs, name in (([sweep], "sweep"), ([tmp_path], tmp_path.name), ([CUBE], "batch"), ([sweep, CUBE], "batch")):
        assert default_output(specs, read_specs(specs)) == Path("outputs") / name


def test_the_sweep_of_the_readme_is_sound(tmp_path):
    """Read the sweep that the README shows: four heights, three dampings, two rotations, three stiffnesses."""
    readme = (SCENES.parent / "README.md").read_text()
    (text,) = re.findall(r"```toml\n(base = .*?)```", readme, re.DOTALL)
    (tmp_path / "cube.toml").write_text(CUBE.read_text())
    (tmp_path / "sweep.toml").write_text(text)
    entries = read_specs([tmp_path / "sweep.toml"])
    assert len(entries) == 4 * 3 * 2 * 3
    assert all(entry.problem is None for entry in entries)


def test_the_sweeps_beside_the_scenes_are_sound():
    """Read every one."""
    paths = list((SCENES / "sweeps").glob("*.toml"))
    assert paths
    assert all(entry.problem is None for entry in read_specs(paths))


def test_the_schema_for_editors_is_current():
    """Compare with the model; `python -m warpjelly.batch.sweep > scenes/sweeps/schema.json` renews it."""
    assert json.loads((SCENES / "sweeps" / "schema.json").read_text()) == Sweep.model_json_schema()
