"""Observations and infos in the layout of Gymnasium's batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.trees import is_dict, is_tuple, paired

if TYPE_CHECKING:
    import gymnasium as gym
    from numpy.typing import NDArray

__all__ = ["batched", "merged", "replaced", "spread"]


def batched(space: gym.Space[Any], observations: Any) -> Any:
    """Convert lists of observations that can't be stacked to tuples, as Gymnasium does."""
    if is_dict(space):
        return {key: batched(part, observations[key]) for key, part in space.spaces.items()}
    if is_tuple(space):
        return tuple(batched(part, observations[k]) for k, part in enumerate(space.spaces))
    if isinstance(observations, list):
        return tuple(cast("list[Any]", observations))
    return observations


def replaced(columns: Any, others: Any, chosen: NDArray[np.intp]) -> Any:
    """Copy `columns`, with the rows `chosen` taken from `others`."""

    def mixed(column: Any, other: Any) -> Any:
        copy = column.copy()
        for k in chosen.tolist():
            copy[k] = other[k]
        return copy

    return paired(mixed, columns, others)


def merged(before: Any, now: Any, chosen: NDArray[np.intp], count: int) -> Any:
    """Observations of all `count` envs: those of `before`, with `now` in the rows `chosen`."""
    if isinstance(now, dict):
        parts = cast("dict[str, Any]", now)
        known: dict[str, Any] = before or {}
        return {key: merged(known.get(key), part, chosen, count) for key, part in parts.items()}
    if isinstance(now, np.ndarray):
        array = cast("NDArray[Any]", now)
        shape = (count, *array.shape[1:])
        whole = np.zeros(shape, array.dtype) if before is None else before.copy()
        whole[chosen] = array
        return whole
    if isinstance(now, tuple):
        several = cast("tuple[Any, ...]", now)
        old: Any = before or [None] * len(several)
        return tuple(merged(old[k], part, chosen, count) for k, part in enumerate(several))
    values: list[Any] = [None] * count if before is None else list(before)
    for k, value in zip(chosen.tolist(), now, strict=True):
        values[k] = value
    return values


def spread(infos: dict[str, Any], chosen: NDArray[np.intp], count: int) -> dict[str, Any]:
    """Expand infos of the envs `chosen` to columns for all `count` envs."""
    columns: dict[str, Any] = {}
    for key, column in infos.items():
        if isinstance(column, dict):
            columns[key] = spread(cast("dict[str, Any]", column), chosen, count)
            continue
        columns[key] = np.zeros((count, *column.shape[1:]), column.dtype)
        if column.dtype == object:
            columns[key][:] = None
        columns[key][chosen] = column
    return columns
