"""One run, bit for bit."""

from __future__ import annotations

import hashlib
import json
import platform
from pathlib import Path

import pytest
import warp as wp
from worlds import make_material, make_scene

from warpjelly.simulator import Simulator

GOLDEN = Path(__file__).with_name("golden.json")


def test_positions_are_those_of_earlier_versions() -> None:
    """Drop a turned cube on a plane and find the recorded bits after 50 ms."""
    body = {
        "type": "cube", "material": "jelly", "particles_per_edge": 8, "size": 0.5,
        "position": [0.0, 0.4, 0.0], "rotation": [20.0, 30.0, 40.0], "velocity": [0.0, -4.0, 0.0],
    }  # fmt: skip
    scene = make_scene(
        bodies=[body],
        colliders=[
            {"type": "plane", "normal": [0.1, 1.0, 0.0], "tangent": [1.0, 0.0, 0.0], "size": [3.0, 3.0],
             "threshold": 0.1, "stiffness": 2000.0, "damping": 1.0}
        ],
        gravity=[0.0, -9.81, 0.0],
        materials={"jelly": make_material(60.0, 0.05)},
        solver={"precision": "float32", "dt": 2.5e-5},
    )  # fmt: skip
    simulator = Simulator(scene, device="cpu")
    simulator.step(2000)
    # The run is about contact: it must have one.
    assert simulator.diagnostics()["contacts"] > 0
    found = hashlib.sha256(simulator.positions.astype("<f4").tobytes()).hexdigest()
    # Warp compiles for the machine it runs on, and one with fused multiply-add rounds less often than one without:
    # that is what this key cannot see.
    key = f"{platform.machine()}-warp-{wp.config.version}"
    expected = json.loads(GOLDEN.read_text()).get(key)
    if expected is None:
        pytest.skip(f'no recorded run for this machine; add "{key}": "{found}" to {GOLDEN.name}')
    assert found == expected, f'results have changed; if on purpose, set "{key}": "{found}" in {GOLDEN.name}'
