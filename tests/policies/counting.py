"""An env that rewards each action that an open-loop policy should play, and its chunks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from kit.scripted import Counts

from rlightning_aio import sync
from rlightning_aio.evaluation import EpisodeSpec, evaluate

if TYPE_CHECKING:
    from rlightning_aio.evaluation import Evaluation

QUEUE = [EpisodeSpec("", seed) for seed in range(6)]


class Counting(Counts):
    """Observes its seed and step; an episode has seed + 4 steps.

    The reward is 1 for an action that says (seed, step when its chunk was asked for, place in it).

    Args:
        period: number of actions of a chunk that are played.
        breaks: raise in the third step of every second episode.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)

    def __init__(self, period: int = 3, breaks: bool = False) -> None:
        self._period, self._breaks = period, breaks

    def does(self, action: Any) -> float:
        if self._breaks and self.resets % 2 and self.steps == 2:
            raise ValueError("as asked for")
        self.length = self.seed + 4
        place = self.steps % self._period
        return float(action.tolist() == [self.seed, self.steps - place, place])

    def observed(self) -> Any:
        return np.array([self.seed, self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        return {} if self.steps else {"task_description": f"lift {self.seed}"}


def chunk_of(observation: Any, horizon: int = 5) -> Any:
    """Return the chunk of one env, ``[horizon, 3]``."""
    seed, step = observation.tolist()
    return np.array([[seed, step, place] for place in range(horizon)], np.float64)


def group_of(num_workers: int = 2, **fields: Any) -> sync.EnvGroup:
    entry = {"name": "env", "task": Counting, "placement": "inline", "num_workers": num_workers}
    return sync.build_env_group({**entry, **fields})


def evaluated(policy: Any, workers: int = 2, retries: int = 2, **fields: Any) -> Evaluation:
    """Play the queue with a policy, in a group of its own."""
    with group_of(workers, **fields) as group, group.auto_reset(100):
        return evaluate(group, policy, QUEUE, min_results=1, retries=retries)


def check(found: Evaluation) -> None:
    """Each episode was played to its end, with the right actions alone."""
    lengths = sorted((one.spec.seed, one.reward, one.length) for one in found.played)
    assert lengths == [(one.seed, one.seed + 4, one.seed + 4) for one in QUEUE]
