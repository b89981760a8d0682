"""Contact with half-spaces, planes, spheres and boxes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import reference
import warp as wp
from reference import EPSILON, ROUND_OFF, World
from worlds import make_material, make_scene, make_voxels, set_state

from warpjelly.kernels import bounds, contacts
from warpjelly.scene import Scene
from warpjelly.simulator import Simulator

# Turned, off the origin and, where it can be, off the unit length; all react to a body that starts at START.
COLLIDERS: dict[str, dict[str, Any]] = {
    "half_space": {"type": "half_space", "center": [0.3, -0.2, 0.1], "normal": [1.0, 2.0, -2.0]},
    "plane": {
        "type": "plane",
        "center": [0.3, -0.2, 0.1],
        "normal": [1.0, 2.0, -2.0],
        "tangent": [1.0, 0.5, 0.0],
        "size": [2.0, 1.0],
        "threshold": 0.6,
    },
    "sphere": {"type": "sphere", "center": [0.3, -0.2, 0.1], "radius": 0.8},
    "box": {"type": "box", "center": [0.3, -0.2, 0.1], "size": [1.0, 0.7, 1.3]},
}
START = [1.0, 2.0, -2.0]
PENALTY = {"stiffness": 2000.0, "damping": 1.0}
COLLIDERS = {kind: {**collider, **PENALTY} for kind, collider in COLLIDERS.items()}


def make_simulator(
    collider: dict[str, Any], precision: str = "float64", device: str = "cpu", start: Any = START
) -> Simulator:
    """Return a simulator of one small cube and one collider."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.1, "position": start}
    scene = make_scene(bodies=[body], colliders=[collider], solver={"precision": precision})
    return Simulator(scene, device=device)


@wp.kernel(enable_backward=False)
def find_contacts(
    colliders: Any,
    points: wp.array(dtype=Any),
    normals: wp.array2d(dtype=Any),
    depths: wp.array2d(dtype=Any),
):
    """Overwrite normals and depths [point, collider] as seen from body 0."""
    i, c = wp.tid()
    normal, depth = contacts.contact_normal_and_depth(colliders, c, 0, points[i])
    normals[i, c] = normal
    depths[i, c] = depth


