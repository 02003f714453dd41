"""What `record_video` of a group does: starts and stops films of envs.

The worker of an env renders and encodes, so no frame is sent to the trainer. Filming starts and
stops by a call of the env, on any host.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.messages import RECORD_VIDEO
from rlightning_aio.config import VideoConfig
from rlightning_aio.errors import ConfigError, RLightningError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.core import Core

__all__ = ["film", "video_of"]


def video_of(
    folder: str | os.PathLike[str] | None,
    every: int,
    episodes: Sequence[int] | None,
    sub_env: int,
) -> VideoConfig | None:
    """Return the order to film, or None to stop.

    Raises:
        ConfigError: an argument is wrong.
    """
    if folder is None:
        return None
    numbers = None if episodes is None else tuple(episodes)
    try:
        return VideoConfig(folder=os.fspath(folder), sub_env=sub_env, every=every, episodes=numbers)
    except ConfigError as error:
        raise ConfigError(str(error).replace("VideoConfig", "record_video", 1)) from None


def film(core: Core, env_ids: Sequence[str] | None, video: VideoConfig | None) -> Procedure[None]:
    """Let envs begin to film, or end it; if one of them can't, none films."""
    ids = core.envs.local_ids if env_ids is None else dict.fromkeys(env_ids)
    slots = [core.envs.find_one(env_id) for env_id in ids]
    for place, slot in enumerate(slots):
        try:
            yield from _order(core, slot, video)
        except BaseException:
            for other in slots[:place]:
                with suppress(RLightningError):
                    yield from _order(core, other, None)
            raise


def _order(core: Core, slot: int, video: VideoConfig | None) -> Procedure[None]:
    return core.calls.call_one(time.monotonic(), slot, (RECORD_VIDEO, (video,), {}))
