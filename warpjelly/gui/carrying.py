"""Going on after an edit: what a simulation that was just built takes over from the one before."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..model import Body
from ..scene import AnyCollider, BoxCollider, HalfSpaceCollider, PlaneCollider, Scene
from ..simulator import Simulator

# A stamp of no step: out of date, as in a state at time zero.
NO_STEP = -2


def carry_over(old: Simulator, new: Simulator) -> None:
    """Let a new simulation go on where another one is.

    Time goes on, to the nearest whole step. A body that has the name and the number of particles of one before goes on
    from its positions and velocities; another starts. Contacts that hold go on holding, and a plane that is moved meets
    what it is moved through. A half-space keeps each body on the side where it kept it or, if it is new or was moved,
    where the body is.

    Args:
        old: what went on until now.
        new: what goes on from now, at time zero.
    """
    count = round(old.time / new.dt)
    new.substep_count = count
    new.state.step.assign([count])
    before = {body.name: body for body in old.model.bodies}
    pairs = [
        (before[body.name], body)
        for body in new.model.bodies
        if body.name in before and _size(before[body.name]) == _size(body)
    ]
    for name in ("x", "v", "x_start"):
        source, target = getattr(old.state, name), getattr(new.state, name)
        values = target.numpy().copy()
        given = source.numpy()
        for was, body in pairs:
            values[:, body.particles] = given[:, was.particles]
        target.assign(values)
    # Where something is pinned now.
    v = new.state.v.numpy().copy()
    v[:, new.model.particle_inv_mass.numpy() == 0.0] = 0.0
    new.state.v.assign(v)
    _carry_contacts(old, new, pairs)
    _carry_sides(old, new, pairs)
    new.update_forces()


def carry_hold(old: Simulator, new: Simulator) -> None:
    """Let the hand of a new simulation hold what that of another one holds, if it is there."""
    assert old.grip is not None and new.grip is not None
    if (hold := old.grip.hold) is None:
        return
    before, now = (next((body for body in sim.model.bodies if body.name == hold.body), None) for sim in (old, new))
    if before is not None and now is not None and _size(before) == _size(now):
        new.grip.go_on(hold)
        new.update_forces()


def move_body(sim: Simulator, name: str, displacement: np.ndarray, *, at_rest: bool) -> None:
    """Put a body elsewhere as it is, as if it started there: it is in contact where a body that starts is.

    Args:
        sim: the simulation.
        name: of the body.
        displacement: [3], m.
        at_rest: whether it stops.
    """
    body = next(body for body in sim.model.bodies if body.name == name)
    own = body.particles
    for rows in (sim.state.x, sim.state.x_start):
        values = rows.numpy().copy()
        values[:, own] += displacement.astype(values.dtype)[:, None]
        rows.assign(values)
    if at_rest:
        v = sim.state.v.numpy().copy()
        v[:, own] = 0.0
        sim.state.v.assign(v)
    stamps, x = sim.state.stamps.numpy().copy(), sim.state.x.numpy()
    for row, collider in _rows(sim.scene):
        slot = int(sim.model.colliders.slot.numpy()[row])
        if slot >= 0:
            stamps[slot, own] = NO_STEP
        if isinstance(collider, PlaneCollider):
            below, beside = _depths(collider, x[:, own])
            touching = ~beside & (below >= 0.0) & (below <= collider.threshold)
            stamps[slot, own] = np.where(touching, _last_step(sim), NO_STEP)
    if stamps.size:
        sim.state.stamps.assign(stamps)
    sides = sim.model.colliders.side.numpy().copy()
    number = sim.model.bodies.index(body)
    for row, collider in _rows(sim.scene):
        if isinstance(collider, HalfSpaceCollider):
            sides[row, number] = _side(collider, center_of_mass(sim, body))
    if sides.size:
        sim.model.colliders.side.assign(sides)
    sim.update_forces()


def center_of_mass(sim: Simulator, body: Body) -> np.ndarray:
    """Return where the centre of mass of a body is, float64 [3], m."""
    mass = sim.model.particle_mass.numpy()[body.particles].astype(float)
    return np.asarray(sim.state.x.numpy()[:, body.particles].astype(float) @ (mass / mass.sum()))


def _size(body: Body) -> int:
    return int(body.particles.stop - body.particles.start)


def _rows(scene: Scene) -> Iterator[tuple[int, AnyCollider]]:
    """Yield the number of each row of the table of colliders, and whose it is."""
    row = 0
    for collider in scene.colliders:
        for _ in range(6 if isinstance(collider, BoxCollider) else 1):
            yield row, collider
            row += 1


def _first_rows(scene: Scene) -> dict[str, tuple[int, AnyCollider]]:
    """Return the first row of each collider, by name."""
    found: dict[str, tuple[int, AnyCollider]] = {}
    for row, collider in _rows(scene):
        found.setdefault(str(collider.name), (row, collider))
    return found


def _last_step(sim: Simulator) -> int:
    """Return the stamp of a contact that held in the step before."""
    return int(np.int64(sim.substep_count - 1).astype(np.int32))


def _held(sim: Simulator, slot: int) -> np.ndarray:
    """Say which particles were in contact in the last step, by a row of the memory, bool [particle_count]."""
    stamps, last = sim.state.stamps.numpy()[slot], _last_step(sim)
    # Forces that were evaluated anew stamp the step that comes.
    return np.asarray((stamps == last) | (stamps == last + 1))


def _depths(plane: PlaneCollider, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far behind a plane points [3, count] are, m, and whether they are beside its rectangle."""
    local = np.array(plane.frame()) @ (x.astype(float) - np.array(plane.center)[:, None])
    return -local[2], (np.abs(local[:2]) > np.array(plane.size)[:, None] / 2).any(axis=0)


