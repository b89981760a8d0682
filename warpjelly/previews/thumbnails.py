"""Small pictures of many runs, made to be compared: at the same times, from one place, in one range of colours."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from ..errors import verdict
from ..signals import interruptions
from ..stage.common import ForceRange, color_by, corners_of, force_range, motion_bounds, widest
from ..stage.prims import CAMERA
from ..stage.stagefiles import open_stage
from ..stage.surroundings import aim_camera
from .preview import brightest_frame
from .view import View

SIZE = (240, 135)
# A run has so many pictures, besides that of its hardest impact; fewer where that would be more in all.
_TIMES, _MOST_IN_ALL = 8, 2400
_QUALITY = 80
# How hard WebP looks for fewer bytes, 0 to 6.
_EFFORT = 2


@dataclass(frozen=True)
class Strip:
    """Pictures of a run."""

    image: bytes
    """WebP: the hardest impact, and then the run at the times of all strips, each to the right of the last."""
    impact: float
    """When that is, s from its start."""


@dataclass(frozen=True)
class Thumbnails:
    """Pictures of many runs."""

    strips: dict[str, Strip]
    times: list[float]
    """Of the pictures in each strip, but for the first, s from the start; a run that is shorter shows its end."""
    ranges: list[ForceRange | None]
    """Forces at both ends of the colours of each group, N."""
    problems: dict[str, str]
    """Why a run has no pictures."""


def draw_thumbnails(
    groups: Sequence[Mapping[str, Path]], progress: Callable[[int, int], None] = lambda done, total: None
) -> Thumbnails:
    """Draw runs.

    Args:
        groups: stages by the names of their runs. Those of one group are seen from one place, and their colours mean
            the same forces.
        progress: called after each run with the number of runs done and in all.

    Raises:
        InputError: pyvista or Pillow is not installed.
        EnvironmentFailedError: there is no offscreen OpenGL.
        KeyboardInterrupt: after the run that was drawn when Ctrl-C was pressed.
    """
    problems: dict[str, str] = {}
    shared, ends = [], [0.0]
    for group in groups:
        seen, ranges = [], []
        for name, path in group.items():
            with _noting(problems, name):
                stage = open_stage(path)
                seen += [corners_of(bounds)] if (bounds := motion_bounds(stage)) is not None else []
                ranges += [forces] if (forces := force_range(stage)) is not None else []
                ends.append((stage.GetEndTimeCode() - stage.GetStartTimeCode()) / stage.GetTimeCodesPerSecond())
        shared.append((np.concatenate(seen) if seen else None, widest(ranges) if ranges else None))
    total, done = sum(map(len, groups)), 0
    count = min(_TIMES, _MOST_IN_ALL // max(total, 1))
    times = np.linspace(0.0, max(ends), count).tolist() if count > 1 else []
    strips: dict[str, Strip] = {}
    # An exception at any moment, as while VTK is loading, can crash it.
    with interruptions() as interrupted, View(SIZE) as window:
        for group, (points, forces) in zip(groups, shared, strict=True):
            for name, path in group.items():
                if name not in problems:
                    with _noting(problems, name):
                        strips[name] = _draw(window, open_stage(path), times, points, forces)
                done += 1
                progress(done, total)
                if interrupted():
                    raise KeyboardInterrupt
    return Thumbnails(strips, times, [forces for _, forces in shared], problems)


@contextmanager
def _noting(problems: dict[str, str], name: str) -> Iterator[None]:
    """Note what goes wrong with a run: the others are drawn all the same."""
    try:
        yield
    except Exception as error:
        problems[name] = verdict(error)[0]


def _draw(
    window: View, stage: Usd.Stage, times: Sequence[float], points: np.ndarray | None, forces: ForceRange | None
) -> Strip:
    """Draw a run.

    Args:
        window: to draw in.
        stage: of the run.
        times: of the pictures after the first, s.
        points: what the camera is to see, m; what the stage's own sees if None.
        forces: at both ends of the colours, N; as in the stage if None.
    """
    from PIL import Image

    rate, first, last = stage.GetTimeCodesPerSecond(), round(stage.GetStartTimeCode()), round(stage.GetEndTimeCode())
    impact = brightest_frame(stage, first, last)
    # Those over a shot start when that does.
    frames = [impact, *(min(first + round(time * rate), last) for time in times)]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        if points is not None:
            camera = UsdGeom.Camera.Get(stage, CAMERA)
            aim_camera(camera, np.array(camera.GetCamera(first).transform)[:3, :3], points)
        if forces is not None and (own := force_range(stage)) is not None:
            color_by(stage.GetPseudoRoot(), own, forces, sorted(set(frames)))
    whole = Image.new("RGB", (len(frames) * SIZE[0], SIZE[1]))
    window.look_at(stage)
    drawn = {frame: Image.fromarray(window.render(frame)) for frame in sorted(set(frames))}
    for number, frame in enumerate(frames):
        whole.paste(drawn[frame], (number * SIZE[0], 0))
    file = io.BytesIO()
    whole.save(file, "WEBP", quality=_QUALITY, method=_EFFORT)
    return Strip(file.getvalue(), (impact - first) / rate)
