"""The largest stable time step of a scene, from its springs linearised about rest.

With A = M^-1/2 K M^-1/2 [1/s^2] and B = M^-1/2 D M^-1/2 [1/s], stiffness K and damping D of the springs at rest, small
motions obey y'' = -A y - B y'. For an eigenvector y of the motion or of a scheme's step, a = y*A y and d = y*B y turn
this into the scalar y'' = -a y - d y'. So a step is stable when it is stable for each pair (a, d) that unit vectors y
give. These pairs fill a convex set, whose reach in a direction (p, q) is the top eigenvalue of p A + q B; here it is
known as a polygon around it. Where damping / stiffness is the same for all springs, the set is a line and the limit
is exact; otherwise it is a bound. ARCHITECTURE.md has the formulas and what was measured.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import contacts, fields
from warpjelly.kernels.turns import Turn

from .memory import LIMIT_EVALUATIONS
from .model import Model
from .placing import BLOCK
from .stepping import capture_lock, launch_spring_forces

INTEGRATORS = ("explicit_euler", "semi_implicit_euler", "rk2", "rk4")
# Share of the limit that dt = "auto" takes. Away from rest springs turn and stretch, and the limit is lower: undamped
# semi-implicit Euler was seen to blow up at 0.7 of it under 30 % strain. Runge-Kutta 4 takes energy out of the fastest
# motions, which leaves it more room.
SAFETY = {"explicit_euler": 0.5, "semi_implicit_euler": 0.5, "rk2": 0.5, "rk4": 0.8}
# Share of the largest stable step of a particle in contact alone up to which no bounce was seen to gain energy.
BOUNCE_SHARE = 0.5
# Share of its energy that a magnetic field may add to a particle by the error of a scheme.
MAGNETIC_GAIN = 0.05
# Of more colliders than this each is taken with all that meet it; of fewer, sets that all meet are sorted out.
MAX_SORTED_OUT = 24
# Stiffness that particles in contact add to each other, in that of one pair.
SOFT_PARTNERS = 4.0
# No limit above this is reported, s; no scene may ask for a longer step.
MAX_STEP = 1.0
# Steps of the Lanczos iteration: within 1 % of the top eigenvalue of lattices up to 64^3.
LANCZOS_STEPS = 30
# Directions around the circle in which the set of pairs is measured. Their polygon is 1 % too large at most.
DIRECTIONS = 24
# Points on each edge of the set in which a Runge-Kutta step is tested.
EDGE_POINTS = 256


def step_limits(pairs: np.ndarray) -> dict[str, float | None]:
    """Return the largest stable step of each integrator, s; None where no step is stable.

    Args:
        pairs: vertices of the set of (a, d), as from ``bound_spring_pairs`` or ``add_contacts``, [vertex_count, 2].
    """
    a, d = pairs.T
    # The conditions of both Euler schemes are linear in (a, d): the vertices decide.
    semi_implicit = _quotient(4.0, d + np.sqrt(d * d + 4.0 * a))
    root = d * d - 4.0 * a
    explicit = np.where(root > 0.0, _quotient(4.0, d + np.sqrt(np.maximum(root, 0.0))), _quotient(d, a))
    steps = {"explicit_euler": explicit.min(), "semi_implicit_euler": semi_implicit.min()}
    # The stable set of the others is star-shaped and without holes: the edges decide.
    share = np.linspace(0.0, 1.0, EDGE_POINTS)[:, None, None]
    edges = ((1.0 - share) * pairs + share * np.roll(pairs, -1, axis=0)).reshape(-1, 2)
    # On the imaginary axis |R|^2 = 1 + |z|^4 / 4 for RK2.
    undamped = (edges[:, 0] > 0.0) & (edges[:, 1] <= 0.0)
    steps["rk2"] = 0.0 if undamped.any() else _runge_kutta_limit(edges, (1.0, 0.5))
    steps["rk4"] = _runge_kutta_limit(edges, (1.0, 0.5, 1.0 / 6.0, 1.0 / 24.0))
    return {name: min(float(steps[name]), MAX_STEP) if steps[name] > 0.0 else None for name in INTEGRATORS}


def _quotient(numerator: np.ndarray | float, denominator: np.ndarray) -> np.ndarray:
    """Divide, with infinity over zero: what is not moved by any force has no limit."""
    infinite = np.full(np.shape(denominator), np.inf)
    return np.divide(numerator, denominator, out=infinite, where=denominator > 0.0)


def _runge_kutta_limit(edges: np.ndarray, coefficients: tuple[float, ...]) -> float:
    """Return the largest dt with |R(dt mu)| <= 1 for both roots of mu^2 + d mu + a = 0 of each pair (a, d).

    Args:
        edges: pairs, [count, 2].
        coefficients: of R(z) - 1 = c1 z + c2 z^2 + ...
    """
    a, d = edges.T
    root = np.sqrt((d * d / 4.0 - a).astype(complex))
    mu = np.concatenate([-d / 2.0 - root, -d / 2.0 + root])
    mu = mu[np.abs(mu) > 0.0]
    if len(mu) == 0:
        return math.inf
    # No stable z is as far from the origin as 4.
    low, high = np.zeros(len(mu)), 4.0 / np.abs(mu)
    for _ in range(50):
        middle = (low + high) / 2.0
        z = middle * mu
        change = np.zeros_like(z)
        for coefficient in reversed(coefficients):
            change = (change + coefficient) * z
        # |1 + c|^2 - 1, without the rounding errors of a difference from 1.
        stable = 2.0 * change.real + np.abs(change) ** 2 <= 0.0
        low, high = np.where(stable, middle, low), np.where(stable, high, middle)
    return float(low.min())


def bound_spring_pairs(model: Model, x: wp.array, wanted: Callable[[], None] = lambda: None) -> np.ndarray:
    """Return a convex polygon around the pairs (a, d) of the springs, [vertex_count, 2], 1/s^2 and 1/s.

    Other threads may simulate, and capture graphs, meanwhile.

    Args:
        model: the springs and masses.
        x: positions at rest, real [3, particle_count], m.
        wanted: called now and then; raises something where the limits are not wanted any more.
    """
    ratios = _ratios(model)
    if len(ratios) == 0:
        return np.zeros((1, 2))
    least, greatest = ratios.min(), ratios.max()
    top_eigenvalue = _eigenvalue_solver(model, x, wanted)
    if math.isinf(least):
        return np.array([[0.0, 0.0], [0.0, top_eigenvalue(0.0, 1.0)]])
    if _are_equal(ratios):
        top = top_eigenvalue(1.0, 0.0)
        return np.array([[0.0, 0.0], [top, greatest * top]])
    scale = np.array([top_eigenvalue(1.0, 0.0), top_eigenvalue(0.0, 1.0)])
    polygon = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    # Pairs are sums over springs, so d / a is between the least and the greatest quotient.
    polygon = _clip(polygon, np.array([least * scale[0], -scale[1]]), 0.0)
    if math.isfinite(greatest):
        polygon = _clip(polygon, np.array([-greatest * scale[0], scale[1]]), 0.0)
    for number in range(DIRECTIONS):
        # The square has the directions of the axes, and the origin those between -90 and -180 degrees.
        angle = -math.pi / 2.0 + 2.0 * math.pi * number / DIRECTIONS
        if angle < math.pi and number % (DIRECTIONS // 4):
            normal = np.array([math.cos(angle), math.sin(angle)])
            # Where the body moves freely, the origin is in the set.
            polygon = _clip(polygon, normal, max(0.0, top_eigenvalue(*(normal / scale))))
    return polygon * scale


def evaluations(model: Model) -> int:
    """Return how many evaluations of the spring forces take about as long as ``bound_spring_pairs``."""
    return LIMIT_EVALUATIONS if _are_equal(_ratios(model)) else 20 * LIMIT_EVALUATIONS


def _ratios(model: Model) -> np.ndarray:
    """Return damping / stiffness of each class of springs that does anything, [count], s."""
    # Not all spans at once, as numbers that index take eight bytes.
    used, labels = np.zeros(len(model.spring_classes), bool), model.spans.numpy()[:, 3]
    for start in range(0, len(labels), BLOCK):
        used[labels[start : start + BLOCK]] = True
    k, d = model.spring_classes.numpy().astype(float)[used, 1:].T
    acting = (k > 0.0) | (d > 0.0)
    return _quotient(d[acting], k[acting])


def _are_equal(ratios: np.ndarray) -> bool:
    # In float32 equal quotients differ by rounding.
    return len(ratios) == 0 or bool(ratios.max() <= ratios.min() * (1.0 + 1e-6))


def contact_pairs(model: Model) -> np.ndarray:
    """Return what contact adds to the pairs (a, d) of springs, [count, 2], no less than it does.

    Each particle may touch, so this is a safe bound: of all sets of colliders whose insides meet, the greatest
    stiffness and the greatest damping in any direction, over the least mass. Between particles it is four times their
    stiffness and damping: two facing balls make twice, and a ball in the gap of four others about four times.
    """
    table = model.colliders
    stiffness, damping = table.stiffness.numpy().astype(float), table.damping.numpy().astype(float)
    added = [
        (_greatest_together(stiffness, table, members), _greatest_together(damping, table, members))
        for members in _touched_together(table)
    ]
    if model.skin is not None:
        between = (SOFT_PARTNERS * model.skin.stiffness, SOFT_PARTNERS * model.skin.damping)
        added += [between, *((a + between[0], d + between[1]) for a, d in added)]
    return np.array(added, float).reshape(-1, 2) * float(model.particle_inv_mass.numpy().max())


def add_contacts(pairs: np.ndarray, touching: np.ndarray) -> np.ndarray:
    """Return a polygon around the pairs (a, d) of springs with and without contact, as from ``contact_pairs``."""
    return _hull(np.concatenate([pairs, *(pairs + pair for pair in touching)])) if len(touching) else pairs


def bounce_limits(touching: np.ndarray) -> dict[str, float | None]:
    """Return the largest step of each integrator with which bounces do not gain energy, s; None where none is known.

    It is a share of the largest stable step of a particle in contact without springs. ARCHITECTURE.md has the bounds.

    Args:
        touching: as from ``contact_pairs``.
    """
    limits = step_limits(add_contacts(np.zeros((1, 2)), touching))
    return {name: None if limit is None else BOUNCE_SHARE * limit for name, limit in limits.items()}


def magnetic_limits(model: Model, duration: float) -> dict[str, float]:
    """Return the step of each integrator above which magnetic fields speed particles up, s.

    A scheme takes y' = i w y, with w = |q B| / m, to R(i w dt) y: |R|^2 is 1 + (w dt)^2 for the Euler schemes, which
    take v from the start of the step, and 1 + (w dt)^4 / 4 for RK2. The energy may grow by MAGNETIC_GAIN over the
    duration [s]. RK4 takes energy out of it up to w dt = 2 sqrt(2).
    """
    table = model.fields
    strength = np.linalg.norm(table.strength.numpy().astype(float), axis=1)
    starts, factors = table.curve_start.numpy(), np.abs(table.curve_factor.numpy())
    peak = [factors[i:j].max() if j > i else 1.0 for i, j in itertools.pairwise(starts)]
    field = float((strength * peak)[table.kind.numpy() == fields.MAGNETIC].sum())
    if not field:
        return dict.fromkeys(INTEGRATORS, MAX_STEP)
    rates = np.abs(model.particle_charge.numpy().astype(float)) * model.particle_inv_mass.numpy()
    if not (w := field * float(rates.max())):
        return dict.fromkeys(INTEGRATORS, MAX_STEP)
    gain = math.log1p(MAGNETIC_GAIN)
    euler = gain / (w * w * duration)
    rk2 = (4.0 * gain / (w**4 * duration)) ** (1.0 / 3.0)
    steps = {"explicit_euler": euler, "semi_implicit_euler": euler, "rk2": rk2, "rk4": math.sqrt(8.0) / w}
    return {name: min(step, MAX_STEP) for name, step in steps.items()}


def _touched_together(table: Any) -> list[list[int]]:
    """Return sets of colliders that one particle may be in at once: each such set is part of one of them."""
    meets = _may_meet(table)
    count = len(meets)
    if count > MAX_SORTED_OUT:
        return [[i, *np.flatnonzero(meets[i])] for i in range(count)]
    found: list[list[int]] = []

    def extend(members: list[int], candidates: set[int], excluded: set[int]) -> None:
        """Bron and Kerbosch 1973, doi:10.1145/362342.362367, with a pivot."""
        if not candidates and not excluded:
            found.append(members)
            return
        pivot = max(candidates | excluded, key=lambda k: sum(meets[k, m] for m in candidates))
        for k in [k for k in candidates if not meets[pivot, k]]:
            near = set(np.flatnonzero(meets[k]).tolist())
            extend([*members, k], candidates & near, excluded & near)
            candidates = candidates - {k}
            excluded = excluded | {k}

    extend([], set(range(count)), set())
    return found if count else []


def _may_meet(table: Any) -> np.ndarray:
    """Say whether a point may be inside two colliders, bool [count, count]; never wrongly no, and not of one itself.

    Planes count as half-spaces.
    """
    centers, normals = table.center.numpy().astype(float), table.normal.numpy().astype(float)
    radius, sides = table.size.numpy()[:, 0].astype(float), table.side.numpy().astype(float)
    sphere = table.kind.numpy() == contacts.SPHERE
    offset = centers - centers[:, None]
    # Of the second one's centre above the first one.
    height = np.einsum("ijk,ik->ij", offset, normals)
    touching = np.linalg.norm(offset, axis=2) <= radius[:, None] + radius
    sunk, meeting = np.zeros_like(touching), np.zeros_like(touching)
    # For some body: a half-space keeps each on its own side.
    for side in sides.T:
        sunk |= side[:, None] * height <= radius
        facing = side[:, None] * side * (normals @ normals.T) < -1.0 + 1e-6
        meeting |= ~facing | (side[:, None] * height <= 0.0)
    meets = np.where(sphere[:, None], np.where(sphere, touching, sunk.T), np.where(sphere, sunk, meeting))
    lower = np.tril(meets, -1)
    return lower | lower.T


def _greatest_together(constant: np.ndarray, table: Any, members: list[int]) -> float:
    """Return the top eigenvalue of the sum of c n n^T over colliders; the normal of a sphere may be any."""
    spheres = table.kind.numpy()[members] == contacts.SPHERE
    flat = np.array(members)[~spheres]
    normals = table.normal.numpy().astype(float)[flat]
    top = np.linalg.eigvalsh((constant[flat, None] * normals).T @ normals)[-1] if len(flat) else 0.0
    return float(top + constant[np.array(members)[spheres]].sum())


def _clip(polygon: np.ndarray, normal: np.ndarray, reach: float) -> np.ndarray:
    """Return the part of a convex polygon, [vertex_count, 2], where normal . p <= reach."""
    height = polygon @ normal - reach
    kept = []
    for p, h, q, g in zip(polygon, height, np.roll(polygon, -1, axis=0), np.roll(height, -1), strict=True):
        if h <= 0.0:
            kept.append(p)
        if h * g < 0.0:
            kept.append(p + (q - p) * h / (h - g))
    return np.array(kept)


def _hull(points: np.ndarray) -> np.ndarray:
    """Return the convex hull of points, [count, 2], counterclockwise (Andrew's monotone chain)."""
    ordered = sorted({(float(a), float(d)) for a, d in points})
    if len(ordered) < 3:
        return np.array(ordered)
    chains: list[list[tuple[float, float]]] = []
    for sequence in (ordered, ordered[::-1]):
        chain: list[tuple[float, float]] = []
        for p in sequence:
            while len(chain) > 1 and (
                (chain[-1][0] - chain[-2][0]) * (p[1] - chain[-2][1])
                - (chain[-1][1] - chain[-2][1]) * (p[0] - chain[-2][0])
                <= 0.0
            ):
                chain.pop()
            chain.append(p)
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1])


