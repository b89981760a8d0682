"""What a batch saves: runs of a cube of 8^3 particles, 60 frames each, with their stages.

python benchmarks/batch.py [RUNS]

The same runs are done by `warpjelly batch` with one worker and with two, and by a `warpjelly run` for each, one after
another; all are whole processes, from the start of Python to the last file. Kernels are compiled before.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENE = Path(__file__).parents[1] / "scenes" / "jello_cube.toml"
FRAMES = 60
# Beside runs that take turns with each other, a machine whose speed drifts still gives ratios that hold.
ROUNDS = 2


def measure(*arguments: object) -> float:
    """Return how long a command takes, s."""
    command = [sys.executable, "-m", "warpjelly.cli", *map(str, arguments), "--device=cpu", "--quiet"]
    began = time.perf_counter()
    subprocess.run(command, check=True)
    return time.perf_counter() - began


def main() -> None:
    """Print times and their ratios, the best of several rounds."""
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    with tempfile.TemporaryDirectory(dir=".") as name:
        folder = Path(name).absolute()
        sweep = folder / "sweep.toml"
        vary = f'[vary]\n"materials.jelly.structural.stiffness" = {{ range = [50.0, 200.0], count = {runs} }}\n'
        sweep.write_text(f"base = '{SCENE}'\n{vary}")
        measure("run", SCENE, f"--frames={FRAMES}", f"--output={folder / 'first'}")
        batch = ["batch", sweep, f"--frames={FRAMES}", f"--output={folder / 'batch'}", "--force"]
        times: dict[str, list[float]] = {"one worker": [], "two workers": [], "separate runs": []}
        for _ in range(ROUNDS):
            times["one worker"].append(measure(*batch, "--workers=1"))
            times["two workers"].append(measure(*batch, "--workers=2"))
        single = ["run", SCENE, f"--frames={FRAMES}", f"--output={folder / 'single'}", "--force"]
        times["separate runs"].append(sum(measure(*single) for _ in range(runs)))
    best = {what: min(taken) for what, taken in times.items()}
    for what, taken in times.items():
        print(f"{what:<14} {', '.join(f'{seconds:.1f}' for seconds in taken)} s, {best[what] / runs:.3f} s a run")
    print(f"two workers are {best['one worker'] / best['two workers']:.2f} times as fast as one,")
    print(f"and {best['separate runs'] / best['two workers']:.1f} times as fast as separate runs")


if __name__ == "__main__":
    main()
