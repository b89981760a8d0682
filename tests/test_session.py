"""The live simulation: time, edits that go on from where it is, and what lasts of it."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Usd
from runs import samples_of
from worlds import make_material, make_scene

from warpjelly.errors import EnvironmentFailedError, InputError, WarpjellyError
from warpjelly.gui import session as sessions
from warpjelly.gui import uploads
from warpjelly.gui.limits import LimitSearch
from warpjelly.gui.live import Live
from warpjelly.gui.pace import MOST_BEHIND, WINDOW, Pace
from warpjelly.gui.session import Session
from warpjelly.gui.setup import SetUp
from warpjelly.gui.snapshot import Limits, Snapshot
from warpjelly.gui.uploads import Uploads
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.simulator import REST_BLOCK, Simulator
from warpjelly.stage.stagefiles import open_stage, progress
from warpjelly.stage.stagewriter import StageWriter
from warpjelly.stage.validate import stage_problems

SCENES = Path(__file__).parents[1] / "scenes"
# Nothing here takes seconds, but a machine may have much else to do.
PATIENCE = 120.0
CUBE: dict[str, Any] = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 3}


def falling_scene(**changes: Any) -> Scene:
    """Return a scene of a cube that falls on a floor, touching all that remembers contacts."""
    colliders = [
        {"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]},
        {"name": "ball", "type": "sphere", "center": [0.3, 0.1, 0.0], "radius": 0.3, "normal": "entry"},
        {"name": "wall", "type": "half_space", "center": [-0.7, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]},
    ]
    body = {**CUBE, "position": [0.0, 0.6, 0.0], "rotation": [0.0, 0.0, 10.0], "velocity": [-1.0, -2.0, 0.0]}
    given = {"bodies": [body], "colliders": colliders, "gravity": None, "contact": {}, **changes}
    return make_scene(**given)


@pytest.fixture
def start() -> Iterator[Callable[..., Session]]:
    """Return a function that starts a session on the CPU, to be closed after the test."""
    started: list[Session] = []

    def begin(scene: Scene | None = None) -> Session:
        started.append(Session(falling_scene() if scene is None else scene, device="cpu"))
        return started[-1]

    yield begin
    for session in started:
        session.close()


def settled(session: Session) -> Snapshot:
    """Return what comes of all that was asked for."""
    return session.settle(PATIENCE)


def until(session: Session, there: Callable[[Snapshot], bool]) -> Snapshot:
    """Return the first snapshot for which something is so."""
    snapshot: Snapshot | None = session.latest()
    while snapshot is not None and not there(snapshot):
        snapshot = session.wait_for_newer(snapshot.number, PATIENCE)
    assert snapshot is not None
    return snapshot


def state(session: Session) -> dict[str, np.ndarray]:
    """Return where a session is that holds time, float64 copies."""
    settled(session)
    sim = session._live.sim
    return {"x": sim.positions, "v": sim.velocities, "f": sim.forces}


def assert_same(session: Session, simulator: Simulator) -> None:
    """Have a session exactly where a simulator is."""
    found = state(session)
    np.testing.assert_array_equal(found["x"], simulator.positions)
    np.testing.assert_array_equal(found["v"], simulator.velocities)


# Time.


def test_steps_are_those_of_a_simulator(start: Callable[..., Session]) -> None:
    """Step as `Simulator.step` does, bit for bit, and show where that leads."""
    session, simulator = start(), Simulator(falling_scene(), device="cpu")
    session.step(150)
    session.step(7)
    simulator.step(157)
    assert_same(session, simulator)
    shown = settled(session)
    assert shown.time == simulator.time
    assert shown.dt == simulator.dt
    assert not shown.playing
    (frame,), (expected,) = shown.frames, simulator.shapes()
    np.testing.assert_array_equal(frame.points, expected.points)
    figures = simulator.diagnostics()
    assert shown.energies.kinetic == figures["kinetic"]
    assert shown.energies.total == sum(figures[name] for name in ("kinetic", "elastic", "potential", "contact"))
    np.testing.assert_allclose(shown.centers["cube"], simulator.positions.mean(axis=0), atol=1e-12)


def test_playing_goes_on_until_paused(start: Callable[..., Session]) -> None:
    """Let time go on by itself, and hold it."""
    session = start()
    assert session.latest().time == 0.0
    session.play()
    shown = until(session, lambda shown: shown.time > 0.1)
    assert shown.playing
    assert shown.substeps_per_second > 0.0
    session.pause()
    held = settled(session)
    assert not held.playing
    assert (held.substeps_per_second, held.real_time) == (0.0, 0.0)
    simulator = Simulator(falling_scene(), device="cpu")
    simulator.step(round(held.time / held.dt))
    assert_same(session, simulator)
    times = [energies.time for energies in session.history()]
    assert times == sorted(set(times))
    assert times[0] == 0.0
    assert session.wait_for_newer(session.latest().number, 0.01) is None


def test_reset_goes_back_to_the_set_up(start: Callable[..., Session]) -> None:
    """Be where a simulator of the set-up starts, and go the same way again."""
    session = start()
    session.step(50)
    before = state(session)
    session.reset()
    assert_same(session, Simulator(falling_scene(), device="cpu"))
    shown = settled(session)
    assert shown.time == 0.0
    assert [energies.time for energies in session.history()] == [0.0]
    session.step(50)
    np.testing.assert_array_equal(state(session)["x"], before["x"])


def test_snapshots_stay_as_they_were(start: Callable[..., Session]) -> None:
    """Keep the arrays of a snapshot while the simulation goes on."""
    session = start()
    shown = settled(session)
    points = shown.frames[0].points.copy()
    session.step(100)
    assert not np.array_equal(settled(session).frames[0].points, points)
    np.testing.assert_array_equal(shown.frames[0].points, points)


def test_pace_follows_real_time() -> None:
    """Say what is due, from a moment on, at the speed that is aimed at."""
    pace = Pace()
    pace.speed = 0.5
    pace.begin(100.0, 3.0)
    assert pace.due(102.0) == 4.0
    assert pace.seconds_to(102.0, 4.5) == 1.0
    assert pace.seconds_to(102.0, 3.5) == -1.0
    # What is little behind is made up for, what is far behind is not.
    pace.keep_up(102.0, 4.0 - 0.4 * MOST_BEHIND)
    assert pace.due(102.0) == 4.0
    pace.keep_up(102.0, 3.5)
    assert pace.due(102.0) == 3.5


def test_rates_are_means_over_the_last_moments() -> None:
    """Count substeps and simulated time per real time, of no more than a window."""
    pace = Pace()
    assert pace.rates(0.0, 0.0, 0) == (0.0, 0.0)
    assert pace.rates(0.5, 0.25, 100) == (200.0, 0.5)
    for number in range(1, 100):
        rates = pace.rates(0.5 + 0.25 * WINDOW * number, 0.25 + WINDOW * number, 100 + 1000 * number)
    assert rates == pytest.approx((4000.0 / WINDOW, 4.0))
    # A simulation that starts again is no step back.
    assert pace.rates(100.0, 0.0, 0) == (0.0, 0.0)


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), 1e4])
def test_absurd_speeds_are_refused(start: Callable[..., Session], speed: float) -> None:
    """Refuse to go backwards, or faster than could be meant."""
    session = start()
    session.speed = 0.25
    with pytest.raises(InputError, match="speed = "):
        session.speed = speed
    assert session.speed == 0.25
    with pytest.raises(InputError, match="substeps = 0: must be at least 1"):
        session.step(0)


def test_a_closed_session_says_so() -> None:
    """Refuse commands, and keep the last snapshot."""
    with Session(falling_scene(), device="cpu") as session:
        session.step(3)
        shown = settled(session)
    for command in (session.play, session.reset, lambda: session.change("solver.dt", 1e-4)):
        with pytest.raises(InputError, match="the session is closed"):
            command()
    assert session.latest().time == shown.time
    session.close()


def test_what_cannot_be_shown_ends_nothing(start: Callable[..., Session], monkeypatch: pytest.MonkeyPatch) -> None:
    """Answer those who wait, and go on, where something fails again when it is told that it failed."""
    session = start()
    settled(session)

    def refuse(_: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "shapes", refuse)
        session.step(1)
        with pytest.raises(WarpjellyError, match="out of memory"):
            settled(session)
        with pytest.raises(MemoryError):
            session.reset()
        with pytest.raises(WarpjellyError, match="out of memory"):
            settled(session)
    session.step(2)
    assert settled(session).time == pytest.approx(2e-3)


def test_a_failure_holds_time_and_the_first_is_raised(start: Callable[..., Session]) -> None:
    """Tell of each failure, and raise the first, which the others may come of."""
    session = start()

    def fail(text: str) -> None:
        raise InputError(text)

    session.play()
    free = threading.Event()
    session._submit(sessions._Command(lambda: free.wait(PATIENCE) and None))
    for text in ("the first", "the second"):
        session._submit(sessions._Command(lambda text=text: fail(text)))
    free.set()
    with pytest.raises(InputError, match="the first"):
        settled(session)
    shown = settled(session)
    assert not shown.playing
    assert [message.text for message in shown.messages][-2:] == ["the first", "the second"]


def test_messages_are_repeated_but_for_warnings(start: Callable[..., Session], tmp_path: Path) -> None:
    """Say each time that something was saved; what each edit warns of anew is said once."""
    session = start()
    for _ in range(2):
        session.save(tmp_path / "scene.toml", force=True)
        session.tell("mind the gap", "warning")
    texts = [message.text for message in session.latest().messages][-3:]
    assert texts == [f"saved as {tmp_path / 'scene.toml'}", "mind the gap", f"saved as {tmp_path / 'scene.toml'}"]


def test_what_takes_long_is_taken_alone_and_not_made_up_for() -> None:
    """Take blocks of substeps only while they are short; forget time that is too far behind."""
    live = Live(SetUp.from_scene(falling_scene()), device="cpu", tell=print, rebuilt=lambda _: None)
    live.play()
    for seconds, count in ((1.0, 1), (0.0, 1 + REST_BLOCK)):
        live._substep_seconds = seconds
        live.pace.begin(time.perf_counter() - 1e3, 0.0)
        live.advance()
        assert live.sim.substep_count == count
        assert live.pace.seconds_to(time.perf_counter(), live.sim.time) > -1e2


# Edits.


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_an_edit_that_changes_nothing_changes_no_bit(start: Callable[..., Session], integrator: str) -> None:
    """Go on after edits as if there had been none: positions, velocities, contacts that hold, sides of walls."""
    scene = falling_scene(solver={"integrator": integrator})
    session, simulator = start(scene), Simulator(scene, device="cpu")
    touched = 0
    for number in range(12):
        session.step(25)
        simulator.step(25)
        touched += simulator.diagnostics()["contacts"]
        # Without culling the same bits come about, so this is the same simulation anew.
        session.change("solver.culling", number % 2 == 1)
    assert touched > 10
    assert_same(session, simulator)
    assert settled(session).time == pytest.approx(simulator.time, abs=0.0)
    assert settled(session).revision == 13


def test_an_edit_of_constants_goes_on_from_the_present(start: Callable[..., Session]) -> None:
    """Keep positions, velocities and time, and evaluate the forces anew."""
    session = start()
    session.step(40)
    before, shown = state(session), settled(session)
    session.change_material("cube", {"structural.stiffness": 900.0})
    after, now = state(session), settled(session)
    np.testing.assert_array_equal(after["x"], before["x"])
    np.testing.assert_array_equal(after["v"], before["v"])
    assert np.abs(after["f"] - before["f"]).max() > 1e-3
    assert now.time == shown.time
    assert now.scene.materials["jelly"].structural.stiffness == 900.0
    assert now.revision > shown.revision


def test_another_step_keeps_the_time(start: Callable[..., Session]) -> None:
    """Go on at the nearest whole step, and fields with it."""
    session = start()
    session.step(41)
    before = settled(session)
    session.change("solver.dt", 3e-4)
    after = settled(session)
    assert after.dt <= 3e-4
    assert abs(after.time - before.time) <= after.dt / 2 * (1 + 1e-9)
    session.step(1)
    assert settled(session).time == pytest.approx(after.time + after.dt)


def test_energies_are_kept_through_edits(start: Callable[..., Session]) -> None:
    """Lose nothing of the plot where another time step rounds the time down; begin anew with a reset."""
    session = start(falling_scene(solver={"dt": 1e-3}))
    for _ in range(7):
        session.step(1)
        settled(session)
    session.change("solver.dt", 5e-3)
    assert settled(session).time == pytest.approx(5e-3)
    times = [energies.time for energies in session.history()]
    assert times == pytest.approx([0.0, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3])
    session.reset()
    assert [energies.time for energies in session.history()] == [0.0]


def test_a_body_with_other_particles_starts_anew_and_others_go_on(start: Callable[..., Session]) -> None:
    """Put the body that changed where the set-up has it, and leave the other one where it is."""
    bodies = [CUBE, {**CUBE, "name": "other", "position": [5.0, 0.0, 0.0], "velocity": [0.0, 1.0, 0.0]}]
    session = start(make_scene(bodies=bodies, gravity=[0.0, -9.81, 0.0]))
    session.step(100)
    before = state(session)["x"]
    session.change("bodies.cube.particles_per_edge", 4)
    after = state(session)["x"]
    np.testing.assert_array_equal(after[64:], before[27:])
    assert after[:64].min() == -0.5
    assert settled(session).time == pytest.approx(0.1)
    session.delete_body("cube")
    np.testing.assert_array_equal(state(session)["x"], before[27:])
    assert session.add_body({"type": "cube", "particles_per_edge": 2, "position": [0.0, 2.0, 0.0]}) == "cube"
    after = state(session)["x"]
    np.testing.assert_array_equal(after[:27], before[27:])
    assert after[27:, 1].min() == 1.5


def test_edits_that_follow_each_other_are_carried_out_together(start: Callable[..., Session]) -> None:
    """Build once for many edits that come while something else is done."""
    session = start()
    free = threading.Event()
    before = settled(session).revision
    session._submit(sessions._Command(lambda: free.wait(PATIENCE) and None))
    for number in range(1, 30):
        session.change("contact.stiffness", 100.0 * number)
    assert session.scene.contact.stiffness == 2900.0
    free.set()
    after = settled(session)
    assert after.revision == before + 1
    assert after.scene.contact.stiffness == 2900.0


def test_commands_keep_their_order_among_edits(start: Callable[..., Session]) -> None:
    """Step with the set-up as it was when the step was asked for."""
    session, simulator = start(), Simulator(falling_scene(), device="cpu")
    free = threading.Event()
    session._submit(sessions._Command(lambda: free.wait(PATIENCE) and None))
    session.step(20)
    session.change("gravity", [0.0, 9.81, 0.0])
    free.set()
    simulator.step(20)
    assert_same(session, simulator)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda s: s.change("solver.dtt", 1e-3), "solver.dtt: unknown key; did you mean 'dt'?"),
        (lambda s: s.change("solver.dt", -1.0), "solver.dt = -1.0: "),
        (lambda s: s.change("colliders.roof.radius", 1.0), "colliders.roof.radius: no entry 'roof'; entries: 0 to 2"),
        (lambda s: s.change("bodies.cube.file.name", "a.obj"), "bodies.0.file: unknown key"),
        (lambda s: s.change_material("cube", {"structural.stiffness": -5.0}), "materials.jelly.structural.stiffness"),
        (lambda s: s.change_material("ball", {}), "bodies: no entry 'ball'"),
        (lambda s: s.add_collider("cone"), "colliders.3.type = 'cone': must be one of"),
        (lambda s: s.add_collider({"type": "sphere", "name": "ball"}), 'colliders.3.name = "ball": this name is taken'),
        (lambda s: s.add_body({"type": "model", "file": "none.obj", "resolution": 3}), "no such file"),
        (lambda s: s.add_body({"type": "voxels", "layers": [["##"], ["#"]]}), "bodies.1.layers"),
        (lambda s: s.delete_body("cube"), "bodies.cube: the only body; add another one before it is deleted"),
        (lambda s: s.delete_collider("roof"), "colliders: no entry 'roof'"),
        (lambda s: s.teleport("cube", by=[0.0, 1e6, 0.0]), "bodies.0.position.1 = 1000000.6"),
        (lambda s: s.teleport("cube", by=[0.0, 1.0]), "teleport: [0.0, 1.0] must be three numbers"),
        (lambda s: s.teleport("cube"), "teleport: give by or to"),
        (lambda s: s.teleport("ball", to=[0.0] * 3), "bodies: no entry 'ball'"),
        (lambda s: s.grab("ball", [0.0] * 3), "bodies: no entry 'ball'"),
        (lambda s: s.drag([float("nan")] * 3), "must be three numbers"),
        (lambda s: s.open("none.toml"), "none.toml: cannot read the scene"),
        (lambda s: s.open(SCENES / "dessert_shot.toml"), "output.over: a run over a shot goes with `warpjelly run`"),
        (lambda s: s.open(SCENES / "stress_block_10m.toml"), "10,077,696 particles are more than the 2,000,000"),
        (lambda s: s.stop_recording(), "no recording is going"),
        (lambda s: s.save("scene.txt"), "scene.txt: a scene file ends in .toml"),
        (lambda s: s.upload("cat.png", b"x"), "cat.png: not a model file; models are .obj"),
        (lambda s: s.upload("cat.obj", b""), "cat.obj: the file is empty"),
    ],
)
def test_what_is_wrong_is_refused_at_once(
    start: Callable[..., Session], edit: Callable[[Session], object], said: str
) -> None:
    """Say in one line what is wrong, and change nothing."""
    session = start()
    session.step(5)
    before = settled(session)
    with pytest.raises(InputError) as error:
        edit(session)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    after = settled(session)
    assert after.scene == before.scene == session.scene
    assert after.revision == before.revision
    assert after.time == before.time


def test_an_edit_that_cannot_be_built_is_taken_back(start: Callable[..., Session]) -> None:
    """Go on with the set-up before, and say why."""
    session = start(make_scene(bodies=[{**CUBE, "pinned": [{"indices": [26]}]}]))
    session.step(3)
    before = state(session)["x"]
    session.change("bodies.cube.particles_per_edge", 2)
    with pytest.raises(InputError, match=r"bodies\.cube\.pinned\.0\.indices: no particle 26; they are 0 to 7"):
        settled(session)
    assert session.scene.bodies[0].particles_per_edge == 3
    np.testing.assert_array_equal(state(session)["x"], before)
    assert session.latest().messages[-1].level == "error"
    session.change("bodies.cube.particles_per_edge", 4)
    assert settled(session).scene.bodies[0].particles_per_edge == 4


def test_what_builds_on_an_edit_that_fails_is_taken_back_too(start: Callable[..., Session]) -> None:
    """Keep set-up and simulation together where a body was moved after an edit that turns out to be impossible."""
    session = start(make_scene(bodies=[{**CUBE, "pinned": [{"indices": [26]}]}]))
    settled(session)
    before = session.scene
    free = threading.Event()
    session._submit(sessions._Command(lambda: free.wait(PATIENCE) and None))
    session.change("bodies.cube.particles_per_edge", 2)
    session.teleport("cube", by=[0.0, 1.0, 0.0])
    free.set()
    with pytest.raises(InputError, match="no particle 26"):
        settled(session)
    assert session.scene == settled(session).scene == before
    session.step(1)
    assert settled(session).time > 0.0


def test_materials_of_bodies_are_edited_alone(start: Callable[..., Session]) -> None:
    """Give a body that shares a material one of its own, once, and drop what nothing is made of."""
    session = start(make_scene(bodies=[CUBE, {**CUBE, "name": "other", "position": [3.0, 0.0, 0.0]}]))
    session.change_material("other", {"bend.damping": 0.25})
    scene = session.scene
    assert [body.material for body in scene.bodies] == ["jelly", "other"]
    assert scene.materials["jelly"].bend.damping == 0.6
    expected = scene.materials["jelly"].model_dump() | {"bend": {"stiffness": 400.0, "damping": 0.25}}
    assert scene.materials["other"].model_dump() == expected
    session.change_material("other", {"particle_mass": 0.02})
    session.change_material("cube", {"particle_mass": 0.03})
    assert list(session.scene.materials) == ["jelly", "other"]
    assert session.scene.materials["other"].particle_mass == 0.02
    session.delete_body("cube")
    assert list(session.scene.materials) == ["other"]
    assert settled(session).scene == session.scene


def test_new_parts_have_defaults_and_names(start: Callable[..., Session]) -> None:
    """Create each type of collider by its type alone, under free names, with all that a scene needs."""
    session = start(make_scene())
    names = [session.add_collider(kind) for kind in ("plane", "sphere", "half_space", "box", "sphere", "sphere")]
    assert names == ["plane", "sphere", "half_space", "box", "sphere_2", "sphere_3"]
    session.delete_collider("sphere")
    assert session.add_collider({"type": "sphere", "radius": 0.25}) == "sphere"
    assert session.scene.colliders[-1].radius == 0.25
    assert [collider.name for collider in session.scene.colliders] == [
        *("plane", "half_space", "box", "sphere_2", "sphere_3", "sphere")
    ]
    session.replace_body("cube", {"type": "cloth", "size": [2.0, 2.0]})
    body = session.scene.bodies[0]
    assert (body.name, body.type, body.material) == ("cube", "cloth", "jelly")
    assert len(settled(session).scene.colliders) == 6


def test_a_session_without_a_scene_has_a_cube_over_a_floor() -> None:
    """Start with something that falls, lands and stays sound."""
    with Session(device="cpu") as session:
        session.step(4000)
        shown = session.settle(PATIENCE)
        assert not shown.diverged
        assert shown.messages == ()
        assert 0.3 < shown.centers["cube"][1] < 1.0


# Contact after edits by hand.


def resting(start: Callable[..., Session], **changes: Any) -> Session:
    """Return a session of a cube that stands on a plane, slightly deep in it, as it does at rest."""
    floor = {"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]}
    body = {**CUBE, "position": [0.0, 0.5, 0.0], **changes}
    material = make_material(stiffness=400.0, damping=0.3)
    scene = make_scene(
        bodies=[body],
        colliders=[floor],
        gravity=[0.0, -9.81, 0.0],
        contact={"damping": 2.0},
        materials={"jelly": material},
    )
    session = start(scene)
    session.step(1000)
    return session


def lowest(session: Session) -> float:
    """Return the height of the lowest particle, m."""
    return float(state(session)["x"][:, 1].min())


def test_a_plane_that_is_moved_takes_along_what_stands_on_it(start: Callable[..., Session]) -> None:
    """Lift a floor in small steps under a cube, which stands on it all the time."""
    session = resting(start)
    sunk = lowest(session)
    assert -0.01 < sunk < 0.0
    for number in range(1, 11):
        session.change("colliders.floor.center", [0.0, 0.02 * number, 0.0])
        session.step(30)
        assert lowest(session) > 0.02 * number - 0.05
    session.step(1500)
    assert lowest(session) == pytest.approx(0.2 + sunk, abs=1e-3)


def test_a_plane_that_leaps_over_a_body_lets_it_fall(start: Callable[..., Session]) -> None:
    """Catch nothing that is farther behind a plane than its threshold: nothing came through its front."""
    session = resting(start)
    session.change("colliders.floor.center", [0.0, 3.0, 0.0])
    session.step(500)
    # Free fall for 0.5 s.
    assert lowest(session) < -1.0


def test_a_plane_meets_what_it_is_moved_through(start: Callable[..., Session]) -> None:
    """Push up a cube that hovered above a floor, which was moved beyond its lowest particles by one edit."""
    floor = {"name": "floor", "type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]}
    session = start(make_scene(bodies=[{**CUBE, "position": [0.0, 0.52, 0.0]}], colliders=[floor]))
    session.step(2)
    np.testing.assert_allclose(state(session)["f"], 0.0, atol=1e-9)
    session.change("colliders.floor.center", [0.0, 0.05, 0.0])
    after = state(session)
    low = after["x"][:, 1] < 0.05
    assert low.sum() == 9
    assert after["f"][low, 1].min() > 1.0


def test_a_new_plane_catches_what_touches_it(start: Callable[..., Session]) -> None:
    """Hold a cube by a second floor that appears a little above the first, which goes."""
    session = resting(start)
    sunk = lowest(session)
    session.add_collider({"type": "plane", "name": "second", "center": [0.0, 0.002, 0.0], "size": [4.0, 4.0]})
    session.delete_collider("floor")
    session.step(3000)
    assert lowest(session) == pytest.approx(0.002 + sunk, abs=5e-4)


def test_a_wall_keeps_bodies_on_the_side_where_they_are(start: Callable[..., Session]) -> None:
    """Put a half-space between two bodies after one of them has come past the other: it pushes neither."""
    bodies = [
        {**CUBE, "velocity": [100.0, 0.0, 0.0]},
        {**CUBE, "name": "other", "position": [5.0, 0.0, 0.0]},
    ]
    session = start(make_scene(bodies=bodies))
    session.step(100)
    before = state(session)
    # Where the first one starts is on the other side.
    session.add_collider({"type": "half_space", "center": [7.5, 0.0, 0.0], "normal": [1.0, 0.0, 0.0], "name": "wall"})
    np.testing.assert_allclose(state(session)["f"], before["f"], atol=1e-9)
    # An edit of something else leaves the sides as they are, and a teleport across the wall changes that of the body.
    session.change("contact.stiffness", 3000.0)
    session.teleport("other", by=[10.0, 0.0, 0.0])
    np.testing.assert_allclose(state(session)["f"], before["f"], atol=1e-9)
    assert state(session)["x"][27:, 0].min() > 7.5


def test_a_teleport_moves_the_body_and_its_start(start: Callable[..., Session]) -> None:
    """Displace a deformed body as it is, at rest or in motion, and the set-up by as much; a reset starts there."""
    session = start(falling_scene(colliders=[]))
    session.step(20)
    before = state(session)
    session.teleport("cube", by=[1.0, 2.0, -0.5], at_rest=False)
    after = state(session)
    np.testing.assert_allclose(after["x"] - before["x"], [[1.0, 2.0, -0.5]] * 27, atol=1e-15)
    np.testing.assert_array_equal(after["v"], before["v"])
    assert session.scene.bodies[0].position == (1.0, 2.6, -0.5)
    session.teleport("cube", to=[0.0, 3.0, 0.0])
    after = state(session)
    np.testing.assert_allclose(settled(session).centers["cube"], [0.0, 3.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(after["v"], 0.0)
    scene = session.scene
    assert settled(session).scene == scene
    session.reset()
    assert_same(session, Simulator(scene, device="cpu"))


def test_a_teleport_at_time_zero_starts_where_a_file_would(start: Callable[..., Session]) -> None:
    """Step from exactly the set-up that a saved scene has, not from one that was displaced and rounded."""
    session = start(falling_scene(solver={"precision": "float32"}))
    for _ in range(3):
        session.teleport("cube", by=[0.1, 0.7, 0.3])
    session.step(25)
    simulator = Simulator(session.scene, device="cpu")
    simulator.step(25)
    assert_same(session, simulator)


def test_a_teleport_while_playing_at_time_zero_starts_where_a_file_would(start: Callable[..., Session]) -> None:
    """Take no step from a place that was displaced and rounded, also where time was let go on before."""
    session = start(falling_scene(solver={"precision": "float32"}))
    settled(session)
    before = session.scene
    free = threading.Event()
    session._submit(sessions._Command(lambda: free.wait(PATIENCE) and None))
    session.play()
    for _ in range(3):
        session.teleport("cube", by=[0.1, 0.7, 0.3])
    free.set()
    until(session, lambda shown: shown.time > 0.0)
    session.pause()
    steps = round(settled(session).time / 1e-3)
    assert session.scene != before
    simulator = Simulator(session.scene, device="cpu")
    simulator.step(steps)
    assert_same(session, simulator)


def test_explicit_places_are_teleported_too(start: Callable[..., Session]) -> None:
    """Move the start of a cube whose particles are each put somewhere, as in worlds."""
    places = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5).tolist()
    session = start(make_scene(bodies=[{**CUBE, "particles_per_edge": 2, "positions": places}]))
    session.teleport("cube", by=[0.0, 1.0, 0.0])
    assert session.scene.bodies[0].positions[0] == (-0.5, 0.5, -0.5)
    session.step(1)
    np.testing.assert_allclose(state(session)["x"], np.add(places, [0.0, 1.0, 0.0]), atol=1e-12)


def test_a_body_that_is_lifted_off_a_plane_falls_on_it_again(start: Callable[..., Session]) -> None:
    """Forget contacts where a body was taken from, and find them where it comes to."""
    session = resting(start)
    sunk = lowest(session)
    session.teleport("cube", by=[0.3, 0.1, 0.0])
    assert lowest(session) == pytest.approx(0.1 + sunk, abs=1e-12)
    session.step(3000)
    assert lowest(session) == pytest.approx(sunk, abs=2e-3)
    # Pushed into the plane by less than its threshold it is in contact, as a body that starts there is.
    session.teleport("cube", by=[0.0, -0.02, 0.0])
    session.step(3000)
    assert lowest(session) == pytest.approx(sunk, abs=2e-3)
    # Behind the plane it is not.
    session.teleport("cube", by=[0.0, -3.0, 0.0])
    session.step(200)
    assert lowest(session) < -3.0


def test_a_teleport_forgets_where_a_ball_was_entered(start: Callable[..., Session]) -> None:
    """Push a body out of a ball on the side where it was put, not where it had come in."""
    ball = {"name": "ball", "type": "sphere", "radius": 0.5, "normal": "entry"}
    body = {**CUBE, "position": [0.0, 1.02, 0.0], "velocity": [0.0, -2.0, 0.0]}
    session = start(make_scene(bodies=[body], colliders=[ball]))
    session.step(20)
    before = state(session)
    bottom = np.argmin(np.linalg.norm(before["x"] - [0.0, 0.48, 0.0], axis=1))
    assert before["f"][bottom, 1] > 0.1
    # Its bottom is in the lower half then.
    session.teleport("cube", by=[0.0, -0.93, 0.0])
    assert state(session)["f"][bottom, 1] < -0.1


def test_what_is_pinned_while_it_moves_stays_there(start: Callable[..., Session]) -> None:
    """Stop particles where they are pinned, and no others."""
    session = start(make_scene(bodies=[{**CUBE, "velocity": [1.0, 0.0, 0.0]}]))
    session.step(5)
    before = state(session)
    session.change("bodies.cube.pinned", [{"indices": [26]}])
    after = state(session)
    np.testing.assert_array_equal(after["v"][26], 0.0)
    np.testing.assert_array_equal(after["v"][:26], before["v"][:26])
    session.step(20)
    np.testing.assert_array_equal(state(session)["x"][26], before["x"][26])


# The hand.


def test_a_body_is_pulled_and_let_go(start: Callable[..., Session]) -> None:
    """Show what is held, take the body along, hold on through edits, and let go at a reset."""
    session = start(make_scene())
    session.grab("cube", [0.5, 0.5, 0.5])
    shown = settled(session)
    assert shown.pull is not None
    assert shown.pull.body == "cube"
    np.testing.assert_allclose(shown.pull.point, [0.5, 0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(shown.pull.force, 0.0, atol=1e-12)
    session.drag([0.5, 1.5, 0.5])
    pulled = settled(session).pull
    assert pulled is not None
    assert pulled.force[1] > 0.0
    session.step(300)
    session.change_material("cube", {"particle_mass": 0.02})
    held = settled(session).pull
    assert held is not None
    np.testing.assert_array_equal(held.hand, [0.5, 1.5, 0.5])
    session.step(4000)
    assert settled(session).centers["cube"][1] > 0.5
    session.release()
    assert settled(session).pull is None
    session.drag([0.0, 9.0, 0.0])
    assert settled(session).pull is None
    session.grab("cube", [0.5, 0.5, 0.5])
    session.reset()
    assert settled(session).pull is None
    session.grab("cube", [0.5, 0.5, 0.5])
    session.change("bodies.cube.particles_per_edge", 3)
    assert settled(session).pull is None


# Stability.


def test_limits_are_found_beside_the_simulation(start: Callable[..., Session]) -> None:
    """Show the largest stable step of the set-up and its integrator, and warn of a step above."""
    scene = falling_scene()
    session = start(scene)
    session.step(10)
    shown = until(session, lambda shown: shown.limits is not None)
    simulator = Simulator(scene, device="cpu")
    assert shown.limits is not None
    assert shown.limits.springs == simulator.step_limits(contacts=False)["semi_implicit_euler"]
    assert shown.limits.contact == simulator.step_limits(contacts=True)["semi_implicit_euler"]
    assert shown.limits.warning == simulator.broken_limit()
    session.change_all({"solver.dt": 9e-3, "solver.integrator": "rk4"})
    settled(session)
    shown = until(session, lambda shown: shown.limits is not None)
    assert shown.limits is not None
    assert shown.limits.warning is not None
    assert "the time step of 0.005 s is above the largest stable one" in shown.limits.warning


def test_limits_of_a_set_up_before_are_not_shown(start: Callable[..., Session]) -> None:
    """Leave out what a search finds after another one has begun."""
    session = start()
    shown = until(session, lambda shown: shown.limits is not None)
    session._take_limits(LimitSearch(session._live.sim, print, print), Limits(1.0, 1.0, None))
    assert session.latest().limits == shown.limits
    assert session.latest().number == shown.number


def test_a_search_for_limits_that_fails_is_told_of(
    start: Callable[..., Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Say so in a line, and let the simulation go on without them."""

    def refuse(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Simulator, "step_limits", refuse)
    session = start()
    shown = until(session, lambda shown: any("no largest stable step" in each.text for each in shown.messages))
    assert shown.messages[-1].text.startswith("no largest stable step was found: out of memory")
    session.step(2)
    assert settled(session).time > 0.0


