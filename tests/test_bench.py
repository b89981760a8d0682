import dataclasses
import json
import math
import os
import sys
import time
from importlib import import_module, util
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from test_cli import one_line, warpjelly  # noqa: F401 -- a fixture

from warpjelly import bench
from warpjelly.simulator import Simulator

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
import contenders
import peers

FIELDS = {field.name for field in dataclasses.fields(bench.Figures)}
REPORT_KEYS = {
    *("device", "device_name", "cores", "python", "warpjelly", "warp-lang", "numpy"),
    *("rounds", "scenes", "baseline", "regressions"),
}


def write_baseline(path: Path, ratio: float, device: str = "cpu") -> Path:
    """Write a baseline of 4 cores in which each scene used 2 and has some ratio to the reference kernel."""
    scenes = {name: {"reference_ratio": ratio, "cores_used": 2.0} for name in bench.SCENES}
    path.write_text(json.dumps({"device": device, "device_name": "a processor", "cores": 4, "scenes": scenes}))
    return path


def figures_of(ratio: float) -> bench.Figures:
    """Return figures with some ratio to the reference kernel, which are otherwise empty."""
    return bench.Figures(**{**dict.fromkeys(FIELDS), "reference_ratio": ratio})


def test_figures_are_finite_and_consistent():
    """Derive rates from times, and keep medians within their ranges and shares below 1."""
    figures = bench.measure(bench.Cubes(3, count=2), "cpu", 3, time.time())
    values = dataclasses.asdict(figures)
    assert all(math.isfinite(number) for value in values.values() for number in np.atleast_1d(value))
    sim = Simulator(bench.Cubes(3).scene(), device="cpu")
    assert (figures.particles, figures.springs) == (2 * 27, 2 * sim.model.spring_count)
    assert figures.springs_per_second == pytest.approx(figures.springs / figures.seconds_per_substep, rel=1e-12)
    assert figures.substeps_per_second == pytest.approx(1.0 / figures.seconds_per_substep, rel=1e-12)
    for name in ("springs_per_second", "reference_ratio"):
        low, high = values[f"{name}_range"]
        assert 0.0 < low <= values[name] <= high
    assert figures.contact_share < 1.0
    assert figures.pair_share < 1.0
    assert figures.integration_share > 0.0
    assert figures.first_frame_seconds > 0.0


def test_figures_are_the_ratios_that_they_are_called(monkeypatch):
    """Put each variant above or below the line where it belongs, given how long each takes."""
    seconds = {"free": 2.0, "reference": 30.0, "rk4": 9.0, "dust": 0.5, "ground": 2.5, "standing": 2.0,
               "touching": 4.0, "beside": 3.0, "singles": 3.0}  # fmt: skip
    slices = {name: bench.Slice(each, 2.0 if name == "free" else 1.0) for name, each in seconds.items()}
    monkeypatch.setattr(bench, "time_in_turn", lambda variants, **_: {name: [slices[name]] * 2 for name in variants})
    runs = {1: bench.Slice(3.0, 2.0), 2: bench.Slice(12.0, 1.0)}
    monkeypatch.setattr(bench, "time_runs", lambda scenes, **_: runs[len(scenes)])
    figures = bench.measure(bench.Cubes(2, count=2), "cpu", 2, time.time() - 100.0)
    assert (figures.seconds_per_substep, figures.substeps_per_second, figures.cores_used) == (2.0, 0.5, 2.0)
    assert figures.springs_per_second == figures.springs / 2.0
    assert (figures.reference_ratio, figures.rk4_ratio) == (15.0, 4.5)
    assert (figures.integration_share, figures.pair_share) == (0.25, 0.25)
    assert figures.contact_share == pytest.approx(0.2)
    assert (figures.at_once_ratio, figures.at_once_core_ratio) == (1.5, 0.75)
    assert (figures.runs_at_once_ratio, figures.runs_at_once_core_ratio) == (4.0, 2.0)
    assert figures.first_frame_seconds >= 100.0


def test_one_body_has_no_neighbours():
    """Leave out what needs several bodies."""
    figures = bench.measure(bench.Cubes(2), "cpu", 1, time.time())
    assert (figures.pair_share, figures.at_once_ratio, figures.runs_at_once_ratio) == (None, None, None)


