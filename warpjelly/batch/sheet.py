"""The page of a batch, index.html: its runs as pictures, a plot and a table; it works from disk, without a network.

The page is ``sheet.html`` with a description in JSON, made of batch.json, and a strip of small pictures of each run.
"""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colors import SRGB_TABLE, range_in_words
from ..errors import EnvironmentFailedError, InputError, WarpjellyError
from ..files import whole_file
from ..pages import fill_page
from ..scene import Expect
from ..stage.comparison import Compared, require_comparable, write_comparison
from .report import FINISHED
from .specs import COMPARISON_NAME, PAGE_NAME, TABLE_NAME
from .specs import RECORD_NAME as BATCH_NAME

if TYPE_CHECKING:
    from ..previews.thumbnails import Thumbnails

log = logging.getLogger("warpjelly")

# A comparison that nobody asked for has so many runs at most.
MOST_COMPARED = 64

# What figures mean besides those of ``[expect]``, which come before; the page shows them in this order.
_MEANINGS = {
    "max_speed": "greatest particle speed over the run, m/s",
    "max_penetration": "greatest depth of a particle in a collider over the run, m",
    "max_overlap": "greatest depth of a particle in another body over the run, m",
    "contacts": "greatest number of particles in contact over the run",
    "kinetic": "kinetic energy at the end, J",
    "elastic": "energy in springs at the end, J",
    "potential": "energy in gravity at the end, J",
    "spring_losses": "energy that dampers took, J",
    "contact_losses": "energy that contacts took, J",
    "friction_losses": "energy that friction took, J",
    "field_work": "energy that fields gave, J",
    "frames": "number of samples",
    "particles": "number of particles",
    "springs": "number of springs",
    "voxels": "number of jelly cubes",
    "substeps": "substeps a frame",
    "dt": "time step, s",
    "wall_seconds": "time that the run took, s",
    "springs_per_second": "springs x force evaluations in a second of stepping, 1/s",
}


def present(
    folder: Path,
    record: Mapping[str, Any],
    *,
    pictures: bool,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write what a batch is looked at with: its page, and the comparison of its finished runs.

    Args:
        folder: of the batch.
        record: contents of batch.json.
        pictures: whether the page is to have pictures of the runs.
        progress: called after each run that was drawn, with the number of those done and in all.

    Raises:
        OSError: the page cannot be written.
    """
    _compare(folder, record)
    thumbnails: Thumbnails | None = None
    missing = "" if pictures else "The runs were not drawn; warpjelly batch --resume draws them."
    if pictures:
        try:
            # Importing this takes longer than the rest of a page without pictures.
            from ..previews.thumbnails import draw_thumbnails

            thumbnails = draw_thumbnails(list(_groups(folder, record).values()), progress)
        except (InputError, EnvironmentFailedError) as error:
            missing = f"No pictures: {error}; then warpjelly batch --resume draws them."
            log.warning("%s has no pictures: %s", folder / PAGE_NAME, error)
    with whole_file(folder / PAGE_NAME) as unfinished:
        unfinished.write_text(_page(folder, record, thumbnails, missing), encoding="utf-8")


def finished_runs(folder: Path, record: Mapping[str, Any]) -> list[Compared]:
    """Return the finished runs of a batch, as they are compared."""
    return [
        Compared(run["name"], folder / run["stage"], run["parameters"])
        for run in record["runs"]
        if run["status"] == FINISHED and run["stage"] is not None
    ]


def compared(sources: Sequence[Path]) -> list[Compared]:
    """Return the runs that paths stand for: those of run directories, stages, and all finished ones of batches.

    Raises:
        InputError: the record of a batch cannot be read.
    """
    runs: list[Compared] = []
    for source in sources:
        path = source / BATCH_NAME
        if path.is_file():
            try:
                runs += finished_runs(source, json.loads(path.read_text(encoding="utf-8")))
            except (OSError, ValueError, KeyError, TypeError) as error:
                raise InputError(f"{path}: not the record of a batch: {error}") from error
        else:
            runs.append(Compared((source if source.is_dir() else source.with_suffix("")).resolve().name, source))
    return runs


def _compare(folder: Path, record: Mapping[str, Any]) -> None:
    """Write the comparison of the first finished runs that can be compared; without two, remove that of before."""
    path, runs, wrong = folder / COMPARISON_NAME, list[Compared](), list[str]()
    for run in finished_runs(folder, record):
        try:
            require_comparable(run)
            runs.append(run)
        except InputError as error:
            wrong.append(str(error))
        if len(runs) == MOST_COMPARED:
            break
    if wrong:
        more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
        log.warning("not in %s: %s%s", path, wrong[0], more)
    try:
        if len(runs) > 1:
            write_comparison(runs, path)
            return
    except WarpjellyError as error:
        log.warning("no %s: %s", path, error)
    path.unlink(missing_ok=True)


def _groups(folder: Path, record: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Return the stages of finished runs by SPEC: scenes of different files are too different for one camera."""
    groups: dict[str, dict[str, Path]] = {}
    sources = {run["name"]: run["source"] for run in record["runs"]}
    for run in finished_runs(folder, record):
        groups.setdefault(sources[run.name], {})[run.name] = run.source
    return groups


def _page(folder: Path, record: Mapping[str, Any], thumbnails: Thumbnails | None, missing: str) -> str:
    strips = thumbnails.strips if thumbnails else {}
    problems = thumbnails.problems if thumbnails else {}
    ranges = [range_in_words(forces) for forces in (thumbnails.ranges if thumbnails else []) if forces is not None]
    described = {
        "counts": record["counts"],
        "began": record["began"],
        "version": record["warpjelly"],
        "missing": missing,
        "links": [name for name in (TABLE_NAME, COMPARISON_NAME) if (folder / name).is_file()],
        "times": thumbnails.times if thumbnails else [],
        "forces": ranges,
        "colors": np.rint(SRGB_TABLE[::15] * 255).astype(int).tolist(),
        "meanings": {name: field.description for name, field in Expect.model_fields.items()} | _MEANINGS,
        "runs": [
            {
                **{key: run[key] for key in ("name", "status", "reason", "parameters", "figures", "stage", "log")},
                "missed": [_told(outcome) for outcome in run["expect"] if not outcome["met"]],
                "expected": len(run["expect"]),
                "impact": strips[run["name"]].impact if run["name"] in strips else None,
                "problem": problems.get(run["name"]),
            }
            for run in record["runs"]
        ],
    }
    pictures = {name: base64.b64encode(strip.image).decode() for name, strip in strips.items()}
    tables = {"BATCH": described, "PICTURES": pictures}
    return fill_page(__package__, "sheet.html", title=folder.resolve().name, tables=tables, texts={})


def _told(outcome: Mapping[str, Any]) -> str:
    """Say what was expected and not met."""
    bounds = [("at least", outcome["min"]), ("at most", outcome["max"])]
    allowed = " and ".join(f"{words} {bound:g}" for words, bound in bounds if bound is not None)
    return f"{outcome['quantity']} of {outcome['body']}: {outcome['value']:.4g}, not {allowed}"
