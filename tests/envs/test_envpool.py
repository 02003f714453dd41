"""The `envpool` backend on the real EnvPool."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from envs.bare import gymnasium_outcomes
from envs.group_contract import GroupContract

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.contract import Expected, same, values_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rlightning_aio.envs.simulators.envpool import EnvPoolEnv

envpool: Any = pytest.importorskip("envpool")

pytestmark = [
    pytest.mark.simulators,
    pytest.mark.filterwarnings("ignore:.*precision lowered:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*overrides the limits:UserWarning"),
]


def entry(task: str = "CartPole-v1", num_envs: int = 4, **fields: Any) -> EnvConfig:
    return EnvConfig(name="pool", backend="envpool", task=task, num_envs=num_envs, **fields)


def make(*args: Any, **fields: Any) -> EnvPoolEnv:
    from rlightning_aio.envs.simulators.envpool import EnvPoolEnv

    return EnvPoolEnv(entry(*args, **fields))


class PoolContract(GroupContract):
    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        limit = self.config.max_episode_steps
        pool = envpool.make(
            self.config.task,
            env_type="gymnasium",
            num_envs=self.config.num_envs,
            seed=self.seed,
            **({} if limit is None else {"max_episode_steps": limit}),
        )
        return gymnasium_outcomes(pool, None, actions, resets_itself=True)


class TestCartPoles(PoolContract):
    config = entry()


class TestHalfCheetahs(PoolContract):
    config = entry("HalfCheetah-v5", 3, max_episode_steps=50)


class TestAtari(PoolContract):
    config = entry("Pong-v5", 2)


class TestPoolOfOne(GroupContract):
    config = entry(num_envs=1)

    def simulate(self, actions: Sequence[Any]) -> Iterator[Expected]:
        pool = envpool.make("CartPole-v1", env_type="gymnasium", num_envs=1, seed=self.seed)
        batched = gymnasium_outcomes(
            pool, None, [np.array([a]) for a in actions], resets_itself=True
        )
        (observation, *rest) = next(batched)
        yield observation[0], *rest
        for outcome in batched:
            yield tuple(column[0] for column in outcome)


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Pong-v5", "Blackjack-v1", "CheetahRun-v1"])
def test_results_equal_those_of_the_pools_methods(task: str) -> None:
    """`send` and `recv`, including names, dtypes and nesting; arrays and dicts of them."""
    env = make(task, 3)
    pool = envpool.make(task, env_type="gymnasium", num_envs=3, seed=[4, 5, 6])
    pool.async_reset()
    result = env.reset(seed=4)
    space = env.get_action_space()
    for _ in range(30):
        observation, reward, terminated, truncated, info = pool.recv()
        assert same((result.observation, result.info), (observation, info))
        action = space.sample()
        pool.send(action, info["env_id"])
        if result.info["elapsed_step"].any():
            outcome = values_of(result)
            assert same(outcome, (observation, reward, terminated, truncated))
            assert outcome[1].dtype == reward.dtype
        result = env.step(PolicyResponse("pool-0", action))
    for opened in (env, pool):
        opened.close()


def test_inline_results_are_not_copied() -> None:
    """The batch owns EnvPool's arrays; a row of shared memory would need a copy."""
    config = entry("Pong-v5", 2, placement="inline")
    with sync.build_env_group(config) as group:
        batch, _ = group.reset(seed=1)
        kept = batch.observation.copy()
        results = [batch]
        for _ in range(5):
            results.append(group.step(results[-1].respond(action=np.zeros((1, 2), np.int64)))[0])
        assert not any(result.observation.flags.owndata for result in results[1:])
        assert len({result.observation.ctypes.data for result in results}) == len(results)
        assert np.array_equal(batch.observation, kept)


@pytest.mark.parametrize("task", ["LunarLander-v3", "WalkerRun-v1"])
def test_observations_outside_their_space_only_warn(task: str) -> None:
    """One warning names the task, and EnvPool's observations are returned."""
    with sync.build_env_group(entry(task, 2, placement="inline")) as group:
        with pytest.warns(UserWarning, match=f"task '{task}'.*an observation.* holds") as said:
            batch, _ = group.reset(seed=0)
        assert len(said) == 1
        space = group.get_action_spaces()[0]
        assert space is not None
        for _ in range(5):
            batch, _ = group.step(batch.respond(action=[space.sample()]))


