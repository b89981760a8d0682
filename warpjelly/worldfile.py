"""Read and write the `.w` world files of the CMU jello cube: one 8 x 8 x 8 cube in a box, in a field of forces.

The format is a sequence of numbers: integrator; dt and steps per sample; the constants of the springs and of the
contacts; mass per particle; an inclined plane or none; a grid of forces or none; positions; velocities.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as shorten
from typing import Any

import numpy as np

from .errors import EnvironmentFailedError, InputError, SceneError
from .files import refuse_to_replace, whole_file
from .scene import (
    DEFAULT_PARTICLE_MASS,
    MAX_FPS,
    MAX_LENGTH,
    MAX_MAGNITUDE,
    MAX_STEP,
    MAX_SUBSTEPS,
    MIN_FPS,
    MIN_MASS,
    MIN_STEP,
    BoxCollider,
    ConstantField,
    CubeBody,
    GridField,
    HalfSpaceCollider,
    Material,
    Scene,
)

log = logging.getLogger("warpjelly")

SUFFIX = ".w"
INTEGRATORS = {"Euler": "explicit_euler", "EULER": "explicit_euler", "RK4": "rk4"}
# Particles along an edge of the cube, its edge [m], and half the edge of the box [m].
PARTICLES_PER_EDGE, CUBE_SIZE, BOX_REACH = 8, 1.0, 2.0
DEFAULT_FRAMES = 300
# The stock worlds have 30 nodes along each axis of the field; 128 are six million numbers.
MAX_RESOLUTION = 128

_INTEGER = re.compile(r"[+-]?[0-9]{1,9}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


class _Tokens:
    """The words of a world file, in order, each with its line."""

    def __init__(self, path: Path, text: str) -> None:
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        self.path = path
        self.words = [(word, number) for number, line in enumerate(lines, start=1) for word in line.split()]
        self.next = 0

    def refuse(self, why: str) -> InputError:
        """Return the error that something is wrong with the word read last, or with the end of the file."""
        if self.next <= len(self.words):
            line = self.words[self.next - 1][1]
        else:
            line = self.words[-1][1] if self.words else 1
        return InputError(f"{self.path}: line {line}: {why}")

    def word(self, what: str) -> str:
        """Take the next word."""
        self.next += 1
        if self.next > len(self.words):
            raise self.refuse(f"the file ends here, where {what} should follow")
        return self.words[self.next - 1][0]

    def integer(self, what: str, least: int, most: int) -> int:
        """Take an integer between two bounds."""
        word = self.word(what)
        if not _INTEGER.fullmatch(word) or not least <= int(word) <= most:
            raise self.refuse(f"{shorten(word)} is not {what}, an integer from {least} to {most}")
        return int(word)

    def number(self, what: str, least: float = -MAX_MAGNITUDE, most: float = MAX_MAGNITUDE) -> float:
        """Take a number between two bounds."""
        word = self.word(what)
        if not _NUMBER.fullmatch(word) or not least <= float(word) <= most:
            raise self.refuse(f"{shorten(word)} is not {what}, a number from {least:g} to {most:g}")
        return float(word)

    def vectors(self, count: int, what: str, most: float = MAX_MAGNITUDE) -> list[tuple[float, float, float]]:
        """Take some vectors."""
        missing = self.next + 3 * count - len(self.words)
        if missing > 0:
            self.next = len(self.words) + 1
            raise self.refuse(f"the file ends here, {missing} numbers before the end of {count} x 3 for {what}")
        numbers = iter([self.number(f"a component of {what}", -most, most) for _ in range(3 * count)])
        return list(zip(numbers, numbers, numbers, strict=True))


def read_world(path: Path) -> dict[str, Any]:
    """Read a world as the tables of a scene, without its name and length.

    Raises:
        InputError: the file cannot be read, or is not a world; the message names the line.
    """
    try:
        tokens = _Tokens(path, path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file: {error.reason} at byte {error.start}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot read the world: {error.strerror}") from error
    integrator = tokens.word("the integrator")
    if integrator not in INTEGRATORS:
        raise tokens.refuse(f"{shorten(integrator)} is not an integrator of jello cube worlds; they are Euler and RK4")
    dt = tokens.number("the time step in s", MIN_STEP, MAX_STEP)
    steps = tokens.integer("the number of steps per sample", 1, MAX_SUBSTEPS)
    if steps * dt > 1.0 / MIN_FPS:
        raise tokens.refuse(f"a sample every {steps * dt:g} s; at most {1.0 / MIN_FPS:g} s are allowed")
    stiffness, damping = tokens.number("kElastic in N/m", 0.0), tokens.number("dElastic in N s/m", 0.0)
    contact = {"stiffness": tokens.number("kCollision in N/m", 0.0), "damping": tokens.number("dCollision", 0.0)}
    if contact["stiffness"] == 0 and contact["damping"] > 0:
        raise tokens.refuse("dCollision is given, but kCollision is 0; it must be above 0, or both 0 for no collisions")
    mass = tokens.number("the mass of a particle in kg", MIN_MASS)
    colliders: list[dict[str, Any]] = [{"name": "box", "type": "box", "size": [2 * BOX_REACH] * 3}]
    if tokens.integer("the flag of the inclined plane", 0, 1) == 1:
        *normal, shift = (tokens.number(f"coefficient {name} of the inclined plane") for name in "abcd")
        square = float(np.dot(normal, normal))
        if square < 1e-12:
            raise tokens.refuse("the inclined plane has no normal; a, b and c must not all be 0")
        # The point of the plane a x + b y + c z + d = 0 that is closest to the origin.
        center = [-shift * component / square for component in normal]
        if max(map(abs, center)) > MAX_LENGTH:
            raise tokens.refuse(f"the inclined plane is farther away than {MAX_LENGTH:g} m")
        colliders.append({"name": "plane", "type": "half_space", "center": center, "normal": normal})
    resolution = tokens.integer("the resolution of the field", 0, MAX_RESOLUTION)
    if resolution == 1:
        raise tokens.refuse("a field of resolution 1 has no box; give 0 for no field, or at least 2")
    fields = []
    if resolution > 0:
        forces = tokens.vectors(resolution**3, "the field")
        box = {"lower": [-BOX_REACH] * 3, "upper": [BOX_REACH] * 3}
        fields = [{"type": "grid", **box, "forces": forces, "outside": "clamp"}]
    positions = tokens.vectors(PARTICLES_PER_EDGE**3, "the positions", MAX_LENGTH)
    velocities = tokens.vectors(PARTICLES_PER_EDGE**3, "the velocities")
    if tokens.next < len(tokens.words):
        extra = tokens.word("nothing")
        raise tokens.refuse(f"{shorten(extra)} follows after the last velocity, where the file should end")
    constants = {"stiffness": stiffness, "damping": damping}
    return {
        "up_axis": "Z",
        "gravity": [0.0, 0.0, 0.0],
        "solver": {
            "integrator": INTEGRATORS[integrator],
            "dt": dt,
            "steps_per_frame": steps,
            "precision": "float64",
        },
        "materials": {
            "jelly": {
                "law": "hooke",
                "particle_mass": mass,
                "structural": dict(constants),
                "shear": dict(constants),
                "bend": dict(constants),
            }
        },
        "bodies": [
            {
                "name": "cube",
                "type": "cube",
                "material": "jelly",
                "size": CUBE_SIZE,
                "particles_per_edge": PARTICLES_PER_EDGE,
                "positions": positions,
                "velocities": velocities,
            }
        ],
        "contact": {"static_friction": 0.0, "dynamic_friction": 0.0},
        "colliders": [collider | contact | {"pulls": True} for collider in colliders] if contact["stiffness"] else [],
        "fields": fields,
    }


def settle_time(path: Path, data: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the overrides of a world without fps, which its exact step decides; give the world its length.

    A wish for fps becomes the nearest whole number of steps per sample, and the log says so. It stays where the scene
    refuses it, or the step, and where the overrides say the number of steps themselves.
    """
    overrides = dict(overrides)
    if "duration" not in overrides:
        data["frames"] = DEFAULT_FRAMES
    wish, dt = overrides.get("fps"), overrides.get("solver.dt", data["solver"]["dt"])
    sound = _is_number(wish, MIN_FPS, MAX_FPS) and _is_number(dt, MIN_STEP, MAX_STEP)
    if not sound or overrides.keys() & {"solver", "solver.steps_per_frame"}:
        return overrides
    del overrides["fps"]
    steps = max(1, round(1.0 / (wish * dt)))
    overrides["solver.steps_per_frame"] = steps
    log.warning(
        "%s: a sample every %d steps of %g s, that is %.9g samples per second for the %g asked for",
        path, steps, dt, 1.0 / (steps * dt), wish,
    )  # fmt: skip
    return overrides


