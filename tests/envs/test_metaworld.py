"""The `metaworld` backend on MetaWorld itself, whose tasks share envs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.group_contract import GroupContract

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.errors import ConfigError
from rlightning_aio.evaluation import EpisodeSpec, evaluate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from kit.contract import Expected

    import rlightning_aio as rl

pytest.importorskip("metaworld")
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.filterwarnings("ignore:Constant:UserWarning"),
]


def entry(task: str = "reach-v3", **fields: Any) -> EnvConfig:
    return EnvConfig(name="arm", backend="metaworld", task=task, **fields)


def simulator_of(task: str) -> Any:
    env = ALL_V3_ENVIRONMENTS[task]()
    env._partially_observable = False
    vars(env).pop("sawyer_observation_space", None)
    env._set_task_called = env.seeded_rand_vec = True
    return env


def begun(env: Any, seed: int) -> Any:
    env.seed(seed)
    env._freeze_rand_vec = False
    env.reset_model()
    env._freeze_rand_vec = True
    return env.reset()[0]


class TestOneTask(GroupContract):
    num_steps = 40
    config = entry("drawer-close-v3", env_kwargs={"terminate_on_success": False})

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        env = simulator_of("drawer-close-v3")
        yield begun(env, self.seed), 0.0, False, False
        for action in actions:
            observation, reward, _, truncated, _ = env.step(action)
            yield observation, reward, False, truncated
        env.close()


def plain_loop(task: str, seed: int) -> tuple[float, int, bool]:
    env, policy = simulator_of(task), ENV_POLICY_MAP[task]()
    observation = begun(env, seed)
    total, length, over, info = 0.0, 0, False, {"success": 0.0}
    while not over:
        action = np.clip(policy.get_action(observation), -1, 1).astype(np.float32)
        observation, reward, _, truncated, info = env.step(action)
        total, length, over = total + float(reward), length + 1, truncated or bool(info["success"])
    env.close()
    return total, length, bool(info["success"])


def scripted() -> Any:
    """MetaWorld's own policies, by the task that the last reset of each env named."""
    policies: dict[str, Any] = {}

    def policy(batch: rl.BatchedData) -> Any:
        env_ids = batch.env_ids()
        begins = np.flatnonzero(batch.is_reset).tolist()
        for row, info in zip(begins, batch.take(begins).info() if begins else (), strict=True):
            policies[env_ids[row]] = ENV_POLICY_MAP[info["task"]]()
        actions = [
            policies[env_id].get_action(observation)
            for env_id, observation in zip(env_ids, batch.observation, strict=True)
        ]
        return np.clip(actions, -1, 1).astype(np.float32)

    return policy


def test_tasks_share_envs_and_end_as_in_a_plain_loop() -> None:
    """Whichever env plays an episode, and whatever it has played before."""
    tasks = ("reach-v3", "drawer-close-v3", "handle-press-v3")
    queue = [EpisodeSpec(task, seed) for seed in range(2) for task in tasks]
    with sync.build_env_group(entry(num_workers=2)) as group, group.auto_reset():
        found = evaluate(group, scripted(), queue)
    assert len(found.played) == 6
    for one in found.played:
        alone = plain_loop(one.spec.task, one.spec.seed)
        assert (one.reward, one.length, one.success) == alone
    assert found.success is not None
    assert found.success.mean == 1.0


def test_a_task_that_does_not_exist_is_named() -> None:
    """At the start, and at a reset."""
    with pytest.raises(ConfigError) as raised:
        sync.build_env_group(entry("reach")).init()
    assert "did you mean 'reach-v3'?" in str(raised.value)
    with sync.build_env_group(entry()) as group, group.auto_reset():
        found = evaluate(group, scripted(), [EpisodeSpec("pusch-v3", 0)], retries=0)
    (failed,) = found.failed
    assert "did you mean 'push-v3'?" in failed.outcome.cause