def test_bodies_touch_what_they_are_measured_with():
    """Stand every cube on the floor, and beside others with all opposite particles overlapping."""
    cubes = bench.Cubes(4, count=4)
    ground = Simulator(cubes.scene(pinned=True, colliders=bench.COLLIDERS), device="cpu")
    ground.step(2)
    # The lowest layers, of 16 particles each, touch the floor and nothing else.
    assert ground.diagnostics()["contacts"] == 4 * 16
    touching = Simulator(cubes.scene(gap=0.9 / 3, pinned=True, soft_contact={}), device="cpu")
    touching.step(2)
    # Two sides of each cube, that share an edge of 4.
    assert touching.diagnostics()["contacts"] == 4 * (2 * 16 - 4)
    apart = Simulator(cubes.scene(), device="cpu")
    apart.step(2)
    assert apart.diagnostics()["contacts"] == 0


def test_twins_move_the_same_particles():
    """Step a simulator's own arrays by another integrator, as a simulator of its own would."""
    cubes, rk4 = bench.Cubes(3), {"solver": {"integrator": "rk4"}}
    sim, alone = Simulator(cubes.scene(), device="cpu"), Simulator(cubes.scene(**rk4), device="cpu")
    stretched = np.ascontiguousarray(1.01 * alone.positions.T)
    for each in (sim, alone):
        each.state.x.assign(stretched)
    bench.twin(sim, cubes.scene(**rk4))(25)
    alone.step(25)
    np.testing.assert_array_equal(sim.positions, alone.positions)


def test_everything_has_its_turn_in_every_round():
    """Time the same numbers of steps again and again, one after another."""
    calls = []
    variants = {"quick": lambda count: calls.append(("quick", count)), "slow": lambda count: time.sleep(0.002 * count)}
    times = bench.time_in_turn(variants, device="cpu", rounds=4)
    assert [len(slices) for slices in times.values()] == [4, 4]
    assert len({count for name, count in calls[2:]}) == 1
    # Sleeping takes at least as long as it is asked for, and nearly no processor time.
    assert all(slice_.seconds >= 0.002 and slice_.cores < 0.5 for slice_ in times["slow"])


@pytest.mark.parametrize(("seconds", "count"), [(0.001, 50), (0.0024, 20), (0.01, 5), (0.4, 1)])
def test_slices_are_whole_frames_or_some_steps(seconds, count):
    """Fill 0.05 s with whole frames of ten steps, with steps where a frame takes longer, at least one."""
    assert bench.steps_for(0.05, seconds) == count


def test_memory_counts_each_array_once():
    """Find arrays in objects, containers and structs, and count no view of them."""
    array, own = wp.zeros(100, dtype=wp.float32, device="cpu"), np.zeros(10)
    holder = SimpleNamespace(a=[array, {"b": own}], views=(array[10:20], array.numpy(), own[3:], own.reshape(2, 5)))
    assert bench.held_bytes(holder) == 400 + 80
    model = Simulator(bench.Cubes(3).scene(colliders=bench.COLLIDERS), device="cpu").model
    kinds, masses = model.colliders.kind, model.particle_mass
    assert bench.held_bytes([model.colliders, kinds]) == bench.held_bytes(model.colliders) > kinds.capacity
    assert bench.held_bytes(masses) == 27 * 4


@pytest.mark.parametrize(
    ("now", "cores", "slower"),
    [(7.4, 4, "10.00"), (7.6, 4, ""), (30.0, 4, ""), (7.4, 2, "10.00"), (3.8, 1, ""), (3.7, 1, "5.00")],
)
def test_regressions_go_by_the_ratio_to_the_reference_kernel(tmp_path, now, cores, slower):
    """Warn of a scene that lost more than a quarter of what it may have here, and name the machine of the baseline."""
    baseline = bench.read_baseline(write_baseline(tmp_path / "then.json", 10.0))
    lines = bench.regressions({"cube_8": figures_of(now), "new": figures_of(0.1)}, baseline, cores=cores)
    assert len(lines) == bool(slower)
    for line in lines:
        words = ("cube_8", f"{now:.2f}", slower, f"with {cores} cores", "a processor with 4 cores", "25%")
        assert all(part in line for part in words)


