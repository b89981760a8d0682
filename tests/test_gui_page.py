"""The page of the interactive simulation, driven in a browser: what is asked for happens in the session, and is seen.

One browser, server and session serve all tests, in their order; each begins with the scene below, held at time zero.
"""

from __future__ import annotations

import io
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browsers import browser
from PIL import Image

from warpjelly import Simulator, load_scene
from warpjelly.gui.server import served
from warpjelly.gui.session import Session
from warpjelly.scene import Scene
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

pytestmark = pytest.mark.browser

MODELS = Path(__file__).parent.parent / "scenes" / "models"
SIZE = {"width": 1540, "height": 420}
# Messages are left of the view and the panel is right of it, pixels.
LEFT, RIGHT = 315, 835
# A machine that does other things, too, draws some frames per second.
PATIENCE = 60.0
SPRINGS = {kind: {"stiffness": 100.0, "damping": 0.05} for kind in ("structural", "shear", "bend")}


def a_scene() -> Scene:
    """Return a cube above a floor."""
    return Scene.model_validate(
        {
            "name": "experiment",
            "solver": {"dt": 5e-4},
            "materials": {"jelly": {"particle_mass": 0.01, **SPRINGS}},
            "bodies": [
                {"name": "cube", "type": "cube", "particles_per_edge": 5, "material": "jelly", "position": [0, 1, 0]}
            ],
            "colliders": [{"name": "floor", "type": "plane", "normal": [0, 1, 0], "size": [8, 8]}],
        }
    )


@pytest.fixture(scope="module")
def shared(tmp_path_factory) -> Iterator[SimpleNamespace]:
    """Serve the page, and open it in a browser."""
    folder = tmp_path_factory.mktemp("gui")
    with (
        Session(a_scene(), device="cpu") as session,
        served(session, scenes=MODELS.parent, folder=folder) as (page, address),
        browser() as started,
    ):
        tab = open_tab(started, address)
        # Without a GPU they take most of the time.
        go(tab, "View")
        tab.get_by_label("Shadows", exact=True).click()
        yield SimpleNamespace(session=session, page=page, address=address, tab=tab, folder=folder, browser=started)
        assert page.failure is None


@pytest.fixture
def gui(shared) -> SimpleNamespace:
    """Begin anew."""
    shared.session.take(a_scene())
    shared.session.settle()
    return shared


def open_tab(started: Any, address: str) -> Any:
    """Open the page as another tab."""
    tab = started.new_page(viewport=SIZE)
    tab.set_default_timeout(1e3 * PATIENCE)
    tab.goto(address)
    tab.get_by_role("tab", name="Bodies").wait_for()
    return tab


def wait(condition: Callable[[], Any], what: str) -> Any:
    """Wait until something is so, and return it."""
    until = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < until, f"never: {what}"
        time.sleep(0.05)
    return found


def go(tab: Any, name: str) -> None:
    """Turn to a tab of controls."""
    tab.get_by_role("tab", name=name, exact=True).click()


def press(tab: Any, name: str) -> None:
    """Press a button."""
    tab.get_by_role("button", name=name, exact=True).click()


def fill(tab: Any, label: str, value: float) -> None:
    """Type a number."""
    tab.get_by_label(label, exact=True).fill(f"{value:g}")


def field(tab: Any, label: str) -> Any:
    """Return where to type in a control, the first of its parts if it has several."""
    typed = "//input[not(@type='hidden')]"
    inside = f"//label[normalize-space()='{label}']/ancestor::*[.{typed}][1]{typed}"
    return tab.locator(f"xpath={inside}").filter(visible=True).first


def picture(tab: Any) -> np.ndarray:
    """Return what is seen of the view, [height, width, 3], 0 to 255."""
    shot = Image.open(io.BytesIO(tab.screenshot(timeout=1e3 * PATIENCE))).convert("RGB")
    return np.asarray(shot).astype(int)[:, LEFT:RIGHT]


