"""What the runs of a batch will take, before they are begun."""

from __future__ import annotations

import heapq
import json
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import WarpjellyError, verdict
from ..machine import memory_limit, threads_of
from ..plan import CLIP_FRAMES, PLACEMENT, plan_scene
from ..run import forecast
from ..scene import Scene
from .specs import Entry

# What has no say in how much memory a scene takes, nor, but for contacts, in how long a substep does.
_FREE = {"name", "duration", "frames", "fps", "gravity", "contact", "expect"}


class Estimator:
    """Estimates what runs need; what differs in numbers only, as the runs of a sweep do, is built and measured once."""

    def __init__(self) -> None:
        self._memory: dict[str, int | WarpjellyError] = {}
        self._forecasts: dict[str, tuple[Scene, dict[str, Any]]] = {}

    def memory_bytes(self, scene: Scene) -> int:
        """Return the peak of memory, bytes.

        Raises:
            InputError: the scene cannot be built.
        """
        # Clips of the stage are in memory until they are whole.
        key = f"{_structure(scene)} {min(scene.frame_count, CLIP_FRAMES)}"
        if key not in self._memory:
            try:
                self._memory[key] = plan_scene(scene).memory_bytes
            except WarpjellyError as error:
                self._memory[key] = error
        known = self._memory[key]
        if isinstance(known, WarpjellyError):
            raise known
        return known

    def forecast(self, scene: Scene, *, device: str, threads: int | None = None) -> dict[str, Any]:
        """Return ``particles, springs, frames, memory_bytes, seconds`` of a run.

        Raises:
            InputError: the scene cannot be built.
        """
        if scene.solver.dt == "auto":
            # Then all of the scene decides how many substeps there are.
            figures = forecast(scene, device=device, threads=threads)
            share = 1.0
        else:
            key = _structure(scene)
            if key not in self._forecasts:
                self._forecasts[key] = scene, forecast(scene, device=device, threads=threads)
            first, figures = self._forecasts[key]
            share = _substeps(scene) / _substeps(first)
        names = ("particles", "springs", "memory_bytes")
        told = {name: figures[name] for name in names}
        return {**told, "frames": scene.frame_count, "seconds": figures["seconds"] * share}


def _substeps(scene: Scene) -> float:
    """Return the number of substeps of a run whose step is given."""
    assert scene.solver.dt != "auto"
    return max(scene.frame_count - 1, 1e-9) * scene.substeps_for(scene.solver.dt)


def _structure(scene: Scene) -> str:
    """Return what two scenes have in common that differ in numbers only."""
    data = scene.model_dump(mode="json", exclude=_FREE)
    data["bodies"] = [{key: body[key] for key in body.keys() - PLACEMENT} for body in data["bodies"]]
    data["materials"] = {name: material["law"] for name, material in data["materials"].items()}
    data["colliders"] = [collider["type"] for collider in data["colliders"]]
    data["fields"] = [field["type"] for field in data["fields"]]
    data["soft_contact"] = data["soft_contact"]["mode"]
    for key in ("dt", "steps_per_frame"):
        data["solver"].pop(key)
    return json.dumps(data, sort_keys=True)


def estimate(
    entries: Sequence[Entry],
    *,
    workers: int,
    device: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Say what a batch takes on this machine, without doing it.

    Args:
        entries: its runs.
        workers: how many are at work.
        device: as for ``forecast``.
        progress: called after each run with the number of runs done and in all.

    Returns:
        ``runs``, each with ``name, source, parameters, problem`` (None if it is sound), and ``particles, springs,
        frames, memory_bytes, seconds``, None with a problem; ``workers``; ``seconds`` and ``memory_bytes`` of all,
        with so many workers.
    """
    estimator, runs = Estimator(), []
    for number, entry in enumerate(entries, 1):
        figures: dict[str, Any] = dict.fromkeys(("particles", "springs", "frames", "memory_bytes", "seconds"))
        problem = entry.problem
        if entry.scene is not None:
            try:
                figures = estimator.forecast(entry.scene, device=device, threads=threads_of(workers))
            except Exception as error:
                # Whatever is wrong with one scene, memory too small for it included, is not wrong with the others.
                problem = f"{entry.source}: {verdict(error)[0]}"
        about = {"name": entry.name, "source": entry.source, "parameters": entry.parameters, "problem": problem}
        runs.append({**about, **figures})
        progress(number, len(entries))
    sound = [run for run in runs if run["problem"] is None]
    largest = sorted((run["memory_bytes"] for run in sound), reverse=True)[:workers]
    return {
        "runs": runs,
        "workers": workers,
        "seconds": _makespan([run["seconds"] for run in sound], workers),
        "memory_bytes": min(sum(largest), max([int(memory_limit()), *largest[:1]])),
    }


def _makespan(seconds: Sequence[float], workers: int) -> float:
    """Return how long it takes to do jobs in order, each by the worker that is free first."""
    free = [0.0] * workers
    for duration in seconds:
        heapq.heapreplace(free, free[0] + duration)
    return max(free)