def test_what_diverges_is_held_at_the_last_good_moment(start: Callable[..., Session]) -> None:
    """Hold time, say why, refuse to go on, and start anew with an edit or a reset."""
    wild = {"solver": {"dt": 5e-3}, "materials": {"jelly": make_material(stiffness=1e5)}}
    session = start(falling_scene(**wild))
    session.play()
    shown = until(session, lambda shown: shown.diverged)
    assert not shown.playing
    assert all(np.isfinite(frame.points).all() for frame in shown.frames)
    message = next(message for message in shown.messages if message.level == "error")
    assert "the simulation diverged before t = " in message.text
    assert "particle" in message.text
    session.play()
    with pytest.raises(InputError, match="the simulation has diverged: reset it"):
        settled(session)
    session.reset()
    shown = settled(session)
    assert (shown.diverged, shown.time, shown.playing) == (False, 0.0, False)
    session.step(2000)
    assert settled(session).diverged
    session.change_material("cube", {"structural.stiffness": 400.0, "shear.stiffness": 400.0, "bend.stiffness": 400.0})
    shown = settled(session)
    assert (shown.diverged, shown.time) == (False, 0.0)


# What lasts.


def test_a_teleport_of_what_diverged_starts_anew(start: Callable[..., Session]) -> None:
    """Treat it as any other edit."""
    wild = {"solver": {"dt": 5e-3}, "materials": {"jelly": make_material(stiffness=1e5)}}
    session = start(falling_scene(**wild))
    session.step(2000)
    assert settled(session).diverged
    session.teleport("cube", by=[0.0, 1.0, 0.0])
    assert (settled(session).diverged, settled(session).time) == (False, 0.0)
    assert_same(session, Simulator(session.scene, device="cpu"))


