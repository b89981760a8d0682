"""Soft against soft: forces between particles against NumPy, conservation laws, and bodies that collide."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import warp as wp
from reference import EPSILON, ROUND_OFF
from worlds import make_material, make_scene, make_voxels

from warpjelly.errors import DivergedError
from warpjelly.scene import Scene
from warpjelly.simulator import Simulator
from warpjelly.softcontact import GRID_SIZE

LOOSE = make_material(0.0, 0.0)
"""Springs without force: what acts is what particles do to each other."""


def colliding(**changes: Any) -> Scene:
    """Return a scene in which bodies collide by the defaults, unlike in other tests."""
    return make_scene(**{"soft_contact": {}, **changes})


def put(simulator: Simulator, x: np.ndarray, v: np.ndarray | None = None) -> None:
    """Put the particles elsewhere, [particle_count, 3] each, and evaluate the forces there."""
    state = simulator.state
    rows = np.ascontiguousarray(np.asarray(x, float).T)
    state.x.assign(rows)
    state.x_start.assign(rows)
    state.v.assign(np.zeros_like(rows) if v is None else np.ascontiguousarray(np.asarray(v, float).T))
    simulator._stepper.add_forces(loss_weight=simulator.dt)


def stored_energy(simulator: Simulator) -> float:
    """Return the energy of all overlaps, J."""
    assert simulator.model.skin is not None
    return simulator._stepper.soft.measure()[0]


def loose_points(*groups: list[list[float]], masses: tuple[float, ...] = (), **changes: Any) -> Scene:
    """Return a scene of bodies of lone particles; without springs their unit is 1 m, the radius of balls 0.5 m."""
    bodies = [
        {"name": f"points_{i}", "type": "network", "points": points, "material": f"loose_{i}"}
        for i, points in enumerate(groups)
    ]
    masses = masses or (0.01,) * len(groups)
    materials = {f"loose_{i}": {**LOOSE, "particle_mass": mass} for i, mass in enumerate(masses)}
    return colliding(bodies=bodies, materials=materials, **changes)


def two_cubes(n: int = 3, *, gap: float = 0.5, speed: float = 2.0, **changes: Any) -> Scene:
    """Return two cubes of 1 m with n^3 particles each, a gap between them along x, thrown at each other."""
    shift = (1.0 + gap) / 2
    bodies = [
        {"name": name, "type": "cube", "material": "jelly", "particles_per_edge": n,
         "position": [sign * shift, 0.02 * sign, 0.03 * sign], "velocity": [-sign * speed, 0.0, 0.0]}
        for name, sign in (("left", -1.0), ("right", 1.0))
    ]  # fmt: skip
    return colliding(**{"bodies": bodies, "solver": {"dt": 5e-4}, **changes})


class Cube:
    """A cube at rest as the reference sees it: places in the grid of unit cells, and its edge and masses."""

    def __init__(self, n: int, size: float, mass: float) -> None:
        self.places = np.array(list(itertools.product(range(n), repeat=3)))
        self.on_skin = ((self.places == 0) | (self.places == n - 1)).any(axis=1)
        self.unit = size / (n - 1)
        self.mass = mass

    def joined(self, a: int, b: int) -> bool:
        """Say whether a spring joins two particles: within a cell, or two cells apart along an axis."""
        apart = sorted(abs(self.places[a] - self.places[b]))
        return apart[-1] == 1 or apart == [0, 0, 2]


def reference_forces(
    cubes: list[Cube], x: np.ndarray, v: np.ndarray, contact: dict[str, Any], dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the force on each particle, [particle_count, 3], N, and the sum of what its parts could round to."""
    owners = [(cube, i) for cube in cubes for i in range(len(cube.places))]
    force, scale = np.zeros_like(x), np.zeros((len(x), 1))
    k, c, mu = (contact[name] for name in ("stiffness", "damping", "friction"))
    for (p, (cube, i)), (q, (other, j)) in itertools.combinations(enumerate(owners), 2):
        if not (cube.on_skin[i] and other.on_skin[j]):
            continue
        radii = [contact.get("radius") or body.unit / 2 for body in (cube, other)]
        reach = sum(radii)
        if cube is other:
            rest = cube.unit * np.linalg.norm(cube.places[i] - cube.places[j])
            if contact["mode"] == "bodies" or rest < reach or cube.joined(i, j):
                continue
        apart = x[p] - x[q]
        distance = np.linalg.norm(apart)
        if distance >= reach:
            continue
        n = apart / distance
        w = v[p] - v[q]
        push = max(0.0, k * (reach - distance) - c * (w @ n))
        slide = w - (w @ n) * n
        slip = np.linalg.norm(slide)
        stop = slip * cube.mass * other.mass / (cube.mass + other.mass) / dt
        f = push * n - min(mu * push, stop) * slide / slip
        force[p] += f
        force[q] -= f
        size = (1 + mu) * (k * reach + c * np.linalg.norm(w))
        scale[[p, q]] += size
    return force, scale


