"""World files: what they mean, how they are refused, and how scenes become them."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference import ROUND_OFF, World
from world_files import INDICES, WORLDS, WorldFile, sample_field
from worlds import step_of, substeps_of

from warpjelly.errors import EnvironmentFailedError, InputError
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator
from warpjelly.worldfile import write_world


def write(path: Path, world: WorldFile | str) -> Path:
    """Write a world and return its path."""
    path.write_text(world if isinstance(world, str) else world.text(), encoding="utf-8", newline="")
    return path


def world_forces(world: WorldFile) -> np.ndarray:
    """Return the forces on all particles, straight from the description of the format, [512, 3], N."""
    x, v = np.round(world.positions, 6), np.round(world.velocities, 6)
    f = np.zeros((512, 3))
    # Springs, by the differences of their ends' indices.
    rests = {(1,): 1 / 7, (1, 1): 2**0.5 / 7, (1, 1, 1): 3**0.5 / 7, (2,): 2 / 7}
    for i in range(512):
        step = np.abs(INDICES - INDICES[i])
        for j in range(i):
            if (rest := rests.get(tuple(int(s) for s in step[j] if s))) is not None:
                offset = x[i] - x[j]
                length = np.linalg.norm(offset)
                unit = offset / length
                force = -(world.k_elastic * (length - rest) + world.d_elastic * (v[i] - v[j]) @ unit) * unit
                f[i] += force
                f[j] -= force
    # Walls: a spring for each that is violated, damped both ways.
    beyond = np.abs(x) - 2.0
    outward = np.sign(x)
    f += (beyond >= 0) * (-world.k_collision * beyond * outward - world.d_collision * v)
    if world.plane is not None:
        normal = np.array(world.plane[:3])
        height = (x @ normal + world.plane[3]) / np.linalg.norm(normal)
        normal /= np.linalg.norm(normal)
        # Positive on the side of the centre.
        side = np.sign(height.mean())
        depth = -side * height
        push = world.k_collision * depth - world.d_collision * side * (v @ normal)
        f += (depth >= 0)[:, None] * push[:, None] * side * normal
    if len(world.grid):
        n = len(world.grid)
        place = (np.clip(x, -2, 2) + 2) / 4 * (n - 1)
        cell = np.minimum(place.astype(int), n - 2)
        share, forces = place - cell, np.round(world.grid, 6)
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, share, 1 - share), axis=1)
            f += weight[:, None] * forces[tuple((cell + corner).T)]
    return f


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_is_read_as_the_format_says(tmp_path: Path, name: str) -> None:
    """Take every number of a file to its place, exactly."""
    world = WORLDS[name]
    scene = load_scene(write(tmp_path / f"{name}.w", world))
    assert scene.solver.integrator == {"RK4": "rk4", "Euler": "explicit_euler"}[world.integrator]
    assert (step_of(scene), substeps_of(scene), scene.solver.precision) == (world.dt, world.n, "float64")
    assert scene.fps == 1 / (world.n * world.dt)
    assert (scene.name, scene.frame_count, scene.up_axis, scene.gravity) == (name, 300, "Z", (0.0, 0.0, 0.0))
    material = scene.materials["jelly"]
    assert (material.law, material.particle_mass) == ("hooke", round(world.mass, 6))
    for kind in (material.structural, material.shear, material.bend):
        assert (kind.stiffness, kind.damping) == (world.k_elastic, world.d_elastic)
    assert [c.type for c in scene.colliders] == ["box"] + ["half_space"] * (world.plane is not None)
    for collider in scene.colliders:
        assert (collider.stiffness, collider.damping, collider.pulls) == (world.k_collision, world.d_collision, True)
    sim = Simulator(load_scene(tmp_path / f"{name}.w"), device="cpu")
    np.testing.assert_array_equal(sim.positions, np.round(world.positions, 6))
    np.testing.assert_array_equal(sim.velocities, np.round(world.velocities, 6))
    assert (sim.model.particle_count, sim.model.spring_count) == (512, 6220)
    for field in scene.fields:
        assert (field.lower, field.upper, field.outside) == ((-2.0,) * 3, (2.0,) * 3, "clamp")
        np.testing.assert_array_equal(field.nodes(), np.round(world.grid, 6))
    assert len(scene.fields) == (len(world.grid) > 0)


@pytest.mark.parametrize("name", WORLDS)
def test_the_first_forces_are_those_of_the_format(tmp_path: Path, name: str, device: str) -> None:
    """Start with the forces of springs, walls, plane and field, computed straight from the format."""
    world = WORLDS[name]
    sim = Simulator(load_scene(write(tmp_path / "a.w", world)), device=device)
    expected = world_forces(world)
    # Springs of 200 N/m over 2 m and dampers at 50 m/s: terms of up to 400 N, some 40 on each particle.
    np.testing.assert_allclose(sim.forces, expected, rtol=0, atol=40 * 400 * ROUND_OFF["float64"])
    # The world shows something, but for a cube in free flight, which only has the rounding of the file.
    assert np.abs(expected).max() > 1e-2 or name == "left"


def test_a_corner_of_the_box_pushes_along_every_violated_wall(tmp_path: Path) -> None:
    """Have particles beyond one, two and three walls among the worlds that are compared."""
    beyond = (np.abs(WORLDS["corner"].positions) >= 2).sum(axis=1)
    assert set(beyond) == {0, 1, 2, 3}


def test_walls_pull_while_a_particle_leaves(tmp_path: Path, device: str) -> None:
    """Damp a particle that leaves a wall as one that enters it, beyond what the spring pushes."""
    positions, velocities = INDICES / 7.0 + [1.05, 0.0, 0.0], np.tile([-30.0, 0.0, 0.0], (512, 1))
    world = WorldFile(positions=positions, velocities=velocities, d_collision=2.0)
    scene = load_scene(write(tmp_path / "a.w", world))
    pulled = positions[:, 0] > 2
    assert 0 < pulled.sum() < 512
    forces = {}
    for pulls in (True, False):
        data = scene.model_dump(exclude_none=True)
        for collider in data["colliders"]:
            collider["pulls"] = pulls
        forces[pulls] = Simulator(Scene.model_validate(data), device=device).forces
    # 400 N/m over 0.05 m are 20 N outwards, against 60 N of the damper.
    difference = (forces[True] - forces[False])[pulled]
    expected = np.zeros_like(difference)
    expected[:, 0] = -400 * (np.round(positions[pulled, 0], 6) - 2.0) + 2.0 * 30.0
    np.testing.assert_allclose(difference, expected, rtol=0, atol=60 * 10 * ROUND_OFF["float64"])


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_moves_like_the_reference(tmp_path: Path, name: str, device: str) -> None:
    """Follow each world for a few steps like the reference, with the exact step of the file."""
    scene = load_scene(write(tmp_path / "a.w", WORLDS[name]))
    sim, reference = Simulator(scene, device=device), World(scene)
    sim.step(3)
    reference.step(3)
    # A step adds dt^2/m = 1.3e-4 m/N of the error of the force above, and what the steps before have left.
    np.testing.assert_allclose(sim.positions, reference.x, rtol=0, atol=40 * 400 * 1.3e-4 * 6 * ROUND_OFF["float64"])


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: " ".join(text.split()),
        lambda text: "\n\n  " + text.replace(" ", "\t\t \n") + "\n \n",
        lambda text: text.rstrip(),
        lambda text: "\ufeff" + text,
        lambda text: text.replace("0.000500", "5e-4").replace("RK4", "RK4"),
    ],
)
def test_any_layout_of_a_world_is_read(tmp_path: Path, change: Any) -> None:
    """Read the same scene whatever the line ends and the white space."""
    plain = write(tmp_path / "a.w", WORLDS["plane"])
    scene = load_scene(plain)
    (tmp_path / "b").mkdir()
    assert load_scene(write(tmp_path / "b" / "a.w", change(plain.read_text()))) == scene


def test_all_names_of_the_integrators_are_known(tmp_path: Path) -> None:
    """Read both spellings of Euler."""
    for word, name in (("Euler", "explicit_euler"), ("EULER", "explicit_euler"), ("RK4", "rk4")):
        scene = load_scene(write(tmp_path / "a.W", replace(WORLDS["left"], integrator=word)))
        assert scene.solver.integrator == name


# The plane's world has its lines: 1 integrator, 2 time, 3 constants, 4 mass, 5 and 6 plane, 7 resolution 5, 8 to 132
# field, 133 to 644 positions, 645 to 1156 velocities.
@pytest.mark.parametrize(
    ("line", "text", "said"),
    [
        (1, "Verlet", "line 1: 'Verlet' is not an integrator"),
        (1, 1000 * "\0", r"line 1: '\x00\x00\x00"),
        (1, "HAIR 3", "line 1: 'HAIR' is not an integrator"),
        (2, "0.0 1", "line 2: '0.0' is not the time step"),
        (2, "-0.0005 1", "line 2: '-0.0005' is not the time step"),
        (2, "0.0005 0", "line 2: '0' is not the number of steps"),
        (2, "0.0005 1.5", "line 2: '1.5' is not the number of steps"),
        (2, "1.0 11", "line 2: a sample every 11 s"),
        (3, "-200 0.25 400 0.25", "line 3: '-200' is not kElastic"),
        (3, "200 0.25 0 0.25", "line 3: dCollision is given, but kCollision is 0"),
        (3, "200 0.25 4OO 0.25", "line 3: '4OO' is not kCollision"),
        (4, "0.000000", "line 4: '0.000000' is not the mass"),
        (4, "1e-10", "line 4: '1e-10' is not the mass"),
        (4, 1000 * "x", "line 4: 'xxxxxxxxxxxx...xxxxxxxxxxxxx' is not the mass"),
        (5, "2", "line 5: '2' is not the flag"),
        (6, "0 0 0 1", "line 6: the inclined plane has no normal"),
        (7, "1", "line 7: a field of resolution 1"),
        (7, "-5", "line 7: '-5' is not the resolution"),
        (7, "1000000", "line 7: '1000000' is not the resolution"),
        (7, "100", "line 1156: the file ends here"),
        (20, "0 nan 0", "line 20: 'nan' is not a component of the field"),
        (20, "0 1e400 0", "line 20: '1e400' is not a component of the field"),
        (20, "0 -1.#IND 0", "line 20: '-1.#IND' is not"),
        (140, "0 inf 0", "line 140: 'inf' is not a component of the positions"),
        (140, "0 1e9 0", "line 140: '1e9' is not a component of the positions"),
        (700, "0 1_0 0", "line 700: '1_0' is not a component of the velocities"),
        (1156, "0 0", "line 1156: the file ends here, 1 numbers before"),
        (1157, "0.0", "line 1157: '0.0' follows after the last velocity"),
    ],
)
def test_a_bad_world_is_refused_by_its_line(tmp_path: Path, line: int, text: str, said: str) -> None:
    """Name the file, the line, the word and what is allowed."""
    lines = WORLDS["plane"].text().split("\n")
    lines[line - 1] = text
    path = write(tmp_path / "bad.w", "\n".join(lines))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert str(caught.value).startswith(f"{path}: {said}")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < len(str(path)) + 150


def test_a_truncated_world_is_refused_wherever_it_ends(tmp_path: Path) -> None:
    """Name the last line of a file that is cut after any of its words."""
    text = WORLDS["plane"].text()
    words = text.split()
    for count in [*range(14), 100, 500, len(words) - 1]:
        path = write(tmp_path / "cut.w", "\n".join(words[:count]))
        with pytest.raises(InputError, match=f"line {max(count, 1)}: the file ends here"):
            load_scene(path)


def test_a_world_that_is_no_text_is_refused(tmp_path: Path) -> None:
    """Name files that are missing or binary."""
    with pytest.raises(InputError, match="No such file"):
        load_scene(tmp_path / "none.w")
    (tmp_path / "a.w").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        load_scene(tmp_path / "a.w")


def test_samples_of_a_world_are_whole_steps(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Keep the step of the file, sample the nearest whole number of steps, and say so."""
    path = write(tmp_path / "a.w", WORLDS["left"])
    with caplog.at_level(logging.WARNING, "warpjelly"):
        scene = load_scene(path, overrides={"fps": 60})
    # 1 / (60 * 0.0005) = 33.3
    assert (step_of(scene), substeps_of(scene), scene.frame_count) == (0.0005, 33, 300)
    assert scene.fps == pytest.approx(60.606, rel=1e-4)
    assert "every 33 steps" in caplog.text
    assert load_scene(path, frames=7).frame_count == 7
    assert load_scene(path, overrides={"frames": 9}).frame_count == 9
    # 2000 samples a second.
    assert load_scene(path, overrides={"duration": 0.25}).frame_count == 500
    finer = load_scene(path, overrides={"solver.dt": 1e-4})
    assert (step_of(finer), finer.fps) == (1e-4, pytest.approx(1e4))
    # Steps that are asked for are taken, and another fps beside them is refused.
    assert substeps_of(load_scene(path, overrides={"solver.steps_per_frame": 7})) == 7
    assert substeps_of(load_scene(path, overrides={"solver.steps_per_frame": 8, "fps": 250})) == 8


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"fps": "many"}, 'fps = "many": must be a valid number'),
        ({"fps": True}, "fps = true: must be a valid number"),
        ({"fps": 0.05}, "fps = 0.05: must be greater than or equal to 0.1"),
        ({"fps": 60, "solver.dt": "auto"}, 'solver.dt = "auto": give a number'),
        ({"fps": 60, "solver.dt": 1e-320}, "solver.dt = 1e-320: must be greater than"),
        ({"fps": 60, "solver.steps_per_frame": 7}, "fps = 60.0: leave it out; solver.steps_per_frame and solver.dt"),
        ({"solver.dt": 1.0, "solver.steps_per_frame": 11}, "solver.steps_per_frame = 11: with solver.dt = 1 s that is"),
    ],
)
def test_times_that_a_world_cannot_have_are_refused(tmp_path: Path, overrides: dict[str, Any], said: str) -> None:
    """Blame the key that is wrong, and drop none of those given."""
    path = write(tmp_path / "a.w", WORLDS["left"])
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides=overrides)
    assert str(caught.value).startswith(f"{path}: {said}")


