"""Force fields against analytic motion and the reference, and the clock that moves them."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import reference
import warp as wp
from reference import EPSILON, ROUND_OFF, World
from worlds import make_material, make_scene, set_state, step_of, substeps_of

from warpjelly.errors import InputError
from warpjelly.kernels import fields
from warpjelly.kernels.turns import Turn
from warpjelly.scenefile import load_scene
from warpjelly.simulator import Simulator
from warpjelly.stepping import MAX_CAPTURED_SUBSTEPS

LOWER, UPPER = (-1.0, -2.0, 0.5), (2.0, 1.0, 1.5)


def make_grid(forces: Any, **changes: Any) -> dict[str, Any]:
    """Return a grid over a box that is nothing special."""
    return {"type": "grid", "lower": LOWER, "upper": UPPER, "forces": forces, **changes}


def field_forces(
    field: dict[str, Any], points: np.ndarray, velocities: np.ndarray | None = None, *, device: str, **options: Any
) -> np.ndarray:
    """Return the forces [count, 3] of a field on particles of charge 2 C at some places, N."""
    options = {"precision": "float64", "time": 0.0, **options}
    scene = make_scene(
        fields=[field],
        bodies=[{"type": "cube", "material": "jelly", "particles_per_edge": 2, "charge": 2.0}],
        solver={"precision": options["precision"]},
    )
    model = Simulator(scene, device=device).model
    x, v = (
        wp.array(np.ascontiguousarray(rows.T), dtype=model.real, device=device)
        for rows in (points, np.zeros_like(points) if velocities is None else velocities)
    )
    charge = wp.full(len(points), 2.0, dtype=model.real, device=device)
    step = wp.zeros(1, dtype=wp.int64, device=device)
    f = wp.zeros((3, len(points)), dtype=model.real, device=device)
    wp.launch(
        fields.add_field_forces,
        dim=(1, 1),
        inputs=[
            Turn(),
            wp.array([0, len(points)], dtype=wp.int32, device=device),
            1,
            charge,
            model.fields,
            step,
            x,
            v,
            wp.float64(step_of(scene)),
            wp.float64(options["time"]),
            wp.float64(0.0),
        ],
        outputs=[f, wp.zeros(len(points), dtype=wp.float64, device=device)],
        device=device,
    )
    return f.numpy().T


def test_a_constant_force_accelerates_by_the_sum_of_the_scheme(precision: str, device: str) -> None:
    """Move by dt^2 n (n + 1) / 2 f/m, which is what semi-implicit Euler makes of a constant force."""
    force, n = np.array([0.02, -0.05, 0.01]), 500
    scene = make_scene(fields=[{"type": "constant", "force": force.tolist()}], solver={"precision": precision})
    sim = Simulator(scene, device=device)
    x0 = sim.positions.astype(float)
    sim.step(n)
    # Particles have 0.01 kg. As in free fall: half an epsilon of up to 1 m, and of up to 2.5 m/s for n dt, per step.
    dt = step_of(scene)
    expected = x0 + force / 0.01 * dt**2 * n * (n + 1) / 2
    np.testing.assert_allclose(sim.positions, expected, rtol=0, atol=EPSILON[precision] * n * (1 + 2.5 * n * dt))


def test_a_grid_reproduces_trilinear_functions(precision: str, device: str) -> None:
    """Interpolate a trilinear function without an error, at nodes, in cells and on faces."""
    rng = np.random.default_rng(1)
    coefficients = rng.normal(size=(2, 2, 2, 3))

    def function(p: np.ndarray) -> np.ndarray:
        powers = [np.stack([np.ones(len(p)), p[:, axis]]) for axis in range(3)]
        return np.einsum("an,bn,cn,abcd->nd", *powers, coefficients)

    n = 5
    axes = [np.linspace(a, b, n) for a, b in zip(LOWER, UPPER, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    forces = function(nodes.reshape(-1, 3)).reshape(nodes.shape)
    points = np.concatenate([nodes.reshape(-1, 3), rng.uniform(LOWER, UPPER, size=(500, 3))])
    # Rounding a point by an epsilon moves the function by its slope; nothing here is above 50 N or 50 N/m.
    bound = 50 * ROUND_OFF[precision]
    for given in (forces.tolist(), forces.reshape(-1, 3).tolist()):
        found = field_forces(make_grid(given), points, precision=precision, device=device)
        np.testing.assert_allclose(found, function(points), rtol=0, atol=bound)


@pytest.mark.parametrize("outside", ["clamp", "zero"])
@pytest.mark.parametrize("resolution", [2, 3, 7])
def test_a_grid_agrees_with_the_reference(resolution: int, outside: str, precision: str, device: str) -> None:
    """Agree with the tent functions of all nodes inside the box, and with the clamp or nothing outside."""
    rng = np.random.default_rng(resolution)
    field = make_grid(rng.normal(size=(resolution**3, 3)).tolist(), outside=outside)
    points = np.concatenate([rng.uniform(-4, 4, size=(500, 3)), rng.uniform(LOWER, UPPER, size=(200, 3))])
    points = np.concatenate([points, [LOWER, UPPER]])
    # What float32 cannot hold is no point of it.
    points = points.astype(precision).astype(float)
    parsed = make_scene(fields=[field]).fields[0]
    expected = reference.grid_force(parsed, points)
    # At least some are outside, and some inside.
    assert (expected == 0).all(axis=1).sum() > 100 if outside == "zero" else (expected != 0).all()
    found = field_forces(field, points, precision=precision, device=device)
    # Forces of about 4 N at most, steps between nodes of 6 N over 1/6 m, points of 4 m.
    np.testing.assert_allclose(found, expected, rtol=0, atol=150 * ROUND_OFF[precision])


def test_a_grid_is_read_from_numpy_files(tmp_path, device: str) -> None:
    """Read the same forces from .npy and .npz files beside the scene as from the scene."""
    forces = np.random.default_rng(4).normal(size=(3, 3, 3, 3))
    np.save(tmp_path / "a.npy", forces)
    np.savez(tmp_path / "b.npz", forces.reshape(-1, 3).astype(np.float32))
    scene = '[materials.m]\n[[bodies]]\ntype = "cube"\nmaterial = "m"\n[[fields]]\ntype = "grid"\n'
    scene += "lower = [-1.0, -1.0, -1.0]\nupper = [1.0, 1.0, 1.0]\n"
    for name, bound in (("a.npy", 0.0), ("b.npz", 2.0**-23)):
        (tmp_path / "scene.toml").write_text(f'{scene}file = "{name}"\n')
        found = load_scene(tmp_path / "scene.toml").fields[0].nodes()
        np.testing.assert_allclose(found, forces, rtol=bound)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fields.0.forces": [[1.0, 2.0, 3.0]] * 9}, "[R^3, 3] with R at least 2"),
        ({"fields.0.forces": [[1.0, 2.0, 3.0]]}, "[R^3, 3] with R at least 2"),
        ({"fields.0.forces": [[1.0, 2.0]] * 8}, "fields.0.forces.0 = [1.0, 2.0]: must have 3 entries, not 2"),
        ({"fields.0.forces": [[float("nan"), 2.0, 0.0]] * 8}, "finite"),
        ({"fields.0.forces": None}, "give either forces or file"),
        ({"fields.0.file": "none.npy"}, "no such file"),
        ({"fields.0.lower": [1.0, -1.0, -1.0]}, "lower must be below upper"),
        ({"fields.0.curve": [[0.0, 1.0], [0.0, 2.0]]}, "times must ascend"),
        ({"fields.0.curve": []}, "must not be empty"),
        ({"fields.0.type": "wind"}, "'constant'"),
        ({"fields.0.outsid": "zero"}, "did you mean 'outside'"),
        ({"fields.0.file": "scene.toml", "fields.0.forces": None}, "not a NumPy file"),
    ],
)
def test_a_bad_field_is_refused(tmp_path, changes: dict[str, Any], said: str) -> None:
    """Name the file, the key and what is allowed."""
    path = tmp_path / "scene.toml"
    path.write_text(
        '[materials.m]\n[[bodies]]\ntype = "cube"\nmaterial = "m"\n[[fields]]\ntype = "grid"\n'
        "lower = [-1.0, -1.0, -1.0]\nupper = [1.0, 1.0, 1.0]\n"
    )
    forces = {"fields.0.forces": [[0.0, 0.0, 0.0]] * 8}
    assert load_scene(path, overrides=forces).fields
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides=forces | changes)
    assert said in str(caught.value)
    assert "fields.0" in str(caught.value)


def save_damaged(path: Path) -> None:
    """Write a .npz file in whose packed data some bytes are wrong."""
    np.savez_compressed(path, np.random.default_rng(1).normal(size=(8, 3)))
    data = bytearray(path.read_bytes())
    data[60:100] = 40 * b"\xff"
    path.write_bytes(data)


def save_header(old: bytes, new: bytes) -> Callable[[Path], None]:
    """Return what writes a .npy file with a changed header, padded to the length that it had."""

    def save(path: Path) -> None:
        packed = io.BytesIO()
        np.save(packed, np.zeros((8, 3)))
        data = packed.getvalue()
        assert old in data
        path.write_bytes(data.replace(old, new).replace(b" " * (len(new) - len(old)) + b"\n", b"\n", 1))

    return save


def save_text(path: Path) -> None:
    """Write a .npz file that holds a text."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "forces")


