"""Envs whose episodes end at random, alone or several in one."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from kit.scripted import Counts

from rlightning_aio import sync
from rlightning_aio.envs.adapted.makers import SameStep


class Script(Counts):
    """Observes [number of the env, episodes, steps]; episodes end at random."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __init__(self, number: int, ends: float) -> None:
        self.number, self.ends = number, ends
        self.generator = np.random.default_rng(number)

    def does(self, action: Any) -> float:
        chance = self.generator.random()
        self.over, self.cut = chance < self.ends / 2, 1 - chance < self.ends / 2
        return float(self.generator.integers(100))

    def observed(self) -> Any:
        return np.array([self.number, self.resets, self.steps], np.float64)


KINDS = {
    "single": lambda scripts: scripts[0],
    "same_step": lambda scripts: SameStep(scripts[0]),
    "vector": lambda scripts: SyncVectorEnv(
        [lambda s=s: s for s in scripts], autoreset_mode=AutoresetMode.NEXT_STEP
    ),
    "same_step_vector": lambda scripts: SyncVectorEnv(
        [lambda s=s: s for s in scripts], autoreset_mode=AutoresetMode.SAME_STEP
    ),
}


def scripted_group(kind: str, num_envs: int, ends: float) -> sync.EnvGroup:
    """A group of inline envs of a kind."""
    width = 2 if kind.endswith("vector") else 1
    scripts = [[Script(width * k + j, ends) for j in range(width)] for k in range(num_envs)]
    makers = [lambda own=own: KINDS[kind](own) for own in scripts]
    return sync.build_env_group(makers, name="script", placement="inline")
