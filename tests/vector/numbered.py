"""Envs that observe how far they are.

Left out on purpose: whatever a test needs, as each worker imports this module.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable


class Walk(gym.Env[Any, Any]):
    """Observes its number of steps; action 2 ends the episode, and action 3 its worker."""

    observation_space = gym.spaces.Box(-1, 99, (1,), np.float64)
    action_space = gym.spaces.Discrete(4)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.count = 0
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        if action == 3:
            os._exit(1)
        self.count += 1
        return np.array([float(self.count)]), 1.0, bool(action == 2), False, {}


class Counted(gym.Env[Any, Any]):
    """Observes [episode, step]; action 1 ends the episode."""

    observation_space = gym.spaces.Box(-1, 99, (2,), np.float64)
    action_space = gym.spaces.Discrete(2)
    episode = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.episode += 1
        self.count = 0
        return np.array([self.episode, 0.0]), {"begun": self.episode}

    def step(self, action: Any) -> Any:
        self.count += 1
        info = {"count": self.count}
        return np.array([self.episode, self.count], float), 1.0, bool(action), False, info


def counted(width: int, mode: AutoresetMode) -> list[Callable[[], Any]]:
    """Two callables, each of a single env or of `width` that are stepped together."""
    if not width:
        return [Counted] * 2
    return [lambda: SyncVectorEnv([Counted] * width, autoreset_mode=mode)] * 2
