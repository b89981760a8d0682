"""How a stage gets to the disk: frame by frame, in a few files that are each whole or not there.

While a run is going its stage consists of a small root, one layer with the rest pose, and clips of some frames each.
The root is replaced after every clip. So what is on the disk can be opened at any moment and has only good samples, and
memory holds no more than the frames of a clip.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd

from ..colors import range_in_words
from ..errors import EnvironmentFailedError, InputError
from ..files import whole_file
from ..plan import clip_length
from ..scene import Scene
from ..shapes import Shape, ShapeFrame
from .histogram import ForceHistogram
from .layouts import World, layout_of
from .pack import has_forces, join_clips, recolor_clip
from .prims import WORLD
from .stagefiles import (
    CLIPS_NAME,
    GEOMETRY_NAME,
    MANIFEST_NAME,
    OVER_NAME,
    ROOT_NAME,
    STAGE_NAME,
    active_clips,
    clip_name,
    export_layer,
    open_stage,
    remove_parts,
    remove_stage,
    set_clips,
    set_progress,
)
from .usd import author_colors, declare_samples

log = logging.getLogger("warpjelly")


class StageWriter:
    """Writes the frames of a run into the stage of its directory."""

    def __init__(
        self,
        folder: Path,
        *,
        scene: Scene,
        shapes: Sequence[Shape],
        rest: Sequence[ShapeFrame],
        provenance: Mapping[str, object],
        resume: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Start a stage that can be opened, with its rest pose, or go on with one.

        A stage in one file that was there before stays until the new one is whole, unless it is gone on with.

        Args:
            folder: the run directory; it is made if missing.
            scene: what is simulated.
            shapes: what is shown.
            rest: a sample of each, for applications that ask for no time.
            provenance: where the result comes from; see ``usd.define_rest``.
            resume: ``arrays()`` of the writer whose stage is gone on with, after its last complete clip.

        Raises:
            InputError: what is to be gone on with is not there.
            EnvironmentFailedError: the folder cannot be made or written to.
        """
        self._folder = folder
        self._scene = scene
        self._shapes = list(shapes)
        self._layout = layout_of(scene, self._shapes, rest, folder)
        self._forces = ForceHistogram()
        self._fixed_range = None if scene.output.force_range == "auto" else scene.output.force_range
        self._starts: list[int] = []
        self._frame_count = 0
        _require_writable(folder)
        if resume is None:
            remove_stage(folder)
        else:
            self._restore(resume)
        self._clip_forces: list[list[np.ndarray]] = []
        self._clip = self._new_clip()
        self._write_rest(rest, provenance)
        self._write_root(finished=False)

    @property
    def clip_length(self) -> int:
        """Number of frames of a clip, after which to flush."""
        return clip_length(sum(len(shape.particles) for shape in self._shapes))

    @property
    def frame_count(self) -> int:
        """Number of frames that were written, those in memory included."""
        return self._frame_count

    @property
    def saved_count(self) -> int:
        """Number of frames that are on the disk."""
        return self._frame_count - len(self._clip_forces)

    def write_frame(self, index: int, samples: Sequence[ShapeFrame]) -> None:
        """Add one sample to the clip in memory.

        Args:
            index: number of the frame; frames arrive in order.
            samples: one for each shape, in the order of the shapes.
        """
        if index != self._frame_count:
            raise ValueError(f"frame {index} written where frame {self._frame_count} is due")
        for shape, sample in zip(self._shapes, samples, strict=True):
            self._layout.author(self._clip, index, shape, sample)
        self._clip_forces.append([np.array(sample.forces, np.float32) for sample in samples])
        self._frame_count += 1

    def flush(self) -> None:
        """Write the frames in memory as a clip, and then the root with it.

        Raises:
            EnvironmentFailedError: they cannot be written; the stage is as it was before.
        """
        if not self._clip_forces:
            return
        start = self.saved_count
        if self._colors_wait:
            for forces in self._clip_forces:
                self._forces.add(np.concatenate(forces))
        force_range = self._force_range()
        for index, forces in enumerate(self._clip_forces, start):
            for shape, own in zip(self._shapes, forces, strict=True):
                author_colors(self._clip, self._layout.time(index), shape, own, force_range)
        self._clip.startTimeCode = self._layout.time(start)
        self._clip.endTimeCode = self._layout.time(self._frame_count - 1)
        export_layer(self._clip, self._folder / CLIPS_NAME / clip_name(start))
        self._starts.append(start)
        self._clip_forces.clear()
        self._clip = self._new_clip()
        self._write_root(finished=False)

    def finish(self) -> None:
        """Bring the stage into its final form: all colours by one range, and one file if the scene says so.

        Raises:
            EnvironmentFailedError: it cannot be written; the stage in parts is as good as before.
        """
        self.flush()
        clips = [(time, self._folder / CLIPS_NAME / name) for time, name in self._clips()]
        whole_name = self._layout.whole_name if self._scene.output.format == "usdc" else None
        if whole_name is None:
            for _, clip in clips:
                recolor_clip(clip, self._force_range(), keep_forces=self._scene.output.forces)
        else:
            whole = Sdf.Layer.OpenAsAnonymous(str(self._folder / GEOMETRY_NAME))
            self._layout.define_motion(Usd.Stage.Open(whole), self.saved_count, self._force_range())
            join_clips(whole, clips, self._force_range(), self._folder / whole_name)
        if whole_name == STAGE_NAME:
            (self._folder / ROOT_NAME).unlink()
        else:
            self._write_root(finished=True)
        if whole_name is not None:
            remove_parts(self._folder)
        # Of a run that was replaced, or gone on with.
        for name in {STAGE_NAME, OVER_NAME} - {whole_name}:
            (self._folder / name).unlink(missing_ok=True)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return copies of what another writer needs besides the files to go on after the last clip."""
        return {"frame_count": np.array(self.saved_count), **self._layout.arrays(), **self._forces.arrays()}

    def _restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Go on after the last clip of another writer, even if its stage was brought into its final form."""
        self._frame_count = int(arrays["frame_count"])
        self._layout.restore(arrays)
        self._forces.restore(arrays)
        stage, folder = open_stage(self._folder), self._folder / CLIPS_NAME
        if clips := active_clips(stage):
            # The root is written before a checkpoint, so it may have more clips.
            starts = [self._layout.frame(time) for time, _ in clips]
            self._starts = [start for start in starts if start < self._frame_count]
        else:
            self._starts = [0]
            folder.mkdir(exist_ok=True)
            _link(self._folder / self._layout.whole_name, folder / clip_name(0))
        for start in self._starts:
            if not (folder / clip_name(start)).is_file():
                raise InputError(
                    f"{folder / clip_name(start)}: missing, so the run cannot go on; start anew with --force"
                )
        if self._colors_wait and not has_forces(folder / clip_name(0)):
            # They were removed when the run finished, and colours cannot be stretched over another range without.
            self._fixed_range = tuple(stage.GetPrimAtPath(WORLD).GetCustomDataByKey("legend")["range"])
            if self._scene.frame_count > self._frame_count:
                log.warning(
                    "%s: colours keep the range of the first %d frames, %s to %s N, whose forces were not kept; "
                    "with output.forces = true they would be",
                    *(self._folder, self._frame_count, *range_in_words(self._fixed_range)),
                )

    @property
    def _colors_wait(self) -> bool:
        """Whether there are colours whose range only the whole run gives."""
        return self._layout.shows_force and self._fixed_range is None

    def _force_range(self) -> tuple[float, float]:
        """Return the forces at both ends of the colours: as given, or those of the run so far."""
        return self._fixed_range or self._forces.color_range()

    def _new_clip(self) -> Sdf.Layer:
        clip = Sdf.Layer.CreateAnonymous(".usdc")
        forces = self._scene.output.forces or self._colors_wait
        declare_samples(clip, self._shapes, self._scene, forces=forces)
        return clip

    def _write_rest(self, rest: Sequence[ShapeFrame], provenance: Mapping[str, object]) -> None:
        layer, manifest = (Sdf.Layer.CreateAnonymous(suffix) for suffix in (".usdc", ".usda"))
        self._layout.define_rest(layer, rest, provenance, self._folder)
        declare_samples(manifest, self._shapes, self._scene, forces=self._scene.output.forces)
        (self._folder / CLIPS_NAME).mkdir(exist_ok=True)
        export_layer(layer, self._folder / GEOMETRY_NAME)
        export_layer(manifest, self._folder / CLIPS_NAME / MANIFEST_NAME)

    def _clips(self) -> list[tuple[float, str]]:
        """Return the first time code and the name of each clip."""
        return [(self._layout.time(start), clip_name(start)) for start in self._starts]

    def _write_root(self, *, finished: bool) -> None:
        """Write the root, which says which clip has which frames, or that one layer has them all."""
        root, layout = Sdf.Layer.CreateAnonymous(".usda"), self._layout
        layout.set_metadata(root)
        stage = Usd.Stage.Open(root)
        layout.define_motion(stage, self.saved_count, self._force_range())
        in_parts = not finished or self._scene.output.format == "clips"
        for path in layout.clip_prims if in_parts and self._starts else ():
            set_clips(stage.OverridePrim(path), self._clips(), layout.time(self.saved_count - 1))
        # Without the stage, which would look for the sublayers beside a layer that is nowhere yet.
        del stage
        if not finished:
            set_progress(root, self.saved_count, self._scene.frame_count)
        root.subLayerPaths = [f"./{GEOMETRY_NAME if in_parts else layout.whole_name}", *layout.under]
        export_layer(root, self._folder / ROOT_NAME)


