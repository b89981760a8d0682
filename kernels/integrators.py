"""Time integration, in place. Every scheme leaves in x_start where the particles were at the start of the step."""

from typing import Any

import warp as wp

from . import vectors

wp.set_module_options({"enable_backward": False})

# Runge-Kutta schemes whose stages each need only the one before. For each stage: the share of the step at which it
# evaluates forces, its weight in the result, and the share of the step to the next trial state (the last has none).
STAGES = {
    "explicit_euler": [(0.0, 1.0, 0.0)],
    "rk2": [(0.0, 0.0, 0.5), (0.5, 1.0, 0.0)],
    "rk4": [(0.0, 1.0 / 6.0, 0.5), (0.5, 1.0 / 3.0, 0.5), (0.5, 1.0 / 3.0, 1.0), (1.0, 1.0 / 6.0, 0.0)],
}


@wp.kernel
def semi_implicit_euler(
    # Model:
    inv_mass: wp.array(dtype=Any),
    # State in:
    f: wp.array2d(dtype=Any),
    # In:
    dt: Any,
    # State in and out:
    x_start: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
):
    """Advance by dt: first the velocities by the forces, then the positions by the new velocities."""
    i = wp.tid()
    position = vectors.load(x, i)
    velocity = vectors.load(v, i) + dt * inv_mass[i] * vectors.load(f, i)
    vectors.store(x_start, i, position)
    vectors.store(v, i, velocity)
    vectors.store(x, i, position + dt * velocity)


@wp.kernel
def runge_kutta_stage(
    # Model:
    inv_mass: wp.array(dtype=Any),
    # State in:
    f: wp.array2d(dtype=Any),
    # In:
    dt: Any,
    weight: Any,
    reach: Any,
    first: bool,
    last: bool,
    # State in and out:
    x_start: wp.array2d(dtype=Any),
    v_start: wp.array2d(dtype=Any),
    x_sum: wp.array2d(dtype=Any),
    v_sum: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
):
    """Use the forces of one stage; x and v become the next stage's trial state, or after the last one the new state.

    The rates (v, f / m) of the stages are summed with their weights. The next trial state lies ``reach`` dt from the
    start along this stage's rates.
    """
    i = wp.tid()
    x_rate = vectors.load(v, i)
    v_rate = inv_mass[i] * vectors.load(f, i)
    x_total = weight * x_rate
    v_total = weight * v_rate
    if first:
        vectors.store(x_start, i, vectors.load(x, i))
        vectors.store(v_start, i, vectors.load(v, i))
    else:
        x_total += vectors.load(x_sum, i)
        v_total += vectors.load(v_sum, i)
    if last:
        vectors.store(x, i, vectors.load(x_start, i) + dt * x_total)
        vectors.store(v, i, vectors.load(v_start, i) + dt * v_total)
    else:
        vectors.store(x_sum, i, x_total)
        vectors.store(v_sum, i, v_total)
        vectors.store(x, i, vectors.load(x_start, i) + reach * dt * x_rate)
        vectors.store(v, i, vectors.load(v_start, i) + reach * dt * v_rate)


@wp.kernel
def count_step(
    # State in and out:
    step: wp.array(dtype=wp.int64),
):
    """Count a finished step in step[0]; a launch of one thread, since captured launches freeze their scalars."""
    step[wp.tid()] += wp.int64(1)
