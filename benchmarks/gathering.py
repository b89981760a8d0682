"""The kernels of the Numba contender, at the top of a module so that Numba can keep them compiled."""

import numpy as np
from numba import njit, prange


@njit(cache=True)
def rows(first, second, kind, particle_count):
    """Return where the springs of each particle begin, their other ends, and their classes."""
    start = np.zeros(particle_count + 1, np.int64)
    for s in range(len(first)):
        start[first[s] + 1] += 1
        start[second[s] + 1] += 1
    start = np.cumsum(start)
    place = start[:-1].copy()
    others, kinds = np.empty(2 * len(first), np.int32), np.empty(2 * len(first), np.uint8)
    for s in range(len(first)):
        for i, j in ((first[s], second[s]), (second[s], first[s])):
            others[place[i]], kinds[place[i]] = j, kind[s]
            place[i] += 1
    return start, others, kinds


@njit(parallel=True, fastmath=True, cache=True)
def step(start, others, kinds, mass, classes, gravity, dt, x, v, x_next, v_next):
    """Make a step of semi-implicit Euler from x, v to x_next, v_next."""
    for i in prange(len(x)):
        fx = fy = fz = np.float32(0.0)
        for s in range(start[i], start[i + 1]):
            j, c = others[s], kinds[s]
            dx, dy, dz = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            inverse = np.float32(1.0) / np.sqrt(dx * dx + dy * dy + dz * dz)
            approach = ((v[j, 0] - v[i, 0]) * dx + (v[j, 1] - v[i, 1]) * dy + (v[j, 2] - v[i, 2]) * dz) * inverse
            scale = classes[c, 1] * (np.float32(1.0) - classes[c, 0] * inverse) + classes[c, 2] * approach * inverse
            fx += scale * dx
            fy += scale * dy
            fz += scale * dz
        v_next[i, 0] = v[i, 0] + dt * (fx / mass[i] + gravity[0])
        v_next[i, 1] = v[i, 1] + dt * (fy / mass[i] + gravity[1])
        v_next[i, 2] = v[i, 2] + dt * (fz / mass[i] + gravity[2])
        x_next[i, 0] = x[i, 0] + dt * v_next[i, 0]
        x_next[i, 1] = x[i, 1] + dt * v_next[i, 1]
        x_next[i, 2] = x[i, 2] + dt * v_next[i, 2]
