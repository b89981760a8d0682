"""The four schemes: their orders, free fall, the reference, and the account of energy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from reference import EPSILON, World
from test_simulator import GRAVITY, breathe, make_cube, make_random_world
from worlds import make_material, make_scene, set_state, step_of

from warpjelly.scene import Scene
from warpjelly.simulator import Simulator

ORDERS = {"explicit_euler": 1, "semi_implicit_euler": 1, "rk2": 2, "rk4": 4}
ENERGIES = ("kinetic", "elastic", "potential", "contact", "spring_losses", "contact_losses", "friction_losses")


def energy(simulator: Simulator) -> float:
    """Return all energy that there is and that was taken, J."""
    measured = simulator.diagnostics()
    return sum(measured[name] for name in ENERGIES)


# Small enough for the next power of the step not to show, large enough for the error to stand out of round-off.
STEPS = {"explicit_euler": 1e-5, "semi_implicit_euler": 1e-5, "rk2": 1e-4, "rk4": 5e-4}


@pytest.mark.parametrize("integrator", ORDERS)
def test_breathing_cube_converges_with_the_order_of_the_scheme(integrator: str, device: str) -> None:
    """Come closer to the damped oscillation of a breathing cube by 2^order when the step is halved."""
    errors = []
    for dt in (STEPS[integrator], STEPS[integrator] / 2):
        scene, w2, c = breathe("strain", 0.05, "float64", integrator=integrator, dt=dt)
        simulator = Simulator(scene, device=device)
        rest, start, t = simulator.positions, 0.25, 0.05
        set_state(simulator, x=(1 + start) * rest)
        simulator.step(round(t / step_of(scene)))
        # s'' = -w2 s - c s' from s(0) = start, s'(0) = 0.
        w = math.sqrt(w2 - c * c / 4)
        fade = start * math.exp(-c * t / 2)
        exact = fade * (math.cos(w * t) + c / (2 * w) * math.sin(w * t)), -fade * w2 / w * math.sin(w * t)
        square = (rest * rest).sum()
        found = (simulator.positions * rest).sum() / square - 1, (simulator.velocities * rest).sum() / square
        errors.append(math.hypot(found[0] - exact[0], (found[1] - exact[1]) / w))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(ORDERS[integrator], abs=0.1)
    # Far above round-off, some epsilon for each step.
    assert errors[1] > 1e5 * EPSILON["float64"]


@pytest.mark.parametrize("integrator", ORDERS)
def test_deformed_cube_converges_with_the_order_of_the_scheme(integrator: str, device: str) -> None:
    """Come closer to the motion of a tumbling, deformed, falling cube by 2^order when the step is halved."""

    def fly(integrator: str, dt: float) -> np.ndarray:
        body = make_cube(angular_velocity=[3.0, 1.0, -2.0], velocity=[1.0, 2.0, 0.0])
        materials = {"jelly": make_material(20.0, 0.1)}
        solver = {"integrator": integrator, "dt": dt}
        simulator = Simulator(
            make_scene(bodies=[body], materials=materials, gravity=GRAVITY, solver=solver), device=device
        )
        set_state(simulator, x=simulator.positions + np.random.default_rng(4).normal(scale=0.05, size=(8, 3)))
        simulator.step(round(0.05 / simulator.dt))
        return np.concatenate([simulator.positions, simulator.velocities / 100.0])

    # RK4 at a fifth of its own step here errs by 1/625.
    exact = fly("rk4", 1e-4)
    errors = [np.linalg.norm(fly(integrator, STEPS[integrator] * share) - exact) for share in (1, 1 / 2)]
    # What is left of the error of the exact solution is 16/625 of the smaller one, 0.04 of an order.
    assert math.log2(errors[0] / errors[1]) == pytest.approx(ORDERS[integrator], abs=0.1)


@pytest.mark.parametrize("integrator", ORDERS)
def test_free_fall_follows_the_sum_of_each_scheme(integrator: str, precision: str, device: str) -> None:
    """Fall by v0 n dt + g dt^2 s, with s the sum of 0 .. n-1, of 1 .. n, or n^2/2."""
    n, velocity = 500, np.array([1.0, 2.0, -3.0])
    body = make_cube(velocity=velocity.tolist(), position=[0.5, 2.0, 0.0])
    solver = {"precision": precision, "integrator": integrator}
    simulator = Simulator(make_scene(bodies=[body], gravity=GRAVITY, solver=solver), device=device)
    x0, dt = simulator.positions.astype(float), simulator.dt
    simulator.step(n)
    s = {"explicit_euler": n * (n - 1) / 2, "semi_implicit_euler": n * (n + 1) / 2}.get(integrator, n * n / 2)
    expected = x0 + velocity * n * dt + np.array(GRAVITY) * dt**2 * s
    # As for semi-implicit Euler in test_simulator, with up to twice the roundings a step.
    bound = 2 * EPSILON[precision] * n * (4 + 8 * n * dt)
    # The schemes differ by far more than that in float64.
    assert precision == "float32" or bound < 1e-3 * 9.81 * dt**2 * n / 2
    np.testing.assert_allclose(simulator.positions, expected, rtol=0, atol=bound)
    after = np.tile(velocity + np.array(GRAVITY) * n * dt, (8, 1))
    np.testing.assert_allclose(simulator.velocities, after, rtol=0, atol=2 * EPSILON[precision] * n * 8)


def draw_fields(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return a field of each kind, with curves that turn between and on steps, in binary fractions."""

    def draw(size: float, *shape: int) -> Any:
        return (np.round(rng.uniform(-size, size, shape) * 64) / 64).tolist()

    # Weights are some 0.1 N, charges 0.25 and -0.125 C, speeds 4 m/s: every field pushes by up to as much.
    curve = [[0.0, 0.5], [0.0625, 1.0], [0.110, -1.0], [0.1875, 1.5]]
    return [
        {"type": "constant", "force": draw(0.125, 3), "curve": curve},
        {"type": "grid", "lower": [-1.0, -0.25, -0.5], "upper": [0.75, 0.875, 0.5], "forces": draw(0.25, 3, 3, 3, 3),
         "outside": "zero", "curve": curve[::2]},
        {"type": "electric", "strength": draw(1.0, 3), "curve": curve[1:]},
        {"type": "magnetic", "strength": draw(0.5, 3), "curve": curve},
    ]  # fmt: skip


