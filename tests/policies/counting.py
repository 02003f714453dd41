"""An env that rewards each action that an open-loop policy should play, and its chunks."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec

if TYPE_CHECKING:
    from rlightning_aio.evaluation import Evaluation

QUEUE = [EpisodeSpec("", seed) for seed in range(6)]


class Counting(gym.Env[Any, Any]):
    """Observes its seed and step; an episode has seed + 4 steps.

    The reward is 1 for an action that says (seed, step when its chunk was asked for, place in it).

    Args:
        period: number of actions of a chunk that are played.
        breaks: raise in the third step of every second episode.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, period: int = 3, breaks: bool = False) -> None:
        self._period, self._breaks, self._resets = period, breaks, itertools.count()

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self._seed, self._steps = seed, 0
        self._breaks_now = self._breaks and next(self._resets) % 2 == 0
        return self._observation(), {"task_description": f"lift {seed}"}

    def _observation(self) -> Any:
        return np.array([self._seed, self._steps], np.float64)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        place = self._steps % self._period
        right = action.tolist() == [self._seed, self._steps - place, place]
        self._steps += 1
        if self._breaks_now and self._steps == 3:
            raise ValueError("as asked for")
        return self._observation(), float(right), self._steps == self._seed + 4, False, {}


def chunk_of(observation: Any, horizon: int = 5) -> Any:
    """Return the chunk of one env, ``[horizon, 3]``."""
    seed, step = observation.tolist()
    return np.array([[seed, step, place] for place in range(horizon)], np.float64)


def group_of(num_workers: int = 2, **fields: Any) -> sync.EnvGroup:
    entry = {"name": "env", "task": Counting, "placement": "inline", "num_workers": num_workers}
    return sync.build_env_group({**entry, **fields})


def check(found: Evaluation) -> None:
    """Each episode was played to its end, with the right actions alone."""
    lengths = sorted((one.spec.seed, one.reward, one.length) for one in found.played)
    assert lengths == [(one.seed, one.seed + 4, one.seed + 4) for one in QUEUE]