@pytest.mark.parametrize(
    ("name", "save", "said"),
    [
        ("damaged.npz", save_damaged, "decompressing"),
        ("text.npz", save_text, "something else"),
        ("header.npy", save_header(b"'descr'", b"'descr\""), "header"),
        ("open.npy", save_header(b"'shape': (8, 3), }", b"'shape': (8, 3, 0 "), ""),
        ("huge.npy", save_header(b"(8, 3)", b"(1000000, 1000000, 1000)"), "allocate"),
        ("fields.npy", lambda path: np.save(path, np.zeros(8, [("x", float), ("y", float), ("z", float)])), "'x'"),
        ("complex.npy", lambda path: np.save(path, np.zeros((8, 3), complex)), "complex128"),
        ("dates.npy", lambda path: np.save(path, np.zeros((8, 3), "datetime64[s]")), "datetime64"),
        ("words.npy", lambda path: np.save(path, np.full((8, 3), "1.0")), "<U3"),
        ("flags.npz", lambda path: np.savez(path, np.zeros((8, 3), bool)), "bool"),
    ],
)
def test_a_file_without_an_array_of_numbers_is_refused(
    tmp_path: Path, name: str, save: Callable[[Path], None], said: str
) -> None:
    """Name the file and what is wrong in one line, whatever reading it trips over."""
    save(tmp_path / name)
    (tmp_path / "scene.toml").write_text(
        '[materials.m]\n[[bodies]]\ntype = "cube"\nmaterial = "m"\n[[fields]]\ntype = "grid"\n'
        f'lower = [-1.0, -1.0, -1.0]\nupper = [1.0, 1.0, 1.0]\nfile = "{name}"\n'
    )
    with pytest.raises(InputError) as caught:
        load_scene(tmp_path / "scene.toml")
    message = str(caught.value)
    assert f"fields.0: {tmp_path / name}: not a NumPy file with one array of numbers: " in message
    assert said in message.split("numbers: ")[1]
    assert "\n" not in message


