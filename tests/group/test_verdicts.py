"""Successes that envs report, in the group's statistics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space
from kit.scripted import Counts

from rlightning_aio import ENVS, BaseEnv, BatchedData, EnvConfig, EnvRet, PolicyResponse, sync
from rlightning_aio.attempts.records import success_of
from rlightning_aio.vector import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Iterator


@pytest.fixture
def backend() -> Iterator[str]:
    name = "judging"
    ENVS.register(name)(JudgingEnv)
    yield name
    ENVS._classes.pop(name)


class JudgingEnv(BaseEnv):
    """Sub-environment k ends in every step that k + 1 divides, every other time with success."""

    autoreset = "same_step"

    def _batched(self, space: Any) -> Any:
        return batch_space(space, self.num_envs) if self.num_envs > 1 else space

    def get_observation_space(self) -> Any:
        return self._batched(gym.spaces.Box(0, 1, (1,), np.float32))

    def get_action_space(self) -> Any:
        return self._batched(gym.spaces.Discrete(2))

    def _answer(self, **fields: Any) -> EnvRet:
        observation = np.zeros(self.get_observation_space().shape, np.float32)
        return EnvRet(env_id=self.env_id, observation=observation, **fields)

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        self.count = 0
        return self._answer(info={"success": self._shaped(True)})

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        self.count += 1
        period = np.arange(1, self.num_envs + 1)
        ended, success = self.count % period == 0, self.count % (2 * period) == 0
        info = {"success": self._shaped(success)}
        if "nested" in self.config.env_kwargs:
            info["nested"] = {"travels": "pickled"}
        return self._answer(
            last_reward=self._shaped(np.ones(self.num_envs)),
            last_terminated=self._shaped(ended),
            last_truncated=self._shaped(np.zeros(self.num_envs, bool)),
            info=info,
        )

    def _shaped(self, values: Any) -> Any:
        values = np.broadcast_to(values, (self.num_envs,)).copy()
        return values if self.num_envs > 1 else values[0].item()


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_success_is_counted_where_an_episode_ends(backend: str, placement: str) -> None:
    """Only reports at an end count, for each sub-environment that has ended.

    For infos in the row and pickled ones.
    """
    episodes = {1: 12, 3: 12 + 6 + 4}
    configs = [
        EnvConfig(
            name=f"{way}-{num_envs}",
            backend=backend,
            task="any",
            num_envs=num_envs,
            placement=placement,
            env_kwargs=env_kwargs,
        )
        for way, env_kwargs in (("row", {}), ("pickled", {"nested": True}))
        for num_envs in episodes
    ]
    with sync.build_env_group(configs) as group:
        group.reset()
        responses = [
            PolicyResponse(env_id, np.zeros(space.shape, np.int64))
            for env_id, space in zip(group.env_ids, group.get_action_spaces(), strict=True)
        ]
        for _ in range(12):
            group.step(BatchedData(group.env_ids, responses))
        stats, again = group.get_env_stats(reset=True), group.get_env_stats()
    for config in configs:
        found = stats[f"{config.name}-0"]
        assert found["episodes"] == episodes[config.num_envs]
        assert found["success_rate"] == 0.5
        assert found["fail_rate"] is None
        assert again[f"{config.name}-0"]["success_rate"] is None


class Judged(Counts):
    """Its episodes have three steps. Each ends with success, and each reset reports a failure."""

    length = 3

    def told(self) -> dict[str, Any]:
        return {"success": self.over} if self.over or not self.steps else {}


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_verdict_of_the_next_reset_does_not_count(mode: AutoresetMode) -> None:
    envs = VectorEnv([Judged], autoreset_mode=mode, placement="inline")
    envs.reset()
    for _ in range(12):
        envs.step(np.zeros(1, np.int64))
    assert envs.group.get_env_stats()["env-0"]["success_rate"] == 1.0
    envs.close()


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_the_verdict_of_the_next_reset_of_several_does_not_count(mode: AutoresetMode) -> None:
    make = lambda: SyncVectorEnv([Judged] * 2, autoreset_mode=mode)  # noqa: E731
    with sync.build_env_group({"name": "e", "task": make, "placement": "inline"}) as group:
        batch, _ = group.reset()
        for _ in range(12):
            batch, _ = group.step(batch.respond(action=np.zeros((1, 2), np.int64)))
        assert group.get_env_stats()["e-0"]["success_rate"] == 1.0


def test_a_last_info_without_a_verdict_has_none() -> None:
    """The first info of the next episode has none about the last one."""
    both = {"success": False, "final_info": {"reward": 1.0}}
    assert success_of(both) is None
    masks = {"_final_info": np.array([True, False]), "_success": np.array([True, True])}
    assert success_of({**both, **masks, "success": np.array([False, True])}, 0) is None
    assert success_of({**both, **masks, "success": np.array([False, True])}, 1) is True