def test_exact_steps_decide_fps(tmp_path: Path) -> None:
    """Take fps from steps_per_frame and dt in any scene, and refuse another."""
    path = tmp_path / "a.toml"
    path.write_text(
        "[solver]\ndt = 0.0007\nsteps_per_frame = 3\n[materials.m]\n"
        '[[bodies]]\ntype = "cube"\nmaterial = "m"\nparticles_per_edge = 2\n'
    )
    scene = load_scene(path)
    assert (step_of(scene), substeps_of(scene), scene.fps) == (0.0007, 3, 1 / (3 * 0.0007))
    with pytest.raises(InputError, match=r"fps = 60\.0: leave it out"):
        load_scene(path, overrides={"fps": 60.0})
    sim = Simulator(scene, device="cpu")
    sim.advance_frame()
    assert sim.time == 3 * 0.0007


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_survives_the_round_trip(tmp_path: Path, name: str) -> None:
    """Find the same scene again after .w -> Scene -> .w, and the same file after another."""
    scene = load_scene(write(tmp_path / "a.w", WORLDS[name]))
    for folder in ("b", "c"):
        (tmp_path / folder).mkdir()
        write_world(scene, tmp_path / folder / "a.w")
        again = load_scene(tmp_path / folder / "a.w")
        assert again == scene
    assert (tmp_path / "b" / "a.w").read_bytes() == (tmp_path / "c" / "a.w").read_bytes()


