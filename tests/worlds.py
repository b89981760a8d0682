"""Scenes for tests, and simulators in a given state."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warpjelly.scene import Scene
from warpjelly.simulator import Simulator

# Particle steps that a test of every scene spends on one, about 3 s: all there are but of the coupler, which is down by
# then.
MOST_WORK = 2e7
# Scenes of a million voxels: tests make them of fewer and heavier particles, and the floor as much stiffer. As they are
# benchmarks/scale.py runs them, like the larger ones, which say the same but for these keys.
FEWER_VOXELS = {
    f"stress_{body}_1m": {
        f"bodies.{body}.resolution": resolution,
        "colliders.floor.stiffness": 3e6 * mass,
        "colliders.floor.damping": 1e3 * mass,
    }
    for body, resolution, mass in (("block", 20, 0.125), ("scaffold", 40, 0.061))
}
LARGER = {name.replace("_1m", size): name for name in FEWER_VOXELS for size in ("_10m", "_100m")}


def make_material(stiffness: float = 400.0, damping: float = 0.6, **changes: Any) -> dict[str, Any]:
    """Return a material with the same constants for every kind of spring."""
    constants = {"stiffness": float(stiffness), "damping": float(damping)}
    return {"structural": constants, "shear": constants, "bend": constants, **changes}


def make_scene(*, solver: dict[str, Any] | None = None, **changes: Any) -> Scene:
    """Return a scene of one cube of 8 particles in free flight at 1000 steps/s, with top-level keys replaced."""
    data: dict[str, Any] = {
        "name": "test",
        "fps": 100.0,
        "frames": 2,
        "gravity": [0.0, 0.0, 0.0],
        "materials": {"jelly": make_material()},
        "contact": {"static_friction": 0.0, "dynamic_friction": 0.0},
        "soft_contact": {"mode": "off"},
        "bodies": [{"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": 2}],
    }
    return Scene.model_validate({**data, "solver": {"dt": 1e-3, "precision": "float64", **(solver or {})}, **changes})


def make_voxels(cells: np.ndarray, **changes: Any) -> dict[str, Any]:
    """Return a body of jelly cubes from cells [x, y, z]: 0 for none, 1 for #, 2 to 9 for symbols a to h of regions."""
    layers = [["".join(".#abcdefgh"[int(c)] for c in row) for row in layer] for layer in cells.transpose(1, 2, 0)]
    return {"type": "voxels", "material": "jelly", "layers": layers, **changes}


def set_state(simulator: Simulator, *, x: np.ndarray | None = None, v: np.ndarray | None = None) -> None:
    """Put the particles elsewhere, as if they had always been there, [particle_count, 3] each."""
    for rows, values in ((simulator.state.x, x), (simulator.state.x_start, x), (simulator.state.v, v)):
        if values is not None:
            rows.assign(np.ascontiguousarray(np.asarray(values).T))


def substeps_of(scene: Scene) -> int:
    """Return the substeps per frame of a scene whose step is a number."""
    assert scene.solver.dt != "auto"
    return scene.substeps_for(scene.solver.dt)


def step_of(scene: Scene) -> float:
    """Return the time step of a scene, s."""
    return scene.dt_for(substeps_of(scene))


def frames_of(simulator: Simulator) -> int:
    """Return how many frames a test of every scene simulates."""
    work = len(simulator.masses) * simulator.substeps
    return min(simulator.scene.frame_count - 1, math.ceil(MOST_WORK / work))