def write_still(path: Path, *, scene: Scene, shapes: Sequence[Shape], rest: Sequence[ShapeFrame]) -> None:
    """Write shapes that do not move as a stage of one frame, in the colours of no force.

    Args:
        path: the file to make, .usdc.
        scene: what they are of.
        shapes: what is shown.
        rest: a sample of each.

    Raises:
        EnvironmentFailedError: the file cannot be written.
    """
    _require_writable(path.parent)
    layer, world = Sdf.Layer.CreateAnonymous(".usdc"), World(scene, shapes, rest)
    world.define_rest(layer, rest, {}, path.parent)
    for shape, sample in zip(shapes, rest, strict=True):
        world.author(layer, 0, shape, sample)
    world.define_motion(Usd.Stage.Open(layer), 1, (0.0, 1.0))
    export_layer(layer, path)


def _require_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise EnvironmentFailedError(f"{folder}: cannot make this directory: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise EnvironmentFailedError(f"{folder}: no permission to write in this directory")


def _link(file: Path, name: Path) -> None:
    """Give a file another name as well; where the file system cannot, make it a copy."""
    name.unlink(missing_ok=True)
    try:
        os.link(file, name)
    except OSError:
        with whole_file(name) as unfinished:
            shutil.copyfile(file, unfinished)
