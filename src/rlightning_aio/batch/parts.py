"""Columns of a whole batch of results, made from its parts; and what they say of each row.

A part (`ResultColumns`) holds the rows of envs with the same layout. If there are several, each
knows the positions of its rows in the batch; a single part has the rows in order.
"""

from __future__ import annotations

from itertools import repeat
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np

from rlightning_aio.batch.infos import info_list_of_rows, infos_of_rows, vector_infos
from rlightning_aio.batch.stacking import differing, stacked_values
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.trees import key_of, tree_of, zipped
from rlightning_aio.types import EnvRet, MultiAgentEnvRet, unchecked

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns

T = TypeVar("T")


def rows_in_order(parts: Sequence[ResultColumns]) -> list[tuple[ResultColumns, int]]:
    """Part and row for each position in the batch."""
    return in_order(parts, [[*zip(repeat(part), range(len(part)))] for part in parts])


def in_order(parts: Sequence[ResultColumns], values: Sequence[list[T]]) -> list[T]:
    """Join the values of the rows of each part, in the order of the batch."""
    if len(parts) == 1:
        return values[0]
    whole: list[Any] = [None] * _size(parts)
    for part, own in zip(parts, values, strict=True):
        positions = cast("NDArray[np.intp]", part.positions).tolist()
        for position, value in zip(positions, own, strict=True):
            whole[position] = value
    return whole


def _size(parts: Sequence[ResultColumns]) -> int:
    return sum(len(part.slots) for part in parts)


def column_of_parts(
    parts: Sequence[ResultColumns], column: Callable[[ResultColumns], Any]
) -> NDArray[Any]:
    """Join `column` of each part, in the order of the batch.

    Raises:
        ValueError: the columns have different shapes.
    """
    if parts[0].positions is None:
        return column(parts[0])
    found = [(part, column(part)) for part in parts]
    if len({array.shape[1:] for _, array in found}) > 1:
        raise differing()
    first = found[0][1]
    whole = np.empty((_size(parts), *first.shape[1:]), first.dtype)
    for part, array in found:
        whole[part.positions] = array
    return whole


def observations_of_parts(parts: Sequence[ResultColumns]) -> Any:
    """Stack the observations of all rows, in the order of the batch; for those that have no column.

    Raises:
        ValueError: the envs have different observation spaces.
    """
    values = [part.observation_of(row) for part, row in rows_in_order(parts)]
    known = [part.observation_space for part in parts if part.observation_space is not None]
    if len(known) < len(parts):
        return stacked_values(values)
    return _stacked_in(known, values)


def _stacked_in(known: Sequence[gym.Space[Any]], values: list[Any]) -> Any:
    """Stack values of `known` spaces to columns; values without fixed size stay lists.

    Raises:
        ValueError: the spaces differ in structure.
    """
    trees = [tree_of(space) for space in known]
    if len({key_of(tree, lambda _: None) for tree in trees}) > 1:
        raise differing()
    count = len(known)
    return zipped(lambda *both: _column(both[:count], list(both[count:])), *trees, *values)


def _column(known: Sequence[gym.Space[Any]], values: list[Any]) -> Any:
    if any(leaves(space) is None for space in known):
        return values
    column: Any = stacked_values(values)
    dtype = known[0].dtype
    if type(column) is not np.ndarray or any(space.dtype != dtype for space in known):
        return column
    # As if the values had come through rows of fixed size: an env may count a float32 in ints.
    return column.astype(dtype, copy=False)


def infos_of_parts(parts: Sequence[ResultColumns], *, episodes: bool) -> dict[str, Any]:
    """Infos of all rows as columns, with the sums of episodes if `episodes` is True."""
    if len(parts) == 1 and parts[0].positions is None:
        return infos_of_rows(parts[0], episodes=episodes)
    if episodes:
        return vector_infos([part.info_of(row) for part, row in rows_in_order(parts)])
    return vector_infos(reported_infos_of_parts(parts))


def reported_infos_of_parts(parts: Sequence[ResultColumns]) -> list[dict[str, Any]]:
    """One info for each row, as the env reported it."""
    return in_order(parts, [info_list_of_rows(part) for part in parts])


def taken_parts(parts: Sequence[ResultColumns], chosen: Sequence[int]) -> list[ResultColumns]:
    """Copy the rows at the positions `chosen`, as parts of a new batch in that order."""
    rows_of: dict[int, list[int]] = {}
    positions: dict[int, list[int]] = {}
    places = rows_in_order(parts)
    for position, k in enumerate(chosen):
        part, row = places[k]
        rows_of.setdefault(id(part), []).append(row)
        positions.setdefault(id(part), []).append(position)
    taken = [
        part.subset(rows_of[id(part)], positions[id(part)]) for part in parts if id(part) in rows_of
    ]
    if len(taken) == 1:
        taken[0].positions = None
    return taken


def shapes(responses: Mapping[str, Any], parts: Sequence[ResultColumns]) -> Iterator[str]:
    """Describe columns of responses and parts of results: ``name: dtype[shape]``."""
    for name, column in responses.items():
        yield f"{name}: {_shape(column)}"
    for part in parts:
        observation = "…" if part.observation is None else _shape(part.observation)
        yield f"observation: {observation}, reward: {_shape(part.reward)}"


def _shape(tree: Any) -> str:
    """Dtypes and shapes of the arrays of a column."""
    if isinstance(tree, dict):
        items = cast("dict[str, Any]", tree).items()
        return f"{{{', '.join(f'{key}: {_shape(part)}' for key, part in items)}}}"
    if isinstance(tree, tuple):
        return f"({', '.join(map(_shape, cast('tuple[Any, ...]', tree)))})"
    if hasattr(tree, "shape"):
        return f"{str(tree.dtype).removeprefix('torch.')}{list(tree.shape)}"
    return f"list[{len(tree)}]"


# -- separate results, and how episodes ended -------------------------------------

_FIELDS: Final = (
    "env_id",
    "observation",
    "last_reward",
    "last_terminated",
    "last_truncated",
    "info",
    "ts_env_sent_ns",
)
"""Of a result; see `EnvRet`."""


def rets_of(part: ResultColumns) -> list[EnvRet | MultiAgentEnvRet]:
    """Results of all envs as separate values."""
    rows = range(len(part.slots))
    if part.out_of_band or part.reward.ndim > 1:
        return [_ret(part, row) for row in rows]
    # As `_ret`, column by column, which takes half of the time.
    terminated, truncated = part.terminated.tolist(), part.truncated.tolist()
    infos = info_list_of_rows(part)
    for row in np.flatnonzero(part.done).tolist():
        infos[row] = part.info_of(row)
    env_ids, reward = part.names.ids(part.slots), part.reward.tolist()
    observation = [part.observation_of(row) for row in rows]
    times = [part.sent_ns_of(row) for row in rows]
    columns = env_ids, observation, reward, terminated, truncated, infos, times
    return [
        unchecked(EnvRet, dict(zip(_FIELDS, fields, strict=True)))
        for fields in zip(*columns, strict=True)
    ]


def _ret(part: ResultColumns, row: int) -> EnvRet | MultiAgentEnvRet:
    kept = part.out_of_band_of(row)
    fields = (
        part.names.env_ids[part.slots.item(row)],
        part.observation_of(row),
        part.head_of(part.reward, row),
        part.head_of(part.terminated, row),
        part.head_of(part.truncated, row),
        part.info_of(row),
        part.sent_ns_of(row),
    )
    kind = MultiAgentEnvRet if part.agents else EnvRet
    return unchecked(kind, dict(zip(_FIELDS, fields, strict=True)), kept.get("extra"))


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