def test_a_result_belongs_to_its_caller() -> None:
    """Writing to its ids doesn't redirect the next actions."""
    env, alone = make(num_envs=4), make(num_envs=4)
    result, expected = env.reset(seed=2), alone.reset(seed=2)
    for k in range(20):
        result.info["env_id"] += 100
        action = np.array([0, 1, 1, 0]) ^ (k % 2)
        result, expected = (e.step(PolicyResponse("pool-0", action)) for e in (env, alone))
        assert same(result.observation, expected.observation)
    for opened in (env, alone):
        opened.close()


def test_an_action_may_be_overwritten_after_it_was_sent() -> None:
    """EnvPool reads it later."""
    pool = make("HalfCheetah-v5", 8, env_kwargs={"batch_size": 2, "num_threads": 1})
    alone = [make("HalfCheetah-v5", 1) for _ in range(8)]
    expected = [env.reset(seed=k) for k, env in enumerate(alone)]
    result = pool.reset(seed=0)
    buffer, rng = np.empty((2, 6)), np.random.default_rng(0)
    for _ in range(200):
        buffer[...] = rng.uniform(-1, 1, (2, 6))
        for row, index in enumerate(result.info["env_id"]):
            assert same(result.observation[row], expected[index].observation)
            expected[index] = alone[index].step(PolicyResponse("pool-0", buffer[row].copy()))
        result = pool.step(PolicyResponse("pool-0", buffer))
        buffer[...] = 0.0
    for env in (pool, *alone):
        env.close()


def test_asynchronous_results_are_batches_of_ready_sub_environments() -> None:
    """Spaces and num_envs are those of the batch; steps of each sub-environment are in order."""
    env = make(num_envs=6, env_kwargs={"batch_size": 2})
    meta = env.get_metadata()
    assert meta.num_envs == 2
    assert meta.observation_space is not None
    assert meta.observation_space.shape == (2, 4)
    result = env.reset(seed=5)
    steps_seen: dict[int, int] = {}
    for _ in range(300):
        assert meta.observation_space.contains(result.observation)
        for index, step in zip(result.info["env_id"], result.info["elapsed_step"], strict=True):
            assert step in (0, steps_seen.get(int(index), -1) + 1)
            steps_seen[int(index)] = int(step)
        result = env.step(PolicyResponse("pool-0", np.zeros(2, np.int64)))
    assert steps_seen.keys() == set(range(6))
    env.close()


def test_asynchronous_trajectories_depend_only_on_seeds() -> None:
    """In any order of arrival, the seed determines the trajectory of a sub-environment."""
    pool = make(num_envs=4, env_kwargs={"batch_size": 2})
    alone = [make(num_envs=1) for _ in range(4)]
    expected = [env.reset(seed=9 + k) for k, env in enumerate(alone)]
    result = pool.reset(seed=9)
    for _ in range(200):
        actions = np.arange(2) % 2
        for row, index in enumerate(result.info["env_id"]):
            assert same(result.observation[row], expected[index].observation)
            expected[index] = alone[index].step(PolicyResponse("pool-0", actions[row]))
        result = pool.step(PolicyResponse("pool-0", actions))
    for env in (pool, *alone):
        env.close()


