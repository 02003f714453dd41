"""The global generators of NumPy and Python, which many envs use, in workers and replacements."""

from __future__ import annotations

import os
import random
import signal
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from rlightning_aio import EnvConfig, sync


class Dice(gym.Env[Any, Any]):
    """Observes numbers of the global generators; action 1 ends the process."""

    observation_space = spaces.Box(0, 1, (2,), np.float64)
    action_space = spaces.Discrete(2)

    def _observation(self) -> Any:
        return np.array([np.random.random(), random.random()])  # noqa: NPY002

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        if action == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return self._observation(), 0.0, False, False, {}


class AwaitableDice:
    """The same for an event loop."""

    observation_space, action_space = Dice.observation_space, Dice.action_space

    def __init__(self) -> None:
        self.dice = Dice()

    async def reset(self, **kwargs: Any) -> Any:
        return self.dice.reset(**kwargs)

    async def step(self, action: Any) -> Any:
        return self.dice.step(action)


DICE = pytest.mark.parametrize("make", [Dice, AwaitableDice])


def rolled(make: Any, seed: int | None, *, options: Any = None, count: int = 2) -> list[Any]:
    """The numbers of a reset, three steps, a death, three steps, and all of it again, by env."""
    found: list[Any] = []
    config = EnvConfig(name="d", task=make, num_workers=count, envs_per_process=1)
    with sync.build_env_group(config) as group:
        for _ in range(2):
            batch, _ = group.reset(seed=seed, options=options)
            for deadly in (0, 0, 0, 1, 0, 0, 0):
                found.append(batch.observation)
                batch, _ = group.step(batch.respond(action=np.full(count, deadly)))
            assert batch.restarted.sum() == 0
    return np.array(found).tolist()


@DICE
def test_every_worker_and_every_replacement_has_other_numbers(make: Any) -> None:
    """No number comes twice, also in another group of the same program."""
    found = np.array([rolled(make, None), rolled(make, None)])
    assert len(set(found.ravel().tolist())) == found.size


@DICE
@pytest.mark.parametrize("options", [None, {}], ids=["seed in the row", "seed beside options"])
def test_a_seeded_group_has_the_same_numbers_again(make: Any, options: Any) -> None:
    """Also after a death; other seeds give others, and so do other envs."""
    found = rolled(make, 5, options=options)
    assert rolled(make, 5, options=options) == found
    numbers = np.array([found, rolled(make, 50, options=options)])
    assert len(set(numbers.ravel().tolist())) == numbers.size


def test_an_env_in_this_process_leaves_the_generators_to_their_owner() -> None:
    config = EnvConfig(name="d", task=Dice, placement="inline")
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    with sync.build_env_group(config) as group:
        batch, _ = group.reset(seed=9)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    assert batch.observation.tolist() == [Dice()._observation().tolist()]
