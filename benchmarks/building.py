"""What building takes: voxels of a model of 82,000 triangles, and lattices of solid grids.

python benchmarks/building.py [LARGEST]

LARGEST (256 unless given) is the most cells along an edge; lattices of more than 256 take gigabytes. Times are the best
of three, compile time apart; bytes are what the peak of the process's memory rose by, so sizes grow from row to row.
"""

import resource
import sys
import time
from collections.abc import Callable

import numpy as np
import trimesh

from warpjelly.lattice import build_lattice
from warpjelly.voxelize import voxelize


def make_triangles() -> np.ndarray:
    """Return the corners of a bumpy ball, [81920, 3, 3]."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    x, y, _ = ball.vertices.T
    return (ball.vertices * (1 + 0.2 * np.sin(5 * y) * np.cos(7 * x))[:, None])[ball.faces]


def best_time(work: Callable[[], object]) -> float:
    """Return the shortest of three times that some work takes, s."""
    times = []
    for _ in range(3):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times)


def peak() -> int:
    """Return the greatest memory of the process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def main() -> None:
    """Print a row for each size."""
    largest = int(sys.argv[1]) if len(sys.argv) > 1 else 256
    triangles = make_triangles()
    voxelize(triangles, 8)
    build_lattice(np.ones((2, 2, 2), bool), origin=np.zeros(3), cell_size=1.0)
    print(f"{'cells':>8}  {'voxels of a model':>18}  {'solid lattice':>14}  {'bytes per cell':>14}  {'springs':>14}")
    for size in (size for size in (32, 64, 128, 256, 512, 1024) if size <= largest):
        voxels = best_time(lambda size=size: voxelize(triangles, size))
        columns = [f"{size}^3".rjust(8), f"{voxels:16.3f} s"]
        if size <= 256:
            before, solid = peak(), np.ones((size, size, size), bool)
            began = time.perf_counter()
            lattice = build_lattice(solid, origin=np.zeros(3), cell_size=1.0)
            seconds = time.perf_counter() - began
            columns += [f"{seconds:12.2f} s", f"{(peak() - before) / size**3:14.0f}", f"{lattice.spring_count:14,}"]
        print("  ".join(columns))


if __name__ == "__main__":
    main()
