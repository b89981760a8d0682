"""What a batch leaves beside its runs: batch.json, from which everything else can be made, and a table of it."""

from __future__ import annotations

import csv
import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import INTERRUPTED, InputError
from ..files import whole_file
from ..rundir import METRICS_NAME, read_record
from ..stage.stagefiles import find_stage
from .jobs import LOG_NAME, Result
from .specs import RECORD_NAME as BATCH_NAME
from .specs import TABLE_NAME, Entry

FINISHED, FAILED, UNFINISHED = "finished", "failed", "unfinished"
# Figures of a run that are those of its record, and those of its metrics: the greatest of all frames, or the last.
_OF_RECORD = ("frames", "particles", "springs", "voxels", "substeps", "dt", "wall_seconds", "springs_per_second")
_GREATEST = ("max_speed", "max_penetration", "max_overlap", "contacts")
_LAST = ("kinetic", "elastic", "potential", "spring_losses", "contact_losses", "friction_losses", "field_work")


def describe(folder: Path, entry: Entry, result: Result | None, scene_hash: str | None) -> dict[str, Any]:
    """Return what batch.json says of a run; paths are relative to the folder of the batch.

    Args:
        folder: of the batch.
        entry: the run.
        result: what came of it, None if it was not begun.
        scene_hash: of its scene, if that can be read.
    """
    own = folder / entry.name
    record = {} if result is None else record_of(own) or {}
    # There may be a run of another scene, in whose place this one could not begin.
    recorded = scene_hash is not None and record.get("scene_hash") == scene_hash
    return {
        "name": entry.name,
        "source": entry.source,
        "parameters": entry.parameters,
        "status": _status(result),
        "reason": None if result is None else result.reason,
        "exit_code": None if result is None else result.exit_code,
        "attempts": 0 if result is None else result.attempts,
        "stage": _stage_of(folder, own) if recorded else None,
        "log": f"{entry.name}/{LOG_NAME}" if result is not None and (own / LOG_NAME).is_file() else None,
        "scene_hash": scene_hash,
        "figures": figures_of(own, record) if recorded else {},
        "expect": record["expect"] if recorded else [],
    }


def _status(result: Result | None) -> str:
    if result is None or result.exit_code == INTERRUPTED:
        return UNFINISHED
    return FINISHED if result.exit_code == 0 else FAILED


def _stage_of(folder: Path, own: Path) -> str | None:
    try:
        return find_stage(own).relative_to(folder).as_posix()
    except InputError:
        return None


def record_of(own: Path) -> dict[str, Any] | None:
    """Return the record of the run in a folder, None where there is none that can be read."""
    try:
        return read_record(own)
    except InputError:
        return None


def figures_of(own: Path, record: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the numbers that tell runs apart, by name; SI units.

    What a scene expects of itself is measured, so ``[expect]`` decides which quantities there are.
    """
    figures = {name: record[name] for name in _OF_RECORD}
    measured = Counter(outcome["quantity"] for outcome in record["expect"])
    for outcome in record["expect"]:
        name = outcome["quantity"]
        figures[name if measured[name] == 1 else f"{name}.{outcome['body']}"] = outcome["value"]
    with open(own / METRICS_NAME, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for name in _GREATEST if rows else ():
        figures[name] = max(float(row[name]) for row in rows)
    for name in _LAST if rows else ():
        figures[name] = float(rows[-1][name])
    # Of a run that is about to diverge, they need not be finite, and JSON has no other numbers.
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def count(runs: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Return how many runs there are, and of each status."""
    counts = Counter(run["status"] for run in runs)
    return {"runs": len(runs), **{status: counts[status] for status in (FINISHED, FAILED, UNFINISHED)}}


def write_batch(folder: Path, record: Mapping[str, Any]) -> None:
    """Write batch.json, and batch.csv with one row a run."""
    with whole_file(folder / BATCH_NAME) as unfinished:
        unfinished.write_text(json.dumps(record, indent=2, allow_nan=False, default=str) + "\n", encoding="utf-8")
    runs = record["runs"]
    parameters = _keys(run["parameters"] for run in runs)
    figures = _keys(run["figures"] for run in runs)
    told = ("stage", "log", "source")
    # A parameter may have the name of a figure.
    titles = [
        f"{name} (given)" if name in {*figures, *told, "name", "status", "reason"} else name for name in parameters
    ]
    with whole_file(folder / TABLE_NAME) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["name", *titles, "status", "reason", *figures, *told])
        for run in runs:
            given = (run["parameters"].get(name) for name in parameters)
            measured = (run["figures"].get(name) for name in figures)
            table.writerow([run["name"], *given, run["status"], run["reason"], *measured, *(run[key] for key in told)])


def _keys(tables: Any) -> list[str]:
    """Return the keys of all tables, in the order of their first appearance."""
    return list(dict.fromkeys(key for table in tables for key in table))
