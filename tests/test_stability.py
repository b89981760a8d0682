"""The largest stable step: against dense matrices, and against what blows up and what does not."""

from __future__ import annotations

import itertools
import json
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference import World
from test_scenes import NAMES, SCENES
from worlds import make_material, make_scene, make_voxels, set_state

from warpjelly import stability
from warpjelly.errors import DivergedError, SceneError
from warpjelly.run import forecast, simulate
from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator

MODELS = Path(__file__).parent.parent / "scenes" / "models"
INTEGRATORS = stability.INTEGRATORS
ALL_LIMITED = make_material(400.0, 0.6)
UNDAMPED = make_material(400.0, 0.0)
# Another damping / stiffness for each kind of spring.
MIXED = {
    "structural": {"stiffness": 30.0, "damping": 0.2},
    "shear": {"stiffness": 20.0, "damping": 0.3},
    "bend": {"stiffness": 10.0, "damping": 0.05},
}


def make_cube(count: int, material: dict[str, Any], **changes: Any) -> Scene:
    """Return a scene of one cube with some particles per edge."""
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": count}
    return make_scene(bodies=[body], materials={"jelly": material}, **changes)


def make_tree(material: dict[str, Any], **changes: Any) -> Scene:
    """Return a scene of the tree at resolution 12."""
    body = {"name": "tree", "type": "model", "file": str(MODELS / "tree.obj"), "resolution": 12, "material": "jelly"}
    return make_scene(bodies=[body], materials={"jelly": material}, **changes)


def limits_of(scene: Scene, device: str = "cpu") -> dict[str, float | None]:
    """Return the limits of the springs of a scene."""
    return Simulator(scene, device=device).step_limits(contacts=False)


class Matrices:
    """The springs of a simulator at rest as dense matrices: y'' = -A y - B y' with y the root of the mass times x."""

    def __init__(self, simulator: Simulator) -> None:
        x, m = simulator.positions.astype(float), simulator.masses.astype(float)
        self.a, self.b = np.zeros((2, 3 * len(x), 3 * len(x)))
        classes = simulator.model.spring_classes.numpy().astype(float)
        for first, second, count, kind in simulator.model.spans.numpy():
            for i, j in zip(range(first, first + count), range(second, second + count), strict=True):
                n = x[j] - x[i]
                g = np.zeros(6)
                g[:3], g[3:] = n / math.sqrt(m[i]), -n / math.sqrt(m[j])
                at = np.r_[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]
                block = np.outer(g, g) / (n @ n)
                self.a[np.ix_(at, at)] += classes[kind, 1] * block
                self.b[np.ix_(at, at)] += classes[kind, 2] * block

    def step_matrix(self, integrator: str, dt: float) -> np.ndarray:
        """Return the matrix that advances (y, y') by one step."""
        one, none = np.eye(len(self.a)), np.zeros_like(self.a)
        if integrator == "semi_implicit_euler":
            v = np.hstack([-dt * self.a, one - dt * self.b])
            return np.vstack([np.hstack([one, none]) + dt * v, v])
        z = dt * np.block([[none, one], [-self.a, -self.b]])
        step = term = np.eye(len(z))
        for order in range(1, {"explicit_euler": 1, "rk2": 2, "rk4": 4}[integrator] + 1):
            term = term @ z / order
            step = step + term
        return step

    def growth(self, integrator: str, share: float, limit: float, doublings: int = 13) -> float:
        """Return by how much 2^doublings steps at a share of the limit make a random start in shape grow.

        The start leaves out the motions as a rigid body, which drift for ever, with any step and without any harm.
        """
        step = self.step_matrix(integrator, share * limit)
        for _ in range(doublings):
            step = step @ step
            if not np.abs(step).max() < 1e100:
                return math.inf
        values, modes = np.linalg.eigh(self.a + self.b)
        shapes = modes[:, values > 1e-9 * values[-1]]
        # Positions in units of velocity over the top frequency, so that both count alike.
        scale = math.sqrt(np.linalg.eigvalsh(self.a)[-1]) or 1.0
        start = np.random.default_rng(1).standard_normal(shapes.shape[1] * 2).reshape(2, -1)
        y = np.concatenate([shapes @ start[0] / scale, shapes @ start[1]])
        size = np.repeat([scale, 1.0], len(self.a))
        return float(np.linalg.norm(size * (step @ y)) / np.linalg.norm(size * y))