@pytest.mark.parametrize("mode", ["bodies", "all"])
@pytest.mark.parametrize("radius", [None, 0.7])
def test_forces_match_a_search_of_all_pairs(device: str, precision: str, mode: str, radius: float | None) -> None:
    """Scatter two cubes of different cells and masses into each other: each force is that of NumPy over all pairs."""
    cubes = [Cube(3, 1.0, 0.01), Cube(4, 2.4, 0.3)]
    contact = {"mode": mode, "stiffness": 300.0, "damping": 0.4, "friction": 0.5}
    contact |= {} if radius is None else {"radius": radius}
    bodies = [
        {"name": f"cube_{i}", "type": "cube", "particles_per_edge": n, "size": size, "material": f"jelly_{i}"}
        for i, (n, size) in enumerate(((3, 1.0), (4, 2.4)))
    ]
    materials = {f"jelly_{i}": {**LOOSE, "particle_mass": cube.mass} for i, cube in enumerate(cubes)}
    solver = {"precision": precision}
    simulator = Simulator(
        colliding(bodies=bodies, materials=materials, soft_contact=contact, solver=solver), device=device
    )
    random = np.random.default_rng(7)
    count = simulator.model.particle_count
    # Around a corner of the grid, so that cells with negative numbers are among them.
    put(simulator, random.uniform(-1.2, 1.0, (count, 3)), random.normal(0.0, 1.0, (count, 3)))
    x, v = simulator.positions.astype(float), simulator.velocities.astype(float)
    expected, scale = reference_forces(cubes, x, v, contact, simulator.dt)
    assert np.count_nonzero(expected.any(axis=1)) > 60
    # A force is a difference of terms of this scale, and each is some dozen operations.
    error = np.abs(simulator.forces - expected)
    assert (error <= ROUND_OFF[precision] * scale).all(), (error / np.maximum(scale, 1e-30)).max()
    # What acts on all of them together is nothing, to the rounding of each one's sum.
    assert (np.abs(simulator.forces.astype(float).sum(axis=0)) <= EPSILON[precision] * scale.sum()).all()


def test_two_particles_feel_exactly_opposite_forces(device: str, precision: str) -> None:
    """Let two particles of different mass meet anywhere: the forces are the same but for the sign, bit for bit."""
    solver = {"precision": precision}
    scene = loose_points([[0.0, 0.0, 0.0]], [[5.0, 0.0, 0.0]], masses=(0.01, 0.7), solver=solver)
    simulator = Simulator(scene, device=device)
    random = np.random.default_rng(3)
    for _ in range(20):
        put(simulator, random.uniform(-0.25, 0.25, (2, 3)), random.normal(0.0, 1.0, (2, 3)))
        first, second = simulator.forces
        assert np.any(first != 0.0)
        np.testing.assert_array_equal(first, -second)


def test_force_is_minus_the_gradient_of_the_energy(device: str) -> None:
    """Displace particles of two overlapping bodies: f = -dE/dx without damping and friction."""
    contact = {"mode": "all", "stiffness": 300.0, "damping": 0.0, "friction": 0.0}
    simulator = Simulator(two_cubes(materials={"jelly": LOOSE}, soft_contact=contact), device=device)
    random = np.random.default_rng(11)
    x = random.uniform(0.0, 1.2, (simulator.model.particle_count, 3))
    put(simulator, x)
    forces = simulator.forces
    step = 1e-6
    energy = stored_energy(simulator)
    for particle, axis in random.integers((0, 0), (len(x), 3), (20, 2)):
        sides = []
        for sign in (-1.0, 1.0):
            moved = x.copy()
            moved[particle, axis] += sign * step
            put(simulator, moved)
            sides.append(stored_energy(simulator))
        # Rounding of the two sums over the step; and E''' step^2/6 with E''' of about k over the distance, of which a
        # particle has some tens, no nearer than 0.01 m.
        tolerance = 100 * EPSILON["float64"] * energy / step + 50 * 300.0 / 0.01 * step**2
        np.testing.assert_allclose(forces[particle, axis], (sides[0] - sides[1]) / (2 * step), rtol=0, atol=tolerance)


