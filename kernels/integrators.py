"""Time integration, in place. Every scheme leaves in x_start where the particles were at the start of the step."""

from typing import Any

import warp as wp

from . import turns, vectors

wp.set_module_options({"enable_backward": False})

# Runge-Kutta schemes whose stages each need only the one before. For each stage: the share of the step at which it
# evaluates forces, its weight in the result, and the share of the step to the next trial state (the last has none).
STAGES = {
    "explicit_euler": [(0.0, 1.0, 0.0)],
    "rk2": [(0.0, 0.0, 0.5), (0.5, 1.0, 0.0)],
    "rk4": [(0.0, 1.0 / 6.0, 0.5), (0.5, 1.0 / 3.0, 0.5), (0.5, 1.0 / 3.0, 1.0), (1.0, 1.0 / 6.0, 0.0)],
}


# Both schemes go row by row: components are independent of each other.
@wp.func_native(f"""
    {vectors.ROW}
    {vectors.EACH}
    for (int axis = 0; axis < 3; ++axis) {{
        auto step = dt;
        auto inverse = inv_mass.data;
        auto force = row(f, axis);
        auto start = row(x_start, axis);
        auto place = row(x, axis);
        auto speed = row(v, axis);
        each(begin, end, [=](int i) {{
            start[i] = place[i];
            speed[i] += step * inverse[i] * force[i];
            place[i] += step * speed[i];
        }});
    }}
""")
def _advance(
    inv_mass: wp.array(dtype=Any),
    f: wp.array2d(dtype=Any),
    dt: Any,
    x_start: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    begin: int,
    end: int,
    lanes: int,
): ...


@wp.kernel
def semi_implicit_euler(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    lanes: int,
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
    """Advance by dt: first the velocities by the forces, then the positions by the new velocities.

    Launched over (part, lane); lane k takes particles k, k + lanes, ... of the part.
    """
    part, lane = wp.tid()
    task = part * lanes + lane
    mine = turns.take(turn, task)
    if mine:
        _advance(inv_mass, f, dt, x_start, x, v, part_start[part] + lane, part_start[part + 1], lanes)
    turns.leave(turn, task, mine)


# The lambda is compiled for each of the four cases, so that no case is looked at within a loop.
@wp.func_native(f"""
    {vectors.ROW}
    {vectors.EACH}
    struct yes {{ enum {{ value = 1 }}; }};
    struct no {{ enum {{ value = 0 }}; }};
    auto stage = [&](auto is_first, auto is_last) {{
        for (int axis = 0; axis < 3; ++axis) {{
            auto step = dt, share = weight, ahead = reach * dt;
            auto inverse = inv_mass.data;
            auto force = row(f, axis);
            auto place = row(x, axis);
            auto speed = row(v, axis);
            auto place_start = row(x_start, axis);
            auto speed_start = row(v_start, axis);
            auto place_sum = row(x_sum, axis);
            auto speed_sum = row(v_sum, axis);
            each(begin, end, [=](int i) {{
                auto x_rate = speed[i], v_rate = inverse[i] * force[i];
                auto x_total = share * x_rate, v_total = share * v_rate;
                if (decltype(is_first)::value) {{
                    place_start[i] = place[i];
                    speed_start[i] = speed[i];
                }} else {{
                    x_total += place_sum[i];
                    v_total += speed_sum[i];
                }}
                if (decltype(is_last)::value) {{
                    place[i] = place_start[i] + step * x_total;
                    speed[i] = speed_start[i] + step * v_total;
                }} else {{
                    place_sum[i] = x_total;
                    speed_sum[i] = v_total;
                    place[i] = place_start[i] + ahead * x_rate;
                    speed[i] = speed_start[i] + ahead * v_rate;
                }}
            }});
        }}
    }};
    if (first && last) stage(yes(), yes());
    else if (first) stage(yes(), no());
    else if (last) stage(no(), yes());
    else stage(no(), no());
""")
def _advance_stage(
    inv_mass: wp.array(dtype=Any),
    f: wp.array2d(dtype=Any),
    dt: Any,
    weight: Any,
    reach: Any,
    first: bool,
    last: bool,
    x_start: wp.array2d(dtype=Any),
    v_start: wp.array2d(dtype=Any),
    x_sum: wp.array2d(dtype=Any),
    v_sum: wp.array2d(dtype=Any),
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    begin: int,
    end: int,
    lanes: int,
): ...


@wp.kernel
def runge_kutta_stage(
    # Threads:
    turn: turns.Turn,
    part_start: wp.array(dtype=wp.int32),
    lanes: int,
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
    start along this stage's rates. Launched over (part, lane), as above.
    """
    part, lane = wp.tid()
    task = part * lanes + lane
    mine = turns.take(turn, task)
    if mine:
        begin = part_start[part] + lane
        end = part_start[part + 1]
        _advance_stage(
            inv_mass, f, dt, weight, reach, first, last, x_start, v_start, x_sum, v_sum, x, v, begin, end, lanes
        )
    turns.leave(turn, task, mine)


@wp.kernel
def count_step(
    # Threads:
    turn: turns.Turn,
    # State in and out:
    step: wp.array(dtype=wp.int64),
):
    """Count a finished step in step[0]; a launch of one task, since captured launches freeze their scalars."""
    task = wp.tid()
    mine = turns.take(turn, task)
    if mine:
        step[task] += wp.int64(1)
    turns.leave(turn, task, mine)