def test_a_scene_that_is_opened_is_held(start: Callable[..., Session]) -> None:
    """Stop playing, at time zero."""
    session = start()
    session.play()
    until(session, lambda shown: shown.time > 0.0)
    session.take(falling_scene())
    assert not session.latest().playing
    assert session.latest().time == 0.0


def test_another_scene_is_there_when_it_was_opened(start: Callable[..., Session]) -> None:
    """Show it at once, whatever failed before; keep the one there is if the other cannot be built."""
    wild = {"solver": {"dt": 5e-3}, "materials": {"jelly": make_material(stiffness=1e5)}}
    session = start(falling_scene(**wild))
    session.step(2000)
    session.play()
    session.open(SCENES / "jello_cube.toml")
    shown = session.latest()
    assert (shown.time, shown.playing, shown.diverged) == (0.0, False, False)
    assert shown.scene == session.scene != falling_scene(**wild)
    with pytest.raises(InputError, match="the simulation has diverged"):
        settled(session)
    with pytest.raises(InputError, match="no particle 99"):
        session.take(make_scene(bodies=[{**CUBE, "pinned": [{"indices": [99]}]}]))
    assert session.scene == session.latest().scene == shown.scene


def test_a_saved_scene_reproduces_the_set_up(start: Callable[..., Session], tmp_path: Path) -> None:
    """Write what was set up by hand so that a file gives the same bits as a reset."""
    session = start(falling_scene(solver={"precision": "float32"}))
    session.step(30)
    session.add_collider({"type": "sphere", "center": [0.1, -0.3, 0.2], "radius": 0.4})
    session.add_body({"type": "cloth", "particles": [5, 4], "position": [0.0, 1.5, 0.0]})
    session.change_material("cloth", {"structural.stiffness": 1 / 3, "particle_mass": 1e-5})
    session.teleport("cube", by=[0.1, 0.2, 0.3])
    session.change("solver.integrator", "rk2")
    path = tmp_path / "saved.toml"
    session.save(path)
    with pytest.raises(InputError, match="there already"):
        session.save(path)
    session.save(path, force=True)
    saved = load_scene(path)
    assert saved == session.scene
    session.reset()
    session.step(60)
    simulator = Simulator(saved, device="cpu")
    simulator.step(60)
    assert_same(session, simulator)
    session.open(path)
    assert settled(session).time == 0.0
    assert session.scene == saved