@pytest.mark.parametrize("speed", [-50.0, -1.0, 0.0, 1.0, 50.0, 5000.0])
def test_contact_never_pulls(device: str, precision: str, speed: float) -> None:
    """Part two overlapping particles at any speed: the force along the line of centres is max(0, k o - c v)."""
    contact = {"stiffness": 100.0, "damping": 2.0}
    scene = loose_points([[0.0] * 3], [[5.0, 0.0, 0.0]], soft_contact=contact, solver={"precision": precision})
    simulator = Simulator(scene, device=device)
    # Binary fractions: exact. Overlap 0.25.
    put(simulator, np.array([[0.0, 0.0, 0.0], [0.75, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [speed, 0.0, 0.0]]))
    push = max(0.0, 25.0 - 2.0 * speed)
    np.testing.assert_array_equal(simulator.forces, [[-push, 0.0, 0.0], [push, 0.0, 0.0]])


@pytest.mark.parametrize("slip", [1e-4, 0.01, 0.02, 0.1, 3.0])
def test_friction_is_a_share_of_the_push_and_at_most_stops(device: str, precision: str, slip: float) -> None:
    """Slide two particles past each other: friction is min(mu N, m slip/dt), m the reduced mass, against sliding."""
    contact = {"stiffness": 100.0, "damping": 2.0, "friction": 0.5}
    masses = (0.01, 0.03)
    solver = {"precision": precision}
    scene = loose_points([[0.0] * 3], [[5.0, 0.0, 0.0]], masses=masses, soft_contact=contact, solver=solver)
    simulator = Simulator(scene, device=device)
    x, v = np.array([[0.0, 0.0, 0.0], [0.75, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [0.0, slip, 0.0]])
    put(simulator, x, v)
    reduced = 0.01 * 0.03 / 0.04
    friction = min(0.5 * 25.0, reduced * slip / 1e-3)
    forces = np.array([[-25.0, friction, 0.0], [25.0, -friction, 0.0]])
    # Masses and the step are rounded, then some operations.
    np.testing.assert_allclose(simulator.forces, forces, rtol=10 * EPSILON[precision])
    simulator.step()
    after = np.subtract(*simulator.velocities[::-1])[1]
    # Sticking leaves no sliding, to rounding; sliding goes on in its direction.
    stops = friction < 0.5 * 25.0
    assert abs(after) <= 10 * EPSILON[precision] * slip if stops else 0.0 < after < slip


@pytest.mark.parametrize("size", [1.0, 0.1, 0.3, 0.07, 12.3])
def test_particles_close_at_rest_never_collide(device: str, precision: str, size: float) -> None:
    """Bring any two particles of two cubes that touch along an edge together: they collide if they were apart at rest.

    Close at rest is nearer than the sum of radii, or joined by a spring; among the first are those that coincide. Those
    exactly at the sum of radii collide, whatever the rounding.
    """
    cells = np.zeros((2, 2, 1), bool)
    cells[0, 0, 0] = cells[1, 1, 0] = True
    bodies = [{**make_voxels(cells, cell_size=size), "name": "cubes"}]
    contact = {"mode": "all", "stiffness": 1.0, "damping": 0.0, "friction": 0.0}
    solver = {"precision": precision}
    scene = colliding(bodies=bodies, materials={"jelly": LOOSE}, soft_contact=contact, solver=solver)
    simulator = Simulator(scene, device=device)
    places = np.round(simulator.positions / size * 2)
    assert len(places) == 16
    # The two cubes share no particle, so no spring joins them; within a cube, springs join all.
    lower = np.zeros(16, bool)
    for i, j, count, _ in simulator.model.spans.numpy().tolist():
        for k in range(count):
            lower[[i + k, j + k]] |= i == 0 or lower[i + k] or lower[j + k]
    assert lower.sum() == 8
    apart = 10.0 * size * np.arange(16)[:, None] * np.array([1.0, 0.0, 0.0])
    collided = coincident = 0
    for a, b in itertools.combinations(range(16), 2):
        x = apart.copy()
        x[a] = x[b] + [size / 4, 0.0, 0.0]
        put(simulator, x)
        same = (places[a] == places[b]).all()
        expected = np.zeros((16, 3))
        if lower[a] != lower[b] and not same:
            expected[a, 0], expected[b, 0] = 0.75 * size, -0.75 * size
            collided += 1
        coincident += same
        # Places of up to 160 cells are rounded, and their difference is compared with one cell.
        np.testing.assert_allclose(simulator.forces, expected, rtol=0, atol=200 * size * EPSILON[precision])
    assert coincident == 2 and collided == 8 * 8 - 2


@pytest.mark.parametrize("size", [1.0, 0.1, 0.3, 0.07])
def test_walls_of_a_narrow_slot_collide(device: str, precision: str, size: float) -> None:
    """Close slots of one cell in a comb: opposite particles are a cell apart at rest: not close, at any rounding."""
    cells = np.ones((9, 2, 1), bool)
    cells[1::2, 1] = False
    body = {**make_voxels(cells, cell_size=size), "name": "comb"}
    contact = {"mode": "all", "stiffness": 1.0, "damping": 0.0, "friction": 0.0}
    solver = {"precision": precision}
    scene = colliding(bodies=[body], materials={"jelly": LOOSE}, soft_contact=contact, solver=solver)
    simulator = Simulator(scene, device=device)
    places = np.round(simulator.positions / size * 2) / 2
    # Over the bottom of each slot, at the top, on both sides.
    left = np.flatnonzero((places[:, 1] == 1.0) & np.isin(places[:, 0], np.arange(-3.5, 4.0, 2.0)))
    right = np.array([int(np.flatnonzero((places == places[i] + [1.0, 0.0, 0.0]).all(axis=1))[0]) for i in left])
    assert len(left) == 8
    x = 10.0 * size * np.arange(len(places))[:, None] * np.array([0.0, 1.0, 0.0])
    x[right] = x[left] + [size / 4, 0.0, 0.0]
    put(simulator, x)
    expected = np.zeros_like(x)
    expected[left, 0], expected[right, 0] = -0.75 * size, 0.75 * size
    # Overlap is a difference of lengths near one cell.
    np.testing.assert_allclose(simulator.forces, expected, rtol=0, atol=10 * size * EPSILON[precision])


def test_centres_that_coincide_have_no_force(device: str, precision: str) -> None:
    """Put particles of two bodies into one place: there is no direction to push to, and nothing becomes NaN."""
    scene = loose_points([[0.0] * 3], [[5.0, 0.0, 0.0]], solver={"precision": precision})
    simulator = Simulator(scene, device=device)
    put(simulator, np.full((2, 3), 0.3), np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(simulator.forces, np.zeros((2, 3)))
    assert np.isfinite(simulator.state.pair_losses.numpy()).all()


def fold(rest: np.ndarray, cells: int) -> np.ndarray:
    """Bend a strip along x of so many unit cells of 1 m into a ring whose ends overlap by a quarter of a cell."""
    turn = 2 * np.pi * (rest[:, 0] - rest[:, 0].min()) / (cells + 0.75)
    radius = (cells + 0.75) / (2 * np.pi) + rest[:, 1] - rest[:, 1].mean()
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), rest[:, 2]], axis=1)


