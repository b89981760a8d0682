"""Single evaluations of the kernels of contact, at given states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpjelly.kernels import bounds, contacts
from warpjelly.kernels.turns import Turn
from warpjelly.simulator import Simulator


@wp.kernel(enable_backward=False)
def find_contacts(
    colliders: Any,
    starts: wp.array(dtype=Any),
    points: wp.array(dtype=Any),
    held: bool,
    held_normal: Any,
    anywhere: bool,
    normals: wp.array2d(dtype=Any),
    depths: wp.array2d(dtype=Any),
    counted: wp.array2d(dtype=Any),
):
    """Overwrite normals and depths [point, collider] as seen from body 0."""
    i, c = wp.tid()
    normal, depth, count = contacts.find_contact(colliders, c, 0, starts[i], points[i], held, held_normal, anywhere)
    normals[i, c] = normal
    depths[i, c] = depth
    counted[i, c] = count


def probe(
    simulator: Simulator,
    points: Any,
    *,
    starts: Any = None,
    held: bool = False,
    held_normal: Any = (0.0, 0.0, 0.0),
    anywhere: bool = True,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals, depths and depths that count [point, wall] of points in the only collider; a box is six walls."""
    model, device = simulator.model, simulator.device
    vector = wp.types.vector(3, model.real)
    shape = (len(points), len(model.colliders.kind))
    normals = wp.array(np.full((*shape, 3), np.nan), dtype=vector, device=device)
    depths, counted = (wp.array(np.full(shape, np.nan), dtype=model.real, device=device) for _ in range(2))
    starts, points = (
        wp.array(np.array(a, float), dtype=vector, device=device)
        for a in (points if starts is None else starts, points)
    )
    inputs = [model.colliders, starts, points, held, vector(*held_normal), anywhere]
    wp.launch(find_contacts, dim=shape, inputs=inputs, outputs=[normals, depths, counted], device=device)
    return tuple(array.numpy().astype(float) for array in (normals, depths, counted))


@dataclass
class Pushed:
    """What an evaluation of the contacts leaves behind."""

    forces: np.ndarray
    """[count, 3]"""
    stamps: np.ndarray
    """[slot_count, count]"""
    normals: np.ndarray
    """[3 slot_count, count]"""
    losses: np.ndarray
    """Of damping and of friction, times the loss weight, [2]."""


def push_fully(
    simulator: Simulator,
    x: np.ndarray,
    v: np.ndarray,
    *,
    culling: bool = False,
    before: np.ndarray | None = None,
    size: int = 1,
    lanes: int = 1,
    start: np.ndarray | None = None,
    step: int = 0,
    first: bool = True,
    stamps: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    mass: float = 0.01,
    box: tuple[float, float] | None = None,
) -> Pushed:
    """Add contact to the forces before, in chunks of some size, in boxes around them unless told otherwise."""
    model, device, count = simulator.model, simulator.device, len(x) // size
    real = model.real
    before = np.zeros_like(x) if before is None else before
    start = x if start is None else start
    f, x_start, xs, vs = (wp.array(np.ascontiguousarray(a.T), dtype=real, device=device) for a in (before, start, x, v))
    lower, upper = (wp.array(np.full((3, count), np.nan), dtype=real, device=device) for _ in range(2))
    begin = wp.array(size * np.arange(count + 1), dtype=wp.int32, device=device)
    body = wp.zeros(count, dtype=wp.int32, device=device)
    chunks = wp.array(np.arange(count + 1), dtype=wp.int32, device=device)
    inputs = [Turn(), chunks, begin, xs]
    wp.launch(bounds.update_chunk_bounds, dim=count, inputs=inputs, outputs=[lower, upper], device=device)
    if box is not None:
        lower.fill_(box[0])
        upper.fill_(box[1])
    slots, rows = len(simulator.state.stamps), len(simulator.state.normals)
    stamps = np.full((slots, len(x)), -2) if stamps is None else stamps
    normals = np.zeros((rows, len(x))) if normals is None else normals
    memory = wp.array(stamps, dtype=wp.int32, device=device), wp.array(normals, dtype=real, device=device)
    losses = wp.zeros((2, count), dtype=wp.float64, device=device)
    wp.launch(
        contacts.add_contact_forces,
        dim=(count, lanes),
        inputs=[
            *(Turn(), chunks, lanes),
            *(wp.full(len(x), each, dtype=real, device=device) for each in (mass, 1.0 / mass)),
            *(begin, body, model.colliders, lower, upper),
            *(x_start, xs, vs, wp.full(1, step, dtype=wp.int64, device=device)),
            *(real(simulator.dt), real(1.0), real(0.0), first, culling),
        ],
        outputs=[*memory, f, losses],
        device=device,
    )
    return Pushed(f.numpy().T, memory[0].numpy(), memory[1].numpy(), losses.numpy().sum(axis=1))


def push(simulator: Simulator, x: np.ndarray, v: np.ndarray, **options: Any) -> np.ndarray:
    """Return the forces [count, 3] after contact has been added to those before."""
    return push_fully(simulator, x, v, **options).forces
