"""Episodes through the vector interface are bit-identical to those of Gymnasium's vector envs."""

from __future__ import annotations

import functools
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space
from vector.toys import assert_alike

from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Iterator

SIZE = 2
SEED = 11
MODES = [
    pytest.param(AutoresetMode.NEXT_STEP, id="NextStep"),
    pytest.param(AutoresetMode.SAME_STEP, id="SameStep"),
    pytest.param(AutoresetMode.DISABLED, id="Disabled"),
]

# Python caches shared memory, which would count as left behind. TorchRL,
# once imported, makes processes import everything again.
PEER: dict[str, Any] = {"shared_memory": False, "context": "fork"}


@pytest.fixture(scope="module", autouse=True)
def tracker_of_multiprocessing() -> None:
    """Peers start one for the whole process, which lasts until the process ends."""
    resource_tracker.ensure_running()


def make(task: str, k: int) -> gym.Env[Any, Any]:
    """Env k of the task; episodes end at random, or earlier for env 0 than for env 1."""
    if task == "Dict":
        return gym.wrappers.TimeAwareObservation(gym.make("CartPole-v1"), flatten=False)
    if task.startswith("ALE/"):
        import ale_py

        gym.register_envs(ale_py)
    limit = 90 + 7 * k if task == "HalfCheetah-v5" else None
    return gym.make(task, max_episode_steps=limit)


def makers_of(task: str) -> list[Any]:
    return [functools.partial(make, task, k) for k in range(SIZE)]


def actions_for(space: gym.Space[Any], count: int) -> list[Any]:
    batched = batch_space(space, SIZE)
    batched.seed(0)
    return [batched.sample() for _ in range(count)]


def stepped(env: Any, actions: list[Any]) -> Iterator[Any]:
    """Results of a vector env; if its mode is disabled, the test resets it."""
    yield env.reset(seed=SEED)
    for each in actions:
        result = env.step(each)
        yield result
        ended = result[2] | result[3]
        if env.autoreset_mode == AutoresetMode.DISABLED and ended.any():
            yield env.reset(options={"reset_mask": ended})
    env.close()


def compare(ours: Any, theirs: Any, task: str, count: int) -> None:
    """Both make the same episodes, more than one."""
    actions, ends = actions_for(theirs.single_action_space, count), 0
    for turn, (found, expected) in enumerate(
        zip(stepped(ours, actions), stepped(theirs, actions), strict=True)
    ):
        assert_alike(found, expected, f"{task}, {turn}")
        ends += sum(np.sum(column) for column in expected[2:4])
    assert ends > 2


@pytest.mark.parametrize("mode", MODES)
def test_in_workers(mode: AutoresetMode) -> None:
    """Over a few ends."""
    makers = makers_of("HalfCheetah-v5")
    ours = VectorEnv(makers, autoreset_mode=mode)
    compare(ours, SyncVectorEnv(makers, autoreset_mode=mode), "HalfCheetah-v5", 200)


TASKS = ["HalfCheetah-v5", "CartPole-v1", "Dict", "ALE/Breakout-v5"]


@pytest.mark.simulators
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", TASKS)
def test_beside_gymnasiums_processes(task: str, mode: AutoresetMode) -> None:
    """A thousand steps of each task in each mode."""
    makers = makers_of(task)
    if task.startswith("ALE/"):
        pytest.importorskip("ale_py")
    ours = VectorEnv(makers, autoreset_mode=mode)
    theirs = AsyncVectorEnv(makers, autoreset_mode=mode, **PEER)
    compare(ours, theirs, task, 1000)
