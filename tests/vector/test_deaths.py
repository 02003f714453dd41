"""Worker deaths behind the vector interfaces, where random programs don't look."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from kit.processes import kill
from kit.scripted import DIE, GO
from vector.toys import Counted

from rlightning_aio.vector import VectorEnv

MODES = list(AutoresetMode)


@pytest.mark.parametrize("mode", MODES)
def test_infos_name_the_env_that_died_and_whom_to_blame(mode: AutoresetMode) -> None:
    """With the end of the episode; in the mode that resets in the same step, in its final info."""
    envs = VectorEnv([Counted] * 3, envs_per_process=1, autoreset_mode=mode)
    envs.reset(seed=0)
    infos = envs.step(np.array([GO, DIE, GO]))[4]
    found = infos["final_info"] if mode == AutoresetMode.SAME_STEP else infos
    for name in ("env_at_fault", "outcome"):
        assert found[f"_{name}"].tolist() == [False, True, False]
    assert found["env_at_fault"][1] == found["outcome"][1].env_id == "env-1"
    assert (found["outcome"][1].kind, found["outcome"][1].blame) == ("env_died", "env")
    envs.close()


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
