"""The spring law, and its forces over flat arrays of springs.

Springs are stored as spans: ``(i, j, count, class)`` stands for the springs (i, j), (i + 1, j + 1), ... of one class.
In a lattice in scan order spans are long; a single spring is a span of one. A span costs the 16 bytes of a spring.
A class is ``(rest length [m], stiffness [N/m], damping [N s/m])``.
"""

from typing import Any

import warp as wp

from . import turns, vectors

wp.set_module_options({"enable_backward": False})

# Longest span. It sizes the buffers on the stack of the CPU kernel and the lanes per span on a GPU.
MAX_SPAN = 64


@wp.func
def spring_force(offset: Any, velocity: Any, rest: Any, stiffness: Any, damping: Any):
    """Return the force on the first end; offset and velocity are those of the second end relative to the first."""
    length = wp.length(offset)
    force = type(rest)(0.0) * offset
    # Ends that coincide for a moment have no direction, hence no force.
    if length > type(rest)(0.0):
        direction = offset / length
        force = (stiffness * (length - rest) + damping * wp.dot(velocity, direction)) * direction
    return force


@wp.func
def damping_power(offset: Any, velocity: Any, damping: Any):
    """Return the power [W] that the damper takes from the motion."""
    approach = wp.dot(velocity, wp.normalize(offset))
    return damping * approach * approach


@wp.func
def spring_energy(offset: Any, rest: Any, stiffness: Any):
    """Return the elastic energy, whose negative gradient is the undamped force."""
    stretch = wp.length(offset) - rest
    return type(rest)(0.5) * stiffness * stretch * stretch


# The lanes of a warp of a GPU, which all belong to one span, add up first: two atomic adds a span, not one a spring.
@wp.func_native("""
    #ifdef __CUDA_ARCH__
    for (int lanes = 16; lanes > 0; lanes /= 2) loss += __shfl_xor_sync(0xffffffff, loss, lanes);
    if (lane % 32 == 0) atomicAdd(&losses.data[span], double(loss));
    #else
    if (loss != 0) losses.data[span] += double(loss);
    #endif
""")
def _add_loss(losses: wp.array(dtype=wp.float64), span: int, lane: int, loss: Any): ...


@wp.kernel
def add_spring_forces(
    # Model:
    spans: wp.array(dtype=wp.vec4i),
    classes: wp.array(dtype=Any),
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    loss_weight: Any,
    # State out:
    f: wp.array2d(dtype=Any),
    losses: wp.array(dtype=wp.float64),
):
    """Add the forces of the springs, one thread per spring; launched over (span, MAX_SPAN lanes).

    Losses [span_count] gain the power of the dampers times loss_weight.
    """
    index, lane = wp.tid()
    span = spans[index]
    loss = type(loss_weight)(0.0)
    if lane < span[2]:
        i = span[0] + lane
        j = span[1] + lane
        c = classes[span[3]]
        offset = vectors.load(x, j) - vectors.load(x, i)
        velocity = vectors.load(v, j) - vectors.load(v, i)
        force = spring_force(offset, velocity, c[0], c[1], c[2])
        vectors.add(f, i, force)
        vectors.add(f, j, -force)
        loss = loss_weight * damping_power(offset, velocity, c[2])
    _add_loss(losses, index, lane, loss)


# The same law for a whole span on the CPU, in vector instructions. Where its two ends overlap, the forces on the second
# ends wait in buffers for a pass of their own, so that within a pass no particle occurs twice and plain adds do.
@wp.func_native(f"""
    auto law_rest = rest;
    typedef decltype(law_rest) real;
    const int lanes = 1;
    {vectors.ROW}
    {vectors.EACH}
    const real *px = row(x, 0) + i, *py = row(x, 1) + i, *pz = row(x, 2) + i;
    const real *pu = row(v, 0) + i, *pv = row(v, 1) + i, *pw = row(v, 2) + i;
    real *fx = row(f, 0) + i, *fy = row(f, 1) + i, *fz = row(f, 2) + i;
    const int d = j - i;
    real total = real(0);
    auto law = [&](int s, real& gx, real& gy, real& gz) {{
        #pragma clang fp contract(fast)
        real dx = px[s + d] - px[s], dy = py[s + d] - py[s], dz = pz[s + d] - pz[s];
        real du = pu[s + d] - pu[s], dv = pv[s + d] - pv[s], dw = pw[s + d] - pw[s];
        real square = dx * dx + dy * dy + dz * dz;
        // Only the builtin becomes a vector instruction. The compiler for GPUs, which never run this, does not have it.
        #ifdef __CUDACC__
        real length = sqrt(square);
        #else
        real length = __builtin_elementwise_sqrt(square);
        #endif
        real inverse = square > real(0) ? real(1) / length : real(0);
        real approach = (du * dx + dv * dy + dw * dz) * inverse;
        real scale = stiffness * (real(1) - rest * inverse) + damping * approach * inverse;
        gx = scale * dx;
        gy = scale * dy;
        gz = scale * dz;
        fx[s] += gx;
        fy[s] += gy;
        fz[s] += gz;
        real power = damping * approach * approach;
        {{
            // A sum for each lane: a single one would wait for each addition in turn.
            #pragma clang fp reassociate(on)
            total += power;
        }}
    }};
    if (d >= count || -d >= count) {{
        each(0, count, [&](int s) {{
            real gx, gy, gz;
            law(s, gx, gy, gz);
            fx[s + d] -= gx;
            fy[s + d] -= gy;
            fz[s + d] -= gz;
        }});
    }} else {{
        real gx[{MAX_SPAN}], gy[{MAX_SPAN}], gz[{MAX_SPAN}];
        each(0, count, [&](int s) {{ law(s, gx[s], gy[s], gz[s]); }});
        each(0, count, [&](int s) {{ fx[s + d] -= gx[s]; fy[s + d] -= gy[s]; fz[s + d] -= gz[s]; }});
    }}
    losses.data[span] += double(loss_weight * total);
""")
def _add_span(
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    f: wp.array2d(dtype=Any),
    losses: wp.array(dtype=wp.float64),
    span: int,
    i: int,
    j: int,
    count: int,
    rest: Any,
    stiffness: Any,
    damping: Any,
    loss_weight: Any,
): ...


@wp.kernel
def add_span_forces(
    # Threads:
    turn: turns.Turn,
    tasks: wp.array(dtype=wp.vec2i),
    # Model:
    spans: wp.array(dtype=wp.vec4i),
    classes: wp.array(dtype=Any),
    # State in:
    x: wp.array2d(dtype=Any),
    v: wp.array2d(dtype=Any),
    # In:
    loss_weight: Any,
    # State out:
    f: wp.array2d(dtype=Any),
    losses: wp.array(dtype=wp.float64),
):
    """Add the forces of the springs of some tasks (first span, end), launched over tasks; for the CPU.

    There the springs of a task run one after another, so that adds need not be atomic.
    """
    task = wp.tid()
    mine = turns.take(turn, task)
    if mine:
        for index in range(tasks[task][0], tasks[task][1]):
            span = spans[index]
            c = classes[span[3]]
            _add_span(x, v, f, losses, index, span[0], span[1], span[2], c[0], c[1], c[2], loss_weight)
    turns.leave(turn, task, mine)
