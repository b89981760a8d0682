"""Networks, cloth, pinned particles, and bodies of different materials in one scene."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import UsdGeom
from reference import EPSILON
from worlds import make_material, make_scene, make_voxels

from warpjelly.cells import Cells
from warpjelly.errors import InputError
from warpjelly.lattice import build_lattice
from warpjelly.network import build_cloth, build_network
from warpjelly.plan import plan_scene
from warpjelly.run import simulate
from warpjelly.scene import Material
from warpjelly.simulator import Simulator
from warpjelly.stage.stagefiles import open_stage
from warpjelly.stage.validate import stage_problems

YOUNG = {"law": "young", "youngs_modulus": 2e4, "density": 500.0}
# One body of each kind but models, around the origin, with a material of its own.
BODIES: dict[str, dict[str, Any]] = {
    "cube": {"type": "cube", "particles_per_edge": 4, "material": "cube"},
    "voxels": make_voxels(np.array([[[1, 1], [0, 1]]], bool), cell_size=0.4, material="voxels"),
    "network": {
        "type": "network",
        "points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [3.0, 0.0, 0.0]],
        "structural": [[0, 1], [2, 0]],
        "shear": [[1, 2]],
        "bend": [[3, 0]],
        "material": "network",
    },
    "cloth": {"type": "cloth", "size": [1.0, 0.5], "particles": [5, 4], "material": "cloth"},
}
MATERIALS = {
    "cube": make_material(300.0, 0.4, law="hooke"),
    "voxels": YOUNG,
    "network": make_material(200.0, 0.3, law="strain", particle_mass=0.02),
    "cloth": make_material(100.0, 0.2, law="hooke", particle_mass=0.005),
}


def make_world(*names: str, pinned: list[dict[str, Any]] | None = None, **changes: Any) -> Any:
    """Return a scene of some bodies, in a row, moving."""
    bodies = [
        {**BODIES[name], "name": name, "position": [4.0 * i, 0.0, 0.0], "rotation": [10.0, 20.0, 30.0],
         "velocity": [0.1, 0.2, 0.3], "angular_velocity": [3.0, 2.0, 1.0], "pinned": pinned or []}
        for i, name in enumerate(names)
    ]  # fmt: skip
    return make_scene(bodies=bodies, materials=MATERIALS, **changes)


def expanded(simulator: Simulator) -> Counter[tuple[int, int, float, float]]:
    """Return (first particle, second particle, stiffness, rest length) of every spring of a model."""
    classes = simulator.model.spring_classes.numpy()
    found = []
    for i, j, count, row in simulator.model.spans.numpy().tolist():
        rest, stiffness, _ = classes[row].tolist()
        found += [(min(i + k, j + k), max(i + k, j + k), round(stiffness, 9), round(rest, 9)) for k in range(count)]
    return Counter(found)


def test_a_network_is_what_the_scene_says() -> None:
    """Find each spring with the constants of its kind and the distance of its points, by the law strain."""
    constants = {
        kind: {"stiffness": k, "damping": 0.0} for kind, k in (("structural", 6.0), ("shear", 3.0), ("bend", 9.0))
    }
    body = {**BODIES["network"], "material": "jelly"}
    simulator = Simulator(make_scene(bodies=[body], materials={"jelly": constants}), device="cpu")
    root = round(2**0.5, 9)
    expected = [(0, 1, 6.0, 1.0), (0, 2, 6.0, 1.0), (1, 2, round(3 / 2**0.5, 9), root), (0, 3, 3.0, 3.0)]
    assert expanded(simulator) == Counter(expected)
    np.testing.assert_array_equal(simulator.positions, body["points"])


def test_given_rest_lengths_pull_at_the_start() -> None:
    """Hold three masses on springs of given rest lengths: the forces at the start are k (distance - rest length)."""
    body = {
        "type": "network", "material": "jelly", "points": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]],
        "structural": [[0, 1], [1, 2]], "rest_lengths": [0.5, 4.0],
    }  # fmt: skip
    scene = make_scene(bodies=[body], materials={"jelly": make_material(8.0, 0.0, law="hooke")})
    # Binary fractions: exact.
    np.testing.assert_array_equal(Simulator(scene, device="cpu").forces[:, 0], [4.0, -4.0 - 16.0, 16.0])


def test_two_masses_on_a_spring_swing_at_their_frequency(device: str) -> None:
    """Let two masses swing for half a period: the stretch is then exactly opposite, by the scheme's own frequency."""
    mass, k, steps = 0.5, 100.0, 100
    # Semi-implicit Euler turns the phase by 2 arcsin(w dt/2) a step, w^2 = 2 k/m; half a turn takes ``steps``.
    dt = 2 * np.sin(np.pi / steps / 2) / np.sqrt(2 * k / mass)
    body = {
        "type": "network", "material": "jelly", "points": [[0.0, 0.0, 0.0], [1.25, 0.0, 0.0]],
        "structural": [[0, 1]], "rest_lengths": [1.0],
    }  # fmt: skip
    material = make_material(k, 0.0, law="hooke", particle_mass=mass)
    scene = make_scene(bodies=[body], materials={"jelly": material}, fps=1 / dt, solver={"dt": 1.0})
    simulator = Simulator(scene, device=device)
    simulator.step(steps)
    # The scheme's solution is a cosine plus a sine whose amplitude is tan(w dt / 2), and which is zero at half a turn.
    # Error of a step: some epsilons of the length, multiplied by at most the number of steps, twice summed.
    stretch = simulator.positions[1, 0] - simulator.positions[0, 0] - 1.0
    np.testing.assert_allclose(stretch, -0.25, rtol=0, atol=steps**2 * EPSILON["float64"])