FITTING = """
fps = 100.0
up_axis = "Z"
[solver]
integrator = "rk4"
dt = 0.001
[materials.m]
law = "hooke"
particle_mass = 0.002
structural = { stiffness = 50.0, damping = 0.1 }
shear = { stiffness = 50.0, damping = 0.1 }
bend = { stiffness = 50.0, damping = 0.1 }
[[bodies]]
type = "cube"
material = "m"
position = [0.5, 0.0, 0.0]
rotation = [0.0, 0.0, 90.0]
angular_velocity = [0.0, 0.0, 2.0]
[contact]
static_friction = 0.0
dynamic_friction = 0.0

[[colliders]]
type = "box"
size = [4.0, 4.0, 4.0]
pulls = true
[[colliders]]
type = "half_space"
center = [0.0, 0.0, -0.9]
normal = [0.0, 1.0, 1.0]
pulls = true
[[fields]]
type = "constant"
force = [0.25, 0.0, 0.0]
"""


EMPTY_GRID = {"type": "grid", "lower": [-2.0] * 3, "upper": [2.0] * 3}


def test_a_scene_that_fits_becomes_a_world(tmp_path: Path, device: str) -> None:
    """Start a scene and its world from the same places, speeds and forces."""
    path = tmp_path / "a.toml"
    path.write_text(FITTING)
    scene = load_scene(path)
    write_world(scene, tmp_path / "a.w")
    world = load_scene(tmp_path / "a.w")
    assert (step_of(world), substeps_of(world), world.solver.integrator) == (step_of(scene), substeps_of(scene), "rk4")
    sims = [
        Simulator(load_scene(p, overrides={"solver.precision": "float64"}), device=device)
        for p in (path, tmp_path / "a.w")
    ]
    for quantity in ("positions", "velocities"):
        np.testing.assert_allclose(*(getattr(sim, quantity) for sim in sims), rtol=0, atol=0.51e-6)
    # Rounding two ends by half of 1e-6 m each stretches a spring of 50 N/m by up to 1.7e-6 m; a particle has at most
    # 32 springs, and the damper's direction turns by as much on top.
    np.testing.assert_allclose(*(sim.forces for sim in sims), rtol=0, atol=32 * (50 + 1) * 1.8e-6)
    # Without contacts, springs cancel and gravity and the field remain.
    alone = load_scene(tmp_path / "a.w", overrides={"colliders": []})
    mean = Simulator(alone, device=device).forces.mean(axis=0)
    np.testing.assert_allclose(mean, [0.25, 0.0, -0.002 * 9.81], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"solver.integrator": "semi_implicit_euler"}, "solver.integrator"),
        ({"solver.dt": 1e-7}, "solver.dt"),
        ({"bodies.0.size": 2.0}, "bodies.0"),
        ({"bodies.0.particles_per_edge": 4}, "bodies.0"),
        ({"bodies.0.pinned": [{"indices": [0]}]}, "bodies.0.pinned"),
        ({"soft_contact.mode": "all"}, "soft_contact.mode"),
        ({"bodies.0": {"type": "voxels", "layers": [["#"]], "material": "m"}}, "bodies.0"),
        ({"materials.m.law": "strain"}, "materials.m.law"),
        ({"materials.m.shear.stiffness": 60.0}, "materials.m.shear"),
        ({"materials.m": {"law": "hooke", "density": 1.0}}, "materials.m.density"),
        ({"colliders.0.size": [4.0, 4.0, 5.0]}, "colliders.0"),
        ({"colliders.0.pulls": False}, "colliders.0.pulls"),
        ({"colliders.1.stiffness": 3.0}, "colliders.1.stiffness"),
        ({"colliders.1.damping": 3.0}, "colliders.1.damping"),
        ({"colliders.0": {"type": "sphere", "radius": 1.0, "pulls": True}}, "colliders.0.type"),
        ({"colliders.0": {"type": "half_space", "normal": [1.0, 0.0, 0.0], "pulls": True}}, "colliders"),
        ({"contact.damping": 2e-7}, "colliders.0.damping"),
        ({"gravity": [0.0, 0.0, 1e-4]}, "gravity times particle_mass"),
        ({"fields.0.force": [0.0, -1e-7, 0.0]}, "fields.0.force"),
        ({"fields.0": {**EMPTY_GRID, "forces": [[1e-7, 0.0, 0.0]] * 8}}, "fields.0"),
        ({"fields.0.curve": [[0.0, 1.0]]}, "fields.0.curve"),
        ({"fields.0": {"type": "magnetic", "strength": [1.0, 0.0, 0.0]}}, "fields.0.type"),
    ],
)
def test_a_scene_that_does_not_fit_is_refused(tmp_path: Path, overrides: dict[str, Any], said: str) -> None:
    """Name the key that a world cannot hold, and write nothing."""
    (tmp_path / "a.toml").write_text(FITTING)
    with pytest.raises(InputError, match=f"does not fit a world file: {said} "):
        write_world(load_scene(tmp_path / "a.toml", overrides=overrides), tmp_path / "a.w")
    assert not (tmp_path / "a.w").exists()


