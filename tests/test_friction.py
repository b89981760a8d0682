"""Friction on half-spaces, planes and spheres: holding, sliding, stopping."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import reference
from probes import push_fully
from reference import EPSILON, ROUND_OFF
from worlds import make_material, make_scene, set_state

from warpjelly.simulator import Simulator

STATIC, DYNAMIC = 0.5, 0.4
G = 9.81
REST_ANGLE = math.degrees(math.atan(STATIC))
CONTACT = {"static_friction": STATIC, "dynamic_friction": DYNAMIC, "stiffness": 2000.0, "damping": 2.0}
INTEGRATORS = ["explicit_euler", "semi_implicit_euler", "rk2", "rk4"]


def put_on_incline(
    angle: float, kind: str, per_edge: int, speed: float = 0.0, friction: float | None = None, **solver: Any
) -> tuple[Simulator, np.ndarray]:
    """Return a cube of 0.2 m that lies on a slope that falls along x, at its resting depth, and the way down."""
    t = math.radians(angle)
    normal, down = np.array([math.sin(t), math.cos(t), 0.0]), np.array([math.cos(t), -math.sin(t), 0.0])
    slope = {"type": kind, "normal": normal.tolist()}
    if kind == "plane":
        slope |= {"tangent": down.tolist(), "size": [60.0, 4.0]}
    # per_edge^2 feet carry per_edge^3 particles: k depth = per_edge m g cos t.
    depth = per_edge * 0.01 * G * math.cos(t) / CONTACT["stiffness"]
    body = {
        "type": "cube", "material": "jelly", "particles_per_edge": per_edge, "size": 0.2,
        "position": ((0.1 - depth) * normal).tolist(), "rotation": [0.0, 0.0, -angle],
        "velocity": (speed * down).tolist(),
    }  # fmt: skip
    contact = CONTACT if friction is None else CONTACT | {"static_friction": friction, "dynamic_friction": friction}
    scene = make_scene(
        bodies=[body], colliders=[slope], contact=contact, gravity=[0.0, -G, 0.0],
        materials={"jelly": make_material(120.0, 0.15)}, solver={"dt": 5e-4, **solver},
    )  # fmt: skip
    return Simulator(scene, device="cpu"), down


@pytest.mark.parametrize("kind", ["half_space", "plane"])
@pytest.mark.parametrize("per_edge", [2, 4])
def test_incline_below_the_friction_angle_holds(kind: str, per_edge: int) -> None:
    """Lie still for 10 s at one degree below arctan mu_s, from rest."""
    # At rest means in balance, foot by foot. A cube put there unstrained strains all feet alike, but does not load
    # them alike: with T = tan t = 0.478, balance about the centre gives the two rows of 2^3 particles (1 -+ T)/2 of the
    # load. The uphill row has to hold T/2 > mu_s (1 - T)/2 and slips; while it does, both can hold no more than
    # mu_d (1 - T)/2 + mu_s (1 + T)/2 = 0.474 < T, and with mu_d < T what slides goes on. So the cube comes to rest with
    # both coefficients between T and mu_s.
    settling, _ = put_on_incline(REST_ANGLE - 1, kind, per_edge, friction=0.49)
    settling.step(8000)
    simulator, down = put_on_incline(REST_ANGLE - 1, kind, per_edge)
    start = settling.positions
    set_state(simulator, x=start, v=settling.velocities)
    cell = 0.2 / (per_edge - 1)
    for _ in range(10):
        simulator.step(2000)
        assert np.abs((simulator.positions - start) @ down).max() <= 0.01 * cell
    assert simulator.time == pytest.approx(10.0)
    assert simulator.diagnostics()["contacts"] == per_edge**2


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_single_particles_on_an_incline(integrator: str, device: str) -> None:
    """Lie still for 10 s one degree below arctan mu_s, and slide with g (sin t - mu_d cos t) three degrees above."""
    t = math.radians(REST_ANGLE - 1)
    gravity = [G * math.sin(t), -G * math.cos(t), 0.0]
    simulator = make_loose_particles(FLOOR, [0.0, 0.0, 0.0], gravity, device, integrator=integrator)
    start = simulator.positions
    simulator.step(10000)
    # Each step brings the particle to rest, to the rounding of g dt; 1e4 of these after 1e4 steps of 1e-3 s.
    assert np.abs(simulator.positions - start).max() <= 1e4 * 10 * EPSILON["float64"]
    t = math.radians(REST_ANGLE + 3)
    gravity = [G * math.sin(t), -G * math.cos(t), 0.0]
    simulator = make_loose_particles(FLOOR, [0.0, 0.0, 0.0], gravity, device, integrator=integrator)
    simulator.step(1000)
    expected = G * (math.sin(t) - DYNAMIC * math.cos(t))
    # From the first step on all forces are constant, so every scheme is exact.
    np.testing.assert_allclose(simulator.velocities[:, 0], expected, rtol=1e-10)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_sliding_cube_comes_to_rest_on_a_gentle_slope(integrator: str) -> None:
    """Stop on a slope below arctan mu_d and then lie still: friction also stops what pulls along the slope."""
    simulator, down = put_on_incline(10.0, "half_space", 2, speed=0.5, integrator=integrator, dt=1e-4)
    # It stops after v / (g (mu_d cos t - sin t)) = 0.23 s.
    simulator.step(20000)
    before = simulator.positions
    simulator.step(20000)
    # What pulls along the slope gives two layers g sin t dt = 2e-4 m/s each in a step: 0.7 mm, if that stayed.
    assert np.abs((simulator.positions - before) @ down).max() <= 1e-6
    assert before[:, 0].mean() > 0.02


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_groove_holds_like_a_floor(integrator: str) -> None:
    """Lie still in a groove of two walls, each of which could hold alone: together they stop no more than there is."""
    walls = [{"type": "half_space", "normal": normal} for normal in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0])]
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.1, "position": [0.05, 0.05, 0.0]}
    scene = make_scene(
        bodies=[body], colliders=walls, contact=CONTACT, gravity=[-7.0, -7.0, 0.7],
        materials={"jelly": make_material(100.0, 0.1)}, solver={"integrator": integrator, "dt": 5e-4},
    )  # fmt: skip
    simulator = Simulator(scene, device="cpu")
    simulator.step(4000)
    before = simulator.positions
    simulator.step(4000)
    # Along the groove pulls a tenth of what presses into each wall. One percent of a cell in 10 s is 0.2 mm in 2 s.
    assert np.abs(simulator.positions - before)[:, 2].max() <= 2e-4


@pytest.mark.parametrize("kind", ["half_space", "plane"])
@pytest.mark.parametrize("per_edge", [2, 4])
def test_incline_above_the_friction_angle_slides(kind: str, per_edge: int) -> None:
    """Slide with a = g (sin t - mu_d cos t) at three degrees above arctan mu_s."""
    angle = REST_ANGLE + 3
    simulator, down = put_on_incline(angle, kind, per_edge)
    t = math.radians(angle)
    simulator.step(1000)
    before = simulator.diagnostics()["momentum"] @ down / simulator.masses.sum()
    simulator.step(3000)
    after = simulator.diagnostics()["momentum"] @ down / simulator.masses.sum()
    expected = G * (math.sin(t) - DYNAMIC * math.cos(t))
    assert (after - before) / 1.5 == pytest.approx(expected, rel=0.02)
    assert before > 0


M, DT = 0.01, 1e-3
FLOOR = {"type": "half_space", "normal": [0.0, 1.0, 0.0]}
BALL = {"type": "sphere", "center": [0.0, -1.0, 0.0], "radius": 1.0}
PLATE = {"type": "plane", "normal": [0.0, 1.0, 0.0], "tangent": [1.0, 0.0, 0.0], "size": [1.0, 1.0]}


def make_probe(collider: dict[str, Any], precision: str, device: str, **contact: Any) -> Simulator:
    """Return a simulator of a cube above a collider, of 1000 steps/s, that takes up to mu_s = 0.5, mu_d = 0.4."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "position": [0.0, 2.0, 0.0]}
    scene = make_scene(bodies=[body], colliders=[collider], contact=CONTACT | contact, solver={"precision": precision})
    return Simulator(scene, device=device)