def test_a_network_without_springs_falls_freely() -> None:
    """Drop one particle: after n steps it is g dt^2 n (n + 1)/2 lower."""
    body = {"type": "network", "material": "jelly", "points": [[1.0, 2.0, 3.0]]}
    simulator = Simulator(make_scene(bodies=[body], gravity=[0.0, -10.0, 0.0]), device="cpu")
    simulator.step(100)
    # A hundred sums near 2.
    expected = [[1.0, 2.0 - 10.0 * 1e-6 * 100 * 101 / 2, 3.0]]
    np.testing.assert_allclose(simulator.positions, expected, rtol=0, atol=200 * EPSILON["float64"])


@pytest.mark.parametrize(("n", "m"), [(2, 2), (2, 3), (3, 2), (5, 4)])
def test_cloth_has_springs_in_two_dimensions(n: int, m: int) -> None:
    """Join each particle to its 4 neighbours, 4 diagonal ones and 4 second ones, at their distances."""
    cloth = build_cloth((1.5, 0.75), (n, m))
    places = [(i, k) for i in range(n) for k in range(m)]
    step = np.array([1.5 / (n - 1), 0.75 / (m - 1)])
    expected = {}
    for a, at in enumerate(places):
        for b, to in enumerate(places[a + 1 :], start=a + 1):
            apart = sorted((abs(at[0] - to[0]), abs(at[1] - to[1])))
            if apart in ([0, 1], [1, 1], [0, 2]):
                expected[a, b] = {1: 0, 2: 3}[apart[1]] if apart[0] == 0 else 1
    ends, rows = cloth.springs()
    assert len(ends) == len(expected)
    kinds = cloth.classes.kinds[rows]
    assert {(min(s), max(s)): kind for s, kind in zip(ends.tolist(), kinds.tolist(), strict=True)} == expected
    np.testing.assert_allclose(
        cloth.particles[:, [0, 2]], (np.array(places) - [(n - 1) / 2, (m - 1) / 2]) * step, atol=1e-15
    )
    assert not cloth.particles[:, 1].any()
    offset = cloth.particles[ends[:, 1]] - cloth.particles[ends[:, 0]]
    rest = cloth.classes.rest_lengths[rows]
    # A difference of two rounded coordinates below 1.
    np.testing.assert_allclose(rest, np.linalg.norm(offset, axis=1), rtol=1e-14)


