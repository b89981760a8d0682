"""The command line. Imports are inside the commands, so that ``--help`` answers at once."""

from __future__ import annotations

import inspect
import json
import logging
import os
import re
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .errors import INTERRUPTED, InputError, SceneError, WarpjellyError, listed, verdict

if TYPE_CHECKING:
    from .expect import Outcome
    from .scene import Scene

app = typer.Typer(
    help="Turn 3D models into jelly: a scene file in, an animated USD stage out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    epilog="Start with:  warpjelly run scenes/tree_drop.toml",
)

SceneArgument = Annotated[Path, typer.Argument(help="Scene file (.toml) or jello cube world (.w).", show_default=False)]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key of the scene: --set solver.dt=5e-4 --set bodies.tree.resolution=20.",
        show_default=False,
    ),
]
DeviceOption = Annotated[str, typer.Option("--device", help="auto, cpu, cuda:0 ...; auto takes a GPU if there is one.")]
ThreadsOption = Annotated[
    int | None,
    typer.Option(
        "--threads", min=1, help="CPU threads, one per core unless given; results are the same.", show_default=False
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"warpjelly {version('warpjelly')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None: ...


@app.command()
def run(
    scene: SceneArgument,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Run directory; outputs/<scene name> unless given.", show_default=False),
    ] = None,
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of samples instead of the scene's.", show_default=False)
    ] = None,
    settings: SetOption = [],  # noqa: B006 -- typer wants a list and copies it
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with a run that was interrupted or killed, or now has more --frames."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a run that is there already.")] = False,
    color: Annotated[
        Literal["indexed", "rgb"] | None,
        typer.Option(help="How the stage stores force colours; rgb for readers without indices.", show_default=False),
    ] = None,
    as_json: JsonOption = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress and no summary.")] = False,
) -> None:
    """Simulate a scene and write its stage.

    The run directory receives stage.usdc, metrics.csv (energies, momenta, contacts per frame) and run.json (all that is
    needed to repeat the run). While the run is going, stage.usda beside its parts has the frames so far. Ctrl-C ends it
    after the current frame; with --resume it goes on, and ends as if it had never stopped.
    """
    overrides = _overrides(settings)
    if color is not None:
        overrides["output.color"] = color
    loaded = _load(scene, overrides, frames)

    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    with (
        _named(scene),
        Progress(
            SpinnerColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames  {task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=Console(stderr=True),
            disable=quiet or not sys.stderr.isatty(),
            transient=True,
        ) as bar,
    ):
        task = bar.add_task("reading", total=loaded.frame_count, rate="")

        def show(done: int, total: int) -> None:
            speed = bar.tasks[task].finished_speed or bar.tasks[task].speed
            rate = f"{speed:.1f}/s" if speed else ""
            bar.update(task, completed=done, description="simulating", rate=rate)

        from .run import RunEndedError, simulate

        ended = None
        try:
            with _steps(lambda what: bar.update(task, description=what)):
                result = simulate(
                    loaded, output=output, device=device, threads=threads, force=force, resume=resume, progress=show
                )
        except RunEndedError as error:
            ended, result = error, error.run
    if as_json:
        print(json.dumps(result.record, allow_nan=False))
    elif not quiet:
        _summarize(result.record, result.outcomes)
    if ended is not None:
        sys.stdout.flush()
        raise ended


@app.command()
def batch(
    specs: Annotated[
        list[Path],
        typer.Argument(
            metavar="SPEC...", help="Sweep file, scene files, or folders of scene files.", show_default=False
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Folder of the batch, with a run directory for each run; outputs/<name of the only sweep or "
            "folder>, or outputs/batch, unless given.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Runs at a time; as many as GPUs, or cores, unless given.", show_default=False),
    ] = None,
    device: DeviceOption = "auto",
    engine: Annotated[
        Literal["local", "ray"], typer.Option(help="Processes on this machine, or a Ray cluster that it is part of.")
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            help="Of the Ray cluster; that of RAY_ADDRESS, or of this machine, unless given.",
            show_default=False,
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of samples instead of the scenes'.", show_default=False)
    ] = None,
    settings: SetOption = [],  # noqa: B006
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the runs and what they take, and do nothing.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a batch: do only what is missing, unfinished or failed.")
    ] = False,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Replace runs that are there already; with --resume only those of other scenes or versions."
        ),
    ] = False,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Draw the finished runs for index.html.")
    ] = True,
    as_json: JsonOption = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress and no summary.")] = False,
) -> None:
    """Simulate many scenes, or one scene with many values of some keys.

    Runs that fail do not disturb the others: the exit code is 3 then. batch.json and batch.csv in the folder of the
    batch have parameters, figures and stage of each run, or why it failed; run.log in its run directory has what it
    said. index.html shows the runs in any browser, comparison.usda side by side in a USD viewer. A run whose
    process was lost is begun once more. Ctrl-C ends the runs that are under way after their current frame, and --resume
    goes on.

    A sweep file names a base scene and what its keys are to be; each combination of values is a run:

    \b
        base = "cube.toml"
        \\[vary]
        "materials.jelly.structural.stiffness" = [50, 100, 200]
        "bodies.cube.position.1" = { range = [0.5, 2.0], count = 4 }
    """  # noqa: D301 -- \b keeps lines as they are
    from .batch.batch import BatchInterruptedError, RunsFailedError, estimate_batch, run_batch
    from .batch.display import display, list_runs, summarize

    if engine == "ray":
        from .batch.cluster import RayEngine

        chosen = RayEngine(address=address, workers=workers, device=device)
    elif address is not None:
        raise InputError("--address is that of a Ray cluster: add --engine ray")
    else:
        chosen = None
    if dry_run:
        with _progress("building") as show:
            estimate = estimate_batch(
                specs,
                overrides=_overrides(settings),
                frames=frames,
                workers=workers,
                device=device,
                engine=chosen,
                progress=show,
            )
        print(json.dumps(estimate, allow_nan=False, default=str)) if as_json else list_runs(estimate)
        return
    ended: WarpjellyError | None = None
    with display(quiet=quiet) as watcher:
        try:
            done = run_batch(
                specs,
                output=output,
                overrides=_overrides(settings),
                frames=frames,
                workers=workers,
                device=device,
                engine=chosen,
                resume=resume,
                force=force,
                pictures=pictures,
                watcher=watcher,
            )
        except (BatchInterruptedError, RunsFailedError) as error:
            ended, done = error, error.batch
    if as_json:
        print(json.dumps(done.record, allow_nan=False, default=str))
    elif not quiet:
        summarize(done)
    if ended is not None:
        sys.stdout.flush()
        raise ended