def _carry_contacts(old: Simulator, new: Simulator, pairs: list[tuple[Body, Body]]) -> None:
    known, slots_before = _first_rows(old.scene), old.model.colliders.slot.numpy()
    stamps, normals = new.state.stamps.numpy().copy(), new.state.normals.numpy().copy()
    x_before, normals_before = old.state.x.numpy(), old.state.normals.numpy()
    for row, collider in _rows(new.scene):
        slot = int(new.model.colliders.slot.numpy()[row])
        if slot < 0:
            continue
        row_before, was = known.get(str(collider.name), (-1, None))
        slot_before = int(slots_before[row_before]) if type(was) is type(collider) else -1
        for body_before, body in pairs:
            mine = body_before.particles
            held = np.zeros(_size(body), bool)
            if slot_before >= 0:
                held = _held(old, slot_before)[mine].copy()
            if isinstance(collider, PlaneCollider):
                below, beside = _depths(collider, x_before[:, mine])
                if not (isinstance(was, PlaneCollider) and _stands(was, collider)):
                    # A plane meets what it is moved through, unless it leaps; a new one what touches it, as at a start.
                    if isinstance(was, PlaneCollider):
                        held |= _depths(was, x_before[:, mine])[0] <= 0.0
                    else:
                        held[:] = True
                    held &= below <= collider.threshold
                held &= ~beside & (below >= 0.0)
            elif slot_before >= 0:
                three = slice(3 * slot, 3 * slot + 3)
                normals[three, body.particles] = normals_before[3 * slot_before : 3 * slot_before + 3, mine]
            stamps[slot, body.particles] = np.where(held, _last_step(new), NO_STEP)
    for array, values in ((new.state.stamps, stamps), (new.state.normals, normals)):
        if values.size:
            array.assign(values)


def _stands(was: PlaneCollider, collider: PlaneCollider) -> bool:
    """Say whether a plane is where it was."""
    keys = ("center", "normal", "tangent", "size")
    return all(getattr(was, key) == getattr(collider, key) for key in keys)


def _side(collider: HalfSpaceCollider, center: np.ndarray) -> float:
    """Return on which side of a half-space a centre of mass is, -1 behind, else 1."""
    return -1.0 if (center - np.array(collider.center)) @ np.array(collider.normal) < 0.0 else 1.0


def _carry_sides(old: Simulator, new: Simulator, pairs: list[tuple[Body, Body]]) -> None:
    known, sides = _first_rows(old.scene), new.model.colliders.side.numpy().copy()
    sides_before = old.model.colliders.side.numpy()
    for row, collider in _rows(new.scene):
        if not isinstance(collider, HalfSpaceCollider):
            continue
        row_before, was = known.get(str(collider.name), (-1, None))
        stands = isinstance(was, HalfSpaceCollider) and (was.center, was.normal) == (collider.center, collider.normal)
        for body_before, body in pairs:
            number, number_before = new.model.bodies.index(body), old.model.bodies.index(body_before)
            sides[row, number] = (
                sides_before[row_before, number_before] if stands else _side(collider, center_of_mass(new, body))
            )
    if sides.size:
        new.model.colliders.side.assign(sides)