def make_charged(precision: str, fields: list[dict[str, Any]]) -> Any:
    """Return a scene of a charged cube of 8 particles that moves without turning."""
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "charge": 0.02, "velocity": [1.0, 0.5, 0.25]}
    return make_scene(bodies=[body], fields=fields, solver={"precision": precision})


def test_a_charge_circles_in_a_magnetic_field(precision: str, device: str) -> None:
    """Turn by arctan(w dt) a step with w = q B / m, as the scheme has it, and fly straight along the field."""
    b = np.array([0.0, 0.0, 3.0])
    scene = make_charged(precision, [{"type": "magnetic", "strength": b.tolist()}])
    sim = Simulator(scene, device=device)
    # All particles move alike, so springs stay at rest. With u = vx + i vy, q v x B makes u' = u (1 - i w dt).
    w, n = 0.02 * b[2] / 0.01, 400
    sim.step(n)
    u = (1.0 + 0.5j) * (1 - 1j * w * step_of(scene)) ** n
    # Each step rounds v by half an epsilon of up to 2 m/s, and the springs answer the rounding of x.
    bound = ROUND_OFF[precision] * n
    expected = np.tile([u.real, u.imag, 0.25], (8, 1))
    np.testing.assert_allclose(sim.velocities, expected, rtol=0, atol=bound)
    # It has turned far.
    assert n * np.arctan(w * step_of(scene)) > 2.0