def test_saved_scenes_find_their_models(start: Callable[..., Session], tmp_path: Path) -> None:
    """Name model files relative to the scene, and copy those that were sent beside it."""
    content = (SCENES / "models" / "tree.obj").read_bytes()
    own = tmp_path / "models" / "tree.obj"
    own.parent.mkdir()
    own.write_bytes(content)
    session = start(make_scene())
    sent = session.upload("../../My Tree!.OBJ", content)
    assert sent.name == "My_Tree_.obj"
    for file in (own, sent, session.upload("My Tree!.obj", content), session.upload("My Tree!.obj", content + b"\n")):
        session.add_body({"type": "model", "file": str(file), "resolution": 3})
    path = tmp_path / "scenes" / "forest.toml"
    path.parent.mkdir()
    session.save(path)
    session.close()
    assert not sent.exists()
    files = [body.file for body in load_scene(path).bodies[1:]]
    assert files[0].resolve() == own.resolve()
    copies = path.parent.resolve() / "forest_models"
    assert [file.resolve().relative_to(copies).name for file in files[1:]] == [
        *("My_Tree_.obj", "My_Tree_.obj", "My_Tree__2.obj")
    ]
    assert 'file = "../models/tree.obj"' in path.read_text()


def test_models_that_cannot_be_read_change_nothing(start: Callable[..., Session]) -> None:
    """Refuse a file that is no model with a message."""
    session = start()
    sent = session.upload("broken.glb", b"not a model")
    with pytest.raises(InputError, match=r"broken\.glb"):
        session.add_body({"type": "model", "file": str(sent), "resolution": 5})
    assert len(settled(session).bodies) == 1


