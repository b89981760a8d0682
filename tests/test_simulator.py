"""Whole simulations against analytic solutions, conservation laws and the reference."""

from __future__ import annotations

import itertools
import logging
import math
from typing import Any

import numpy as np
import pytest
import reference
import warp as wp
from reference import EPSILON, ROUND_OFF, Touch, World
from worlds import make_material, make_scene, make_voxels, set_state

from warpjelly.errors import DivergedError
from warpjelly.kernels import fields
from warpjelly.kernels.turns import Turn
from warpjelly.simulator import Simulator
from warpjelly.stepping import MAX_CAPTURED_SUBSTEPS

GRAVITY = [0.5, -9.81, 0.25]
# A body with an edge contact, so that particles coincide at rest.
CRANKED = np.array([[[1, 0], [0, 1]], [[1, 0], [1, 1]]], bool)


def make_cube(**changes: Any) -> dict[str, Any]:
    """Return a cube of 8 particles and 1 m."""
    return {"type": "cube", "material": "jelly", "particles_per_edge": 2, **changes}


def test_free_fall_follows_the_sum_of_the_scheme(precision: str, device: str) -> None:
    """Fall by x0 + v0 n dt + g dt^2 n (n + 1) / 2, which is what semi-implicit Euler makes of free fall."""
    body = make_cube(velocity=[1.0, 2.0, -3.0], position=[0.5, 2.0, 0.0])
    simulator = Simulator(make_scene(bodies=[body], gravity=GRAVITY, solver={"precision": precision}), device=device)
    x0, n, dt = simulator.positions.astype(float), 500, simulator.dt
    simulator.step(n)
    expected = x0 + np.array(body["velocity"]) * n * dt + np.array(GRAVITY) * dt**2 * n * (n + 1) / 2
    # Each step rounds x by half an epsilon of up to 4 m and v by one of up to 8 m/s, which acts on x for n dt.
    # The springs keep the cube in shape against that.
    bound = EPSILON[precision] * n * (4 + 8 * n * dt)
    np.testing.assert_allclose(simulator.positions, expected, rtol=0, atol=bound)
    velocity = np.array(body["velocity"]) + np.array(GRAVITY) * n * dt
    np.testing.assert_allclose(simulator.velocities, np.tile(velocity, (8, 1)), rtol=0, atol=EPSILON[precision] * n * 8)


def breathe(law: str, damping: float, precision: str, **solver: Any) -> tuple[Any, float, float]:
    """Return a scene of a cube of 8 particles, and the squared frequency and damping of its uniform dilation.

    With x = (1 + s) x_rest every spring stretches by r s, whatever s: the cube is a linear oscillator. Springs store
    1/2 k r^2 s^2, on 12 edges with r = a, 12 face diagonals with r = 2^0.5 a and 4 body diagonals with r = 3^0.5 a,
    and the 8 particles at 3^0.5/2 a from the centre carry 1/2 6 m a^2 s'^2. Hence s'' = -w2 s - c s'.
    """
    a, m, edge, diagonal = 0.5, 0.02, 30.0, 20.0
    materials = {
        "structural": {"stiffness": edge, "damping": damping},
        "shear": {"stiffness": diagonal, "damping": damping / 2},
        "bend": {"stiffness": 1e3, "damping": 1e3},
        "particle_mass": m,
        "law": law,
    }
    # Sum of k r^2 / (6 m a^2): with law strain, k r^2 is k_s r.
    power = 1 if law == "strain" else 2
    lengths = 12 * a**power, 12 * (2**0.5 * a) ** power + 4 * (3**0.5 * a) ** power
    w2 = (edge * lengths[0] + diagonal * lengths[1]) / (6 * m * a**2)
    c = damping * (lengths[0] + lengths[1] / 2) / (6 * m * a**2)
    solver = {"precision": precision, **solver}
    scene = make_scene(bodies=[make_cube(size=a)], materials={"jelly": materials}, solver=solver)
    return scene, w2, c