def test_a_charge_falls_in_an_electric_field(precision: str, device: str) -> None:
    """Gain q E / m t of velocity, and nothing without a charge."""
    field = {"type": "electric", "strength": [3.0, 0.0, -1.0]}
    scene = make_charged(precision, [field])
    sim, n = Simulator(scene, device=device), 300
    sim.step(n)
    expected = np.array([1.0, 0.5, 0.25]) + 0.02 / 0.01 * np.array(field["strength"]) * n * step_of(scene)
    # Each step rounds v by half an epsilon of up to 4 m/s, and the springs answer the rounding of x.
    np.testing.assert_allclose(sim.velocities, np.tile(expected, (8, 1)), rtol=0, atol=ROUND_OFF[precision] * n)
    without = make_scene(solver={"precision": precision})
    uncharged = make_scene(fields=[field], solver={"precision": precision})
    np.testing.assert_array_equal(*(Simulator(scene, device=device).forces for scene in (without, uncharged)))


@pytest.mark.parametrize("kind", ["constant", "grid", "electric", "magnetic"])
@pytest.mark.parametrize("time", [-1.0, 0.0, 0.125, 0.25, 0.7, 1.0, 1.5, 2.0, 9.0])
def test_a_curve_is_linear_between_keyframes(kind: str, time: float, device: str) -> None:
    """Follow the keyframes of every kind of field at, between and outside them."""
    curve = [[0.0, 1.0], [0.25, -2.0], [1.0, 0.5], [2.0, 3.0]]
    strength = [1.0, -2.0, 4.0]
    laws = {"constant": {"force": strength}, "grid": make_grid([strength] * 8)}
    field = {"strength": strength, **laws[kind]} if kind in laws else {"strength": strength}
    field = {**laws.get(kind, field), "type": kind, "curve": curve}
    v = np.array([[1.0, 2.0, 3.0]])
    found = field_forces(field, np.zeros((1, 3)), v, time=time, device=device)[0]
    law = {"electric": 2.0 * np.array(strength), "magnetic": 2.0 * np.cross(v[0], strength)}
    expected = law.get(kind, np.array(strength)) * np.interp(time, *zip(*curve, strict=True))
    np.testing.assert_allclose(found, expected, rtol=ROUND_OFF["float64"], atol=0)


def test_one_keyframe_is_a_constant_factor(device: str) -> None:
    """Take the only keyframe's factor at all times."""
    field = {"type": "constant", "force": [1.0, 0.0, 0.0], "curve": [[1.0, 0.5]]}
    for time in (0.0, 1.0, 2.0):
        assert field_forces(field, np.zeros((1, 3)), time=time, device=device)[0, 0] == 0.5


def test_the_clock_is_exact_after_many_steps(precision: str, device: str) -> None:
    """Read the time n dt, not a sum of rounded steps, after 100,000 steps, and count as the host does."""
    # The factor is the time itself; the force on a particle is read at the time n dt of the step's start.
    field = {"type": "constant", "force": [1.0, 0.0, 0.0], "curve": [[0.0, 0.0], [1000.0, 1000.0]]}
    scene = make_scene(fields=[field], fps=10.0, solver={"dt": 1e-3, "precision": precision})
    sim = Simulator(scene, device=device)
    set_state(sim, v=np.zeros((8, 3)))
    sim.step(100_000)
    assert sim.state.step.numpy().tolist() == [100_000] == [sim.substep_count]
    assert sim.time == 100_000 * step_of(scene)
    # A sum of float64 steps would be off by 1e-9 s, of float32 steps by more than 1 ms. The force of float32 is
    # rounded, which is also what the springs do about the shape: within 1e-4 of 100 N.
    sim._stepper.add_forces(loss_weight=0.0)
    mean = sim.forces.mean(axis=0)[0]
    assert mean == pytest.approx(100_000 * step_of(scene), rel={"float32": 1e-6, "float64": 1e-14}[precision])


