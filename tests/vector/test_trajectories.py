"""Episodes through the adapters beside those of their peers and of a plain loop, to the bit."""

from __future__ import annotations

import functools
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
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


@pytest.fixture(scope="module", autouse=True)
def tracker_of_multiprocessing() -> None:
    """Peers start it, one for the whole process; it stays until that ends."""
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
    """What a vector env answers; where nobody else resets, its user does."""
    yield env.reset(seed=SEED)
    for each in actions:
        result = env.step(each)
        yield result
        ended = result[2] | result[3]
        if env.autoreset_mode == AutoresetMode.DISABLED and ended.any():
            yield env.reset(options={"reset_mask": ended})
    env.close()


def looped(task: str, mode: AutoresetMode, actions: list[Any]) -> Iterator[Any]:
    """The same without infos, by single envs one after the other; and what episodes ended with."""
    envs = [make(task, k) for k in range(SIZE)]
    space = envs[0].observation_space

    def all_of(observations: list[Any]) -> Any:
        return concatenate(space, observations, create_empty_array(space, SIZE))

    now = [env.reset(seed=SEED + k)[0] for k, env in enumerate(envs)]
    yield (all_of(now),)
    due = np.zeros(SIZE, np.bool_)
    for each in actions:
        rewards, ends = np.zeros(SIZE), np.zeros((2, SIZE), np.bool_)
        last: list[Any] = [None] * SIZE
        for k, env in enumerate(envs):
            if due[k]:
                now[k] = env.reset()[0]
                continue
            now[k], rewards[k], *ends[:, k], _ = env.step(each[k])
            if ends[:, k].any() and mode == AutoresetMode.SAME_STEP:
                last[k], now[k] = now[k], env.reset()[0]
        yield all_of(now), rewards, *ends, last
        ended = ends.any(axis=0)
        due = ended & (mode == AutoresetMode.NEXT_STEP)
        if mode == AutoresetMode.DISABLED and ended.any():
            for k in np.flatnonzero(ended):
                now[k] = envs[k].reset()[0]
            yield (all_of(now),)
    for env in envs:
        env.close()


def compare(ours: Any, theirs: Any, task: str, count: int) -> None:
    """All three go through the same episodes, of which there are several."""
    actions = actions_for(theirs.single_action_space, count)
    mode, ends = theirs.autoreset_mode, 0
    rollouts = stepped(ours, actions), stepped(theirs, actions), looped(task, mode, actions)
    for turn, (found, expected, plain) in enumerate(zip(*rollouts, strict=True)):
        assert_alike(found, expected, f"{task}, {turn}")
        *columns, last = plain if len(plain) == 5 else (*plain, [])
        assert_alike(found[: len(columns)], tuple(columns), f"{task} in a loop, {turn}")
        for k, observation in enumerate(last):
            if observation is not None:
                assert_alike(found[4]["final_obs"][k], observation, f"{task}, last of {turn}")
        ends += sum(np.sum(column) for column in columns[2:])
    assert ends > 2


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("task", ["CartPole-v1", "Dict"])
def test_inline(task: str, mode: AutoresetMode) -> None:
    """Over a few ends."""
    makers = makers_of(task)
    ours = VectorEnv(makers, autoreset_mode=mode, placement="inline")
    compare(ours, SyncVectorEnv(makers, autoreset_mode=mode), task, 150)


@pytest.mark.parametrize("mode", MODES)
def test_in_workers(mode: AutoresetMode) -> None:
    """A thousand steps over many ends."""
    makers = makers_of("HalfCheetah-v5")
    ours = VectorEnv(makers, autoreset_mode=mode)
    compare(ours, SyncVectorEnv(makers, autoreset_mode=mode), "HalfCheetah-v5", 1000)


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
    # Python keeps the shared memory of its own for the next, which would count as left behind.
    theirs = AsyncVectorEnv(makers, shared_memory=False, autoreset_mode=mode)
    compare(ours, theirs, task, 1000)


@pytest.mark.simulators
@pytest.mark.parametrize("task", TASKS)
def test_beside_stable_baselines3s_processes(task: str) -> None:
    """A thousand steps of each task: observations, rewards, ends, infos, and those of resets."""
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    if task.startswith("ALE/"):
        pytest.importorskip("ale_py")
    from rlightning_aio.sb3 import VecEnv

    makers = makers_of(task)
    # Forked, it leaves no fork server behind.
    ours, theirs = VecEnv(makers), vec_env.SubprocVecEnv(makers, start_method="fork")
    actions = actions_for(theirs.action_space, 1000)
    for env in (ours, theirs):
        env.seed(SEED)
    plain = looped(task, AutoresetMode.SAME_STEP, actions)
    found = ours.reset()
    assert_alike(found, theirs.reset())
    assert_alike(found, next(plain)[0])
    ends = 0
    for turn, (each, of_loop) in enumerate(zip(actions, plain, strict=True)):
        found = ours.step(each)
        *expected, infos = theirs.step(each)
        assert_alike(found, (*expected, list(infos)), f"{task}, {turn}")
        assert_alike(ours.reset_infos, list(theirs.reset_infos), f"{task}, {turn}")
        observations, rewards, terminated, truncated, last = of_loop
        assert_alike(found[:3], (observations, rewards, terminated | truncated), f"{task}, {turn}")
        for info, observation, done in zip(found[3], last, found[2], strict=True):
            if done:
                assert_alike(info["terminal_observation"], observation, f"{task}, {turn}")
                ends += 1
    assert ends > 2
    ours.close()
    theirs.close()