@pytest.mark.parametrize("law", ["strain", "hooke"])
@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_cube_breathes_as_the_scheme_says(law: str, damping: float, precision: str, device: str) -> None:
    """Breathe at arccos(1 - (w dt)^2 / 2) / dt when undamped, and fade by (1 - c dt)^(1/2) a step when damped."""
    scene, w2, c = breathe(law, damping, precision)
    simulator = Simulator(scene, device=device)
    rest, dt, start = simulator.positions.astype(float), simulator.dt, 0.25
    set_state(simulator, x=(1 + start) * rest)
    # s(n+1) = s(n) + dt s'(n+1) and s'(n+1) = (1 - c dt) s'(n) - w2 dt s(n) have the characteristic equation
    # z^2 - (2 - c dt - w2 dt^2) z + (1 - c dt) = 0, with z = q exp(+-i phi), and s(1) = (1 - w2 dt^2) s(0).
    q = math.sqrt(1 - c * dt)
    phi = math.acos((2 - c * dt - w2 * dt**2) / (2 * q))
    if damping == 0:
        assert phi == pytest.approx(math.acos(1 - w2 * dt**2 / 2), rel=1e-12)
    sine = ((1 - w2 * dt**2) / q - math.cos(phi)) / math.sin(phi)
    # A step rounds s by about ROUND_OFF at worst; in an undamped oscillator these add up and swing on with 1/sin(phi).
    bound = ROUND_OFF[precision] / math.sin(phi)
    for n in range(40, 401, 40):
        simulator.step(40)
        expected = start * q**n * (math.cos(n * phi) + sine * math.sin(n * phi))
        found = (simulator.positions * rest).sum(axis=1) / (rest * rest).sum(axis=1) - 1
        np.testing.assert_allclose(found, expected, rtol=0, atol=n * bound)
    # It was more than a period.
    assert 400 * phi > 2 * math.pi


