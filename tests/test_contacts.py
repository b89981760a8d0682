"""Contact with half-spaces, planes, spheres and boxes."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import reference
import warp as wp
from probes import probe, push, push_fully
from reference import EPSILON, ROUND_OFF, World
from worlds import make_material, make_scene, make_voxels, set_state

from warpjelly.kernels import bounds
from warpjelly.kernels.turns import Turn
from warpjelly.model import PRECISIONS
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


def touch_any(shape: Any, x: np.ndarray, origin: Any = START) -> np.ndarray:
    """Return whether points touch a collider, [count]."""
    return np.any([touch.here for touch in reference.find_touches(shape, x, origin)], axis=0)


def draw_points(count: int, precision: str, seed: int = 0) -> np.ndarray:
    """Return points around the colliders, exact in the precision."""
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (count, 3)).astype(precision).astype(float)


def draw_in_contact(scene: Scene, count: int, precision: str) -> np.ndarray:
    """Return points well inside the only collider of a scene, where a small step does not change its contacts."""
    points = draw_points(40 * count, precision, 1)
    shifts = [np.zeros(3), *(s * 1e-3 * axis for s in (-1, 1) for axis in np.eye(3))]
    counts = [
        np.sum([touch.here for touch in reference.find_touches(scene.colliders[0], points + shift, START)], axis=0)
        for shift in shifts
    ]
    found = points[(counts[0] > 0) & (np.ptp(counts, axis=0) == 0)]
    assert len(found) >= count
    return found[:count]


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
    normals, depths, _ = probe(simulator, points)
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
        normals, depths, _ = probe(simulator, list(cases))
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
    law = reference.contact_law(shape, simulator.scene.contact)
    expected = np.zeros_like(x)
    for touch in reference.find_touches(shape, x, START):
        expected += reference.contact_forces(law, touch, v, before, np.full(1000, 0.01), simulator.dt)[0]
    # Every case occurs: outside, pushed, and in contact but leaving too fast to be pushed.
    touched = touch_any(shape, x)
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
        x = x[np.sum([touch.here for touch in reference.find_touches(shape, x, START)], axis=0) == 1]
    touches = reference.find_touches(shape, x, START)
    normal = sum(touch.here[:, None] * touch.normal for touch in touches)
    depth = sum(np.where(touch.here, touch.depth, 0.0) for touch in touches)

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


def test_boxes_are_the_extremes_of_their_particles(precision: str, device: str) -> None:
    """Find the least and greatest coordinates of chunks of many sizes; what is not a number does not count."""
    sizes = np.array([1, 2, 31, 32, 33, 63, 64, 100, 255, 256, 3])
    start = np.append(0, np.cumsum(sizes))
    x = np.random.default_rng(4).normal(size=(3, start[-1])).astype(precision)
    x[0, start[3] + 7] = np.nan
    x[1, start[4]] = -np.inf
    x[:, start[-2] :] = np.nan
    real = PRECISIONS[precision]
    lower, upper = (wp.full((3, len(sizes)), np.nan, dtype=real, device=device) for _ in range(2))
    # Parts of one, two and three chunks, and one with the rest.
    parts, start = (wp.array(a, dtype=wp.int32, device=device) for a in ([0, 1, 3, 6, len(sizes)], start))
    inputs = [Turn(), parts, start, wp.array(x, dtype=real, device=device)]
    wp.launch(bounds.update_chunk_bounds, dim=4, inputs=inputs, outputs=[lower, upper], device=device)
    start = start.numpy()
    np.testing.assert_array_equal(lower.numpy(), np.fmin.reduceat(np.fmin(x, np.inf), start[:-1], axis=1))
    np.testing.assert_array_equal(upper.numpy(), np.fmax.reduceat(np.fmax(x, -np.inf), start[:-1], axis=1))


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("kind", COLLIDERS)
def test_a_lost_particle_hides_no_contact(kind: str, lost: float, precision: str, device: str) -> None:
    """Lose a particle of a box whose others are in contact: they feel the same bits with culling and without."""
    simulator = make_simulator(COLLIDERS[kind], precision, device)
    points = draw_points(400, precision, 1)
    x = points[touch_any(simulator.scene.colliders[0], points, START)][:10]
    for particle, axis in itertools.product((0, 5, 9), range(3)):
        lossy = x.copy()
        lossy[particle, axis] = lost
        culled, full = (push(simulator, lossy, 0 * x, culling=culling, size=10) for culling in (True, False))
        assert culled.tobytes() == full.tobytes()
        assert full.any(axis=1).sum() >= 9


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
    a, b = np.moveaxis(rng.uniform(-1.2, 1.2, (300, 2, 3)) + offset, 1, 0)
    touches = touch_any(shape, a, start)
    differ = touches != touch_any(shape, b, start)
    inside, outside = np.where(touches[:, None], a, b)[differ], np.where(touches[:, None], b, a)[differ]
    for _ in range(60):
        middle = (inside + outside) / 2
        touches = touch_any(shape, middle, start)[:, None]
        inside, outside = np.where(touches, middle, inside), np.where(touches, outside, middle)
    points = [
        p + step * np.spacing(np.abs(p).astype(precision)) for p in inside for step in rng.integers(-3, 4, (9, 3))
    ]
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
    _, depths, _ = probe(simulator, x)
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


INTEGRATORS = ["explicit_euler", "semi_implicit_euler", "rk2", "rk4"]
# A table of 2 m by 2 m at y = 0, 0.1 m thick, that faces up.
TABLE = {"type": "plane", "normal": [0.0, 1.0, 0.0], "tangent": [1.0, 0.0, 0.0], "size": [2.0, 2.0],
         "threshold": 0.1, **PENALTY}  # fmt: skip


@pytest.mark.parametrize("kind", COLLIDERS)
def test_lanes_do_not_matter(kind: str, precision: str, device: str) -> None:
    """Give the same bits whether one thread does a chunk or 32 lanes share it, also where they do not divide it."""
    simulator = make_simulator(COLLIDERS[kind], precision, device)
    x, v, before = (draw_points(3 * 77, precision, seed) for seed in range(3))
    alone, shared = (push_fully(simulator, x, v, before=before, size=77, lanes=lanes) for lanes in (1, 32))
    assert alone.forces.tobytes() == shared.forces.tobytes()
    assert alone.stamps.tobytes() == shared.stamps.tobytes()
    assert (alone.forces != before.astype(precision)).any()
    # Sums over the lanes come in any order.
    np.testing.assert_allclose(alone.losses, shared.losses, rtol=1e-12)


@pytest.mark.parametrize("kind", COLLIDERS)
def test_culling_leaves_out_boxes_that_are_clear(kind: str, precision: str, device: str) -> None:
    """Trust the boxes of chunks: particles in contact get no force where their box is said to be far away."""
    # A room is clear in its middle, and what lies at the origin or faces +x +y +z is clear of a box far out there.
    collider = COLLIDERS[kind] | ({"normal": [1.0, 2.0, 2.0]} if "normal" in COLLIDERS[kind] else {})
    simulator = make_simulator(collider, precision, device, [1.0, 2.0, 2.0])
    clear = (0.05, 0.1) if kind == "box" else (50.0, 51.0)
    points = draw_points(400, precision, 1)
    x = points[touch_any(simulator.scene.colliders[0], points, [1.0, 2.0, 2.0])]
    assert len(x) > 10
    culled = push_fully(simulator, x, 0 * x, culling=True, box=clear)
    np.testing.assert_array_equal(culled.forces, 0)
    np.testing.assert_array_equal(culled.stamps, -2)
    assert push_fully(simulator, x, 0 * x, culling=False, box=clear).forces.any(axis=1).all()


def throw(
    collider: dict[str, Any],
    velocity: Any,
    position: Any,
    device: str,
    *,
    gravity: Any = (0.0, 0.0, 0.0),
    contact: dict[str, Any] | None = None,
    **solver: Any,
) -> Simulator:
    """Return a simulator of 8 particles without springs, on the corners of a cube of 0.1 m."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "size": 0.1, "position": list(position),
            "velocity": list(velocity)}  # fmt: skip
    scene = make_scene(
        bodies=[body], colliders=[collider], materials={"jelly": make_material(0.0, 0.0)}, gravity=list(gravity),
        solver=solver, **({} if contact is None else {"contact": contact}),
    )  # fmt: skip
    return Simulator(scene, device=device)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("speed", [1.0, 30.0, 1000.0])
