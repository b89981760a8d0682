"""What building takes: voxels of a model of 82,000 triangles, lattices of solid grids, and models that are sparse.

python benchmarks/building.py [LARGEST]

LARGEST (256 unless given) is the most cells along an edge. Solid lattices of more than 256 would take gigabytes and are
left out; a shell of 1024 takes two. Times of voxels are the best of three, compile time apart; bytes are what the peak
of the process's memory rose by, so sizes grow from row to row.

Sparse models are a shell one and a half cells thick, which has about 5 N^2 cells, and a wire around a cylinder, five
cells thick, of some 200 N cells. Their cost should grow like that, and not like N^3.
"""

import argparse
import resource
import time
from collections.abc import Callable

import numpy as np
import trimesh

from warpjelly.cells import Cells
from warpjelly.lattice import Lattice, build_lattice, count_lattice
from warpjelly.voxelize import voxelize


def make_triangles() -> np.ndarray:
    """Return the corners of a bumpy ball, [81920, 3, 3]."""
    ball = trimesh.creation.icosphere(subdivisions=6)
    x, y, _ = ball.vertices.T
    return (ball.vertices * (1 + 0.2 * np.sin(5 * y) * np.cos(7 * x))[:, None])[ball.faces]


def make_shell(size: int) -> np.ndarray:
    """Return the corners of a hollow ball, 1.5 of its cells thick, [163840, 3, 3]."""
    inner = trimesh.creation.icosphere(subdivisions=6)
    outer = np.asarray(inner.triangles)
    return np.concatenate([outer, (1.0 - 3.0 / size) * outer[:, ::-1]])


def make_wire(size: int) -> np.ndarray:
    """Return the corners of a wire of six turns, 2.5 of its cells thick, [96000, 3, 3]."""
    along, around = np.linspace(0.0, 1.0, 6001)[:, None], np.linspace(0.0, 2 * np.pi, 9)
    turn = 12 * np.pi * along
    radius = 0.5 + 2.5 / size * np.cos(around)
    points = np.stack([radius * np.cos(turn), radius * np.sin(turn), 2 * along + 2.5 / size * np.sin(around)], axis=-1)
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    return np.concatenate([np.stack(corners, axis=2).reshape(-1, 3, 3) for corners in ((a, b, c), (a, c, d))])


def measure(work: Callable[[], object], times: int = 1) -> float:
    """Return the shortest time that some work takes, s."""
    seconds = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def peak() -> int:
    """Return the greatest memory of the process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def build(cells: Cells) -> Lattice:
    """Return the lattice of some cells."""
    return build_lattice(cells, origin=np.zeros(3), cell_size=1.0)


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "largest", metavar="LARGEST", nargs="?", type=int, default=256, help="cells along an edge (256)"
    )
    if (largest := parser.parse_args().largest) < 32:
        parser.error(f"LARGEST {largest}: at least 32")
    sizes = [size for size in (32, 64, 128, 256, 512, 1024) if size <= largest]
    triangles = make_triangles()
    voxelize(triangles, 8)
    build(Cells.of(np.ones((2, 2, 2), bool)))
    print(f"{'cells':>8}  {'voxels of a model':>18}  {'solid lattice':>14}  {'bytes per cell':>14}  {'springs':>14}")
    for size in sizes:
        columns = [f"{size}^3".rjust(8), f"{measure(lambda size=size: voxelize(triangles, size), 3):16.3f} s"]
        if size <= 256:
            before, solid = peak(), Cells.of(np.ones((size, size, size), bool))
            began = time.perf_counter()
            springs = build(solid).spring_count
            seconds = time.perf_counter() - began
            columns += [f"{seconds:12.2f} s", f"{(peak() - before) / size**3:14.0f}", f"{springs:14,}"]
        print("  ".join(columns))
    print(
        f"\n{'sparse':>12}  {'voxels':>10}  {'found in':>10}  {'counted in':>10}  {'lattice':>10}  {'peak so far':>11}"
    )
    for make in (make_wire, make_shell):
        for size in sizes[1:]:
            model = make(size)
            cells = voxelize(model, size).cells
            work = (
                lambda model=model, size=size: voxelize(model, size),
                lambda cells=cells: count_lattice(cells),
                lambda cells=cells: build(cells),
            )
            seconds = "  ".join(f"{measure(part):8.3f} s" for part in work)
            name = f"{make.__name__.removeprefix('make_')} {size}^3"
            print(f"{name:>12}  {cells.count:10,}  {seconds}  {peak() / 1e9:8.2f} GB")


if __name__ == "__main__":
    main()