def test_fields_in_captured_frames_are_those_of_single_steps(device: str) -> None:
    """Find the same bits with graphs and launch by launch, with curves that change within a frame."""
    curve = [[0.0, 0.0], [0.004, 1.0], [0.03, -1.0]]
    scene = make_scene(
        fps=10.0,
        fields=[{"type": "constant", "force": [0.1, -0.2, 0.3], "curve": curve}, make_grid([[0.1, 0.0, 0.2]] * 8)],
    )
    captured, single = Simulator(scene, device=device), Simulator(scene, device=device)
    assert substeps_of(scene) > MAX_CAPTURED_SUBSTEPS
    captured.advance_frame()
    single._stepper.capturable = False
    single.advance_frame()
    if device == "cpu":
        np.testing.assert_array_equal(captured.positions, single.positions)
    else:
        # Atomic adds come in any order on a GPU.
        np.testing.assert_allclose(captured.positions, single.positions, rtol=0, atol=1e-12)


def test_a_cube_in_all_fields_moves_like_the_reference(device: str) -> None:
    """Follow a deforming, charged cube in four fields with curves for 300 steps."""
    rng = np.random.default_rng(9)
    curve = [[0.0, 1.0], [0.1, -1.0], [0.2, 2.0]]
    forces = rng.normal(scale=0.05, size=(4, 4, 4, 3)).tolist()
    scene = make_charged(
        "float64",
        [
            {"type": "constant", "force": [0.02, 0.0, -0.03], "curve": curve},
            make_grid(forces, curve=curve, outside="zero"),
            {"type": "electric", "strength": [1.0, -2.0, 0.5]},
            {"type": "magnetic", "strength": [2.0, 5.0, -3.0], "curve": curve},
        ],
    )
    sim, world = Simulator(scene, device=device), World(scene)
    sim.step(300)
    world.step(300)
    # 300 steps of errors of a few ROUND_OFF, which springs of w dt < 1 do not amplify beyond their number.
    np.testing.assert_allclose(sim.positions, world.x, rtol=0, atol=300 * 10 * ROUND_OFF["float64"])
    np.testing.assert_allclose(sim.velocities, world.v, rtol=0, atol=300 * 1e3 * ROUND_OFF["float64"])


ORDERS = {"explicit_euler": 1, "semi_implicit_euler": 1, "rk2": 2, "rk4": 4}
LOOSE = make_material(0.0, 0.0)
"""Springs without force: particles that move alike stay together without them."""


