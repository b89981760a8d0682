"""What contact and culling cost: a cube far from six colliders and on the ground, with culling and without.

python benchmarks/contacts.py

Shares are of a substep without any collider, medians over rounds in which the variants take turns, so that a machine
whose speed drifts still gives ratios that hold. The cube of 10 particles per edge with six objects is the case that the
thesis "Gelatin Cubes" (USI 2023) measures.
"""

import statistics
import time

from warpjelly.scene import Scene
from warpjelly.simulator import Simulator

ROUNDS = 15
# How long each variant steps in a round, s.
SLICE = 0.1
SIX_OBJECTS = [
    {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [10.0, 10.0]},
    {"type": "plane", "center": [4.0, 2.0, 0.0], "normal": [-1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "plane", "center": [-4.0, 2.0, 0.0], "normal": [1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "sphere", "center": [2.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [-2.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [0.0, 0.5, 3.0], "radius": 0.5},
]


def make_simulator(particles_per_edge: int, *, height: float, colliders: bool, culling: bool = True) -> Simulator:
    """Return a cube of 1 m at some height [m], whose steps are so short that it stays there."""
    scene = {
        "name": "contacts",
        "fps": 1000.0,
        "solver": {"dt": 1e-5, "culling": culling},
        "materials": {"jelly": {}},
        "bodies": [
            {
                "type": "cube",
                "material": "jelly",
                "particles_per_edge": particles_per_edge,
                "position": [0.0, height, 0.0],
            }
        ],
        "colliders": SIX_OBJECTS if colliders else [],
    }
    return Simulator(Scene.model_validate(scene), device="cpu")


def seconds_per_substep(simulator: Simulator, count: int) -> float:
    """Time some substeps."""
    began = time.perf_counter()
    simulator.step(count)
    return (time.perf_counter() - began) / count


def main() -> None:
    """Print a row for each size."""
    print("particles  million springs/s       far    far, no culling    on the ground    on the ground, no culling")
    for size in (8, 10, 32, 64):
        variants = [
            make_simulator(size, height=5.0, colliders=False),
            make_simulator(size, height=5.0, colliders=True),
            make_simulator(size, height=5.0, colliders=True, culling=False),
            make_simulator(size, height=0.4999, colliders=True),
            make_simulator(size, height=0.4999, colliders=True, culling=False),
        ]
        for simulator in variants:
            simulator.step()
        count = max(1, round(SLICE / seconds_per_substep(variants[0], 3)))
        rounds = [[seconds_per_substep(simulator, count) for simulator in variants] for _ in range(ROUNDS)]
        free = statistics.median(times[0] for times in rounds)
        shares = [statistics.median(times[i] / times[0] for times in rounds) - 1 for i in range(1, len(variants))]
        speed = variants[0].model.spring_count / free / 1e6
        columns = [f"{share:+.1%}" for share in shares]
        print(
            f"{size}^3".rjust(9), f"{speed:18.0f}", *(c.rjust(w) for c, w in zip(columns, (9, 18, 16, 28), strict=True))
        )


if __name__ == "__main__":
    main()
