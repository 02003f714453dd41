"""What `record_video` of a group does: starts and stops films of envs.

The worker of an env renders and encodes, so no frame is sent to the trainer. Filming starts and
stops by a call of the env, on any host; the replacement of a worker gets the order again.
"""

from __future__ import annotations

import os
import time
from contextlib import suppress
from typing import TYPE_CHECKING

from rlightning_aio._core.hosts.messages import RECORD_VIDEO, FilmOrder
from rlightning_aio.errors import ConfigError, RLightningError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.core import Core

__all__ = ["film", "film_order"]


def film_order(
    folder: str | os.PathLike[str] | None,
    every: int,
    episodes: Sequence[int] | None,
    sub_env: int,
) -> FilmOrder | None:
    """Return the order to film, or None to stop.

    Raises:
        ConfigError: an argument is wrong.
    """
    if folder is None:
        return None
    path = os.fspath(folder)
    if not path:
        raise ConfigError("record_video: folder: should not be empty")
    for name, number, least in (("every", every, 1), ("sub_env", sub_env, 0)):
        if number < least:
            raise ConfigError(f"record_video: {name}: should be at least {least}, got {number}")
    # A "~" that names no user is part of the name.
    path = os.path.abspath(os.path.expanduser(path))  # noqa: PTH100, PTH111
    return FilmOrder(path, every, None if episodes is None else tuple(episodes), sub_env)


def film(core: Core, env_ids: Sequence[str] | None, order: FilmOrder | None) -> Procedure[None]:
    """Let envs begin to film, or end it; if one of them can't, none films."""
    ids = core.envs.local_ids if env_ids is None else dict.fromkeys(env_ids)
    slots = [core.envs.find_one(env_id) for env_id in ids]
    for place, slot in enumerate(slots):
        try:
            yield from _film_one(core, slot, order)
        except BaseException:
            for other in slots[:place]:
                with suppress(RLightningError):
                    yield from _film_one(core, other, None)
            raise


def _film_one(core: Core, slot: int, order: FilmOrder | None) -> Procedure[None]:
    films = core.tables.record_of(slot).films
    if order is None:
        films.pop(slot, None)
    yield from core.calls.call_one(time.monotonic(), slot, (RECORD_VIDEO, (order,), {}))
    if order is not None:
        films[slot] = order