def jelly(seen: np.ndarray) -> np.ndarray:
    """Say which pixels show jelly: all else is grey, but for the blue of what is chosen and pulled."""
    return (np.ptp(seen, axis=2) > 60) & (seen[..., 0] > seen[..., 2])


def see(tab: Any, condition: Callable[[np.ndarray], Any], what: str) -> np.ndarray:
    """Wait until the view looks as it should, and return it."""
    found = []

    def looks() -> Any:
        found[:] = [picture(tab)]
        return condition(found[0])

    wait(looks, what)
    return found[0]


def at_rest(gui: SimpleNamespace) -> np.ndarray:
    """Return the view of the cube at time zero, plainly coloured, from the front."""
    return see(gui.tab, lambda seen: 3000 < jelly(seen).sum() < 50_000, "a cube in view")


def middle(seen: np.ndarray) -> np.ndarray:
    """Return the middle of what shows jelly, pixels from the left and from above."""
    return np.argwhere(jelly(seen)).mean(axis=0)[::-1]


def test_plays_and_holds(gui) -> None:
    """Play: time goes on, and the cube is seen to fall; pause holds it, step takes one step, reset goes back."""
    start = middle(at_rest(gui))
    go(gui.tab, "Play")
    press(gui.tab, "Play")
    wait(lambda: gui.session.latest().time > 0.2, "time goes on")
    press(gui.tab, "Pause")
    wait(lambda: not gui.session.latest().playing, "held")
    held = gui.session.settle()
    fallen = see(gui.tab, lambda seen: middle(seen)[1] > start[1] + 10, "the cube lower")
    assert held.centers["cube"][1] < 0.9
    gui.tab.get_by_text(f"{held.time:.3f} s").wait_for()
    press(gui.tab, "Step")
    stepped = wait(lambda: (now := gui.session.settle()).time > held.time and now, "a step")
    assert stepped.time == pytest.approx(held.time + held.dt, rel=1e-9)
    press(gui.tab, "Reset")
    wait(lambda: gui.session.settle().time == 0.0, "time zero")
    see(gui.tab, lambda seen: middle(seen)[1] < middle(fallen)[1] - 10, "the cube as high as before")


def test_a_button_does_what_it_said_when_it_was_pressed(gui) -> None:
    """Press Pause once more while the first time still waits behind something long: time is held, and not let go."""
    go(gui.tab, "Play")
    press(gui.tab, "Play")
    wait(lambda: gui.session.latest().playing, "playing")
    gui.tab.get_by_role("button", name="Pause", exact=True).wait_for()
    over = threading.Event()
    requests = gui.page._requests
    requests.ask(None, lambda: over.wait(PATIENCE))
    wait(lambda: not requests._waiting, "something long")
    press(gui.tab, "Pause")
    wait(lambda: len(requests._waiting) == 1, "a request that waits")
    # The second one comes when the first one is done.
    requests.ask(None, lambda: wait(lambda: not gui.session.latest().playing, "held"))
    press(gui.tab, "Pause")
    wait(lambda: len(requests._waiting) == 3, "another one that waits")
    over.set()
    done = threading.Event()
    requests.ask(None, done.set)
    assert done.wait(PATIENCE)
    assert not gui.session.settle().playing


def test_speed_and_energy_are_shown(gui) -> None:
    """Run at a tenth of real time: so says the session, and a plot of energies has lines."""
    go(gui.tab, "Play")
    gui.tab.get_by_label("Speed", exact=True).click()
    gui.tab.get_by_role("option", name="1/10 of real time").click()
    wait(lambda: gui.session.speed == 0.1, "a tenth")
    press(gui.tab, "Play")
    wait(lambda: gui.session.latest().time > 0.02, "time goes on")
    wait(lambda: gui.session.latest().real_time <= 0.12, "slower")
    canvas = gui.tab.locator(".uplot canvas").first

    def drawn() -> bool:
        shot = np.asarray(Image.open(io.BytesIO(canvas.screenshot())).convert("RGB")).astype(int)
        return bool((np.ptp(shot, axis=2) > 60).sum() > 100)

    wait(drawn, "lines of energy")
    press(gui.tab, "Pause")
    wait(lambda: not gui.session.latest().playing, "held")
    gui.session.speed = 1.0


