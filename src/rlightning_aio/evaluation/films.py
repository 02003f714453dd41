"""`Films`: the first episode of each task as an MP4 file, of frames that the env renders.

Rule: the env is asked for a frame after each result, while it has nothing else to do, so it may
live anywhere. Only the film of an episode that has ended gets its name.
"""

from __future__ import annotations

import importlib
import re
import zlib
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.attempts.spec import written
from rlightning_aio.errors import EnvRaised
from rlightning_aio.files import check_folder, file_name, finish_file
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    import os
    from collections.abc import Generator

    from rlightning_aio.attempts.queue import Job
    from rlightning_aio.attempts.records import Attempt
    from rlightning_aio.collecting.procedure import Procedure

_DEFAULT_FPS: Final = 30.0
_PLAYABLE: Final = (
    # Most players need halved chroma, so sizes must be even; envs need the other cores.
    *("-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-preset", "veryfast", "-threads", "1"),
)


class Films:
    """The films of an evaluation.

    Args:
        group: its envs have no sub-environments.
        folder: for the files, created if missing; None for no films.

    Attributes:
        are_wanted: there is a folder.
        filmed: the encoder by env; None before the first frame.

    Raises:
        ImportError: the encoder isn't installed.
        OSError: nothing can be written into the folder.
    """

    def __init__(self, group: Any, folder: str | os.PathLike[str] | None) -> None:
        self._group, self._folder = group, Path(folder or "")
        self.are_wanted = folder is not None
        self._first: dict[tuple[str, str], tuple[Any, ...]] = {}
        """The episode to film, by entry and task."""
        self.filmed: dict[str, Generator[None, Any] | None] = {}
        if folder is None:
            return
        try:
            self._encoder: Any = importlib.import_module("imageio_ffmpeg")
        except ImportError as error:
            hint = "films need imageio-ffmpeg: pip install 'rlightning-aio[video]'"
            raise ImportError(hint) from error
        check_folder(folder)

    def check(self) -> Procedure[None]:
        """Ask each env whether it renders frames.

        Raises:
            ValueError: one doesn't.
        """
        for env_id in self._group.env_ids if self.are_wanted else ():
            mode = yield from self._attribute(env_id, "render_mode")
            if mode != "rgb_array":
                raise ValueError(
                    f"{env_id} can't be filmed: its render_mode is {mode!r}; make it with "
                    "render_mode 'rgb_array', which goes into the entry's env_kwargs"
                )

    def begin(self, env_id: str, job: Job) -> None:
        """Film the episode that begins, if it is the first of its task, or that one once more."""
        if not self.are_wanted:
            return
        episode = job.spec, job.index
        if self._first.setdefault((job.spec.entry, job.spec.task), episode) == episode:
            self.filmed[env_id] = None

    def see(self, env_id: str) -> Procedure[None]:
        """Add a frame of an idle env to its film.

        Raises:
            EnvFault: it can't be rendered.
            ValueError: what it renders is no frame, or of another size than the ones before.
            OSError: the encoder has ended, as on a full disk.
        """
        frame = np.asarray(as_numpy((yield self._group[env_id].render)))
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(
                f"{env_id} can't be filmed: render() gives {frame.dtype}{list(frame.shape)}, not a "
                "uint8 array [height, width, 3]"
            )
        film = self.filmed[env_id]
        if film is None:
            metadata: dict[str, Any] = (yield from self._attribute(env_id, "metadata")) or {}
            film = self.filmed[env_id] = self._encoder.write_frames(
                str(self._partial(env_id)),
                (frame.shape[1], frame.shape[0]),
                fps=float(metadata.get("render_fps") or _DEFAULT_FPS),
                macro_block_size=1,
                output_params=[*_PLAYABLE],
            )
            next(film)
        film.send(np.ascontiguousarray(frame))

    def keep(self, attempt: Attempt) -> None:
        """Close the film of an episode that has ended, and give it its name."""
        if (film := self.filmed.pop(attempt.env_id, None)) is not None:
            film.close()
            finish_file(self._partial(attempt.env_id), self._folder / _name(attempt))

    def drop(self, env_id: str) -> None:
        """Delete what was filmed of an episode that was lost."""
        if (film := self.filmed.pop(env_id, None)) is not None:
            film.close()
            self._partial(env_id).unlink(missing_ok=True)

    def close(self) -> None:
        """Delete the films of episodes that have no end."""
        for env_id in [*self.filmed]:
            self.drop(env_id)

    def _attribute(self, env_id: str, name: str) -> Procedure[Any]:
        try:
            return (yield partial(self._group[env_id].get_attr, name))
        except EnvRaised:
            return None

    def _partial(self, env_id: str) -> Path:
        return self._folder / f"{file_name(env_id)}.partial.mp4"


def _name(attempt: Attempt) -> str:
    spec = attempt.spec
    options = written(spec.options)
    number = f"-{zlib.crc32(options.encode()):08x}" if options else ""
    if spec.env_id:
        number += f"-{spec.env_id}-episode-{attempt.index}"
    return re.sub(r"[^\w.-]+", "_", f"{spec.entry}-{spec.task}-seed-{spec.seed}{number}") + ".mp4"
