"""Every kernel compiles ahead of time for GPUs, on a machine that has none."""

from __future__ import annotations

import importlib
import itertools
import json
import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from worlds import make_scene

import warpjelly.kernels
from warpjelly.cells import Cells
from warpjelly.device import start_warp
from warpjelly.kernels import springs
from warpjelly.simulator import Simulator
from warpjelly.voxelize import find_pieces, voxelize

ARCHITECTURES = (80, 90)


def launch_everything() -> None:
    """Launch every kernel on the CPU in both precisions, so that Warp knows what to compile."""
    colliders = [
        {"type": "half_space", "normal": [0.0, 1.0, 0.0]},
        {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [1.0, 1.0]},
        {"type": "sphere", "radius": 1.0},
        {"type": "box", "size": [1.0, 1.0, 1.0]},
    ]
    cube = {"type": "cube", "material": "jelly", "particles_per_edge": 2}
    bodies = [cube, {**cube, "position": [3.0, 0.0, 0.0]}]
    parts = {
        "bodies": bodies,
        "soft_contact": {},
        "colliders": colliders,
        "fields": [{"type": "constant", "force": [0.0, 0.0, 0.0]}],
    }
    for precision, integrator in itertools.product(("float32", "float64"), ("rk4", "semi_implicit_euler")):
        solver = {"precision": precision, "integrator": integrator}
        simulator = Simulator(make_scene(**parts, solver=solver), device="cpu", interactive=True)
        simulator.step()
        simulator.first_lost()
        simulator.diagnostics()
        simulator.shapes()
        # The kernel of the springs on a GPU.
        model, state = simulator.model, simulator.state
        wp.launch(
            springs.add_spring_forces,
            dim=(len(model.spans), springs.MAX_SPAN),
            inputs=[model.spans, model.spring_classes, state.x, state.v, model.real(0.0)],
            outputs=[state.f, state.spring_losses],
            device="cpu",
        )
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    voxelize(triangle, 2, method="vote", device="cpu")
    find_pieces(Cells.of(np.ones((1, 1, 1), bool)))


def precisions_of(kernel: wp.Kernel) -> list[str]:
    """Return the types that stand for the Any of a generic kernel's arrays."""
    generic = [i for i, arg in enumerate(kernel.adj.args) if wp.types.is_array(arg.type) and "Any" in str(arg.type)]
    found = set()
    for overload in kernel.overloads.values():
        dtypes = [overload.adj.args[i].type.dtype for i in generic]
        found |= {getattr(dtype, "_wp_scalar_type_", dtype).__name__ for dtype in dtypes}
    return sorted(found)


def compile_everything(folder: Path) -> dict[str, Any]:
    """Compile every module in kernels/ for both architectures; return what each kernel was compiled for."""
    start_warp()
    names = [module.name for module in pkgutil.iter_modules(warpjelly.kernels.__path__)]
    for name in names:
        importlib.import_module(f"warpjelly.kernels.{name}")
    launch_everything()
    report = {}
    for name in names:
        module = wp.get_module(f"warpjelly.kernels.{name}")
        if not module.kernels:
            continue
        files = wp.compile_aot_module(module, arch=ARCHITECTURES, module_dir=folder / name, use_ptx=True)
        texts = {file.name: file.read_text() for file in map(Path, files)}
        report[name] = {
            kernel.key: {
                "precisions": precisions_of(kernel) if kernel.is_generic else None,
                "compiled": {
                    file: all(
                        f"{variant.get_mangled_name()}_cuda_kernel_forward" in text
                        for variant in (kernel.overloads.values() if kernel.is_generic else [kernel])
                    )
                    for file, text in texts.items()
                },
            }
            for kernel in module.kernels.values()
        }
    return report


def test_every_kernel_compiles_for_gpus(tmp_path: Path) -> None:
    """Compile every kernel, in both precisions where it is generic, to code for each architecture."""
    # In its own process: there, only this file has launched kernels.
    child = subprocess.run([sys.executable, __file__, str(tmp_path)], capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    sources = {
        path.stem for path in Path(warpjelly.kernels.__path__[0]).glob("*.py") if "\n@wp.kernel" in path.read_text()
    }
    assert set(report) == sources
    for module, kernels in report.items():
        for name, kernel in kernels.items():
            # A kernel that is launched nowhere above is compiled for nothing.
            assert kernel["precisions"] in (None, ["float32", "float64"]), f"{module}.{name}"
            assert len(kernel["compiled"]) == len(ARCHITECTURES), f"{module}.{name}"
            for architecture in ARCHITECTURES:
                files = [file for file in kernel["compiled"] if f"sm{architecture}" in file]
                assert [kernel["compiled"][file] for file in files] == [True], f"{module}.{name}: sm{architecture}"


if __name__ == "__main__":
    target = Path(sys.argv[1])
    (target / "report.json").write_text(json.dumps(compile_everything(target)))
