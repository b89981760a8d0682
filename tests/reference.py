"""The physics once more: float64, NumPy and dictionaries, written from the laws and not from the kernels.

Everything is as short and direct as it can be, and as slow.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpjelly.scene import BoxCollider, HalfSpaceCollider, PlaneCollider, Scene, SphereCollider

EPSILON = {"float32": 2.0**-23, "float64": 2.0**-52}
"""Spacing of the numbers above 1: one operation is wrong by at most half of it."""
ROUND_OFF = {"float32": 1e-5, "float64": 1e-13}
"""Relative error of one evaluation of a law: some dozen operations, that is, 80 (450) epsilons."""

Vertex = tuple[int, int, int]
Key = tuple[Vertex, frozenset[Vertex]]
"""A particle: its place in the grid of unit cells, and the unit cells that share it."""


@dataclass(frozen=True)
class ReferenceLattice:
    """Particles and springs of a grid."""

    keys: list[Key]
    springs: dict[frozenset[Key], int]
    """Kind by pair of ends: 0 structural, 1 face shear, 2 body shear, 3 bend."""


def shift(a: Vertex, b: Vertex, times: int = 1) -> Vertex:
    """Return a + times b."""
    return (a[0] + times * b[0], a[1] + times * b[1], a[2] + times * b[2])


def unit_cells(cells: np.ndarray, particles_per_edge: int) -> set[Vertex]:
    """Return the occupied unit cells."""
    n = particles_per_edge - 1
    return {
        shift((dx, dy, dz), (int(x), int(y), int(z)), n)
        for x, y, z in np.argwhere(cells)
        for dx, dy, dz in itertools.product(range(n), repeat=3)
    }


def share_particles(units: set[Vertex]) -> dict[tuple[Vertex, Vertex], Key]:
    """Return the particle at each (vertex, unit cell): cells share it if faces join them around it."""
    corners = list(itertools.product((0, 1), repeat=3))
    particle: dict[tuple[Vertex, Vertex], Key] = {}
    for vertex in {shift(unit, corner) for unit in units for corner in corners}:
        left = {shift(vertex, corner, -1) for corner in corners} & units
        while left:
            group: set[Vertex] = set()
            front = {left.pop()}
            while front:
                group |= front
                front = {c for c in left if any(sum(abs(p - q) for p, q in zip(c, g, strict=True)) == 1 for g in front)}
                left -= front
            for unit in group:
                particle[vertex, unit] = (vertex, frozenset(group))
    return particle


def build(cells: np.ndarray, particles_per_edge: int = 2) -> ReferenceLattice:
    """Connect the particles: within each occupied unit cell, and over two consecutive structural springs."""
    units = unit_cells(cells, particles_per_edge)
    particle = share_particles(units)
    springs: dict[frozenset[Key], int] = {}
    for unit in units:
        for a, b in itertools.combinations(itertools.product((0, 1), repeat=3), 2):
            ends = particle[shift(unit, a), unit], particle[shift(unit, b), unit]
            springs[frozenset(ends)] = sum(abs(p - q) for p, q in zip(a, b, strict=True)) - 1
    neighbours: dict[Key, set[Key]] = {}
    for ends in [ends for ends, kind in springs.items() if kind == 0]:
        a, b = ends
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    for middle, around in neighbours.items():
        for a, b in itertools.combinations(around, 2):
            if shift(a[0], b[0]) == shift((0, 0, 0), middle[0], 2):
                springs[frozenset((a, b))] = 3
    # Scan order; particles at one place in the order of their first cells.
    return ReferenceLattice(sorted(set(particle.values()), key=lambda key: (key[0], min(key[1]))), springs)


def spring_forces(
    x: np.ndarray, v: np.ndarray, ends: np.ndarray, rest: np.ndarray, k: np.ndarray, d: np.ndarray
) -> np.ndarray:
    """Sum [k (l - r) + d (v_j - v_i).n] n on i and the opposite on j; coincident ends have no direction, no force."""
    i, j = ends.T
    offset, relative = x[j] - x[i], v[j] - v[i]
    length = np.linalg.norm(offset, axis=1)
    n = offset / np.where(length > 0, length, 1.0)[:, None]
    force = (k * (length - rest) + d * (relative * n).sum(axis=1))[:, None] * n
    total = np.zeros_like(x)
    np.add.at(total, i, force)
    np.add.at(total, j, -force)
    return total


def elastic_energy(x: np.ndarray, ends: np.ndarray, rest: np.ndarray, k: np.ndarray) -> float:
    """Return the sum of 1/2 k (l - r)^2."""
    length = np.linalg.norm(x[ends[:, 1]] - x[ends[:, 0]], axis=1)
    return float((0.5 * k * (length - rest) ** 2).sum())


def find_contacts(collider: Any, point: np.ndarray, start: np.ndarray, up: int = 1) -> list[tuple[np.ndarray, float]]:
    """Return (outward unit normal, depth >= 0) of each contact of a point; start is where its body's mass was."""
    center = np.array(collider.center)
    local = point - center
    if isinstance(collider, SphereCollider):
        distance = np.linalg.norm(local)
        if distance > collider.radius:
            return []
        return [(local / distance if distance > 0 else np.eye(3)[up], collider.radius - distance)]
    if isinstance(collider, BoxCollider):
        walls = [
            (-sign * np.eye(3)[axis], sign * local[axis] - collider.size[axis] / 2)
            for axis, sign in itertools.product(range(3), (-1.0, 1.0))
        ]
        return [(normal, depth) for normal, depth in walls if depth >= 0]
    normal = np.array(collider.normal) / np.linalg.norm(collider.normal)
    if isinstance(collider, HalfSpaceCollider):
        if (start - center) @ normal < 0:
            normal = -normal
        depth = -(local @ normal)
        return [(normal, depth)] if depth >= 0 else []
    assert isinstance(collider, PlaneCollider)
    assert collider.tangent is not None, "the reference knows no default tangent"
    tangent = np.array(collider.tangent) - normal * (normal @ collider.tangent)
    tangent /= np.linalg.norm(tangent)
    inside = abs(local @ tangent) <= collider.size[0] / 2
    inside &= abs(local @ np.cross(normal, tangent)) <= collider.size[1] / 2
    depth = -(local @ normal)
    return [(normal, depth)] if inside and 0 <= depth <= collider.threshold else []