def probe(simulator: Simulator, points: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return normals and depths [point, wall] of points in the only collider, which is six walls if it is a box."""
    model, device = simulator.model, simulator.device
    vector = wp.types.vector(3, model.real)
    shape = (len(points), len(model.colliders.kind))
    normals = wp.array(np.full((*shape, 3), np.nan), dtype=vector, device=device)
    depths = wp.array(np.full(shape, np.nan), dtype=model.real, device=device)
    inputs = [model.colliders, wp.array(np.array(points, float), dtype=vector, device=device)]
    wp.launch(find_contacts, dim=shape, inputs=inputs, outputs=[normals, depths], device=device)
    return normals.numpy().astype(float), depths.numpy().astype(float)


def push(
    simulator: Simulator,
    x: np.ndarray,
    v: np.ndarray,
    *,
    culling: bool,
    before: np.ndarray | None = None,
    size: int = 1,
) -> np.ndarray:
    """Return the forces [count, 3] after contact has been added to those before, in chunks of some size."""
    model, device, count = simulator.model, simulator.device, len(x) // size
    before = np.zeros_like(x) if before is None else before
    rows = [wp.array(np.ascontiguousarray(a.T), dtype=model.real, device=device) for a in (x, v, before)]
    lower, upper = (wp.array(np.full((3, count), np.nan), dtype=model.real, device=device) for _ in range(2))
    start = wp.array(size * np.arange(count + 1), dtype=wp.int32, device=device)
    body = wp.zeros(count, dtype=wp.int32, device=device)
    wp.launch(bounds.update_chunk_bounds, dim=count, inputs=[start, rows[0]], outputs=[lower, upper], device=device)
    wp.launch(
        contacts.add_contact_forces,
        dim=(count, 1),
        inputs=[start, body, model.colliders, lower, upper, *rows[:2], culling, 1],
        outputs=[rows[2]],
        device=device,
    )
    return rows[2].numpy().T


def draw_points(count: int, precision: str, seed: int = 0) -> np.ndarray:
    """Return points around the colliders, exact in the precision."""
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (count, 3)).astype(precision).astype(float)


def draw_in_contact(scene: Scene, count: int, precision: str) -> np.ndarray:
    """Return points well inside the only collider of a scene, where a small step does not change its contacts."""
    found = []
    for point in draw_points(40 * count, precision, 1):
        around = [point, *(point + s * 1e-3 * axis for s in (-1, 1) for axis in np.eye(3))]
        sets = [reference.find_contacts(scene.colliders[0], p, np.array(START)) for p in around]
        if sets[0] and all(len(s) == len(sets[0]) for s in sets):
            found.append(point)
    assert len(found) >= count
    return np.array(found[:count])


POINTS = {
    # Wall y = 0, kept above.
    "half_space": (
        {"type": "half_space", "normal": [0.0, 3.0, 0.0]},
        [
            ([5, 0.5, 0], None),
            ([5, 0, -7], ([0, 1, 0], 0.0)),
            ([5, -0.25, 0], ([0, 1, 0], 0.25)),
            ([0, -64, 0], ([0, 1, 0], 64.0)),
        ],
    ),
    # Wall z = 1, kept below although the normal points up.
    "half_space behind": (
        {"type": "half_space", "center": [0.0, 0.0, 1.0], "normal": [0.0, 0.0, 1.0]},
        [([0, 0, 0.5], None), ([9, 9, 1], ([0, 0, -1], 0.0)), ([0, 0, 1.5], ([0, 0, -1], 0.5))],
    ),
    # 2 m along x, 1 m along z, at y = 1, solid down to y = 0.5.
    "plane": (
        {"type": "plane", "center": [0.0, 1.0, 0.0], "normal": [0.0, 2.0, 0.0], "tangent": [3.0, 1.0, 0.0],
         "size": [2.0, 1.0], "threshold": 0.5},
        [
            ([0, 1.25, 0], None),
            ([0, 1, 0], ([0, 1, 0], 0.0)),
            ([0, 0.75, 0], ([0, 1, 0], 0.25)),
            ([0, 0.5, 0], ([0, 1, 0], 0.5)),
            ([0, 0.4375, 0], None),
            ([1, 0.75, 0.5], ([0, 1, 0], 0.25)),
            ([-1, 0.75, -0.5], ([0, 1, 0], 0.25)),
            ([1.0625, 0.75, 0], None),
            ([-1.0625, 0.75, 0], None),
            ([0, 0.75, 0.5625], None),
            ([0.75, 0.75, 0.5], ([0, 1, 0], 0.25)),
            ([0, 0.75, 0.75], None),
        ],
    ),
    # A wall that faces -x, of 1 m along y and 2 m along z.
    "plane facing -x": (
        {"type": "plane", "normal": [-1.0, 0.0, 0.0], "tangent": [0.0, 1.0, 0.0], "size": [1.0, 2.0],
         "threshold": 0.25},
        [
            ([0.125, 0.5, 1], ([-1, 0, 0], 0.125)),
            ([0.125, 0.75, 0], None),
            ([-0.125, 0, 0], None),
            ([0.5, 0, 0], None),
        ],
    ),
    "sphere": (
        {"type": "sphere", "center": [1.0, 0.0, 0.0], "radius": 2.0},
        [
            ([3, 0, 0], ([1, 0, 0], 0.0)),
            ([3.0625, 0, 0], None),
            ([2, 0, 0], ([1, 0, 0], 1.0)),
            ([1, -1.5, 0], ([0, -1, 0], 0.5)),
            ([1, 0, -0.5], ([0, 0, -1], 1.5)),
            # No direction at the centre: up.
            ([1, 0, 0], ([0, 1, 0], 2.0)),
        ],
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", POINTS)
def test_contacts_at_known_points(name: str, precision: str, device: str) -> None:
    """Find normal and depth at points inside, outside and exactly on the borders, in binary fractions."""
    collider, cases = POINTS[name]
    start = [0.0, 0.0, 0.0] if "behind" in name else [0.0, 3.0, 0.0]
    simulator = make_simulator(collider, precision, device, start)
    assert simulator.model.colliders.side.numpy().tolist() == [[-1.0 if "behind" in name else 1.0]]
    points = [point for point, _ in cases]
    normals, depths = probe(simulator, points)
    for point, expected, normal, depth in zip(points, [e for _, e in cases], normals[:, 0], depths[:, 0], strict=True):
        if expected is None:
            assert depth < 0, point
        else:
            assert depth == expected[1], point
            np.testing.assert_array_equal(normal, expected[0], str(point))


def test_box_is_one_contact_for_each_violated_wall(precision: str, device: str) -> None:
    """Find no contact inside a box, one beyond a wall, two beyond an edge and three beyond a corner, at any depth."""
    box = {"type": "box", "center": [1.0, 0.0, 0.0], "size": [2.0, 4.0, 6.0]}
    # Where the body starts does not matter for a box, unlike for a half-space.
    for start in ([1.0, 0.0, 0.0], [50.0, 50.0, 50.0]):
        simulator = make_simulator(box, precision, device, start)
        cases = {
            (1.0, 0.0, 0.0): {},
            (1.75, -1.75, 2.75): {},
            (2.5, 0.0, 0.0): {(-1, 0, 0): 0.5},
            (-0.25, 1.0, 0.0): {(1, 0, 0): 0.25},
            (1.0, 64.0, 3.5): {(0, -1, 0): 62.0, (0, 0, -1): 0.5},
            (-1.0, -3.0, -4.0): {(1, 0, 0): 1.0, (0, 1, 0): 1.0, (0, 0, 1): 1.0},
        }
        normals, depths = probe(simulator, list(cases))
        for expected, normal, depth in zip(cases.values(), normals, depths, strict=True):
            touched = depth >= 0
            found = {tuple(n): d for n, d in zip(normal[touched].tolist(), depth[touched].tolist(), strict=True)}
            assert found == expected


def test_plane_chooses_a_right_handed_frame() -> None:
    """Span a plane without tangent by unit vectors at right angles, tangent x bitangent = normal."""
    for normal in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [1.0, -2.0, 3.0], [1e-3, 0.0, -5.0], [1.0, 1.0, 1.0]):
        collider = {"type": "plane", "normal": normal, "size": [1.0, 1.0]}
        frame = np.array(make_scene(colliders=[collider]).colliders[0].frame())
        # A dozen operations on numbers up to 1.
        bound = 12 * EPSILON["float64"]
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=bound)
        np.testing.assert_allclose(np.cross(frame[0], frame[1]), frame[2], rtol=0, atol=bound)
        np.testing.assert_allclose(frame[2], np.array(normal) / np.linalg.norm(normal), rtol=0, atol=bound)


@pytest.mark.parametrize("kind", COLLIDERS)
def test_force_matches_the_reference(kind: str, precision: str, device: str) -> None:
    """Add max(0, k depth - d v.n) n to the forces of particles in and around a turned collider."""
    collider = COLLIDERS[kind] | {"stiffness": 500.0, "damping": 200.0}
    simulator = make_simulator(collider, precision, device)
    x, v, before = (draw_points(1000, precision, seed) for seed in range(3))
    found = push(simulator, x, v, culling=False, before=before)
    shape = simulator.scene.colliders[0]
    expected = np.array([reference.contact_force(shape, *xv, np.array(START)) for xv in zip(x, v, strict=True)])
    # Every case occurs: outside, pushed, and in contact but leaving too fast to be pushed.
    touched = np.array([bool(reference.find_contacts(shape, p, np.array(START))) for p in x])
    assert 100 <= touched.sum() <= 960
    assert (touched & ~expected.any(axis=1)).sum() >= 5
    # Lengths and speeds of up to 4 in each of up to three contacts.
    scale = 3 * 4 * (500.0 + 200.0)
    np.testing.assert_allclose(found, before + expected, rtol=0, atol=ROUND_OFF[precision] * scale)
    np.testing.assert_array_equal(found[~touched], before[~touched])


@pytest.mark.parametrize("kind", COLLIDERS)
def test_undamped_force_is_minus_the_gradient_of_the_energy(kind: str, precision: str, device: str) -> None:
    """Find the undamped force as the slope of 1/2 k depth^2, as the simulator measures it."""
    simulator = make_simulator(COLLIDERS[kind] | {"damping": 0.0}, precision, device)
    exact = make_simulator(COLLIDERS[kind] | {"damping": 0.0}, "float64", device)
    x = draw_in_contact(simulator.scene, 8, precision)
    force = push(simulator, x, np.ones_like(x), culling=True)
    assert np.isfinite(force).all()
    assert force.any(axis=1).all()
    # Central differences err by h^2/6 E''' and eps E/h: about eps^(2/3) = 4e-11 for h = eps^(1/3).
    h = EPSILON["float64"] ** (1 / 3)
    gradient = np.zeros_like(x)
    clear = np.array(COLLIDERS[kind]["center"])
    for axis in range(3):
        for sign in (1, -1):
            # One particle of the cube takes the place of each point in turn, the others are out of contact.
            for i in range(8):
                alone = np.tile(clear if kind == "box" else 100 * np.array(START), (8, 1))
                alone[i] = x[i] + sign * h * np.eye(3)[axis]
                set_state(exact, x=alone)
                gradient[i, axis] += sign * exact.diagnostics()["contact"] / (2 * h)
    bound = {"float32": ROUND_OFF["float32"], "float64": 1e-8}[precision]
    # Depths of up to 2 m in up to three walls at 2000 N/m.
    np.testing.assert_allclose(force, -gradient, rtol=0, atol=bound * 2000.0 * 2 * 3)


@pytest.mark.parametrize("kind", COLLIDERS)
def test_contact_never_pulls_and_damping_opposes_approach(kind: str, precision: str, device: str) -> None:
    """Push harder against approach, less against leaving, and not at all against leaving fast."""
    simulator = make_simulator(COLLIDERS[kind] | {"stiffness": 500.0, "damping": 50.0}, precision, device)
    shape = simulator.scene.colliders[0]
    x = draw_in_contact(simulator.scene, 8, precision)
    if kind == "box":
        x = np.array([p for p in x if len(reference.find_contacts(shape, p, np.array(START))) == 1])
    normal, depth = zip(*[reference.find_contacts(shape, p, np.array(START))[0] for p in x], strict=True)
    normal, depth = np.array(normal), np.array(depth)

    def pushed(speed: np.ndarray) -> np.ndarray:
        return (push(simulator, x, speed[:, None] * normal, culling=True) * normal).sum(axis=1)

    # k depth - d v.n = 0 at v.n = k depth / d; lengths and speeds are below 10.
    leaving = 500.0 * depth / 50.0
    bound = ROUND_OFF[precision] * (500.0 + 50.0) * 10
    for share in (-1.0, 0.0, 0.5):
        np.testing.assert_allclose(pushed(share * leaving), (1 - share) * 500.0 * depth, rtol=0, atol=bound)
    np.testing.assert_array_equal(pushed(1.5 * leaving), 0)


def test_each_body_keeps_its_side_of_a_half_space(device: str) -> None:
    """Keep two bodies on both sides of one wall, whichever way its normal points."""
    for normal in ([0.0, 4.0, 0.0], [0.0, -0.5, 0.0]):
        bodies = [
            {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.2, "position": [0.0, y, 0.0],
             "velocity": [0.0, -5.0 * y, 0.0]}
            for y in (0.5, -0.5)
        ]  # fmt: skip
        wall = {"type": "half_space", "normal": normal, **PENALTY}
        materials = {"jelly": make_material(30.0, 0.03)}
        simulator = Simulator(make_scene(bodies=bodies, colliders=[wall], materials=materials), device=device)
        # They reach the wall after 0.16 s and, at 2.5 m/s and sqrt(2000/0.01) rad/s, sink in by some 5 mm.
        deepest = 0.0
        for _ in range(50):
            simulator.step(10)
            y = simulator.positions[:, 1].reshape(2, 8)
            deepest = min(deepest, y[0].min(), -y[1].max())
            assert y[0].mean() > 0 > y[1].mean()
        assert -0.02 < deepest < 0
        # Both have bounced.
        velocity = simulator.velocities[:, 1].reshape(2, 8).mean(axis=1)
        assert velocity[0] > 0 > velocity[1]


def test_resting_depth_is_weight_over_stiffness(device: str) -> None:
    """Let a cube come to rest at the depth where k depth carries its weight, m g / k for each column of particles."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.2, "position": [0.0, 0.1, 0.0]}
    floor = {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [1.0, 1.0], "stiffness": 200.0, "damping": 2.0}
    scene = make_scene(
        bodies=[body], colliders=[floor], gravity=[0.0, -9.81, 0.0], materials={"jelly": make_material(50.0, 0.5)}
    )
    simulator = Simulator(scene, device=device)
    # A column of 2 m = 0.02 kg on k and d bounces at sqrt(k/2m) = 100 rad/s and fades by exp(-t d/4m) = exp(-50 t/s):
    # after 4 s nothing but round-off is left.
    simulator.step(4000)
    y = simulator.positions[:, 1]
    # 8 particles on 4 springs: 4 k depth = 8 m g.
    depth = 2 * 0.01 * 9.81 / 200.0
    feet = np.argsort(y)[:4]
    np.testing.assert_allclose(y[feet], -depth, rtol=1e-9)
    measured = simulator.diagnostics()
    assert measured["contacts"] == 4
    assert measured["penetrations"].max() == pytest.approx(depth, rel=1e-9)
    # 1/2 k depth^2 each.
    assert measured["contact"] == pytest.approx(4 * 0.5 * 200.0 * depth**2, rel=1e-8)
    # All forces are in balance: the contact carries the weight.
    np.testing.assert_allclose(simulator.forces.sum(axis=0), 0, atol=1e-9 * 8 * 0.01 * 9.81)


FLIGHTS = {
    "half_space": [{"type": "half_space", "center": [0.0, -0.4, 0.0], "normal": [0.2, 1.0, 0.1]}],
    "plane": [
        {"type": "plane", "center": [0.2, -0.4, 0.0], "normal": [0.2, 1.0, 0.1], "size": [0.9, 0.7]},
        {"type": "plane", "center": [-0.8, 0.0, 0.0], "normal": [1.0, 0.0, 0.3], "size": [0.5, 2.0]},
    ],
    "sphere": [
        {"type": "sphere", "center": [0.1, -0.7, 0.0], "radius": 0.4},
        {"type": "sphere", "center": [-0.9, 0.2, 0.1], "radius": 0.3},
    ],
    "box": [{"type": "box", "size": [2.4, 1.2, 1.6]}],
}
FLIGHTS = {kind: [{**collider, **PENALTY} for collider in colliders] for kind, colliders in FLIGHTS.items()}
FLIGHTS["all"] = [collider for colliders in FLIGHTS.values() for collider in colliders]


def make_flight(kind: str, precision: str, *, culling: bool) -> Simulator:
    """Return a cube of several chunks and a small body that fly past and into colliders."""
    bodies = [
        {"type": "cube", "material": "jelly", "particles_per_edge": 8, "size": 0.6, "rotation": [10.0, 20.0, 30.0],
         "velocity": [-2.0, -3.0, 0.2], "angular_velocity": [1.0, 2.0, 3.0]},
        make_voxels(np.array([[[1, 1], [0, 1]], [[0, 0], [0, 1]]], bool), position=[0.8, 0.3, 0.4],
                    velocity=[-3.0, -2.0, -3.0], cell_size=0.15, particles_per_edge=3),
    ]  # fmt: skip
    scene = make_scene(
        bodies=bodies,
        colliders=FLIGHTS[kind],
        gravity=[0.0, -9.81, 0.0],
        materials={"jelly": make_material(60.0, 0.1)},
        solver={"precision": precision, "culling": culling},
    )
    return Simulator(scene, device="cpu")


@pytest.mark.parametrize("kind", FLIGHTS)
def test_culling_does_not_change_a_bit(kind: str, precision: str) -> None:
    """Simulate the same bits with and without bounding boxes, through and past colliders."""
    culled, full = (make_flight(kind, precision, culling=culling) for culling in (True, False))
    contacts_seen = 0
    for _ in range(20):
        culled.step(25)
        full.step(25)
        assert culled.state.x.numpy().tobytes() == full.state.x.numpy().tobytes()
        assert culled.state.v.numpy().tobytes() == full.state.v.numpy().tobytes()
        contacts_seen += full.diagnostics()["contacts"]
    assert contacts_seen > 0
    assert np.isfinite(full.positions).all()


@pytest.mark.parametrize("far", [0.0, 1000.0])
@pytest.mark.parametrize("kind", COLLIDERS)
def test_culling_keeps_contacts_within_round_off_of_the_border(
    kind: str, far: float, precision: str, device: str
) -> None:
    """Give the same forces with and without bounding boxes to points that touch by a few last bits, or just not."""
    rng = np.random.default_rng(8)
    offset = far * np.array([1.0, -0.5, 0.25])
    simulator = make_simulator(
        COLLIDERS[kind] | {"center": (COLLIDERS[kind]["center"] + offset).tolist()},
        precision, device, (START + offset).tolist(),
    )  # fmt: skip
    # From inside to outside on many lines, a bisection finds the border; then there are the last bits around it.
    shape, start = simulator.scene.colliders[0], START + offset
    points = []
    for a, b in rng.uniform(-1.2, 1.2, (300, 2, 3)) + offset:
        touches = [bool(reference.find_contacts(shape, p, start)) for p in (a, b)]
        if touches[0] == touches[1]:
            continue
        inside, outside = (a, b) if touches[0] else (b, a)
        for _ in range(60):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if reference.find_contacts(shape, middle, start) else (inside, middle)
        points += [inside + step * np.spacing(np.abs(inside).astype(precision)) for step in rng.integers(-3, 4, (9, 3))]
    # The extremes of round and turned solids, where their boxes are tight.
    center = np.array(shape.center)
    extremes = []
    if kind == "sphere":
        extremes = [center + sign * shape.radius * axis for sign in (-1, 1) for axis in np.eye(3)]
    if kind == "plane":
        tangent, bitangent, normal = shape.frame()
        extremes = [
            center + a * shape.size[0] / 2 * tangent + b * shape.size[1] / 2 * bitangent - c * shape.threshold * normal
            for a, b, c in itertools.product((-1, 1), (-1, 1), (0, 1))
        ]
    for point in extremes:
        points += [point + step * np.spacing(np.abs(point).astype(precision)) for step in rng.integers(-3, 4, (200, 3))]
    x = np.array(points).astype(precision)
    # Approaching, a particle feels even a contact of no depth.
    outward = x - center
    v = {"box": outward, "sphere": -outward}.get(kind, np.tile(-np.array(COLLIDERS["plane"]["normal"]), (len(x), 1)))
    full = push(simulator, x, v, culling=False)
    assert push(simulator, x, v, culling=True).tobytes() == full.tobytes()
    # Boxes of two points that reach the border with a corner, the other point being clear of it.
    away = rng.uniform(0.1, 2.0, x.shape) * np.sign(outward if kind == "sphere" else COLLIDERS["plane"]["normal"])
    clear = np.tile(center, (len(x), 1)) if kind == "box" else x + away
    pairs = np.stack([x, clear], axis=1).reshape(-1, 3).astype(precision)
    speeds = np.repeat(v, 2, axis=0)
    both = [push(simulator, pairs, speeds, culling=culling, size=2) for culling in (True, False)]
    assert both[0].tobytes() == both[1].tobytes()
    np.testing.assert_array_equal(both[1][::2], full)
    _, depths = probe(simulator, x)
    touching = (depths >= 0).any(axis=1)
    np.testing.assert_array_equal(full.any(axis=1), touching)
    assert touching.sum() > 100
    assert (~touching).sum() > 100


@pytest.mark.parametrize("kind", ["half_space", "plane", "sphere"])
@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_bounce_gains_no_energy(kind: str, damping: float, device: str) -> None:
    """Drop an undamped cube: total energy does not grow, and it bounces no higher than it came from."""
    floor = {
        "half_space": {"type": "half_space", "normal": [0.0, 1.0, 0.0]},
        "plane": {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [4.0, 4.0], "threshold": 0.3},
        "sphere": {"type": "sphere", "center": [0.05, -1.0, 0.02], "radius": 1.0},
    }[kind] | {"damping": damping, "stiffness": 1000.0}
    body = {
        "type": "cube", "material": "jelly", "particles_per_edge": 3, "size": 0.3,
        "position": [0.0, 0.8, 0.0], "rotation": [10.0, 0.0, 20.0],
    }  # fmt: skip
    scene = make_scene(
        bodies=[body],
        colliders=[floor],
        gravity=[0.0, -9.81, 0.0],
        materials={"jelly": make_material(60.0, 0.0)},
        solver={"dt": 1e-4},
    )
    simulator, world = Simulator(scene, device=device), World(scene)
    weight = simulator.masses.sum() * 9.81
    measured = [simulator.diagnostics()]
    for _ in range(400):
        simulator.step(25)
        measured.append(simulator.diagnostics())
    energy = np.array([sum(m[k] for k in ("kinetic", "elastic", "potential", "contact")) for m in measured])
    height = np.array([m["potential"] for m in measured]) / weight
    touched = np.array([m["contacts"] > 0 for m in measured])
    # Of a linear system semi-implicit Euler conserves H + dt/2 v.F, so H swings by (w dt)/2 of what can swing, that
    # is, at most the energy above the lowest point reached. w^2 <= w_springs^2 + k_c/m; and 10 % for the bends.
    frequency = np.sqrt(world.top_frequency() ** 2 + 1000.0 / 0.01)
    swing = energy[0] - weight * (height.min() - 0.1)
    bound = 1.1 * frequency * simulator.dt / 2 * swing
    assert touched.any()
    assert energy.max() - energy[0] <= bound
    after = np.flatnonzero(touched)[0]
    rebound = height[after:].max()
    assert rebound <= height[0] + bound / weight
    # It does bounce.
    assert rebound > height[after:].min() + 0.1
    if damping == 0:
        assert energy[0] - energy.min() <= bound
    else:
        # The lost energy is far beyond the swing.
        assert energy[0] - energy[-1] > 2 * bound


def test_momentum_is_untouched_without_contact(precision: str) -> None:
    """Simulate the same bits beside colliders that are not touched as without them."""
    far = [
        {"type": "half_space", "center": [0.0, -50.0, 0.0], "normal": [0.0, 1.0, 0.0]},
        {"type": "plane", "center": [2.0, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0], "size": [9.0, 9.0]},
        {"type": "sphere", "center": [0.0, 2.0, 0.0], "radius": 0.5},
        {"type": "box", "size": [80.0, 80.0, 80.0]},
    ]
    for culling in (True, False):
        simulators = [
            Simulator(
                make_scene(
                    colliders=colliders,
                    gravity=[0.0, -9.81, 0.0],
                    solver={"precision": precision, "culling": culling},
                ),
                device="cpu",
            )
            for colliders in (far, [])
        ]
        for simulator in simulators:
            simulator.step(300)
        near, alone = simulators
        assert near.state.x.numpy().tobytes() == alone.state.x.numpy().tobytes()
        assert near.state.v.numpy().tobytes() == alone.state.v.numpy().tobytes()
        assert near.diagnostics()["contacts"] == 0