def test_warnings_of_models_are_told(start: Callable[..., Session], tmp_path: Path) -> None:
    """Hand on what reading a model warns of, and that a body starts in a collider."""
    session = start(falling_scene())
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1", "f 1 3 2", "f 1 2 4", "f 1 4 3"]
    file = tmp_path / "open.obj"
    file.write_text("\n".join(lines))
    session.add_body({"type": "model", "file": str(file), "resolution": 4, "position": [0.0, -0.3, 0.0]})
    texts = [message.text for message in settled(session).messages if message.level == "warning"]
    assert any("open.obj" in text for text in texts)
    assert any("starts" in text and "'model'" in text for text in texts)


def test_a_recording_is_a_run(start: Callable[..., Session], tmp_path: Path) -> None:
    """Write the frames from the present on as a run does, sound, with all that was done by hand."""
    session = start()
    session.step(33)
    frames = [settled(session).frames[0].points]
    session.record(tmp_path / "run")
    for number in range(30):
        session.step(10)
        frames.append(settled(session).frames[0].points)
        if number == 10:
            session.teleport("cube", by=[0.0, 1.0, 0.0])
            session.change_material("cube", {"structural.stiffness": 300.0})
    session.step(5)
    recorded = settled(session).recording
    assert recorded is not None
    assert (recorded.folder, recorded.frames) == (tmp_path / "run", 31)
    record = session.stop_recording()
    assert settled(session).recording is None
    assert record == json.loads((tmp_path / "run" / "run.json").read_text())
    assert (record["frames"], record["interrupted"], record["diverged"]) == (31, False, False)
    assert record["recorded_from"] == pytest.approx(0.033)
    assert stage_problems(tmp_path / "run") == []
    stage = open_stage(tmp_path / "run")
    assert progress(stage) is None
    points = stage.GetPrimAtPath("/World/bodies/cube/surface").GetAttribute("points")
    assert points.GetTimeSamples() == list(range(31))
    for number, expected in enumerate(frames):
        np.testing.assert_array_equal(np.asarray(points.Get(number)), expected)
    rows = (tmp_path / "run" / "metrics.csv").read_text().splitlines()
    assert len(rows) == 32
    with pytest.raises(InputError, match="holds a run already"):
        session.record(tmp_path / "run")
    session.record(tmp_path / "run", force=True)
    session.step(10)
    assert session.stop_recording()["frames"] == 2
    assert stage_problems(tmp_path / "run") == []