@pytest.mark.parametrize("collider", [FLOOR, PLATE, BALL], ids=["half_space", "plane", "sphere"])
def test_friction_at_known_states(collider: dict[str, Any], precision: str, device: str) -> None:
    """Hold, slide and stop as the law says, 1 mm deep, where N = 2000 N/m x 1 mm = 2 N."""
    simulator = make_probe(collider, precision, device)
    # Below the top, where all three have the normal +y. Stopping 1 m/s within a step takes m v/dt = 10 N.
    cases = [
        # velocity, applied force, friction
        ((0, 0, 0), (0, 0, 0), (0, 0, 0)),
        # Held, up to mu_s N = 1 N, ...
        ((0, 0, 0), (0.6, 0, -0.6), (-0.6, 0, 0.6)),
        ((5e-5, 0, 0), (0.9, 0, 0), (-0.9005, 0, 0)),
        # ... and beyond that against the pull with mu_d N = 0.8 N.
        ((0, 0, 0), (0, 0, 3.0), (0, 0, -0.8)),
        # Sliding, whatever pulls across or presses in.
        ((0.3, 0, 0.4), (0, 0, 0), (-0.48, 0, -0.64)),
        ((0.3, 0, 0.4), (0, -7.0, 0), (-0.48, 0, -0.64)),
        # Never more than what stops it: 0.01 m/s takes 0.1 N.
        ((0, 0, -0.01), (0, 0, 0), (0, 0, 0.1)),
    ]
    v, before, expected = (np.array(column, float) for column in zip(*cases, strict=True))
    x = np.tile([0.0, -1e-3, 0.0], (len(cases), 1))
    pushed = push_fully(simulator, x, v, before=before, mass=M)
    # The reaction is 2 N upwards; the greatest force is 7 N, and float32 knows 1 mm below the centre of a ball of 1 m
    # to half an epsilon of 1 m, times 2000 N/m.
    bound = 7 * ROUND_OFF[precision] + 2000.0 * EPSILON[precision]
    np.testing.assert_allclose(pushed.forces - before, expected + np.array([0, 2, 0]), rtol=0, atol=bound)
    # Losses are the power against friction, -F.v.
    assert pushed.losses[0] == pytest.approx(0, abs=bound)
    assert pushed.losses[1] == pytest.approx(-(expected * v).sum(), abs=bound)


