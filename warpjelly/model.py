"""Model (constant arrays) and State (x, v, f): a scene on a device."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import bounds, contacts, fields, pairs
from warpjelly.kernels.lattices import BEND, BODY_SHEAR, FACE_SHEAR, STRUCTURAL
from warpjelly.kernels.shapes import Shapes

from .lattice import Lattice
from .placing import place_body
from .plan import Plan
from .scene import (
    AnyCollider,
    BoxCollider,
    ConstantField,
    GridField,
    MagneticField,
    Material,
    PlaneCollider,
    Scene,
    SphereCollider,
)
from .shapes import Shape, shapes_of, starts_of

steps = logging.getLogger("warpjelly.steps")

# Most particles of a chunk. Its box should be small against a body, and cheap against its particles.
CHUNK_SIZE = 256

# Rows of arrays that are used together begin this many bytes beyond whole pages apart. At the same place of a page, as
# with powers of two, few of them fit into a cache, and reading one waits for writing another: 32^3 and 64^3 particles
# step 15 to 25 % slower then. A multiple of the 128 bytes that GPUs read at once.
PAGE, ROW_SHIFT = 4096, 896

# Law young: stiffness of each kind of spring over Young's modulus and the edge of a unit cell, for springs that all
# cells around them contain. Of the one-parameter family with the same modulus along edges and diagonals, this member
# gives body diagonals 0.15 and bend springs 0.05.
YOUNG = {STRUCTURAL: 0.4, FACE_SHEAR: 0.2, BODY_SHEAR: 0.15, BEND: 0.05}
# Damping over stiffness of law young, unless given, s.
DAMPING_TIME = 5e-4
PRECISIONS = {"float32": wp.float32, "float64": wp.float64}


@dataclass(frozen=True)
class Body:
    """Where one body is in the arrays of the model."""

    name: str
    particles: slice
    unit: float
    """Edge of a unit cell, m; without cells, the shortest rest length."""


@dataclass(frozen=True)
class Model:
    """What stays the same over a run. Arrays are on the device; real is float32 or float64."""

    bodies: list[Body]
    real: type
    voxel_count: int
    particle_count: int
    spring_count: int
    particle_mass: wp.array
    """real [particle_count], kg."""
    particle_inv_mass: wp.array
    """real [particle_count], 1/kg; 0 for pinned particles."""
    particle_charge: wp.array
    """real [particle_count], C; empty without fields."""
    spans: wp.array
    """(i, j, count, class) of each run of springs, vec4i [span_count]."""
    spring_classes: wp.array
    """(rest length, stiffness, damping), real vec3 [class_count]; m, N/m, N s/m."""
    chunk_start: wp.array
    """First particle of each chunk, and the end of the last, int32 [chunk_count + 1]."""
    chunk_body: wp.array
    """int32 [chunk_count]."""
    body_chunk_start: wp.array
    """First chunk of each body, and the end of the last, int32 [body_count + 1]."""
    gravity: wp.array
    """real vec3 [1], m/s^2."""
    colliders: Any
    """The table of kernels/contacts.py; a box of the scene is six half-spaces here."""
    fields: Any
    """The table of kernels/fields.py."""
    shapes: list[Shape]
    """What the stage shows, body after body."""
    shape_table: Any
    """The table of kernels/shapes.py: the same for all shapes, one after another."""
    skin: Any | None
    """The table of kernels/pairs.py of the particles that collide with others, where any do."""


@dataclass(frozen=True)
class State:
    """What changes, real [3, particle_count] each unless said otherwise; updated in place."""

    x: wp.array
    """Positions, m."""
    v: wp.array
    """Velocities, m/s."""
    f: wp.array
    """Total forces, N."""
    x_start: wp.array
    """Positions at the start of the step, m; before it, at the start of the last one."""
    step: wp.array
    """Steps since the start, int64 [1]."""
    stamps: wp.array
    """Step in which a particle was last in contact with a plane or a sphere, its low 32 bits, int32 [slot_count,
    particle_count]."""
    normals: wp.array
    """Normals of those contacts for spheres that remember them, real [3 slot_count, particle_count]."""
    spring_losses: wp.array
    """Energy taken by the dampers of each span, float64 [span_count], J."""
    field_work: wp.array
    """Energy given by fields to each particle, float64 [particle_count], J; empty without fields."""
    pair_losses: wp.array
    """Energy taken by damping and friction between particles, float64 [2, skin_count], J."""
    contact_losses: wp.array
    """Energy taken by contact damping and by friction in each chunk, float64 [2, chunk_count], J."""


def build(plan: Plan, *, device: str) -> tuple[Model, State]:
    """Build every body and put the scene on a device at time zero."""
    scene, count = plan.scene, plan.particle_count
    real = PRECISIONS[scene.solver.precision]
    vector = wp.types.vector(3, real)
    # Rows per component: see kernels/__init__.py. Memory is taken up where it is written, body after body; what is not
    # needed to build comes after the last one.
    rows = new_rows(4, count, real, device)
    # On the CPU the arrays themselves.
    x, v = (row.numpy() for row in rows[:2])
    mass, inv_mass = (np.empty(count, x.dtype) for _ in range(2))
    bodies: list[Body] = []
    spans, classes, chunks, centers = ([] for _ in range(4))
    skins: list[_Skin] = []
    shapes: list[Shape] = []
    shape_starts: list[int] = []
    first = class_count = 0
    lattice: Lattice | None = None
    for body_plan, next_plan in zip_longest(plan.bodies, plan.bodies[1:]):
        body, materials = body_plan.body, [scene.materials[name] for name in body_plan.materials]
        steps.info("building '%s' of %s particles", body.name, f"{body_plan.particle_count:,}")
        # Bodies that follow one another and are made alike share a lattice.
        shared = next_plan is not None and next_plan.build is body_plan.build
        lattice = lattice or body_plan.build()
        own = slice(first, first + lattice.particle_count)
        bodies.append(Body(name=str(body.name), particles=own, unit=lattice.unit))
        shapes += shapes_of(str(body.name), lattice, scene.output, body_plan.model)
        shape_starts += [first] * (len(shapes) - len(shape_starts))
        if scene.soft_contacts:
            skins.append(_skin_of(lattice))
        start = {"x": x[:, own], "v": v[:, own], "mass": mass[own], "inv_mass": inv_mass[own]}
        centers.append(place_body(lattice, materials, body, **start))
        chunks.append(np.arange(own.start, own.stop, CHUNK_SIZE, dtype=np.int32))
        classes.append(spring_classes(materials, lattice))
        # In place where the lattice is not needed any more.
        spans.append(lattice.spans.copy() if shared else lattice.spans)
        spans[-1] += np.array([first, first, 0, class_count], np.int32)
        first = own.stop
        class_count += len(classes[-1])
        if not shared:
            lattice = None

    def array(data: Any, dtype: Any) -> wp.array:
        # On the CPU the array is the data itself.
        return wp.array(np.asarray(data), dtype=dtype, device=device, copy=False)

    chunk_counts = [len(part) for part in chunks]
    all_spans = _joined(spans)
    sizes = [part.particle_count if scene.fields else 0 for part in plan.bodies]
    charges = np.repeat([part.body.charge for part in plan.bodies], sizes)
    model = Model(
        bodies=bodies,
        real=real,
        voxel_count=plan.voxel_count,
        particle_count=count,
        spring_count=int(all_spans[:, 2].sum(dtype=np.int64)),
        particle_mass=array(mass, real),
        particle_inv_mass=array(inv_mass, real),
        particle_charge=array(charges, real),
        spans=array(all_spans, wp.vec4i),
        spring_classes=array(np.concatenate(classes), vector),
        chunk_start=array(np.append(np.concatenate(chunks), np.int32(count)), wp.int32),
        chunk_body=array(np.repeat(np.arange(len(bodies), dtype=np.int32), chunk_counts), wp.int32),
        body_chunk_start=array(np.cumsum([0, *chunk_counts]), wp.int32),
        gravity=array(scene.gravity_vector[None], vector),
        colliders=_colliders(scene, centers, real, device),
        fields=_fields(scene, real, device),
        shapes=shapes,
        shape_table=_shape_table(shapes, shape_starts, device),
        skin=_skin(scene, bodies, skins, real, device) if skins else None,
    )
    slots = int(model.colliders.slot.numpy().max(initial=-1)) + 1
    remembered = int(model.colliders.entry_normal.numpy().sum())
    if not rows[0].device.is_cpu:
        rows[0].assign(x)
        rows[1].assign(v)
    rows[2].zero_()
    wp.copy(rows[3], rows[0])
    state = State(
        x=rows[0],
        v=rows[1],
        f=rows[2],
        x_start=rows[3],
        step=wp.zeros(1, dtype=wp.int64, device=device),
        stamps=wp.full((slots, count), -2, dtype=wp.int32, device=device),
        normals=wp.zeros((3 * remembered, count), dtype=real, device=device),
        spring_losses=wp.zeros(len(model.spans), dtype=wp.float64, device=device),
        pair_losses=wp.zeros(
            (2, 0 if model.skin is None else len(model.skin.particles)), dtype=wp.float64, device=device
        ),
        field_work=wp.zeros(len(charges), dtype=wp.float64, device=device),
        contact_losses=wp.zeros((2, len(model.chunk_body)), dtype=wp.float64, device=device),
    )
    return model, state


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return arrays one after the other; a single one as it is, not as a copy."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def new_rows(count: int, particle_count: int, real: type, device: Any) -> list[wp.array]:
    """Return some arrays, real [3, particle_count] each and not set, whose rows begin in different places of a page."""
    size = wp.types.type_size_in_bytes(real)
    stride = (-(-particle_count * size // PAGE) * PAGE + ROW_SHIFT) // size
    block = wp.empty((3 * count, stride), dtype=real, device=device)
    # What is between the rows.
    block[:, particle_count:].zero_()
    return [block[3 * number : 3 * number + 3, :particle_count] for number in range(count)]


def zero_rows(count: int, particle_count: int, real: type, device: Any) -> list[wp.array]:
    """Return such arrays full of zeros."""
    rows = new_rows(count, particle_count, real, device)
    for row in rows:
        row.zero_()
    return rows


def spring_classes(materials: Sequence[Material], lattice: Lattice) -> np.ndarray:
    """Return (rest length [m], stiffness [N/m], damping [N s/m]) of each class of springs, float64 [class_count, 3].

    A spring has the constants of its material, or the sum of what those of the cells around it contribute: with the
    laws hooke and strain by their shares, which makes the mean, with the law young by their numbers.
    """
    constants = np.zeros((2, len(lattice.classes.kinds)))
    for number, material in enumerate(materials):
        add = _young if material.law == "young" else _hooke
        constants += add(material, lattice, number)
    return np.stack([lattice.classes.rest_lengths, *constants], axis=1)


def _hooke(material: Material, lattice: Lattice, number: int) -> np.ndarray:
    """Return what a material adds to stiffness [N/m] and damping [N s/m] of each class, float64 [2, class_count].

    The law "strain", k_s (l/r - 1) with damping d_s / r, is Hooke's with k = k_s / r and d = d_s / r.
    """
    classes = lattice.classes
    by_kind = {
        STRUCTURAL: material.structural,
        FACE_SHEAR: material.shear,
        BODY_SHEAR: material.shear,
        BEND: material.bend,
    }
    constants = np.array([(by_kind[kind].stiffness, by_kind[kind].damping) for kind in classes.kinds]).reshape(-1, 2)
    scale = 1.0 / classes.rest_lengths if material.law == "strain" else 1.0
    return scale * constants.T * classes.shares[:, number]


def _young(material: Material, lattice: Lattice, number: int) -> np.ndarray:
    """Return what a material adds to stiffness [N/m] and damping [N s/m] of each class, float64 [2, class_count].

    A spring on the surface is in fewer cells than one inside, and weaker by as much: then every cell resists strain
    alike, wherever it is. A bend spring adds twice its stiffness to each of the two structural springs under it, which
    give up as much. All of this holds for the cells of each material alone, and so for their sum.
    """
    classes = lattice.classes
    assert classes.cells is not None and classes.bends is not None and material.youngs_modulus is not None
    # How many cells contain a spring inside: 4 around an edge, 2 at a face, 1 around a body diagonal.
    share = classes.cells[:, number] / np.array([4, 2, 1, 4])[classes.kinds]
    stiffness = np.array([YOUNG[kind] for kind in range(4)])[classes.kinds] * share
    edge = classes.kinds == STRUCTURAL
    stiffness[edge] += YOUNG[BEND] * (4 * share[edge] - 2 * classes.bends[edge, number] / 4)
    stiffness *= material.youngs_modulus * lattice.unit
    time = DAMPING_TIME if material.damping_time is None else material.damping_time
    return np.stack([stiffness, stiffness * time])


def _fields(scene: Scene, real: type, device: str) -> Any:
    """Return the table of fields for the kernels."""
    rows: list[dict[str, Any]] = []
    nodes, curves = [np.zeros((0, 3))], [np.zeros((0, 2))]
    for field in scene.fields:
        row: dict[str, Any] = {"node_start": sum(map(len, nodes))}
        if isinstance(field, GridField):
            grid = field.nodes()
            nodes.append(grid.reshape(-1, 3))
            row |= {"kind": fields.GRID, "lower": field.lower, "upper": field.upper, "resolution": len(grid)}
            row["clamped"] = field.outside == "clamp"
        elif isinstance(field, ConstantField):
            row |= {"kind": fields.CONSTANT, "strength": field.force}
        else:
            kind = fields.MAGNETIC if isinstance(field, MagneticField) else fields.ELECTRIC
            row |= {"kind": kind, "strength": field.strength}
        rows.append(row)
        curves.append(np.array(field.curve or np.zeros((0, 2))))

    def array(data: Any, dtype: Any) -> wp.array:
        return wp.array(data, dtype=dtype, device=device)

    vector = wp.types.vector(3, real)
    table = fields.FIELDS[real]()
    for name in ("kind", "resolution", "node_start", "clamped"):
        setattr(table, name, array(np.array([row.get(name, 0) for row in rows], np.int32), wp.int32))
    for name in ("strength", "lower", "upper"):
        data = np.array([row.get(name, np.zeros(3)) for row in rows], float).reshape(-1, 3)
        setattr(table, name, array(data, vector))
    table.nodes = array(np.concatenate(nodes), vector)
    table.curve_start = array(np.cumsum([len(curve) for curve in curves], dtype=np.int32), wp.int32)
    keyframes = np.concatenate(curves)
    table.curve_time, table.curve_factor = (array(np.ascontiguousarray(column), wp.float64) for column in keyframes.T)
    return table


def _shape_table(shapes: Sequence[Shape], first_particles: Sequence[int], device: str) -> Any:
    """Return the table of shapes for the kernels, given the first particle of each one's body."""

    def joined(parts: Iterable[np.ndarray], dtype: Any) -> wp.array:
        return wp.array(np.concatenate(list(parts)), dtype=dtype, device=device)

    def starts(lengths: Iterable[np.ndarray]) -> wp.array:
        return wp.array(np.cumsum(np.concatenate([[0], *lengths])), dtype=wp.int32, device=device)

    first_points, first_normals = starts_of(shapes)
    table = Shapes()
    table.point_start = starts(np.full(len(shape.particles), shape.particles.shape[1]) for shape in shapes)
    table.particles = joined(
        (shape.particles.ravel() + first for shape, first in zip(shapes, first_particles, strict=True)), wp.int32
    )
    table.weights = joined((shape.weights.ravel() for shape in shapes), wp.float32)
    table.face_start = starts(shape.counts for shape in shapes)
    table.corners = joined(
        (shape.corners + first for shape, first in zip(shapes, first_points, strict=False)), wp.int32
    )
    table.corner_normals = joined(
        (
            (shape.corners if shape.corner_normals is None else shape.corner_normals) + first
            for shape, first in zip(shapes, first_normals, strict=False)
        ),
        wp.int32,
    )
    return table


