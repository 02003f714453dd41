"""Worker deaths behind the vector interfaces look like truncated episodes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import vector as wrappers
from kit.processes import kill
from vector.toys import Counted, Mortal, assert_alike

from rlightning_aio.vector import VectorEnv

MODES = list(AutoresetMode)


def mortals(mode: AutoresetMode, *, dies: bool) -> Any:
    """Three envs, each in a worker of its own, or in this process if they don't die."""
    makers = [lambda k=k: Mortal(k, dies=dies) for k in range(3)]
    if not dies:
        return gym.vector.SyncVectorEnv(makers, autoreset_mode=mode)
    return VectorEnv(makers, autoreset_mode=mode, envs_per_process=1, max_restarts=9)


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
    envs.reset(options={"reset_mask": np.array([True, False, False])})
    rewards = envs.step(nothing)[1]  # One of them is reset by that step, if steps do that.
    assert rewards.tolist() == [1, 1, mode != AutoresetMode.NEXT_STEP]
    envs.close()
