"""What a batch saves: runs of a cube of 8^3 particles, dropped from as many heights, 60 frames each, with their stages.

python benchmarks/batch.py [RUNS]

The same runs are done by `warpjelly batch` with one worker and with two, and by a `warpjelly run` for each, one after
another, of which some are enough; all are whole processes, from the start of Python to the last file. Kernels are
compiled before. Pictures for the page of the batch are left out, as a single run has none.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENE = Path(__file__).parents[1] / "scenes" / "jello_cube.toml"
FRAMES = 60
# So many of the separate runs are done.
SEPARATE = 20


def measure(*arguments: object) -> float:
    """Return how long a command takes, s."""
    command = [sys.executable, "-m", "warpjelly.cli", *map(str, arguments), "--device=cpu", "--quiet"]
    began = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - began


def main() -> None:
    """Print times and their ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", metavar="RUNS", nargs="?", type=int, default=100, help="how many runs (100)")
    if (runs := parser.parse_args().runs) < 1:
        parser.error(f"RUNS {runs}: at least 1")
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name).absolute()
        sweep = folder / "sweep.toml"
        vary = f'[vary]\n"bodies.cube.position.1" = {{ range = [1.0, 2.0], count = {runs} }}\n'
        sweep.write_text(f"base = '{SCENE}'\n{vary}")
        measure("run", SCENE, f"--frames={FRAMES}", f"--output={folder / 'first'}")
        batch = ["batch", sweep, f"--frames={FRAMES}", f"--output={folder / 'batch'}", "--force", "--no-pictures"]
        # The separate runs before and after, as the speed of machines drifts.
        single = ["run", SCENE, f"--frames={FRAMES}", f"--output={folder / 'single'}", "--force"]
        alone = sum(measure(*single) for _ in range(SEPARATE // 2))
        one, two = (measure(*batch, f"--workers={workers}") for workers in (1, 2))
        alone = (alone + sum(measure(*single) for _ in range(SEPARATE // 2))) * runs / SEPARATE
    for what, seconds in (("separate runs", alone), ("one worker", one), ("two workers", two)):
        print(f"{what:<14} {seconds:6.1f} s, {seconds / runs:.3f} s a run")
    print(f"two workers are {one / two:.2f} times as fast as one, and {alone / two:.1f} times as fast as separate runs")


if __name__ == "__main__":
    main()
