"""Parts of both kinds of evaluation: success and length of an episode."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["EndlessEpisodes", "success_of"]

_log = logging.getLogger("rlightning_aio")

_LONG: Final = 100_000

_SUCCESS_KEYS: Final = ("success", "is_success")
"""In an info: Gymnasium's robotics and ManiSkill's name, and Stable-Baselines3's."""


class EndlessEpisodes:
    """Warns once, in the log, of an episode that may never end."""

    _seen = False

    def look(self, lengths: NDArray[np.int64], env_ids: Sequence[str]) -> None:
        """Look at the lengths of the episodes of a batch: ``[n]`` or ``[n, num_envs]``."""
        if self._seen or not (lengths == _LONG).any():
            return
        self._seen = True
        row = int(np.argwhere(lengths == _LONG)[0, 0])
        _log.warning(
            "an episode of env %r has made %d steps: if it never ends, neither does evaluate; "
            "max_episode_steps of its entry, or `with group.auto_reset(…):`, limits it",
            env_ids[row],
            _LONG,
        )


def success_of(info: dict[str, Any], sub_env: int = 0) -> bool | None:
    """Read the success of an episode from its last info, or from the ``final_info`` in it."""
    final: Any = info.get("final_info")
    marked: Any = info.get("_final_info")
    if isinstance(final, dict) and (marked is None or marked[sub_env]):
        info = cast("dict[str, Any]", final)  # The rest is about the next episode.
    for key in _SUCCESS_KEYS:
        given, known = info.get(key), info.get(f"_{key}")
        if given is not None and (known is None or known[sub_env]):
            # It may be a tensor on another device.
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given)
            return bool(array.reshape(-1)[sub_env if array.size > 1 else 0])
    return None
