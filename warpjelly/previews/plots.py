"""Plots of a run's metrics: energies, momentum, speed, penetration and contacts over time."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import EnvironmentFailedError, InputError
from ..files import refuse_to_replace, whole_file
from ..rundir import METRICS_NAME

MAX_SIZE = 8192

_DPI = 100
# Smaller, curves have no room between what is written on them.
_MIN_SIZE = (800, 400)
# What is there and what was taken add up to what there was.
_ENERGIES = {"kinetic": "kinetic", "elastic": "elastic", "potential": "potential", "contact": "in contacts"}
_TAKEN = {"spring_losses": "dampers", "contact_losses": "contacts", "friction_losses": "friction"}
_GIVEN = {"field_work": "given by fields"}
_SUM = "sum"


@dataclass(frozen=True)
class _Panel:
    title: str
    unit: str
    curves: Mapping[str, str]
    """Labels by column."""
    scale: float = 1.0
    """Units of the panel in a unit of the column."""


_PANELS = (
    _Panel("Energy, and its sum with what was taken", "J", {**_ENERGIES, _SUM: "sum of all"}),
    _Panel("Energy taken since the start", "J", _TAKEN | _GIVEN),
    _Panel("Momentum", "kg m/s", {f"momentum_{axis}": axis for axis in "xyz"}),
    _Panel("Speed of the fastest particle", "m/s", {"max_speed": "speed"}),
    _Panel("Greatest depth", "mm", {"max_penetration": "in a collider", "max_overlap": "in another body"}, scale=1e3),
    _Panel("Contacts", "number", {"contacts": "contacts"}),
)


def plot_metrics(source: Path, output: Path, *, size: tuple[int, int] = (1400, 800), force: bool = False) -> None:
    """Plot the metrics of a run over time into a PNG.

    Args:
        source: a run directory, or the stage in it.
        output: the PNG to make; it appears under its name only when it is complete.
        size: width and height, pixels.
        force: replace a file that is there already.

    Raises:
        InputError: there are no metrics, they are damaged, the output name is or the size is wrong, the file is there
            already, or Matplotlib is not installed.
        EnvironmentFailedError: the file cannot be written.
    """
    if output.suffix.lower() != ".png":
        raise InputError(f"{output}: plots are a PNG; choose a name that ends in .png")
    refuse_to_replace(output, force=force)
    if not all(low <= side <= MAX_SIZE for low, side in zip(_MIN_SIZE, size, strict=True)):
        least = "x".join(map(str, _MIN_SIZE))
        raise InputError(f"size {size[0]}x{size[1]}: plots must be {least} to {MAX_SIZE}x{MAX_SIZE} pixels")
    metrics = read_metrics(source)
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("plots need Matplotlib: pip install 'warpjelly[preview]'") from error
    figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), layout="constrained")
    grid = figure.subplots(2, 3, sharex=True)
    for axes, panel in zip(grid.flat, _PANELS, strict=True):
        for column, label in panel.curves.items():
            look = {"color": "black", "linestyle": "--"} if column == _SUM else {}
            axes.plot(metrics["time"], metrics[column] * panel.scale, label=label, linewidth=1.6, **look)
        axes.set_title(panel.title, fontsize="medium", loc="left")
        axes.set_ylabel(panel.unit)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0)
        if len(panel.curves) > 1:
            axes.legend(frameon=False, fontsize="small")
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as unfinished:
            figure.savefig(unfinished, dpi=_DPI)
    except OSError as error:
        raise EnvironmentFailedError(f"{output}: cannot write the plots: {error.strerror or error}") from error


def read_metrics(source: Path) -> dict[str, np.ndarray]:
    """Return the metrics of a run by column, float64 [frame_count], SI units, and ``sum``, the energy account, J.

    Raises:
        InputError: there are none, or they are damaged.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file")
    path = (source if source.is_dir() else source.parent) / METRICS_NAME
    if not path.is_file():
        raise InputError(f"{source}: no {METRICS_NAME} here, and plots are of nothing else; give a run directory")
    names = ["time", *(column for panel in _PANELS for column in panel.curves if column != _SUM)]
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        metrics = {name: np.array([float(row[name]) for row in rows]) for name in names}
    # A row that ends early has None where something is missing.
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not the metrics of a run: {error}") from error
    if not rows:
        raise InputError(f"{path}: not the metrics of a run: there are none")
    metrics[_SUM] = sum(metrics[name] for name in (*_ENERGIES, *_TAKEN)) - metrics["field_work"]
    return metrics