def test_an_undisturbed_recording_from_the_start_is_the_run(start: Callable[..., Session], tmp_path: Path) -> None:
    """Have every sample of the stage that `warpjelly run` writes of the same scene."""
    from warpjelly.run import simulate

    scene = falling_scene().model_copy(update={"frames": 12})
    session = start(scene)
    session.record(tmp_path / "live")
    session.step(110)
    session.stop_recording()
    simulate(scene, output=tmp_path / "run", device="cpu")
    assert samples_of(tmp_path / "live") == samples_of(tmp_path / "run")
    live, run = ((tmp_path / name / "metrics.csv").read_text() for name in ("live", "run"))
    assert [line.split(",")[2:] for line in live.splitlines()] == [line.split(",")[2:] for line in run.splitlines()]


def test_a_recording_refuses_what_it_cannot_show(start: Callable[..., Session], tmp_path: Path) -> None:
    """Refuse edits of shapes, objects and steps, a reset and a second recording, until it ends."""
    session = start()
    session.record(tmp_path / "run")
    for edit in (
        lambda: session.change("bodies.cube.particles_per_edge", 5),
        lambda: session.add_body({"type": "cube"}),
        lambda: session.add_collider("sphere"),
        lambda: session.change("colliders.floor.center", [0.0, 0.1, 0.0]),
        lambda: session.change("solver.dt", 1e-4),
        lambda: session.change("output.show", ["particles"]),
        lambda: session.open(SCENES / "jello_cube.toml"),
        session.reset,
        # Nor the scene itself, which would begin again.
        lambda: session.take(session.scene),
        lambda: session.record(tmp_path / "other"),
    ):
        with pytest.raises(InputError, match=f"recording to {tmp_path / 'run'}"):
            edit()
    assert not (tmp_path / "other").exists()
    session.change("colliders.floor.stiffness", 1500.0)
    session.change("gravity", [0.0, -1.6, 0.0])
    session.step(10)
    assert session.stop_recording()["frames"] == 2
    session.reset()
    session.add_collider("sphere")
    settled(session)


