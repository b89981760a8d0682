"""The hand that pulls particles: its law, what it moves, and what it leaves alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference import EPSILON, ROUND_OFF, World
from worlds import make_material, make_scene, set_state

from warpjelly.errors import InputError
from warpjelly.grip import HELD_SHARE, MAX_HELD, MAX_TURN, SWING_RATE, Hold
from warpjelly.scene import Scene
from warpjelly.simulator import Simulator

INTEGRATORS = ("explicit_euler", "semi_implicit_euler", "rk2", "rk4")


def interactive(scene: Scene, device: str = "cpu", **options: int) -> Simulator:
    """Return a simulator with a hand."""
    return Simulator(scene, device=device, interactive=True, **options)


def point_scene(mass: float = 0.01, **solver: object) -> Scene:
    """Return a single free particle."""
    body = {"name": "point", "type": "network", "points": [[0.0, 0.0, 0.0]], "material": "jelly"}
    return make_scene(materials={"jelly": make_material(particle_mass=mass)}, bodies=[body], solver=dict(solver))


def rate_of(simulator: Simulator, hold: Hold) -> float:
    """Return the rate of the springs of a hand, 1/s, from its definition, where nothing is pinned."""
    body = next(body for body in simulator.model.bodies if body.name == hold.body)
    mass = simulator.masses.astype(float)[body.particles]
    held = (hold.weights * mass[hold.particles]).sum()
    return min(SWING_RATE * math.sqrt(mass.sum() / held), MAX_TURN / simulator.dt)


def pulls(simulator: Simulator, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the force of the hand on each particle, from the law, float64 [particle_count, 3]."""
    assert simulator.grip is not None
    hold = simulator.grip.hold
    force = np.zeros_like(x)
    if hold is not None:
        body = next(body for body in simulator.model.bodies if body.name == hold.body)
        chosen = body.particles.start + hold.particles
        held, rate = (hold.weights * simulator.masses.astype(float)[chosen])[:, None], rate_of(simulator, hold)
        force[chosen] = -held * (rate**2 * (x[chosen] - hold.hand - hold.offsets.T) + 2.0 * rate * v[chosen])
    return force


