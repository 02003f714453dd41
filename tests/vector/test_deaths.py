"""Worker deaths behind the vector interfaces look like truncated episodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from kit.processes import kill, stop
from vector.toys import Counted, Mortal, assert_alike

from rlightning_aio.errors import WorkerDied
from rlightning_aio.vector import VectorEnv, make_vec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

TASK, ACTIONS = "Hopper-v5", np.full((4, 3), 0.1, np.float32)
MODES = list(AutoresetMode)
LOST = [True, True, False, False]


def made(**arguments: Any) -> VectorEnv:
    """Two workers, each with two envs."""
    entry = {"placement": "process", "envs_per_process": 2, **arguments}
    envs = make_vec(TASK, 4, vector_kwargs=entry)
    assert isinstance(envs, VectorEnv)
    return envs


def killed(group: Any, send: Callable[[], None]) -> None:
    """Kill the first worker before it executes what `send` sends."""
    pid = group.get_workers()[0]["pid"]
    stop(pid)
    send()
    kill(pid)


@pytest.fixture
def twins() -> Iterator[Any]:
    """An action for each env."""
    envs: Any = gym.make_vec(TASK, 4, "sync")
    envs.reset(seed=7)
    yield envs
    envs.close()


def mortals(mode: AutoresetMode, *, dies: bool, **entry: Any) -> Any:
    """Three envs, each in a worker of its own, or in this process if they don't die."""
    makers = [lambda k=k: Mortal(k, dies=dies) for k in range(3)]
    if not dies:
        return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
    return VectorEnv(makers, autoreset_mode=mode, envs_per_process=1, max_restarts=9, **entry)


def plainly(stepped: Any, mode: AutoresetMode) -> Any:
    """Results without causes of deaths and without times."""
    infos = stepped[-1]
    for found in (infos, infos.get("final_info", {})):
        if "env_at_fault" in found:
            mask, at_fault = found.pop("_env_at_fault"), found.pop("env_at_fault")
            assert [at_fault[k] for k in np.flatnonzero(mask)] == [
                f"env-{k}" for k in np.flatnonzero(mask)
            ]
        if "outcome" in found:
            mask, outcomes = found.pop("_outcome"), found.pop("outcome")
            assert [outcomes[k].env_id for k in np.flatnonzero(mask)] == [
                f"env-{k}" for k in np.flatnonzero(mask)
            ]
            assert all(outcomes[k].blame in ("env", "either") for k in np.flatnonzero(mask))
    if "worker_restarted" in infos:
        assert all(infos["worker_restarted"][infos["_worker_restarted"]])
        if mode == AutoresetMode.SAME_STEP:  # There the info of the reset has it too.
            for key in ("worker_restarted", "_worker_restarted"):
                del infos[key]
        else:
            infos["worker_restarted"] = infos["_worker_restarted"]
    if "worker_restarted" in infos.get("final_info", {}):
        final = infos["final_info"]
        final["worker_restarted"] = final["_worker_restarted"]
    if "episode" in infos:
        del infos["episode"]["t"]
    return stepped


def both_do(ours: Any, theirs: Any, mode: AutoresetMode, actions: Any) -> None:
    """Step both; reset envs whose episode has ended if the mode doesn't."""
    assert_alike(ours.reset(), theirs.reset())
    for step, chosen in enumerate(actions):
        found, expected = ours.step(chosen), theirs.step(chosen)
        assert_alike(plainly(found, mode), plainly(expected, mode), f"step {step}: {chosen}")
        done = expected[2] | expected[3]
        if mode == AutoresetMode.DISABLED and done.any():
            found, expected = (env.reset(options={"reset_mask": done}) for env in (ours, theirs))
            assert_alike(found, expected)


_DIE, _TERMINATE, _TRUNCATE, _STEP = 0, 2, 3, 4
SINGLE_AND_TOGETHER = np.array(
    [
        [_STEP, _STEP, _STEP], [_DIE, _STEP, _STEP], [_DIE, _STEP, _TERMINATE],
        [_DIE, _STEP, _DIE], [_STEP, _DIE, _STEP], [_STEP, _STEP, _STEP], [_DIE, _DIE, _DIE],
        [_STEP, _DIE, _STEP], [_TERMINATE, _STEP, _TRUNCATE], [_DIE, _TRUNCATE, _STEP],
        [_STEP, _STEP, _DIE],
    ]
)  # fmt: skip
"""Actions of three envs: single losses, several in a row, and losses of all."""


