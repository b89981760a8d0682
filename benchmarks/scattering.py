"""The kernels of the Taichi contender. Taichi reads annotations as they stand, not as strings."""

import taichi as ti

Vectors = ti.types.ndarray(dtype=ti.types.vector(3, ti.f32), ndim=1)
Numbers = ti.types.ndarray(dtype=ti.f32, ndim=1)
Indices = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def add_forces(first: Indices, second: Indices, kind: Indices, classes: Vectors, x: Vectors, v: Vectors, f: Vectors):
    """Add the force of each spring to both ends, atomically."""
    for s in first:
        i, j, c = first[s], second[s], classes[kind[s]]
        offset = x[j] - x[i]
        length = offset.norm()
        direction = offset / length
        force = (c[1] * (length - c[0]) + c[2] * (v[j] - v[i]).dot(direction)) * direction
        f[i] += force
        f[j] -= force


@ti.kernel
def integrate(mass: Numbers, gravity: Vectors, dt: ti.f32, x: Vectors, v: Vectors, f: Vectors):
    """Make a step of semi-implicit Euler, and clear the forces."""
    for i in x:
        v[i] += dt * (f[i] / mass[i] + gravity[0])
        x[i] += dt * v[i]
        f[i] = ti.Vector([0.0, 0.0, 0.0])
