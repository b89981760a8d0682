"""What is loaded and compiled before a command answers."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

CUBE = Path(__file__).parents[1] / "scenes" / "jello_cube.toml"

HELP = """
import json, sys
from warpjelly import cli
cli.app(["--help"], standalone_mode=False)
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""

# Runs a scene, and prints of each module of kernels that was loaded which kernels it has; of generic ones, those that
# were launched, which are all that Warp compiles.
RUN = """
import importlib, json, pkgutil, sys
import warp as wp
import warpjelly.kernels
from warpjelly.run import simulate
from warpjelly.scenefile import load_scene
simulate(load_scene(sys.argv[1], frames=2), output=sys.argv[2], device="cpu")
modules = [wp.get_module(f"warpjelly.kernels.{m.name}") for m in pkgutil.iter_modules(warpjelly.kernels.__path__)]
print(json.dumps({
    module.name.rpartition(".")[2]: [k.key for k in module.kernels.values() if not k.is_generic or k.overloads]
    for module in modules if module.execs
}))
"""


def last_line(script: str, *arguments: object) -> object:
    """Run a script in a process of its own and return what its last line says, JSON."""
    command = [sys.executable, "-c", script, *map(str, arguments)]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


def test_help_loads_nothing_heavy() -> None:
    """Show the help without a package that takes long to import."""
    loaded = last_line(HELP)
    assert {"typer", "warpjelly"} <= set(loaded)
    assert not {"numpy", "warp", "pxr", "pydantic", "trimesh", "pyvista", "matplotlib"} & set(loaded)


def test_a_cube_compiles_what_it_needs(tmp_path: Path) -> None:
    """Load no kernels of models, pairs and fields for a cube that falls on a floor, and none of what it does not do."""
    compiled = last_line(RUN, CUBE, tmp_path / "run")
    assert {"voxels", "embedding", "pairs"}.isdisjoint(compiled)
    assert compiled["fields"] == ["set_gravity_forces"]
    assert "runge_kutta_stage" not in compiled["integrators"]
    assert {"lattices", "springs", "contacts", "integrators", "diagnostics", "shapes"} <= set(compiled)
