"""Observations and infos in the layout of Gymnasium's batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.trees import mapped, tree_of, zipped

if TYPE_CHECKING:
    import gymnasium as gym
    from numpy.typing import NDArray


def batched(space: gym.Space[Any], observations: Any) -> Any:
    """Convert lists of observations that can't be stacked to tuples, as Gymnasium does."""

    def part_of(_: gym.Space[Any], part: Any) -> Any:
        return tuple(cast("list[Any]", part)) if isinstance(part, list) else part

    return zipped(part_of, tree_of(space), observations)


def replaced(columns: Any, others: Any, chosen: NDArray[np.intp]) -> Any:
    """Copy `columns`, with the rows `chosen` taken from `others`."""

    def mixed(column: Any, other: Any) -> Any:
        copy = column.copy()
        for k in chosen.tolist():
            copy[k] = other[k]
        return copy

    return zipped(mixed, columns, others)


def merged(before: Any, now: Any, chosen: NDArray[np.intp], count: int) -> Any:
    """Observations of all `count` envs: those of `before`, with `now` in the rows `chosen`."""

    def whole_of(now: Any, before: Any = None) -> Any:
        if isinstance(now, np.ndarray):
            array = cast("NDArray[Any]", now)
            shape = (count, *array.shape[1:])
            whole = np.zeros(shape, array.dtype) if before is None else before.copy()
            whole[chosen] = array
            return whole
        values: list[Any] = [None] * count if before is None else list(before)
        for k, value in zip(chosen.tolist(), now, strict=True):
            values[k] = value
        return values

    return mapped(whole_of, now) if before is None else zipped(whole_of, now, before)


def spread(infos: dict[str, Any], chosen: NDArray[np.intp], count: int) -> dict[str, Any]:
    """Expand infos of the envs `chosen` to columns for all `count` envs."""

    def expanded(column: NDArray[Any]) -> NDArray[Any]:
        whole = np.zeros((count, *column.shape[1:]), column.dtype)
        if column.dtype == object:
            whole[:] = None
        whole[chosen] = column
        return whole

    return mapped(expanded, infos)