@pytest.mark.parametrize("mode", ["bodies", "all"])
def test_a_folded_body_collides_with_itself_if_asked_to(device: str, precision: str, mode: str) -> None:
    """Bend a strip until its ends meet: they push each other apart with mode "all", and pass with "bodies"."""
    strip = make_voxels(np.ones((16, 1, 1), bool), cell_size=1.0, name="strip")
    far = {"name": "far", "type": "cube", "material": "jelly", "particles_per_edge": 2, "position": [90.0, 0.0, 0.0]}
    scene = colliding(
        bodies=[strip, far], materials={"jelly": LOOSE}, soft_contact={"mode": mode}, solver={"precision": precision}
    )
    simulator = Simulator(scene, device=device)
    x = simulator.positions
    part = simulator.model.bodies[0].particles
    first, last = (x[part, 0] == edge for edge in (x[part, 0].min(), x[part, 0].max()))
    x[part] = fold(x[part], 16)
    put(simulator, x)
    forces = simulator.forces[part]
    if mode == "bodies":
        np.testing.assert_array_equal(forces, np.zeros_like(forces))
        return
    # The ring starts and ends at y = 0, the first end above it: it is pushed up, the last one down.
    assert first.sum() == last.sum() == 4
    assert (forces[first, 1] > 50.0).all() and (forces[last, 1] < -50.0).all()
    np.testing.assert_array_equal(forces[~(first | last)], 0.0)
    np.testing.assert_array_equal(simulator.forces[simulator.model.bodies[1].particles], 0.0)


