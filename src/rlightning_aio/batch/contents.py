"""What this library asks of a batch, and users don't: functions, to keep them from users.

`data` has the contents themselves: parts, origin, sources, columns of responses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.batch.data import parts_of
from rlightning_aio.batch.parts import (
    column_of_parts,
    infos_of_parts,
    reported_infos_of_parts,
    rows_in_order,
)
from rlightning_aio.errors import EnvFault

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.batch.data import BatchedData


def reported_infos(batch: BatchedData) -> dict[str, Any]:
    """`BatchedData.infos` of a batch of results, without the sums of episodes."""
    return infos_of_parts(parts_of(batch), episodes=False)


def reported_info_list(batch: BatchedData) -> list[dict[str, Any]]:
    """`BatchedData.info` of a batch of results, without the sums of episodes."""
    return reported_infos_of_parts(parts_of(batch))


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


def are_over(batch: BatchedData) -> list[bool]:
    """Return for each result whether it ends the episodes of all agents and sub-environments.

    A marked one begins an episode.
    """
    return column_of_parts(parts_of(batch), _over_of_rows).tolist()


def _over_of_rows(part: ResultColumns) -> NDArray[np.bool_]:
    done = part.done
    over = done if done.ndim == 1 else np.logical_and.reduce(done.reshape(len(part), -1), 1)
    return over & ~part.by_env(part.restarted)


def values_or_faults(batch: BatchedData) -> list[Any]:
    """Return the results as separate values; in place of one that can't be read, the error."""
    try:
        return batch.values()
    except EnvFault as fault:
        if len(batch) == 1:
            return [fault]
    return [one for row in range(len(batch)) for one in values_or_faults(batch.take([row]))]


def readable(batch: BatchedData) -> tuple[BatchedData, list[EnvFault]]:
    """Return the results of a batch that can be read here, and the errors of the others."""
    faults: dict[int, EnvFault] = {}
    for part in parts_of(batch):
        for row in part.out_of_band:
            try:
                part.out_of_band_of(row)
            except EnvFault as fault:
                faults[row if part.positions is None else part.positions.item(row)] = fault
    if not faults:
        return batch, []
    rows = [row for row in range(len(batch)) if row not in faults]
    return batch.take(rows), [fault for _, fault in sorted(faults.items(), key=lambda one: one[0])]


def lost_rows(batch: BatchedData) -> set[int]:
    """Return the positions of results whose episode before was lost."""
    parts = parts_of(batch)
    if all(part.restarted is None for part in parts):
        return set()
    lost = column_of_parts(parts, lambda part: part.by_env(part.restarted))
    return {*np.flatnonzero(lost).tolist()}