def test_a_stiffness_changes_while_it_plays(gui) -> None:
    """Type a stiffness: the material has it, time goes on where it was, and the softer cube is lower than before."""
    go(gui.tab, "Play")
    press(gui.tab, "Play")
    go(gui.tab, "Bodies")
    wait(lambda: gui.session.latest().time > 0.05, "time goes on")
    before = gui.session.latest()
    fill(gui.tab, "Structural, N", 37)
    after = wait(
        lambda: (now := gui.session.latest()).scene.materials["jelly"].structural.stiffness == 37.0 and now, "37 N"
    )
    assert after.playing
    assert after.time >= before.time
    assert after.scene.materials["jelly"].shear.stiffness == 100.0
    gui.session.pause()


def test_an_unstable_step_is_warned_of(gui) -> None:
    """Type a step that is too long: the panel says so, with the largest stable one, and says when all is well again."""
    go(gui.tab, "Play")
    fill(gui.tab, "Step, ms", 15)
    wait(lambda: (limits := gui.session.settle().limits) is not None and limits.warning, "a warning")
    warning = gui.session.latest().limits.warning
    gui.tab.get_by_text(warning).wait_for()
    fill(gui.tab, "Step, ms", 0.5)
    gui.tab.get_by_text(warning).wait_for(state="detached")
    gui.tab.get_by_text(re.compile("step used 0.49.* ms; largest stable")).wait_for()


def test_a_sphere_comes_and_goes(gui) -> None:
    """Create a sphere, move it, delete it: the list is current, and it is seen where it is."""

    def bluish(seen: np.ndarray) -> int:
        """Return how many pixels show a ball."""
        return int((seen[..., 2] - seen[..., 0] > 25).sum())

    assert bluish(at_rest(gui)) < 50
    go(gui.tab, "Objects")
    press(gui.tab, "Sphere")
    added = wait(lambda: [c for c in gui.session.latest().scene.colliders if c.type == "sphere"], "a sphere")[0]
    wait(lambda: gui.tab.get_by_label("Object", exact=True).input_value() == added.name, "it is chosen")

    see(gui.tab, lambda seen: bluish(seen) > 800, "a ball")
    fill(gui.tab, "Radius, m", 0.7)
    wait(lambda: gui.session.latest().scene.colliders[-1].radius == 0.7, "a larger one")
    press(gui.tab, "Delete")
    wait(lambda: len(gui.session.latest().scene.colliders) == 1, "no sphere")
    wait(lambda: gui.tab.get_by_label("Object", exact=True).input_value() == "floor", "the list is current")
    see(gui.tab, lambda seen: bluish(seen) < 50, "what was there before")


@pytest.mark.parametrize("kind", ["Plane", "Half-space", "Box"])
def test_objects_can_be_created(gui, kind) -> None:
    """Create the other kinds, and tilt what has a normal by an angle."""
    go(gui.tab, "Objects")
    press(gui.tab, kind)
    added = wait(lambda: (found := gui.session.latest().scene.colliders)[1:] and found[1], kind)
    assert added.type == kind.lower().replace("-", "_")
    wait(lambda: gui.tab.get_by_label("Object", exact=True).input_value() == added.name, "it is chosen")
    gui.tab.get_by_text("Sides, m").wait_for(state="visible" if kind == "Plane" else "detached")
    if kind != "Box":
        field(gui.tab, "Tilt, °").fill("30")
        tilted = wait(lambda: (found := gui.session.latest().scene.colliders[1]).normal[1] < 1.0 and found, "a tilt")
        np.testing.assert_allclose(np.degrees(np.arccos(tilted.normal[1])), 30.0, atol=1e-3)


