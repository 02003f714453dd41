"""Collectors with all kinds of envs, with policies that wait or fail, and their memory."""

from __future__ import annotations

import asyncio
import copy
import math
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from collecting.scripted import scripted_group
from group import sample_envs
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.collecting.episodes import whole_episodes
from rlightning_aio.errors import BadAction

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData

assert sample_envs  # Registers its envs.

POLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "placement": "inline"}


def zeros(batch: BatchedData) -> dict[str, Any]:
    return {"action": np.zeros(batch.is_reset.shape, int)}


def poles(count: int, **fields: Any) -> Any:
    return sync.build_env_group({**POLE, "num_workers": count, **fields})


# -- kinds of envs


def test_each_kind_of_env_has_its_own_policy_and_rollout() -> None:
    """Together they have the requested number of transitions."""
    entries = [
        {**POLE, "num_workers": 3},
        {"name": "probe", "backend": "probe", "task": "-", "num_workers": 2, "placement": "inline"},
    ]

    def probe(batch: BatchedData) -> dict[str, Any]:
        assert batch.observation.shape == (len(batch), 4)
        return {"action": np.zeros((len(batch), 2)), "note": np.arange(len(batch))}

    for options, expected in (
        ({"min_results": 2}, {}),
        ({"wait_all": True}, {"pole": (4, 3), "probe": (4, 2)}),
    ):
        group = sync.build_env_group(entries, mixed_actions=True)
        with group, group.auto_reset(20):
            collector = Collector(
                group, {"pole": zeros, "probe": probe}, num_transitions=20, seed=0, **options
            )
            for _ in range(3):
                rollouts = collector.collect()
                assert list(rollouts) == ["pole", "probe"]
                assert sum(map(len, rollouts.values())) == 20
                assert "note" in rollouts["probe"]
                assert "note" not in rollouts["pole"]
                assert set(rollouts["probe"].index.flat) <= {3, 4}
                for name, shape in expected.items():
                    assert rollouts[name].shape == shape
                    assert rollouts[name].action.shape[:2] == shape


def test_envs_of_several_kinds_need_several_policies() -> None:
    entries = [{**POLE}, {**POLE, "name": "car", "task": "MountainCar-v0"}]
    with sync.build_env_group(entries, mixed_actions=True) as group, group.auto_reset():
        collector = Collector(group, zeros, num_transitions=4)
        with pytest.raises(ValueError, match="by_entry"):
            collector.collect()


class Judged(gym.Wrapper[Any, Any, Any, Any]):
    """CartPole with `value` as the success in the last info of an episode."""

    def __init__(self, value: Any) -> None:
        super().__init__(gym.make("CartPole-v1"))
        self.value = value

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, _ = self.env.step(action)
        info = {"success": self.value} if terminated or truncated else {}
        return observation, reward, terminated, truncated, info


def collector_of_infos(value: Any, infos: Any) -> Any:
    entry = {"name": "judged", "task": lambda: Judged(value), "placement": "inline"}
    group = sync.build_env_group(entry)
    return group, Collector(group, zeros, num_transitions=60, infos=infos, seed=0)


@pytest.mark.parametrize("value", [True, np.False_, 0.5, np.float32(0.5), np.array(1)])
def test_an_info_becomes_a_column_that_is_nan_where_it_is_missing(value: Any) -> None:
    group, collector = collector_of_infos(value, ["success", "absent"])
    with group, group.auto_reset():
        rollout = collector.collect()
    assert rollout.done.any()
    np.testing.assert_array_equal(rollout.success, np.where(rollout.done, float(value), np.nan))
    assert np.isnan(rollout.absent).all()
    assert rollout.episodes["info"] == [{"success": value}] * rollout.done.sum()


@pytest.mark.parametrize("value", ["yes", [1.0, 2.0], {"a": 1}, np.zeros(2)])
def test_an_info_that_is_not_a_number_raises(value: Any) -> None:
    group, collector = collector_of_infos(value, ["success"])
    with group, group.auto_reset():
        for _ in range(2):
            with pytest.raises(ValueError, match=r"info 'success' .* one number"):
                collector.collect()