@pytest.mark.parametrize("damped", [False, True])
def test_lanczos_finds_the_top_of_the_assembled_matrix(damped: bool, precision: str, device: str) -> None:
    """Find the top eigenvalue within 1 % from below, and damping / stiffness times it."""
    material = make_material(400.0, 0.6 if damped else 0.0, density=300.0)
    simulator = Simulator(make_cube(5, material, solver={"precision": precision}), device=device)
    origin, (top, damping) = stability.bound_spring_pairs(simulator.model, simulator.state.x)
    expected = np.linalg.eigvalsh(Matrices(simulator).a)[-1]
    assert (origin == 0).all()
    # Rounding can put it above by some epsilons.
    assert 0.99 * expected <= top <= expected * (1 + 1e-5)
    assert damping == pytest.approx(0.0015 * top if damped else 0.0, rel=1e-6)


def test_the_polygon_holds_the_pairs_of_unequal_springs() -> None:
    """Enclose (a, d) of random shapes and of the top modes, within 2 % of the top values."""
    simulator = Simulator(make_cube(4, MIXED), device="cpu")
    matrices = Matrices(simulator)
    pairs = stability.bound_spring_pairs(simulator.model, simulator.state.x)
    scale = pairs.max(axis=0)
    tops = [np.linalg.eigvalsh(matrix)[-1] for matrix in (matrices.a, matrices.b)]
    np.testing.assert_allclose(scale, tops, rtol=0.01)
    y = [np.linalg.eigh(math.cos(t) * matrices.a / scale[0] + math.sin(t) * matrices.b / scale[1])[1].T
         for t in np.linspace(0, 2 * math.pi, 25)]  # fmt: skip
    found = np.array([[v @ matrices.a @ v, v @ matrices.b @ v] for vectors in y for v in vectors]) / scale
    edges = np.roll(pairs, -1, axis=0) / scale - pairs / scale
    outward = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1), 1e-12)[:, None]
    outside = ((found[:, None] - pairs / scale) * outward).sum(axis=2)
    # Lanczos is within 1 % from below.
    assert outside.max() <= 0.01


MATERIALS = {
    "damped": ALL_LIMITED,
    "lightly damped": make_material(400.0, 0.2),
    "undamped": UNDAMPED,
    "mixed": MIXED,
    "dampers": make_material(0.0, 0.3),
    "no bend stiffness": MIXED | {"bend": {"stiffness": 0.0, "damping": 0.3}},
}


def make_blocks() -> Scene:
    """Return a scene of one body of two materials, both damped alike, cell by cell in turn."""
    numbers = np.indices((3, 3, 3)).sum(axis=0) % 2 + 1
    regions = [{"symbol": "a", "material": "bone"}]
    materials = {"jelly": make_material(400.0, 0.6), "bone": make_material(8000.0, 12.0, particle_mass=0.03)}
    return make_scene(bodies=[make_voxels(numbers, regions=regions)], materials=materials)


