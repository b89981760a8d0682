from pathlib import Path

import pytest

from warpjelly.expect import Observer
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator

SCENES = Path(__file__).parent.parent / "scenes"
NAMES = sorted(path.stem for path in SCENES.glob("*.toml"))
NO_SPRING = {"stiffness": 0.0, "damping": 0.0}

# What each scene shows, switched off, and the expectation that has to notice.
SWITCHED_OFF = [
    ("jello_cube", {"colliders": []}, "rest_height"),
    ("jello_cube", {"colliders": []}, "bounce"),
    ("jello_cube", {"materials.jelly.shear": NO_SPRING, "materials.jelly.bend": NO_SPRING}, "shape_error"),
    ("cube_on_sphere", {"colliders.ball.center": [100.0, 0.0, 0.0]}, "bounce"),
    ("cube_on_sphere", {"colliders.room.center": [100.0, 0.0, 0.0]}, "rest_height"),
    ("tree_drop", {"colliders": []}, "squash"),
    ("tree_drop", {"colliders": []}, "bounce"),
    ("tree_drop", {"colliders": []}, "rest_height"),
    ("tree_drop", {"colliders.floor.stiffness": 2000.0}, "penetration"),
    ("coupler_drop", {"colliders": [], "duration": 1.0}, "squash"),
    ("two_cubes", {"soft_contact.mode": "off"}, "displacement"),
    ("u_on_sphere", {"colliders.ball.center": [100.0, 0.0, 0.0]}, "bounce"),
    ("u_on_sphere", {"colliders.room.center": [100.0, 0.0, 0.0]}, "rest_height"),
]


def outcomes(name: str, overrides: dict | None = None) -> dict:
    """Run a scene without its stage and return the measured quantities by name."""
    scene = load_scene(SCENES / f"{name}.toml", overrides=overrides)
    sim = Simulator(scene, device="cpu")
    observer = Observer(sim)
    observer.observe(sim.diagnostics()["penetrations"])
    for _ in range(scene.frame_count - 1):
        sim.advance_frame()
        observer.observe(sim.diagnostics()["penetrations"])
    return {outcome.quantity: outcome for outcome in observer.outcomes()}


@pytest.mark.parametrize("name", NAMES)
def test_a_scene_does_what_it_is_for(name):
    """Run each scene whole and hold it against its own expectations."""
    found = outcomes(name)
    assert found, "the scene expects nothing"
    for outcome in found.values():
        assert outcome.met, outcome


@pytest.mark.parametrize(("name", "off", "quantity"), SWITCHED_OFF)
def test_an_expectation_notices_when_its_effect_is_off(name, off, quantity):
    """Switch an effect off and require the expectation that is about it to fail."""
    assert not outcomes(name, off)[quantity].met


def test_every_scene_has_an_effect_to_switch_off():
    """Require a switched-off case for each scene, and a first comment that says what it is for."""
    assert {name for name, _, _ in SWITCHED_OFF} == set(NAMES)
    for name in NAMES:
        lines = (SCENES / f"{name}.toml").read_text().splitlines()
        assert lines[0] == "#:schema schema.json"
        assert lines[1].startswith("# ")
