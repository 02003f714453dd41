"""What this library asks of a batch, and users don't: functions, to keep them from users.

`data` has the contents themselves: parts, origin, sources, columns of responses.
"""

from __future__ import annotations

from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.batch.data import columns_of_responses, origin_of, parts_of
from rlightning_aio.batch.endings import all_agents, summed_rewards
from rlightning_aio.batch.parts import (
    column_of_parts,
    infos_of_parts,
    reported_infos_of_parts,
    rows_in_order,
)
from rlightning_aio.batch.rets import rets_of
from rlightning_aio.trees import walked, zipped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.batch.data import BatchedData, Issuer
    from rlightning_aio.batch.names import EnvNames

__all__ = [
    "all_agents",
    "any_reset",
    "are_over",
    "columns_of_responses",
    "ended_episodes",
    "has_ended",
    "lost_rows",
    "names_of",
    "plain_columns",
    "reported_info_list",
    "reported_infos",
    "slots_of",
    "slots_of_results",
    "summed_rewards",
]


def reported_infos(batch: BatchedData) -> dict[str, Any]:
    """`BatchedData.infos` of a batch of results, without the sums of episodes."""
    return infos_of_parts(parts_of(batch), episodes=False)


def reported_info_list(batch: BatchedData) -> list[dict[str, Any]]:
    """`BatchedData.info` of a batch of results, without the sums of episodes."""
    return reported_infos_of_parts(parts_of(batch))


def plain_columns(batch: BatchedData) -> ResultColumns | None:
    """The columns of a batch whose properties of the same names equal them; None for others."""
    parts = parts_of(batch)
    if len(parts) != 1:
        return None
    part = parts[0]
    unlike = part.positions is not None or part.whole_results or part.agents
    return None if unlike or part.observation is None or not len(part.slots) else part


def has_ended(batch: BatchedData) -> NDArray[np.bool_]:
    """Mask of rows whose episode has ended and was not reset since; shaped like `is_reset`."""
    parts = parts_of(batch)
    if not parts:
        return np.zeros(0, np.bool_)
    return (
        parts[0].has_ended if len(parts) == 1 else column_of_parts(parts, attrgetter("has_ended"))
    )


def ended_episodes(
    batch: BatchedData, rows: Sequence[int]
) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Sums of the episodes that ended in `rows`, and the infos that the envs reported there.

    The sums are ``r`` and ``l``: numbers, or arrays ``[num_envs]``. Rewards of agents are added.
    They are empty where the group counted no episode.
    """
    places = rows_in_order(parts_of(batch))
    chosen = [places[row] for row in rows]
    return [(part.episode_of_all(row), part.reported_info_of(row)) for part, row in chosen]


def slots_of(batch: BatchedData, group: Issuer) -> NDArray[np.intp] | None:
    """Slots of the envs, each once, if the batch was made by `group`."""
    origin = origin_of(batch)
    if origin is None or origin.group is not group or origin.repeats:
        return None
    return origin.slots


def slots_of_results(batch: BatchedData) -> NDArray[np.intp]:
    """Slots of the envs of a batch of results, in order."""
    origin = origin_of(batch)
    assert origin is not None
    return origin.slots


def names_of(batch: BatchedData) -> EnvNames | None:
    """Names of the envs of the group when it returned the batch; None for plain values."""
    origin = origin_of(batch)
    return None if origin is None else origin.names


def are_over(batch: BatchedData) -> list[bool]:
    """Return for each result whether it ends the episodes of all agents and sub-environments."""
    return column_of_parts(parts_of(batch), _over_of_rows).tolist()


def any_reset(batch: BatchedData) -> NDArray[np.bool_]:
    """Return for each result whether the env, or one of its sub-environments, was reset."""
    return column_of_parts(parts_of(batch), _resets_of_rows)


def _resets_of_rows(part: ResultColumns) -> NDArray[np.bool_]:
    return np.logical_or.reduce(part.is_reset.reshape(len(part.slots), -1), axis=1)


def _over_of_rows(part: ResultColumns) -> NDArray[np.bool_]:
    if not part.whole_results:
        done = part.done
        return done if done.ndim == 1 else np.logical_and.reduce(done.reshape(len(part), -1), 1)
    flags = [_all_flags(ret.last_terminated, ret.last_truncated) for ret in rets_of(part)]
    return np.array(flags, np.bool_)


def _all_flags(terminated: Any, truncated: Any) -> bool:
    """Return True if one of the two is set for each agent and sub-environment."""
    either = zipped(np.logical_or, terminated, truncated)
    return all(np.all(flags) for _, flags in walked(either))


def lost_rows(batch: BatchedData) -> set[int]:
    """Return the positions of results whose episode before was lost."""
    parts = parts_of(batch)
    if all(part.restarted is None for part in parts):
        return set()
    lost = column_of_parts(parts, lambda part: part.by_env(part.restarted))
    return {*np.flatnonzero(lost).tolist()}