def test_rotation_and_momentum_last_in_free_flight(precision: str, device: str) -> None:
    """Keep momentum and angular momentum of a spinning, damped, deforming body to round-off."""
    body = make_voxels(
        CRANKED, cell_size=0.2, particles_per_edge=3, velocity=[1.0, -2.0, 0.5], angular_velocity=[4.0, -6.0, 5.0]
    )
    material = make_material(40.0, 0.02, density=300.0)
    simulator = Simulator(
        make_scene(bodies=[body], materials={"jelly": material}, solver={"precision": precision}), device=device
    )
    x = simulator.positions
    set_state(simulator, x=x * [[1.1, 0.9, 1.05]])
    before, m = simulator.diagnostics(), simulator.masses[:, None].astype(float)
    # Spring forces are opposite along their line, and x(n+1) x v(n+1) = x(n) x v(n+1): both are conserved exactly.
    # What is left is the rounding of x, v, f and 1/m in each of n steps, of the largest values that occur.
    steps, moved, forces = 400, 0.0, 0.0
    for _ in range(steps // 20):
        simulator.step(20)
        moved = max(moved, (m * np.abs(simulator.velocities)).sum())
        forces = max(forces, np.abs(simulator.forces).sum())
    after, dt = simulator.diagnostics(), simulator.dt
    bound = EPSILON[precision] * steps * (moved + 10 * forces * dt)
    assert np.abs(before["angular_momentum"]).max() > 1e-2
    assert after["elastic"] > 0
    np.testing.assert_allclose(after["momentum"], before["momentum"], rtol=0, atol=bound)
    reach = np.abs(simulator.positions).max()
    np.testing.assert_allclose(after["angular_momentum"], before["angular_momentum"], rtol=0, atol=2 * reach * bound)


@pytest.mark.parametrize("law", ["strain", "hooke"])
def test_energy_of_an_undamped_cube_is_bounded(law: str, device: str) -> None:
    """Keep the energy of a vibrating cube within w dt / 2 (+10 %) for a thousand steps."""
    stiffness = 40.0 if law == "strain" else 100.0
    scene = make_scene(
        bodies=[make_cube(particles_per_edge=3, size=0.5)],
        materials={"jelly": make_material(stiffness, 0.0, law=law)},
    )
    simulator, world = Simulator(scene, device=device), World(scene)
    rng = np.random.default_rng(3)
    set_state(simulator, x=world.x + rng.normal(scale=0.01, size=world.x.shape))
    start, energies = simulator.diagnostics(), []
    for _ in range(500):
        simulator.step(2)
        now = simulator.diagnostics()
        energies.append(now["kinetic"] + now["elastic"])
    # The scheme conserves H + dt/2 v.F of linear springs, and |v.F| <= w H in each mode; at rest v.F = 0.
    bound = 1.1 * world.top_frequency() * simulator.dt / 2
    drift = np.abs(np.array(energies) / start["elastic"] - 1)
    assert drift.max() <= bound
    # The bound is of use.
    assert bound < 0.25


def test_deformed_cube_regains_its_shape(precision: str, device: str) -> None:
    """Return to the rest shape, turned and moved, after a squeeze and a shear."""
    scene = make_scene(
        bodies=[make_cube(particles_per_edge=4, size=0.6)],
        materials={"jelly": make_material(80.0, 0.05)},
        solver={"precision": precision},
    )
    simulator = Simulator(scene, device=device)
    rest = simulator.positions.astype(float)
    squeeze = np.array([[0.8, 0.2, 0.0], [0.0, 1.1, 0.1], [0.0, 0.0, 0.9]])
    set_state(simulator, x=rest @ squeeze, v=rest @ squeeze[::-1])

    def misfit() -> float:
        x = simulator.positions.astype(float)
        return np.abs(x - reference.fit_rigidly(rest, x)).max()

    assert misfit() > 0.02
    simulator.step(8000)
    # A mode of frequency w fades by exp(-w^2 b t/2), b = d/k = 1/1600 s: the softest, at 128 rad/s, by exp(-40) in 8 s.
    # What is left is the rounding of places up to 1 m, of the springs that hold them and of the fit.
    assert misfit() < 32 * EPSILON[precision]


def make_random_world(seed: int) -> dict[str, Any]:
    """Return a small scene with random bodies, materials and colliders of all kinds, in binary fractions."""
    rng = np.random.default_rng(seed)

    def draw(low: float, high: float, *size: int) -> Any:
        return (np.round(rng.uniform(low, high, size) * 64) / 64).tolist()

    def direction() -> list[float]:
        return (np.eye(3)[1] + draw(-0.4, 0.4, 3)).tolist()

    materials = {
        f"m{i}": {
            **{k: {"stiffness": draw(10, 40), "damping": draw(0, 0.1)} for k in ("structural", "shear", "bend")},
            "law": law,
            **mass,
        }
        for i, (law, mass) in enumerate([("strain", {"density": 400.0}), ("hooke", {"particle_mass": 0.01})])
    }
    grid = rng.random((2, 2, 2)) < 0.6
    grid[0, 0, 0] = True
    motion = {"velocity": draw(-1, 1, 3), "angular_velocity": draw(-4, 4, 3), "rotation": draw(-180, 180, 3)}
    bodies = [
        make_voxels(grid, material="m0", cell_size=0.25, position=[0.25, 0.5, 0.125], **motion),
        make_cube(material="m1", size=0.375, particles_per_edge=3, position=[-0.5, 0.5, 0.0], **motion),
    ]
    damping = {"damping": 0.25, "stiffness": 500.0}
    colliders = [
        {"type": "half_space", "center": [0.0, -0.5, 0.0], "normal": direction(), **damping},
        {"type": "plane", "center": [0.25, -0.1875, 0.0], "normal": direction(), "tangent": [1.0, 0.0, 0.5],
         "size": [0.75, 1.0], "threshold": 0.125, **damping},
        {"type": "sphere", "center": [-0.5, -0.25, 0.0625], "radius": 0.3125, **damping},
        {"type": "box", "center": [0.0, 0.5, 0.0], "size": [2.0, 2.5, 1.25], **damping},
    ]  # fmt: skip
    return {"bodies": bodies, "colliders": colliders, "materials": materials, "gravity": GRAVITY}


@pytest.mark.parametrize("seed", range(3))
def test_trajectories_match_the_reference(seed: int, device: str) -> None:
    """Follow random small worlds with bounces off all colliders for 1000 steps like the reference."""
    scene = make_scene(**make_random_world(seed))
    simulator, world = Simulator(scene, device=device), World(scene)
    np.testing.assert_allclose(simulator.masses, world.m, rtol=4 * EPSILON["float64"])
    np.testing.assert_allclose(simulator.positions, world.x, rtol=0, atol=1e-15)
    np.testing.assert_allclose(simulator.velocities, world.v, rtol=0, atol=1e-14)
    contacts = 0
    for _ in range(10):
        simulator.step(100)
        world.step(100)
        contacts += simulator.diagnostics()["contacts"]
        # Both round differently, by 1e-16 m a step; bounces and vibrations of 1000 steps blow that up, but not by 1e6.
        np.testing.assert_allclose(simulator.positions, world.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(simulator.velocities, world.v, rtol=0, atol=1e-7)
    assert contacts > 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirrored_scene_gives_the_mirrored_result(axis: int, device: str) -> None:
    """Mirror everything in a scene and find the mirrored motion."""
    plain = make_random_world(7)
    sign = np.where(np.arange(3) == axis, -1.0, 1.0)

    def mirror(table: dict[str, Any]) -> dict[str, Any]:
        result = dict(table)
        for key in ("position", "velocity", "center", "normal", "tangent"):
            if key in table:
                result[key] = (sign * table[key]).tolist()
        # A rotation keeps its sense about the mirrored axis and reverses it about the others.
        for key in ("rotation", "angular_velocity"):
            if key in table:
                result[key] = (-sign * table[key]).tolist()
        return result

    mirrored = {**plain, "gravity": (sign * GRAVITY).tolist()}
    mirrored["colliders"] = [mirror(collider) for collider in plain["colliders"]]
    mirrored["bodies"] = [mirror(body) for body in plain["bodies"]]
    grid, *_ = make_scene(**plain).bodies[0].grid()
    mirrored["bodies"][0]["layers"] = make_voxels(np.flip(grid.dense(), axis))["layers"]
    scenes = make_scene(**plain), make_scene(**mirrored)

    # Which particle becomes which: its vertex and its cells are mirrored within the grid.
    order, first = [], 0
    for keys, other in zip(World(scenes[0]).keys, World(scenes[1]).keys, strict=True):
        size = max(key[0][axis] for key in keys) if len(keys) == 27 else 2
        number = {key: first + i for i, key in enumerate(other)}
        for vertex, cells in keys:
            flipped = tuple(size - c if k == axis else c for k, c in enumerate(vertex))
            around = frozenset(tuple(size - 1 - c if k == axis else c for k, c in enumerate(cell)) for cell in cells)
            order.append(number[flipped, around])
        first += len(keys)
    simulators = [Simulator(scene, device=device) for scene in scenes]
    contacts = 0
    for _ in range(10):
        for simulator in simulators:
            simulator.step(100)
        found, image = (simulator.positions for simulator in simulators)
        # Forces are summed in another order, so the last bits differ: as with the reference.
        np.testing.assert_allclose(image[order] * sign, found, rtol=0, atol=1e-9)
        contacts += simulators[0].diagnostics()["contacts"]
    assert contacts > 0


def run_world(steps: list[int], precision: str = "float32", device: str = "cpu") -> bytes:
    """Return the bits of positions and velocities of a random world after some calls of step."""
    simulator = Simulator(make_scene(**make_random_world(5), solver={"precision": precision}), device=device)
    for count in steps:
        simulator.step(count)
    return simulator.state.x.numpy().tobytes() + simulator.state.v.numpy().tobytes()


def test_cpu_repeats_itself(precision: str) -> None:
    """Simulate the same bits twice on the CPU."""
    assert run_world([500], precision) == run_world([500], precision)


def test_grouping_of_steps_does_not_matter(precision: str) -> None:
    """Simulate the same bits in one call, one by one and in any groups, also across replays of one graph."""
    whole = run_world([192], precision)
    assert whole != run_world([191], precision)
    for steps in ([1] * 192, [7, 64, 0, 121], [191, 1], [10] * 19 + [2]):
        assert run_world(steps, precision) == whole


def test_long_frames_replay_their_graph(device: str) -> None:
    """Advance a frame of more substeps than a graph holds by exactly that many."""
    scene = make_scene(bodies=[make_cube(velocity=[1.0, 0.0, 0.0])], fps=5.0)
    simulator = Simulator(scene, device=device)
    assert simulator.substeps == 200 > MAX_CAPTURED_SUBSTEPS
    start = simulator.positions
    simulator.advance_frame()
    assert simulator.substep_count == 200
    # x0 + v n dt, rounded at each of 200 steps.
    np.testing.assert_allclose(simulator.positions - start, np.tile([0.2, 0, 0], (8, 1)), rtol=0, atol=1e-13)


def test_missing_graph_capture_falls_back(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, precision: str
) -> None:
    """Simulate the same bits without graphs, and say so once."""
    expected = run_world([64, 65, 3], precision)

    def refuse(*args: Any, **options: Any) -> None:
        raise RuntimeError("no graphs today")

    monkeypatch.setattr(wp, "ScopedCapture", refuse)
    with caplog.at_level(logging.WARNING):
        assert run_world([64, 65, 3], precision) == expected
    warnings = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert "no graphs today" in warnings[0]


def test_divergence_names_body_and_particle(device: str) -> None:
    """Stop at the frame in which a body blows up, and say which particle of which body it was."""
    stiff = {"calm": make_material(), "wild": make_material(1e8)}
    bodies = [make_cube(material="calm"), make_cube(name="boom", material="wild", angular_velocity=[1.0, 2.0, 3.0])]
    simulator = Simulator(make_scene(bodies=bodies, materials=stiff), device=device)
    # Below the limit a frame is fine; at k dt^2/m = 1e4 each step multiplies the error by as much.
    assert simulator.first_lost() is None
    with pytest.raises(DivergedError, match=r"particle [0-7] of 'boom'"):
        for _ in range(100):
            simulator.advance_frame()
    first = simulator.first_lost()
    assert first is not None
    assert first >= 8
    # The other body goes on.
    assert np.isfinite(simulator.positions[:8]).all()


@pytest.mark.parametrize("part", ["x", "v"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_every_number_that_is_not_finite_is_found(part: str, value: float, precision: str, device: str) -> None:
    """Find the first of several particles whose position or velocity is not finite, in any component."""
    simulator = Simulator(make_scene(solver={"precision": precision}), device=device)
    assert simulator.first_lost() is None
    for axis in range(3):
        broken = np.zeros((8, 3))
        broken[5, axis] = broken[7] = value
        set_state(simulator, x=np.zeros((8, 3)), v=np.zeros((8, 3)))
        assert simulator.first_lost() is None
        set_state(simulator, **{part: broken})
        assert simulator.first_lost() == 5


def test_precision_is_what_the_scene_says(precision: str, device: str) -> None:
    """Hold and advance every quantity in the precision of the scene."""
    body = make_cube(position=[1.0 / 3, 0.0, 0.0], velocity=[1.0 / 3, 0.0, 0.0])
    materials = {"jelly": make_material(0.0, 0.0)}
    scene = make_scene(bodies=[body], materials=materials, solver={"precision": precision}, gravity=[0.1, 0.0, 0.0])
    simulator = Simulator(scene, device=device)
    simulator.step(1)
    for array in (simulator.positions, simulator.velocities, simulator.forces, simulator.masses):
        assert array.dtype == np.dtype(precision)
    # v = v0 + dt g to a few epsilons of v; not better than half of one where v is float32.
    error = abs(simulator.velocities[0, 0].astype(float) - (1 / 3 + 1e-3 * 0.1))
    assert error <= 4 * EPSILON[precision]
    if precision == "float32":
        assert error > EPSILON["float64"]


def test_read_arrays_are_copies(device: str) -> None:
    """Return arrays that neither change with the simulation nor change it."""
    simulator = Simulator(make_scene(gravity=GRAVITY), device=device)
    names = ("positions", "velocities", "forces", "masses")
    before = {name: getattr(simulator, name) for name in names}
    kept = {name: array.copy() for name, array in before.items()}
    surface = simulator.shapes()[0]
    points = surface.points.copy()
    simulator.step(5)
    simulator.shapes()
    np.testing.assert_array_equal(surface.points, points)
    for name in names:
        np.testing.assert_array_equal(before[name], kept[name])
        now = getattr(simulator, name)
        getattr(simulator, name)[:] = 99.0
        np.testing.assert_array_equal(getattr(simulator, name), now)
    assert (simulator.positions != kept["positions"]).any()


def test_time_counts_substeps(device: str) -> None:
    """Count time in steps of 1/(fps substeps) s, with as few substeps as dt allows."""
    # 1/60 s in steps of at most 3 ms: six of 1/360 s.
    simulator = Simulator(make_scene(fps=60.0, solver={"dt": 3e-3}), device=device)
    assert simulator.substeps == 6
    assert simulator.time == 0
    simulator.step(3)
    assert simulator.time == pytest.approx(3 / 360, rel=1e-15)
    simulator.advance_frame()
    assert simulator.time == pytest.approx(9 / 360, rel=1e-15)
    simulator.step(0)
    assert simulator.substep_count == 9


def test_diagnostics_match_their_formulas(precision: str, device: str) -> None:
    """Measure energies, momenta and contacts of a moving scene like NumPy does."""
    scene = make_scene(**make_random_world(2), solver={"precision": precision})
    simulator, world = Simulator(scene, device=device), World(scene)
    touched = 0
    for _ in range(6):
        simulator.step(100)
        measured = simulator.diagnostics()
        x, v, m = (a.astype(float) for a in (simulator.positions, simulator.velocities, simulator.masses))
        # What is remembered of the only collider that remembers, the plane; nothing of the others.
        held = simulator.state.stamps.numpy()[0] >= simulator.state.step.numpy()[0] - 1
        memory = Touch(np.zeros_like(x), np.where(held, 0.0, -1.0), np.zeros(len(x)))
        before = np.array(simulator.state.x_start.numpy().T, float)
        depths, stored = [], 0.0
        for collider in scene.colliders:
            for touch in reference.find_touches(
                collider, x, world.origins, before=before, earlier=[memory], anywhere=False
            ):
                depths += touch.depth[touch.here].tolist()
                stored += reference.contact_energy(collider, scene.contact, touch)
        touched += len(depths)
        momentum, swirl = m[:, None] * v, m[:, None] * np.cross(x, v)
        weight = m * (x @ scene.gravity_vector)
        elastic = reference.elastic_energy(x, world.ends, world.rest, world.k)
        # Each term is as exact as ROUND_OFF of its parts; lengths are up to 1 m and depths far less than that, and
        # an energy 1/2 k s^2 answers an error of s by k s.
        close = ROUND_OFF[precision]
        assert measured["kinetic"] == pytest.approx((0.5 * m * (v * v).sum(axis=1)).sum(), rel=close)
        assert measured["potential"] == pytest.approx(-weight.sum(), rel=0, abs=close * np.abs(weight).sum())
        stretch = np.abs(np.linalg.norm(x[world.ends[:, 1]] - x[world.ends[:, 0]], axis=1) - world.rest)
        assert measured["elastic"] == pytest.approx(elastic, rel=close, abs=close * (world.k * stretch).sum())
        assert measured["contact"] == pytest.approx(stored, rel=close, abs=close * 500 * sum(depths))
        np.testing.assert_allclose(
            measured["momentum"], momentum.sum(axis=0), rtol=0, atol=close * np.abs(momentum).sum()
        )
        np.testing.assert_allclose(
            measured["angular_momentum"], swirl.sum(axis=0), rtol=0, atol=close * np.abs(swirl).sum()
        )
        assert measured["max_speed"] == pytest.approx(np.linalg.norm(v, axis=1).max(), rel=close)
        assert measured["penetrations"].max() == pytest.approx(max(depths, default=0.0), abs=close)
        assert measured["contacts"] == len(depths)
    assert touched > 0


def test_forces_are_those_of_the_last_substep(precision: str, device: str) -> None:
    """Return the forces that made the last change of velocity, f = m dv/dt."""
    scene = make_scene(**make_random_world(4), solver={"precision": precision})
    simulator, world = Simulator(scene, device=device), World(scene)
    # At the start, those at time zero.
    scale = np.abs(world.forces()).max() + (world.k * world.rest).max() * 17
    np.testing.assert_allclose(simulator.forces, world.forces(), rtol=0, atol=ROUND_OFF[precision] * scale)
    for _ in range(5):
        simulator.step(79)
        before = simulator.velocities.astype(float)
        simulator.step(1)
        # v is rounded by half an epsilon, twice; m/dt makes a force of it.
        change = (simulator.velocities - before) / simulator.dt * world.m[:, None]
        bound = EPSILON[precision] * (
            2 * np.abs(before).max() / simulator.dt * world.m.max() + np.abs(change).max() * 4
        )
        np.testing.assert_allclose(simulator.forces, change, rtol=0, atol=bound)


def test_bodies_are_placed_as_told(precision: str, device: str) -> None:
    """Turn about x, then y, then z through the origin of the body, move, and set it off about its centre of mass."""
    turn = [90.0, 90.0, 0.0]
    cells = np.zeros((2, 1, 1), bool)
    cells[0] = True
    body = make_voxels(
        cells,
        cell_size=1.0,
        rotation=turn,
        position=[4.0, 5.0, 6.0],
        velocity=[1.0, 2.0, 3.0],
        angular_velocity=[0.0, 0.0, 2.0],
    )
    simulator = Simulator(make_scene(bodies=[body], solver={"precision": precision}), device=device)
    # The cube spans x -1 to 0 beside the centre of the grid; y and z -1/2 to 1/2.
    corners = np.array(list(itertools.product((-1.0, 0.0), (-0.5, 0.5), (-0.5, 0.5))))
    # About x by 90 degrees: (x, y, z) -> (x, -z, y); then about y: (x, y, z) -> (z, y, -x).
    about_x = np.stack([corners[:, 0], -corners[:, 2], corners[:, 1]], axis=1)
    turned = np.stack([about_x[:, 2], about_x[:, 1], -about_x[:, 0]], axis=1) + np.array([4, 5, 6])
    # Cosines of 90 degrees and sums up to 7 round by some epsilons.
    bound = 16 * EPSILON[precision]
    np.testing.assert_allclose(simulator.positions, turned, rtol=0, atol=bound)
    arm = turned - turned.mean(axis=0)
    # w x arm with w along z: (-w y, w x, 0).
    expected = np.array([1, 2, 3]) + np.stack([-2 * arm[:, 1], 2 * arm[:, 0], 0 * arm[:, 2]], axis=1)
    np.testing.assert_allclose(simulator.velocities, expected, rtol=0, atol=bound)


@pytest.mark.parametrize("mass", [{"density": 250.0}, {"particle_mass": 0.125}, {}])
def test_spin_and_speed_are_those_of_the_centre_of_mass(mass: dict[str, float], device: str) -> None:
    """Give momentum M v and angular momentum about the centre of mass I w, and the mass that the material says."""
    velocity, spin = np.array([1.0, -2.0, 3.0]), np.array([3.0, 1.0, -2.0])
    body = make_voxels(
        CRANKED, cell_size=0.5, particles_per_edge=3, rotation=[10.0, 20.0, 30.0], position=[1.0, 0.0, 2.0],
        velocity=velocity.tolist(), angular_velocity=spin.tolist(),
    )  # fmt: skip
    material = make_material(**mass)
    simulator = Simulator(make_scene(bodies=[body], materials={"jelly": material}), device=device)
    x, m, measured = simulator.positions, simulator.masses[:, None], simulator.diagnostics()
    # Some hundred additions.
    close = 1000 * EPSILON["float64"]
    if "density" in mass:
        # Lumping keeps the mass: density x volume.
        assert m.sum() == pytest.approx(250.0 * CRANKED.sum() * 0.5**3, rel=close)
        assert np.ptp(m) > 0
    else:
        np.testing.assert_array_equal(m, mass.get("particle_mass", 0.01))
    np.testing.assert_allclose(measured["momentum"], m.sum() * velocity, rtol=close)
    center = (m * x).sum(axis=0) / m.sum()
    arm = x - center
    inertia = m[:, :, None] * ((arm * arm).sum(axis=1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None])
    expected = inertia.sum(axis=0) @ spin + m.sum() * np.cross(center, velocity)
    np.testing.assert_allclose(measured["angular_momentum"], expected, rtol=close)


def test_surfaces_show_the_state(precision: str, device: str) -> None:
    """Show places, velocities, force magnitudes and outward normals of the surface particles of each body."""
    bodies = [make_cube(particles_per_edge=3, size=0.5), make_voxels(CRANKED, position=[0.0, 2.0, 0.0], cell_size=0.5)]
    simulator = Simulator(make_scene(bodies=bodies, gravity=GRAVITY, solver={"precision": precision}), device=device)
    simulator.step(20)
    x, v, f = simulator.positions, simulator.velocities, simulator.forces
    shapes, shown = simulator.model.shapes, simulator.shapes()
    for body, shape, sample in zip(simulator.model.bodies, shapes, shown, strict=True):
        here = shape.particles[:, 0] + body.particles.start
        np.testing.assert_array_equal(sample.points, x[here].astype(np.float32))
        np.testing.assert_array_equal(sample.velocities, v[here].astype(np.float32))
        np.testing.assert_allclose(sample.forces, np.linalg.norm(f[here], axis=1), rtol=4 * EPSILON["float32"])
        # Area vectors of the quads, half the cross products of their diagonals, summed at their corners.
        quads = shape.corners.reshape(-1, 4)
        corners = sample.points[quads].astype(float)
        area = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
        normals = np.zeros((len(here), 3))
        np.add.at(normals, quads, area[:, None])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        # Areas of up to 1/4 m^2 from places up to 3 m away, relative to those of at least 1/16 m^2.
        np.testing.assert_allclose(sample.normals, normals, rtol=0, atol=ROUND_OFF["float32"])
    # Six faces of 3 x 3 points each, whose normals point away from the centre of the cube.
    assert len(shown[0].points) == 54
    outward = shown[0].points - x[:27].mean(axis=0)
    assert ((shown[0].normals * outward).sum(axis=1) > 0).all()


def test_rows_may_be_more_than_a_gigabyte_apart() -> None:
    """Write to all three rows of an array for 300 million particles, in native code: it takes no memory untouched."""
    rows, count = wp.empty((3, 300_000_000), dtype=wp.float32, device="cpu"), 70
    f = rows[:, :count]
    inputs = [wp.array([0, count], dtype=wp.int32, device="cpu"), 1, wp.ones(count, dtype=wp.float32, device="cpu")]
    gravity = wp.array([[1.0, 2.0, 3.0]], dtype=wp.vec3f, device="cpu")
    wp.launch(fields.set_gravity_forces, (1, 1), inputs=[Turn(), *inputs, gravity], outputs=[f], device="cpu")
    np.testing.assert_array_equal(f.numpy(), np.repeat([[1.0], [2.0], [3.0]], count, axis=1))
