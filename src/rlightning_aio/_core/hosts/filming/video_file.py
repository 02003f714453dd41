"""`VideoFile`: writes the frames of one episode to one MP4 file.

Rule: only a complete file has the requested name. Until then, and if its process dies, it is called
``….partial.mp4``. A separate ffmpeg process closes such a file properly when its input ends, so it
can be played.
"""

from __future__ import annotations

import os
import subprocess
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.files import check_regular, check_writable, finish_file

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["VideoFile", "find_ffmpeg"]

_NICE: Final = 10
"""Stepping has priority over encoding."""


def find_ffmpeg() -> str:
    """Return the path of ffmpeg.

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
    """An MP4 file that is being written.

    Args:
        path: of the complete file, ``<folder>/<name>.mp4``.
        frame: the first frame, ``[height, width, 3]`` uint8; all others have its shape.
        fps: frames per second when it is played.

    Raises:
        ImportError: ffmpeg isn't installed.
        OSError: it can't be started, or the file can't be written.
    """

    def __init__(self, path: Path, frame: NDArray[np.uint8], fps: float) -> None:
        self._path = path
        self._partial = path.with_suffix(".partial.mp4")
        self._shape = frame.shape
        height, width, _ = frame.shape
        check_writable(path)
        # The ffmpeg of a dead worker may still write to it.
        check_regular(self._partial)
        self._partial.unlink(missing_ok=True)
        # In its own session, because Ctrl-C would reach it, too.
        self._ffmpeg = subprocess.Popen(
            [
                *(find_ffmpeg(), "-loglevel", "error"),
                *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"),
                *("-r", str(fps), "-i", "-", "-an"),
                # Most players need halved chroma, so sizes must be even.
                *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"),
                # Without a limit it would use all cores, which envs need.
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
            ValueError: its shape differs from that of the first frame.
            OSError: ffmpeg has ended, as on a full disk; the message includes its output.
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
        """Close the file and give it its name: the episode is over.

        Raises:
            OSError: the file couldn't be written.
        """
        self._end()
        finish_file(self._partial, self._path)

    def abandon(self) -> None:
        """Close the file early; it keeps its partial name."""
        self._end()

    def _end(self) -> None:
        _, said = self._ffmpeg.communicate()
        if self._ffmpeg.returncode:
            words = said.decode(errors="replace").strip() or f"code {self._ffmpeg.returncode}"
            raise OSError(f"ffmpeg has failed to write {self._partial}: {words}")