@pytest.mark.parametrize("integrator", ORDERS)
def test_a_ramp_accelerates_by_the_sum_of_the_scheme(integrator: str, precision: str, device: str) -> None:
    """Push with a force that grows linearly, a = a0 + b t: each scheme makes a polynomial of it.

    With C(n, k) = n! / (k! (n - k)!) and T = n dt, v is v0 + a0 T + b V and x is x0 + v0 T + a0 P + b Q, where

    explicit Euler: V = C(n, 2) dt^2, P = C(n, 2) dt^2, Q = C(n, 3) dt^3;
    semi-implicit Euler: V = C(n, 2) dt^2, P = C(n + 1, 2) dt^2, Q = C(n + 1, 3) dt^3, the same but with new velocities;
    RK2: V = T^2/2 and P = T^2/2 exactly; x gains v dt + a dt^2/2 in a step, a at its start: Q = T^3/6 - T dt^2/6;
    RK4: V, P and Q = T^3/6 exactly, which needs forces at the start, in the middle and at the end of a step.
    """
    start, slope, n, mass = 0.25, 10.0, 500, 0.01
    force, velocity = np.array([0.04, -0.03, 0.02]), np.array([-1.0, 0.5, 0.25])
    curve = [[0.0, start], [2.0, start + 2.0 * slope]]
    body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "velocity": velocity.tolist()}
    field = {"type": "constant", "force": force.tolist(), "curve": curve}
    scene = make_scene(
        bodies=[body], fields=[field], materials={"jelly": LOOSE | {"particle_mass": mass}},
        solver={"precision": precision, "integrator": integrator},
    )  # fmt: skip
    sim, dt = Simulator(scene, device=device), step_of(scene)
    x0, a0, b, t = sim.positions.astype(float), start * force / mass, slope * force / mass, n * dt
    sim.step(n)
    late, p, q = {
        "explicit_euler": (math.comb(n, 2) * dt**2, math.comb(n, 2) * dt**2, math.comb(n, 3) * dt**3),
        "semi_implicit_euler": (math.comb(n, 2) * dt**2, math.comb(n + 1, 2) * dt**2, math.comb(n + 1, 3) * dt**3),
        "rk2": (t**2 / 2, t**2 / 2, t**3 / 6 - t * dt**2 / 6),
        "rk4": (t**2 / 2, t**2 / 2, t**3 / 6),
    }[integrator]
    # As in free fall: half an epsilon of up to 2 m, and of up to 8 m/s for n dt, per step, or twice that with stages.
    bound = 2 * EPSILON[precision] * n
    np.testing.assert_allclose(sim.velocities, np.tile(velocity + a0 * t + b * late, (8, 1)), rtol=0, atol=8 * bound)
    expected = x0 + velocity * t + a0 * p + b * q
    np.testing.assert_allclose(sim.positions, expected, rtol=0, atol=(2 + 8 * t) * bound)
    # Forces half a step too early or too late would change the velocities by b dt/2 T.
    assert np.abs(b).max() * dt * t / 2 > 5 * 8 * bound
    # What RK2 lacks is seen in float64.
    assert precision == "float32" or np.abs(b).max() * t * dt**2 / 6 > 1e3 * (2 + 8 * t) * bound


@pytest.mark.parametrize("integrator", ORDERS)
def test_motion_in_a_changing_field_converges_with_the_order_of_the_scheme(integrator: str, device: str) -> None:
    """Come closer to the motion of a charge in a magnetic field that changes by 2^order when the step is halved.

    With u = vx + i vy, u' = -i w f(t) u, so u(t) = u(0) exp(-i w F(t)), F the integral of the curve f. Keyframes are at
    ends of steps, so that f is smooth within each. Forces at other times than those of the stages are of first order.
    """
    charge, mass, b, end = 0.02, 0.01, 4.0, 0.4
    curve = [[0.0, 0.5], [end / 2, 2.0], [end, -1.0]]
    errors = []
    # Errors are c dt^p (1 + O(w dt)), with w f dt at most 0.002 for Euler, 0.04 for RK2 and 0.16 for RK4.
    for dt in np.array([1.0, 0.5]) * {"rk2": 2.5e-3, "rk4": 1e-2}.get(integrator, 1.25e-4):
        body = {"type": "cube", "material": "jelly", "particles_per_edge": 2, "charge": charge,
                "velocity": [1.0, 0.5, 0.25]}  # fmt: skip
        field = {"type": "magnetic", "strength": [0.0, 0.0, b], "curve": curve}
        scene = make_scene(
            bodies=[body], fields=[field], materials={"jelly": LOOSE | {"particle_mass": mass}},
            solver={"dt": dt, "integrator": integrator},
        )  # fmt: skip
        sim = Simulator(scene, device=device)
        assert sim.dt == pytest.approx(dt, rel=1e-12)
        sim.step(round(end / dt))
        turned = charge * b / mass * np.trapezoid(*zip(*[(f, t) for t, f in curve], strict=True))
        u = (1.0 + 0.5j) * np.exp(-1j * turned)
        errors.append(np.abs(sim.velocities - [u.real, u.imag, 0.25]).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(ORDERS[integrator], abs=0.1)
    # Far above round-off, some epsilon for each step.
    assert errors[1] > 1e5 * EPSILON["float64"]
