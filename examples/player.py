"""The policy that acts for ppo_async.py and ppo_overlap.py; not an example itself.

It is a policy as `rlightning_aio.collecting.Collector` needs it: called with a batch of results,
it returns columns with a row for each of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box, Discrete

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from ppo import Agent

    from rlightning_aio import BatchedData
    from rlightning_aio.normalize import Normalizer


def single(space: Any) -> Any:
    """The space of one sub-environment, from that of a batch."""
    if isinstance(space, Box):
        return Box(space.low[0], space.high[0], dtype=space.dtype.type)
    return Discrete(space.nvec[0])


class Player:
    """The acting policy: a copy of the agent's actor, fixed during learning, and the normaliser.

    It is in NumPy, which takes a quarter of torch's time for a few rows, or less.
    """

    def __init__(self, agent: Agent, normalizer: Normalizer, actions: Any, seed: int) -> None:
        self.normalizer, self.actions = normalizer, actions
        self.random = np.random.default_rng(seed)
        self.take(agent)

    def take(self, agent: Agent) -> None:
        """Copy the current weights of `agent`."""
        layers = [part for part in agent.actor if hasattr(part, "weight")]
        self.layers = [
            (part.weight.detach().numpy().T.copy(), part.bias.detach().numpy().copy())
            for part in layers
        ]
        self.log_std = None if agent.log_std is None else agent.log_std.detach().numpy().copy()

    def __call__(self, batch: BatchedData) -> dict[str, Any]:
        """Actions for the envs of a batch, and columns for the learner."""
        shape = batch.index.shape
        seen = self.normalizer.observe(batch)
        chosen = self.chosen(seen.reshape(batch.index.size, -1))
        return {name: column.reshape(*shape, *column.shape[1:]) for name, column in chosen.items()}

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
