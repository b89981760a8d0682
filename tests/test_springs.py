"""The spring law and both of its kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from reference import EPSILON, ROUND_OFF, elastic_energy, spring_forces
from worlds import make_material, make_scene, make_voxels

from warpjelly.cells import Cells
from warpjelly.kernels import springs
from warpjelly.kernels.turns import Turn
from warpjelly.lattice import build_lattice
from warpjelly.model import PRECISIONS, spring_classes
from warpjelly.scene import Material
from warpjelly.simulator import Simulator


@wp.kernel(enable_backward=False)
def evaluate_law(
    offset: wp.array(dtype=Any),
    velocity: wp.array(dtype=Any),
    constants: wp.array(dtype=Any),
    force: wp.array(dtype=Any),
    energy: wp.array(dtype=Any),
):
    """Evaluate the law and its energy, one thread per spring."""
    i = wp.tid()
    c = constants[i]
    force[i] = springs.spring_force(offset[i], velocity[i], c[0], c[1], c[2])
    energy[i] = springs.spring_energy(offset[i], c[0], c[1])


def evaluate(
    offset: np.ndarray, velocity: np.ndarray, constants: np.ndarray, precision: str, device: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the forces on the first ends and the energies of some springs."""
    real = PRECISIONS[precision]
    vector = wp.types.vector(3, real)
    inputs = [wp.array(np.asarray(a), dtype=vector, device=device) for a in (offset, velocity, constants)]
    force = wp.array(np.full(np.shape(offset), np.nan), dtype=vector, device=device)
    energy = wp.array(np.full(len(offset), np.nan), dtype=real, device=device)
    wp.launch(evaluate_law, dim=len(offset), inputs=inputs, outputs=[force, energy], device=device)
    return force.numpy().astype(float), energy.numpy().astype(float)


