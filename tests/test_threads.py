"""Threads on the CPU: how work is cut, that results do not depend on them, and that nobody waits in vain."""

from __future__ import annotations

import gc
import itertools
import multiprocessing
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference import World
from test_integrators import ENERGIES, ORDERS, make_rough_world
from worlds import make_material, make_scene, make_voxels

from warpjelly import machine, parts, team
from warpjelly.cells import Cells
from warpjelly.lattice import build_lattice
from warpjelly.network import build_cloth
from warpjelly.scene import Scene
from warpjelly.simulator import Simulator


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut small scenes into many parts, so that tests of threads are quick."""
    monkeypatch.setattr(parts, "MIN_PART", 64)


def make_crowd(integrator: str = "semi_implicit_euler", *, soft: bool = True, **solver: Any) -> Scene:
    """Return a cube, a sparse body, a cloth and a network that fall on a ball and a floor and meet each other."""
    rng = np.random.default_rng(5)
    ends = sorted({tuple(sorted(pair)) for pair in rng.integers(0, 300, (500, 2)).tolist() if pair[0] != pair[1]})
    bodies = [
        {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 8, "size": 0.7,
         "velocity": [1.0, -2.0, 0.0], "charge": 0.01},
        make_voxels(rng.random((6, 6, 6)) < 0.5, name="sparse", cell_size=0.15, position=[0.82, 0.1, 0.0],
                    velocity=[-1.0, -2.0, 0.0]),
        {"name": "cloth", "type": "cloth", "material": "jelly", "particles": [30, 20], "size": [1.5, 1.0],
         "position": [0.0, 0.37, 0.0]},
        {"name": "web", "type": "network", "material": "jelly", "points": rng.normal(scale=0.3, size=(300, 3)).tolist(),
         "structural": ends, "position": [-1.0, 0.3, 0.0], "velocity": [2.0, -2.0, 0.0]},
    ]  # fmt: skip
    return make_scene(
        fps=1000.0,
        bodies=bodies,
        colliders=[
            {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [9.0, 9.0], "center": [0.0, -0.36, 0.0]},
            {"type": "sphere", "radius": 0.3, "center": [0.2, -0.6, 0.0], "normal": "entry"},
        ],
        fields=[{"type": "magnetic", "strength": [0.0, 1.0, 0.0], "curve": [[0.0, 0.0], [0.004, 1.0]]}],
        contact={"static_friction": 0.5, "dynamic_friction": 0.4},
        gravity=[0.0, -9.81, 0.0],
        materials={"jelly": make_material(30.0, 0.02)},
        soft_contact={"mode": "bodies" if soft else "off"},
        solver={"integrator": integrator, "dt": 2e-4, **solver},
    )


def bits_of(simulator: Simulator) -> dict[str, bytes]:
    """Return everything that changes, and what is measured of it, bit for bit."""
    arrays = {name: getattr(simulator.state, name).numpy().tobytes() for name in vars(simulator.state)}
    return arrays | {"measured": repr(simulator.diagnostics()).encode()}


@pytest.mark.parametrize(
    ("integrator", "soft", "precision"),
    [
        *((integrator, False, "float32") for integrator in ORDERS),
        ("semi_implicit_euler", True, "float32"),
        ("rk4", True, "float64"),
    ],
)
def test_threads_do_not_change_a_bit(integrator: str, soft: bool, precision: str, small_parts: None) -> None:
    """Step a crowd by one, two, three and seven threads, more than most machines have for it: the same bits."""
    scene = make_crowd(integrator, soft=soft, precision=precision)
    runs = []
    for threads in (1, 2, 3, 7):
        simulator = Simulator(scene, device="cpu", threads=threads)
        # Where bodies may touch, more than four are not worth it.
        assert simulator.threads == (min(threads, 4) if soft else threads)
        # Frames of five substeps, and single ones.
        for count in (20, 11) if threads < 3 else (31,):
            simulator.step(count)
        runs.append(bits_of(simulator))
    for run in runs[1:]:
        assert [name for name in run if run[name] != runs[0][name]] == []
    measured = simulator.diagnostics()
    assert measured["contacts"] > 0 and measured["friction_losses"] > 0.0 and measured["field_work"] != 0.0
    assert (measured["overlaps"].max() > 0.0) == soft


ODD = {
    "dot": {"type": "network", "points": [[0.0, 0.1, 0.0]]},
    "backwards": {"type": "network", "points": [[0.0, 0.1, 0.0], [0.0, 0.3, 0.0], [0.1, 0.3, 0.0]],
                  "structural": [[2, 0], [1, 0]]},
    "ribbon": {"type": "cloth", "particles": [2, 37], "size": [0.1, 1.0]},
    "needle": make_voxels(np.ones((31, 1, 1), bool), cell_size=0.1),
    "sheet": make_voxels(np.ones((1, 13, 17), bool), cell_size=0.1),
    "prime": {"type": "cube", "particles_per_edge": 11},
}  # fmt: skip


@pytest.mark.parametrize("kind", [*ODD, "all"])
def test_threads_do_not_change_odd_bodies(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drop a lonely particle, springs from later particles to earlier ones, thin bodies and odd ones, in tiny parts."""
    monkeypatch.setattr(parts, "MIN_PART", 2)
    names = list(ODD) if kind == "all" else [kind]
    # Apart by more than they are long.
    bodies = [ODD[name] | {"name": name, "material": "jelly", "position": [4.0 * k, 0.0, 0.0]}
              for k, name in enumerate(names)]  # fmt: skip
    floor = {"type": "half_space", "normal": [0.0, 1.0, 0.0]}
    scene = make_scene(
        bodies=bodies, colliders=[floor], gravity=[0.0, -9.81, 0.0], materials={"jelly": make_material(30.0, 0.02)}
    )
    one, three = (Simulator(scene, device="cpu", threads=threads) for threads in (1, 3))
    one.step(30)
    three.step(30)
    assert bits_of(one) == bits_of(three)
    # The reference knows nothing without cells.
    if kind in ("needle", "sheet", "prime"):
        world = World(scene)
        world.step(30)
        # As in test_integrators.
        np.testing.assert_allclose(one.positions, world.x, rtol=0, atol=1e-9)


