"""The outcomes of a batch of results, made when somebody asks for them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from rlightning_aio.outcomes import own_end

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


class Endings(Protocol):
    """The columns of a batch that say how episodes ended."""

    @property
    def done(self) -> Any: ...
    @property
    def terminated(self) -> Any: ...
    @property
    def limit_reached(self) -> NDArray[np.bool_]: ...
    @property
    def restarted(self) -> NDArray[np.bool_]: ...
    def env_ids(self) -> list[str]: ...


def outcomes_of(
    batch: Endings, infos_of: Callable[[list[int]], list[dict[str, Any]]]
) -> NDArray[np.object_]:
    """See `BatchedData.outcome`; `infos_of` returns the infos of some rows."""
    over = all_agents(batch.done) | batch.restarted
    found = np.full(over.shape, None, np.object_)
    rows: list[int] = np.flatnonzero(over.reshape(len(over), -1).any(axis=1)).tolist()
    if not rows:
        return found
    terminated, cut, env_ids = all_agents(batch.terminated), batch.limit_reached, batch.env_ids()
    for row, info in zip(rows, infos_of(rows), strict=True):
        for place in np.argwhere(over[row]).tolist():  # One, and empty, without sub-environments.
            where = (row, *place)
            cause = "it reached the step limit" if cut[where] else "its env cut it"
            ended = bool(terminated[where])
            found[where] = own_end(env_ids[row], info, terminated=ended, cut=cause)
    return found


def summed_rewards(reward: Any) -> NDArray[np.float64]:
    """Sum rewards over agents."""
    if isinstance(reward, dict):
        reward = np.sum(list(cast("dict[str, Any]", reward).values()), axis=0)
    return np.asarray(reward, np.float64)


def all_agents(done: Any) -> NDArray[np.bool_]:
    """Return True for episodes that are over for all of their agents."""
    if isinstance(done, dict):
        return np.logical_and.reduce(list(cast("dict[str, Any]", done).values()))
    return done
