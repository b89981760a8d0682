"""What contact and culling cost: a cube and six colliders, and two cubes and each other, with culling and without.

python benchmarks/contacts.py

Shares are of a substep without any contact, medians over rounds in which the variants take turns, so that a machine
whose speed drifts still gives ratios that hold. Variants share their arrays: where arrays lie in memory changes the
speed of a cube of 32 particles per edge, whose rows are powers of two, by more than what is measured. The cube of 10
particles per edge with six objects is the case that the thesis "Gelatin Cubes" (USI 2023) measures.
"""

import argparse
import dataclasses
import statistics
import time
from typing import Any

from warpjelly.scene import Scene
from warpjelly.simulator import Simulator
from warpjelly.stepping import MAX_CAPTURED_SUBSTEPS, Stepper

ROUNDS = 75
# How long each variant steps in a round, s.
SLICE = 0.02
SIX_OBJECTS = [
    {"type": "plane", "normal": [0.0, 1.0, 0.0], "size": [10.0, 10.0]},
    {"type": "plane", "center": [4.0, 2.0, 0.0], "normal": [-1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "plane", "center": [-4.0, 2.0, 0.0], "normal": [1.0, 0.0, 0.0], "size": [4.0, 4.0]},
    {"type": "sphere", "center": [2.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [-2.0, 0.5, 0.0], "radius": 0.5},
    {"type": "sphere", "center": [0.0, 0.5, 3.0], "radius": 0.5},
]


def make_simulator(particles_per_edge: int, *places: list[float], **parts: Any) -> Simulator:
    """Return cubes of 1 m at some places [m]; they are pinned, so that they stay there."""
    cube = {
        "type": "cube",
        "material": "jelly",
        "particles_per_edge": particles_per_edge,
        "pinned": [{"lower": [-1.0] * 3, "upper": [1.0] * 3}],
    }
    scene = {
        "name": "contacts",
        "fps": 1000.0,
        "solver": {"dt": 1e-5},
        "materials": {"jelly": {}},
        "bodies": [{**cube, "name": f"cube_{i}", "position": place} for i, place in enumerate(places)],
        **parts,
    }
    return Simulator(Scene.model_validate(scene), device="cpu", threads=1)


def variants_of(simulator: Simulator) -> list[Stepper]:
    """Return steppers of one state: without contact, with culling, and without culling."""
    nothing = make_simulator(2, [0.0, 0.0, 0.0]).model.colliders
    free = dataclasses.replace(simulator.model, colliders=nothing, skin=None)
    return [
        Stepper(model, simulator.state, integrator="semi_implicit_euler", dt=simulator.dt, culling=culling, threads=1)
        for model, culling in ((free, True), (simulator.model, True), (simulator.model, False))
    ]


def seconds_per_substep(stepper: Stepper, count: int) -> float:
    """Time some substeps."""
    began = time.perf_counter()
    stepper.step(count)
    return (time.perf_counter() - began) / count


def measure(simulator: Simulator) -> tuple[float, float, float]:
    """Return what contact costs with culling and without, as shares, and a substep without contact, s."""
    steppers = variants_of(simulator)
    seconds_per_substep(steppers[0], 3)
    count = min(max(1, round(SLICE / seconds_per_substep(steppers[0], 3))), MAX_CAPTURED_SUBSTEPS)
    for stepper in steppers:
        stepper.step(count)
    rounds = [[seconds_per_substep(stepper, count) for stepper in steppers] for _ in range(ROUNDS)]
    culling, full = (statistics.median(times[i] / times[0] for times in rounds) - 1.0 for i in (1, 2))
    return culling, full, statistics.median(times[0] for times in rounds)


def main() -> None:
    """Print a row for each size."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print("                             far from six objects         on the ground")
    print("particles  M springs/s    culling   no culling    culling   no culling")
    for size in (8, 10, 32, 64):
        shares = []
        for height in (5.0, 0.4999):
            simulator = make_simulator(size, [0.0, height, 0.0], colliders=SIX_OBJECTS)
            culling, full, seconds = measure(simulator)
            shares += [f"{culling:+11.1%}", f"{full:+13.1%}"]
        print(f"{size}^3".rjust(9), f"{simulator.model.spring_count / seconds / 1e6:12.0f}", *shares, sep="")
    print("\n                       apart               touching            mode all")
    print("particles    culling   no culling    culling   no culling         apart")
    for size in (8, 16, 32):
        shares = []
        # Opposite particles touch at a distance of a unit cell.
        for gap in (1.0, 0.9 / (size - 1)):
            culling, full, _ = measure(make_simulator(size, [0.0, 0.0, 0.0], [1.0 + gap, 0.01, 0.02], soft_contact={}))
            shares += [f"{culling:+11.1%}", f"{full:+13.1%}"]
        both = make_simulator(size, [0.0, 0.0, 0.0], [2.0, 0.0, 0.0], soft_contact={"mode": "all"})
        print(f"2 x {size}^3".rjust(9), *shares, f"{measure(both)[0]:+14.1%}", sep="")


if __name__ == "__main__":
    main()