def _eigenvalue_solver(model: Model, x: wp.array, wanted: Callable[[], None]) -> Callable[[float, float], float]:
    """Return a function (p, q) -> top eigenvalue of p A + q B.

    The force kernel itself applies the matrices: at rest, with velocities w and (rest length, 0, p k + q d) for (rest
    length, stiffness, damping), it gives -(p K + q D) w.
    """
    device = x.device
    with capture_lock:
        v, f = wp.zeros_like(x), wp.zeros_like(x)
        losses = wp.zeros(len(model.spans), dtype=wp.float64, device=device)
        phases = [(Turn(), wp.array([[0, len(model.spans)]], dtype=wp.vec2i, device=device))]
    classes = model.spring_classes.numpy().astype(float)
    root = np.sqrt(model.particle_inv_mass.numpy())
    # Row by row, here and below: of a large model temporaries of whole arrays would double what it takes.
    generator = np.random.default_rng(0)
    start = np.empty(x.shape, root.dtype)
    for row in start:
        row[:] = generator.standard_normal(len(row)) * (root > 0.0)

    def top_eigenvalue(p: float, q: float) -> float:
        constants = np.stack([classes[:, 0], 0.0 * classes[:, 0], p * classes[:, 1] + q * classes[:, 2]], axis=1)
        with capture_lock:
            table = wp.array(constants, dtype=model.spring_classes.dtype, device=device)

        def multiply(vector: np.ndarray) -> np.ndarray:
            wanted()
            with capture_lock:
                for number, row in enumerate(vector):
                    v[number].assign(root * row)
                f.zero_()
                launch_spring_forces(model, table, x, v, f, phases=phases, loss_weight=0.0, losses=losses)
                product = f.numpy()
            product *= -root
            return product

        return _lanczos(multiply, start)

    return top_eigenvalue