def contact_force(collider: Any, point: np.ndarray, velocity: np.ndarray, start: np.ndarray, up: int = 1) -> np.ndarray:
    """Sum max(0, k depth - d v.n) n, without the maximum where the collider pulls, over the contacts of a particle."""
    force = np.zeros(3)
    for normal, depth in find_contacts(collider, point, start, up):
        push = collider.stiffness * depth - collider.damping * (velocity @ normal)
        force += (push if collider.pulls else max(0.0, push)) * normal
    return force


def grid_force(field: Any, points: np.ndarray) -> np.ndarray:
    """Sum the forces of all nodes of a grid, each weighted with its tent functions along x, y and z, [count, 3]."""
    nodes, lower, upper = field.nodes(), np.array(field.lower), np.array(field.upper)
    place = (np.clip(points, lower, upper) - lower) / (upper - lower) * (len(nodes) - 1)
    tents = np.maximum(0.0, 1.0 - np.abs(np.arange(len(nodes)) - place.T[:, :, None]))
    force = np.einsum("ni,nj,nk,ijkc->nc", *tents, nodes, optimize=True)
    inside = ((lower <= points) & (points <= upper)).all(axis=1)
    return force if field.outside == "clamp" else force * inside[:, None]


def field_force(field: Any, x: np.ndarray, v: np.ndarray, charge: np.ndarray, time: float) -> np.ndarray:
    """Return the force of a field on particles at a time, [count, 3]: its law times its curve."""
    factor = 1.0 if field.curve is None else np.interp(time, *zip(*field.curve, strict=True))
    if field.type == "grid":
        return factor * grid_force(field, x)
    if field.type == "electric":
        return factor * np.outer(charge, field.strength)
    if field.type == "magnetic":
        return factor * charge[:, None] * np.cross(v, field.strength)
    return factor * np.tile(field.force, (len(x), 1))


def contact_energy(collider: Any, point: np.ndarray, start: np.ndarray, up: int = 1) -> float:
    """Sum 1/2 k depth^2 over the contacts of a particle with a collider."""
    return sum(0.5 * collider.stiffness * depth**2 for _, depth in find_contacts(collider, point, start, up))


