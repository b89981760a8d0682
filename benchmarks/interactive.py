"""How large a cube the interactive simulation moves in real time, with six objects around it and 30 snapshots a second.

python benchmarks/interactive.py [SECONDS]

Each cube falls on a floor among planes and spheres, the case that the thesis "Gelatin Cubes" (USI 2023) measures with
10 particles per edge, for SECONDS of real time (5 unless given) at a step of 1 ms, while a viewer takes every snapshot.
The real time reached is simulated over real time, 1 at best; the most is what it would be if nothing held it back. The
longest gap is that between two snapshots. An edit is a change of a stiffness while it plays, from the call until there
is a snapshot of the simulation that was built for it.
"""

import itertools
import statistics
import sys
import time

from contacts import SIX_OBJECTS

from warpjelly.gui.session import Session
from warpjelly.gui.snapshot import Snapshot
from warpjelly.scene import Scene

SIZES = (8, 10, 16, 24, 32, 36, 40, 47)
# Of the springs, N/m.
STIFFNESS = 900.0
# Simulated over real time that is out of reach.
OUT_OF_REACH = 1000.0
EDITS = 5


def make_scene(particles_per_edge: int) -> Scene:
    """Return a cube over six objects whose springs all have the same constants at any resolution, stable at 1 ms."""
    spring = {"stiffness": STIFFNESS, "damping": 0.3}
    body = {"name": "cube", "type": "cube", "material": "jelly", "particles_per_edge": particles_per_edge}
    data = {
        "fps": 50.0,
        "solver": {"dt": 1e-3},
        "materials": {"jelly": {"law": "hooke", "structural": spring, "shear": spring, "bend": spring}},
        "bodies": [{**body, "position": [0.0, 1.2, 0.0], "rotation": [0.0, 25.0, 10.0]}],
        "colliders": SIX_OBJECTS,
    }
    return Scene.model_validate(data)


def watch(session: Session, seconds: float) -> tuple[Snapshot, Snapshot, list[float]]:
    """Return the first and the last of the snapshots that come in a time, and when each comes, s."""
    first = last = session.latest()
    moments = [time.perf_counter()]
    while moments[-1] < moments[0] + seconds:
        shot = session.wait_for_newer(last.number, 60.0)
        assert shot is not None
        assert not shot.diverged
        last = shot
        moments.append(time.perf_counter())
    return first, last, moments


def seconds_of_an_edit(session: Session, stiffness: float) -> float:
    """Time a change of the stiffness while it plays."""
    shot = session.latest()
    revision, began = shot.revision, time.perf_counter()
    session.change("materials.jelly.bend.stiffness", stiffness)
    while shot.revision == revision:
        newer = session.wait_for_newer(shot.number, 60.0)
        assert newer is not None
        shot = newer
    return time.perf_counter() - began


def main() -> None:
    """Print a row for each size."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 5.0
    print("particles  springs  real time  substeps/s  snapshots/s  longest gap  most  an edit")
    for size in SIZES:
        with Session(make_scene(size), device="cpu") as session:
            session.play()
            watch(session, 1.0)
            first, last, moments = watch(session, seconds)
            passed = moments[-1] - moments[0]
            real_time = (last.time - first.time) / passed
            gaps = [after - before for before, after in itertools.pairwise(moments)]
            edits = [seconds_of_an_edit(session, STIFFNESS - i - 1) for i in range(EDITS)]
            session.speed = OUT_OF_REACH
            watch(session, 0.5)
            first, last, moments = watch(session, seconds / 2)
            most = (last.time - first.time) / (moments[-1] - moments[0])
            print(
                f"{size}^3".rjust(9),
                f"{last.springs:8d}",
                f"{real_time:9.2f}",
                f"{real_time / last.dt:11.0f}",
                f"{len(gaps) / passed:12.1f}",
                f"{max(gaps) * 1e3:9.0f} ms",
                f"{most:5.1f}",
                f"{statistics.median(edits) * 1e3:6.0f} ms",
                flush=True,
            )


if __name__ == "__main__":
    main()