def _is_number(value: Any, least: float, most: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def write_world(scene: Scene, path: str | Path, *, force: bool = False) -> None:
    """Write a scene as a world file; names, expectations and what is shown of it have no place there.

    Args:
        scene: what to write.
        path: file to write, .w.
        force: replace a file that is there already.

    Raises:
        InputError: the scene does not fit the format, and the message names the key; or the file exists.
        EnvironmentFailedError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise InputError(f"{path}: a world file ends in {SUFFIX}")
    refuse_to_replace(path, force=force)
    text = _format(scene)
    try:
        with whole_file(path) as unfinished:
            unfinished.write_text(text, encoding="ascii", newline="\n")
    except OSError as error:
        raise EnvironmentFailedError(f"{path}: cannot write the world: {error.strerror or error}") from error


def _format(scene: Scene) -> str:
    """Return the text of a world."""
    names = {name: word for word, name in reversed(INTEGRATORS.items())}
    _require(scene.solver.integrator in names, "solver.integrator", f"is not one of {', '.join(names)}")
    _require(len(scene.bodies) == 1, "bodies", "is not one cube")
    body = scene.bodies[0]
    if not (isinstance(body, CubeBody) and math.isclose(body.size, CUBE_SIZE) and body.particles_per_edge == 8):
        raise _unfit("bodies.0", "is not a cube of size 1 with 8 particles per edge")
    _require(not body.pinned, "bodies.0.pinned", "is given; a world pins no particle")
    _require(not scene.soft_contacts, "soft_contact.mode", "is all; the cube of a world does not collide with itself")
    key = f"materials.{body.material}"
    springs, mass = _one_kind(scene.materials[body.material], key)
    plane, contact = _contact(scene)
    constants = {
        f"{key}.structural.stiffness": springs[0],
        f"{key}.structural.damping": springs[1],
        "colliders.0.stiffness": contact[0],
        "colliders.0.damping": contact[1],
    }
    _require(scene.solver.dt != "auto", "solver.dt", "is auto; a world has a number")
    substeps = scene.substeps_for(float(scene.solver.dt))
    lines = [
        names[scene.solver.integrator],
        f"{_written(scene.dt_for(substeps), 'solver.dt')} {substeps}",
        " ".join(_written(value, name) for name, value in constants.items()),
        _written(mass, f"{key}.particle_mass"),
        "0" if plane is None else "1\n" + _vector(_coefficients(plane)),
    ]
    grid = _grid(scene, mass)
    lines.append(str(len(grid)))
    # Everything that imports Warp takes a second, which reading a scene need not spend.
    from .placing import place_body
    from .plan import plan_scene

    plan = plan_scene(scene).bodies[0]
    x, v, masses = (np.empty((rows, plan.particle_count)) for rows in (3, 3, 2))
    place_body(
        plan.build(), [scene.materials[plan.body.material]], plan.body, x=x, v=v, mass=masses[0], inv_mass=masses[1]
    )
    lines += [_vector(row) for rows in (grid.reshape(-1, 3), x.T, v.T) for row in rows]
    return "\n".join(lines) + "\n"


def _unfit(key: str, why: str) -> SceneError:
    return SceneError(f"the scene does not fit a world file: {key} {why}")


def _require(fits: bool, key: str, why: str) -> None:
    if not fits:
        raise _unfit(key, why)


def _vector(values: Any) -> str:
    # Adding zero takes the sign from a zero.
    return " ".join(f"{round(float(value), 6) + 0.0:.6f}" for value in values)


def _written(value: float, key: str) -> str:
    """Return a constant with the six decimals of the format, and say what they lose."""
    text = f"{value:.6f}"
    _require(float(text) != 0 or value == 0, key, f"= {value:g} is 0 with the six decimals of the format")
    if not math.isclose(float(text), value, rel_tol=1e-9):
        log.warning("%s = %.9g is written as %s, with the six decimals of the format", key, value, text)
    return text


def _one_kind(material: Material, key: str) -> tuple[tuple[float, float], float]:
    """Return the stiffness and damping of all springs, N/m and N s/m, and the mass of a particle, kg."""
    _require(material.law == "hooke", f"{key}.law", "is not hooke")
    _require(material.density is None, f"{key}.density", "is given; a world has a particle_mass")
    for kind in ("shear", "bend"):
        same = getattr(material, kind) == material.structural
        _require(same, f"{key}.{kind}", "differs from structural; a world has one kind of spring")
    mass = DEFAULT_PARTICLE_MASS if material.particle_mass is None else material.particle_mass
    return (material.structural.stiffness, material.structural.damping), mass


def _contact(scene: Scene) -> tuple[HalfSpaceCollider | None, tuple[float, float]]:
    """Return the inclined plane, if there is one, and stiffness and damping of all contacts, N/m and N s/m."""
    if not scene.colliders:
        return None, (0.0, 0.0)
    boxes, planes = [], []
    first = scene.contact_of(scene.colliders[0])
    for i, collider in enumerate(scene.colliders):
        key = f"colliders.{i}"
        contact = scene.contact_of(collider)
        _require(contact.stiffness == first.stiffness, f"{key}.stiffness", "differs between colliders")
        _require(contact.damping == first.damping, f"{key}.damping", "differs between colliders")
        _require(contact.pulls or contact.damping == 0, f"{key}.pulls", "is false; contacts of a world pull")
        rubs = max(contact.static_friction, contact.dynamic_friction) > 0
        _require(not rubs, f"{key}.static_friction", "is not 0, or dynamic_friction; a world has no friction")
        _require(not contact.normal_force_term, "contact.normal_force_term", "is true; a world has no such term")
        if isinstance(collider, BoxCollider):
            fits = collider.size == (2 * BOX_REACH,) * 3 and not any(collider.center)
            _require(fits, key, "is not the box from -2 to 2")
            boxes.append(collider)
        elif isinstance(collider, HalfSpaceCollider):
            planes.append(collider)
        else:
            raise _unfit(f"{key}.type", f"is {collider.type}; a world has a box and half-spaces")
    _require(len(boxes) == 1, "colliders", f"has {len(boxes)} boxes; a world has one")
    _require(len(planes) <= 1, "colliders", f"has {len(planes)} half-spaces; a world has at most one")
    return (planes[0] if planes else None), (first.stiffness, first.damping)


def _coefficients(plane: HalfSpaceCollider) -> np.ndarray:
    """Return a, b, c, d of a x + b y + c z + d = 0: as given where six decimals hold them, or else of length 1."""
    coefficients = np.array([*plane.normal, -np.dot(plane.center, plane.normal)])
    # The tolerances are for the rounding of d alone, which follows from the centre.
    held = np.allclose(np.round(coefficients, 6), coefficients, rtol=1e-9, atol=1e-12)
    return coefficients if held and abs(coefficients[3]) <= MAX_MAGNITUDE else coefficients / math.hypot(*plane.normal)


def _grid(scene: Scene, mass: float) -> np.ndarray:
    """Return the forces of gravity and all fields at the nodes, float64 [R, R, R, 3], N; empty without any."""
    everywhere = mass * scene.gravity_vector
    for weight in everywhere:
        _written(weight, "gravity times particle_mass")
    grid = None
    for i, field in enumerate(scene.fields):
        key = f"fields.{i}"
        _require(field.curve is None, f"{key}.curve", "is given; a field of a world is constant in time")
        if isinstance(field, ConstantField):
            for component in field.force:
                _written(component, f"{key}.force")
            everywhere = everywhere + field.force
        elif isinstance(field, GridField):
            fits = field.lower == (-BOX_REACH,) * 3 and field.upper == (BOX_REACH,) * 3
            _require(fits, key, "is not a grid over the box from -2 to 2")
            _require(field.outside == "clamp", f"{key}.outside", "is not clamp")
            _require(grid is None, key, "is a second grid; a world has at most one")
            grid = field.nodes()
            _require(bool(grid.round(6).any() or not grid.any()), key, "is 0 with the six decimals of the format")
            _require(len(grid) <= MAX_RESOLUTION, key, f"has more than {MAX_RESOLUTION} nodes along an axis")
        else:
            raise _unfit(f"{key}.type", f"is {field.type}; a world has constant and grid fields")
    if grid is not None:
        return grid + everywhere
    # Two nodes along each axis hold a force that is the same everywhere.
    return np.broadcast_to(everywhere, (2, 2, 2, 3)) if everywhere.any() else np.zeros((0, 0, 0, 3))