def test_samples_are_in_time_whatever_the_step(start: Callable[..., Session], tmp_path: Path) -> None:
    """Take each sample when it is due, also where dt = "auto" follows the material in the middle of a frame."""
    session = start(falling_scene(solver={"dt": "auto"}, colliders=[], gravity=[0.0, -10.0, 0.0]))
    session.record(tmp_path / "run")
    for stiffness in (30.0, 3000.0, 100.0):
        before = settled(session).dt
        session.change("materials.jelly.structural.stiffness", stiffness)
        dt = settled(session).dt
        assert dt != before
        # A frame and a half, as nearly as there are steps.
        session.step(max(2, round(0.015 / dt)))
    session.stop_recording()
    rows = [line.split(",") for line in (tmp_path / "run" / "metrics.csv").read_text().splitlines()]
    heights = np.array([float(row[rows[0].index("potential")]) for row in rows[1:]])
    times = np.array([float(row[rows[0].index("time")]) for row in rows[1:]])
    assert len(times) >= 4
    fallen = (heights[0] - heights) / (Simulator(falling_scene(), device="cpu").model.particle_mass.numpy().sum() * 10)
    # Thrown down with 2 m/s; a scheme of first order, off by up to a step, and edits round the time to a step.
    np.testing.assert_allclose(fallen, 2.0 * times + 5.0 * times**2, atol=0.015)