@pytest.mark.parametrize("mode", MODES)
def test_a_death_looks_like_an_episode_that_is_cut_short(mode: AutoresetMode) -> None:
    """Also to Gymnasium's wrappers; single deaths, several in a row, and with ignored actions."""

    def wrap(envs: Any) -> Any:
        if mode == AutoresetMode.NEXT_STEP:
            envs = wrappers.NormalizeObservation(envs)
        if (
            mode == AutoresetMode.DISABLED
        ):  # In this mode `SyncVectorEnv` hides masks from wrappers.
            return envs
        return wrappers.NormalizeReward(wrappers.RecordEpisodeStatistics(envs))

    ours, theirs = wrap(mortals(mode, dies=True)), wrap(mortals(mode, dies=False))
    both_do(ours, theirs, mode, SINGLE_AND_TOGETHER)
    ours.close()


def test_a_death_in_a_reset_or_a_call(twins: Any) -> None:
    """A reset still begins episodes, without its seeds, and reports the cause; a call ends in an
    error, and the next step is the one that tells.
    """
    envs = made()
    killed(envs.group, lambda: envs.reset_async(seed=7))
    observations, infos = envs.reset_wait()
    assert infos["_worker_restarted"].tolist() == LOST
    np.testing.assert_array_equal(observations[2:], twins.reset(seed=7)[0][2:])
    assert not envs.step(ACTIONS)[3].any()
    killed(envs.group, lambda: None)
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.get_attr("dt")
    assert envs.step(ACTIONS)[3].tolist() == LOST
    mask = np.array([True, False, True, False])
    envs.reset(options={"reset_mask": mask})
    _, rewards, _, truncated, _ = envs.step(ACTIONS)
    assert (rewards == 0).tolist() == [False, True, False, False]
    assert not truncated.any()
    assert (envs.step(ACTIONS)[1] != 0).all()
    envs.close()


def test_a_death_raises_if_configured() -> None:
    """Each time, as the worker is not replaced."""
    envs = made(on_worker_death="raise")
    envs.reset(seed=7)
    killed(envs.group, lambda: envs.step_async(ACTIONS))
    with pytest.raises(WorkerDied, match=r"env 'env-0'.*was killed by SIGKILL"):
        envs.step_wait()
    with pytest.raises(WorkerDied, match="env 'env-0'"):
        envs.reset()
    envs.close()


@pytest.fixture
def sb3_mortals() -> Iterator[Any]:
    """Two envs behind Stable-Baselines3's interface; some random actions kill the worker."""
    pytest.importorskip("stable_baselines3")
    from rlightning_aio.sb3 import VecEnv

    makers = [lambda k=k: Mortal(k, dies=True) for k in range(2)]
    envs = VecEnv(makers, envs_per_process=1, max_restarts=9, step_timeout=2.0)
    yield envs
    envs.close()


def taken(before: Any, action: int) -> Any:
    """Results of a step from a given observation."""
    env = Mortal(int(before[0]), dies=False)
    env.count, env.sum = int(before[1]), int(before[2])
    return env.step(action)


@pytest.mark.simulators
def test_a_replay_buffer_holds_only_steps_that_were_taken(sb3_mortals: Any) -> None:
    """In a run with deaths and hangs."""
    from stable_baselines3 import DQN

    model = DQN("MlpPolicy", sb3_mortals, learning_starts=99, buffer_size=99, seed=1, device="cpu")
    buffer = model.learn(60).replay_buffer
    for step, k in np.ndindex(buffer.pos, 2):
        before, action = buffer.observations[step, k], int(buffer.actions[step, k, 0])
        observation, reward, terminated, truncated, _ = taken(before, action)
        np.testing.assert_array_equal(buffer.next_observations[step, k], observation)
        assert buffer.rewards[step, k] == reward
        assert buffer.dones[step, k] == (terminated or truncated)
        assert buffer.timeouts[step, k] == truncated
    assert {0, 1} < set(buffer.actions[: buffer.pos].flatten().tolist())


@pytest.mark.parametrize("mode", MODES)
def test_a_masked_reset_leaves_it_to_the_next_step_to_tell_of_other_lost_episodes(
    mode: AutoresetMode,
) -> None:
    """Three envs of one worker, which dies between two calls; one of them is to be reset."""
    envs = VectorEnv([Counted] * 3, envs_per_process=3, autoreset_mode=mode)
    nothing = np.zeros(3, np.int64)
    envs.reset(seed=0)
    envs.step(nothing)
    kill(envs.group.get_workers()[0]["pid"])
    first, infos = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert first[:, 1].tolist() == [1, 0, 1]
    assert not infos.get("_worker_restarted", nothing)[[0, 2]].any()
    _, rewards, _, truncated, infos = envs.step(nothing)
    assert truncated.tolist() == infos["_worker_restarted"].tolist() == [True, False, True]
    assert rewards.tolist() == [0, 1, 0]
    envs.close()
