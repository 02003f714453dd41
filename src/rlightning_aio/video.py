"""`record_video`: films chosen envs of a group, as Gymnasium's `RecordVideo` films one env.

The worker of an env renders and encodes, so no frame is sent to the trainer. Filming starts and
stops by a call of the env, on any host.
"""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.messages import RECORD_VIDEO
from rlightning_aio.collecting.procedure import run
from rlightning_aio.config import VideoConfig
from rlightning_aio.errors import ConfigError, RLightningError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
    from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
    from rlightning_aio.collecting.procedure import Procedure

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
    """Start filming envs of a running group with their next episode; or stop filming.

    Await it if the group is asynchronous. The envs must be idle: call it before the first reset, or
    between collecting their results and answering them. A later call for an env replaces an
    earlier one.

    Args:
        group: an initialised group.
        env_ids: the envs to film. Envs that share a worker wait while it renders; the field
            ``video`` of a config entry gives the env a separate worker.
        folder: for ``<env id>-episode-<n>.mp4``, or ``<env id>-sub-<k>-episode-<n>.mp4`` of envs
            with sub-environments; created if missing. An unfinished episode is called
            ``….partial.mp4``. If the folder has films of the env, n continues after the last one.
            None stops filming; a film in progress becomes a partial one.
        sub_env: index of the sub-environment to film.
        every: film episodes 0, every, 2 * every, … of each, counted from now.
        episodes: film only these.

    ``render`` must return frames ``[height, width, 3]`` uint8, as Gymnasium's envs do with
    ``render_mode: rgb_array``. A film has the simulator's ``render_fps``.

    Raises (and films no env of `env_ids`):
        EnvRaised: an env renders nothing or has no such sub-environment, or ffmpeg or the folder
            is missing.
        EnvBusy: an env has a request outstanding.
        UnknownEnv: no env of this group has that id.
        NotImplementedError: an env belongs to an env_server.
        WorkerDied, EnvHung: a worker ended. Replacements are not filmed.
        ConfigError: `sub_env`, `every` or `episodes` is invalid.
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
    except ConfigError as error:
        raise ConfigError(str(error).replace("VideoConfig", "record_video", 1)) from None


def _record(handles: Sequence[Any], video: VideoConfig | None) -> Procedure[None]:
    for place, handle in enumerate(handles):
        try:
            yield partial(handle.call, RECORD_VIDEO, video)
        except BaseException:
            for other in handles[:place]:
                with suppress(RLightningError):
                    yield partial(other.call, RECORD_VIDEO, None)
            raise