def test_what_is_wrong_is_said_and_nothing_else_happens(gui) -> None:
    """Type more friction in motion than at rest: a line in the page, and the control shows what holds."""
    go(gui.tab, "Objects")
    before = gui.session.scene
    fill(gui.tab, "Friction in motion", 5)
    gui.tab.get_by_text("must not be above static_friction").first.wait_for()
    friction = gui.tab.get_by_label("Friction in motion", exact=True)
    wait(lambda: float(friction.input_value()) == 0.4, "0.4 again")
    assert gui.session.scene == before


def test_a_body_is_put_elsewhere(gui) -> None:
    """Type another place: the body is there, and is seen there."""
    start = middle(at_rest(gui))
    go(gui.tab, "Bodies")
    field(gui.tab, "Centre, m").fill("0.6")
    wait(lambda: abs(gui.session.latest().centers["cube"][0] - 0.6) < 1e-6, "0.6 m")
    see(gui.tab, lambda seen: middle(seen)[0] > start[0] + 10, "the cube farther right")


def test_arrows_move_a_body(gui) -> None:
    """Drag the arrow that points up: the body and its start are higher, and nowhere else."""
    at_rest(gui)
    go(gui.tab, "Bodies")
    switch = gui.tab.get_by_label("Arrows", exact=True).locator("visible=true")
    switch.click()

    def green(seen: np.ndarray) -> np.ndarray:
        return np.argwhere((seen[..., 1] - seen[..., 0] > 60) & (seen[..., 1] - seen[..., 2] > 20))

    tip = min(green(see(gui.tab, lambda seen: len(green(seen)) > 30, "an arrow")).tolist())
    x, y = tip[1] + LEFT, tip[0] + 6
    gui.tab.mouse.move(x, y)
    gui.tab.mouse.down()
    for step in range(1, 9):
        gui.tab.mouse.move(x, y - 5 * step)
    wait(lambda: gui.session.latest().centers["cube"][1] > 1.15, "it is higher")
    gui.tab.mouse.up()
    switch.click()
    moved = gui.session.settle()
    np.testing.assert_allclose(moved.centers["cube"], moved.scene.bodies[0].position, atol=1e-6)
    np.testing.assert_allclose(moved.centers["cube"][[0, 2]], 0.0, atol=1e-6)


def test_cameras_look_from_where_they_say(gui) -> None:
    """Look from above: the cube's silhouette is a square; then from before."""
    at_rest(gui)
    go(gui.tab, "View")

    def square(seen: np.ndarray) -> bool:
        found = np.argwhere(jelly(seen))
        sides = np.ptp(found, axis=0) + 1 if len(found) else np.ones(2)
        return bool(abs(sides[0] / sides[1] - 1) < 0.05 and len(found) > 0.95 * sides.prod())

    press(gui.tab, "Top")
    see(gui.tab, square, "a square")
    press(gui.tab, "Perspective")
    see(gui.tab, lambda seen: not square(seen) and jelly(seen).sum() > 3000, "the cube as before")


def test_a_body_is_pulled_with_the_mouse(gui) -> None:
    """Drag the cube: it is held at the point under the mouse, is pulled up while it plays, and let go."""
    start = middle(at_rest(gui))
    mouse = gui.tab.mouse
    x, y = start[0] + LEFT, start[1]
    mouse.move(x, y)
    mouse.down()
    for step in range(1, 11):
        mouse.move(x, y - 10 * step)
    held = wait(lambda: (now := gui.session.latest()).pull is not None and now, "it is held")
    assert held.pull.body == "cube"
    wait(lambda: gui.session.latest().pull.hand[1] > held.centers["cube"][1] + 0.2, "the hand above it")
    gui.session.play()
    wait(lambda: gui.session.latest().time > 0.15, "time goes on")
    gui.session.pause()
    # Falling freely it would be lower by now.
    pulled = gui.session.settle()
    assert pulled.centers["cube"][1] > 1.0 - 0.5 * 9.81 * pulled.time**2 + 0.01
    mouse.up()
    wait(lambda: gui.session.latest().pull is None, "it is let go")