def test_infos_with_the_name_of_a_rollouts_column_raise() -> None:
    for infos, why in (("success", "give .'success',."), (["reward"], "already has 'reward'")):
        with pytest.raises(ValueError, match=why):
            collector_of_infos(1.0, infos)
    group, collector = collector_of_infos(1.0, ["success"])
    with group, group.auto_reset():
        rollout = collector.collect()
    for name in {*dir(rollout), *rollout} - {"success"}:
        if not name.startswith("_"):
            with pytest.raises(ValueError, match=f"already has '{name}'"):
                collector_of_infos(1.0, [name])


@pytest.mark.parametrize("on_done", [True, False])
def test_each_agent_has_its_own_rewards_and_ends(on_done: bool) -> None:
    """An env whose episode is over is reset, also where the open context leaves that out."""

    def policy(batch: BatchedData) -> dict[str, Any]:
        count = len(batch)
        action = {"tall": np.ones((count, 1), np.float32), "small": np.ones(count, int)}
        return {"action": action, "value": {"tall": np.zeros(count), "small": np.zeros(count)}}

    crowd = {"name": "crowd", "backend": "crowd", "task": "-", "num_workers": 2}
    group = sync.build_env_group({**crowd, "placement": "inline"})
    with group, group.auto_reset(9, on_done):
        rollout = Collector(group, policy, num_transitions=9, min_results=2).collect()
        assert rollout.index.tolist() == [0] * 5 + [1] * 4
        assert rollout.observation["small"].tolist() == [0, 1, 2, 0, 1, 0, 1, 2, 0]
        assert rollout.terminated["tall"].tolist() == [0, 1, 1, 0, 1, 0, 1, 1, 0]
        assert rollout.terminated["small"].tolist() == [0, 0, 1, 0, 0, 0, 0, 1, 0]
        assert rollout.ends.tolist() == [4, 8, 2, 7]
        assert rollout.episodes["index"].tolist() == [0, 1]
        assert rollout.episodes["total_reward"].tolist() == [5.0, 5.0]
        assert rollout.episodes["length"].tolist() == [3, 3]
        assert group.metrics()["envs/results"] == 14
        values = {agent: np.zeros(4) for agent in ("tall", "small")}
        found = rollout.advantages(rollout.value, values, 1.0, 1.0)
        assert found["small"].tolist() == [3, 2, 1, 2, 1, 3, 2, 1, 1]
        assert found["tall"][:2].tolist() == [2, 1]


def test_blocks_that_would_have_holes_raise() -> None:
    group = scripted_group("vector", 2, 0.1)
    with group, group.auto_reset(99):
        collector = Collector(group, None, num_transitions=8, wait_all=True)
        with pytest.raises(ValueError, match=r"no \[T, N\] block.*min_results instead"):
            collector.collect()
    with poles(3) as group, group.auto_reset():
        collector = Collector(group, zeros, num_transitions=8, wait_all=True)
        for _ in range(2):
            with pytest.raises(ValueError, match=r"num_transitions=8 .* 3 envs"):
                collector.collect()


# -- policies


async def test_policies_may_be_awaited_and_cancelled() -> None:
    """The next call continues after a cancellation anywhere; nothing is lost or duplicated."""
    async with rl.build_env_group({**POLE, "num_workers": 3}) as group:
        asked, answering = asyncio.Event(), asyncio.Event()
        calls: list[list[int]] = []

        async def policy(batch: BatchedData) -> dict[str, Any]:
            calls.append(batch.index.tolist())
            asked.set()
            await answering.wait()
            return zeros(batch)

        with group.auto_reset():
            collector = Collector(group, policy, num_transitions=6, min_results=3, seed=0)
            task = asyncio.ensure_future(collector.collect())
            await asked.wait()
            with pytest.raises(RuntimeError, match="already collecting"):
                await collector.collect()
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            answering.set()
            rollout = await collector.collect()
            assert calls[:2] == [[0, 1, 2]] * 2
            assert rollout.index.tolist() == [0, 0, 1, 1, 2, 2]


def test_a_coroutine_needs_an_asynchronous_group() -> None:
    async def policy(batch: BatchedData) -> dict[str, Any]:
        return zeros(batch)

    with poles(1) as group, group.auto_reset():
        collector = Collector(group, policy, num_transitions=2)
        with pytest.raises(TypeError, match="asynchronous group"):
            collector.collect()


