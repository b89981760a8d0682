"""What a scene is said to take, against what it takes."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from worlds import make_material

from warpjelly import plan
from warpjelly.errors import SceneError
from warpjelly.model import build
from warpjelly.plan import plan_scene
from warpjelly.scene import ModelBody, Scene

# Runs a scene and prints what was planned, the greatest memory of the process, and its pages of mapped files, in bytes.
# How many of these there are is up to the kernel, so they are left out of what is planned and measured.
RUN = """
import json, sys
from pathlib import Path
from warpjelly.memory import BYTES_OF_LIBRARIES
from warpjelly.plan import plan_scene
from warpjelly.run import simulate
from warpjelly.scene import Scene
scene = Scene.model_validate(json.loads(sys.argv[1]))
planned = plan_scene(scene).memory_bytes - BYTES_OF_LIBRARIES
simulate(scene, output=sys.argv[2], device="cpu")
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(planned, *(1024 * int(status[key].split()[0]) for key in ("VmHWM", "RssFile")))
"""


def make_shell(folder: Path, thickness: float) -> Path:
    """Write a hollow ball of radius 1, and return its file."""
    outer, inner = (trimesh.creation.icosphere(subdivisions=5, radius=radius) for radius in (1.0, 1.0 - thickness))
    inner.invert()
    trimesh.util.concatenate([outer, inner]).export(folder / "shell.ply")
    return folder / "shell.ply"


def make_model(file: Path, resolution: int, **changes: Any) -> dict[str, Any]:
    """Return a scene of one model."""
    body = {"type": "model", "file": str(file), "resolution": resolution, "material": "jelly", **changes}
    materials = {name: make_material(1.0, 0.0) for name in ("jelly", "stiff")}
    return {"frames": 2, "gravity": [0.0, 0.0, 0.0], "materials": materials, "bodies": [body]}


def make_pair(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Return two scenes, of which the second takes much more of what the kind is about."""
    box, sphere = folder / "box.ply", folder / "sphere.ply"
    trimesh.creation.box().export(box)
    small, solid = make_model(box, 4), make_model(box, 96)
    if kind == "numbers":
        return [solid, solid | {"solver": {"precision": "float64", "integrator": "rk4"}}]
    if kind == "packages":
        return [small | {"bodies": [{"type": "cube", "material": "jelly", "particles_per_edge": 5}]}, small]
    if kind == "rows":
        scenes = []
        for size in (1, 5000):
            # Two cells at opposite corners of a grid of one layer.
            cells = np.zeros((size, size, 1), bool)
            cells[0, 0] = cells[-1, -1] = True
            np.savez_compressed(folder / f"corners{size}.npz", cells=cells)
            body = {"type": "voxels", "file": str(folder / f"corners{size}.npz"), "material": "jelly"}
            scenes.append(make_model(box, 4) | {"bodies": [body]})
        return scenes
    if kind == "triangles":
        trimesh.creation.icosphere(subdivisions=7).export(sphere)
        return [small, make_model(sphere, 4)]
    if kind == "points":
        return [make_model(make_shell(folder, 3 / 192), resolution, keep_thin_parts=True) for resolution in (4, 192)]
    if kind == "spans":
        # Blocks of four cells, each of one of two materials, at which springs of a kind end.
        blocks = np.random.default_rng(0).integers(0, 2, (24, 24, 24))
        np.savez(folder / "blocks.npz", cells=blocks, origin=[-0.5] * 3, cell_size=1 / 24)
        solid["bodies"][0]["regions"] = [{"grid": str(folder / "blocks.npz"), "material": "stiff"}]
    return [small, solid]


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux to measure memory")
@pytest.mark.parametrize("kind", ["packages", "particles", "numbers", "rows", "spans", "points", "triangles"])
def test_memory_is_estimated(tmp_path: Path, kind: str) -> None:
    """Plan what memory a scene takes, and how much more another one does.

    It is within 10 % where the machine has nothing else to do. With other work beside, a frame may be written before
    the next one is simulated, so that the two do not add up: the peak was 11 % below what was planned. Repeated, the
    same difference was measured 4 % more or less, as allocators keep what is freed; numbers of spans are estimates
    themselves, which left up to 4 %. What a kind is about is more than a quarter of its difference, so that nothing can
    be left out; but the spans of the law "young" are too few of any to be told apart.
    """
    runs = []
    for number, scene in enumerate(make_pair(tmp_path, kind)):
        command = [sys.executable, "-c", RUN, json.dumps(scene), str(tmp_path / f"run{number}")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        planned, peak, mapped = map(float, done.stdout.split())
        runs.append([planned, peak - mapped])
    planned, measured = (large - small for small, large in zip(*runs, strict=True))
    assert planned == pytest.approx(measured, rel=0.15)
    assert runs[0][0] == pytest.approx(runs[0][1], rel=0.15)


def test_a_body_that_cannot_fit_is_refused_before_it_is_made(tmp_path: Path, monkeypatch) -> None:
    """Refuse by numbers what needs more than there is: a solid before it is voxelised, a shell when it is counted."""
    monkeypatch.setattr(plan, "memory_limit", lambda: 3.5e9)
    box = tmp_path / "box.ply"
    trimesh.creation.box().export(box)
    with pytest.raises(SceneError, match=r"about 8,589,934,592 voxels at resolution 2,048 need about 172.\d GB .* 3.5"):
        plan_scene(Scene.model_validate(make_model(box, 2048)))
    with pytest.raises(SceneError, match=r"particles and [0-9,]+ springs need about [34].\d GB of memory, of 3.5 GB"):
        plan_scene(Scene.model_validate(make_model(make_shell(tmp_path, 3 / 704), 704)))
    assert 0.5e9 < plan_scene(Scene.model_validate(make_model(tmp_path / "shell.ply", 256))).memory_bytes < 1.2e9


@pytest.mark.parametrize(("precision", "sheets"), [("float32", 32), ("float64", 16)])
def test_more_particles_than_rows_can_hold_are_refused(precision: str, sheets: int, monkeypatch) -> None:
    """Refuse by numbers what strides of 32 bits cannot reach: rows of 2^31 bytes and the gap behind them."""
    monkeypatch.setattr(plan, "memory_limit", lambda: math.inf)
    sheet = {"type": "cloth", "material": "jelly", "size": [1.0, 1.0], "particles": [4096, 4096]}
    scene = {"materials": {"jelly": make_material()}, "solver": {"precision": precision}}
    assert plan_scene(Scene.model_validate({**scene, "bodies": [sheet] * (sheets - 1)})).memory_bytes > 0
    with pytest.raises(SceneError, match=rf"^{sheets * 4096**2:,} particles are more than the [0-9,]+ that arrays can"):
        plan_scene(Scene.model_validate({**scene, "bodies": [sheet] * sheets}))


def test_bodies_that_are_made_alike_are_made_once(tmp_path: Path, monkeypatch) -> None:
    """Read and voxelise a model once for all bodies that differ in their places only; each becomes what it is alone."""
    box = tmp_path / "box.ply"
    trimesh.creation.box(extents=(1.0, 0.7, 0.4)).export(box)
    scene = make_model(box, 6, name="plain")
    (first,) = scene["bodies"]
    corner = {"lower": [-1.0, -1.0, -1.0], "upper": [-0.3, -0.3, 0.0]}
    changes: list[dict[str, Any]] = [
        {"name": "turned", "position": [2.0, 0.0, 0.0], "rotation": [10.0, 20.0, 30.0]},
        {"name": "pinned", "pinned": [corner], "velocity": [0.0, 1.0, 0.0], "angular_velocity": [1.0, 0.0, 0.0]},
        {"name": "finer", "resolution": 9},
        {"name": "stiff", "material": "stiff"},
        {"name": "again"},
    ]
    bodies = [first, *({**first, **change} for change in changes)]
    voxelized = []
    voxelize_model = plan.voxelize_model

    def count(body: ModelBody, **options: Any) -> plan.VoxelizedModel:
        voxelized.append(body.name)
        return voxelize_model(body, **options)

    monkeypatch.setattr(plan, "voxelize_model", count)
    together, state = build(plan_scene(Scene.model_validate({**scene, "bodies": bodies})), device="cpu")
    assert voxelized == ["plain", "finer"]
    spans, classes, first_class = together.spans.numpy(), together.spring_classes.numpy(), 0
    for part, body in zip(together.bodies, bodies, strict=True):
        alone, start = build(plan_scene(Scene.model_validate({**scene, "bodies": [body]})), device="cpu")
        own = spans[(spans[:, 0] >= part.particles.start) & (spans[:, 0] < part.particles.stop)]
        offset = [part.particles.start, part.particles.start, 0, first_class]
        np.testing.assert_array_equal(own, alone.spans.numpy() + offset)
        last_class = first_class + len(alone.spring_classes)
        np.testing.assert_array_equal(classes[first_class:last_class], alone.spring_classes.numpy())
        first_class = last_class
        for several, single in ((state.x, start.x), (state.v, start.v)):
            np.testing.assert_array_equal(several.numpy()[:, part.particles], single.numpy())
        inverse = together.particle_inv_mass.numpy()[part.particles]
        np.testing.assert_array_equal(inverse, alone.particle_inv_mass.numpy())
    assert first_class == len(classes)
