"""`EndlessEpisodes`: warns of an episode that may never end."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["EndlessEpisodes"]

_log = logging.getLogger("rlightning_aio")

_LONG: Final = 100_000


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
