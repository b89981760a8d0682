"""Look at a stage without a USD viewer: pictures and movies through its own camera, and a page to look around in."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from ..errors import EnvironmentFailedError, InputError
from ..files import refuse_to_replace, whole_file
from ..stage.stagefiles import open_stage
from ..stage.validate import stage_problems
from .captions import captioned
from .movies import MOVIES, movie_writer
from .review import review_page
from .shown import left_out, shapes_in
from .view import View

log = logging.getLogger("warpjelly")

MIN_SIZE, MAX_SIZE = 16, 8192
MAX_PIXELS = 100_000_000
MAX_FPS = 120

_FORMATS = (".png", *MOVIES, ".html")


def render_preview(
    source: Path,
    output: Path,
    *,
    frames: Sequence[int] | None = None,
    every: int = 1,
    size: tuple[int, int] = (960, 540),
    force: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Show a stage as a file of the kind that its name tells.

    A PNG has frames side by side; MP4 and WebP are movies in real time; HTML is a page to look around in.

    Args:
        source: a stage file or a run directory.
        output: the file to make; it appears under its name only when it is complete.
        frames: numbers of frames. Of a PNG those to show; None shows the one with the greatest forces, which is the
            moment of the hardest impact, or the last where no colours show forces. Of a movie or page the first and the
            last; None shows all.
        every: a movie or page shows each ``every``-th frame from the first on.
        size: width and height of each frame of a picture or movie, pixels. Those of an MP4 are rounded up to even
            numbers.
        force: replace a file that is there already.
        progress: called after each frame, or shape of a page, with the number of those done and in all.

    Raises:
        InputError: the stage, the output name, a frame number or the size is wrong, the file is there already, or the
            extra ``preview`` is not installed.
        EnvironmentFailedError: there is no offscreen OpenGL, or the file cannot be written.
    """
    kind = output.suffix.lower()
    if kind not in _FORMATS:
        raise InputError(f"{output}: choose a name that ends in {', '.join(_FORMATS[:-1])} or {_FORMATS[-1]}")
    refuse_to_replace(output, force=force)
    if not all(MIN_SIZE <= side <= MAX_SIZE for side in size):
        raise InputError(f"size {size[0]}x{size[1]}: each side must be {MIN_SIZE} to {MAX_SIZE} pixels")
    stage = open_stage(source)
    # Damage that only shows when values are read would otherwise come as whatever trips over it.
    if problems := stage_problems(source):
        raise InputError(f"{source}: the stage is not sound, so it cannot be shown: {problems[0]}")
    if missing := left_out(stage):
        log.warning(
            "%s: not shown, since previews show meshes with fixed polygons, balls and lines alone: %s", source, missing
        )
    shown = _chosen_frames(stage, source, frames, every, single=kind == ".png")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(output) as unfinished:
            if kind == ".png":
                _write_picture(stage, unfinished, shown, size, progress)
            elif kind == ".html":
                unfinished.write_text(review_page(stage, shown, progress), encoding="utf-8")
            else:
                _write_movie(stage, unfinished, shown, every, size, progress)
    except OSError as error:
        raise EnvironmentFailedError(f"{output}: cannot write the preview: {error.strerror or error}") from error


def _chosen_frames(
    stage: Usd.Stage, source: Path, frames: Sequence[int] | None, every: int, *, single: bool
) -> list[int]:
    first, last = round(stage.GetStartTimeCode()), round(stage.GetEndTimeCode())
    for frame in frames or []:
        if not first <= frame <= last:
            raise InputError(f"{source}: no frame {frame}; frames are {first} to {last}")
    if single:
        if every != 1:
            raise InputError("a picture shows single frames: choose them with --frame; --every is for movies and pages")
        if frames is None:
            return [brightest_frame(stage, first, last)]
        if not frames:
            raise InputError("no frame to show")
        return list(frames)
    if every < 1:
        raise InputError(f"every {every}: it must be at least 1")
    if frames is not None:
        if len(frames) != 2 or frames[0] > frames[1]:
            raise InputError("movies and pages show all frames, or those from the first to the second of two --frame")
        first, last = frames
    return list(range(first, last + 1, every))


def brightest_frame(stage: Usd.Stage, first: int, last: int) -> int:
    """Return the frame with the brightest bodies, which have the greatest forces; without colours, the last."""
    brightness = np.zeros(last - first + 1)
    for mesh in shapes_in(stage, UsdGeom.PointBased):
        primvar = UsdGeom.Primvar(mesh.GetDisplayColorAttr())
        if primvar.ValueMightBeTimeVarying():
            brightness += [np.sum(np.array(primvar.ComputeFlattened(t))[:, 1]) for t in range(first, last + 1)]
    return first + int(np.argmax(brightness)) if brightness.any() else last


def _write_picture(
    stage: Usd.Stage, path: Path, frames: list[int], size: tuple[int, int], progress: Callable[[int, int], None]
) -> None:
    if len(frames) * size[0] * size[1] > MAX_PIXELS:
        raise InputError(f"{len(frames)} frames of {size[0]}x{size[1]}: more than {MAX_PIXELS:,} pixels")
    panels = []
    with View(size) as view:
        view.look_at(stage)
        for frame in frames:
            panels.append(view.render(frame))
            progress(len(panels), len(frames))
    captioned(stage, frames, panels, with_legend=view.shows_force).save(path, format="PNG")


def _write_movie(
    stage: Usd.Stage,
    path: Path,
    frames: list[int],
    every: int,
    size: tuple[int, int],
    progress: Callable[[int, int], None],
) -> None:
    if path.suffix.lower() == ".mp4":
        # Colours are stored for two by two pixels, which every player understands.
        size = (size[0] + size[0] % 2, size[1] + size[1] % 2)
    fps = stage.GetTimeCodesPerSecond() / every
    if fps > MAX_FPS:
        least = math.ceil(stage.GetTimeCodesPerSecond() / MAX_FPS)
        raise InputError(f"{fps:g} frames a second are more than movies show: thin them with --every {least}")
    with View(size) as view, movie_writer(path, size, fps) as add:
        view.look_at(stage)
        for done, frame in enumerate(frames, start=1):
            picture = view.render(frame)
            add(captioned(stage, [frame], [picture], with_legend=view.shows_force))
            progress(done, len(frames))
