"""`Camera`: films the episodes of an env in its own process.

It renders after each result and passes the frame to an encoder (`VideoFile`), so no frame travels.
A film begins with the frame after the reset and ends with the frame after the last step. If an env
begins the next episode within that step, the film ends with the frame before it.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np

from rlightning_aio._core.hosts.filming.video_file import VideoFile, find_ffmpeg
from rlightning_aio.files import check_folder, file_name
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import FilmOrder
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.slab import Slab

__all__ = ["Camera"]

_DEFAULT_FPS: Final = 30.0


class Camera:
    """Films the episodes of one env, or of one of its sub-environments.

    Raises:
        ImportError: ffmpeg isn't installed where the env lives.
        OSError: nothing can be written into the folder.
        ValueError: the env renders nothing, or can't be filmed.
    """

    def __init__(self, env: BaseEnv, order: FilmOrder) -> None:
        find_ffmpeg()
        _check_renders(env, order.sub_env)
        check_folder(order.folder)
        self._env, self._order = env, order
        self._name = file_name(env.env_id)
        if env.num_envs > 1:
            self._name += f"-sub-{order.sub_env}"
        self._fps = _fps(env)
        self._file: VideoFile | None = None
        self._number = _last_number(Path(order.folder), self._name)
        self._off = False

    def watch(self, slab: Slab, row: int, autoreset: str, limit: int | None) -> None:
        """Read from `row` what each result is."""
        agents = len(slab.layout.agents) or 1
        columns = (slab.is_reset, slab.over, slab.episode_length)
        self._is_reset, self._over, self._length = (
            column[row, ...].reshape(agents, -1)[:, self._order.sub_env] for column in columns
        )
        self._resets_itself = autoreset == "same_step"
        self._limit = limit

    def see(self) -> None:
        """Film the result that was just written into the row."""
        if self._off:
            return
        if self._is_reset.all():
            self._begin()
        elif self._file is not None or self._resets_itself:
            self._continue()

    def _begin(self) -> None:
        """Begin the next episode with the current frame."""
        self._finish()
        self._number += 1
        if self._order.wants(self._number):
            self._write()

    def _continue(self) -> None:
        over = bool(self._over.all())
        if over and self._resets_itself:
            self._begin()
            return
        if self._file is not None:
            self._write()
            if over or (self._limit is not None and self._length.max() >= self._limit):
                self._finish()

    def _write(self) -> None:
        frame = self._frame()
        try:
            if self._file is None:
                path = Path(self._order.folder) / f"{self._name}-episode-{self._number}.mp4"
                self._file = VideoFile(path, frame, self._fps)
            else:
                self._file.write(frame)
        except OSError as error:
            self._stop(error)

    def _finish(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            try:
                file.finish()
            except OSError as error:
                self._stop(error)

    def _stop(self, error: OSError) -> None:
        """Stop filming; a full disk must not end the training."""
        self._off, self._file = True, None
        sys.stderr.write(f"env {self._env.env_id!r} is no longer filmed: {error}\n")

    def _frame(self) -> NDArray[np.uint8]:
        frame = as_numpy(self._env.render_one(self._order.sub_env))
        array = np.asarray(frame)
        if array.ndim == 4 and len(array) == 1:  # ManiSkill's, of one sub-environment.
            array = array[0]
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
            found = type(frame).__name__ if array.ndim != 3 else f"{array.dtype}{array.shape}"
            raise ValueError(
                f"env {self._env.env_id!r} can't be filmed: render() gives {found}, not a uint8 "
                "array [height, width, 3]; a simulator of Gymnasium's does with "
                "env_kwargs: {render_mode: rgb_array}"
            )
        return array

    def close(self) -> None:
        """End the film of the current episode early."""
        file, self._file = self._file, None
        if file is not None:
            file.abandon()


def _check_renders(env: BaseEnv, sub_env: int) -> None:
    inner: Any = getattr(env.env, "unwrapped", env.env)
    if getattr(inner.__class__, "render", None) is gym.vector.VectorEnv.render:
        raise ValueError(
            f"env {env.env_id!r} can't be filmed: a {inner.__class__.__name__} renders nothing; "
            "film one with num_envs: 1"
        )
    mode = getattr(env.env, "render_mode", "rgb_array")
    if mode != "rgb_array":
        raise ValueError(
            f"env {env.env_id!r} can't be filmed: its render_mode is {mode!r}; make it with "
            "render_mode 'rgb_array', which goes into the entry's env_kwargs"
        )
    if sub_env >= env.num_envs:
        raise ValueError(
            f"env {env.env_id!r} has no sub-environment {sub_env} that could be "
            f"filmed: it has {env.num_envs}, from 0"
        )


def _fps(env: BaseEnv) -> float:
    metadata: Any = getattr(env.env, "metadata", None) or {}
    return float(metadata.get("render_fps") or _DEFAULT_FPS)


def _last_number(folder: Path, name: str) -> int:
    """Return the highest number of an episode that has a film; -1 if there is none.

    So a replaced worker and a resumed run continue the numbers.
    """
    pattern = re.compile(rf"{re.escape(name)}-episode-(\d+)\.mp4")
    found = (pattern.fullmatch(path.name) for path in folder.glob("*.mp4"))
    return max((int(match[1]) for match in found if match), default=-1)