def run_bits(scene: Scene, device: str, steps: int = 400) -> list[np.ndarray]:
    """Return positions, velocities and forces after some steps."""
    simulator = Simulator(scene, device=device)
    simulator.step(steps)
    return [simulator.positions, simulator.velocities, simulator.forces]


def launches_of(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the names of the kernels that one substep launches, and of what is built for it."""
    simulator = Simulator(scene, device="cpu")
    names: list[str] = []
    launch, build = wp.launch, wp.HashGrid.build

    def record(kernel: wp.Kernel, *args: Any, **kwargs: Any) -> Any:
        names.append(kernel.key)
        return launch(kernel, *args, **kwargs)

    def record_build(*args: Any, **kwargs: Any) -> Any:
        names.append("build")
        return build(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", record)
        patch.setattr(wp.HashGrid, "build", record_build)
        simulator._stepper.launch_step()
    return names


def test_off_and_single_bodies_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Count what a substep launches: pairs are extra only where something may collide, a search where it is near."""
    plain = ["set_gravity_forces", "add_span_forces", "semi_implicit_euler", "count_step"]
    boxes = ["update_chunk_bounds", "update_body_bounds", "find_meetings"]
    search = ["gather_skin", "build", "add_pair_forces"]
    one = two_cubes().bodies[:1]
    for changes, mode, culling, extra in [
        ({}, "off", True, []), ({"bodies": one}, "off", True, []), ({"bodies": one}, "bodies", True, []),
        ({}, "bodies", True, [*boxes, *search]), ({}, "bodies", False, search), ({}, "all", True, search),
        ({"gap": 1.5}, "bodies", True, [*boxes, search[-1]]), ({"gap": 1.5}, "bodies", False, search),
        ({"bodies": one}, "all", True, search),
    ]:  # fmt: skip
        scene = two_cubes(soft_contact={"mode": mode}, solver={"dt": 5e-4, "culling": culling}, **changes)
        assert launches_of(scene, monkeypatch) == [*plain[:2], *extra, *plain[2:]], (mode, culling)


def three_bodies(culling: bool, **solver: Any) -> Scene:
    """Return two turning cubes of several chunks that fly at each other from afar, and a small one between them."""
    shapes = ((8, 1.0, -1.3, 4.0), (3, 0.3, 0.05, 0.0), (7, 1.2, 1.4, -4.0))
    bodies = [
        {"name": f"cube_{n}", "type": "cube", "material": "jelly", "particles_per_edge": n, "size": size,
         "position": [x, 0.1 * size, 0.02], "velocity": [speed, 0.0, 0.0], "angular_velocity": [1.0, 2.0, 3.0]}
        for n, size, x, speed in shapes
    ]  # fmt: skip
    materials = {"jelly": make_material(60.0, 0.05)}
    return colliding(bodies=bodies, materials=materials, solver={"dt": 2.5e-4, "culling": culling, **solver})


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_culling_does_not_change_a_bit(device: str, precision: str, integrator: str) -> None:
    """Collide three bodies with boxes and without: the same bits, before they meet, then, and after."""
    culled, full = (
        Simulator(three_bodies(culling, precision=precision, integrator=integrator), device=device)
        for culling in (True, False)
    )
    meetings = []
    for _ in range(45):
        for simulator in (culled, full):
            simulator.step(50)
        meetings.append(bool(culled._stepper.soft._meetings.numpy()[0]))
        for name in ("x", "v", "f", "pair_losses"):
            assert getattr(culled.state, name).numpy().tobytes() == getattr(full.state, name).numpy().tobytes(), name
    assert not meetings[0] and any(meetings) and not meetings[-1]
    assert full.diagnostics()["friction_losses"] > 0.0


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf, 1e30])
def test_a_lost_particle_touches_nobody_and_hides_nobody(device: str, precision: str, lost: float) -> None:
    """Lose one of many points in each other: it gets no force, others the same bits with culling and without."""
    x = np.random.default_rng(2).uniform(-3.0, 3.0, (600, 3))
    forces = []
    for culling in (True, False):
        solver = {"precision": precision, "culling": culling}
        simulator = Simulator(loose_points(x[:300].tolist(), x[300:].tolist(), solver=solver), device=device)
        lossy = x.copy()
        lossy[0, 1] = lost
        put(simulator, lossy)
        forces.append(simulator.forces)
    assert forces[0].tobytes() == forces[1].tobytes()
    np.testing.assert_array_equal(forces[0][0], 0.0)
    assert np.count_nonzero(forces[0].any(axis=1)) > 300