def _lanczos(multiply: Callable[[np.ndarray], np.ndarray], start: np.ndarray) -> float:
    """Return the top eigenvalue of a symmetric matrix, from below.

    Without reorthogonalisation three vectors are enough: what orthogonality is lost is lost towards eigenvectors that
    have been found, which repeats their eigenvalues and leaves the top one as it is (Paige 1980,
    doi:10.1016/0024-3795(80)90167-6).

    Args:
        multiply: returns the product with a vector, which is overwritten the next time.
        start: [rows, count]; vectors are of its precision, their products are summed in float64.
    """
    if not (norm := math.sqrt(_dot(start, start))):
        return 0.0
    before, now, off = np.zeros_like(start), start / start.dtype.type(norm), 0.0
    diagonal: list[float] = []
    beside: list[float] = []
    for _ in range(min(LANCZOS_STEPS, int(np.count_nonzero(start)))):
        product = multiply(now)
        diagonal.append(_dot(now, product))
        # The next vector takes the place of the one before.
        for ahead, middle, image in zip(before, now, product, strict=True):
            ahead *= -off
            ahead += image
            ahead -= diagonal[-1] * middle
        off = math.sqrt(_dot(before, before))
        # What is left is rounding when the start had no more eigenvectors in it.
        if off <= 1e-6 * max(map(abs, diagonal)):
            break
        beside.append(off)
        before /= off
        before, now = now, before
    size = len(diagonal)
    tridiagonal = np.diag(diagonal) + np.diag(beside[: size - 1], 1) + np.diag(beside[: size - 1], -1)
    return float(np.linalg.eigvalsh(tridiagonal)[-1])


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the product of two vectors, [rows, count], in float64 where they are long."""
    return math.fsum(
        float(np.dot(p[start : start + BLOCK], q[start : start + BLOCK]))
        for p, q in zip(a, b, strict=True)
        for start in range(0, len(p), BLOCK)
    )
