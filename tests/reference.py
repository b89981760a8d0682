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
REST_SPEED = 1e-4
"""Slower than this along a surface, static friction may hold, m/s."""
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


def name_particles(vertices: np.ndarray, ends: np.ndarray, kinds: np.ndarray) -> list[Key]:
    """Name each particle by its place and the unit cells that share it, as its body diagonals say.

    Each body diagonal lies in one unit cell, and a cell's four of them end in its eight corners.
    """
    owners: list[set[Vertex]] = [set() for _ in vertices]
    for i, j in ends[kinds == 2]:
        x, y, z = np.minimum(vertices[i], vertices[j])
        owners[i].add((int(x), int(y), int(z)))
        owners[j].add((int(x), int(y), int(z)))
    return [((int(x), int(y), int(z)), frozenset(cells)) for (x, y, z), cells in zip(vertices, owners, strict=True)]


def cells_in(spring: frozenset[Key]) -> frozenset[Vertex]:
    """Return the unit cells that contain both ends of a spring."""
    a, b = spring
    return a[1] & b[1]


def springs_under(lattice: ReferenceLattice) -> dict[frozenset[Key], list[frozenset[Key]]]:
    """Return both structural springs under each bend spring; of two ways around a gap, that of the last cell."""
    found = {}
    for ends in [ends for ends, kind in lattice.springs.items() if kind == 3]:
        a, b = sorted(ends, key=lambda key: key[0])
        ways = [
            [frozenset((a, middle)), frozenset((middle, b))]
            for middle in lattice.keys
            if shift(a[0], b[0]) == shift((0, 0, 0), middle[0], 2) and a[1] & middle[1] and b[1] & middle[1]
        ]
        found[ends] = max(ways, key=lambda way: max(cells_in(way[0])))
    return found


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


@dataclass(frozen=True)
class Touch:
    """How each of n points touches one wall, plane or ball."""

    normal: np.ndarray
    """Outward unit normals, [n, 3]."""
    depth: np.ndarray
    """Depths along them, m, [n]; -1 without contact."""
    counted: np.ndarray
    """The part of the depths that the force grows with, m, [n]."""

    @property
    def here(self) -> np.ndarray:
        """Whether there is contact, [n]."""
        return self.depth >= 0


def lengths(a: np.ndarray) -> np.ndarray:
    """Return the lengths of the rows, [n]."""
    return np.sqrt((a * a).sum(axis=1))


def find_touches(
    collider: Any,
    x: np.ndarray,
    origin: Any,
    *,
    before: np.ndarray | None = None,
    earlier: list[Touch] | None = None,
    anywhere: bool = True,
    up: int = 1,
) -> list[Touch]:
    """Return how points touch a collider; six times for the six walls of a box.

    Args:
        collider: of the scene.
        x: the points, [n, 3].
        origin: where the centre of mass of the body of each point started, [3] or [n, 3].
        before: where the points were one step earlier; the points themselves unless given.
        earlier: what this returned one step earlier.
        anywhere: whether a point near behind a plane touches it, wherever it comes from, as at time zero.
        up: axis that points up.
    """
    before = x if before is None else before
    center = np.array(collider.center)
    local, ago = x - center, before - center
    if isinstance(collider, BoxCollider):
        walls = []
        for axis, sign in itertools.product(range(3), (-1.0, 1.0)):
            depth = sign * local[:, axis] - collider.size[axis] / 2
            walls.append((np.tile(-sign * np.eye(3)[axis], (len(x), 1)), np.where(depth >= 0, depth, -1.0)))
        return [Touch(normal, depth, depth) for normal, depth in walls]
    held = np.zeros(len(x), bool) if earlier is None else earlier[0].here
    if isinstance(collider, SphereCollider):
        distance = lengths(local)
        normal = np.tile(np.eye(3)[up], (len(x), 1))
        normal[distance > 0] = local[distance > 0] / distance[distance > 0, None]
        if collider.normal == "entry":
            if earlier is not None:
                normal[held] = earlier[0].normal[held]
            # The line of the path passes the centre at its foot, and enters the ball by half a chord before that.
            for i in np.flatnonzero(~held & (distance <= collider.radius) & (lengths(ago) > collider.radius)):
                direction = (local[i] - ago[i]) / np.linalg.norm(local[i] - ago[i])
                foot = ago[i] - (ago[i] @ direction) * direction
                normal[i] = (foot - direction * np.sqrt(max(0.0, collider.radius**2 - foot @ foot))) / collider.radius
        # The way out along n: |local + depth n| = radius.
        along = (local * normal).sum(axis=1)
        square = np.where(distance <= collider.radius, along**2 + collider.radius**2 - distance**2, 0.0)
        depth = np.where(distance <= collider.radius, np.sqrt(np.maximum(square, 0.0)) - along, -1.0)
        return [Touch(normal, depth, depth)]
    n = np.array(collider.normal) / np.linalg.norm(collider.normal)
    if isinstance(collider, HalfSpaceCollider):
        sign = np.where((np.broadcast_to(origin, x.shape) - center) @ n < 0, -1.0, 1.0)
        depth = -sign * (local @ n)
        depth = np.where(depth >= 0, depth, -1.0)
        return [Touch(sign[:, None] * n, depth, depth)]
    assert isinstance(collider, PlaneCollider)
    assert collider.tangent is not None, "the reference knows no default tangent"
    tangent = np.array(collider.tangent) - n * (n @ collider.tangent)
    tangent /= np.linalg.norm(tangent)
    bitangent = np.cross(n, tangent)

    def over(points: np.ndarray) -> np.ndarray:
        inside = abs(points @ tangent) <= collider.size[0] / 2
        return inside & (abs(points @ bitangent) <= collider.size[1] / 2)

    height, height_ago = local @ n, ago @ n
    behind = (height <= 0) & over(local)
    # Where the path meets the plane; a path within it has met it already.
    fall = height_ago - height
    share = np.where(fall > 0, height_ago / np.where(fall > 0, fall, 1.0), 0.0)
    came_through = (height_ago >= 0) & over(ago + share[:, None] * (local - ago))
    here = behind & (held | came_through | (anywhere & (height >= -collider.threshold)))
    depth = np.where(here, -height, -1.0)
    return [Touch(np.tile(n, (len(x), 1)), depth, np.minimum(depth, collider.threshold))]


