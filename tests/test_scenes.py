from pathlib import Path

import pytest
from worlds import FEWER_VOXELS, LARGER, frames_of

from warpjelly.checkpoint import scene_keys
from warpjelly.errors import DivergedError
from warpjelly.expect import Observer, Outcome
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator

SCENES = Path(__file__).parent.parent / "scenes"
ALL = sorted(path.stem for path in SCENES.glob("*.toml") if path.stem not in LARGER)
# Those that are as they are here, too.
NAMES = [name for name in ALL if name not in FEWER_VOXELS]
KINDS = ("structural", "shear", "bend")
NO_SPRING = {"stiffness": 0.0, "damping": 0.0}
SOFT_SPRING = {"stiffness": 1.0, "damping": 0.1}

# Scenes whose colliders are there to be seen, or to be tested for.
NEVER_TOUCHED = ("force_grid", "stress_scaffold_1m")

# What each scene shows, switched off, and the expectation that has to notice.
SWITCHED_OFF = [
    ("broken_damping", {f"materials.jelly.{kind}.damping": 0.05 for kind in KINDS}, "diverges"),
    ("broken_springs", {f"materials.jelly.{kind}.stiffness": 3.0 for kind in KINDS}, "rest_height"),
    ("broken_springs", {f"materials.jelly.{kind}.stiffness": 3.0 for kind in KINDS}, "shape_error"),
    ("chain", {"bodies.chain.pinned": []}, "reach"),
    ("corner_throw", {"colliders": []}, "reach"),
    ("dessert_shot", {"colliders": []}, "squash"),
    ("dessert_shot", {"colliders": []}, "bounce"),
    ("dessert_shot", {"colliders": []}, "rest_height"),
    ("falling_cloth", {"soft_contact.mode": "off"}, "rest_height"),
    ("force_grid", {"fields": []}, "rotation"),
    ("hanging_cloth", {"bodies.cloth.pinned": []}, "rest_height"),
    ("hanging_cloth", {"materials.cloth.shear": NO_SPRING}, "rest_height"),
    ("hanging_cloth", {"materials.cloth.shear": NO_SPRING}, "shape_error"),
    ("hanging_cloth", {"materials.cloth.bend": NO_SPRING}, "rest_height"),
    ("incline_holds", {"colliders.slope.static_friction": 0.4}, "displacement"),
    (
        "incline_slides",
        {"colliders.slope.dynamic_friction": 0.0, "colliders.slope.static_friction": 0.0},
        "displacement",
    ),
    ("magnetic_cube", {"fields": []}, "reach"),
    ("pile", {"soft_contact.mode": "off"}, "rest_height"),
    ("rolling_off_sphere", {"colliders.ball.static_friction": 0.0, "colliders.ball.dynamic_friction": 0.0}, "rotation"),
    (
        "rolling_off_sphere",
        {"colliders.ball.static_friction": 0.0, "colliders.ball.dynamic_friction": 0.0},
        "displacement",
    ),
    ("soft_plane", {"colliders.floor.stiffness": 2000.0}, "rest_height"),
    ("stiff_plane", {"colliders.floor.stiffness": 2000.0}, "bounce"),
    ("stiff_plane", {"solver.dt": 1e-4}, "bounce"),
    ("three_networks", {"materials.structural_only.shear": SOFT_SPRING}, "shape_error"),
    ("three_networks", {"materials.with_shear.shear": NO_SPRING}, "shape_error"),
    ("three_networks", {"materials.with_shear.bend": SOFT_SPRING}, "shape_error"),
    ("three_networks", {"materials.with_bend.shear": NO_SPRING}, "shape_error"),
    ("three_networks", {"materials.with_bend.bend": NO_SPRING}, "shape_error"),
    ("two_masses", {"materials.spring.structural.stiffness": 1.95}, "shape_error"),
    ("jello_cube", {"colliders": []}, "rest_height"),
    ("jello_cube", {"colliders": []}, "bounce"),
    ("jello_cube", {"materials.jelly.shear": NO_SPRING, "materials.jelly.bend": NO_SPRING}, "shape_error"),
    ("cube_on_sphere", {"colliders.ball.center": [100.0, 0.0, 0.0]}, "bounce"),
    ("cube_on_sphere", {"colliders.room.center": [100.0, 0.0, 0.0]}, "rest_height"),
    ("tree_drop", {"colliders": []}, "squash"),
    ("tree_drop", {"colliders": []}, "bounce"),
    ("tree_drop", {"colliders": []}, "rest_height"),
    ("tree_drop", {"colliders.floor.stiffness": 2000.0}, "penetration"),
    ("coupler_7", {"colliders": []}, "squash"),
    ("coupler_7", {"materials.rubber.youngs_modulus": 2e5}, "shape_error"),
    ("coupler_8", {"colliders": []}, "squash"),
    ("coupler_8", {"materials.rubber.youngs_modulus": 2e5}, "shape_error"),
    ("coupler_drop", {"colliders": [], "duration": 0.5}, "squash"),
    ("coupler_drop", {"materials.rubber.youngs_modulus": 5e5, "duration": 0.5}, "squash"),
    ("coupler_40", {"colliders": [], "duration": 0.1}, "squash"),
    ("coupler_40", {"colliders": [], "duration": 0.1}, "shape_error"),
    ("creature_drop", {"colliders": []}, "squash"),
    ("creature_drop", {"colliders": []}, "bounce"),
    ("creature_drop", {"materials.jelly.youngs_modulus": 5e4}, "squash"),
    ("creature_drop", {"materials.jelly.youngs_modulus": 5e4}, "rest_height"),
    (
        "creature_drop",
        {"bodies.creature.rotation": [0.0, 50.0, 90.0], "bodies.creature.position": [0.0, 0.5, 0.0]},
        "rest_height",
    ),
    ("two_materials", {"bodies.with_bones.regions": [], "duration": 1.0}, "rest_height"),
    ("two_materials", {"bodies.with_bones.regions": [], "duration": 1.0}, "squash"),
    ("two_cubes", {"soft_contact.mode": "off"}, "displacement"),
    ("u_on_sphere", {"colliders.ball.center": [100.0, 0.0, 0.0]}, "bounce"),
    ("u_on_sphere", {"colliders.room.center": [100.0, 0.0, 0.0]}, "rest_height"),
    ("stress_block_1m", {"colliders": []}, "squash"),
    ("stress_scaffold_1m", {"bodies.scaffold.pinned": []}, "squash"),
]