def test_a_model_is_uploaded(gui, tmp_path) -> None:
    """Send a model: the body is made of it, and is seen; a broken one is a message, and changes nothing."""
    at_rest(gui)
    go(gui.tab, "Bodies")
    chooser = gui.tab.locator("input[type=file]").first
    broken = tmp_path / "broken.obj"
    broken.write_text("this is not a model\n")
    before = gui.session.scene
    chooser.set_input_files(broken)
    gui.tab.get_by_text("broken.obj").first.wait_for()
    assert gui.session.scene == before
    wrong = tmp_path / "letter.txt"
    wrong.write_text("Dear Sir or Madam\n")
    chooser.set_input_files(wrong)
    gui.tab.get_by_text("letter.txt").first.wait_for()
    assert gui.session.scene == before
    chooser.set_input_files(MODELS / "tree.obj")
    snapshot = wait(lambda: (now := gui.session.latest()).scene.bodies[0].type == "model" and now, "a model")
    assert snapshot.particles != 125
    wait(lambda: gui.tab.get_by_label("Model", exact=True).input_value() == "tree.obj", "its name")
    gui.tab.get_by_label("Extent, m", exact=True).wait_for()
    see(gui.tab, lambda seen: 800 < jelly(seen).sum() < 50_000, "a tree")
    other = tmp_path / "bush.obj"
    other.write_bytes((MODELS / "tree.obj").read_bytes())
    chooser.set_input_files(other)
    wait(lambda: gui.tab.get_by_label("Model", exact=True).input_value() == "bush.obj", "the name of the next")