def test_cloth_is_covered_by_faces_once() -> None:
    """Find faces that all look up and whose areas add up to the sheet."""
    cloth = build_cloth((1.5, 0.75), (4, 5))
    corner = cloth.particles[cloth.surface_particles][cloth.surface_quads]
    area = np.cross(corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]) / 2
    np.testing.assert_allclose(area, np.tile([0.0, 1.5 * 0.75 / 12, 0.0], (12, 1)), atol=1e-15)


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_springs_know_how_many_cells_contain_them(seed: int, weighted: bool) -> None:
    """Share out the cells among the springs; weights leave springs, particles and faces as they are."""
    cells = np.random.default_rng(seed).random((3, 4, 3)) < 0.5
    plain = build_lattice(Cells.of(cells), origin=np.zeros(3), cell_size=1.0)
    lattice = build_lattice(Cells.of(cells), origin=np.zeros(3), cell_size=1.0, weighted=weighted)
    for field in ("particles", "cell_counts", "surface_quads"):
        np.testing.assert_array_equal(getattr(lattice, field), getattr(plain, field))
    classes = lattice.classes
    ends, rows = lattice.springs()
    plain_ends, plain_kinds = plain.springs()
    assert Counter(zip(*ends.T.tolist(), classes.kinds[rows].tolist(), strict=True)) == Counter(
        zip(*plain_ends.T.tolist(), plain_kinds.tolist(), strict=True)
    )
    if not weighted:
        assert classes.cells is None
        return
    found = {kind: int(classes.cells[rows[classes.kinds[rows] == kind]].sum()) for kind in range(3)}
    # Every cell has 12 edges, 12 face diagonals and 4 body diagonals.
    assert found == {kind: count * np.count_nonzero(cells) for kind, count in enumerate((12, 12, 4))}
    # Which spring got which share shows in the forces in test_young.py. Bend springs count at both springs under them.
    bend = classes.kinds[rows] == 3
    assert classes.bends[rows].sum() == 2 * classes.cells[rows[bend]].sum()


def test_bodies_of_different_laws_move_as_if_alone(device: str) -> None:
    """Run one body of each kind and law in one scene, and each by itself: the same motion."""
    together = Simulator(make_world(*BODIES), device=device)
    together.step(50)
    start = together.model.bodies
    assert together.model.voxel_count == 1 + 3
    assert together.model.spring_count == sum(together.model.spans.numpy()[:, 2])
    for name, body in zip(BODIES, start, strict=True):
        alone = Simulator(make_world(name), device=device)
        alone.step(50)
        # Up to 16 m from the origin positions are rounded more coarsely, in each of 50 steps, twice summed.
        moved = together.positions[body.particles] - [4.0 * list(BODIES).index(name), 0.0, 0.0]
        np.testing.assert_allclose(moved, alone.positions, rtol=0, atol=50**2 * 16 * EPSILON["float64"])


@pytest.mark.parametrize("name", BODIES)
def test_momentum_of_every_kind_of_body_is_kept(name: str) -> None:
    """Fly freely for 200 steps: momentum and angular momentum stay, springs being equal and opposite."""
    simulator = Simulator(make_world(name), device="cpu")
    before = simulator.diagnostics()
    simulator.step(200)
    after = simulator.diagnostics()
    total = simulator.masses.sum()
    np.testing.assert_allclose(before["momentum"], total * np.array([0.1, 0.2, 0.3]), rtol=1e-13)
    # Each step adds the round-off of its forces, f dt, below 10 N on arms below 4 m.
    atol = 200 * 10 * 4 * 1e-3 * len(simulator.masses) * EPSILON["float64"]
    np.testing.assert_allclose(after["momentum"], before["momentum"], rtol=0, atol=atol)
    np.testing.assert_allclose(after["angular_momentum"], before["angular_momentum"], rtol=0, atol=atol)


@pytest.mark.parametrize("name", BODIES)
def test_pinned_particles_stay_to_the_bit(name: str, precision: str, device: str) -> None:
    """Pin two particles of a body that is thrown and falls: they stay where they start, and only they do."""
    world = make_world(
        name, pinned=[{"indices": [0]}, {"indices": [2, 2]}], gravity=[0.0, -9.81, 0.0], solver={"precision": precision}
    )
    simulator = Simulator(world, device=device)
    start = simulator.positions
    simulator.step(100)
    stayed = (simulator.positions == start).all(axis=1)
    assert np.flatnonzero(stayed).tolist() == [0, 2]
    assert not simulator.velocities[stayed].any()


