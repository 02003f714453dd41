"""Action masks: the discrete actions that a result allows.

As in PettingZoo and Gymnasium, a mask is ``action_mask`` in the info or in a dict observation (of
the agent, if there are several). 1 stands for an allowed action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.trees import is_dict
from rlightning_aio.types import EnvRet, MultiAgentEnvRet

if TYPE_CHECKING:
    from collections.abc import Iterator


def can_be_masked(space: gym.Space[Any]) -> bool:
    """Return True if actions of `space`, or of an agent in it, are discrete."""
    parts = space.spaces.values() if is_dict(space) else (space,)
    return any(map(_is_discrete, parts))


def has_masks(result: Any) -> bool:
    """Return True if a result has a mask for any agent."""
    return any(mask is not None for _, mask in _masks(result))


def allowed_action(
    space: gym.Space[Any], action: Any, result: Any, rng: np.random.Generator
) -> Any:
    """Return `action`, with a random allowed action wherever a mask of `result` forbids it.

    Agents without a mask, and those whose mask allows nothing, keep their action.
    """
    for agent, mask in _masks(result):
        if agent is None:
            return _allowed(space, action, mask, rng)
        inner = cast("Any", space)[agent]
        action = {**action, agent: _allowed(inner, action[agent], mask, rng)}
    return action


def _masks(result: Any) -> Iterator[tuple[str | None, Any]]:
    """Return each agent's mask or None; the key is None for an env without agents."""
    if isinstance(result, MultiAgentEnvRet):
        for agent, observation in result.observation.items():
            yield agent, _mask(observation, result.info.get(agent))
    elif isinstance(result, EnvRet):
        yield None, _mask(result.observation, result.info)


def _mask(observation: Any, info: Any) -> Any:
    for where in (info, observation):
        if isinstance(where, Mapping) and "action_mask" in where:
            return cast("Any", where)["action_mask"]
    return None


def _is_discrete(space: gym.Space[Any]) -> bool:
    # Gymnasium's spaces are generic over a dtype that is usually left out.
    spaces: Any = gym.spaces
    return isinstance(space, (spaces.Discrete, spaces.MultiDiscrete))


def _allowed(space: gym.Space[Any], action: Any, mask: Any, rng: np.random.Generator) -> Any:
    known = cast("Any", space)
    if mask is None or not _is_discrete(space):
        return action
    # A vectorised env has one action for each sub-environment.
    weights = np.asarray(mask, np.bool_)
    drawn = (weights * (1.0 - rng.random(weights.shape))).argmax(axis=-1)
    any_allowed = weights.any(axis=-1)
    return (any_allowed * (drawn + known.start) + ~any_allowed * action).astype(known.dtype)