def test_colours_show_forces_or_not(gui) -> None:
    """Switch colours off and on: one hue, or several, with a legend."""
    # As the cube meets the floor.
    gui.session.step(700)
    gui.session.settle()

    def hues(seen: np.ndarray) -> int:
        """Return how many hues jelly has, of 36, each in a hundredth of its pixels."""
        colors = seen[jelly(seen)].astype(np.uint8)
        hue = np.asarray(Image.fromarray(colors[None]).convert("HSV"))[0, :, 0]
        return int((np.bincount(hue.astype(int) * 36 // 256, minlength=36) > len(hue) / 100).sum())

    many = hues(see(gui.tab, lambda seen: jelly(seen).sum() > 1000 and hues(seen) > 2, "many hues"))
    go(gui.tab, "Bodies")
    gui.tab.get_by_text("force on a particle, N").wait_for()
    gui.tab.get_by_label("Colours of forces", exact=True).click()
    see(gui.tab, lambda seen: jelly(seen).sum() > 1000 and hues(seen) < many, "one hue")
    gui.tab.get_by_text("force on a particle, N").wait_for(state="detached")
    gui.tab.get_by_label("Colours of forces", exact=True).click()
    see(gui.tab, lambda seen: hues(seen) > 2, "many hues again")


def borders(seen: np.ndarray) -> int:
    """Return how often what shows jelly begins or ends along the rows of a view."""
    return int((np.diff(jelly(seen).astype(int), axis=1) != 0).sum())


def test_springs_and_particles_are_seen(gui) -> None:
    """Show springs, then particles instead of the surface: what is behind shines through."""
    solid = borders(at_rest(gui))
    go(gui.tab, "Bodies")
    gui.tab.get_by_label("Springs", exact=True).click()
    wait(lambda: gui.session.latest().scene.output.show == ["surface", "springs"], "springs")
    gui.tab.get_by_label("Surface", exact=True).click()
    gui.tab.get_by_role("option", name="none").click()
    wait(lambda: gui.session.latest().scene.output.show == ["springs"], "no surface")
    see(gui.tab, lambda seen: borders(seen) > 2 * solid, "springs alone")
    gui.tab.get_by_label("Particles", exact=True).click()
    gui.tab.get_by_label("Springs", exact=True).click()
    wait(lambda: gui.session.latest().scene.output.show == ["particles"], "no springs")
    see(gui.tab, lambda seen: borders(seen) > 2 * solid, "particles alone")


def test_a_saved_scene_reproduces_the_run(gui) -> None:
    """Save what was changed; a simulation of the file goes as the session does from time zero, to the bit."""
    gui.session.change_material("cube", {"bend.stiffness": 41.0})
    gui.session.add_collider({"type": "sphere", "radius": 0.3, "center": [0.2, 0.0, 0.1]})
    go(gui.tab, "Files")
    field(gui.tab, "Name").fill("kept")
    press(gui.tab, "Save the scene")
    path = gui.folder / "kept.toml"
    wait(path.exists, "a file")
    gui.tab.get_by_text("kept.toml").first.wait_for()
    gui.session.reset()
    gui.session.step(300)
    here = gui.session.settle()
    again = Simulator(load_scene(path), device="cpu")
    again.step(300)
    assert again.time == here.time
    np.testing.assert_array_equal(again.shapes()[0].points, here.frames[0].points)
    # It can be opened, and is not replaced unasked.
    press(gui.tab, "Save the scene")
    gui.tab.get_by_text("there already; choose another name, or tick Replace").first.wait_for()


def test_a_run_is_recorded(gui) -> None:
    """Record while it plays: a sound stage with as many samples as were taken."""
    go(gui.tab, "Files")
    field(gui.tab, "Run").fill("taken")
    press(gui.tab, "Record")
    wait(lambda: gui.session.latest().recording is not None, "it records")
    gui.session.play()
    wait(lambda: gui.session.latest().time > 0.2, "time goes on")
    gui.session.pause()
    press(gui.tab, "Stop recording")
    wait(lambda: gui.session.latest().recording is None, "it has ended")
    gui.tab.get_by_role("button", name="Record", exact=True).wait_for()
    wait(lambda: any("recorded" in told.text for told in gui.session.latest().messages), "all is written")
    assert stage_problems(gui.folder / "taken") == []
    assert open_stage(gui.folder / "taken").GetEndTimeCode() >= 10


def test_a_picture_is_taken(gui) -> None:
    """Take a picture: a PNG of the view, with the cube."""
    at_rest(gui)
    go(gui.tab, "Files")
    with gui.tab.expect_download() as download:
        press(gui.tab, "Take a picture")
    seen = np.asarray(Image.open(download.value.path()).convert("RGB")).astype(int)
    assert download.value.suggested_filename == "experiment.png"
    assert jelly(seen).sum() > 3000


def test_a_scene_is_opened(gui) -> None:
    """Choose a scene of the folder: it is there, and is seen."""
    go(gui.tab, "Files")
    gui.tab.get_by_label("Scene", exact=True).click()
    gui.tab.get_by_role("option", name="two_cubes.toml").click()
    press(gui.tab, "Open")
    wait(lambda: gui.session.latest().scene.name == "two_cubes", "two cubes")
    assert gui.session.latest().time == 0.0
    see(gui.tab, lambda seen: jelly(seen).sum() > 3000, "cubes")
    wait(lambda: field(gui.tab, "Name").input_value() == "two_cubes", "its name to save it by")
    assert field(gui.tab, "Run").input_value() == "two_cubes_run"


def test_tabs_show_the_same(gui) -> None:
    """Watch from a second tab: it has what the first does, and closing it loses nothing."""
    second = open_tab(gui.browser, gui.address)
    go(gui.tab, "Objects")
    press(gui.tab, "Sphere")
    go(second, "Objects")
    wait(lambda: second.get_by_label("Object", exact=True).input_value() == "sphere", "the sphere in the other tab")
    see(second, lambda seen: jelly(seen).sum() > 3000, "the cube in the other tab")
    press(second, "Delete")
    wait(lambda: gui.tab.get_by_label("Object", exact=True).input_value() == "floor", "gone in the first")
    scene = gui.session.scene
    second.close()
    wait(lambda: not gui.page.failure and gui.session.scene == scene, "nothing is lost")
    at_rest(gui)
