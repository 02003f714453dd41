"""The policy that acts for ppo_async.py and ppo_overlap.py; not an example itself.

It is a policy as `rlightning_aio.collecting.Collector` needs it: called with a batch of results,
it returns columns with a row for each of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Discrete

if TYPE_CHECKING:
    from normalizer import Normalizer
    from numpy.typing import NDArray
    from ppo import Agent

    from rlightning_aio import BatchedData


def single(space: Any) -> Any:
    """The space of one of those whose space it is together."""
    if isinstance(space, Box):
        return Box(space.low[0], space.high[0], dtype=space.dtype.type)
    return Discrete(space.nvec[0])


class Player:
    """What acts: a copy of the agent's actor, which learning doesn't change, and the normaliser.

    It is in NumPy, which takes a quarter of torch's time for a few rows, or less.
    """

    def __init__(self, agent: Agent, normalizer: Normalizer, actions: Any, seed: int) -> None:
        self.normalizer, self.actions = normalizer, actions
        self.random = np.random.default_rng(seed)
        self.sums = np.zeros(len(normalizer.returns.mean))
        self.returns: list[float] = []
        self.take(agent)

    def take(self, agent: Agent) -> None:
        """Act as `agent` does now."""
        layers = [part for part in agent.actor if hasattr(part, "weight")]
        self.layers = [
            (part.weight.detach().numpy().T.copy(), part.bias.detach().numpy().copy())
            for part in layers
        ]
        self.log_std = None if agent.log_std is None else agent.log_std.detach().numpy().copy()

    def __call__(self, batch: BatchedData) -> dict[str, Any]:
        """Actions for the envs of a batch, and what the learner will want to know of them."""
        index = batch.index
        shape, index = index.shape, index.reshape(-1)
        is_reset, reward = batch.is_reset.reshape(-1), batch.reward.reshape(-1)
        self._note(index, reward, batch.terminated.reshape(-1), batch.done.reshape(-1), is_reset)
        seen = self.normalizer.observed(index, batch.observation.reshape(len(index), -1))
        chosen = self.chosen(seen)
        return {name: column.reshape(*shape, *column.shape[1:]) for name, column in chosen.items()}

    def _note(
        self,
        index: NDArray[np.int64],
        reward: NDArray[Any],
        terminated: NDArray[np.bool_],
        done: NDArray[np.bool_],
        is_reset: NDArray[np.bool_],
    ) -> None:
        """Take in what the last actions have brought; rows that are resets have brought nothing."""
        self.sums[index] += reward
        if is_reset.any():
            stepped = ~is_reset
            self.sums[index[is_reset]] = 0.0
            index, reward, terminated = index[stepped], reward[stepped], terminated[stepped]
            done = done[stepped]
        self.normalizer.rewarded(index, reward, terminated)
        if done.any():
            self.returns += self.sums[index[done]].tolist()
            self.sums[index[done]] = 0.0

    def ended(self) -> list[float]:
        """Returns of the episodes that have ended since it was called last."""
        returns, self.returns = self.returns, []
        return returns

    def chosen(self, seen: NDArray[np.float32]) -> dict[str, Any]:
        found = seen
        for weight, bias in self.layers[:-1]:
            found = np.tanh(found @ weight + bias)
        weight, bias = self.layers[-1]
        found = found @ weight + bias
        if self.log_std is None:
            log_probs = found - np.log(np.exp(found).sum(-1, keepdims=True))
            raw = (log_probs + self.random.gumbel(size=found.shape)).argmax(-1)
            log_prob = log_probs[np.arange(len(raw)), raw]
            return {"action": raw, "raw": raw, "log_prob": log_prob, "seen": seen}
        noise = self.random.standard_normal(found.shape, np.float32)
        raw = found + noise * np.exp(self.log_std)
        log_prob = (-0.5 * noise**2 - self.log_std - 0.5 * np.log(2 * np.pi)).sum(-1)
        action = raw.clip(self.actions.low, self.actions.high)
        return {"action": action, "raw": raw, "log_prob": log_prob, "seen": seen}