def test_a_folder_has_one_recording_at_a_time(start: Callable[..., Session], tmp_path: Path) -> None:
    """Refuse a folder that another session records into, also where what is there may be replaced."""
    first, second = start(), start()
    first.record(tmp_path / "run")
    with pytest.raises(InputError, match="writing"):
        second.record(tmp_path / "run", force=True)
    record = first.stop_recording()
    assert record["resolved_scene"]["frames"] == 1
    second.record(tmp_path / "run", force=True)


def test_uploads_are_limited(start: Callable[..., Session], monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse what is too large, and take the rest."""
    monkeypatch.setattr(uploads, "MOST_BYTES", 3)
    session = start()
    with pytest.raises(InputError, match=r"a\.obj: 0 MB; at most 0 MB can be sent"):
        session.upload("a.obj", b"1234")
    assert session.upload("a.obj", b"123").read_bytes() == b"123"


def test_copies_of_uploads_replace_nothing(tmp_path: Path) -> None:
    """Copy a file beside another one of its name, and once what is the same."""
    for content, name in ((b"one", "a.obj"), (b"two", "a_2.obj"), (b"one", "a.obj"), (b"two", "a_2.obj")):
        (tmp_path / "a.obj").write_bytes(content)
        assert Uploads.copy(tmp_path / "a.obj", tmp_path / "kept") == tmp_path / "kept" / name
        assert (tmp_path / "kept" / name).read_bytes() == content
    assert len(list((tmp_path / "kept").iterdir())) == 2


def test_what_diverges_ends_a_recording(start: Callable[..., Session], tmp_path: Path) -> None:
    """Keep the frames before, all finite, and say that there are no more."""
    wild = {"solver": {"dt": 5e-3}, "materials": {"jelly": make_material(stiffness=1e5)}}
    session = start(falling_scene(**wild))
    session.record(tmp_path / "run")
    session.step(2000)
    shown = settled(session)
    assert shown.diverged
    assert shown.recording is None
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["diverged"]
    assert 1 <= record["frames"] < 1000
    assert stage_problems(tmp_path / "run") == []
    assert any(f"recorded {record['frames']} frames" in message.text for message in shown.messages)


def test_closing_finishes_a_recording(tmp_path: Path) -> None:
    """Leave a whole stage behind."""
    with Session(falling_scene(), device="cpu") as session:
        session.record(tmp_path / "run")
        session.step(40)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["frames"] == 5
    assert stage_problems(tmp_path / "run") == []


@pytest.mark.parametrize("failure", [EnvironmentFailedError, OSError])
def test_a_recording_that_cannot_be_written_ends(
    start: Callable[..., Session], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: type[Exception]
) -> None:
    """Say why, keep what was written, and let the simulation go on."""
    session = start()
    session.record(tmp_path / "run")

    def refuse(*_: object) -> None:
        raise failure("run: cannot write the stage: No space left on device")

    session.step(30)
    settled(session)
    monkeypatch.setattr(StageWriter, "write_frame", refuse)
    # A sample that cannot be written is noticed with one of the next.
    for _ in range(3):
        session.step(10)
        session._live.recording and session._live.recording._background._executor.submit(int).result()
    with pytest.raises(WarpjellyError, match="No space left on device"):
        settled(session)
    shown = settled(session)
    assert shown.recording is None
    assert shown.messages[-1].text.endswith("No space left on device")
    before = shown.time
    session.step(10)
    assert settled(session).time > before
    assert (tmp_path / "run" / "stage.usda").exists()
    with pytest.raises(InputError, match="no recording is going"):
        session.stop_recording()
    monkeypatch.undo()
    session.record(tmp_path / "run", force=True)
    assert session.stop_recording()["frames"] == 1


KILLED = """
import os, sys
sys.path.insert(0, sys.argv[2])
from test_session import falling_scene
from warpjelly import plan
from warpjelly.gui.session import Session
plan.CLIP_FRAMES = 5
session = Session(falling_scene(), device="cpu")
session.record(sys.argv[1])
session.step(200)
session.settle()
# Of 21 samples, 20 are in clips.
session._live.recording._background.join()
os.kill(os.getpid(), 9)
"""


def test_a_killed_recording_is_readable(tmp_path: Path) -> None:
    """Have all but the last frames in a sound stage after the process is gone, which a run does not go on with."""
    folder = tmp_path / "run"
    killed = subprocess.run([sys.executable, "-c", KILLED, folder, Path(__file__).parent], check=False)
    assert killed.returncode == -9
    assert stage_problems(folder) == []
    stage: Usd.Stage = open_stage(folder)
    points = stage.GetPrimAtPath("/World/bodies/cube/surface").GetAttribute("points")
    assert len(points.GetTimeSamples()) == 20
    from warpjelly.run import simulate

    with pytest.raises(InputError, match="missing, so the run cannot go on"):
        simulate(falling_scene(), output=folder, device="cpu", resume=True)


def test_the_package_does_without() -> None:
    """Import warpjelly without what is interactive, and that without what draws it."""
    script = (
        "import sys, warpjelly; assert not [m for m in sys.modules if 'warpjelly.gui' in m]\n"
        "import warpjelly.gui.session; assert 'viser' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