def draw_states(count: int, precision: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places at a ball of 1 m below the origin, velocities of all magnitudes, and forces."""
    rng = np.random.default_rng(11)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    x = [0.0, -1.0, 0.0] + direction * rng.uniform(0.99, 1.002, (count, 1))
    v = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-6, 1, (count, 1))
    f = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 1, (count, 1))
    return tuple(a.astype(precision).astype(float) for a in (x, v, f))


@pytest.mark.parametrize(
    "options",
    [{}, {"pulls": True}, {"normal_force_term": True}, {"friction_normal": "applied"},
     {"pulls": True, "normal_force_term": True, "friction_normal": "applied"}],
    ids=["plain", "pulls", "term", "applied", "all"],
)  # fmt: skip
def test_random_states_match_the_reference(options: dict[str, Any], device: str) -> None:
    """Add reaction, friction and losses like the reference at places and speeds of all kinds, with every option."""
    simulator = make_probe(BALL, "float64", device, **options)
    shape = simulator.scene.colliders[0]
    law = reference.contact_law(shape, simulator.scene.contact)
    x, v, f = draw_states(2000, "float64")
    (touch,) = reference.find_touches(shape, x, np.zeros(3))
    reaction, friction = reference.contact_forces(law, touch, v, f, np.full(2000, M), DT)
    pushed = push_fully(simulator, x, v, before=f, mass=M)
    # Forces of up to some 100 N, and depths of up to 1 cm as the difference of lengths of 1 m.
    bound = 100 * ROUND_OFF["float64"]
    np.testing.assert_allclose(pushed.forces, f + reaction + friction, rtol=0, atol=bound)
    stored = np.where(touch.here, touch.counted, 0.0)[:, None] * law["stiffness"] * touch.normal
    np.testing.assert_allclose(
        pushed.losses, [-((reaction - stored) * v).sum(), -(friction * v).sum()], rtol=1e-10, atol=1e-9
    )
    assert 100 < touch.here.sum() < 1900
    assert not np.array_equal(
        reaction + friction,
        sum(reference.contact_forces(law | {"pulls": not law["pulls"]}, touch, v, f, np.full(2000, M), DT)),
    )


def test_friction_opposes_motion_and_never_exceeds_what_stops(precision: str, device: str) -> None:
    """Slow a free particle down along the surface, against its motion, but never turn it round."""
    simulator = make_probe(BALL, precision, device, static_friction=5.0, dynamic_friction=4.0)
    x, v, _ = draw_states(2000, precision)
    pushed = push_fully(simulator, x, v, mass=M)
    local = x - [0.0, -1.0, 0.0]
    n = local / np.linalg.norm(local, axis=1)[:, None]

    def tangential(a: np.ndarray) -> np.ndarray:
        return a - (a * n).sum(axis=1)[:, None] * n

    slid, friction = tangential(v), tangential(pushed.forces.astype(float))
    after = slid + DT / M * friction
    # Normals are rounded, so that a little of the reaction, up to 20 N + 20 N, shows along the surface.
    bound = 40 * ROUND_OFF[precision] * DT / M + np.abs(v).max(axis=1) * ROUND_OFF[precision]
    assert ((after * slid).sum(axis=1) >= -bound * np.linalg.norm(slid, axis=1)).all()
    assert (np.linalg.norm(after, axis=1) <= np.linalg.norm(slid, axis=1) + bound).all()
    touched = np.linalg.norm(local, axis=1) <= 1
    # Some are stopped and some slide on.
    stopped = np.linalg.norm(after, axis=1) <= bound
    assert (touched & stopped).sum() > 100
    assert (touched & ~stopped).sum() > 10


def test_static_friction_stops_within_one_step(device: str) -> None:
    """Leave no tangential velocity at all after one semi-implicit step at rest."""
    simulator = make_loose_particles(FLOOR, [5e-5, 0.0, -3e-5], gravity=[1.0, -G, 2.0], device=device)
    simulator.step()
    # v + dt/m (F_t - (F_t + m v/dt)): two roundings of F_t dt/m = 2 mm/s.
    assert np.abs(simulator.velocities[:, [0, 2]]).max() <= 4 * EPSILON["float64"] * 2e-3
    # Held from then on, without drift: sqrt(5) < 0.5 g.
    start = simulator.positions
    simulator.step(1000)
    assert np.abs(simulator.positions - start)[:, [0, 2]].max() <= 1e-13


def make_loose_particles(
    collider: dict[str, Any], velocity: list[float], gravity: list[float], device: str, **solver: Any
) -> Simulator:
    """Return 8 particles without springs in one layer that rest on y = 0, at the depth m g / k."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.1}
    scene = make_scene(
        bodies=[body], colliders=[collider], contact=CONTACT, gravity=gravity,
        materials={"jelly": make_material(0.0, 0.0)}, solver={"dt": DT, **solver},
    )  # fmt: skip
    # The body starts above, so that it is kept there.
    data = scene.model_dump(exclude_none=True)
    data["bodies"][0]["position"] = [0.0, 1.0, 0.0]
    simulator = Simulator(type(scene).model_validate(data), device=device)
    x = simulator.positions
    x[:, 1] = gravity[1] * M / CONTACT["stiffness"]
    set_state(simulator, x=x, v=np.tile(velocity, (8, 1)))
    return simulator


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_friction_losses_are_the_kinetic_energy_lost(integrator: str, device: str) -> None:
    """Slide to rest from 1 m/s on a floor: friction takes all of the kinetic energy, to the order of the scheme."""
    simulator = make_loose_particles(FLOOR, [0.6, 0.0, 0.8], [0.0, -G, 0.0], device, integrator=integrator)
    start = simulator.diagnostics()
    path = simulator.positions
    simulator.step(400)
    end = simulator.diagnostics()
    a = DYNAMIC * G
    # Euler schemes take the power at the mean velocity of a step, whose work is exact. So do Runge-Kutta schemes, but
    # differ in the last step, when v <= a dt.
    left = 1e-12 if "euler" in integrator else 8 * M * (a * DT) ** 2
    assert end["kinetic"] <= 1e-9 * start["kinetic"]
    assert end["friction_losses"] + end["kinetic"] == pytest.approx(start["kinetic"], abs=left)
    # It went v0^2/2a, to a step's way.
    way = np.linalg.norm(simulator.positions - path, axis=1)
    np.testing.assert_allclose(way, 1 / (2 * a), rtol=0, atol=DT)
    assert end["contact_losses"] == pytest.approx(0, abs=1e-12)
