"""A parameter study: how high a jelly cube bounces, by the stiffness and damping of its springs.

python scenes/sweeps/bounce.py [PICTURE.png]

Runs that are finished already, in outputs/bounce, are not done again. The plot needs matplotlib, which the extra
``preview`` brings.
"""

import sys
from pathlib import Path

from matplotlib import pyplot

import warpjelly as wj

HERE = Path(__file__).parent


def main() -> None:
    """Do the runs and plot them: a line for each damping, bounce height over stiffness."""
    batch = wj.run_batch(HERE / "bounce.toml", output="outputs/bounce", resume=True)
    lines: dict[float, list[tuple[float, float]]] = {}
    for run in batch.record["runs"]:
        stiffness, damping = run["parameters"]["stiffness"], run["parameters"]["damping"]
        lines.setdefault(damping, []).append((stiffness, run["figures"]["bounce"]))
    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    for damping, points in lines.items():
        axes.plot(*zip(*points, strict=True), "o-", label=f"{damping} N s")
    axes.set(xscale="log", xlabel="stiffness of the springs [N]", ylabel="bounce of the centre of mass [m]")
    axes.set_ylim(bottom=0.0)
    values = sorted({stiffness for points in lines.values() for stiffness, _ in points})
    axes.set_xticks(values, [f"{value:.3g}" for value in values])
    axes.minorticks_off()
    axes.legend(title="damping")
    picture = sys.argv[1] if len(sys.argv) > 1 else "outputs/bounce/bounce.png"
    figure.savefig(picture, dpi=120)
    print(picture)


if __name__ == "__main__":
    main()
