"""What writing the stage takes: time and memory, for a surface with normals and colours that all change in every frame.

python benchmarks/stage.py [POINTS [FRAMES]]

POINTS (200,000 unless given) on the surface, FRAMES (200 unless given) at most. Memory is what the process holds at
most, without files that the system maps into it and takes back when it needs to. Then a cloth of so many points is
simulated with 100 substeps a frame, with and without its stage.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from warpjelly.run import simulate
from warpjelly.scene import Scene
from warpjelly.shapes import SURFACE, Shape, ShapeFrame
from warpjelly.simulator import Simulator
from warpjelly.stage.stagewriter import StageWriter

SUBSTEPS = 100
FRAMES_SIMULATED = 25


def own_memory() -> float:
    """Return the memory of the process that no file stands behind, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1e3


def make_scene(points: int, frames: int) -> Scene:
    """Return a scene of a falling cloth of about so many points, with a range of forces to be found."""
    side = round(math.sqrt(points))
    body = {"name": "cloth", "type": "cloth", "material": "m", "size": [1.0, 1.0], "particles": [side, side]}
    springs = {kind: {"stiffness": 10.0, "damping": 0.01} for kind in ("structural", "shear", "bend")}
    data = {"materials": {"m": {"law": "hooke", **springs}}, "bodies": [body], "solver": {"dt": 1.0 / (60 * SUBSTEPS)}}
    return Scene.model_validate({**data, "frames": frames})


def strip(points: int) -> Shape:
    """Return a surface of quads between two rows of points."""
    columns = np.arange(points // 2 - 1, dtype=np.int32)
    quads = np.stack([columns, columns + 1, columns + 1 + points // 2, columns + points // 2], axis=1)
    everyone = np.arange(points, dtype=np.int32)[:, None]
    ones = np.ones((points, 1), np.float32)
    return Shape("cloth", SURFACE, everyone, ones, np.full(len(quads), 4, np.int32), quads.ravel())


def write_stage(points: int, frames: int, folder: Path) -> None:
    """Write a stage of so many frames, and print what it takes on the way."""
    rng = np.random.default_rng(0)
    start, normals = (rng.random((points, 3), dtype=np.float32) for _ in range(2))
    forces = rng.random(points, dtype=np.float32)

    def frame(index: int) -> ShapeFrame:
        shift = np.float32(1e-3 * index)
        return ShapeFrame(start + shift, normals + shift, start, forces + shift)

    writer = StageWriter(
        folder, scene=make_scene(points, frames), shapes=[strip(points)], rest=[frame(0)], provenance={}
    )
    print(f"{points:,} points, clips of {writer.clip_length} frames; {own_memory():.0f} MB before the first frame")
    writing, most = 0.0, 0.0
    for index in range(frames):
        sample = frame(index)
        began = time.perf_counter()
        writer.write_frame(index, [sample])
        most = max(most, own_memory())
        if (index + 1) % writer.clip_length == 0:
            writer.flush()
        writing += time.perf_counter() - began
        if index + 1 in (frames // 8, frames // 4, frames // 2, frames):
            print(f"  {index + 1:5} frames  {writing / (index + 1) * 1e3:6.1f} ms a frame  {most:6.0f} MB")
    began = time.perf_counter()
    writer.finish()
    print(f"  one file      {(time.perf_counter() - began) / frames * 1e3:6.1f} ms a frame  {own_memory():6.0f} MB")


def simulate_with_stage(points: int, folder: Path) -> None:
    """Print which share of the time of a run its stage takes, by the best of three."""
    scene = make_scene(points, FRAMES_SIMULATED)
    alone, whole = [], []
    for _ in range(3):
        sim = Simulator(scene, device="auto")
        sim.prepare()
        began = time.perf_counter()
        for _ in range(FRAMES_SIMULATED - 1):
            sim.advance_frame()
            # For the metrics, which any run has.
            sim.diagnostics()
        alone.append((time.perf_counter() - began) / (FRAMES_SIMULATED - 1))
        points = len(sim.model.shapes[0].particles)
        del sim
        record = simulate(scene, output=folder, force=True).record
        whole.append(record["wall_seconds"] / (FRAMES_SIMULATED - 1))
    print(f"cloth of {points:,} points, {SUBSTEPS} substeps a frame on {record['device']}:")
    share = min(whole) / min(alone) - 1
    print(f"  {min(alone):.2f} s a frame without a stage, {min(whole):.2f} s with it: {share:.1%} more")


def main() -> None:
    """Print figures for writing alone, and beside a simulation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("points", metavar="POINTS", nargs="?", type=int, default=200_000, help="of a surface (200,000)")
    parser.add_argument("frames", metavar="FRAMES", nargs="?", type=int, default=200, help="of a stage (200)")
    points, frames = vars(parser.parse_args()).values()
    if points < 4 or frames < 8:
        parser.error(f"POINTS {points}, FRAMES {frames}: at least 4 and 8")
    with tempfile.TemporaryDirectory(dir=".") as folder:
        write_stage(points, frames, Path(folder) / "written")
        simulate_with_stage(points, Path(folder) / "simulated")


if __name__ == "__main__":
    main()