def test_only_chunks_near_another_body_are_searched(device: str, precision: str) -> None:
    """Put two cubes of two chunks each face to face: those at the faces find each other, those behind find nothing."""
    scene = two_cubes(8, gap=0.1, solver={"dt": 5e-4, "precision": precision})
    simulator = Simulator(scene, device=device)
    x, body = simulator.positions, simulator.model.chunk_body.numpy()
    assert body.tolist() == [0, 0, 1, 1]
    lower, upper = simulator._stepper.soft._near_lower.numpy().T, simulator._stepper.soft._near_upper.numpy().T
    # Chunks are layers along x: the second of the left cube and the first of the right one.
    for chunk, other in ((1, x[512:768]), (2, x[256:512])):
        np.testing.assert_array_equal([lower[chunk], upper[chunk]], [other.min(axis=0), other.max(axis=0)])
    for chunk in (0, 3):
        assert (lower[chunk] > upper[chunk]).all()


@pytest.mark.parametrize("mode", ["bodies", "all"])
def test_what_never_touches_moves_as_without_contact(device: str, precision: str, mode: str) -> None:
    """Let a turning cube and another one pass at a distance: not a bit differs from mode "off"."""
    results = []
    for soft in (mode, "off"):
        scene = two_cubes(gap=3.0, speed=0.5, soft_contact={"mode": soft}, solver={"precision": precision, "dt": 5e-4})
        results.append(run_bits(scene, device))
    for found, expected in zip(*results, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_captured_steps_equal_launched_ones(precision: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a collision with and without capture: the grid is rebuilt in the graph, and not a bit differs."""
    scene = two_cubes(solver={"precision": precision, "dt": 5e-4})
    captured = run_bits(scene, "cpu")

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError("no capture")

    monkeypatch.setattr(wp, "ScopedCapture", refuse)
    launched = run_bits(scene, "cpu")
    # They have met: without contact the mean of the first cube would have gone on.
    assert captured[1][:27, 0].mean() < 0.0
    for found, expected in zip(captured, launched, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_two_runs_are_equal(precision: str) -> None:
    """Run a collision of bodies with themselves and each other twice on the CPU: not a bit differs."""
    scene = two_cubes(soft_contact={"mode": "all"}, solver={"precision": precision, "dt": 5e-4})
    for found, expected in zip(run_bits(scene, "cpu"), run_bits(scene, "cpu"), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("integrator", ["explicit_euler", "semi_implicit_euler", "rk2", "rk4"])
def test_a_collision_keeps_momentum(device: str, precision: str, integrator: str) -> None:
    """Collide two spinning cubes with friction: linear momentum is what it was, to rounding."""
    scene = two_cubes(solver={"precision": precision, "dt": 5e-4, "integrator": integrator})
    bodies = [{**body.model_dump(), "angular_velocity": [1.0, 2.0, 3.0]} for body in scene.bodies]
    scene = scene.model_copy(update={"bodies": colliding(bodies=bodies).bodies})
    simulator = Simulator(scene, device=device)
    mass = simulator.masses.astype(float)[:, None]
    before = (mass * simulator.velocities).sum(axis=0)
    simulator.step(600)
    v = simulator.velocities.astype(float)
    assert v[:27, 0].mean() < 0.0
    # Each velocity rounds once a step (a few times with stages), by half an epsilon of its size, a few m/s; forces
    # of up to 1e3 N round alike, times dt.
    worst = 600 * 4 * EPSILON[precision] * (mass.sum() * 5.0 + len(v) * 1e3 * simulator.dt)
    np.testing.assert_allclose((mass * v).sum(axis=0), before, rtol=0, atol=worst)
    assert simulator.diagnostics()["friction_losses"] > 0.0


def total_energy(simulator: Simulator) -> float:
    """Return the sum of all energies and all losses, J."""
    names = ("kinetic", "elastic", "potential", "contact", "spring_losses", "contact_losses", "friction_losses")
    found = simulator.diagnostics()
    return sum(found[name] for name in names)


def test_the_energy_account_of_a_collision_closes(device: str) -> None:
    """Collide two cubes: energies and losses keep their sum to first order, so half the step halves the deviation."""
    deviations = []
    for substeps in (40, 80, 160):
        simulator = Simulator(two_cubes(solver={"dt": 0.01 / substeps}), device=device)
        start = total_energy(simulator)
        worst = 0.0
        for _ in range(40):
            simulator.advance_frame()
            worst = max(worst, abs(total_energy(simulator) - start))
        found = simulator.diagnostics()
        assert found["contact_losses"] > 0.01 * start and found["friction_losses"] > 0.0
        deviations.append(worst / start)
    # Contacts begin within a step, anywhere in it, which is a part of first order that comes and goes.
    assert 1.6 < deviations[0] / deviations[1] < 2.4 and 1.6 < deviations[1] / deviations[2] < 2.4, deviations
    assert deviations[2] < 0.01


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "rk4"])
def test_colliding_never_gains_energy(device: str, precision: str, integrator: str) -> None:
    """Collide two cubes with all losses of contact: what is not lost never exceeds the start, to first order."""
    scene = two_cubes(solver={"precision": precision, "dt": 5e-4, "integrator": integrator})
    simulator = Simulator(scene, device=device)
    start = simulator.diagnostics()["kinetic"]
    for _ in range(40):
        simulator.advance_frame()
        found = simulator.diagnostics()
        # The energy of semi-implicit Euler swings by about omega dt/2, here below 5 %.
        assert found["kinetic"] + found["elastic"] + found["contact"] < 1.05 * start
    assert simulator.velocities[:27, 0].mean() < 0.0


@pytest.mark.parametrize("shift", [0.0, 0.25])
@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_cubes_do_not_pass_through_each_other(device: str, precision: str, shift: float, n: int, speed: float) -> None:
    """Throw two cubes at each other, face to face and with particles aimed at the gaps: both come back."""
    aim = shift * 2 / (n - 1)
    bodies = [
        {"name": name, "type": "cube", "material": "jelly", "particles_per_edge": n,
         "position": [sign * 0.8, sign * aim / 2, sign * aim / 2], "velocity": [-sign * speed, 0.0, 0.0]}
        for name, sign in (("left", -1.0), ("right", 1.0))
    ]  # fmt: skip
    scene = colliding(bodies=bodies, solver={"dt": 2.5e-4, "precision": precision})
    simulator = Simulator(scene, device=device)
    half = simulator.model.particle_count // 2
    for _ in range(round(60 / speed)):
        simulator.advance_frame()
        x = simulator.positions
        # Neither middle reaches the other one's.
        assert x[:half, 0].mean() < x[half:, 0].mean()
    v = simulator.velocities
    assert v[:half, 0].mean() < 0.0 < v[half:, 0].mean()


def test_a_cube_rests_on_another_one(device: str, precision: str) -> None:
    """Drop a cube on another one on the floor: they come to rest, the upper one's balls in gaps, and stay there."""
    # A unit cell is 1/3 m, and so is the distance at which balls meet. Half a cell aside, balls are over gaps.
    bodies = [
        {"name": name, "type": "cube", "material": "jelly", "particles_per_edge": 4, "position": [x, y, 0.0]}
        for name, x, y in (("lower", 0.0, 0.5), ("upper", 1.0 / 6, 1.8))
    ]
    scene = colliding(
        bodies=bodies,
        materials={"jelly": make_material(1000.0, 0.3)},
        gravity=[0.0, -9.81, 0.0],
        solver={"dt": 2.5e-4, "precision": precision},
        colliders=[{"type": "half_space", "normal": [0.0, 1.0, 0.0]}],
    )
    simulator = Simulator(scene, device=device)
    for _ in range(200):
        simulator.advance_frame()
    settled = simulator.positions
    for _ in range(100):
        simulator.advance_frame()
    # In a second it would have fallen by 4.9 m; what is allowed is 1 % of a unit cell.
    assert np.linalg.norm(simulator.positions - settled, axis=1).max() < 0.01 / 3
    assert simulator.positions[64:, 1].min() > 1.0


def test_bodies_far_from_the_origin_collide(device: str) -> None:
    """Collide two cubes 1 km away in float32: they come back, as at the origin."""
    scene = two_cubes(solver={"precision": "float32", "dt": 5e-4})
    bodies = [{**body.model_dump(), "position": np.add(body.position, 1000.0).tolist()} for body in scene.bodies]
    scene = scene.model_copy(update={"bodies": colliding(bodies=bodies).bodies})
    simulator = Simulator(scene, device=device)
    for _ in range(40):
        simulator.advance_frame()
    v = simulator.velocities
    assert v[:27, 0].mean() < 0.0 < v[27:, 0].mean()


def test_the_search_hides_no_pair(device: str, precision: str) -> None:
    """Put pairs anywhere, far away and across all kinds of cell borders: each overlap is found from both sides."""
    random = np.random.default_rng(5)
    count = 400
    # Spread so that only the pairs themselves meet, and beyond 64 cells, where the grid repeats.
    centers = 3.0 * np.array(list(itertools.product(range(-10, 10), range(-5, 5), (-333, 341))), float)[:count]
    # Where a cell, and where the whole grid, begins.
    centers[::2] += 0.5 * random.integers(-1, 2, (count // 2, 3))
    along = random.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    along[:60] = np.eye(3)[np.arange(60) % 3]
    points = [[[-5000.0 + 3.0 * i, side, 0.0] for i in range(count)] for side in (0.0, 5000.0)]
    contact = {"stiffness": 1.0, "damping": 0.0, "friction": 0.0}
    simulator = Simulator(loose_points(*points, soft_contact=contact, solver={"precision": precision}), device=device)
    # Overlaps from large to a few epsilons of the coordinates.
    overlap = np.geomspace(1e-3, 0.5, count)[:, None]
    put(simulator, np.concatenate([centers, centers + (1.0 - overlap) * along]))
    x = simulator.positions.astype(float)
    apart = x[count:] - x[:count]
    distance = np.linalg.norm(apart, axis=1, keepdims=True)
    # At 1 km float32 moves particles, but they are where they are.
    expected = np.maximum(0.0, 1.0 - distance) * apart / distance
    assert (distance < 1.0).all()
    forces = simulator.forces
    np.testing.assert_allclose(forces[count:], expected, rtol=0, atol=ROUND_OFF[precision])
    np.testing.assert_array_equal(forces[:count], -forces[count:])


def test_the_repeating_grid_gives_no_false_contact(device: str, precision: str) -> None:
    """Put bodies 64 cells apart, so that they share cells of the grid: they do not feel each other."""
    scene = loose_points([[0.0] * 3], [[5.0, 0.0, 0.0]], solver={"precision": precision})
    simulator = Simulator(scene, device=device)
    for direction in itertools.product((-1, 0, 1), repeat=3):
        if direction == (0, 0, 0):
            continue
        # Cells are as wide as two radii, 1 m.
        put(simulator, 0.1 + 2 * GRID_SIZE * np.array([[0.0] * 3, direction]))
        np.testing.assert_array_equal(simulator.forces, np.zeros((2, 3)))
        assert stored_energy(simulator) == 0.0


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf, 1e30])
def test_a_lost_particle_is_reported(device: str, precision: str, lost: float) -> None:
    """Lose a particle: the frame ends with an error that says so, and the process lives."""
    simulator = Simulator(two_cubes(solver={"precision": precision, "dt": 5e-4}), device=device)
    x = simulator.positions
    x[5, 1] = lost
    put(simulator, x, simulator.velocities)
    with pytest.raises(DivergedError, match="of 'left'"):
        simulator.advance_frame()


BODIES: dict[str, dict[str, Any]] = {
    "cloth": {"type": "cloth", "size": [1.5, 1.5], "particles": [9, 9], "position": [0.03, 0.9, 0.05]},
    "network": {
        "type": "network", "position": [0.1, 0.9, 0.05], "points": [[-0.2, 0, -0.2], [0.3, 0, 0], [-0.1, 0, 0.3]],
        "structural": [[0, 1], [1, 2], [2, 0]],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ["cloth", "network"])
def test_cloth_and_networks_fall_on_a_cube(device: str, precision: str, name: str) -> None:
    """Drop what has no volume on a pinned cube: it is caught by the top."""
    cube = {
        "name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 7,
        "pinned": [{"lower": [-1.0] * 3, "upper": [1.0] * 3}],
    }  # fmt: skip
    body = {"name": name, "material": "light", **BODIES[name]}
    materials = {"jelly": make_material(), "light": make_material(20.0, 0.02)}
    scene = colliding(
        bodies=[cube, body],
        materials=materials,
        gravity=[0.0, -9.81, 0.0],
        solver={"dt": 2.5e-4, "precision": precision},
        soft_contact={"damping": 1.0},
    )
    simulator = Simulator(scene, device=device)
    for _ in range(60):
        simulator.advance_frame()
    x = simulator.positions[simulator.model.bodies[1].particles]
    above = (np.abs(x[:, [0, 2]]) < 0.4).all(axis=1)
    # Freely it would have fallen by 1.8 m; the top is at 0.5 m.
    assert above.any() and x[above, 1].min() > 0.5
