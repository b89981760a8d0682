"""Soft-body simulation: voxelised models as mass-spring jelly, written as animated USD stages.

```python
import warpjelly as wj

scene = wj.load_scene("scenes/tree_drop.toml", overrides={"solver.dt": 5e-4})
sim = wj.Simulator(scene, device="cpu")
sim.advance_frame()
wj.simulate(scene, output="outputs/tree")
```
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .batch.batch import Batch, RunsFailedError, run_batch
    from .batch.sweep import Sweep
    from .errors import DivergedError, EnvironmentFailedError, InputError, WarpjellyError
    from .run import Run, simulate
    from .scene import Scene
    from .scenefile import load_scene
    from .simulator import Simulator

# Loaded at first use, so that the command line answers at once.
_HOMES = {
    "Batch": "batch.batch",
    "DivergedError": "errors",
    "EnvironmentFailedError": "errors",
    "InputError": "errors",
    "Run": "run",
    "RunsFailedError": "batch.batch",
    "Scene": "scene",
    "Simulator": "simulator",
    "Sweep": "batch.sweep",
    "WarpjellyError": "errors",
    "load_scene": "scenefile",
    "run_batch": "batch.batch",
    "simulate": "run",
}

__all__ = [
    "Batch",
    "DivergedError",
    "EnvironmentFailedError",
    "InputError",
    "Run",
    "RunsFailedError",
    "Scene",
    "Simulator",
    "Sweep",
    "WarpjellyError",
    "load_scene",
    "run_batch",
    "simulate",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpjelly' has no attribute '{name}'")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)
