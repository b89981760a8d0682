"""What large scenes take: memory, time to build, time of a substep. Each is run whole, by `warpjelly run`.

python benchmarks/scale.py [SCENE ...]

Scenes are names of files under scenes/; without any, those of 1 and 10 million voxels. 100 million take 8 GB as a solid
block. Planned is what `warpjelly check` says of the memory, beside the peak of the process. Building is everything from
the scene to the first state.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from warpjelly.plan import plan_scene
from warpjelly.scenefile import load_scene

SCENES = Path(__file__).parents[1] / "scenes"
NAMES = [f"stress_{body}_{size}" for body in ("block", "scaffold") for size in ("1m", "10m")]


def measure(name: str) -> dict[str, float]:
    """Run a scene and return figures of it."""
    path = SCENES / f"{name}.toml"
    with tempfile.TemporaryDirectory() as folder:
        # In a process of its own, too: what planning takes must not add to what the run takes.
        pid = os.fork()
        if not pid:
            (Path(folder) / "planned").write_text(str(plan_scene(load_scene(path)).memory_bytes))
            os._exit(0)
        os.waitpid(pid, 0)
        command = [sys.executable, "-m", "warpjelly.cli", "run", str(path), "-o", f"{folder}/run", "--json", "--quiet"]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
            assert child.stdout is not None
            printed = child.stdout.read()
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            sys.exit(f"{name}: `warpjelly run` ended with exit code {child.returncode}")
        record = json.loads(printed)
        return {
            "voxels": record["voxels"],
            "particles": record["particles"],
            "springs": record["springs"],
            "planned": float((Path(folder) / "planned").read_text()),
            "peak": 1024.0 * usage.ru_maxrss,
            "build": record["build_seconds"],
            "substep": record["springs"] / record["springs_per_second"],
            "rate": record["springs_per_second"],
            "stage": float(Path(record["stage"]).stat().st_size),
            "total": time.perf_counter() - began,
        }


def main() -> None:
    """Print a row for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", metavar="SCENE", nargs="*", help=f"{', '.join(NAMES)} unless given")
    names = parser.parse_args().scenes or NAMES
    for name in names:
        if not (SCENES / f"{name}.toml").is_file():
            parser.error(f"{name}: no scene under {SCENES.name}/")
    print(
        f"{'scene':<22} {'voxels':>11} {'particles':>11} {'springs':>13} {'planned':>8} {'peak':>8} {'':>8} "
        f"{'build':>7} {'substep':>9} {'springs/s':>9} {'whole run':>9}"
    )
    for name in names:
        figures = measure(name)
        print(
            f"{name:<22} {figures['voxels']:>11,} {figures['particles']:>11,} {figures['springs']:>13,} "
            f"{figures['planned'] / 1e9:>5.2f} GB {figures['peak'] / 1e9:>5.2f} GB "
            f"{figures['peak'] / figures['particles']:>4.0f} B/p {figures['build']:>5.1f} s "
            f"{figures['substep'] * 1e3:>6.0f} ms {figures['rate'] / 1e6:>7.0f} M {figures['total']:>7.1f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
