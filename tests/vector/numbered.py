"""Envs that observe how far they are.

Left out on purpose: whatever a test needs, as each worker imports this module.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np


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