@pytest.mark.parametrize("name", [*MATERIALS, "two in one body"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_limit_is_neither_unsafe_nor_timid(name: str, integrator: str) -> None:
    """Stay bounded for 8192 linear steps at 0.95 of the limit, and blow up at 1.3 of it."""
    scene = make_cube(4, MATERIALS[name]) if name in MATERIALS else make_blocks()
    simulator = Simulator(scene, device="cpu")
    limit = simulator.step_limits(contacts=False)[integrator]
    if name == "undamped" and integrator in ("explicit_euler", "rk2"):
        assert limit is None
        return
    assert limit is not None
    matrices = Matrices(simulator)
    # A stable step is a contraction in some norm; near the limit that of y and y' over the top frequency is within the
    # inverse root of the distance from it, 0.05^-0.5 = 4.5, for one mode, and 10 leaves room for several.
    assert matrices.growth(integrator, 0.95, limit) < 10
    assert matrices.growth(integrator, 1.3, limit) > 1e6


def make_cloth(material: dict[str, Any], **changes: Any) -> Scene:
    """Return a scene of a cloth of 12 by 12 particles."""
    body = {"name": "cloth", "type": "cloth", "size": [1.0, 1.0], "particles": [12, 12], "material": "jelly"}
    return make_scene(bodies=[body], materials={"jelly": material}, **changes)


BODIES: dict[str, Callable[..., Scene]] = {
    "cube": lambda material, **changes: make_cube(8, material, **changes),
    "tree": make_tree,
    "cloth": make_cloth,
}
# The last two have another damping / stiffness for each kind of spring, the first of them so much that some motions
# creep, the other one so little that all swing.
PERTURBED = {
    "damped": make_material(100.0, 0.2),
    "undamped": make_material(100.0, 0.0),
    "mixed": MIXED,
    "unequal": {
        "structural": {"stiffness": 30.0, "damping": 0.1},
        "shear": {"stiffness": 90.0, "damping": 0.1},
        "bend": {"stiffness": 6.0, "damping": 0.02},
    },
}


def growths(body: str, material: str, integrator: str, dt: float) -> list[float]:
    """Return by how much the energy of a small perturbation about rest has grown, at some times over 2000 steps."""
    # A frame is 20 steps of exactly this length.
    changes: dict[str, Any] = {"solver": {"integrator": integrator, "dt": dt, "steps_per_frame": 20}, "fps": 0.05 / dt}
    simulator = Simulator(BODIES[body](PERTURBED[material], **changes), device="cpu")
    assert simulator.dt == dt
    rest, rng = simulator.positions, np.random.default_rng(5)
    set_state(simulator, x=rest + 1e-6 * simulator.model.bodies[0].unit * rng.standard_normal(rest.shape))
    first, found = simulator.diagnostics()["elastic"], []
    for _ in range(100):
        simulator.step(20)
        now = simulator.diagnostics()
        found.append((now["elastic"] + now["kinetic"]) / first)
        # Once a thousand times as far away, energy is not a quadratic form for much longer.
        if not found[-1] < 1e6:
            break
    return found


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("material", PERTURBED)
@pytest.mark.parametrize("body", BODIES)
def test_the_simulator_obeys_the_limit(body: str, material: str, integrator: str) -> None:
    """Keep a small perturbation small at 0.95 of the limit, and make it a thousand times as large at 1.3 of it."""
    limits = limits_of(BODIES[body](PERTURBED[material]))
    limit = limits[integrator]
    if limit is None:
        assert material == "undamped"
        assert integrator in ("explicit_euler", "rk2")
        # With z = dt w up to 0.7 energy grows by z^2 or z^4/4 = 0.06 in a step.
        shortest = limits["rk4"]
        assert shortest is not None
        assert not growths(body, material, integrator, 0.25 * shortest)[-1] < 1e6
        return
    # By 4 / (1 - share) at most with semi-implicit Euler: see the scenes below. The others have the modes of the exact
    # flow, whose energy never grows: they only mix position and velocity, by (1 + z) / (1 - z) for a damping ratio z,
    # which is 19 for 0.9. This start, without velocity, mixes little even where motions creep.
    assert max(growths(body, material, integrator, 0.95 * limit)) <= 80
    # The square of a thousand.
    assert not growths(body, material, integrator, 1.3 * limit)[-1] < 1e6


def test_the_limit_falls_with_the_roots_of_stiffness_and_mass(precision: str) -> None:
    """Halve the step of undamped springs with 4 times the stiffness, and double it with 4 times the mass."""
    limits = [
        limits_of(make_cube(4, make_material(k, 0.0, particle_mass=m), solver={"precision": precision}))
        for k, m in ((100.0, 0.01), (400.0, 0.01), (100.0, 0.04))
    ]
    for integrator in ("semi_implicit_euler", "rk4"):
        once, stiff, heavy = (limit[integrator] for limit in limits)
        # Lanczos takes the same steps but for rounding.
        assert stiff == pytest.approx(once / 2, rel=1e-4)
        assert heavy == pytest.approx(once * 2, rel=1e-4)


def test_contact_alone_gives_the_limits_of_an_oscillator() -> None:
    """Find the limits of k = 50 N/m and c = 0.1 N s/m on 0.01 kg where no spring does anything."""
    floor = {"type": "half_space", "normal": [0.0, 1.0, 0.0], "stiffness": 50.0, "damping": 0.1}
    simulator = Simulator(make_cube(2, make_material(0.0, 0.0), colliders=[floor]), device="cpu")
    assert simulator.step_limits(contacts=False) == dict.fromkeys(INTEGRATORS, stability.MAX_STEP)
    a, d = 50.0 / 0.01, 0.1 / 0.01
    limits = simulator.step_limits(contacts=True)
    assert limits["explicit_euler"] == pytest.approx(d / a, rel=1e-6)
    assert limits["semi_implicit_euler"] == pytest.approx((-d + math.sqrt(d * d + 4 * a)) / a, rel=1e-6)
    for integrator, coefficients in (("rk2", [1 / 2, 1, 1]), ("rk4", [1 / 24, 1 / 6, 1 / 2, 1, 1])):
        limit = limits[integrator]
        assert limit is not None
        mu = -d / 2 + 1j * math.sqrt(a - d * d / 4)
        assert abs(np.polyval(coefficients, 0.999 * limit * mu)) < 1 < abs(np.polyval(coefficients, 1.001 * limit * mu))


FLOOR = {"type": "half_space", "normal": [0.0, 1.0, 0.0], "center": [0.0, -1.0, 0.0], "damping": 0.5}
BALL = {"type": "sphere", "center": [0.0, -2.0, 0.0], "radius": 1.5, "damping": 0.5}


@pytest.mark.parametrize(
    ("colliders", "times"),
    [
        ([FLOOR], 1.0),
        # Which all push the same way, ...
        ([FLOOR, {**FLOOR, "type": "plane", "size": [1.0, 1.0]}, FLOOR], 3.0),
        # ... or at right angles, or face each other, or both, ...
        ([FLOOR, {**FLOOR, "normal": [1.0, 0.0, 0.0]}], 1.0),
        ([FLOOR, {**FLOOR, "normal": [0.0, -1.0, 0.0], "center": [0.0, 1.0, 0.0]}], 1.0),
        ([{"type": "box", "size": [4.0, 4.0, 4.0], "damping": 0.5}], 1.0),
        # ... unless there is something between them; or at 60 degrees, n n^T + m m^T having 1 + n.m.
        ([FLOOR, {**FLOOR, "normal": [0.0, -1.0, 0.0], "center": [0.0, -1.1, 0.0]}], 2.0),
        ([FLOOR, {**FLOOR, "normal": [3.0**0.5, 1.0, 0.0]}], 1.5),
        # A ball pushes any way: with another one that it meets, and with the floor that it sticks out of.
        ([BALL, {**BALL, "center": [0.0, 3.0, 0.0]}], 1.0),
        ([BALL, {**BALL, "center": [0.0, 0.9, 0.0]}], 2.0),
        ([BALL, FLOOR], 2.0),
        ([BALL, {**FLOOR, "center": [0.0, -4.0, 0.0]}], 1.0),
    ],
)  # fmt: skip
def test_colliders_that_meet_add_up(colliders: list[dict[str, Any]], times: float) -> None:
    """Count the stiffness and damping of what one particle may be in at once, as far as it acts one way."""
    scene = make_cube(2, make_material(0.0, 0.0), colliders=colliders, contact={"stiffness": 2000.0})
    ((a, d),) = np.unique(
        stability.contact_pairs(Simulator(scene, device="cpu").model).max(axis=0, keepdims=True), axis=0
    )
    # float32 is not involved; rounding of directions is.
    assert a == pytest.approx(times * 2000.0 / 0.01, rel=1e-9)
    assert d == pytest.approx(times * 0.5 / 0.01, rel=1e-9)


def test_sets_that_meet_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find the same greatest sets of balls that all meet as by trying all sets, and no less where there are many."""
    rng = np.random.default_rng(6)
    for count in (1, 5, 9):
        balls = [{"type": "sphere", "center": rng.uniform(-2, 2, 3).tolist(), "radius": 1.0} for _ in range(count)]
        table = Simulator(make_cube(2, UNDAMPED, colliders=balls), device="cpu").model.colliders
        centers = table.center.numpy()
        meet = np.linalg.norm(centers[:, None] - centers, axis=2) <= 2.0
        every = [
            set(members)
            for size in range(1, count + 1)
            for members in itertools.combinations(range(count), size)
            if meet[np.ix_(members, members)].all()
        ]
        greatest = {frozenset(members) for members in every if not any(members < other for other in every)}
        assert {frozenset(members) for members in stability._touched_together(table)} == greatest
        monkeypatch.setattr("warpjelly.stability.MAX_SORTED_OUT", 0)
        many = [set(members) for members in stability._touched_together(table)]
        monkeypatch.undo()
        assert all(any(members <= other for other in many) for members in greatest)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_resting_on_several_floors_is_bounded_at_the_limit(integrator: str) -> None:
    """Rest on a floor that is there four times, at 0.95 of its limit and at the step of auto."""
    drop = {"colliders": [FLOOR] * 4, "gravity": [0.0, -9.81, 0.0], "contact": {"stiffness": 2000.0}, "fps": 1000.0}
    scene = make_cube(2, make_material(0.0, 0.0), solver={"integrator": integrator, "dt": "auto"}, **drop)
    simulator = Simulator(scene, device="cpu")
    limit = simulator.step_limits(contacts=True)[integrator]
    assert limit is not None
    steps = {"steps_per_frame": 1, "dt": 0.95 * limit, "integrator": integrator}
    at_limit = Simulator(
        make_cube(2, make_material(0.0, 0.0), solver=steps, **drop | {"fps": 1 / (0.95 * limit)}), device="cpu"
    )
    for tried in (simulator, at_limit):
        x = tried.positions
        x[:, 1] = -1.0
        set_state(tried, x=x)
        tried.step(round(1.0 / tried.dt))
        # From rest at the surface it sinks in by 2 m g / k = 0.02 mm with all four, and comes back.
        assert tried.positions[:, 1].max() <= -1.0 + 1e-3


def test_magnetic_fields_have_limits() -> None:
    """Gain 5 % of energy over the run at the limit of the Euler schemes and of RK2, and none below that of RK4."""
    turns = [{"type": "magnetic", "strength": [0.0, 3.0, 0.0], "curve": [[0.0, 0.5], [1.0, 1.0]]},
             {"type": "magnetic", "strength": [0.0, 2.0, 0.0]}]  # fmt: skip
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "charge": 0.02, "velocity": [1.0, 0.0, 0.0]}
    parts = {"bodies": [body], "materials": {"jelly": make_material(0.0, 0.0)}, "duration": 1.0, "frames": None}
    for integrator in INTEGRATORS:
        scene = make_scene(fields=turns, solver={"integrator": integrator}, **parts)
        limit = stability.magnetic_limits(Simulator(scene, device="cpu").model, 1.0)[integrator]
        # w = 0.02 C x 5 T / 0.01 kg, at the peak of the curves.
        w, gain = 10.0, math.log(1.05)
        expected = {"rk2": (4 * gain / w**4) ** (1 / 3), "rk4": 8**0.5 / w}.get(integrator, gain / w**2)
        assert limit == pytest.approx(expected, rel=1e-6)
        # At the peak all the time the energy grows by 5 %, to the next order of (w dt)^2.
        steady = [{"type": "magnetic", "strength": [0.0, 5.0, 0.0]}]
        solver = {"integrator": integrator, "steps_per_frame": 1, "dt": limit}
        simulator = Simulator(make_scene(fields=steady, solver=solver, fps=1 / limit, **parts), device="cpu")
        before = simulator.diagnostics()["kinetic"]
        simulator.step(round(1 / limit))
        grown = simulator.diagnostics()["kinetic"] / before
        if integrator == "rk4":
            assert grown <= 1.0
        else:
            assert grown == pytest.approx(1.05, rel=0.01)
        auto = Simulator(
            make_scene(fields=turns, solver={"integrator": integrator, "dt": "auto"}, **parts), device="cpu"
        )
        assert auto.dt <= limit


# What balls do to each other here. Explicit Euler and RK2 have no limit without damping.
BETWEEN = {"stiffness": 1000.0, "damping": 0.8, "friction": 0.0}


def make_squeezed(dt: float = 1e-3, integrator: str = "semi_implicit_euler") -> Scene:
    """Return a scene of a ball of 10 g in the gaps of four others on either side, which are pinned.

    Centres are 1 m apart, the balls a little larger. With normals (+-1/2, +-1/2^0.5, +-1/2) the stiffness is
    k sum n n^T = k diag(2, 4, 2), less a share of the order of overlap / distance, 0.001. The same is what two layers
    of balls, each in the gap of four of the other layer, make when they swing against each other: four times c^2 = 1/2
    for each ball, twice over for the relative motion.
    """
    around = [[x, y, z] for x in (-0.5, 0.5) for y in (-(0.5**0.5), 0.5**0.5) for z in (-0.5, 0.5)]
    bodies = [
        {"name": "around", "type": "network", "material": "loose", "points": around,
         "pinned": [{"lower": [-1.0] * 3, "upper": [1.0] * 3}]},
        {"name": "within", "type": "network", "material": "loose", "points": [[0.0, 0.0, 0.0]]},
    ]  # fmt: skip
    return make_scene(
        bodies=bodies, materials={"loose": make_material(0.0, 0.0, particle_mass=0.01)},
        soft_contact=BETWEEN | {"radius": 0.5005},
        solver={"dt": dt, "integrator": integrator, "steps_per_frame": 20}, fps=0.05 / dt,
    )  # fmt: skip


def growth_between(integrator: str, dt: float) -> float:
    """Return by how much the energy of a squeezed ball grows at most over 4000 steps."""
    simulator = Simulator(make_squeezed(dt, integrator), device="cpu")
    assert simulator.dt == dt
    x, v, rng = simulator.positions, simulator.velocities, np.random.default_rng(7)
    # A millionth of the overlap: a thousand times that is still small. Positions in units of velocity.
    w = np.sqrt(np.array([2.0, 4.0, 2.0]) * BETWEEN["stiffness"] / 0.01)
    x[8], v[8] = 1e-9 * rng.standard_normal((2, 3)) * [np.ones(3), w]
    set_state(simulator, x=x, v=v)
    first, greatest = ((w * x[8]) ** 2 + v[8] ** 2).sum(), 0.0
    for _ in range(200):
        simulator.advance_frame()
        greatest = max(greatest, ((w * simulator.positions[8]) ** 2 + simulator.velocities[8] ** 2).sum() / first)
        if not greatest < 1e6:
            break
    return greatest


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_ball_between_others_obeys_the_limit(integrator: str) -> None:
    """Keep a squeezed ball where it is at 0.95 of the limit in contact, and throw it out at 1.05 of it."""
    simulator = Simulator(make_squeezed(), device="cpu")
    assert simulator.step_limits(contacts=False) == dict.fromkeys(INTEGRATORS, stability.MAX_STEP)
    limit = simulator.step_limits(contacts=True)[integrator]
    # That of four times stiffness and damping on 0.01 kg.
    a, d = (4.0 * BETWEEN[name] / 0.01 for name in ("stiffness", "damping"))
    assert limit is not None
    assert limit == pytest.approx(stability.step_limits(np.array([[0.0, 0.0], [a, d]]))[integrator], rel=1e-6)
    # Semi-implicit Euler lets energy grow by 4 / (1 - share) at most (see the scenes below). The others have the modes
    # of the exact flow, which mix position and velocity by (1 + z) / (1 - z), z = d / (2 a^0.5) = 0.25.
    assert growth_between(integrator, 0.95 * limit) <= 80
    assert not growth_between(integrator, 1.05 * limit) < 1e6


def make_pressed(dt: float) -> Scene:
    """Return a scene of two soft cubes that are pressed together, the balls of one in the gaps of the other."""
    count, unit = 5, 0.25
    # Balls of 0.125 m touch at a height of 2^0.5 times that above gaps; these overlap by 0.1 mm.
    apart = np.array([unit / 2.0, 1.0 + 0.5**0.5 * unit - 1e-4, unit / 2.0])
    bodies = [
        {"name": name, "type": "cube", "material": "jelly", "particles_per_edge": count, "charge": -0.1 * side,
         "position": (side * apart / 2.0).tolist()}
        for name, side in (("upper", 1.0), ("lower", -1.0))
    ]  # fmt: skip
    return make_scene(
        bodies=bodies, materials={"jelly": make_material(20.0, 0.02, particle_mass=0.01)},
        fields=[{"type": "electric", "strength": [0.0, 1.0, 0.0]}],
        soft_contact={"stiffness": 1e4, "damping": 0.5, "friction": 0.0},
        solver={"dt": dt, "steps_per_frame": 20}, fps=0.05 / dt,
    )  # fmt: skip


def pressed_energy(dt: float) -> float:
    """Return the energy of pressed cubes over 0.5 s as a share of what there can be, at most."""
    simulator = Simulator(make_pressed(dt), device="cpu")
    names, given, greatest, contacts = ("kinetic", "elastic", "contact"), 0.0, 0.0, 0
    start = simulator.diagnostics()
    first = sum(start[name] for name in names)
    while simulator.time < 0.5:
        try:
            simulator.advance_frame()
        except DivergedError:
            return math.inf
        now = simulator.diagnostics()
        given = max(given, now["field_work"])
        greatest = max(greatest, sum(now[name] for name in names) / (first + given))
        contacts += now["contact"] > 0.0
    assert contacts > 10 or not greatest < 80
    return greatest


def test_pressed_cubes_need_the_limit_of_their_contact() -> None:
    """Stay bounded at 0.95 of the limit with contact, which is lower than that of the springs, where they blow up."""
    simulator = Simulator(make_pressed(1e-4), device="cpu")
    springs, limit = (simulator.step_limits(contacts=flag)["semi_implicit_euler"] for flag in (False, True))
    assert springs is not None
    assert limit is not None
    # (a, d) of the top motion of the springs plus four times those of a pair; z^2 - (2 - d dt - a dt^2) z + 1 - d dt
    # has the root -1 at 4 - 2 d dt - a dt^2 = 0.
    a, d = stability.bound_spring_pairs(simulator.model, simulator.state.x)[1] + 4.0 * np.array([1e4, 0.5]) / 0.01
    assert limit == pytest.approx((math.sqrt(d * d + 4.0 * a) - d) / a, rel=1e-6)
    assert limit < 0.2 * springs
    assert pressed_energy(0.95 * limit) <= 80
    assert pressed_energy(0.95 * springs) > 80


def test_pinned_particles_do_not_move() -> None:
    """Leave particles of zero inverse mass out: a body held at one end is not less stable than a free one."""
    simulator = Simulator(make_cube(4, ALL_LIMITED), device="cpu")
    free = stability.bound_spring_pairs(simulator.model, simulator.state.x)[1, 0]
    inverse = simulator.model.particle_inv_mass.numpy().copy()
    inverse[simulator.positions[:, 0] < 0.0] = 0.0
    simulator.model.particle_inv_mass.assign(inverse)
    held = stability.bound_spring_pairs(simulator.model, simulator.state.x)[1, 0]
    kept = np.repeat(inverse > 0, 3)
    expected = np.linalg.eigvalsh(Matrices(simulator).a[np.ix_(kept, kept)])[-1]
    assert 0.99 * expected <= held <= expected * (1 + 1e-9)
    assert held < free
    simulator.model.particle_inv_mass.zero_()
    assert stability.bound_spring_pairs(simulator.model, simulator.state.x)[1, 0] == 0


def test_auto_takes_a_safe_step_that_divides_the_frame() -> None:
    """Take half the limit in contact, rounded down to a part of the frame."""
    floor = {"type": "half_space", "normal": [0.0, 1.0, 0.0], "center": [0.0, -3.0, 0.0]}
    simulator = Simulator(make_cube(4, ALL_LIMITED, solver={"dt": "auto"}, colliders=[floor]), device="cpu")
    limit = simulator.step_limits(contacts=True)["semi_implicit_euler"]
    assert limit is not None
    assert limit < simulator.step_limits(contacts=False)["semi_implicit_euler"]
    assert simulator.dt == pytest.approx(1 / (100 * simulator.substeps), rel=1e-15)
    assert simulator.dt <= stability.SAFETY["semi_implicit_euler"] * limit < 1 / (100 * (simulator.substeps - 1))
    simulator.advance_frame()
    assert simulator.time == pytest.approx(0.01, rel=1e-12)


def test_auto_names_the_integrators_that_would_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse an integrator without a stable step."""

    def without(pairs: np.ndarray) -> dict[str, float | None]:
        return dict.fromkeys(INTEGRATORS, None) | {"rk4": 1e-3}

    monkeypatch.setattr("warpjelly.simulator.step_limits", without)
    with pytest.raises(SceneError, match=r'solver.dt = "auto".*semi_implicit_euler.*rk4'):
        Simulator(make_cube(2, UNDAMPED, solver={"dt": "auto"}), device="cpu")


def greatest_energy(simulator: Simulator, time: float) -> tuple[float, np.ndarray]:
    """Run; return the greatest energy as a share of that of the start, and how far particles got along each axis."""

    def total() -> float:
        now = simulator.diagnostics()
        return float(now["kinetic"] + now["elastic"] + now["contact"])

    first, greatest, reach = total(), 0.0, np.zeros(3)
    while simulator.time < time:
        simulator.advance_frame()
        greatest = max(greatest, total() / first)
        reach = np.maximum(reach, simulator.positions.max(axis=0))
    return greatest, reach


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("along", [[0.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
def test_auto_survives_compression(along: list[float], integrator: str) -> None:
    """Let go of an undamped cube that is squeezed by 30 %: for 5 s, some twenty of its swings, it stays bounded."""
    simulator = Simulator(make_cube(6, UNDAMPED, solver={"dt": "auto", "integrator": integrator}), device="cpu")
    axis = np.array(along) / np.linalg.norm(along)
    set_state(simulator, x=simulator.positions - 0.3 * np.outer(simulator.positions @ axis, axis))
    # At half the limit w dt / 2 = 0.5: with H + dt/2 v.F kept, H stays within (1 + 0.5) / (1 - 0.5) of the first. RK4
    # takes energy out.
    assert greatest_energy(simulator, 5.0)[0] <= (3.0 if integrator == "semi_implicit_euler" else 1.0)


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
@pytest.mark.parametrize("contact", [{}, {"damping": 0.0, "static_friction": 0.0, "dynamic_friction": 0.0}])
def test_auto_survives_a_fast_throw_into_a_corner(contact: dict[str, float], integrator: str) -> None:
    """Throw an undamped cube at 15 m/s into a corner of six walls, as they are by default or undamped as well."""
    walls = [
        {"type": "half_space", "normal": (-side * axis).tolist(), "center": (2.0 * side * axis).tolist()}
        for axis in np.eye(3)
        for side in (1.0, -1.0)
    ]
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 6, "rotation": [10.0, 20.0, 30.0],
            "velocity": [10.0, 8.0, 8.0]}  # fmt: skip
    scene = make_scene(
        bodies=[body], materials={"jelly": UNDAMPED}, colliders=walls, contact=contact,
        solver={"dt": "auto", "integrator": integrator},
    )  # fmt: skip
    greatest, reach = greatest_energy(Simulator(scene, device="cpu"), 5.0)
    # In the corner all three walls push, and it does not get through.
    assert (reach > 2.0).all()
    assert (reach < 3.0).all()
    # As above.
    assert greatest <= 3.0


def test_a_run_above_the_limit_warns_with_both_numbers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Warn just above the limit, with the step and the limit; say nothing just below it."""
    limit = limits_of(make_cube(3, ALL_LIMITED))["semi_implicit_euler"]
    assert limit is not None
    for share, warned in ((0.99, False), (1.01, True)):
        caplog.clear()
        dt = share * limit
        with caplog.at_level(logging.WARNING):
            simulate(make_cube(3, ALL_LIMITED, solver={"dt": dt}, fps=1 / dt), output=tmp_path / str(share))
        said = [record.getMessage() for record in caplog.records]
        assert bool(said) == warned
        if warned:
            assert f"{dt:.4g} s" in said[0]
            assert f"{limit:.4g} s" in said[0]


def test_a_diverged_run_names_the_limit_that_was_broken() -> None:
    """Give both numbers when asked for the limits before, and the step alone when it is within them."""
    simulator = Simulator(make_cube(3, ALL_LIMITED, solver={"dt": 0.01}), device="cpu")
    limit = simulator.step_limits(contacts=False)["semi_implicit_euler"]
    rng = np.random.default_rng(1)
    set_state(simulator, x=simulator.positions + 0.01 * rng.standard_normal((27, 3)))
    with pytest.raises(
        DivergedError, match=f"0.01 s is above the largest stable one of the springs, {limit:.4g} s"
    ) as told:
        for _ in range(1000):
            simulator.advance_frame()
    assert str(told.value).count("lower solver.dt") == 1


def test_limits_belong_to_the_start() -> None:
    """Refuse to look for limits in a shape that is not at rest."""
    simulator = Simulator(make_cube(2, ALL_LIMITED), device="cpu")
    simulator.step()
    with pytest.raises(RuntimeError, match="before the first step"):
        simulator.step_limits(contacts=False)


def test_check_gives_all_limits() -> None:
    """List seconds or null for each integrator, as JSON can hold them."""
    figures = forecast(make_cube(3, UNDAMPED), device="cpu")
    limits = json.loads(json.dumps(figures, allow_nan=False))["dt_limit"]
    assert set(limits) == set(INTEGRATORS)
    assert limits["explicit_euler"] is None
    assert limits["rk2"] is None
    top = World(make_cube(3, UNDAMPED)).top_frequency()
    # Of an oscillator, 2 / w and 8^0.5 / w; half of Lanczos's 1 %.
    assert limits["semi_implicit_euler"] == pytest.approx(2 / top, rel=0.005)
    assert limits["rk4"] == pytest.approx(math.sqrt(8) / top, rel=0.005)


# What starts so far from rest that the limit, which is about small motions, says nothing. The two masses, undamped and
# pulled by 0.4 m, swing by 0.4 m / (1 - share^2)^0.5 with semi-implicit Euler: at 0.95 that is more than the 1 m that
# is between them, and they pass through each other. They get the step of auto.
FAR_FROM_REST = ("two_masses",)


def run_at(name: str, share: float) -> float:
    """Run a scene at a share of its limit in contact; return its energy as a share of what there can be, at most.

    What there can be is that of the start, what fields gave, and what gravity gave.
    """
    path = SCENES / f"{name}.toml"
    as_given = Simulator(load_scene(path), device="cpu")
    scene = as_given.scene
    limit = as_given.step_limits(contacts=True)[scene.solver.integrator]
    assert limit is not None
    # About as many samples as it has, of steps of exactly this length.
    dt = share * limit
    substeps = max(1, round(1 / (scene.fps * dt)))
    overrides = {"solver.dt": dt, "solver.steps_per_frame": substeps, "fps": 1 / (substeps * dt)}
    simulator = Simulator(load_scene(path, overrides=overrides), device="cpu")
    assert simulator.dt == dt
    start, greatest = simulator.diagnostics(), 0.0
    first = sum(start[name] for name in ("kinetic", "elastic", "contact", "potential"))
    for _ in range(round(scene.frame_count / (scene.fps * substeps * dt))):
        try:
            simulator.advance_frame()
        except DivergedError:
            return math.inf
        now = simulator.diagnostics()
        stored = now["kinetic"] + now["elastic"] + now["contact"]
        greatest = max(greatest, stored / (first - now["potential"] + now["field_work"]))
    return greatest


@pytest.mark.parametrize("name", NAMES)
def test_every_scene_stays_bounded_below_its_limit_in_contact(name: str) -> None:
    """Run each scene whole at 0.95 of the limit in contact: its energy stays what the scheme can make of it.

    L = v (1 - dt/2 B) v + y A (y - dt v) of the linear scheme never grows (test_energy has why). For a pair (a, d) it
    is a quadratic form in (v, a^0.5 y) of trace 2 - d dt/2 and determinant 1 - d dt/2 - a dt^2/4 >= 1 - share: between
    (1 - share) / 2 and 2 times v^2 + a y^2, twice the energy. So that grows by 4 / (1 - share) at most, 80; what blows
    up comes to 1e10 and far more.
    """
    share = 0.5 if name in FAR_FROM_REST else 0.95
    assert run_at(name, share) <= 4 / (1 - share)


def test_scenes_of_springs_alone_blow_up_above_their_limit() -> None:
    """Exceed that bound, and by far, at 1.3 of the limit where there is no contact, for which the limit is careful."""
    scenes = {name: load_scene(SCENES / f"{name}.toml") for name in NAMES}
    alone = [name for name, scene in scenes.items() if not scene.colliders and not scene.soft_contacts]
    assert alone
    for name in alone:
        assert run_at(name, 1.3) > 1e3, name
