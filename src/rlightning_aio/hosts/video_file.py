"""`VideoFile`: frames of one episode become one MP4 file.

Rule: only a file that has all frames of its episode has the name that was asked for. Until then,
and if its process dies, it is called ``….partial.mp4``; ffmpeg, a process of its own, ends such a
file properly when its input ends, so what there is can be played.
"""

from __future__ import annotations

import os
import subprocess
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["VideoFile", "find_ffmpeg"]

_NICE: Final = 10
"""Who steps comes before who encodes."""


def find_ffmpeg() -> str:
    """The program that encodes.

    Raises:
        ImportError: it isn't installed.
    """
    try:
        import imageio_ffmpeg  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "videos need imageio-ffmpeg: pip install 'rlightning-aio[video]'"
        ) from error
    return cast("Any", imageio_ffmpeg).get_ffmpeg_exe()


class VideoFile:
    """One file that is being written.

    Args:
        path: what it is to be called, ``<folder>/<name>.mp4``.
        frame: the first one, ``[height, width, 3]`` uint8; all others have its shape.
        fps: frames to a second when it is played.

    Raises:
        ImportError: ffmpeg isn't installed.
        OSError: it can't be started.
    """

    def __init__(self, path: Path, frame: NDArray[np.uint8], fps: float) -> None:
        self._path = path
        self._partial = path.with_suffix(".partial.mp4")
        self._shape = frame.shape
        height, width, _ = frame.shape
        # The ffmpeg of a worker that has died may still be at work on it.
        self._partial.unlink(missing_ok=True)
        # In a session of its own, as Ctrl-C would reach it, too.
        self._ffmpeg = subprocess.Popen(
            [
                *(find_ffmpeg(), "-loglevel", "error"),
                *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"),
                *("-r", str(fps), "-i", "-", "-an"),
                # What most players take: chroma by the half, so sizes must be even.
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"),
                # By itself it would take all cores, which others step on.
                *("-c:v", "libx264", "-preset", "veryfast", "-threads", "1", str(self._partial)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        os.setpriority(os.PRIO_PROCESS, self._ffmpeg.pid, _NICE)
        self.write(frame)

    def write(self, frame: NDArray[np.uint8]) -> None:
        """Add a frame.

        Raises:
            ValueError: it has another shape than the first one.
            OSError: ffmpeg has ended, as on a full disk; the message has what it said.
        """
        if frame.shape != self._shape:
            raise ValueError(f"a frame has shape {frame.shape}, the ones before {self._shape}")
        assert self._ffmpeg.stdin is not None
        try:
            self._ffmpeg.stdin.write(np.ascontiguousarray(frame).data)
        except BrokenPipeError:
            self._end()
            raise

    def finish(self) -> None:
        """The episode is over: the file gets its name.

        Raises:
            OSError: the file couldn't be written.
        """
        self._end()
        self._partial.replace(self._path)

    def abandon(self) -> None:
        """No more frames will come; what there is stays, marked as partial."""
        self._end()

    def _end(self) -> None:
        _, said = self._ffmpeg.communicate()
        if self._ffmpeg.returncode:
            words = said.decode(errors="replace").strip() or f"code {self._ffmpeg.returncode}"
            raise OSError(f"ffmpeg has failed to write {self._partial}: {words}")