@app.command()
def check(
    scene: SceneArgument,
    settings: SetOption = [],  # noqa: B006
    device: DeviceOption = "auto",
    threads: ThreadsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Validate a scene, count what it is made of, and estimate what a run takes."""
    loaded = _load(scene, _overrides(settings), None)

    from rich.console import Console

    from .run import forecast

    console = Console(stderr=True, quiet=not sys.stderr.isatty())
    with _named(scene), console.status("reading") as status, _steps(status.update):
        figures = forecast(loaded, device=device, threads=threads)
    if as_json:
        print(json.dumps(figures))
        return
    name = loaded.solver.integrator
    limits = [figures[key][name] for key in ("dt_limit", "dt_limit_in_contact")]
    stable = all(limit is not None and figures["dt"] <= limit for limit in limits)
    print(f"{scene}: {'sound' if stable else 'sound, but for its time step: see the warning'}")
    print(f"  voxels     {figures['voxels']:>13,}")
    if len(figures["materials"]) > 1:
        print(f"  of which   {', '.join(f'{count:,} {name}' for name, count in figures['materials'].items())}")
    print(f"  particles  {figures['particles']:>13,}")
    print(f"  springs    {figures['springs']:>13,}")
    print(f"  memory     {figures['memory_bytes'] / 1e9:>13.2f} GB at the peak, about")
    largest = sorted(figures["body_memory_bytes"].items(), key=itemgetter(1), reverse=True)[:3]
    for name, share in largest if len(figures["body_memory_bytes"]) > 1 else []:
        print(f"             {share / 1e9:>13.2f} GB of it for '{name}'")
    print(f"  step       {figures['dt'] * 1e3:>13.4g} ms, {figures['substeps']} a frame, {figures['frames']} frames")
    for name, limit in figures["dt_limit"].items():
        steps = [f"{step * 1e3:.4g} ms" if step else "none" for step in (limit, figures["dt_limit_in_contact"][name])]
        used = "; used here" if name == loaded.solver.integrator else ""
        print(f"  {name:<19} {steps[0]:>10} is its largest stable step; in contact {steps[1]}{used}")
    if over := figures["over"]:
        first, last = over["time_codes"]
        print(f"  over       {listed(over['meshes'], 3)}")
        print(f"  shot       {first:>13g} to {last:g}, its time codes")
    print(f"  time       {figures['seconds']:>13.3g} s on {figures['device']}, about, stage included")


@app.command()
def voxelize(
    model: Annotated[Path, typer.Argument(help="Mesh file.", show_default=False)],
    resolution: Annotated[
        int, typer.Option("--resolution", "-n", min=1, max=4096, help="Jelly cubes along the longest edge.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="Grid to write, .npz, for `file` of a body of voxels; or stage to look at, .usdc.",
            show_default=False,
        ),
    ] = None,
    prim: Annotated[
        str | None, typer.Option(help="Of a USD file, the prim below which to look.", show_default=False)
    ] = None,
    scale: Annotated[
        float | None, typer.Option(help="Metres per unit of the model; 1 unless given.", show_default=False)
    ] = None,
    fit: Annotated[
        float | None, typer.Option(help="Largest extent of the model, m, instead of --scale.", show_default=False)
    ] = None,
    method: Annotated[
        Literal["auto", "parity", "winding", "vote"], typer.Option(help="How cells are told to be inside.")
    ] = "auto",
    keep_thin_parts: Annotated[
        bool, typer.Option("--keep-thin-parts", help="Fill, too, what parts thinner than a cell pass through.")
    ] = False,
    pieces: Annotated[
        Literal["all", "largest"], typer.Option(help="Of pieces that no face joins, keep each or one.")
    ] = "all",
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Say what a model becomes: voxels, pieces, particles, springs, volume, and what is wrong with it.

    Start with -n 20 and go up until nothing that matters is lost: twice the resolution is eight times the voxels. What
    is printed here is what a scene gets from a body of type "model" with the same keys.

    With -o FILE.npz the grid is kept, for a body with type = "voxels" and file = "FILE.npz". With -o FILE.usdc the
    voxels become a stage, for any USD viewer or `warpjelly preview`.
    """
    from .files import missing, refuse_to_replace

    if why := missing(model):
        raise InputError(f"{model}: {why}")
    if output is not None and output.suffix.lower() not in (".npz", ".usdc"):
        raise InputError(f"{output}: a grid is written as .npz, a stage of the voxels as .usdc")
    if output is not None:
        refuse_to_replace(output, force=force)

    from .plan import survey_model
    from .scenefile import read_scene

    options: dict[str, Any] = {"method": method, "keep_thin_parts": keep_thin_parts, "pieces": pieces}
    options |= {key: value for key, value in (("prim", prim), ("scale", scale), ("fit", fit)) if value is not None}
    body = {"type": "model", "name": "model", "material": "jelly", "file": str(model.absolute()), **options}
    scene = read_scene({"materials": {"jelly": {}}, "bodies": [{**body, "resolution": resolution}]}, model)
    grid, lattice, figures = survey_model(scene)
    if output is not None and output.suffix.lower() == ".npz":
        from .gridfile import write_grid

        write_grid(output, grid.cells, grid.origin, grid.cell_size)
    elif output is not None:
        from .shapes import at_rest, face_edges, shapes_of
        from .stage.stagewriter import write_still

        shapes = [*shapes_of("model", lattice, scene.output), face_edges("model", lattice)]
        write_still(output, scene=scene, shapes=shapes, rest=[at_rest(shape, lattice) for shape in shapes])
    if as_json:
        print(json.dumps(figures))
        return
    closed = "watertight" if figures["watertight"] else "not watertight"
    whole = figures["mesh_volume"]
    share = f", {figures['volume'] / whole:.1%} of the mesh's {whole:.4g} m^3" if whole else ""
    print(f"{model}: {closed}, method {figures['method']}")
    cells = f"{' x '.join(map(str, grid.cells.shape))}, {grid.cell_size:.4g} m each"
    print(f"  voxels     {figures['voxels']:>13,} of {cells}")
    print(f"  pieces     {figures['pieces']:>13,}")
    print(f"  particles  {figures['particles']:>13,}")
    print(f"  springs    {figures['springs']:>13,}")
    print(f"  volume     {figures['volume']:>13.4g} m^3{share}")
    if output is not None:
        print(f"{'grid' if output.suffix.lower() == '.npz' else 'stage'}: {output}")


@app.command()
def validate(
    stage: Annotated[Path, typer.Argument(metavar="RUN_OR_STAGE", help="Run directory or stage.", show_default=False)],
) -> None:
    """Say whether a stage is sound: exit 0, or 1 with every problem listed.

    The stage of a run that was killed or interrupted is as sound as any, but said not to be finished.
    """
    from .stage.stagefiles import open_stage, progress
    from .stage.validate import stage_problems

    problems = stage_problems(stage)
    for problem in problems:
        print(problem)
    unfinished = progress(open_stage(stage))
    note = f"; the run is not finished: {unfinished[0]} of {unfinished[1]} frames" if unfinished else ""
    print(f"{stage}: {'sound' if not problems else f'{len(problems)} problem(s)'}{note}")
    if problems:
        raise typer.Exit(1)


@app.command()
def pack(
    source: Annotated[Path, typer.Argument(metavar="RUN_OR_STAGE", help="Run directory or stage.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write: .usdc, .usda or .usdz.", show_default=False)
    ],
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
) -> None:
    """Write a stage as one self-contained file, also that of a run that has not finished.

    Textures go into a .usdz, and into a folder beside a .usdc or .usda.
    """
    from .files import refuse_to_replace
    from .stage.pack import pack as pack_stage

    refuse_to_replace(output, force=force)
    pack_stage(source, output)
    print(f"stage: {output}")


@app.command()
def compare(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN_OR_STAGE_OR_BATCH...",
            help="Run directories, stages, or folders of batches, which stand for all their finished runs.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Stage to write, .usda.", show_default=False)],
    columns: Annotated[
        int | None,
        typer.Option(min=1, help="Runs in a row; about as many as rows unless given.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
) -> None:
    """Show runs side by side in one stage, all from their start, with colours that mean the same forces.

    The stage refers to those of the runs by relative paths, so they may be moved together.
    """
    from .batch.sheet import compared
    from .files import refuse_to_replace
    from .stage.comparison import write_comparison

    refuse_to_replace(output, force=force)
    runs = compared(sources)
    write_comparison(runs, output, columns=columns)
    print(f"stage: {output}, with {len(runs)} runs side by side")


@app.command()
def preview(
    source: Annotated[Path, typer.Argument(metavar="RUN_OR_STAGE", help="Run directory or stage.", show_default=False)],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write: .png, .mp4, .webp or .html.", show_default=False)
    ],
    frames: Annotated[
        list[int],
        typer.Option(
            "--frame",
            help="In a picture, a frame to show, repeated for several side by side; the moment of the hardest impact "
            "unless given, or the last where no colours show forces. In a movie or page, given twice, the first and "
            "the last; all unless given.",
            show_default=False,
        ),
    ] = [],  # noqa: B006
    every: Annotated[int, typer.Option(min=1, help="In a movie or page, show every so many frames.")] = 1,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Size in pixels of a frame, 960x540 unless given, or of plots, 1400x800.",
            show_default=False,
        ),
    ] = None,
    plots: Annotated[
        bool, typer.Option("--plots", help="Plot the run's metrics over time: energies, momentum, contacts ...")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
) -> None:
    """Look at a result without a USD viewer.

    The name of the file says as what: a picture (.png), a movie in real time (.mp4, .webp), or a page to look around
    in, which plays from disk in any browser (.html).
    """
    sides = re.fullmatch(r"([0-9]{1,9})x([0-9]{1,9})", size or ("1400x800" if plots else "960x540"))
    if not sides:
        raise InputError(f"--size {size}: give width x height in pixels, for example 960x540")
    pixels = int(sides[1]), int(sides[2])
    if plots:
        if frames or every != 1:
            raise InputError("--plots shows all frames: leave out --frame and --every")
        from .previews.plots import plot_metrics

        plot_metrics(source, output, size=pixels, force=force)
    else:
        from .previews.preview import render_preview

        with _progress("rendering") as show:
            render_preview(source, output, frames=frames or None, every=every, size=pixels, force=force, progress=show)
    print(f"preview: {output} ({output.stat().st_size / 1e6:.1f} MB)")