@dataclass(frozen=True)
class _Skin:
    """What one body adds to the table of the particles that collide with each other."""

    particles: np.ndarray
    """Those of them in the body, ascending, int [count]."""
    radius: float
    """Half of a unit cell's edge, m."""
    rest: np.ndarray
    """Where they rest, float64 [count, 3], m."""
    springs: np.ndarray
    """Numbers of both ends of each spring between them, from either end, ascending by the first, int [count, 2]."""


def _skin_of(lattice: Lattice) -> _Skin:
    on_skin = np.zeros(lattice.particle_count, bool)
    on_skin[lattice.surface_particles] = True
    members = np.flatnonzero(on_skin)
    inner = np.searchsorted(members, lattice.springs_among(on_skin))
    ends = np.concatenate([inner, inner[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    return _Skin(members, lattice.unit / 2, lattice.positions(members), ends)


def _skin(scene: Scene, bodies: Sequence[Body], skins: Sequence[_Skin], real: type, device: str) -> Any:
    """Return the table of the particles that collide with each other."""
    contact = scene.soft_contact
    particles, owners, chunks, radii, rest, starts, neighbors = ([] for _ in range(7))
    count = chunk_count = neighbor_count = 0
    for number, (body, skin) in enumerate(zip(bodies, skins, strict=True)):
        size = len(skin.particles)
        degree = np.bincount(skin.springs[:, 0], minlength=size)
        starts.append(neighbor_count + np.cumsum(degree) - degree)
        neighbors.append(count + skin.springs[:, 1])
        particles.append(body.particles.start + skin.particles)
        owners.append(np.full(size, number))
        chunks.append(chunk_count + skin.particles // CHUNK_SIZE)
        radii.append(np.full(size, skin.radius if contact.radius is None else contact.radius))
        rest.append(skin.rest)
        count += size
        chunk_count += -(-(body.particles.stop - body.particles.start) // CHUNK_SIZE)
        neighbor_count += len(skin.springs)

    def array(parts: list[np.ndarray], dtype: Any) -> wp.array:
        return wp.array(np.concatenate(parts), dtype=dtype, device=device)

    table = pairs.SKIN[real]()
    table.particles = array(particles, wp.int32)
    table.body = array(owners, wp.int32)
    table.chunk = array(chunks, wp.int32)
    table.radius = array(radii, real)
    table.rest = array(rest, wp.types.vector(3, real))
    table.neighbor_start = array([*starts, np.array([neighbor_count])], wp.int32)
    table.neighbors = array(neighbors, wp.int32)
    table.greatest_radius = max(part.max() for part in radii)
    table.stiffness, table.damping, table.friction = contact.stiffness, contact.damping, contact.friction
    table.with_itself = contact.mode == "all"
    return table


def _colliders(scene: Scene, centers_of_mass: Sequence[np.ndarray], real: type, device: str) -> Any:
    """Return the table of colliders for the kernels."""
    rows = [row for collider in scene.colliders for row in _collider_rows(collider, scene, centers_of_mass)]
    # Spheres that remember normals have the first slots of the memory, so that only they need rows for them.
    with_memory = [row for row in rows if row["entry_normal"]] + [row for row in rows if row["kind"] == contacts.PLANE]
    for row in rows:
        row["slot"] = next((slot for slot, other in enumerate(with_memory) if other is row), -1)
    vector = wp.types.vector(3, real)
    table = contacts.COLLIDERS[real]()
    numbers = ("stiffness", "damping", "static_friction", "dynamic_friction")
    flags = ("kind", "pulls", "entry_normal", "normal_force_term", "applied_friction", "slot")
    for name, dtype in [(name, real) for name in numbers] + [(name, wp.int32) for name in flags]:
        setattr(table, name, wp.array(np.array([row[name] for row in rows]), dtype=dtype, device=device))
    for name in ("center", "tangent", "bitangent", "normal", "size", "lower", "upper"):
        data = np.array([row.get(name, np.zeros(3)) for row in rows], float).reshape(-1, 3)
        setattr(table, name, wp.array(data, dtype=vector, device=device))
    side = np.array([row["side"] for row in rows], float).reshape(-1, len(centers_of_mass))
    table.side = wp.array(side, dtype=real, device=device)
    return table


def _collider_rows(collider: AnyCollider, scene: Scene, centers_of_mass: Sequence[np.ndarray]) -> list[dict[str, Any]]:
    """Return the members of the table of kernels/contacts.py for one collider of the scene."""
    center = np.array(collider.center)
    everywhere = np.ones(len(centers_of_mass))
    contact = scene.contact_of(collider)
    row: dict[str, Any] = {"center": center, "side": everywhere, "entry_normal": False}
    for name in ("stiffness", "damping", "static_friction", "dynamic_friction", "pulls", "normal_force_term"):
        row[name] = getattr(contact, name)
    row["applied_friction"] = contact.friction_normal == "applied"
    if isinstance(collider, SphereCollider):
        radius = np.full(3, collider.radius)
        up = np.eye(3)[scene.up]
        # The box that culling tests, grown so that rounding never makes it too small.
        reach = radius + bounds.MARGIN * (1.0 + np.abs(center) + radius)
        volume = {"lower": center - reach, "upper": center + reach}
        entry = {"entry_normal": collider.normal == "entry"}
        return [row | entry | {"kind": contacts.SPHERE, "normal": up, "size": radius} | volume]
    if isinstance(collider, PlaneCollider):
        tangent, bitangent, normal = collider.frame()
        a, b = np.array(collider.size) / 2
        directions = {"tangent": tangent, "bitangent": bitangent, "normal": normal}
        size = {"size": [a, b, collider.threshold]}
        return [row | {"kind": contacts.PLANE} | directions | size]
    if isinstance(collider, BoxCollider):
        walls = []
        for axis in range(3):
            for sign in (-1.0, 1.0):
                outward = sign * np.eye(3)[axis]
                wall = {"center": center + outward * collider.size[axis] / 2, "normal": -outward}
                walls.append(row | {"kind": contacts.HALF_SPACE} | wall)
        return walls
    normal = np.array(collider.normal) / np.linalg.norm(collider.normal)
    side = [-1.0 if (com - center) @ normal < 0 else 1.0 for com in centers_of_mass]
    return [row | {"kind": contacts.HALF_SPACE, "normal": normal, "side": side}]
