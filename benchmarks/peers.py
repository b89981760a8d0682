"""warpjelly and its peers on the same bodies: springs per second, memory, time to the first frame, and ratios.

python benchmarks/peers.py [OBJECT ...] [--rounds N] [-o FILE.json]

Needs `pip install 'warpjelly[bench]'`; whoever is not installed is named and left out. OBJECT is a scene of
`warpjelly bench` or coupler_40; all unless given, which takes some minutes and 4 GB. Prints tables in Markdown.

All contenders get the particles, springs, constants and masses of warpjelly's model, springs in the order of its spans,
and take full steps without contact. Each is a process of its own that waits while others step; they take turns in every
round, so that drift of the machine hits all alike, and ratios are those within a round: medians, least to most. The
positions after the first frame are held against those of NumPy in float64.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata, util
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from contenders import CONTENDERS, Contender, Newton, NumPy, Taichi, Thing, Warpjelly, make_scene

from warpjelly import bench
from warpjelly.simulator import Simulator

RATIO = "warpjelly is so many times as fast"
INSTALL = "pip install 'warpjelly[bench]'"
# How long each contender steps in a round, s.
SLICE = 0.3
OBJECTS = [*(name for name in bench.SCENES if name != "cubes_100"), "coupler_40", "cubes_100"]
# Times as fast as a peer, in a full step on two cores.
TARGETS = {
    (Newton, "cube_8"): 4.0,
    (Newton, "cube_64"): 10.0,
    (Newton, "cube_128"): 12.0,
    (Taichi, "cube_64"): 6.0,
    (Taichi, "cube_128"): 6.0,
}


def write_thing(name: str, folder: Path) -> None:
    """Write the arrays of an object."""
    Thing.of(Simulator(make_scene(name), device="cpu")).save(folder)


def serve(connection: Connection, kind: type[Contender], name: str, folder: Path, began: float) -> None:
    """Make the first frame of an object, write its positions, and then time as many steps as the parent asks for."""
    contender = kind(Thing.load(folder), make_scene(name))
    contender.step(bench.STEPS_PER_FRAME)
    ready = time.time() - began
    np.save(folder / f"{kind.__name__}.npy", contender.positions())
    connection.send({"first_frame_seconds": ready, "bytes": bench.held_bytes(contender)})
    while (count := connection.recv()) is not None:
        connection.send(bench.time_steps(contender.step, count))


def check_positions(kinds: Sequence[type[Contender]], thing: Thing, folder: Path) -> None:
    """Compare the positions after the first frame with those of NumPy in float64.

    Raises:
        RuntimeError: a contender computes something else, or the test would not see it.
    """
    count, dt, roundoff = bench.STEPS_PER_FRAME, float(thing.dt), float(np.finfo(np.float32).eps) / 2.0
    expected = np.load(folder / f"{NumPy.__name__}.npy")
    # Each step rounds positions once. In the stable range that grows no further, and forces, a hundredth of
    # which acts in a step, are rounded by less.
    tolerance = 2.0 * count * roundoff * float(np.abs(expected).max())
    thrown = thing.x + count * dt * thing.v.astype(float) + 0.5 * count * (count + 1) * dt**2 * thing.gravity
    moved = float(np.abs(expected - thrown).max())
    if moved < 100.0 * tolerance:
        raise RuntimeError(
            f"springs move particles by {moved:.1e} m only, too little beside rounding, {tolerance:.1e} m"
        )
    for kind in kinds:
        wrong = float(np.abs(np.load(folder / f"{kind.__name__}.npy") - expected).max())
        if not wrong <= tolerance:
            raise RuntimeError(
                f"{kind.label} is {wrong:.1e} m beside NumPy after {count} steps; {tolerance:.1e} m allowed"
            )
    say(f"  equal after {count} steps to {tolerance:.1e} m; springs moved particles by up to {moved:.1e} m")


def receive(kind: type[Contender], connection: Connection) -> Any:
    """Return what the process of a contender sends.

    Raises:
        RuntimeError: it has ended instead.
    """
    try:
        return connection.recv()
    except EOFError:
        raise RuntimeError(f"{kind.label} failed; its own message is above") from None


def race(name: str, kinds: Sequence[type[Contender]], rounds: int) -> dict[str, Any]:
    """Return the figures of all contenders for an object, by label."""
    context = get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="warpjelly-") as place:
        folder = Path(place)
        with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
            pool.submit(write_thing, name, folder).result()
        thing = Thing.load(folder)
        springs, particles = len(thing.first), len(thing.x)
        kinds = [kind for kind in kinds if springs <= kind.most_springs]
        say(f"{name}: {particles:,} particles, {springs:,} springs")
        children, figures, counts = {}, {}, {}
        try:
            for kind in kinds:
                connection, theirs = context.Pipe()
                child = context.Process(target=serve, args=(theirs, kind, name, folder, time.time()), daemon=True)
                child.start()
                theirs.close()
                children[kind] = child, connection
                figures[kind] = receive(kind, connection)
                say(f"  {kind.label}: first frame after {figures[kind]['first_frame_seconds']:.1f} s")
            check_positions(kinds, thing, folder)

            def time_steps(kind: type[Contender], count: int) -> bench.Slice:
                children[kind][1].send(count)
                return receive(kind, children[kind][1])

            for kind in kinds:
                time_steps(kind, kind.stride)
                steps = bench.steps_for(SLICE, time_steps(kind, kind.stride).seconds)
                counts[kind] = max(1, steps // kind.stride) * kind.stride
            slices = [{kind: time_steps(kind, counts[kind]) for kind in kinds} for _ in range(rounds)]
            for _, connection in children.values():
                connection.send(None)
            for child, _ in children.values():
                child.join()
        finally:
            for child, _ in children.values():
                child.kill()
    return {
        kind.label: {
            "first_frame_seconds": figures[kind]["first_frame_seconds"],
            "bytes_per_particle": figures[kind]["bytes"] / particles,
            "seconds_per_substep": [turn[kind].seconds for turn in slices],
            "springs_per_second": [springs / turn[kind].seconds for turn in slices],
            "cores_used": [turn[kind].cores for turn in slices],
            "ratio": [turn[kind].seconds / turn[Warpjelly].seconds for turn in slices],
        }
        for kind in kinds
    }


def say(line: str) -> None:
    """Tell the user how far it is."""
    print(line, file=sys.stderr, flush=True)


def print_table(title: str, rows: Sequence[Sequence[str]]) -> None:
    """Print rows as a table in Markdown; the first row has the headers but for the first column's."""
    print(f"\n| {title} | {' | '.join(rows[0][1:])} |\n|---|{'---:|' * (len(rows[0]) - 1)}")
    for row in rows[1:]:
        print(f"| {' | '.join(row)} |")