def test_fast_particles_do_not_get_through_a_plane(integrator: str, speed: float, device: str) -> None:
    """Catch particles that pass a plane of 0.1 m at up to 1000 m/s, 1 m within a step, and send them back."""
    collider = TABLE | {"stiffness": 2e4, "damping": 0.0, "threshold": 0.5}
    simulator = throw(collider, [0.3, -speed, 0.1], [0.1, 0.45, 0.05], device, integrator=integrator)
    # It takes 0.5 m / speed to get there. At 1000 m/s it ends 0.5 m or more behind and has to be brought back by
    # 1e4 N / 0.01 kg = 1e6 m/s^2: 2 ms. That of the slow ones takes half a period, pi/sqrt(2e4/0.01) = 2 ms.
    simulator.step(700 if speed < 10 else 30)
    assert (simulator.velocities[:, 1] > 0).all()
    # Along the surface nothing happens.
    np.testing.assert_allclose(simulator.velocities[:, [0, 2]], np.tile([0.3, 0.1], (8, 1)), rtol=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_flight_under_a_plane_is_free(integrator: str, device: str) -> None:
    """Leave alone what flies sideways or up from under a plane, inside its threshold: no force, no energy."""
    for velocity, position in (([4.0, 0.0, 0.0], [-1.2, -0.055, 0.0]), ([0.5, 2.0, 0.0], [0.2, -0.5, 0.0])):
        simulator = throw(TABLE, velocity, position, device, integrator=integrator)
        start = simulator.positions
        kinetic, n = simulator.diagnostics()["kinetic"], 500
        for _ in range(n // 10):
            simulator.step(10)
            measured = simulator.diagnostics()
            assert measured["contacts"] == measured["contact"] == 0
            assert measured["kinetic"] == kinetic
        # v n dt, rounded at each of n steps.
        expected = start + np.array(velocity) * n * simulator.dt
        np.testing.assert_allclose(simulator.positions, expected, rtol=0, atol=4 * n * EPSILON["float64"])


def test_springy_cube_under_a_plane_gains_no_energy(device: str) -> None:
    """Fly a vibrating cube sideways under a plane and up against its back: its energy stays what it was."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 3, "size": 0.3, "position": [-1.5, -0.25, 0.0],
            "velocity": [4.0, 0.5, 0.0], "angular_velocity": [1.0, 2.0, 3.0]}  # fmt: skip
    alone, beside = (
        Simulator(
            make_scene(bodies=[body], colliders=colliders, materials={"jelly": make_material(30.0, 0.05)}),
            device=device,
        )
        for colliders in ([], [TABLE])
    )
    for simulator in (alone, beside):
        simulator.step(1000)
    # As without the plane, in every bit. From 0.1 m below it rose by 0.5 m, and crossed 3 m of it meanwhile.
    np.testing.assert_array_equal(alone.positions, beside.positions)
    assert alone.positions[:, 1].min() > 0
    assert beside.diagnostics()["contacts"] == 0


def test_force_ends_at_the_threshold_and_contact_does_not(precision: str, device: str) -> None:
    """Push a particle that was in contact one step earlier with the force of the threshold, however deep it is."""
    simulator = make_simulator(TABLE | {"damping": 0.0}, precision, device, [0.0, 1.0, 0.0])
    x = np.array([[0.0, -0.0625, 0.0], [0.0, -0.5, 0.0], [0.5, -64.0, 0.5], [1.25, -0.0625, 0.0], [0.0, 0.5, 0.0]])
    held, ago = (
        push_fully(simulator, x, 0 * x, step=7, stamps=np.full((1, 5), stamp), culling=culling)
        for stamp, culling in ((6, True), (5, False))
    )
    # k min(depth, threshold); nothing beyond the rectangle or in front.
    bound = ROUND_OFF[precision] * 200.0
    np.testing.assert_allclose(held.forces[:, 1], [125.0, 200.0, 200.0, 0.0, 0.0], rtol=0, atol=bound)
    assert held.stamps.tolist() == [[7, 7, 7, 6, 6]]
    # Two steps ago is over: they are now behind without having come through.
    np.testing.assert_array_equal(ago.forces, 0)
    assert ago.stamps.tolist() == [[5] * 5]
    # At time zero, those within the threshold are in contact, wherever they come from.
    start = push_fully(simulator, x, 0 * x)
    assert (start.stamps == 0).tolist() == [[True, False, False, False, False]]
    # Energy grows on by k threshold for each metre: 1/2 k 0.1^2 + k 0.1 (0.5 - 0.1).
    set_state(simulator, x=np.tile([0.0, 5.0, 0.0], (8, 1)))
    simulator.state.stamps.fill_(-1)
    simulator.state.x.assign(np.tile([[0.0], [-0.5], [0.0]], (1, 8)))
    stored = simulator.diagnostics()
    assert stored["contact"] == pytest.approx(8 * (10.0 + 80.0), rel=ROUND_OFF[precision])
    assert stored["penetrations"].max() == pytest.approx(0.5, rel=ROUND_OFF[precision])


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_body_too_heavy_for_a_plane_falls_through(integrator: str, device: str) -> None:
    """Sink into a plane that carries k threshold = 2 N with 5 N, and go on behind it with what is left of gravity."""
    collider = TABLE | {"stiffness": 20.0, "damping": 0.0}
    simulator = throw(
        collider, [0.0, 0.0, 0.0], [0.0, 0.05, 0.0], device, gravity=[0.0, -500.0, 0.0], integrator=integrator
    )
    simulator.step(200)
    assert (simulator.positions[:, 1] < -1.0).all()
    assert simulator.diagnostics()["contacts"] == 8
    before = simulator.velocities[:, 1]
    simulator.step(100)
    # a = -g + k threshold / m, constant, for 0.1 s, with rounding of speeds of up to 100 m/s.
    change = (-500.0 + 20.0 * 0.1 / 0.01) * 0.1
    np.testing.assert_allclose(simulator.velocities[:, 1] - before, change, rtol=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_contact_ends_beyond_the_rectangle(integrator: str, device: str) -> None:
    """Let go of a particle that slides off a plane, and leave it alone when it comes back under it."""
    collider = TABLE | {"stiffness": 20.0}
    simulator = throw(
        collider, [5.0, 0.0, 0.0], [0.5, 0.05 - 1e-9, 0.0], device, gravity=[0.0, -9.81, 0.0], integrator=integrator
    )
    simulator.step(50)
    assert simulator.diagnostics()["contacts"] == 4
    simulator.step(150)
    # All are beyond x = 1 and fall.
    assert (simulator.positions[:, 0] > 1.2).all()
    assert simulator.diagnostics()["contacts"] == 0
    v = simulator.velocities
    below = np.where(simulator.positions[:, 1] < 0)[0]
    assert len(below) >= 4
    simulator.state.v.assign(np.ascontiguousarray((v * [-1, 0, 1]).T))
    seen = 0
    for _ in range(10):
        simulator.step(10)
        under = simulator.positions[below]
        seen += ((np.abs(under[:, 0]) < 1) & (under[:, 1] < 0)).sum()
        assert (simulator.velocities[below, 1] < 0).all()
    assert seen > 0


def test_contact_that_ended_in_this_step_does_not_hold_in_its_later_stages(precision: str, device: str) -> None:
    """Judge the later stages of a step by the first one, not by the step before: what left is not in contact any more.

    Beyond the rectangle at the start of the step, a trial position behind it is free; outside the ball, one inside it
    has a new entry.
    """
    simulator = make_simulator(TABLE, precision, device, [0.0, 1.0, 0.0])
    start, x = np.array([[1.25, -0.0625, 0.0]]), np.array([[0.75, -0.0625, 0.0]])
    # In contact in step 6, but not in the first evaluation of step 7.
    later = push_fully(simulator, x, 0 * x, start=start, step=7, first=False, stamps=np.full((1, 1), 6))
    np.testing.assert_array_equal(later.forces, 0)
    ball = {"type": "sphere", "radius": 1.0, "normal": "entry", "stiffness": 64.0, "damping": 0.0}
    simulator = make_simulator(ball, precision, device, [0.0, 3.0, 0.0])
    start, x = np.array([[2.0, 0.0, 0.0]]), np.array([[0.5, 0.0, 0.0]])
    normals = np.array([[0.0], [1.0], [0.0]])
    later = push_fully(
        simulator, x, 0 * x, start=start, step=7, first=False, stamps=np.full((1, 1), 6), normals=normals
    )
    np.testing.assert_allclose(later.forces, [[32.0, 0.0, 0.0]], atol=32 * ROUND_OFF[precision])


def test_later_stages_remember_nothing(precision: str, device: str) -> None:
    """Remember contacts in the first evaluation of a step only."""
    simulator = make_simulator(TABLE, precision, device, [0.0, 1.0, 0.0])
    x, start = np.array([[0.0, -0.0625, 0.0]]), np.array([[0.0, 0.5, 0.0]])
    for first in (True, False):
        pushed = push_fully(simulator, x, 0 * x, start=start, step=7, first=first)
        assert pushed.forces[0, 1] > 0
        assert pushed.stamps.tolist() == [[7 if first else -2]]


def test_entry_normal_is_where_the_path_enters_and_stays(precision: str, device: str) -> None:
    """Push back to where a path came into a ball, by the depth along that normal, for as long as contact lasts."""
    ball = {"type": "sphere", "center": [1.0, 0.0, 0.0], "radius": 2.0, "normal": "entry", "stiffness": 64.0,
            "damping": 0.0}  # fmt: skip
    simulator = make_simulator(ball, precision, device, [1.0, 5.0, 0.0])
    close = 64 * 4 * ROUND_OFF[precision]
    # Down the line z = 1.2 of the ball: it enters at y = 1.6, so n = (0, 0.8, 0.6), and from (0, 0.6, 1.2), which is
    # 0.8 x 0.6 + 0.6 x 1.2 = 1.2 along n and 0.6 x 0.6 - 0.8 x 1.2 = -0.6 across, it is (4 - 0.36)^0.5 - 1.2 out.
    start, x = np.array([[1.0, 3.6, 1.2]]), np.array([[1.0, 0.6, 1.2]])
    pushed = push_fully(simulator, x, 0 * x, start=start, step=3)
    normal, depth = np.array([0.0, 0.8, 0.6]), (4 - 0.36) ** 0.5 - 1.2
    np.testing.assert_allclose(pushed.forces[0], 64.0 * depth * normal, rtol=0, atol=close)
    np.testing.assert_allclose(pushed.normals[:, 0], normal, rtol=0, atol=close)
    assert pushed.stamps.tolist() == [[3]]
    # One step later it is elsewhere, with the same normal; through the centre, too.
    for step, point in enumerate(([2.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, -0.8, 1.2]), start=4):
        x, start = np.array([point]), x
        pushed = push_fully(simulator, x, 0 * x, start=start, step=step, stamps=pushed.stamps, normals=pushed.normals)
        local = np.array(point) - [1, 0, 0]
        along = local @ normal
        depth = (along**2 + 4 - local @ local) ** 0.5 - along
        np.testing.assert_allclose(pushed.forces[0], 64.0 * depth * normal, rtol=0, atol=2 * close)
        # It leads to the surface.
        assert np.linalg.norm(local + depth * normal) == pytest.approx(2.0, rel=1e-12)
    # Once it was out, and for who starts inside, the normal is another: here radial.
    pushed = push_fully(simulator, x, 0 * x, step=9, stamps=pushed.stamps, normals=pushed.normals)
    local = x[0] - [1, 0, 0]
    radial = local / np.linalg.norm(local)
    np.testing.assert_allclose(pushed.forces[0], 64.0 * (2 * radial - local), rtol=0, atol=close)


FLIGHT_OPTIONS = {"static_friction": 0.6, "dynamic_friction": 0.4}


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_culling_does_not_change_a_bit_with_friction(integrator: str, precision: str) -> None:
    """Simulate the same bits with and without bounding boxes, with friction and memory, by every scheme."""
    data = make_flight("all", precision, culling=True).scene.model_dump(exclude_none=True)
    data["contact"] |= FLIGHT_OPTIONS
    entry = next(collider for collider in data["colliders"] if collider["type"] == "sphere")
    entry["normal"] = "entry"
    data["solver"] |= {"integrator": integrator, "dt": 5e-4}
    simulators = []
    for culling in (True, False):
        data["solver"]["culling"] = culling
        simulators.append(Simulator(Scene.model_validate(data), device="cpu"))
    seen = 0
    for _ in range(10):
        for simulator in simulators:
            simulator.step(80)
        culled, full = simulators
        for name in ("x", "v", "f", "contact_losses"):
            assert getattr(culled.state, name).numpy().tobytes() == getattr(full.state, name).numpy().tobytes(), name
        seen += full.diagnostics()["contacts"]
    assert seen > 0
    assert np.isfinite(full.positions).all()
    assert full.diagnostics()["friction_losses"] > 0


@pytest.mark.parametrize("kind", COLLIDERS)
def test_thrown_particles_gain_no_energy(kind: str, device: str) -> None:
    """Throw particles at every kind of collider at random, with the defaults for contact: none gets faster."""
    rng = np.random.default_rng(21)
    # The body starts where a half-space keeps it; then the particles are put around the collider.
    collider = {key: value for key, value in COLLIDERS[kind].items() if key not in PENALTY}
    dt, k, d, m = 5e-4, 2000.0, 1.0, 0.01
    for speed in (0.3, 3.0, 30.0):
        simulator = throw(collider, [0.0, 0.0, 0.0], START, device, contact={}, dt=dt)
        center = np.array(COLLIDERS[kind]["center"])
        aim = center + rng.uniform(-0.2, 0.2, (8, 3))
        outward = rng.normal(size=(8, 3)) + 2 * np.array([1, 2, -2]) / 3
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        if kind in ("half_space", "plane"):
            n = np.array([1, 2, -2]) / 3
            outward += np.maximum(0.0, 0.2 - outward @ n)[:, None] * n
            outward /= np.linalg.norm(outward, axis=1)[:, None]
        x = aim if kind == "box" else center + 1.5 * outward
        v = speed * (outward if kind == "box" else (aim - x) / np.linalg.norm(aim - x, axis=1)[:, None])
        set_state(simulator, x=x, v=v)
        start, greatest, seen = simulator.diagnostics()["kinetic"], 0.0, 0
        for _ in range(100):
            simulator.step(max(1, round(0.08 / speed / dt)))
            measured = simulator.diagnostics()
            greatest = max(greatest, measured["kinetic"] + measured["contact"])
            seen += measured["contacts"]
        # Semi-implicit Euler keeps H + dt/2 v.F, so H swings by w dt/2, w^2 = k/m, in each of up to three walls; and
        # damping only makes it less: d dt/m = 0.05.
        assert d * dt / m < 1
        bound = 1 + (k / m) ** 0.5 * dt / 2 * 1.1
        assert greatest <= bound * start
        # In flight there is no swing: none leaves faster than it came.
        after = np.linalg.norm(simulator.velocities, axis=1)
        assert simulator.diagnostics()["contacts"] == 0 or kind == "box"
        if kind != "box":
            assert (after <= speed * (1 + 1e-12)).all()
            assert (after < 0.99 * speed).sum() >= 4
        assert simulator.diagnostics()["kinetic"] < start


@pytest.mark.parametrize("mass", [0.002, 0.01, 1.0])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_bounce_at_the_default_step_is_no_gain(integrator: str, mass: float, device: str) -> None:
    """Throw many particles at a wall with nothing but defaults: whenever they arrive within a step, none gets faster.

    A first depth of up to v dt comes for free. Explicit Euler adds energy while it bounces once k dt > d, which is its
    largest stable step in contact; that is below the default step, and runs warn of it, so it takes a much shorter one.
    """
    rng = np.random.default_rng(13)
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 5, "size": 0.5, "position": [0.0, 1.0, 0.0]}
    data = make_scene(
        bodies=[body], colliders=[{"type": "half_space", "normal": [0.0, 1.0, 0.0]}], contact={},
        materials={"jelly": make_material(0.0, 0.0, particle_mass=mass)},
    ).model_dump(exclude_none=True)  # fmt: skip
    # The step is the default, too, but for explicit Euler: 0.3 of d / k = 0.5 ms.
    data["solver"] = {"integrator": integrator, "precision": "float64"}
    if integrator == "explicit_euler":
        data["solver"]["dt"] = 1.5e-4
    simulator = Simulator(Scene.model_validate(data), device=device)
    x, v = simulator.positions, rng.normal(size=(125, 3))
    x[:, 1], v[:, 1] = rng.uniform(0.001, 0.2, 125), rng.uniform(-3.0, -1.0, 125)
    set_state(simulator, x=x, v=v)
    # At least 1 m/s for 0.2 m, and half a period in contact: pi sqrt(m/k) = 0.07 s for 1 kg.
    simulator.step(round(0.4 / simulator.dt))
    after = simulator.velocities
    assert (after[:, 1] > 0).all()
    assert (np.linalg.norm(after, axis=1) <= np.linalg.norm(v, axis=1)).all()
