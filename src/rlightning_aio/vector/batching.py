"""Observations and infos of some envs as Gymnasium batches those of all."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.protocol.columns import is_dict, is_tuple

if TYPE_CHECKING:
    import gymnasium as gym
    from numpy.typing import NDArray

__all__ = ["batched", "merged", "spread"]


def batched(space: gym.Space[Any], observations: Any) -> Any:
    """What doesn't stack as the tuples that Gymnasium makes of it."""
    if is_dict(space):
        return {key: batched(part, observations[key]) for key, part in space.spaces.items()}
    if is_tuple(space):
        return tuple(batched(part, observations[k]) for k, part in enumerate(space.spaces))
    if isinstance(observations, list):
        return tuple(cast("list[Any]", observations))
    return observations


def merged(before: Any, now: Any, chosen: NDArray[np.intp], count: int) -> Any:
    """Observations of all envs, some of which are new."""
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
    """Columns of some envs as those of all."""
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