def grid_force(field: Any, points: np.ndarray) -> np.ndarray:
    """Sum the forces of all nodes of a grid, each weighted with its tent functions along x, y and z, [count, 3]."""
    nodes, lower, upper = field.nodes(), np.array(field.lower), np.array(field.upper)
    place = (np.clip(points, lower, upper) - lower) / (upper - lower) * (len(nodes) - 1)
    tents = np.maximum(0.0, 1.0 - np.abs(np.arange(len(nodes)) - place.T[:, :, None]))
    force = np.tensordot(np.einsum("ni,nj,nk->nijk", *tents), nodes, 3)
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


def contact_law(collider: Any, contact: Any) -> dict[str, Any]:
    """Return what a collider does, by its own keys or else by the scene's."""
    names = ("stiffness", "damping", "static_friction", "dynamic_friction", "pulls")
    own = {name: getattr(collider, name) for name in names}
    law = {name: getattr(contact, name) if value is None else value for name, value in own.items()}
    return {**law, "term": contact.normal_force_term, "applied_friction": contact.friction_normal == "applied"}


def contact_forces(
    law: dict[str, Any],
    touch: Touch,
    v: np.ndarray,
    applied: np.ndarray,
    m: np.ndarray,
    dt: float,
    given: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal reactions and the frictions on particles, [n, 3] each.

    Args:
        law: of the collider.
        touch: how they touch it.
        v: velocities, [n, 3].
        applied: all forces but the reactions of colliders, [n, 3].
        m: masses, [n].
        dt: the step.
        given: friction that other colliders gave already, [n, 3]; none unless given.
    """
    reactions, frictions = np.zeros_like(v), np.zeros_like(v)
    given = np.zeros_like(v) if given is None else given
    for i in np.flatnonzero(touch.here):
        n = touch.normal[i]
        push = law["stiffness"] * touch.counted[i] - law["damping"] * (v[i] @ n)
        if not law["pulls"]:
            push = max(push, 0.0)
        pressing = -(applied[i] @ n)
        if law["term"]:
            push += max(pressing, 0.0)
        reactions[i] = push * n
        load = max(pressing, 0.0) if law["applied_friction"] else abs(push)
        sliding, pulling = v[i] - (v[i] @ n) * n, applied[i] - (applied[i] @ n) * n
        pulling = pulling + given[i] - (given[i] @ n) * n
        stop = -(pulling + m[i] * sliding / dt)
        needed = np.linalg.norm(stop)
        resting = np.linalg.norm(sliding) < REST_SPEED
        if needed > law["static_friction" if resting else "dynamic_friction"] * load:
            stop *= min(1.0, law["dynamic_friction"] * load / needed)
        frictions[i] = stop
    return reactions, frictions


def contact_energy(collider: Any, contact: Any, touch: Touch) -> float:
    """Return 1/2 k depth^2, from a plane's threshold on growing as the force there times the rest of the way."""
    k = contact_law(collider, contact)["stiffness"]
    deep, counted = touch.depth[touch.here], touch.counted[touch.here]
    return float((k * counted**2 / 2 + k * counted * (deep - counted)).sum())


def rotation(degrees: Any) -> np.ndarray:
    """Return the matrix that turns about x, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


class World:
    """A scene of cubes and voxels in motion."""

    def __init__(self, scene: Scene) -> None:
        assert scene.solver.dt != "auto"
        self.scene, self.dt = scene, scene.dt_for(scene.substeps_for(scene.solver.dt))
        self.laws = [contact_law(collider, scene.contact) for collider in scene.colliders]
        self.steps = 0
        self.losses = np.zeros(3)
        """Taken by springs, by the damping of contacts and by friction, J."""
        self.field_work = 0.0
        """Given by fields, J."""
        self.keys: list[list[Key]] = []
        xs, vs, ms, bodies, springs, self.starts = [], [], [], [], [], []
        first = 0
        for number, body in enumerate(scene.bodies):
            if body.type == "cube":
                cells, edge = np.ones((1, 1, 1), bool), body.size
            else:
                cells, edge = body.grid()[0].dense(), body.grid()[2]
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
        self.charge = np.array([scene.bodies[body].charge for body in self.body])
        table = np.array(springs)
        self.ends = table[:, :2].astype(int)
        self.rest, self.k, self.d = table[:, 2:].T.copy()
        self.origins = np.array(self.starts)[self.body]
        self.before = self.x
        """Positions at the start of the previous step."""
        self.touches: list[list[Touch]] | None = None
        """How the particles touched each collider at the start of the previous step."""

    def find_touches(self, x: np.ndarray, before: np.ndarray, earlier: list[list[Touch]] | None) -> list[list[Touch]]:
        """Return how the particles touch each collider."""
        return [
            find_touches(
                collider,
                x,
                self.origins,
                before=before,
                earlier=None if earlier is None else earlier[number],
                anywhere=self.steps == 0,
                up=self.scene.up,
            )
            for number, collider in enumerate(self.scene.colliders)
        ]

    def evaluate(
        self, x: np.ndarray, v: np.ndarray, touches: list[list[Touch]], share: float = 0.0, ahead: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the total forces [count, 3], a share of a step on, and the powers [4], W.

        Those are what springs, contacts and friction take and what fields give; for contacts and friction at the
        velocities that the forces make some time ahead.
        """
        elastic = spring_forces(x, v, self.ends, self.rest, self.k, 0 * self.d)
        springs = spring_forces(x, v, self.ends, self.rest, self.k, self.d)
        applied = self.m[:, None] * self.scene.gravity_vector + springs
        pushed = np.zeros_like(x)
        for field in self.scene.fields:
            pushed += field_force(field, x, v, self.charge, (self.steps + share) * self.dt)
        applied, given, damping = applied + pushed, np.zeros_like(x), np.zeros_like(x)
        total = applied
        for law, of_collider in zip(self.laws, touches, strict=True):
            for touch in of_collider:
                if touch.here.any():
                    reaction, friction = contact_forces(law, touch, v, applied, self.m, self.dt, given)
                    stored = law["stiffness"] * np.where(touch.here, touch.counted, 0.0)[:, None] * touch.normal
                    total, given = total + reaction + friction, given + friction
                    damping = damping + reaction - stored
        u = v + ahead * total / self.m[:, None]
        power = [((elastic - springs) * v).sum(), -(damping * u).sum(), -(given * u).sum(), (pushed * v).sum()]
        return total, np.array(power)

    def forces(self) -> np.ndarray:
        """Return the total forces at the current state."""
        return self.evaluate(self.x, self.v, self.find_touches(self.x, self.before, self.touches))[0]

    def step(self, count: int = 1) -> None:
        """Advance by the scheme of the scene."""
        for _ in range(count):
            self._step()

    def _step(self) -> None:
        x, v, h = self.x, self.v, self.dt
        # The first evaluation of a step looks one step back and is remembered; later ones look back to its start.
        now = self.find_touches(x, self.before, self.touches)

        def rate(share: float, dx: np.ndarray, dv: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            f, power = self.evaluate(x + dx, v + dv, self.find_touches(x + dx, x, now), share)
            return v + dv, f / self.m[:, None], power

        # The mean velocity of a step by either Euler scheme, whose work is the change of kinetic energy.
        euler = "euler" in self.scene.solver.integrator
        f, power = self.evaluate(x, v, now, ahead=h / 2 if euler else 0.0)
        a = f / self.m[:, None]
        match self.scene.solver.integrator:
            case "explicit_euler":
                self.x, self.v = x + h * v, v + h * a
            case "semi_implicit_euler":
                self.v = v + h * a
                self.x = x + h * self.v
            case "rk2":
                # y + h f(y + h/2 f(y))
                u, a, power = rate(0.5, h / 2 * v, h / 2 * a)
                self.x, self.v = x + h * u, v + h * a
            case "rk4":
                # y + h/6 (k1 + 2 k2 + 2 k3 + k4)
                u2, a2, power2 = rate(0.5, h / 2 * v, h / 2 * a)
                u3, a3, power3 = rate(0.5, h / 2 * u2, h / 2 * a2)
                u4, a4, power4 = rate(1.0, h * u3, h * a3)
                self.x = x + h / 6 * (v + 2 * u2 + 2 * u3 + u4)
                self.v = v + h / 6 * (a + 2 * a2 + 2 * a3 + a4)
                power = (power + 2 * power2 + 2 * power3 + power4) / 6
        self.losses += h * power[:3]
        self.field_work += h * power[3]
        self.before, self.touches = x, now
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
