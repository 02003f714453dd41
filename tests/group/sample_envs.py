"""Envs of the tests' own, which workers import by this module's name.

`Tree-v0` has observations and actions of every space that travels in rows, `Words-v0` of
every kind that doesn't. Each observation is drawn anew, so that seeds matter.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

TREE = spaces.Dict(
    place=spaces.Box(-1, 1, (3,), np.float32),
    image=spaces.Box(0, 255, (4, 5, 3), np.uint8),
    inner=spaces.Dict(count=spaces.Discrete(1000), bits=spaces.MultiBinary(4)),
    pair=spaces.Tuple([spaces.MultiDiscrete([3, 5]), spaces.Box(-9, 9, (), np.float64)]),
)
WORDS = spaces.Dict(
    text=spaces.Text(8),
    items=spaces.Sequence(spaces.Box(0, 1, (2,), np.float64)),
    graph=spaces.Graph(spaces.Box(-1, 1, (2,)), spaces.Discrete(3)),
    place=spaces.Box(-1, 1, (2,), np.float64),
)
MOVES = spaces.Dict(
    push=spaces.Box(-1, 1, (2,), np.float32),
    hands=spaces.Tuple([spaces.MultiBinary(3), spaces.MultiDiscrete([2, 4])]),
    jump=spaces.Discrete(2),
)


class DrawnEnv(gym.Env[Any, Any]):
    """Observations are samples of its space; an episode ends by chance in one step of 25."""

    def __init__(self, observation_space: Any, action_space: Any) -> None:
        self.observation_space = deepcopy(observation_space)  # Which holds a generator.
        self.action_space = action_space
        self.steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        return self.observation_space.sample(), {"seed": seed, "options": options}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action in self.action_space, action
        self.steps += 1
        chance = self.np_random.random()
        info = {"chance": chance, "steps": self.steps}
        return self.observation_space.sample(), chance, chance < 0.04, False, info


def tree() -> DrawnEnv:
    return DrawnEnv(TREE, MOVES)


def words() -> DrawnEnv:
    return DrawnEnv(WORDS, spaces.Discrete(3))


gym.register("Tree-v0", entry_point=tree)
gym.register("Words-v0", entry_point=words)
