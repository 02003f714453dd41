"""`RandomPolicy`: random actions, as a policy, which obey action masks.

Sampling works on whole columns, so its cost hardly grows with the batch. As in PettingZoo and
Gymnasium, a mask is ``action_mask`` in the info or in a dict observation (of the agent, if there
are several). 1 stands for an allowed action.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import gymnasium as gym
import numpy as np

from rlightning_aio.errors import ConfigError
from rlightning_aio.trees import index, is_dict, mapped, stacked, tree_of, walked
from rlightning_aio.types import EnvRet, MultiAgentEnvRet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rlightning_aio.batch import BatchedData

Sampler: TypeAlias = "Callable[[int], Any]"

_UNBOUNDED = 0.2
"""Largest size of numbers without bounds. They are usually in units of a joint's range, and larger
ones would throw a robot about."""


class RandomPolicy:
    """Samples actions from the envs' spaces.

    Numbers are uniform; without a bound they are small, or near the other bound. Envs whose first
    result has an ``action_mask`` get discrete actions that it allows, or any if it
    allows none. One generator serves all envs in the order of their results.

    Args:
        space_of: a function that returns the action space for an env id; called at the env's
            first result.
        seed: the seed of the generator; None draws one.
    """

    def __init__(self, space_of: Callable[[str], gym.Space[Any] | None], seed: int | None) -> None:
        self._space_of = space_of
        self._rng = np.random.default_rng(seed)
        self._kinds: list[tuple[gym.Space[Any], Sampler]] = []
        self._samplers: dict[str, Sampler] = {}
        self._masked: dict[str, gym.Space[Any]] = {}
        """Action spaces of envs whose results have masks."""

    def __call__(self, batch: BatchedData) -> Any:
        """Return actions for a batch: columns if its envs share one action space, else a list."""
        env_ids = batch.env_ids()
        samplers = [
            self._samplers.get(id_) or self._meet(id_, batch, row)
            for row, id_ in enumerate(env_ids)
        ]
        first = samplers[0]
        if samplers.count(first) < len(samplers):
            actions = [index(sampler(1), 0) for sampler in samplers]
        else:
            actions = first(len(samplers))
        return self._allowed(env_ids, actions, batch) if self._masked else actions

    def _allowed(self, env_ids: list[str], actions: Any, batch: BatchedData) -> Any:
        """Return `actions` in the same form, with allowed ones in place of forbidden ones."""
        listed = isinstance(actions, list)
        chosen = [actions[k] if listed else index(actions, k) for k in range(len(env_ids))]
        for row, (env_id, result) in enumerate(zip(env_ids, batch.values(), strict=True)):
            if (space := self._masked.get(env_id)) is not None:
                chosen[row] = allowed_action(space, chosen[row], result, self._rng)
        return chosen if listed else stacked(chosen)

    def _meet(self, env_id: str, batch: BatchedData, row: int) -> Sampler:
        space = self._space_of(env_id)
        if space is None:
            raise ConfigError(f"env {env_id!r} reports no action space; give a policy")
        sampler = next((sampler for known, sampler in self._kinds if known == space), None)
        if sampler is None:
            sampler = sampler_of(space, self._rng)
            self._kinds.append((space, sampler))
        self._samplers[env_id] = sampler
        # Other infos are not read: they may hold objects that can't be unpickled here.
        if can_be_masked(space) and has_masks(batch.values()[row]):
            self._masked[env_id] = space
        return sampler


def sampler_of(space: gym.Space[Any], rng: np.random.Generator) -> Sampler:
    """Return a function that makes n actions of `space`, as columns."""
    samplers = mapped(lambda part: _columns(part, rng), tree_of(space))
    if all(draw is not None for _, draw in walked(samplers)):
        return lambda n: mapped(lambda draw: draw(n), samplers)
    space.seed(int(rng.integers(2**31)))
    return lambda n: [space.sample() for _ in range(n)]


def _columns(space: Any, rng: np.random.Generator) -> Sampler | None:
    """Return a function that makes columns, or None for spaces whose values can't be stacked."""
    # Gymnasium's spaces are generic over a dtype that is usually left out.
    spaces: Any = gym.spaces
    if isinstance(space, spaces.Box):
        return _box(space, rng)
    if isinstance(space, spaces.Discrete):
        return _integers(space.start, space.start + space.n - 1, space, rng)
    if isinstance(space, spaces.MultiDiscrete):
        return _integers(space.start, space.start + space.nvec - 1, space, rng)
    if isinstance(space, spaces.MultiBinary):
        return _integers(0, 1, space, rng)
    return None


def _integers(low: Any, high: Any, space: gym.Space[Any], rng: np.random.Generator) -> Sampler:
    """Return a function that draws integers from `low` to `high`, both included."""
    shape, dtype = space.shape or (), space.dtype
    return lambda n: rng.integers(low, high, (n, *shape), dtype=dtype, endpoint=True)


def _box(space: Any, rng: np.random.Generator) -> Sampler:
    if np.issubdtype(space.dtype, np.integer):
        return _integers(space.low, space.high, space, rng)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    with np.errstate(over="ignore"):
        span = high - low
    known: Any = np  # Its annotations make nothing of the bounds, which have no types.
    first = known.where(np.isfinite(low), low, np.minimum(high, _UNBOUNDED) - 2 * _UNBOUNDED)
    span = known.where(np.isfinite(span), span, 2 * _UNBOUNDED)
    return lambda n: (first + span * rng.random((n, *space.shape))).astype(space.dtype)


# -- masks ---------------------------------------------------------------------------------


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