def test_command_prints_one_json_object_and_warns(warpjelly, tmp_path):  # noqa: F811
    """Print the documented keys, keep them in a file, and warn of what a baseline had much faster, with exit code 0."""
    then, report = write_baseline(tmp_path / "then.json", 1e6), tmp_path / "now.json"
    code, out, err = warpjelly("bench", "cube_8", "--rounds", 1, "--json", "--baseline", then, "-o", report)
    printed = json.loads(out)
    assert code == 0
    assert printed.keys() == REPORT_KEYS
    assert printed["scenes"].keys() == {"cube_8"}
    assert printed["scenes"]["cube_8"].keys() == FIELDS
    assert printed["scenes"]["cube_8"]["springs"] == 6220
    assert err.startswith("warning: cube_8: ")
    assert printed["regressions"] == [err.strip().removeprefix("warning: ")]
    # What was written is a baseline: the same figures are no slower than themselves.
    ratios = bench.read_baseline(report)["reference_ratio"]
    assert ratios == {"cube_8": printed["scenes"]["cube_8"]["reference_ratio"]}
    own = bench.read_baseline(report)
    assert bench.regressions({"cube_8": figures_of(ratios["cube_8"])}, own, cores=printed["cores"]) == []


def test_command_prints_a_table(warpjelly, tmp_path):  # noqa: F811
    """Name every figure of a scene, and say that a baseline of another device is not compared."""
    then = write_baseline(tmp_path / "then.json", 1e6, device="cuda:0")
    code, out, err = warpjelly("bench", "cube_8", "--rounds", 1, "--device", "cpu", "--baseline", then)
    assert (code, err) == (0, "")
    for words in ("6,220", "million springs/s", "share of springs", "bytes per particle", "not compared"):
        assert words in out


def vanish(*_):
    """End the process that measures."""
    os._exit(1)


def test_a_process_that_is_lost_is_named(warpjelly, monkeypatch):  # noqa: F811
    """Say which scene was measured, with the exit code of an environment that failed."""
    monkeypatch.setattr(bench, "measure", vanish)
    code, out, err = warpjelly("bench", "cube_8", "--rounds", 1)
    assert (code, out) == (4, "")
    assert "cube_8: its process was killed; is there too little memory?" in one_line(err)


