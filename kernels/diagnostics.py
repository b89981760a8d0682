"""Measurements once per frame: energies, momenta, contacts, non-finite numbers. Sums are float64 in every precision."""

from typing import Any

import warp as wp

from . import contacts, springs, vectors

wp.set_module_options({"enable_backward": False})

# Columns of the sums over a chunk, measured about the origin.
KINETIC, POTENTIAL, CONTACT, SPEED, DEPTH, CONTACTS, MOMENTUM, ANGULAR_MOMENTUM = 0, 1, 2, 3, 4, 5, 6, 9
COLUMNS = 12
# Whoever is farther from the origin [m] or faster [m/s] than this is lost: a simulation that blows up passes here on
# its way to infinity, and its frames would only spoil the stage.
MAX_DISTANCE = 1e6
MAX_SPEED = 1e5


@wp.kernel
def find_lost(
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # Out:
    first: wp.array(dtype=wp.int32),
):
    """Lower first[0] to the smallest index of a particle whose position or velocity is beyond the limits."""
    i = wp.tid()
    distance = wp.length(vectors.load(x, i))
    speed = wp.length(vectors.load(v, i))
    # Numbers that are not finite fail every comparison, or this one.
    if not (distance <= type(distance)(MAX_DISTANCE) and speed <= type(speed)(MAX_SPEED)):
        wp.atomic_min(first, 0, i)


@wp.kernel
def add_elastic_energy(
    # Model:
    spans: wp.array(dtype=wp.vec4i),
    classes: wp.array(dtype=Any),
    # State in:
    x: wp.array2d(dtype=Any),
    # Out:
    energy: wp.array(dtype=wp.float64),
):
    """Add the elastic energy [J] of the springs to energy[0], one thread per span."""
    span = spans[wp.tid()]
    c = classes[span[3]]
    total = wp.float64(0.0)
    for s in range(span[2]):
        offset = vectors.load(x, span[1] + s) - vectors.load(x, span[0] + s)
        total += wp.float64(springs.spring_energy(offset, c[0], c[1]))
    wp.atomic_add(energy, 0, total)


@wp.kernel
def measure_chunks(
    # Model:
    mass: wp.array(dtype=Any),
    gravity: wp.array(dtype=Any),
    chunk_start: wp.array(dtype=wp.int32),
    chunk_body: wp.array(dtype=wp.int32),
    colliders: Any,
    # State in:
    x_start: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    step: wp.array(dtype=wp.int64),
    stamps: wp.array2d(dtype=wp.int32),
    normals: wp.array2d(dtype=Any),
    # Out:
    sums: wp.array2d(dtype=wp.float64),
):
    """Overwrite the row of each chunk in sums [chunk_count, COLUMNS], one thread per chunk."""
    chunk = wp.tid()
    kinetic = wp.float64(0.0)
    potential = wp.float64(0.0)
    stored = wp.float64(0.0)
    greatest_speed = wp.float64(0.0)
    greatest_depth = wp.float64(0.0)
    touching = wp.float64(0.0)
    momentum = wp.vec3d()
    angular = wp.vec3d()
    g = wp.vec3d(gravity[0])
    for i in range(chunk_start[chunk], chunk_start[chunk + 1]):
        point = vectors.load(x, i)
        m = wp.float64(mass[i])
        p = wp.vec3d(point)
        u = wp.vec3d(vectors.load(v, i))
        kinetic += wp.float64(0.5) * m * wp.dot(u, u)
        potential -= m * wp.dot(g, p)
        momentum += m * u
        angular += m * wp.cross(p, u)
        greatest_speed = wp.max(greatest_speed, wp.length(u))
        for c in range(colliders.kind.shape[0]):
            held = contacts.held_contact(colliders, c, stamps, i, step[0])
            before = contacts.held_normal(colliders, c, normals, i)
            _normal, depth, counted = contacts.find_contact(
                colliders, c, chunk_body[chunk], vectors.load(x_start, i), point, held, before, step[0] == wp.int64(0)
            )
            if depth >= type(depth)(0.0):
                stored += wp.float64(contacts.contact_energy(depth, counted, colliders.stiffness[c]))
                greatest_depth = wp.max(greatest_depth, wp.float64(depth))
                touching += wp.float64(1.0)
    sums[chunk, KINETIC] = kinetic
    sums[chunk, POTENTIAL] = potential
    sums[chunk, CONTACT] = stored
    sums[chunk, SPEED] = greatest_speed
    sums[chunk, DEPTH] = greatest_depth
    sums[chunk, CONTACTS] = touching
    for axis in range(3):
        sums[chunk, MOMENTUM + axis] = momentum[axis]
        sums[chunk, ANGULAR_MOMENTUM + axis] = angular[axis]