@app.command()
def export_world(
    scene: SceneArgument,
    output: Annotated[Path, typer.Option("-o", "--output", help="World to write, .w.", show_default=False)],
    settings: SetOption = [],  # noqa: B006
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
) -> None:
    """Write a CMU jello cube world from a scene that fits one."""
    loaded = _load(scene, _overrides(settings), None)

    from .worldfile import write_world

    with _named(scene):
        write_world(loaded, output, force=force)
    print(f"world: {output}")


@app.command()
def bench(
    scenes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SCENE",
            help="cube_8, cube_32, cube_64, cube_128 (particles along an edge), cubes_100 (a hundred of cube_8); all "
            "but cube_128 unless given.",
            show_default=False,
        ),
    ] = None,
    device: DeviceOption = "auto",
    rounds: Annotated[int, typer.Option(min=1, help="How often each figure is measured; more are steadier.")] = 15,
    baseline: Annotated[
        Path | None,
        typer.Option(
            help="Report of an earlier run to compare with; warpjelly's own unless given.", show_default=False
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Report to write, .json, a baseline for later runs.", show_default=False),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the speed of this machine on standard scenes, in less than a minute.

    Figures are medians over rounds in which everything has its turn; other work on the machine widens their range.

    The reference kernel is the plainest that computes the forces of springs, one after another on the CPU. Measured in
    the same rounds, it tells a slower program from a slower machine: a scene whose ratio to it is a quarter below what
    the baseline promises for as many cores is warned of, and the exit code stays 0.

    To see what a change does to speed here: bench -o before.json, change, bench --baseline before.json.
    """
    from .bench import BASELINE, QUICK, SCENES, run, table
    from .files import refuse_to_replace, whole_file

    names = list(dict.fromkeys(scenes or QUICK))
    if unknown := [name for name in names if name not in SCENES]:
        raise InputError(f"{unknown[0]}: no standard scene; they are {', '.join(SCENES)}")
    if output is not None:
        refuse_to_replace(output, force=force)
    with _progress("measuring") as show:
        report = run(names, device=device, rounds=rounds, baseline=baseline or BASELINE, progress=show)
    if output is not None:
        with whole_file(output) as file:
            file.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if as_json:
        print(json.dumps(report, allow_nan=False))
        return

    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Column, Table

    (corner, *names), *rows = table(report)
    shown = Table(corner, *(Column(name, justify="right", no_wrap=True) for name in names), box=SIMPLE)
    for row in rows:
        shown.add_row(*row)
    versions = f"warpjelly {report['warpjelly']}, Warp {report['warp-lang']}, Python {report['python']}"
    print(f"{report['device_name']}, {report['cores']} cores; {versions}")
    # As wide as the table is, wherever it goes.
    Console(width=200, highlight=False).print(shown)
    then = report["baseline"]
    print(
        f"baseline: {then['device_name']}, {then['cores']} cores"
        if then is not None
        else f"baseline: not of {report['device']}, not compared"
    )
    if output is not None:
        print(f"report: {output}")


@app.command()
def gui(
    scene: Annotated[
        Path | None,
        typer.Argument(
            help="Scene file to begin with, or folder to choose from; a cube over a floor unless given.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder for what the page saves: scenes, runs, models sent by browsers."),
    ] = Path("outputs/gui"),
    device: DeviceOption = "auto",
    host: Annotated[
        str, typer.Option(help="Address to listen at; 0.0.0.0 lets in whoever can reach this machine, unasked.")
    ] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option(min=1, max=65535, help="8080 if it is free, or any, unless given.", show_default=False),
    ] = None,
    settings: SetOption = [],  # noqa: B006
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser here.")] = True,
) -> None:
    """Experiment with a scene in a browser: play, pull, change, record.

    The address of the page is printed; any number of browsers may watch, and closing them loses nothing. Ctrl-C ends
    it.
    """
    from .gui.server import require_viser, serve

    require_viser()
    found = Path("scenes")
    if scene is not None:
        found = scene if scene.is_dir() else scene.parent
    if settings and (scene is None or scene.is_dir()):
        raise InputError("--set changes keys of a scene: name its file")
    loaded = None if scene is None or scene.is_dir() else _load(scene, _overrides(settings), None)
    with _named(scene) if loaded is not None and scene is not None else nullcontext():
        serve(loaded, device=device, host=host, port=port, scenes=found, folder=output, open_page=open_page)
    raise typer.Exit(INTERRUPTED)


@app.command()
def doctor() -> None:
    """Show versions, devices, and which optional parts are present."""
    import platform
    from importlib import metadata, util

    import warp as wp

    from .device import start_warp
    from .machine import memory_limit

    start_warp()
    print(f"warpjelly {metadata.version('warpjelly')} on Python {platform.python_version()}, {platform.platform()}")
    for package in ("warp-lang", "numpy", "usd-core", "trimesh", "pydantic"):
        print(f"  {package:<10} {metadata.version(package)}")
    print(f"memory: {memory_limit() / 1e9:.1f} GB; processors: {os.cpu_count()}")
    print("devices:")
    for device in wp.get_devices():
        print(f"  {device.alias:<10} {device.name}")
    if not wp.is_cuda_available():
        print("  no CUDA device; simulations run on the CPU")
    print(f"kernel cache: {wp.config.kernel_cache_dir}")
    print("optional parts:")
    for extra, modules in [
        ("preview", ["pyvista", "PIL", "imageio_ffmpeg", "matplotlib"]),
        ("formats", ["lxml", "networkx", "collada"]),
        ("bench", ["newton", "numba", "taichi"]),
        ("cluster", ["ray"]),
        ("gui", ["viser"]),
    ]:
        missing = "" if all(map(util.find_spec, modules)) else f"missing: pip install 'warpjelly[{extra}]'"
        print(f"  {extra:<10} {missing or 'present'}")


# Typer keeps the line breaks of docstrings, however wide the terminal is; what is indented keeps its own.
for _command in app.registered_commands:
    _command.help = re.sub(r"(?<!\n)\n(?![\n ])", " ", inspect.getdoc(_command.callback) or "")


def main() -> None:
    """Run the command line; never returns."""
    warnings = logging.StreamHandler()
    warnings.setFormatter(logging.Formatter("warning: %(message)s"))
    warnings.setLevel(logging.WARNING)
    logging.getLogger("warpjelly").handlers = [warnings]
    # Termination is an interruption like Ctrl-C: the frames that were finished are saved.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(_guarded())


@contextmanager
def _steps(show: Callable[[str], None]) -> Iterator[None]:
    """Show what is being done, as the steps that take long on large models log it."""
    handler = logging.Handler()
    handler.emit = lambda record: show(record.getMessage())  # type: ignore[method-assign]
    steps = logging.getLogger("warpjelly.steps")
    steps.setLevel(logging.INFO)
    steps.addHandler(handler)
    try:
        yield
    finally:
        steps.removeHandler(handler)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Give a function that shows how much is done, of how much; only on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console, off = Console(stderr=True), not sys.stderr.isatty()
    with Progress(*columns, TextColumn("left"), console=console, disable=off, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _guarded() -> int:
    """Run a command and return its exit code; whatever goes wrong becomes one line on stderr."""
    try:
        code = int(app(prog_name="warpjelly", standalone_mode=False) or 0)
        # Typer makes Ctrl-C a number.
        return _fail("interrupted", code) if code == INTERRUPTED else code
    except typer.TyperException as error:
        # Without arguments the help was shown, and there is nothing to add.
        if not (message := error.format_message().rstrip(".")):
            return error.exit_code
        context = getattr(error, "ctx", None)
        hint = f"; see '{context.command_path} --help'" if context is not None else ""
        return _fail(f"{message}{hint}", error.exit_code)
    except BrokenPipeError:
        # Whoever read our output has gone, as `| head` does; writing a message would only fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (Exception, KeyboardInterrupt) as error:
        return _fail(*verdict(error))


def _fail(message: str, exit_code: int) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return exit_code


def _overrides(settings: list[str]) -> dict[str, Any]:
    """Parse KEY=VALUE settings; values are TOML, and bare words are strings."""
    overrides = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not (equals and key):
            raise InputError(f"--set {setting}: give KEY=VALUE, for example --set solver.dt=5e-4")
        try:
            overrides[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            overrides[key.strip()] = text.strip()
    return overrides


def _load(path: Path, overrides: dict[str, Any], frames: int | None) -> Scene:
    from .scenefile import load_scene

    return load_scene(path, overrides=overrides, frames=frames)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Name the scene file where its scene cannot be built, as errors of validation do."""
    try:
        yield
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error


def _summarize(record: dict[str, Any], outcomes: list[Outcome]) -> None:
    """Print what came of a run."""
    rate = record["springs_per_second"] / 1e6
    threads = f" with {record['threads']} threads" if record["threads"] > 1 else ""
    print(
        f"{record['scene']}: {record['frames']} frames of {record['voxels']:,} voxels, "
        f"{record['particles']:,} particles, {record['springs']:,} springs"
    )
    print(
        f"{record['wall_seconds']:.1f} s on {record['device']}{threads}: {record['substeps']} substeps a frame of "
        f"{record['dt'] * 1e3:.4g} ms, {rate:.0f} million springs/s"
    )
    for outcome in outcomes:
        bounds = [("at least", outcome.min), ("at most", outcome.max)]
        allowed = " and ".join(f"{words} {bound:g}" for words, bound in bounds if bound is not None)
        verdict = "as expected" if outcome.met else "NOT as expected"
        print(f"  {outcome.quantity} of {outcome.body}: {outcome.value:.4g}, {verdict} ({allowed})")
    print(f"stage: {record['stage']}")
    print(f"look:  warpjelly preview {record['run_dir']} -o {record['scene']}.png")


if __name__ == "__main__":
    main()