def spread(values: Sequence[float], form: str = ".3g") -> str:
    """Return the median and, where there are others, the least and the most."""
    ends = f" ({min(values):{form}} to {max(values):{form}})" if len(values) > 1 else ""
    return f"{statistics.median(values):{form}}{ends}"


def print_race(results: dict[str, dict[str, Any]], labels: Sequence[str]) -> None:
    """Print a table for each figure, with a row for each contender."""
    forms: list[tuple[str, Callable[[dict[str, Any]], str]]] = [
        ("million springs/s", lambda f: f"{statistics.median(f['springs_per_second']) / 1e6:.3g}"),
        (RATIO, lambda f: spread(f["ratio"])),
        ("million springs/s per core used", lambda f: f"{statistics.median(per_core(f)) / 1e6:.3g}"),
        ("cores used", lambda f: f"{statistics.median(f['cores_used']):.1f}"),
        ("substeps/s", lambda f: f"{1.0 / statistics.median(f['seconds_per_substep']):.4g}"),
        ("bytes per particle", lambda f: f"{f['bytes_per_particle']:.0f}"),
        ("first frame after, s", lambda f: f"{f['first_frame_seconds']:.1f}"),
    ]
    for title, form in forms:
        shown = [label for label in labels if title != RATIO or label != Warpjelly.label]
        cells = [[form(result[label]) if label in result else "–" for result in results.values()] for label in shown]
        print_table(title, [["", *results], *([label, *row] for label, row in zip(shown, cells, strict=True))])


def per_core(figures: dict[str, Any]) -> list[float]:
    """Return springs per second over the cores that did them, which other work on the machine disturbs less."""
    return [rate / cores for rate, cores in zip(figures["springs_per_second"], figures["cores_used"], strict=True)]


def print_targets(results: dict[str, dict[str, Any]], report: dict[str, Any]) -> None:
    """Print what was aimed at beside what was measured."""
    rows = [["", "measured", "target"]]
    for (kind, name), target in TARGETS.items():
        if kind.label in results.get(name, {}):
            measured = spread(results[name][kind.label]["ratio"])
            rows.append([f"{name}, times as fast as {kind.label}", measured, f"at least {target:g}"])
    scenes = report["scenes"]
    if (scene := scenes.get("cubes_100")) is not None:
        label = "100 cubes at once, times as fast as runs one after another, per core used"
        rows.append([label, f"{scene['runs_at_once_core_ratio']:.2f}", "at least 1.7"])
    if (scene := scenes.get("cube_64")) is not None:
        rows.append(["cube_64, a step of RK4, in steps", f"{scene['rk4_ratio']:.2f}", "at most 4.3"])
        rows.append(
            ["cube_64, share of culling and contact on the floor", f"{scene['contact_share']:.0%}", "at most 15 %"]
        )
    print_table("", rows)


def main() -> None:
    """Measure what was asked for, and print it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("objects", nargs="*", metavar="OBJECT", help=f"of {', '.join(OBJECTS)}; all unless given")
    parser.add_argument("--rounds", type=int, default=7, help="how often each is timed (7)")
    parser.add_argument("-o", "--output", type=Path, help="file for all figures, .json")
    options = parser.parse_args()
    if unknown := set(options.objects) - set(OBJECTS):
        parser.error(f"{unknown.pop()}: there is {', '.join(OBJECTS)}")
    if options.rounds < 1:
        parser.error(f"--rounds {options.rounds}: at least 1")
    if (output := options.output) is not None and (output.exists() or not output.parent.is_dir()):
        parser.error(f"{output}: {'there already' if output.exists() else 'its folder does not exist'}")
    kinds = [kind for kind in CONTENDERS if util.find_spec(kind.package) is not None]
    absent = [f"{kind.label}: not installed: {INSTALL}" for kind in CONTENDERS if kind not in kinds]
    for line in absent:
        say(line)
    objects = options.objects or OBJECTS
    results = {name: race(name, kinds, options.rounds) for name in objects}
    report = bench.run(
        [name for name in objects if name in bench.SCENES],
        device="cpu",
        rounds=2 * options.rounds,
        baseline=bench.BASELINE,
        progress=lambda done, total: say(f"warpjelly bench: {done} of {total}"),
    )
    versions = ", ".join(sorted({f"{kind.package} {metadata.version(kind.package)}" for kind in kinds}))
    print(f"{report['device_name']}, {report['cores']} cores; {versions}")
    for line in absent:
        print(f"\n{line}")
    print_race(results, [kind.label for kind in kinds])
    print_table("warpjelly", bench.table(report))
    print_targets(results, report)
    if output is not None:
        output.write_text(json.dumps({"peers": results, "warpjelly": report}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
