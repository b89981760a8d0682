"""What contact and culling cost: a cube far from six colliders and on the ground, with culling and without.

python benchmarks/contacts.py

Shares are of a substep without any collider, medians over rounds in which the variants take turns, so that a machine
whose speed drifts still gives ratios that hold. Variants share their arrays: where arrays lie in memory changes the
speed of a cube of 32 particles per edge, whose rows are powers of two, by more than what is measured. The cube of 10
particles per edge with six objects is the case that the thesis "Gelatin Cubes" (USI 2023) measures.
"""

import copy
import dataclasses
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


def make_simulator(particles_per_edge: int, *, height: float, colliders: bool = True) -> Simulator:
    """Return a cube of 1 m at some height [m], whose steps are so short that it stays there."""
    scene = {
        "name": "contacts",
        "fps": 1000.0,
        "solver": {"dt": 1e-5},
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


def make_variants(particles_per_edge: int, *, height: float) -> list[Simulator]:
    """Return one cube without colliders, with them, and with them but without culling."""
    culled = make_simulator(particles_per_edge, height=height)
    free, full = copy.copy(culled), copy.copy(culled)
    nothing = make_simulator(2, height=height, colliders=False).model.colliders
    free.model = dataclasses.replace(culled.model, colliders=nothing)
    full.scene = culled.scene.model_copy(update={"solver": culled.scene.solver.model_copy(update={"culling": False})})
    for variant in (free, full):
        variant._graphs = {}
    return [free, culled, full]


def seconds_per_substep(simulator: Simulator, count: int) -> float:
    """Time some substeps."""
    began = time.perf_counter()
    simulator.step(count)
    return (time.perf_counter() - began) / count


def measure(variants: list[Simulator]) -> list[list[float]]:
    """Return the seconds per substep of each variant, round by round."""
    for simulator in variants:
        simulator.prepare()
        simulator.step()
    count = max(1, round(SLICE / seconds_per_substep(variants[0], 3)))
    return [[seconds_per_substep(simulator, count) for simulator in variants] for _ in range(ROUNDS)]


def share(rounds: list[list[float]], variant: int) -> str:
    """Return what a variant costs more than the first one."""
    return f"{statistics.median(times[variant] / times[0] for times in rounds) - 1:+.1%}"


def main() -> None:
    """Print a row for each size."""
    print("particles  million springs/s       far    far, no culling    on the ground    on the ground, no culling")
    for size in (8, 10, 32, 64):
        shares = []
        for height in (5.0, 0.4999):
            variants = make_variants(size, height=height)
            rounds = measure(variants)
            shares += [share(rounds, 1), share(rounds, 2)]
            speed = variants[0].model.spring_count / statistics.median(times[0] for times in rounds) / 1e6
        columns = "".join(column.rjust(width) for column, width in zip(shares, (10, 19, 17, 29), strict=True))
        print(f"{size}^3".rjust(9), f"{speed:18.0f}", columns, sep="")


if __name__ == "__main__":
    main()
