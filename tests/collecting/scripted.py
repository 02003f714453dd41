"""Envs whose episodes end at random, alone or several in one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rlightning_aio import sync
from rlightning_aio.envs.adapted.makers import SameStep

if TYPE_CHECKING:
    import numpy.typing as npt


@dataclass
class Script(gym.Env[Any, Any]):
    """Observes [number of the env, episodes, steps]; episodes end at random."""

    number: int
    ends: float
    generator: np.random.Generator = field(init=False)
    episode: int = 0
    steps: int = 0

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def __post_init__(self) -> None:
        self.generator = np.random.default_rng(self.number)

    def _observation(self) -> npt.NDArray[np.float64]:
        return np.array([self.number, self.episode, self.steps], np.float64)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.episode += 1
        self.steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        chance = self.generator.random()
        terminated, truncated = chance < self.ends / 2, 1 - chance < self.ends / 2
        reward = float(self.generator.integers(100))
        return self._observation(), reward, terminated, truncated, {}


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
