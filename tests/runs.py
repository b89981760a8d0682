"""Runs of a small scene, in this process and in others, and all that they leave."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from warpjelly.scene import Scene
from warpjelly.scenefile import load_scene
from warpjelly.stage.stagefiles import open_stage

CUBE = Path(__file__).parents[1] / "scenes" / "jello_cube.toml"
SETTINGS: dict[str, Any] = {"bodies.cube.particles_per_edge": 4, "duration": 2.0}
CLIP_FRAMES = 5
# The command line with short clips, so that much is written, and maybe a limit on the size of files.
SCRIPT = f"""
import resource, signal, sys
from warpjelly import cli, plan
plan.CLIP_FRAMES = {CLIP_FRAMES}
if limit := int(sys.argv.pop(1)):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
cli.main()
"""


def small_scene(**settings: Any) -> Scene:
    """Return the scene that these runs are of, with other keys (dots as __) set."""
    return load_scene(CUBE, overrides=SETTINGS | {key.replace("__", "."): value for key, value in settings.items()})


def start_run(folder: Path, *options: object, limit: int = 0) -> subprocess.Popen[str]:
    """Start a run of the scene in a process of its own.

    Args:
        folder: the run directory.
        options: of the command.
        limit: no file may get larger than this, bytes; 0 for any.
    """
    settings = [f"--set={key}={value}" for key, value in SETTINGS.items()]
    command = [sys.executable, "-c", SCRIPT, limit, "run", CUBE, "-o", folder, "--device=cpu", *settings, *options]
    pipe = subprocess.PIPE
    return subprocess.Popen(list(map(str, command)), stdout=pipe, stderr=pipe, text=True)


def samples_of(source: Path, *, colors: bool = True) -> dict[tuple[str, float], bytes]:
    """Return every sample of a stage by path and time, with or without colours."""
    stage: Usd.Stage = open_stage(source)
    attributes = [attribute for prim in stage.Traverse() for attribute in prim.GetAuthoredAttributes()]
    return {
        (str(attribute.GetPath()), time): np.asarray(attribute.Get(time)).tobytes()
        for attribute in attributes
        if colors or "displayColor" not in attribute.GetName()
        for time in attribute.GetTimeSamples()
    }
