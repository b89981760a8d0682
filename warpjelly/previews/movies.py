"""MP4 and animated WebP, encoded by ffmpeg."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

from ..errors import EnvironmentFailedError, InputError

# H.264 as browsers play it, from the first bytes of the file on; the quality is 0 to 51, lower is better. WebP that
# repeats for ever; the quality goes up to 100, higher is better.
_ENCODERS = {
    ".mp4": "-codec:v libx264 -pix_fmt yuv420p -crf 18 -movflags +faststart",
    ".webp": "-codec:v libwebp_anim -pix_fmt yuva420p -quality 90 -loop 0",
}
MOVIES = tuple(_ENCODERS)


@contextmanager
def movie_writer(path: Path, size: tuple[int, int], fps: float) -> Iterator[Callable[[Any], object]]:
    """Give a function that adds a picture to a movie; the movie is complete when the block ends.

    Args:
        path: the file to make, ``.mp4`` (both sides even) or ``.webp``.
        size: width and height of its pictures, pixels.
        fps: frames per second.

    Raises:
        InputError: imageio-ffmpeg is not installed.
        EnvironmentFailedError: there is no ffmpeg for this kind of machine.
        OSError: ffmpeg failed.
    """
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise InputError("movies need imageio-ffmpeg: pip install 'warpjelly[preview]'") from error
    try:
        ffmpeg = get_ffmpeg_exe()
    except RuntimeError as error:
        raise EnvironmentFailedError(f"movies need ffmpeg: {error}") from error
    rate = str(Fraction(fps).limit_denominator(100_000))
    pictures = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}", "-r", rate, "-i", "-"]
    encoder = _ENCODERS[path.suffix.lower()].split()
    command = [ffmpeg, "-y", "-v", "error", *pictures, *encoder, str(path)]
    with tempfile.TemporaryFile("w+") as said:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said) as process:
            pipe = process.stdin
            assert pipe is not None
            try:
                yield lambda picture: pipe.write(picture.tobytes())
                pipe.close()
            except BrokenPipeError:
                # ffmpeg has gone, and said why.
                process.wait()
            except BaseException:
                process.kill()
                raise
        if process.returncode:
            said.seek(0)
            # The last line of what it said is the one that counts.
            *_, reason = said.read().strip().split("\n")
            raise OSError(f"ffmpeg: {reason}")