@pytest.mark.parametrize(
    ("answer", "error", "named"),
    [
        (
            {"action": np.zeros(2, int), "value": np.zeros(3)},
            BadAction,
            "'value' has 3 rows for a batch of 2",
        ),
        ({"action": np.zeros(2, int), "reward": np.zeros(2)}, ValueError, "already has 'reward'"),
        ({"action": np.zeros((2, 5), int)}, BadAction, "nothing was sent"),
    ],
)
def test_a_bad_answer_of_a_policy_raises_and_the_policy_is_called_again(
    answer: Any, error: type[Exception], named: str
) -> None:
    answers = [answer]

    def policy(batch: BatchedData) -> Any:
        return answers.pop() if answers else zeros(batch)

    with poles(2) as group, group.auto_reset():
        collector = Collector(group, policy, num_transitions=4, min_results=2, seed=0)
        with pytest.raises(error, match=named):
            collector.collect()
        assert collector.collect().index.tolist() == [0, 0, 1, 1]


def test_a_policy_must_give_the_same_columns_each_time() -> None:
    """With the same shape and kind of number: 0.5 is not an integer."""
    for more in (
        {"value": np.zeros(2)},
        {"note": np.full(2, 0.5)},
        {"note": np.zeros((2, 2), int)},
    ):
        answers: list[Any] = [more, {"note": np.zeros(2, int)}]

        def policy(batch: BatchedData, answers: Any = answers) -> Any:
            return {**zeros(batch), **(answers.pop() if answers else {"note": np.ones(2, int)})}

        with poles(2) as group, group.auto_reset():
            collector = Collector(group, policy, num_transitions=4, min_results=2, seed=0)
            with pytest.raises(ValueError, match="before"):
                collector.collect()
            assert collector.collect().note.tolist() == [0, 1, 0, 1]


def test_a_seed_of_numpy_seeds_random_actions_as_well() -> None:
    def actions(seed: Any) -> Any:
        with poles(1) as group:
            return Collector(group, None, num_transitions=20, seed=seed).collect().action.tolist()

    assert actions(np.int64(3)) == actions(3)


# -- the collector itself


def test_lag_is_counted_in_versions() -> None:
    with poles(2) as group, group.auto_reset():
        collector = Collector(group, zeros, num_transitions=3, min_results=2, seed=0)
        collector.collect()  # The fourth transition has already begun, with version 0.
        collector.policy_version += 2
        rollout = collector.collect()
        assert sorted(rollout.policy_version.tolist()) == [0, 2, 2]
        assert sorted(rollout.lag.tolist()) == [0, 0, 2]


@pytest.mark.parametrize(
    "options", [{"num_transitions": 0}, {"num_transitions": 1, "min_results": 0}]
)
def test_numbers_must_be_above_zero(options: Any) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Collector(poles(1), zeros, **options)


def test_columns_share_their_memory_with_torch() -> None:
    torch = pytest.importorskip("torch")

    def policy(batch: BatchedData) -> dict[str, Any]:
        observation = torch.from_numpy(batch.observation)
        return {"action": (observation[:, 2] > 0).long(), "value": observation.sum(1)}

    with poles(2) as group, group.auto_reset():
        rollout = Collector(group, policy, num_transitions=6, seed=0).collect()
        torch.from_numpy(rollout.observation).zero_()
        assert not rollout.observation.any()
        next_values = torch.zeros(len(rollout.ends))
        assert rollout.advantages(torch.from_numpy(rollout.value), next_values, 0.9, 0.9).any()


def carts_of_a_loop() -> SyncVectorEnv:
    makers = [lambda: gym.make("CartPole-v1")] * 3
    return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_sub_environments_of_a_vector_env_without_resets_wait_for_the_others(
    placement: str,
) -> None:
    """A `SyncVectorEnv` refuses to step those whose episode is over; their rows are left out."""
    entry = {"name": "v", "task": carts_of_a_loop, "placement": placement, "num_workers": 2}
    with sync.build_env_group(entry) as group, group.auto_reset(math.inf):
        collector = Collector(group, None, num_transitions=300, seed=0)
        rollouts = [copy.deepcopy(collector.collect()) for _ in range(3)]
    episodes = [*whole_episodes(rollouts)]
    assert len(episodes) > 12
    for one in episodes:
        assert one.terminated.tolist() == [False] * (len(one.reward) - 1) + [True]
    assert sum(len(rollout) for rollout in rollouts) == 900