def make_rough_world(seed: int, *, without: int | None = None, **solver: Any) -> Scene:
    """Return a random world with friction and a ball that pushes back to where one came in; bodies fall fast.

    They are charged, and there is a field of each kind, but for one that is left out.
    """
    world = make_random_world(seed)
    rng = np.random.default_rng(100 + seed)
    for collider in world["colliders"]:
        collider |= {"static_friction": 0.5, "dynamic_friction": 0.375}
    world["colliders"][2]["normal"] = "entry"
    for body, charge in zip(world["bodies"], (0.25, -0.125), strict=True):
        body["velocity"] = (np.round(rng.uniform([-2, -3.5, -2], [2, -2.5, 2]) * 64) / 64).tolist()
        body["charge"] = charge
    fields = [field for number, field in enumerate(draw_fields(rng)) if number != without]
    return make_scene(**world, fields=fields, solver={"dt": 2.5e-4, **solver})


@pytest.mark.parametrize("integrator", ORDERS)
@pytest.mark.parametrize("seed", [1, 8])
def test_trajectories_match_the_reference(seed: int, integrator: str, device: str) -> None:
    """Follow random small worlds of fields and rough colliders for 1000 steps like the reference, losses included."""
    scene = make_rough_world(seed, integrator=integrator)
    simulator, world = Simulator(scene, device=device), World(scene)
    touched = np.zeros(len(scene.colliders), int)
    for _ in range(10):
        simulator.step(100)
        world.step(100)
        # Round-off of 1e-16 m a step; nothing in 0.25 s makes 1e-9 m of that, but a friction that held in one and slid
        # in the other would.
        np.testing.assert_allclose(simulator.positions, world.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(simulator.velocities, world.v, rtol=0, atol=1e-7)
        measured = simulator.diagnostics()
        losses = [measured[name] for name in ENERGIES[4:]]
        np.testing.assert_allclose(losses, world.losses, rtol=1e-9, atol=1e-9)
        assert measured["field_work"] == pytest.approx(world.field_work, rel=1e-9, abs=1e-9)
        assert world.touches is not None
        touched += [sum(int(touch.here.sum()) for touch in touches) for touches in world.touches]
    # Every collider took part, and every way to lose energy.
    assert (touched > 0).all()
    assert (world.losses > 0.01).all()


@pytest.mark.parametrize("seed", [1, 8])
def test_every_field_matters_to_the_trajectories(seed: int) -> None:
    """End the 1000 steps elsewhere by more than 1 mm, a million times what is allowed above, without any one field."""
    places = []
    for without in (None, *range(4)):
        simulator = Simulator(make_rough_world(seed, without=without), device="cpu")
        simulator.step(1000)
        places.append(simulator.positions)
    assert (np.abs(np.array(places[1:]) - places[0]).max(axis=(1, 2)) > 1e-3).all()


def drop(integrator: str, dt: float, device: str) -> tuple[np.ndarray, float]:
    """Return the account of energy over a drop of a turning cube on a floor with friction, and the energy lost."""
    scene = make_scene(
        bodies=[make_cube(size=0.3, position=[0.0, 0.35, 0.0], rotation=[10.0, 0.0, 20.0], velocity=[1.5, -2.0, 0.5])],
        colliders=[{"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [9.0, 9.0], "threshold": 0.2}],
        contact={"static_friction": 0.5, "dynamic_friction": 0.375, "stiffness": 500.0, "damping": 0.5},
        gravity=[0.0, -9.81, 0.0],
        materials={"jelly": make_material(30.0, 0.05)},
        solver={"integrator": integrator, "dt": dt},
    )  # fmt: skip
    simulator = Simulator(scene, device=device)
    account = [energy(simulator)]
    for _ in range(40):
        simulator.step(round(0.0125 / step_of(scene)))
        account.append(energy(simulator))
    measured = simulator.diagnostics()
    lost = [measured[name] for name in ENERGIES[4:]]
    assert min(lost) > 0.01
    return np.array(account) - account[0], sum(lost)


@pytest.mark.parametrize("integrator", ORDERS)
def test_energy_account_closes_with_the_step(integrator: str, device: str) -> None:
    """Halve what the account of energy misses over a drop with friction when the step is halved."""
    (coarse, lost), (fine, _) = (drop(integrator, dt, device) for dt in (2.5e-5, 1.25e-5))
    # The account of explicit Euler misses dt/2 (dv/dt)^2 m of each step, a few w dt of what the springs hold.
    assert np.abs(coarse).max() <= 0.02 * lost
    ratio = np.abs(coarse).max() / np.abs(fine).max()
    # Contacts begin and end within a step, and forces jump there: that is of first order by any scheme, though for
    # Runge-Kutta schemes it is all there is, less than a hundredth of the others.
    if "euler" in integrator:
        assert ratio == pytest.approx(2, rel=0.1)
    else:
        assert ratio > 1.8
        assert np.abs(coarse).max() <= 1e-5 * lost


def test_energy_account_of_damped_flight_closes_at_fourth_order(device: str) -> None:
    """Close the account of a damped, deformed cube in flight by RK4 16 times better at half the step."""
    missed = []
    for dt in (1e-3, 5e-4):
        solver = {"integrator": "rk4", "dt": dt}
        materials = {"jelly": make_material(20.0, 0.1)}
        simulator = Simulator(make_scene(gravity=GRAVITY, materials=materials, solver=solver), device=device)
        set_state(simulator, x=simulator.positions + np.random.default_rng(4).normal(scale=0.05, size=(8, 3)))
        start = energy(simulator)
        simulator.step(round(0.05 / simulator.dt))
        missed.append(abs(energy(simulator) - start))
        assert simulator.diagnostics()["spring_losses"] > 0.01
    # The losses are summed with the weights of the scheme, so they are of its order.
    assert math.log2(missed[0] / missed[1]) >= 3.9