def test_springs_of_a_world_keep_their_constants(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Refuse a damping that six decimals make 0, warn of one that they change, and take a true 0."""
    (tmp_path / "a.toml").write_text(FITTING)
    same = {f"materials.m.{kind}.damping": 2e-7 for kind in ("structural", "shear", "bend")}
    with pytest.raises(InputError, match=r"materials\.m\.structural\.damping = 2e-07 is 0"):
        write_world(load_scene(tmp_path / "a.toml", overrides=same), tmp_path / "a.w")
    with caplog.at_level(logging.WARNING, "warpjelly"):
        write_world(load_scene(tmp_path / "a.toml", overrides=dict.fromkeys(same, 0.0)), tmp_path / "a.w")
        assert not caplog.records
        write_world(load_scene(tmp_path / "a.toml", overrides=dict.fromkeys(same, 1.4e-6)), tmp_path / "b.w")
    assert "materials.m.structural.damping = 1.4e-06 is written as 0.000001" in caplog.text


@pytest.mark.parametrize("normal", [[0.0, 0.0, 1e-7], [1e-5, 2e-5, 2.5e-6], [3e11, 4e11, 1e12]])
def test_a_plane_keeps_its_place_whatever_the_length_of_its_normal(tmp_path: Path, normal: list[float]) -> None:
    """Find the direction and the distance of a half-space again, to the six decimals of the format."""
    (tmp_path / "a.toml").write_text(FITTING)
    scene = load_scene(
        tmp_path / "a.toml", overrides={"colliders.1.normal": normal, "colliders.1.center": [0.0, 0.0, -9.0]}
    )
    write_world(scene, tmp_path / "a.w")
    found = load_scene(tmp_path / "a.w").colliders[1]
    unit = np.array(normal) / np.linalg.norm(normal)
    # Half of 1e-6 for each component; the centre is the point next to the origin, 9 m away at most.
    np.testing.assert_allclose(found.normal / np.linalg.norm(found.normal), unit, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.center, unit * (unit[2] * -9.0), rtol=0, atol=(1 + 2 * 9) * 1e-6)


def test_gravity_and_constants_join_the_grid(tmp_path: Path) -> None:
    """Add the weight of a particle and constant forces to the nodes of the only grid."""
    forces = sample_field(lambda p: 0.1 * p, resolution=3)
    grid = {"type": "grid", "lower": [-2.0] * 3, "upper": [2.0] * 3, "forces": forces.tolist()}
    (tmp_path / "a.toml").write_text(FITTING)
    scene = load_scene(
        tmp_path / "a.toml", overrides={"fields": [grid, {"type": "constant", "force": [0.5, 0.0, 0.0]}]}
    )
    write_world(scene, tmp_path / "a.w")
    found = load_scene(tmp_path / "a.w").fields[0].nodes()
    np.testing.assert_allclose(found, forces + np.array([0.5, 0.0, -0.002 * 9.81]), rtol=0, atol=0.51e-6)


def test_a_world_that_is_there_is_kept_unless_forced(tmp_path: Path) -> None:
    """Refuse to overwrite a file, replace it when forced, and ask for the suffix."""
    scene = load_scene(write(tmp_path / "a.w", WORLDS["left"]))
    before = (tmp_path / "a.w").read_text()
    other = load_scene(write(tmp_path / "b.w", WORLDS["displaced"]))
    with pytest.raises(InputError, match="--force"):
        write_world(other, tmp_path / "a.w")
    assert (tmp_path / "a.w").read_text() == before
    write_world(scene, tmp_path / "b.w", force=True)
    assert (tmp_path / "b.w").read_text() == before
    with pytest.raises(InputError, match=r"ends in \.w"):
        write_world(scene, tmp_path / "c.txt")


def test_a_world_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    """Name the file whose folder is missing, and leave no unfinished file where the name is a folder's."""
    scene = load_scene(write(tmp_path / "a.w", WORLDS["left"]))
    with pytest.raises(EnvironmentFailedError, match=r"none/b\.w: cannot write the world: No such file or directory"):
        write_world(scene, tmp_path / "none" / "b.w")
    (tmp_path / "b.w").mkdir()
    with pytest.raises(InputError, match=r"b\.w: it is a folder; choose the name of a file"):
        write_world(scene, tmp_path / "b.w", force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.w", "b.w"]
