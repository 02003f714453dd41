"""`record_video`: films of chosen envs of a group, as Gymnasium's `RecordVideo` makes of one env.

An env is filmed where it lives: its worker renders and encodes, and no frame crosses to the
trainer. Each is told by a call, as of a method, whatever its host.
"""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from rlightning_aio.collecting.procedure import run
from rlightning_aio.config import VideoConfig
from rlightning_aio.errors import ConfigError, RLightningError
from rlightning_aio.hosts.messages import RECORD_VIDEO

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio.collecting.procedure import Procedure
    from rlightning_aio.group.aio import EnvGroup as AsyncEnvGroup
    from rlightning_aio.group.sync import EnvGroup as SyncEnvGroup

__all__ = ["record_video"]


def record_video(
    group: AsyncEnvGroup | SyncEnvGroup,
    env_ids: Sequence[str],
    folder: str | os.PathLike[str] | None,
    *,
    sub_env: int = 0,
    every: int = 1,
    episodes: Sequence[int] | None = None,
) -> Any:
    """Film envs of a running group, from their next episode on; or no longer.

    To be awaited where the group is asynchronous. The envs must be idle: call it before the first
    reset, or while their results are collected and not answered. A later call for the same env
    replaces an earlier one.

    Args:
        group: initialised.
        env_ids: which envs. One that shares its worker makes its neighbours wait for frames; the
            field ``video`` of its entry gives it a worker of its own.
        folder: gets ``<env id>-episode-<n>.mp4``, or, of an env with sub-environments,
            ``<env id>-sub-<k>-episode-<n>.mp4``; it is created if missing. An unfinished episode
            is called ``….partial.mp4``. A folder that has films of the env already
            gets further ones: n goes on from the last. None: film no longer; a film under way
            ends here, as a partial one.
        sub_env: which of an env's sub-environments.
        every: film episodes 0, every, 2 * every, … of each, counted from now on.
        episodes: film only these.

    ``render`` must give frames ``[height, width, 3]`` uint8, as Gymnasium's envs do that are made
    with ``render_mode: rgb_array``. A film has the simulator's ``render_fps``.

    Raises (no env of `env_ids` is filmed then):
        EnvRaised: an env renders nothing, has no such sub-environment, or finds no ffmpeg or
            folder.
        EnvBusy: an env has a reply outstanding.
        UnknownEnv: no env of this group has that id.
        NotImplementedError: an env is an env_server's.
        WorkerDied, EnvHung: a worker ended meanwhile. Replacements are not filmed.
        ConfigError: `sub_env`, `every` or `episodes` isn't what it should be.
        GroupClosed: the group was not initialised, or is closed.
    """
    video = None if folder is None else _video(folder, sub_env, every, episodes)
    handles = [group[env_id] for env_id in dict.fromkeys(env_ids)]
    return run(_record(handles, video), group)


def _video(
    folder: str | os.PathLike[str], sub_env: int, every: int, episodes: Sequence[int] | None
) -> VideoConfig:
    numbers = None if episodes is None else tuple(episodes)
    try:
        return VideoConfig(folder=os.fspath(folder), sub_env=sub_env, every=every, episodes=numbers)
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigError(
            f"record_video: {first['loc'][0]}: {first['msg']}, not {first['input']!r}"
        ) from None


def _record(handles: Sequence[Any], video: VideoConfig | None) -> Procedure[None]:
    for place, handle in enumerate(handles):
        try:
            yield partial(handle.call, RECORD_VIDEO, video)
        except BaseException:
            for other in handles[:place]:
                with suppress(RLightningError):
                    yield partial(other.call, RECORD_VIDEO, None)
            raise
