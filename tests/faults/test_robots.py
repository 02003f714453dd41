"""After a worker's death, only an explicit reset moves real hardware."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest

from rlightning_aio import ENVS, BaseEnv, EnvConfig, EnvRet, PolicyResponse, sync
from rlightning_aio.errors import BadAction, EnvRaised, EpisodeLost, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Iterator

REFUSE, DIE = 6, 7


class Robot(BaseEnv):
    """Counts its movements, and dies of one action."""

    def __init__(self, config: EnvConfig, worker_index: int = 0, preprocess_fn: Any = None) -> None:
        super().__init__(config, worker_index, preprocess_fn)
        self.num_moves = 0
        self.env = self

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(0, np.inf, (1,), np.float32)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Discrete(DIE + 1)

    def _moved(self) -> EnvRet:
        self.num_moves += 1
        return EnvRet(env_id=self.env_id, observation=np.array([self.num_moves], np.float32))

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        return self._moved()

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        if policy_resp.action == DIE:
            os._exit(3)
        if policy_resp.action == REFUSE:
            raise BadAction("beyond its limits")
        return self._moved()


@pytest.fixture
def robots() -> Iterator[dict[str, Any]]:
    """Return the fields of an entry of two robots."""
    ENVS.register("robot", hardware=True)(Robot)
    yield {"name": "robot", "backend": "robot", "task": "any", "num_workers": 2}
    del ENVS._classes["robot"]


def test_a_robots_worker_is_not_replaced_by_default(robots: dict[str, Any]) -> None:
    """The registration of the backend says that it is hardware, or the row of a built-in one."""
    piper = EnvConfig(name="arm", backend="piper", task="any")
    assert (piper.on_worker_death, EnvConfig(**robots).on_worker_death) == ("raise", "raise")
    assert EnvConfig(name="e", backend="mujoco", task="any").on_worker_death == "restart"
    assert EnvConfig(**robots, on_worker_death="restart").on_worker_death == "restart"
    ENVS.register("robot")(Robot)
    assert EnvConfig(**robots).on_worker_death == "restart"


def test_a_robot_whose_worker_was_replaced_waits_for_a_reset(robots: dict[str, Any]) -> None:
    """A step raises the death's error, and nothing moves before a requested reset."""
    with sync.build_env_group({**robots, "on_worker_death": "restart"}) as group:
        batch, _ = group.reset()
        with pytest.raises(WorkerDied, match="it moves nothing until you reset it") as caught:
            group.step(batch.respond(action=np.array([0, DIE])))
        assert caught.value.env_ids == ("robot-1",)
        assert caught.value.results.observation.tolist() == [[2.0]]
        assert group["robot-1"].get_attr("num_moves") == 0
        for _ in range(2):
            with pytest.raises(EpisodeLost, match=r"exited with code 3.*reset it to go on"):
                group.step(batch.respond(action=np.array([0, 0])))
        batch, _ = group.reset(env_ids=["robot-1"])
        assert batch.observation.tolist() == [[1.0]]
        assert batch.restarted.all()
        group["robot-1"].step(PolicyResponse("robot-1", 0))


def test_an_action_that_an_env_refuses_is_a_bad_action(robots: dict[str, Any]) -> None:
    """Like one that the group refuses, except that the other envs have stepped."""
    with sync.build_env_group({**robots, "placement": "inline"}) as group:
        batch, _ = group.reset()
        with pytest.raises(BadAction, match="BadAction: beyond its limits") as caught:
            group.step(batch.respond(action=np.array([0, REFUSE])))
        fault = caught.value
        assert isinstance(fault, EnvRaised)
        assert (fault.env_id, fault.results.ids()) == ("robot-1", ["robot-0"])
