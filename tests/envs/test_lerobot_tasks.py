"""The backends `pusht` and `aloha` on the packages themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from envs.bare import gymnasium_outcomes
from envs.group_contract import GroupContract

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.evaluation import EpisodeSpec, evaluate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from kit.contract import Expected

pytest.importorskip("gym_pusht")
pytest.importorskip("gym_aloha")

pytestmark = pytest.mark.simulators


class TestPushT(GroupContract):
    config = EnvConfig(name="block", backend="pusht", task="PushT-v0")

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        env = gym.make("gym_pusht/PushT-v0", disable_env_checker=True)
        return gymnasium_outcomes(env, self.seed, actions)


def test_tasks_of_aloha_share_an_env() -> None:
    """Episodes are those of the bare simulators, whatever their env has played before."""
    tasks = ("AlohaInsertion-v0", "AlohaTransferCube-v0")
    config = EnvConfig(
        name="arms", backend="aloha", task=tasks[0], max_episode_steps=2,
        env_kwargs={"obs_type": "pixels_agent_pos"},
    )  # fmt: skip
    moved: dict[str, Any] = {}

    def act(batch: Any) -> Any:
        moved.setdefault("positions", []).append(batch.observation["agent_pos"][0])
        return np.full((len(batch), 14), 0.3, np.float32)

    with sync.build_env_group(config) as group, group.auto_reset():
        found = evaluate(group, act, [EpisodeSpec(tasks[k % 2], k // 2) for k in (0, 1, 2)])
    # An env continues with its own task while episodes of it wait.
    assert [(one.spec.task, one.length) for one in found.attempts] == [
        (tasks[0], 2),
        (tasks[0], 2),
        (tasks[1], 2),
    ]
    env = gym.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos")
    observation, _ = env.reset(seed=0)
    assert np.array_equal(observation["agent_pos"], moved["positions"][4])
    observation = env.step(np.full(14, 0.3, np.float32))[0]
    assert np.array_equal(observation["agent_pos"], moved["positions"][5])
    env.close()
