"""A worker that dies with a batch: all that it stepped together say so, nobody else notices."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from faults.driven import kill, stop
from gymnasium.vector import AutoresetMode

from rlightning_aio.errors import WorkerDied
from rlightning_aio.vector import VectorEnv, make_vec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TASK, ACTIONS = "Hopper-v5", np.full((4, 3), 0.1, np.float32)
LOST = [True, True, False, False]


def made(**arguments: Any) -> VectorEnv:
    """Two workers, each with two simulations that it steps together."""
    entry = {"placement": "process", "max_concurrency": 2, **arguments}
    return make_vec(TASK, 4, vector_kwargs=entry)


def killed(group: Any, send: Callable[[], None]) -> None:
    """Kill the first worker while it has yet to do what is sent."""
    pid = group._core.supervisor.hosts[0].pid
    stop(pid)
    send()
    kill(pid)


@pytest.fixture
def twins() -> Iterator[Any]:
    """What all would have done."""
    envs: Any = gym.make_vec(TASK, 4, "sync")
    envs.reset(seed=7)
    yield envs
    envs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_a_death_in_a_step_truncates_what_was_stepped_together(
    mode: AutoresetMode, twins: Any
) -> None:
    """Their observations begin new episodes, in every mode; the others' step is what it was."""
    envs = made(autoreset_mode=mode)
    before, _ = envs.reset(seed=7)
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    observations, rewards, terminated, truncated, infos = envs.step_wait()
    expected = twins.step(ACTIONS)
    assert truncated.tolist() == infos["_worker_restarted"].tolist() == LOST
    assert not terminated.any()
    assert rewards[:2].tolist() == [0, 0]
    assert all("was killed by SIGKILL" in cause for cause in infos["worker_restarted"][:2])
    assert "final_obs" not in infos
    assert not (observations[:2] == before[:2]).all(axis=1).any()
    for _ in range(3):
        np.testing.assert_array_equal(observations[2:], expected[0][2:])
        np.testing.assert_array_equal(rewards[2:], expected[1][2:])
        observations, rewards, _, truncated, infos = envs.step(ACTIONS)
        expected = twins.step(ACTIONS)
        assert not truncated.any()
        assert (rewards != 0).all()
        assert "worker_restarted" not in infos
    envs.close()


def test_a_death_in_anything_else(twins: Any) -> None:
    """A reset begins episodes all the same, without its seeds, and says why; a call ends in an
    error, and the next step is the one that tells.
    """
    envs = made()
    killed(envs.group, lambda: envs.reset_async(seed=7))
    observations, infos = envs.reset_wait()
    assert infos["_worker_restarted"].tolist() == LOST
    np.testing.assert_array_equal(observations[2:], twins.reset(seed=7)[0][2:])
    assert not envs.step(ACTIONS)[3].any()
    killed(envs.group, lambda: envs.call_async("get_wrapper_attr", "dt"))
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.call_wait()
    assert envs.step(ACTIONS)[3].tolist() == LOST
    assert not envs.step(ACTIONS)[3].any()
    envs.close()


def test_a_death_is_raised_where_that_is_asked_for() -> None:
    """Again and again: the worker is not replaced."""
    envs = made(on_worker_death="raise")
    envs.reset(seed=7)
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    with pytest.raises(WorkerDied, match=r"env 'env-0'.*was killed by SIGKILL"):
        envs.step_wait()
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.step(ACTIONS)
    envs.close()


def test_episodes_that_are_kept_go_on(twins: Any) -> None:
    """What was lost is done once more, with the same outcome."""
    envs = made(on_worker_death="resume", snapshot_every=1)
    envs.reset(seed=7)
    before = envs.step(ACTIONS)[0]
    twins.step(ACTIONS)
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    observations, rewards, _, truncated, infos = envs.step_wait()
    np.testing.assert_array_equal(observations[:2], before[:2])
    assert rewards[:2].tolist() == [0, 0]
    assert truncated.tolist() == LOST
    assert infos["worker_resumed"][:2].tolist() == [0, 0]
    expected = twins.step(ACTIONS)
    np.testing.assert_array_equal(envs.step(ACTIONS)[0][:2], expected[0][:2])
    envs.close()


@pytest.mark.simulators
def test_stable_baselines3_is_told_in_its_own_words() -> None:
    """They are done, cut short, and show no last observation, as that is lost."""
    pytest.importorskip("stable_baselines3")
    from rlightning_aio.sb3 import make_vec_env

    entry = {"placement": "process", "envs_per_process": 2}
    envs = make_vec_env(TASK, 4, vec_env_kwargs=entry)
    envs.seed(7)
    before = envs.reset()
    killed(envs.venv.group, lambda: envs.step_async(ACTIONS))
    observations, rewards, done, infos = envs.step_wait()
    assert done.tolist() == [info["TimeLimit.truncated"] for info in infos] == LOST
    assert ["worker_restarted" in info for info in infos] == LOST
    assert not any("terminal_observation" in info for info in infos)
    assert rewards[:2].tolist() == [0, 0]
    assert not (observations[:2] == before[:2]).all(axis=1).any()
    _, rewards, done, infos = envs.step(ACTIONS)
    assert not done.any()
    assert (rewards != 0).all()
    assert not any("worker_restarted" in info for info in infos)
    envs.close()