def rotation(degrees: Any) -> np.ndarray:
    """Return the matrix that turns about x, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


class World:
    """A scene of cubes and voxels in motion by semi-implicit Euler."""

    def __init__(self, scene: Scene) -> None:
        assert scene.solver.dt != "auto"
        self.scene, self.dt = scene, 1 / (scene.fps * scene.substeps_for(scene.solver.dt))
        self.keys: list[list[Key]] = []
        xs, vs, ms, bodies, springs, self.starts = [], [], [], [], [], []
        first = 0
        for number, body in enumerate(scene.bodies):
            cells, edge = (
                (np.ones((1, 1, 1), bool), body.size) if body.type == "cube" else (body.grid(), body.cell_size)
            )
            lattice, unit = build(cells, body.particles_per_edge), edge / (body.particles_per_edge - 1)
            material = scene.materials[body.material]
            rest_shape = unit * np.array([key[0] for key in lattice.keys]) - edge * np.array(cells.shape) / 2
            x = rest_shape @ rotation(body.rotation).T + body.position
            if getattr(body, "positions", None) is not None:
                x = np.array(body.positions)
            if material.density is not None:
                m = np.array([material.density * unit**3 * len(key[1]) / 8 for key in lattice.keys])
            else:
                m = np.full(len(x), material.particle_mass or 0.01)
            start = (m[:, None] * x).sum(axis=0) / m.sum()
            number_of = {key: first + i for i, key in enumerate(lattice.keys)}
            for ends, kind in lattice.springs.items():
                i, j = sorted(number_of[key] for key in ends)
                rest = unit * [1, 2**0.5, 3**0.5, 2][kind]
                constants = [material.structural, material.shear, material.shear, material.bend][kind]
                per_length = 1 / rest if material.law == "strain" else 1.0
                springs.append((i, j, rest, constants.stiffness * per_length, constants.damping * per_length))
            self.keys.append(lattice.keys)
            self.starts.append(start)
            v = body.velocity + np.cross(body.angular_velocity, x - start)
            xs.append(x)
            vs.append(v if getattr(body, "velocities", None) is None else np.array(body.velocities))
            ms.append(m)
            bodies.append(np.full(len(x), number))
            first += len(x)
        self.x, self.v, self.m, self.body = (np.concatenate(parts) for parts in (xs, vs, ms, bodies))
        table = np.array(springs)
        self.ends = table[:, :2].astype(int)
        self.rest, self.k, self.d = table[:, 2:].T.copy()

    def forces(self) -> np.ndarray:
        """Return the total forces at the current state."""
        f = self.m[:, None] * self.scene.gravity_vector
        f += spring_forces(self.x, self.v, self.ends, self.rest, self.k, self.d)
        for collider, (i, body) in itertools.product(self.scene.colliders, enumerate(self.body)):
            f[i] += contact_force(collider, self.x[i], self.v[i], self.starts[body], self.scene.up)
        charge = np.array([self.scene.bodies[body].charge for body in self.body])
        for field in self.scene.fields:
            f += field_force(field, self.x, self.v, charge, self.steps * self.dt)
        return f

    def step(self, count: int = 1) -> None:
        """Advance: v += dt f / m, then x += dt v."""
        for _ in range(count):
            self.v = self.v + self.dt * self.forces() / self.m[:, None]
            self.x = self.x + self.dt * self.v
            self.steps += 1

    def top_frequency(self) -> float:
        """Return the largest angular frequency of the springs at rest, rad/s: the root of the top of M^-1 K."""
        size = 3 * len(self.x)
        stiffness = np.zeros((size, size))
        for (i, j), k in zip(self.ends, self.k, strict=True):
            n = self.x[j] - self.x[i]
            block = k * np.outer(n, n) / (n @ n)
            a, b = slice(3 * i, 3 * i + 3), slice(3 * j, 3 * j + 3)
            stiffness[a, a] += block
            stiffness[b, b] += block
            stiffness[a, b] -= block
            stiffness[b, a] -= block
        root = np.repeat(self.m, 3) ** -0.5
        return float(np.linalg.eigvalsh(root[:, None] * stiffness * root)[-1] ** 0.5)


def fit_rigidly(rest: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the rest shape turned and moved onto x as well as possible (Kabsch)."""
    a, b = rest - rest.mean(axis=0), x - x.mean(axis=0)
    u, _, w = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ w))])
    return a @ (u @ flip @ w) + x.mean(axis=0)
