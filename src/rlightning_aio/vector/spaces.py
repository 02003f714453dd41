"""Spaces, observations and infos in the layout of Gymnasium's batches."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import utils

from rlightning_aio.trees import mapped, tree_of, zipped

if TYPE_CHECKING:
    from collections.abc import Sequence

    import gymnasium as gym
    from numpy.typing import NDArray


Space: TypeAlias = Any


def batched(space: gym.Space[Any], observations: Any) -> Any:
    """Convert lists of observations that can't be stacked to tuples, as Gymnasium does."""

    def part_of(_: gym.Space[Any], part: Any) -> Any:
        return tuple(cast("list[Any]", part)) if isinstance(part, list) else part

    return zipped(part_of, tree_of(space), observations)


def merged(before: Any, now: Any, chosen: NDArray[np.intp], count: int) -> Any:
    """Observations of all `count` envs: those of `before`, with `now` in the rows `chosen`."""

    def whole_of(now: Any, before: Any = None) -> Any:
        whole = before.copy() if before is not None else _empty(now, count)
        for k, value in zip(chosen.tolist(), now, strict=True):
            whole[k] = value
        return whole

    return mapped(whole_of, now) if before is None else zipped(whole_of, now, before)


def _empty(column: Any, count: int) -> Any:
    if isinstance(column, list):
        return [None] * count
    return np.zeros((count, *column.shape[1:]), column.dtype)


def spread(infos: dict[str, Any], chosen: NDArray[np.intp], count: int) -> dict[str, Any]:
    """Expand infos of the envs `chosen` to columns for all `count` envs."""

    def expanded(column: NDArray[Any]) -> NDArray[Any]:
        whole = np.zeros((count, *column.shape[1:]), column.dtype)
        if column.dtype == object:
            whole[:] = None
        whole[chosen] = column
        return whole

    return mapped(expanded, infos)


def adopted_spaces(
    spaces: Sequence[tuple[Space, Space]],
    mode: str | tuple[gym.Space[Any], gym.Space[Any]],
) -> tuple[Space, Space, Space, Space]:
    """Single and batched observation space, single and batched action space.

    Args:
        spaces: observation and action space of each env.
        mode: see `VectorEnv`.

    Raises:
        ValueError: there is no such mode.
        RuntimeError: the spaces can't be batched.
    """
    observations, actions = zip(*spaces, strict=True)
    single, batched = _observed(list(observations), mode)
    alike = operator.eq if mode == "same" else is_space_dtype_shape_equiv
    for k, own in enumerate(observations):
        if own is not single and not alike(single, own):
            hint = "If this is intentional, use `observation_mode='different'` instead."
            raise RuntimeError(
                f"the sub-environments observation spaces are not equivalent. That of env {k} "
                f"is {own}, not {single}. {hint * (mode == 'same')}"
            )
    for k, own in enumerate(actions):
        if own is not actions[0] and own != actions[0]:
            raise RuntimeError(
                f"the action space of env {k}, {own}, isn't that of env 0, {actions[0]}; "
                "actions are batched, so they must be equal"
            )
    return single, batched, actions[0], utils.batch_space(actions[0], len(actions))


def _observed(
    spaces: list[Space], mode: str | tuple[gym.Space[Any], gym.Space[Any]]
) -> tuple[Space, Space]:
    """The single observation space, and the batched one."""
    if isinstance(mode, tuple):
        return mode[1], mode[0]
    if mode == "same":
        return spaces[0], utils.batch_space(spaces[0], len(spaces))
    if mode == "different":
        # Gymnasium's annotations are incomplete.
        return spaces[0], cast("Any", utils).batch_differing_spaces(spaces)
    raise ValueError(
        "Invalid `observation_mode`, expected: 'same' or 'different' or tuple of single "
        f"and batch observation space, actual got {mode}"
    )
