"""The single and batched spaces of a vector environment, from those of its envs."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any, cast

from gymnasium.spaces.utils import is_space_dtype_shape_equiv
from gymnasium.vector import utils

if TYPE_CHECKING:
    from collections.abc import Sequence

    import gymnasium as gym

Space = Any


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