def test_own_baseline_has_every_scene():
    """Compare every standard scene with what comes with warpjelly."""
    baseline = bench.read_baseline(bench.BASELINE)
    assert baseline["reference_ratio"].keys() == bench.SCENES.keys()
    assert all(ratio > 1.0 for ratio in baseline["reference_ratio"].values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cube_9"], "cube_9: no standard scene; they are cube_8, cube_32, cube_64, cube_128, cubes_100"),
        (["--rounds", "0"], "greater than or equal to 1"),
        (["--fast"], "No such option"),
        (["--device", "cuda:7"], "cuda:7: not on this machine"),
        (["--baseline", "none.json"], "none.json: no such file; `warpjelly bench -o none.json` writes a baseline"),
        (["--baseline", "text.json"], "text.json: not a baseline"),
        (["--baseline", "list.json"], "list.json: not a baseline"),
        (["-o", "text.json"], "text.json: there already"),
    ],
)
def test_command_refuses_what_it_cannot_do(warpjelly, tmp_path, monkeypatch, arguments, message):  # noqa: F811
    """Say in one line what is wrong before anything is measured."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "measure", None)
    Path("text.json").write_text("fast\n")
    Path("list.json").write_text('{"device": "cpu", "device_name": "a", "cores": 1, "scenes": []}')
    code, out, err = warpjelly("bench", *arguments)
    assert (code, out) == (2, "")
    assert message in one_line(err)


@pytest.fixture(scope="module")
def thing() -> contenders.Thing:
    """Return the arrays of a cube."""
    return contenders.Thing.of(Simulator(contenders.make_scene("cube_8"), device="cpu"))


def test_peers_get_the_springs_of_the_model(thing):
    """Give each spring once, with the rest length that its ends have in the lattice."""
    assert len(thing.first) == 6220
    ends = np.sort(np.stack([thing.first, thing.second], axis=1), axis=1)
    assert len(np.unique(ends, axis=0)) == 6220
    at_rest = Simulator(contenders.make_scene("cube_8"), device="cpu").positions
    lengths = np.linalg.norm(at_rest[thing.second] - at_rest[thing.first], axis=1)
    # Positions of up to 1 m in float32, whose differences are rest lengths.
    np.testing.assert_allclose(lengths, thing.classes[thing.kind, 0], atol=4 * np.finfo(np.float32).eps)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(
            kind,
            id=kind.__name__,
            marks=pytest.mark.skipif(
                util.find_spec(kind.package) is None, reason=f"{kind.package} comes with pip install 'warpjelly[bench]'"
            ),
        )
        for kind in contenders.CONTENDERS[:-1]
    ],
)
def test_peers_compute_the_same(thing, tmp_path, kind):
    """Be where NumPy is after a frame, and be found out with springs that are a little softer."""
    expected = contenders.NumPy(thing, contenders.make_scene("cube_8"))
    expected.step(bench.STEPS_PER_FRAME)
    contender = kind(thing, contenders.make_scene("cube_8"))
    contender.step(bench.STEPS_PER_FRAME)
    np.save(tmp_path / f"{kind.__name__}.npy", contender.positions())
    np.save(tmp_path / "NumPy.npy", expected.positions())
    peers.check_positions([kind], thing, tmp_path)
    softer = dataclasses.replace(thing, classes=thing.classes * np.array([1.0, 0.999, 1.0], np.float32))
    other = contenders.NumPy(softer, contenders.make_scene("cube_8"))
    other.step(bench.STEPS_PER_FRAME)
    np.save(tmp_path / "NumPy.npy", other.positions())
    with pytest.raises(RuntimeError, match=f"{kind.label} is .* m beside NumPy"):
        peers.check_positions([kind], thing, tmp_path)


def test_race_times_every_contender_in_every_round(monkeypatch):
    """Give a figure per round for each, and ratios of the same round."""
    monkeypatch.setattr(peers, "SLICE", 0.02)
    kinds = [contenders.Warpjelly, contenders.NumPy]
    result = peers.race("cube_8", kinds, 2)
    own, numpy = (result[kind.label] for kind in kinds)
    assert own["ratio"] == [1.0, 1.0]
    for a, b, ratio in zip(own["seconds_per_substep"], numpy["seconds_per_substep"], numpy["ratio"], strict=True):
        assert ratio == b / a
    assert all(
        rate * seconds == pytest.approx(6220)
        for rate, seconds in zip(numpy["springs_per_second"], numpy["seconds_per_substep"], strict=True)
    )
    # Positions and velocities of 24 bytes and masses of 8 in float64, and three numbers for each spring.
    assert numpy["bytes_per_particle"] >= 2 * 24 + 8 + 3 * 4 * 6220 / 512


def test_missing_peers_are_named(monkeypatch, capsys):
    """Say how to install a contender that is not there, and go on with the others."""
    raced = []
    monkeypatch.setattr(peers.util, "find_spec", lambda package: None if package == "taichi" else package)
    monkeypatch.setattr(peers, "race", lambda name, kinds, rounds: raced.extend(kinds) or sys.exit("raced"))
    monkeypatch.setattr(sys, "argv", ["peers.py", "cube_8"])
    with pytest.raises(SystemExit, match="raced"):
        peers.main()
    assert capsys.readouterr().err == "Taichi, atomic scatter: not installed: pip install 'warpjelly[bench]'\n"
    assert raced == [kind for kind in contenders.CONTENDERS if kind is not contenders.Taichi]


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("peers", ["cube_9"], "cube_9: there is cube_8, cube_32"),
        ("peers", ["--rounds", "0"], "--rounds 0: at least 1"),
        ("peers", ["-o", "README.md"], "README.md: there already"),
        ("peers", ["-o", "no/where.json"], "where.json: its folder does not exist"),
        ("scale", ["stress_block_1m", "block"], "block: no scene under scenes/"),
        ("batch", ["0"], "RUNS 0: at least 1"),
        ("building", ["16"], "LARGEST 16: at least 32"),
        ("building", ["large"], "invalid int value: 'large'"),
        ("stage", ["3"], "POINTS 3, FRAMES 200: at least 4 and 8"),
        ("contacts", ["8"], "unrecognized arguments: 8"),
    ],
)
def test_benchmarks_refuse_what_they_cannot_do(name, arguments, message, monkeypatch, capsys):
    """Say what is wrong before anything is measured."""
    monkeypatch.chdir(Path(__file__).parents[1])
    monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
    with pytest.raises(SystemExit, match="2"):
        import_module(name).main()
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err


def test_a_large_scene_that_fails_is_named(monkeypatch):
    """Name the scene whose run said what is wrong with it."""
    scale = import_module("scale")
    monkeypatch.setattr(scale.sys, "executable", "false")
    with pytest.raises(SystemExit, match=r"^jello_cube: `warpjelly run` ended with exit code 1$"):
        scale.measure("jello_cube")