def test_the_force_is_that_of_damped_springs(precision: str, device: str) -> None:
    """Pull the held particles of the second body by k (place - x) - c v, and no others."""
    cube = {"type": "cube", "material": "jelly", "particles_per_edge": 5}
    bodies = [{**cube, "name": "a"}, {**cube, "name": "b", "position": [3.0, 0.0, 0.0]}]
    simulator = interactive(make_scene(bodies=bodies, solver={"precision": precision}), device)
    rng = np.random.default_rng(1)
    x = simulator.positions.astype(float) + rng.normal(scale=0.01, size=simulator.positions.shape)
    v = rng.normal(size=x.shape)
    set_state(simulator, x=x, v=v)
    simulator.update_forces()
    alone = simulator.forces.astype(float)
    assert simulator.grip is not None
    simulator.grip.grab("b", np.array([3.5, 0.5, 0.5]))
    simulator.grip.move(np.array([3.7, 1.5, 0.4]))
    simulator.update_forces()
    x, v = simulator.positions.astype(float), simulator.velocities.astype(float)
    expected = pulls(simulator, x, v)
    assert np.count_nonzero(expected.any(axis=1)) == round(HELD_SHARE * 125)
    # Some operations of the size of the sums of all forces.
    tolerance = ROUND_OFF[precision] * (np.abs(alone).max() + np.abs(expected).max())
    np.testing.assert_allclose(simulator.forces - alone, expected, rtol=0.0, atol=tolerance)
    np.testing.assert_allclose(simulator.grip.force(), expected.sum(axis=0), rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_pulled_motion_is_that_of_the_reference(integrator: str) -> None:
    """Move a cube that is pulled as NumPy does, for 60 steps."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 3, "rotation": [20.0, 5.0, 0.0]}
    scene = make_scene(bodies=[body], solver={"integrator": integrator}, gravity=[0.0, -9.81, 0.0])
    simulator = interactive(scene)
    assert simulator.grip is not None
    simulator.grip.grab("cube", simulator.positions[0])
    simulator.grip.move(simulator.positions[0] + [0.3, 0.4, -0.2])

    class Pulled(World):
        def evaluate(self, x, v, *arguments, **options):
            total, power = super().evaluate(x, v, *arguments, **options)
            return total + pulls(simulator, x, v), power

    reference = Pulled(scene)
    np.testing.assert_allclose(simulator.positions, reference.x, rtol=0.0, atol=1e-15)
    simulator.step(60)
    reference.step(60)
    # Both round in float64, each step some dozen times; errors of a position are amplified by no more than the steps.
    tolerance = 60 * 100 * EPSILON["float64"]
    np.testing.assert_allclose(simulator.positions, reference.x, rtol=0.0, atol=tolerance)
    assert np.abs(reference.x - World(scene).x).max() > 0.01


def test_a_free_particle_goes_where_the_hand_is() -> None:
    """Follow the critically damped recursion, which ends at the hand."""
    simulator = interactive(point_scene())
    assert simulator.grip is not None
    simulator.grip.grab("point", np.array([0.1, 0.0, 0.0]))
    simulator.grip.move(np.array([1.1, 2.0, 0.0]))
    x, v, dt = np.zeros(3), np.zeros(3), simulator.dt
    for _ in range(1500):
        v = v - dt * (SWING_RATE**2 * (x - [1.0, 2.0, 0.0]) + 2.0 * SWING_RATE * v)
        x = x + dt * v
    simulator.step(1500)
    np.testing.assert_allclose(simulator.positions[0], x, rtol=0.0, atol=1500 * 10 * EPSILON["float64"])
    # 22 time constants of 1/15 s.
    np.testing.assert_allclose(x, [1.0, 2.0, 0.0], atol=1e-7)


def test_a_body_comes_to_rest_where_it_was_pulled(precision: str) -> None:
    """Displace a cube without gravity by as much as the hand, neither turned nor deformed."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 5}
    material = make_material(stiffness=100.0, damping=0.1)
    scene = make_scene(bodies=[body], materials={"jelly": material}, solver={"precision": precision})
    simulator = interactive(scene)
    start = simulator.positions.astype(float)
    assert simulator.grip is not None
    simulator.grip.grab("cube", np.array([0.5, 0.5, 0.5]))
    simulator.grip.move(np.array([0.6, 0.8, 0.3]))
    errors = []
    for _ in range(3):
        simulator.step(20_000)
        moved = simulator.positions.astype(float) - start
        errors.append(np.abs(moved - [0.1, 0.3, -0.2]).max())
    # Turning about the corner, which 8 particles some 0.2 m apart hold, is the slowest to die away, exponentially.
    assert errors[0] < 0.05
    assert errors[1] < 0.5 * errors[0]
    assert errors[2] < 0.5 * errors[1]


def test_momentum_is_the_impulse_of_the_pull() -> None:
    """Gain no more and no less than the sum of the force of the hand over time."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 4, "velocity": [0.3, 0.0, 0.1]}
    soft = {"jelly": make_material(stiffness=100.0, damping=0.1)}
    simulator = interactive(make_scene(bodies=[body], materials=soft))
    assert simulator.grip is not None
    before, impulse = simulator.diagnostics()["momentum"], np.zeros(3)
    simulator.grip.grab("cube", np.array([0.5, 0.1, 0.2]))
    for number in range(200):
        simulator.grip.move(np.array([0.5 + 0.01 * number, 0.1, 0.2 - 0.004 * number]))
        impulse += simulator.dt * simulator.grip.force()
        simulator.step()
    gained = simulator.diagnostics()["momentum"] - before
    # Per step some dozen roundings of forces that springs and hand exert, which are below 1 kN.
    tolerance = 200 * 64 * 12 * EPSILON["float64"] * simulator.dt * 1e3
    np.testing.assert_allclose(gained, impulse, rtol=0.0, atol=tolerance)
    assert np.linalg.norm(impulse) > 0.1


def test_pinned_particles_stay() -> None:
    """Hold free particles only, and refuse a body that has none."""
    cube = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 3}
    half = {**cube, "pinned": [{"lower": [-0.5, -0.5, -0.5], "upper": [0.5, 0.5, 0.0]}]}
    simulator = interactive(make_scene(bodies=[half]))
    assert simulator.grip is not None
    start, pinned = simulator.positions, simulator.model.particle_inv_mass.numpy() == 0.0
    # Of a corner that is pinned, the nearest free particle is taken.
    simulator.grip.grab("cube", np.array([-0.5, -0.5, -0.5]))
    simulator.grip.move(np.array([-0.5, -3.0, -0.5]))
    simulator.step(100)
    np.testing.assert_array_equal(simulator.positions[pinned], start[pinned])
    assert np.abs(simulator.positions - start).max() > 0.01
    whole = {**cube, "pinned": [{"lower": [-0.5] * 3, "upper": [0.5] * 3}]}
    simulator = interactive(make_scene(bodies=[whole]))
    assert simulator.grip is not None
    with pytest.raises(InputError, match=r"bodies\.cube: cannot be pulled, as all of its particles are pinned"):
        simulator.grip.grab("cube", np.zeros(3))
    assert simulator.grip.hold is None


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("mass", [1e-6, 0.01, 1e4])
@pytest.mark.parametrize("fps", [20.0, 1e5])
def test_a_pull_is_stable_for_any_mass_and_step(integrator: str, mass: float, fps: float) -> None:
    """Come to rest at the hand, without ever passing it, at a step of 50 ms as at one of 10 us."""
    scene = point_scene(mass, integrator=integrator, dt=1.0 / fps).model_copy(update={"fps": fps})
    simulator = interactive(scene)
    assert simulator.grip is not None
    simulator.grip.grab("point", np.zeros(3))
    simulator.grip.move(np.array([1.0, 0.0, 0.0]))
    rate = min(SWING_RATE, MAX_TURN / simulator.dt)
    greatest = 0.0
    for _ in range(10):
        simulator.step(round(2.0 / (rate * simulator.dt)))
        greatest = max(greatest, simulator.positions[0, 0])
    # 20 time constants, of which the schemes' own differ by rate dt / 2 = 5 % at most; critical damping overshoots in
    # none of them by more than explicit Euler's (rate dt)^2.
    assert greatest < 1.0 + MAX_TURN**2
    assert abs(simulator.positions[0, 0] - 1.0) < 1e-6


def test_a_pull_is_stable_near_the_limit_of_the_springs() -> None:
    """Shake a cube at nine tenths of its largest stable step, and let it go: it comes to rest."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 4}
    limit = interactive(make_scene(bodies=[body])).step_limits(contacts=False)["semi_implicit_euler"]
    assert limit is not None
    scene = make_scene(bodies=[body], solver={"dt": 0.9 * limit, "steps_per_frame": 10}, fps=1 / (9.0 * limit))
    simulator = interactive(scene)
    assert simulator.dt == pytest.approx(0.9 * limit)
    start = simulator.positions
    assert simulator.grip is not None
    simulator.grip.grab("cube", start[0])
    rng = np.random.default_rng(3)
    for _ in range(40):
        simulator.grip.move(start[0] + rng.normal(scale=0.02, size=3))
        simulator.step(20)
    shaken = simulator.diagnostics()["elastic"]
    assert shaken > 1e-4
    simulator.grip.move(start[0])
    energies = []
    for _ in range(5):
        simulator.step(1000)
        energies.append(simulator.diagnostics()["elastic"])
    # An unstable mode would feed it; what stays for a while is what turning as a whole stretches.
    assert max(energies) < 1e-2 * shaken
    assert energies[-1] <= energies[0]


def test_nothing_held_changes_no_bit() -> None:
    """Step as a simulator without a hand does, after one was used as before."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 14, "position": [0.0, 0.6, 0.0]}
    floor = {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0]}
    scene = make_scene(bodies=[body], colliders=[floor], gravity=None, solver={"precision": "float32"})
    for threads in (1, 2):
        plain, held = Simulator(scene, device="cpu", threads=threads), interactive(scene, threads=threads)
        assert held.threads == threads
        assert held.grip is not None
        held.grip.grab("cube", np.zeros(3))
        held.grip.release()
        plain.step(150)
        held.step(150)
        np.testing.assert_array_equal(held.positions, plain.positions)
        np.testing.assert_array_equal(held.velocities, plain.velocities)


def test_threads_pull_alike() -> None:
    """Give the same bits with two threads as with one."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 14}
    results = []
    for threads in (1, 2):
        simulator = interactive(make_scene(bodies=[body]), threads=threads)
        assert simulator.grip is not None
        simulator.grip.grab("cube", np.array([0.5, 0.5, 0.5]))
        simulator.grip.move(np.array([0.7, 0.9, 0.5]))
        simulator.step(50)
        results.append(simulator.positions)
    np.testing.assert_array_equal(results[0], results[1])


def test_a_step_with_everything_in_it_is_captured() -> None:
    """Have room for the launches of all effects, of two threads, in one graph."""
    cube = {"type": "cube", "material": "jelly", "particles_per_edge": 14}
    scene = make_scene(
        bodies=[{**cube, "name": "a"}, {**cube, "name": "b", "position": [0.0, 1.2, 0.0]}],
        colliders=[{"type": "half_space", "center": [0.0, -0.6, 0.0], "normal": [0.0, 1.0, 0.0]}],
        fields=[{"type": "constant", "force": [0.1, 0.0, 0.0]}],
        soft_contact={},
        solver={"integrator": "rk4"},
        fps=10.0,
    )
    simulator = interactive(scene, threads=2)
    simulator.step(64)
    assert simulator.threads == 2
    assert simulator._stepper.capturable


def test_a_hand_holds_what_is_near_and_no_more_than_it_can() -> None:
    """Take a sixteenth of the particles, those nearest to the point, the nearest ones firmly."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 18}
    simulator = interactive(make_scene(bodies=[body]))
    assert simulator.grip is not None
    point = np.array([0.5, 0.5, 0.5])
    simulator.grip.grab("cube", point)
    hold = simulator.grip.hold
    assert hold is not None
    assert len(hold.particles) == MAX_HELD < HELD_SHARE * 18**3
    distance = np.linalg.norm(simulator.positions - point, axis=1)
    others = np.setdiff1d(np.arange(18**3), hold.particles)
    assert distance[hold.particles].max() <= distance[others].min() + 1e-12
    assert np.all(hold.weights > 0.0)
    assert hold.weights.max() == 1.0
    order = np.argsort(distance[hold.particles])
    assert np.all(np.diff(hold.weights[order]) <= 1e-12)
    # Nothing is pulled before the hand moves.
    np.testing.assert_allclose(simulator.grip.force(), 0.0, atol=1e-10)
    np.testing.assert_allclose(simulator.grip.point(), point, atol=1e-12)