@pytest.mark.parametrize("integrator", ORDERS)
def test_threads_follow_the_reference(integrator: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Follow a random world with fields, friction and colliders for 300 steps in small parts like the reference."""
    monkeypatch.setattr(parts, "MIN_PART", 2)
    scene = make_rough_world(8, integrator=integrator)
    simulator, world = Simulator(scene, device="cpu", threads=3), World(scene)
    assert simulator.threads == 3
    simulator.step(300)
    world.step(300)
    # As in test_integrators.
    np.testing.assert_allclose(simulator.positions, world.x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(simulator.velocities, world.v, rtol=0, atol=1e-7)
    measured = simulator.diagnostics()
    np.testing.assert_allclose([measured[name] for name in ENERGIES[4:]], world.losses, rtol=1e-9, atol=1e-9)
    assert (world.losses[1:] > 0.0).all()


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_lanes_do_what_one_thread_does(integrator: str, precision: str) -> None:
    """Step by several lanes per part, as on a GPU: the same up to what rounding makes of 30 steps."""
    results = []
    for lanes in (1, 5):
        simulator = Simulator(make_crowd(integrator, soft=False, precision=precision), device="cpu", threads=1)
        simulator._stepper._lanes = lanes
        simulator.step(30)
        results.append((simulator.positions, simulator.velocities))
    # Only fused or separate roundings differ: a few epsilon of 2 m and 5 m/s a step, which the stiffest motion,
    # sqrt(100 k/m) = 550/s over 6 ms, may stretch tenfold.
    bound = {"float32": 30 * 10 * 1.2e-7, "float64": 30 * 10 * 2.2e-16}[precision]
    for (found, expected), scale in zip(zip(*results, strict=True), (4.0, 4.0 * 550.0), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound * scale)


def spans_of(kind: str) -> tuple[np.ndarray, int]:
    """Return the spans of a body and how many particles it has."""
    rng = np.random.default_rng(3)
    if kind == "network":
        first = np.sort(rng.integers(0, 900, 3000))
        spans = np.stack([first, rng.integers(0, 900, 3000), np.ones(3000), np.zeros(3000)], axis=1)
        return spans.astype(np.int32), 900
    if kind == "cloth":
        lattice = build_cloth((1.0, 1.0), (40, 30))
    else:
        cells = {"cube": np.ones((11, 11, 11), bool), "flat": np.ones((2, 20, 20), bool),
                 "long": np.ones((200, 3, 3), bool), "sparse": rng.random((12, 12, 12)) < 0.4}[kind]  # fmt: skip
        lattice = build_lattice(Cells.of(cells), origin=np.zeros(3), cell_size=1.0)
    return lattice.spans, len(lattice.particles)


def check_phases(phases: list[np.ndarray], spans: np.ndarray, particle_count: int) -> None:
    """Find every span in one task, and every particle in at most one task of a phase."""
    order = np.concatenate(phases)
    order = order[np.argsort(order[:, 0])]
    np.testing.assert_array_equal(order[:, 0], np.append(0, order[:-1, 1]))
    assert order[-1, 1] == len(spans)
    for phase in phases:
        owner = np.full(particle_count, -1)
        for number, (begin, end) in enumerate(phase):
            for i, j, count, _ in spans[begin:end]:
                for first in (i, j):
                    assert np.isin(owner[first : first + count], (-1, number)).all()
                    owner[first : first + count] = number


@pytest.mark.parametrize("kind", ["cube", "flat", "long", "sparse", "cloth", "network"])
def test_no_two_tasks_of_a_phase_touch_the_same_particle(kind: str, small_parts: None) -> None:
    """Cut bodies so that most are worked on in many places at once, and nothing waits for phases that are of no use."""
    spans, particle_count = spans_of(kind)
    phases = parts.cut_spans(spans, particle_count)
    check_phases(phases, spans, particle_count)
    # A body of two layers is worked on in some places, what is joined at random in one, in no more phases than need be.
    assert sum(map(len, phases)) / len(phases) >= {"flat": 1.5, "network": 1.0}.get(kind, 3.0)
    assert kind != "network" or len(phases) <= 2


def test_spans_at_random_are_cut_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut spans of any length that reach anywhere within some distance, also where parts are joined to longer ones."""
    monkeypatch.setattr(parts, "MIN_PART", 8)
    joined = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        particle_count, reach = rng.integers(200, 600), rng.integers(1, 120)
        count = rng.integers(1, rng.choice([2, 65]), 150)
        ends = rng.integers(0, particle_count - 64 - reach, 150)
        ends = np.stack([ends, ends + rng.integers(1, reach + 1, 150)])
        first, second = rng.permuted(ends, axis=0)
        spans = np.stack([first, second, count, 0 * count], axis=1)[np.argsort(first, kind="stable")].astype(np.int32)
        phases = parts.cut_spans(spans, int(particle_count))
        check_phases(phases, spans, int(particle_count))
        joined += sum(map(len, phases)) < len(np.unique(spans[:, 0] // 8))
    assert joined > 5


def test_large_models_have_no_more_than_some_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the parts of a large model longer instead of more."""
    monkeypatch.setattr(parts, "MIN_PART", 64)
    monkeypatch.setattr(parts, "MAX_PARTS", 7)
    spans, particle_count = spans_of("long")
    phases = parts.cut_spans(spans, particle_count)
    check_phases(phases, spans, particle_count)
    # 3216 particles, which would be 51 parts; a body three cells thick has two phases.
    assert [len(phase) for phase in phases] == [4, 3]


def test_the_cut_follows_from_the_model_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut a scene the same for any number of threads, and one that is small not at all."""
    scene = make_crowd()
    simulators = [Simulator(scene, device="cpu", threads=threads) for threads in (1, 4)]
    assert [simulator.threads for simulator in simulators] == [1, 1]
    monkeypatch.setattr(parts, "MIN_PART", 64)
    cuts = [Simulator(scene, device="cpu", threads=threads)._stepper._parts for threads in (1, 4)]
    assert cuts[0].count > 4
    for one, four in itertools.chain(
        [(cuts[0].particle_start, cuts[1].particle_start)], zip(cuts[0].phases, cuts[1].phases, strict=True)
    ):
        np.testing.assert_array_equal(one.numpy(), four.numpy())


def test_helpers_that_never_come_are_not_waited_for(small_parts: None) -> None:
    """Step while the other threads are kept busy elsewhere: one does all the work."""
    simulator, expected = (Simulator(make_crowd(), device="cpu", threads=threads) for threads in (3, 1))
    assert isinstance(simulator._stepper._team, team.Team)
    pool, release = simulator._stepper._team._helpers, threading.Event()
    assert isinstance(pool, ThreadPoolExecutor)
    for _ in range(2):
        pool.submit(release.wait)
    try:
        simulator.step(10)
    finally:
        release.set()
    expected.step(10)
    assert bits_of(simulator) == bits_of(expected)


def test_an_interruption_leaves_whole_blocks(small_parts: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupt the thread that waits for the others, before it has begun: they finish what they do."""
    simulator, expected = (Simulator(make_crowd(), device="cpu", threads=threads) for threads in (2, 1))
    simulator.prepare()
    launch, main = team.wp.capture_launch, threading.current_thread()

    def interrupted(graph: Any) -> None:
        if threading.current_thread() is main:
            # Whoever is interrupted later than here has done its part of the work.
            while not simulator._stepper._team._counts.numpy().any():
                pass
            raise KeyboardInterrupt
        launch(graph)

    with monkeypatch.context() as patch:
        patch.setattr(team.wp, "capture_launch", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulator.step(simulator.substeps)
    expected.step(simulator.substeps)
    assert simulator.state.x.numpy().tobytes() == expected.state.x.numpy().tobytes()
    assert simulator.time == expected.time > 0.0


def test_who_is_left_at_work_is_waited_for(small_parts: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupt the wait for a helper that has not looked at its launches yet, and step on: it finds nothing to do."""
    simulator, expected = (Simulator(make_crowd(), device="cpu", threads=threads) for threads in (2, 1))
    assert simulator._stepper._team is not None
    simulator.step(1)
    simulator.prepare()
    launch, main = team.wp.capture_launch, threading.current_thread()
    held, release = threading.Event(), threading.Event()

    def late(graph: Any) -> None:
        if threading.current_thread() is main:
            held.wait()
        else:
            held.set()
            release.wait()
        launch(graph)

    def interrupted(helpers: Any) -> None:
        if helpers and not release.is_set():
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(team.wp, "capture_launch", late)
        patch.setattr(team, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulator.step(simulator.substeps)
    timer = threading.Timer(0.1, release.set)
    timer.start()
    simulator.step(1)
    timer.join()
    # Whatever it still does would be seen.
    simulator._stepper._team._helpers.shutdown()
    expected.step(simulator.substeps + 2)
    assert bits_of(simulator) == bits_of(expected)
    assert simulator.time == expected.time


def test_what_goes_wrong_in_a_helper_is_raised(small_parts: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Raise the error of one helper, but not before the other one has ended."""
    simulator = Simulator(make_crowd(soft=False), device="cpu", threads=3)
    simulator.step(1)
    launch, main, begun, ended = team.wp.capture_launch, threading.current_thread(), threading.Barrier(3), []

    def broken(graph: Any) -> None:
        begun.wait()
        if threading.current_thread() is not main:
            if not ended:
                ended.append("first")
                raise RuntimeError("broken")
            time.sleep(0.05)
            ended.append("second")
        launch(graph)

    monkeypatch.setattr(team.wp, "capture_launch", broken)
    with pytest.raises(RuntimeError, match="broken"):
        simulator.step(1)
    assert ended == ["first", "second"]


def test_simulators_share_a_process(small_parts: None) -> None:
    """Step two scenes in two threads at once, each with helpers of its own."""
    scenes = [make_crowd(), make_crowd("rk4", soft=False)]
    expected = []
    for scene in scenes:
        expected.append(Simulator(scene, device="cpu", threads=1))
        expected[-1].step(40)
    with ThreadPoolExecutor(2) as pool:
        simulators = [Simulator(scene, device="cpu", threads=2) for scene in scenes]
        list(pool.map(lambda simulator: simulator.step(40), simulators))
    for simulator, other in zip(simulators, expected, strict=True):
        assert bits_of(simulator) == bits_of(other)


def _step_and_send(simulator: Simulator, sender: Any) -> None:
    simulator.step(10)
    sender.send(simulator.positions.tobytes())


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="this system has no fork")
def test_a_process_that_is_forked_off_goes_on(small_parts: None) -> None:
    """Step on in a copy of the process, which has no helpers: the same bits."""
    simulator, expected = (Simulator(make_crowd(), device="cpu", threads=threads) for threads in (2, 1))
    simulator.step(10)
    receiver, sender = multiprocessing.get_context("fork").Pipe()
    child = multiprocessing.get_context("fork").Process(target=_step_and_send, args=(simulator, sender))
    child.start()
    assert receiver.poll(60.0), "the copy does not go on"
    expected.step(20)
    assert receiver.recv() == expected.positions.tobytes()
    child.join()
    simulator.step(10)
    assert simulator.positions.tobytes() == expected.positions.tobytes()


def test_helpers_end_with_their_simulator(small_parts: None) -> None:
    """Leave no threads behind."""
    before = set(threading.enumerate())
    simulator = Simulator(make_crowd(), device="cpu", threads=3)
    simulator.step()
    helpers = set(threading.enumerate()) - before
    assert len(helpers) > 0
    del simulator
    gc.collect()
    for helper in helpers:
        helper.join(10.0)
    assert not any(helper.is_alive() for helper in helpers)


@pytest.mark.parametrize(("quota", "expected"), [("max 100000", 8), ("250000 100000", 3), ("50000 100000", 1)])
def test_cores_are_those_that_the_process_may_use(
    quota: str, expected: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Count the cores that the process is bound to, or what its control group leaves of them."""
    monkeypatch.setattr(machine.os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(machine, "CPU_QUOTA", tmp_path / "cpu.max")
    assert machine.available_cores() == 8
    (tmp_path / "cpu.max").write_text(quota + "\n")
    assert machine.available_cores() == expected


def test_no_threads_are_refused() -> None:
    """Say that a simulation needs a thread."""
    with pytest.raises(ValueError, match="0 threads"):
        Simulator(make_scene(), device="cpu", threads=0)