def test_a_box_pins_what_it_holds_before_the_body_is_placed() -> None:
    """Pin the lowest layer of a cube that is turned and moved away, at the box's very edge; all of it moves not."""
    pin = [{"lower": [-0.5, -0.5, -0.5], "upper": [0.5, -0.5, 0.5]}]
    simulator = Simulator(make_world("cube", pinned=pin), device="cpu")
    lattice = build_lattice(
        Cells.of(np.ones((1, 1, 1), bool)), origin=np.full(3, -0.5), cell_size=1.0, particles_per_edge=4
    )
    np.testing.assert_array_equal(simulator.model.particle_inv_mass.numpy() == 0, lattice.particles[:, 1] < -0.4)
    frozen = Simulator(make_world("cube", pinned=[{"lower": [-1.0] * 3, "upper": [1.0] * 3}]), device="cpu")
    start = frozen.positions
    frozen.step(10)
    np.testing.assert_array_equal(frozen.positions, start)


def test_a_pinned_chain_hangs_by_its_weight() -> None:
    """Hang three masses by a pinned one and let them settle: each spring carries what is below it, n m g / k longer."""
    body = {
        "type": "network", "material": "jelly", "points": [[0.0, -float(i), 0.0] for i in range(4)],
        "structural": [[i, i + 1] for i in range(3)], "pinned": [{"indices": [0]}],
    }  # fmt: skip
    material = make_material(50.0, 4.0, law="hooke", particle_mass=0.2)
    scene = make_scene(bodies=[body], materials={"jelly": material}, gravity=[0.0, -10.0, 0.0])
    simulator = Simulator(scene, device="cpu")
    # The slowest mode, w^2 = 0.198 k/m, decays with rate 0.198 d/(2 m) = 2/s: exp(-40) after 20 s.
    simulator.step(20_000)
    expected = -np.cumsum([0.0, *(1 + n * 0.2 * 10.0 / 50.0 for n in (3, 2, 1))])
    np.testing.assert_allclose(simulator.positions[:, 1], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("pin", "said"),
    [
        ({"indices": [3, 64]}, ["bodies.cube.pinned.1.indices", "no particle 64", "0 to 63"]),
        ({"lower": [0.1, 0.1, 0.1], "upper": [0.11, 0.2, 0.2]}, ["bodies.cube.pinned.1", "pins no particle", "-0.5"]),
    ],
)
def test_a_pin_that_holds_nothing_is_refused(pin: dict[str, Any], said: list[str]) -> None:
    """Require the entry and what the body has in the refusal."""
    with pytest.raises(InputError) as caught:
        Simulator(make_world("cube", pinned=[{"indices": [0]}, pin]), device="cpu")
    for part in said:
        assert part in str(caught.value)


@pytest.mark.parametrize("name", BODIES)
def test_plans_count_what_is_built(name: str) -> None:
    """Plan particles exactly, and springs never too few, for every kind of body."""
    plan = plan_scene(make_world(name))
    simulator = Simulator(plan, device="cpu")
    assert plan.particle_count == simulator.model.particle_count
    assert plan.spring_bound >= simulator.model.spring_count
    assert plan.voxel_count == simulator.model.voxel_count
    assert plan.memory_bytes > 0


def test_material_tells_networks_kinds_apart() -> None:
    """Read back kinds and rest lengths of a network: structural, shear and bend rows, in the order of the scene."""
    network = build_network(BODIES["network"]["points"], [[(0, 1)], [(1, 2)], [(3, 0)]], [0.5, 0.25, 0.125])
    ends, rows = network.springs()
    assert ends.tolist() == [[0, 1], [1, 2], [3, 0]]
    assert network.classes.kinds[rows].tolist() == [0, 1, 3]
    assert network.classes.rest_lengths[rows].tolist() == [0.5, 0.25, 0.125]
    assert network.unit == 0.125


