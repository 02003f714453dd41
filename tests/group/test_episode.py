"""When an episode of one env is over; tests/hosts/test_loop.py tests the rest of `EnvEpisode`."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from kit.scripted import Counts

from rlightning_aio import BaseEnv, EnvConfig, MultiAgentEnvRet, build_env_group


class Timed(Counts):
    """Ends after `length` steps."""

    def __init__(self, length: int) -> None:
        self.length = length


class Duel(BaseEnv):
    """Agent k leaves after 2 + k steps."""

    agents = ("first", "second")

    def get_observation_space(self) -> Any:
        return gym.spaces.Dict({agent: gym.spaces.Discrete(9) for agent in self.agents})

    get_action_space = get_observation_space

    def reset(self, *, seed: Any = None, options: Any = None) -> MultiAgentEnvRet:
        self._count = 0
        return MultiAgentEnvRet(env_id=self.env_id, observation=dict.fromkeys(self.agents, 0))

    def step(self, policy_resp: Any) -> MultiAgentEnvRet:
        self._count += 1
        ends = {agent: self._count >= 2 + k for k, agent in enumerate(self.agents)}
        return MultiAgentEnvRet(
            env_id=self.env_id,
            observation=dict.fromkeys(self.agents, 0),
            last_reward=dict.fromkeys(self.agents, 1.0),
            last_terminated=ends,
            last_truncated=dict.fromkeys(self.agents, False),
        )


@pytest.mark.parametrize(
    ("make_env", "action", "limit", "num_steps"),
    [
        (lambda: Timed(5), 0, None, 5),
        (lambda: Timed(5), 0, 3, 3),
        (lambda: Duel(EnvConfig(name="duel", backend="callable", task="-")), None, None, 3),
        (lambda: Duel(EnvConfig(name="duel", backend="callable", task="-")), None, 2, 2),
    ],
    ids=["env", "limit", "agents", "agents-limit"],
)
async def test_an_episode_is_over_at_the_end_of_all_its_agents_or_at_the_limit(
    make_env: Any, action: Any, limit: int | None, num_steps: int
) -> None:
    action = {"first": 0, "second": 0} if action is None else action
    async with build_env_group({"name": "e", "task": make_env}) as group:
        with group.auto_reset(limit or 99):
            async with group.episode("e-0", seed=3) as episode:
                count = 0
                while not episode.is_over:
                    await episode.step(action)
                    count += 1
    assert count == num_steps


@pytest.mark.parametrize("other", [2, 4])
async def test_an_episode_is_over_when_all_sub_environments_are(other: int) -> None:
    def make_env() -> Any:
        return SyncVectorEnv([lambda: Timed(2), lambda: Timed(other)])

    config = {"name": "e", "task": make_env}
    async with build_env_group(config) as group, group.episode("e-0") as episode:
        assert not episode.is_over
        for over in (False, other == 2):
            await episode.step(np.zeros(2, np.int64))
            assert episode.is_over is over