@pytest.mark.parametrize("placement", ["process", "inline"])
def test_a_group_counts_the_episodes_of_each_sub_environment(placement: str) -> None:
    """With partial batches, without additional resets, and with all episodes counted."""
    config = entry(
        num_envs=4, placement=placement, max_episode_steps=7, env_kwargs={"batch_size": 2}
    )
    steps_seen: dict[int, int] = {}
    finished: list[int] = []
    with sync.build_env_group(config) as group:
        batch, _ = group.reset(seed=2)
        with group.auto_reset(max_episode_steps=10**6):
            for count in range(200):
                result = batch.values()[0]
                for index, step in zip(
                    result.info["env_id"].tolist(), result.info["elapsed_step"], strict=True
                ):
                    assert step in (0, steps_seen.get(index, -1) + 1)
                    steps_seen[index] = int(step)
                if count:
                    ended = result.last_terminated | result.last_truncated
                    finished += result.info["elapsed_step"][ended].tolist()
                group.step_async(batch.respond(action=np.array([[count % 2, 1]])))
                batch, _ = group.collect_async()
        stats = group.get_env_stats()["pool-0"]
    last = batch.values()[0]
    finished += last.info["elapsed_step"][last.last_terminated | last.last_truncated].tolist()
    assert stats["episodes"] == len(finished) > 20
    assert stats["mean_length"] == stats["mean_return"] == np.mean(finished)


def test_asynchronous_pools_can_be_reset_while_they_compute() -> None:
    """Steps in flight are dropped; a seed gives the same start."""
    env = make(num_envs=4, env_kwargs={"batch_size": 2})
    starts = []
    for _ in range(3):
        result = env.reset(seed=1)
        starts.append(dict(zip(result.info["env_id"].tolist(), result.observation, strict=True)))
        env.step(PolicyResponse("pool-0", np.zeros(2, np.int64)))
    for index in range(4):
        seen = [start[index] for start in starts if index in start]
        assert all(same(one, seen[0]) for one in seen)
    assert env.reset().info["elapsed_step"].tolist() == [0, 0]
    env.close()


def test_a_seed_or_a_list_of_seeds() -> None:
    """Sub-environment k gets seed + k, or element k of a list."""
    env = make()
    start = values_of(env.reset(seed=7))
    assert same(start, values_of(env.reset(seed=[7, 8, 9, 10])))
    assert not same(start, values_of(env.reset(seed=[8, 7, 9, 10])))
    with pytest.raises(ValueError, match="'pool-0': 2 seeds for 4 sub-environments"):
        env.reset(seed=[1, 2])
    env.close()


def test_unseeded_pools_differ() -> None:
    """Despite EnvPool's fixed default seed."""
    envs = [make(), make()]
    assert not np.array_equal(envs[0].reset().observation, envs[1].reset().observation)
    for env in envs:
        env.close()


def test_the_final_observation_comes_before_the_reset() -> None:
    """The step after an end returns the first observation of the next episode and reward 0."""
    env = make("Pendulum-v1", 2, max_episode_steps=3)
    env.reset(seed=0)
    results = [env.step(PolicyResponse("pool-0", np.ones((2, 1), np.float32))) for _ in range(5)]
    assert [bool(r.last_truncated.all()) for r in results] == [False, False, True, False, False]
    assert [int(r.info["elapsed_step"][0]) for r in results] == [1, 2, 3, 0, 1]
    assert not results[3].last_reward.any()
    env.close()


def test_limits_are_known() -> None:
    """The configured limit, the task's own, or none."""
    assert make().get_metadata().max_episode_steps == 500
    assert make(max_episode_steps=9).get_metadata().max_episode_steps == 9
    assert make("Blackjack-v1").get_metadata().max_episode_steps is None


def test_misuse_raises() -> None:
    """Invalid batch sizes, steps before a reset, and options of a reset."""
    with pytest.raises(ConfigError, match="batch_size is 5, but must be between 1 and num_envs"):
        make(env_kwargs={"batch_size": 5})
    env = make()
    with pytest.raises(RuntimeError, match="before its first reset"):
        env.step(PolicyResponse("pool-0", np.zeros(4, np.int64)))
    with pytest.raises(ValueError, match="takes no reset options"):
        env.reset(options={"reset_mask": [True, False, False, False]})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"shape \(3,\) for 4 sub-environments; expected \(4,\)"):
        env.step(PolicyResponse("pool-0", np.zeros(3, np.int64)))
    for task in ("IntersectionMultiAgent-v0", "TicTacToe-v1"):
        with pytest.raises(ConfigError, match=f"'pool-0'.*'{task}' has several players"):
            make(task)
    env.close()