def load(name: str, overrides: dict | None = None) -> Scene:
    """Read a scene, with fewer voxels where it has a million."""
    return load_scene(SCENES / f"{name}.toml", overrides=FEWER_VOXELS.get(name, {}) | (overrides or {}))


def outcomes(name: str, overrides: dict | None = None) -> list[Outcome]:
    """Run a scene without its stage and return the measured quantities."""
    scene = load(name, overrides)
    sim = Simulator(scene, device="cpu")
    observer = Observer(sim)
    observer.observe(sim.diagnostics()["penetrations"])
    try:
        for _ in range(scene.frame_count - 1):
            sim.advance_frame()
            observer.observe(sim.diagnostics()["penetrations"])
    except DivergedError:
        observer.diverged = True
    return observer.outcomes()


@pytest.mark.parametrize("name", ALL)
def test_a_scene_does_what_it_is_for(name):
    """Run each scene whole and hold it against its own expectations."""
    found = outcomes(name)
    assert found, "the scene expects nothing"
    for outcome in found:
        assert outcome.met, outcome


@pytest.mark.parametrize(("name", "off", "quantity"), SWITCHED_OFF)
def test_an_expectation_notices_when_its_effect_is_off(name, off, quantity):
    """Switch an effect off and require the expectation that is about it to fail."""
    found = [outcome for outcome in outcomes(name, off) if outcome.quantity == quantity]
    assert found
    assert not all(outcome.met for outcome in found)


def test_every_scene_has_an_effect_to_switch_off():
    """Require a switched-off case for each scene, and a first comment that says what it is for."""
    assert {name for name, _, _ in SWITCHED_OFF} == set(ALL)
    for name in (*ALL, *LARGER):
        lines = (SCENES / f"{name}.toml").read_text().splitlines()
        assert lines[0] == "#:schema schema.json"
        assert lines[1].startswith("# ")


@pytest.mark.parametrize("name", ALL)
def test_culling_changes_no_bit_of_a_scene(name):
    """Run each scene with and without bounding boxes: state, memory of contacts and losses are the same bits."""
    culled, full = (Simulator(load(name, {"solver.culling": culling}), device="cpu") for culling in (True, False))
    contacts = 0
    for _ in range(frames_of(full)):
        for simulator in (culled, full):
            simulator.step(simulator.substeps)
        contacts += full.diagnostics()["contacts"]
        for quantity in ("x", "v", "f", "stamps", "normals", "contact_losses", "pair_losses"):
            bits = [getattr(simulator.state, quantity).numpy().tobytes() for simulator in (culled, full)]
            assert bits[0] == bits[1], (quantity, full.time)
        if full.first_lost() is not None:
            break
    # What diverges may burst before it touches anything.
    touches = bool(full.scene.colliders) and name not in NEVER_TOUCHED
    assert (contacts > 0) == touches or full.first_lost() is not None or full.scene.soft_contacts


@pytest.mark.parametrize(("larger", "name"), LARGER.items())
def test_a_larger_scene_is_the_same_with_more_voxels(larger, name):
    """Say the same of 10 and 100 million voxels as of a million, but for the keys that are changed here, too."""
    keys, others = (scene_keys(load_scene(SCENES / f"{scene}.toml")) for scene in (name, larger))
    changed = {key for key in keys.keys() | others.keys() if keys.get(key) != others.get(key)}
    assert changed == {*FEWER_VOXELS[name], "name"}