def test_a_young_material_survives_its_record() -> None:
    """Write a material as run.json does and read it again: keys of other laws must not come back."""
    material = Material.model_validate(YOUNG)
    assert Material.model_validate(material.model_dump(mode="json", exclude_none=True)) == material


@pytest.mark.parametrize("output", [{}, {"color": "rgb", "velocities": True, "force_range": (0.0, 5.0)}])
def test_the_stage_shows_networks_as_curves_and_cloth_from_both_sides(tmp_path: Path, output: dict[str, Any]) -> None:
    """Find a straight curve for each spring, moving and coloured with its particles, in a sound stage."""
    names = ("network", "cloth", "cube")
    run = simulate(make_world(*names, output=output, frames=3), output=tmp_path, device="cpu")
    assert run.record["frames"] == 3
    assert stage_problems(tmp_path) == []
    stage = open_stage(tmp_path)
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/bodies/network/springs"))
    assert not stage.GetPrimAtPath("/World/bodies/network/surface")
    assert curves.GetTypeAttr().Get() == UsdGeom.Tokens.linear
    assert list(curves.GetCurveVertexCountsAttr().Get()) == [2] * 4
    simulator = Simulator(make_world(*names, output=output), device="cpu")
    ends = simulator.model.shapes[0].particles[:, 0]
    assert {frozenset(pair) for pair in ends.reshape(-1, 2).tolist()} == {
        frozenset(pair) for kind in ("structural", "shear", "bend") for pair in BODIES["network"].get(kind, [])
    }
    for frame in range(3):
        np.testing.assert_array_equal(curves.GetPointsAttr().Get(frame), simulator.positions[ends].astype(np.float32))
        colors = np.array(UsdGeom.Primvar(curves.GetDisplayColorAttr()).ComputeFlattened(frame))
        # All springs at a particle have its colour.
        for particle in set(ends.tolist()):
            assert len(np.unique(colors[ends == particle], axis=0)) == 1
        simulator.advance_frame()
    sheet, cube = (UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/bodies/{name}/surface")) for name in ("cloth", "cube"))
    assert sheet.GetDoubleSidedAttr().Get() and not cube.GetDoubleSidedAttr().Get()


def test_a_lone_particle_makes_a_sound_stage(tmp_path: Path) -> None:
    """Write a particle without springs as a ball."""
    body = {"type": "network", "name": "dot", "material": "jelly", "points": [[1.0, 2.0, 3.0]]}
    simulate(make_scene(bodies=[body]), output=tmp_path, device="cpu")
    assert stage_problems(tmp_path) == []
    stage = open_stage(tmp_path)
    assert [str(prim.GetName()) for prim in stage.GetPrimAtPath("/World/bodies/dot").GetChildren()] == ["particles"]
    balls = UsdGeom.Points(stage.GetPrimAtPath("/World/bodies/dot/particles"))
    assert np.array(balls.GetPointsAttr().Get(1)).tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.egl
def test_a_preview_shows_springs_in_their_colors(tmp_path: Path) -> None:
    """Draw a network in colour and without a word."""
    from PIL import Image

    body = {**BODIES["network"], "name": "net", "points": [*BODIES["network"]["points"], [0.5, 0.5, 0.5]]}
    simulate(make_scene(bodies=[body], materials=MATERIALS), output=tmp_path, device="cpu")
    script = (
        "import sys; from pathlib import Path; from warpjelly.previews.preview import render_preview\n"
        "render_preview(Path(sys.argv[1]), Path(sys.argv[2]), size=(320, 180))"
    )
    command = [sys.executable, "-c", script, str(tmp_path), str(tmp_path / "p.png")]
    process = subprocess.run(command, check=True, capture_output=True, text=True)
    assert process.stdout + process.stderr == ""
    with Image.open(tmp_path / "p.png") as picture:
        # Jelly is colourful; the rest is nearly grey, and the legend is in the last sixth.
        shown = np.ptp(np.asarray(picture.convert("RGB"))[:150].astype(int), axis=2) > 50
    assert 100 < shown.sum() < shown.size / 4