def draw_springs(count: int, precision: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets [m], relative velocities [m/s] and constants of random springs, exact in the precision."""
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(count, 3)), rng.normal(size=(count, 3)), rng.uniform([0.1, 1, 0], [2, 900, 5], (count, 3))
    offset, velocity, constants = (a.astype(precision).astype(float) for a in drawn)
    return offset, velocity, constants


def test_force_is_minus_the_gradient_of_the_energy(precision: str, device: str) -> None:
    """Find the undamped force as the slope of 1/2 k (l - r)^2."""
    offset, velocity, constants = draw_springs(64, precision)
    force, energy = evaluate(offset, velocity, constants * [1, 1, 0], precision, device)
    # The force on the second end, at x + offset, is -dE/d(offset); the first end gets the opposite. Central
    # differences err by h^2/6 E''' and eps E/h: about eps^(2/3) = 4e-11 for h = eps^(1/3), times lengths of 0.05 to 4.
    h = EPSILON["float64"] ** (1 / 3)
    gradient = np.zeros_like(force)
    for axis in range(3):
        ahead, behind = (evaluate(offset + s * h * np.eye(3)[axis], velocity, constants, "float64", device)[1]
                         for s in (1, -1))  # fmt: skip
        gradient[:, axis] = (ahead - behind) / (2 * h)
    length = np.linalg.norm(offset, axis=1)
    scale = constants[:, 1] * (length + constants[:, 0])
    bound = {"float32": ROUND_OFF["float32"], "float64": 1e-8}[precision]
    assert (np.linalg.norm(force - gradient, axis=1) <= bound * scale).all()
    ends = np.arange(128).reshape(64, 2)
    points = np.stack([0 * offset, offset], axis=1).reshape(-1, 3)
    expected = elastic_energy(points, ends, *constants.T[:2])
    assert energy.sum() == pytest.approx(expected, rel=ROUND_OFF[precision])


def test_reaction_is_exactly_opposite(precision: str, device: str) -> None:
    """Get the exactly opposite force when both ends swap their places."""
    offset, velocity, constants = draw_springs(64, precision)
    force, _ = evaluate(offset, velocity, constants, precision, device)
    reaction, _ = evaluate(-offset, -velocity, constants, precision, device)
    np.testing.assert_array_equal(force, -reaction)
    assert (force != 0).all()


def test_damping_acts_along_the_line_only(precision: str, device: str) -> None:
    """Damp only the velocity along the spring, with a force along the spring."""
    offset, velocity, constants = draw_springs(64, precision)
    constants[:, 1] = 0
    force, _ = evaluate(offset, velocity, constants, precision, device)
    direction = offset / np.linalg.norm(offset, axis=1)[:, None]
    # F = d (v.n) n
    expected = constants[:, 2:] * (velocity * direction).sum(axis=1)[:, None] * direction
    scale = constants[:, 2:] * np.linalg.norm(velocity, axis=1)[:, None]
    assert (np.abs(force - expected) <= ROUND_OFF[precision] * scale).all()
    # Across the spring there is nothing to damp.
    across = np.cross(offset, velocity)
    force, _ = evaluate(offset, across, constants, precision, device)
    scale = constants[:, 2:] * np.linalg.norm(across, axis=1)[:, None]
    assert (np.abs(force) <= ROUND_OFF[precision] * scale).all()


def test_coincident_ends_have_no_force(precision: str, device: str) -> None:
    """Give no force and no NaN for a spring of no length, in the law and in the kernel of the device."""
    force, energy = evaluate(np.zeros((1, 3)), np.ones((1, 3)), np.array([[0.5, 400.0, 2.0]]), precision, device)
    np.testing.assert_array_equal(force, 0)
    # E = 1/2 k r^2, exactly.
    assert energy.tolist() == [50.0]
    for kernel in kernels_of(device):
        start = np.full((4, 3), 7.0)
        f = launch(
            kernel, np.zeros((4, 3)), np.ones((4, 3)) * [[1], [2], [3], [4]], start,
            np.array([[0, 2, 2, 0]]), np.array([[0.5, 400.0, 2.0]]), precision, device,
        )  # fmt: skip
        np.testing.assert_array_equal(f, start)


def kernels_of(device: str) -> list[str]:
    """Name the spring kernels that run on a device."""
    return ["scatter", "span"] if device == "cpu" else ["scatter"]


def launch(
    kernel: str,
    x: np.ndarray,
    v: np.ndarray,
    f: np.ndarray,
    spans: np.ndarray,
    classes: np.ndarray,
    precision: str,
    device: str,
) -> np.ndarray:
    """Return f after a kernel has added the forces of the spans, and check the power that it says is lost."""
    real = PRECISIONS[precision]
    rows = [wp.array(np.ascontiguousarray(a.T), dtype=real, device=device) for a in (x, v, f)]
    table = [
        wp.array(spans, dtype=wp.vec4i, device=device),
        wp.array(classes, dtype=wp.types.vector(3, real), device=device),
    ]
    # It adds to what was lost before.
    losses = wp.array(np.full(len(spans), 3.0), dtype=wp.float64, device=device)
    inputs = [*table, *rows[:2], real(0.25)]
    if kernel == "span":
        tasks = wp.array([[0, len(spans)]], dtype=wp.vec2i, device=device)
        function, dim, inputs = springs.add_span_forces, 1, [Turn(), tasks, *inputs]
    else:
        function, dim = springs.add_spring_forces, (len(spans), springs.MAX_SPAN)
    wp.launch(function, dim=dim, inputs=inputs, outputs=[rows[2], losses], device=device)
    for span, lost in zip(spans, losses.numpy(), strict=True):
        i, j = (span[end] + np.arange(span[2]) for end in (0, 1))
        offset, velocity = x[j] - x[i], v[j] - v[i]
        length = np.linalg.norm(offset, axis=1)
        approach = (velocity * offset).sum(axis=1) / np.where(length > 0, length, 1.0)
        d = classes[span[3], 2]
        # Each term is as exact as ROUND_OFF of d |v|^2; offsets lose digits like positions do.
        bound = ROUND_OFF[precision] * d * ((velocity**2).sum(axis=1) * (1 + np.abs(x).max() / (length + 1e-9))).sum()
        bound = min(bound, 1.0) + 3.0 * EPSILON["float64"] * (1 + span[2])
        assert abs(lost - 3.0 - 0.25 * d * (approach**2).sum()) <= bound, kernel
    return rows[2].numpy().T.astype(float)


def check_kernels(
    x: np.ndarray, v: np.ndarray, spans: np.ndarray, classes: np.ndarray, precision: str, device: str
) -> None:
    """Compare what the kernels add to known forces with the reference."""
    x, v, classes = (a.astype(precision).astype(float) for a in (x, v, classes))
    ends = np.array([(i + s, j + s) for i, j, count, _ in spans for s in range(count)])
    rest, k, d = classes[np.repeat(spans[:, 3], spans[:, 2])].T
    before = np.random.default_rng(2).normal(size=x.shape).astype(precision).astype(float)
    expected = before + spring_forces(x, v, ends, rest, k, d)
    # Each term of the sum at a particle is wrong by ROUND_OFF of its greatest part, and so is each of its partial sums.
    length = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
    # Positions far from the origin lose digits in the offset.
    spread = np.abs(x).max() + length + rest
    part = k * spread + d * np.linalg.norm(v[ends[:, 1]] - v[ends[:, 0]], axis=1)
    scale = np.abs(before).max(axis=1)
    for end in ends.T:
        np.add.at(scale, end, part)
    for kernel in kernels_of(device):
        found = launch(kernel, x, v, before, spans, classes, precision, device)
        assert (np.abs(found - expected) <= ROUND_OFF[precision] * scale[:, None]).all(), kernel


@pytest.mark.parametrize("seed", range(4))
def test_random_networks_match_the_reference(seed: int, precision: str, device: str) -> None:
    """Add the forces of random springs between random particles, many of them on the same ones."""
    rng = np.random.default_rng(seed)
    count, classes = 40, rng.uniform([0.1, 1, 0], [2, 900, 5], (7, 3))
    ends = np.array([rng.choice(count, 2, replace=False) for _ in range(300)])
    spans = np.column_stack([ends, np.ones(300, int), rng.integers(0, 7, 300)])
    check_kernels(*rng.normal(size=(2, count, 3)), spans, classes, precision, device)


@pytest.mark.parametrize("gap", [1, 3, 64, 100])
def test_spans_of_every_length_match_the_reference(gap: int, precision: str, device: str) -> None:
    """Add the forces of spans of 1 to 64 springs, whose two ends overlap (a chain, at gap 1) or do not."""
    rng = np.random.default_rng(gap)
    lengths = np.arange(1, springs.MAX_SPAN + 1)
    spans = np.array([(rng.integers(0, 50), 0, n, rng.integers(0, 3)) for n in lengths])
    spans[:, 1] = spans[:, 0] + gap
    count = 50 + gap + springs.MAX_SPAN
    classes = rng.uniform([0.1, 1, 0], [2, 900, 5], (3, 3))
    # All together, and each alone, so that an error cannot hide in the sum of the others.
    x, v = rng.normal(size=(2, count, 3))
    check_kernels(x, v, spans, classes, precision, device)
    for span in spans:
        check_kernels(x, v, span[None], classes, precision, device)


def test_lattices_match_the_reference(precision: str, device: str) -> None:
    """Add the forces of a strained random lattice."""
    rng = np.random.default_rng(5)
    lattice = build_lattice(
        Cells.of(rng.random((3, 3, 3)) < 0.6), origin=np.zeros(3), cell_size=0.2, particles_per_edge=3
    )
    x = lattice.particles + rng.normal(scale=0.02, size=lattice.particles.shape)
    classes = spring_classes([Material.model_validate(make_material(300.0, 0.5))], lattice)
    check_kernels(x, rng.normal(size=x.shape), lattice.spans, classes, precision, device)


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
def test_strain_law_is_hooke_with_constants_over_the_rest_length(kind: int) -> None:
    """Turn [ks (l/r - 1) + ds (v.n)/r] into [k (l - r) + d (v.n)] with k = ks/r and d = ds/r."""
    constants = {"structural": (300.0, 1.0), "shear": (200.0, 0.5), "bend": (100.0, 0.25)}
    tables = {name: {"stiffness": k, "damping": d} for name, (k, d) in constants.items()}
    rest = 0.2 * [1, 2**0.5, 3**0.5, 2][kind]
    k, d = list(constants.values())[[0, 1, 1, 2][kind]]
    lattice = build_lattice(Cells.of(np.ones((1, 1, 1), bool)), origin=np.zeros(3), cell_size=0.2)
    hooke = spring_classes([Material.model_validate({"law": "hooke", **tables})], lattice)[kind]
    strain = spring_classes([Material.model_validate({"law": "strain", **tables})], lattice)[kind]
    # One multiplication, division or root each.
    np.testing.assert_allclose(hooke, [rest, k, d], rtol=4 * EPSILON["float64"])
    np.testing.assert_allclose(strain, [rest, k / rest, d / rest], rtol=4 * EPSILON["float64"])


@pytest.mark.parametrize("law", ["strain", "hooke"])
def test_forces_of_a_body_match_the_laws(law: str, device: str) -> None:
    """Find the forces of a moving body, law, stiffness and damping of each kind of spring included."""
    constants = {"structural": (300.0, 1.0), "shear": (200.0, 0.5), "bend": (100.0, 0.25)}
    material = {name: {"stiffness": k, "damping": d} for name, (k, d) in constants.items()} | {"law": law}
    body = make_voxels(np.ones((2, 1, 1), bool), cell_size=0.3, particles_per_edge=3, angular_velocity=[1.0, -2.0, 3.0])
    simulator = Simulator(make_scene(materials={"jelly": material}, bodies=[body]), device=device)
    v = simulator.velocities
    lattice = build_lattice(
        Cells.of(np.ones((2, 1, 1), bool)), origin=[-0.3, -0.15, -0.15], cell_size=0.3, particles_per_edge=3
    )
    np.testing.assert_allclose(simulator.positions, lattice.particles, rtol=0, atol=EPSILON["float64"])
    ends, kinds = lattice.springs()
    rest = 0.15 * np.array([1, 2**0.5, 3**0.5, 2])[kinds]
    k, d = np.array([constants[n] for n in ("structural", "shear", "shear", "bend")])[kinds].T
    x = lattice.particles * 1.25
    simulator.state.x.assign(np.ascontiguousarray(x.T))
    v += x * [[3.0, 2.0, 1.0]]
    simulator.state.v.assign(np.ascontiguousarray(v.T))
    simulator.step()
    offset = x[ends[:, 1]] - x[ends[:, 0]]
    length = np.linalg.norm(offset, axis=1)
    n = offset / length[:, None]
    approach = ((v[ends[:, 1]] - v[ends[:, 0]]) * n).sum(axis=1)
    # The laws as they are written, not one by the other.
    pull = k * (length / rest - 1) + d * approach / rest if law == "strain" else k * (length - rest) + d * approach
    expected = np.zeros_like(x)
    np.add.at(expected, ends[:, 0], pull[:, None] * n)
    np.add.at(expected, ends[:, 1], -pull[:, None] * n)
    # Up to 17 springs at a particle, each wrong by ROUND_OFF of its parts.
    scale = 17 * np.abs(k / rest * (length + rest) + d / rest * np.abs(approach)).max()
    np.testing.assert_allclose(simulator.forces, expected, rtol=0, atol=ROUND_OFF["float64"] * scale)


def test_damped_springs_dissipate(precision: str, device: str) -> None:
    """Take energy out with every damped spring: d/dt E = -d (v.n)^2."""
    offset, velocity, constants = draw_springs(64, precision)
    damped, _ = evaluate(offset, velocity, constants, precision, device)
    undamped, _ = evaluate(offset, velocity, constants * [1, 1, 0], precision, device)
    # Power on both ends: F.v_i - F.v_j = -F.(v_j - v_i).
    power = -((damped - undamped) * velocity).sum(axis=1)
    approach = (offset * velocity).sum(axis=1) / np.linalg.norm(offset, axis=1)
    speed = np.linalg.norm(velocity, axis=1)
    scale = (constants[:, 1] * (np.linalg.norm(offset, axis=1) + constants[:, 0]) + constants[:, 2] * speed) * speed
    assert (np.abs(power + constants[:, 2] * approach**2) <= ROUND_OFF[precision] * scale).all()
    assert (power < 0).all()
