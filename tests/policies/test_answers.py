"""What a policy may return: the same in a `Collector`, in `evaluate` and on the command line."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts

import rlightning_aio as rl
from rlightning_aio import BatchedData, sync
from rlightning_aio.cli.policies import Responder
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import BadAction
from rlightning_aio.evaluation import EpisodeSpec, evaluate

if TYPE_CHECKING:
    from collections.abc import Callable


class Echo(Counts):
    """Its reward is what the action says; an episode has three steps."""

    length = 3

    def __init__(self, space: gym.Space[Any], read: Callable[[Any], float]) -> None:
        self.action_space, self.does = space, read


class Plain(Echo):
    """Acts with a number."""

    def __init__(self) -> None:
        super().__init__(gym.spaces.Discrete(5), float)


class Limbs(Echo):
    """Acts with a dict."""

    def __init__(self) -> None:
        parts = {"arm": gym.spaces.Discrete(5), "leg": gym.spaces.Discrete(5)}
        super().__init__(gym.spaces.Dict(parts), lambda action: float(action["leg"]))


class Clash(Echo):
    """Acts with a dict that has a key ``action``."""

    def __init__(self) -> None:
        parts = {"action": gym.spaces.Discrete(5), "leg": gym.spaces.Discrete(5)}
        super().__init__(gym.spaces.Dict(parts), lambda action: float(action["leg"]))


def four(batch: BatchedData) -> Any:
    return np.full(len(batch), 4)


def limbs(batch: BatchedData, name: str = "arm") -> Any:
    return {name: np.zeros(len(batch), int), "leg": four(batch)}


SINGLE: list[Callable[[BatchedData], Any]] = [
    four,
    lambda batch: four(batch).tolist(),
    lambda batch: {"action": four(batch)},
    lambda batch: {"action": four(batch), "value": np.zeros(len(batch))},
    lambda batch: batch.respond(four(batch), value=np.zeros(len(batch))),
]
DICTS: list[Callable[[BatchedData], Any]] = [
    limbs,
    lambda batch: {"action": limbs(batch), "value": np.zeros(len(batch))},
    lambda batch: batch.respond(limbs(batch)),
]
FORMS = [(Plain, policy) for policy in SINGLE] + [(Limbs, policy) for policy in DICTS]
FORMS.append((Clash, lambda batch: batch.respond(limbs(batch, "action"))))


def entry(make_env: Any, count: int = 4) -> dict[str, Any]:
    return {"name": "env", "task": make_env, "num_workers": count, "placement": "inline"}


def played(group: Any, policy: Any) -> list[Any]:
    """The calls of everything that takes a policy, for a group of either kind."""
    specs = [EpisodeSpec("", seed) for seed in range(5)]
    return [
        lambda: Collector(group, policy, num_transitions=12, wait_all=True).collect(),
        lambda: evaluate(group, policy, 2, min_results=4),
        lambda: evaluate(group, policy, specs, min_results=4),
    ]


def check(found: list[Any]) -> None:
    rollout, by_env, queue = found
    assert (rollout.reward == 4).all()
    for evaluation, count in ((by_env, 8), (queue, 5)):
        assert evaluation.total_reward.count == count
        assert evaluation.total_reward.mean == 12


@pytest.mark.parametrize(("make_env", "policy"), FORMS)
def test_one_policy_serves_all(make_env: Any, policy: Callable[[BatchedData], Any]) -> None:
    """In each form, plain or awaitable."""
    found: list[Any] = []
    for number in range(3):
        with sync.build_env_group(entry(make_env)) as group:
            found.append(played(group, policy)[number]())
    check(found)

    async def awaitable(batch: BatchedData) -> Any:
        await asyncio.sleep(0)
        return policy(batch)

    async def main() -> None:
        found: list[Any] = []
        for number in range(3):
            async with rl.build_env_group(entry(make_env)) as group:
                found.append(await played(group, awaitable)[number]())
        check(found)
        async with rl.build_env_group(entry(make_env)) as group:
            batch, _ = await group.reset()
            (response,) = await Responder(group, awaitable, None)(batch)
            batch, _ = await group.step(response)
            assert (batch.reward == 4).all()

    asyncio.run(main())


def test_none_is_random_actions() -> None:
    """By the seed, in each of them; a mapping may have it, too."""
    runs: list[list[Any]] = []
    for _ in range(2):
        with sync.build_env_group(entry(Plain)) as group:
            rewards = [evaluate(group, None, 2, seed=3).total_reward]
            queue: Any = evaluate(group, None, [EpisodeSpec("", 0)])
            assert queue.total_reward.count == 1
            actions = Collector(group, None, num_transitions=12, wait_all=True, seed=3).collect()
            assert {0, 4} <= {*actions.action.ravel().tolist()} <= {*range(5)}
            runs.append([*rewards, actions.action.tolist()])
    assert runs[0] == runs[1]
    with sync.build_env_group(entry(Plain)) as group:
        rollouts = Collector(group, {"env": None}, num_transitions=8).collect()
        assert rollouts["env"].action.shape == (8,)


def test_an_action_space_with_a_key_action_needs_respond() -> None:
    """The error says so."""
    for number in range(3):
        refused = pytest.raises(BadAction, match=r"has a key 'action'.* return batch\.respond\(")
        with sync.build_env_group(entry(Clash)) as group, refused:
            played(group, lambda batch: limbs(batch, "action"))[number]()


@pytest.mark.parametrize(
    ("answer", "named"),
    [
        (lambda batch: {"actions": four(batch)}, "columns with 'action'.* not a dict of 'actions'"),
        (lambda _: {}, "not a dict of nothing"),
        (lambda _: None, "column 'action' is None for a batch of 4"),
        (lambda _: np.zeros(3, int), "column 'action' has 3 rows for a batch of 4"),
        (lambda batch: batch.take([0, 1]).respond(four(batch)[:2]), "answered 2 of 4"),
    ],
)
def test_other_answers_are_refused(answer: Callable[[BatchedData], Any], named: str) -> None:
    """In words about the policy, before anything is sent."""
    for number in range(3):
        with sync.build_env_group(entry(Plain)) as group:
            with pytest.raises(BadAction, match=named):
                played(group, answer)[number]()
            assert group.pending == []


def test_a_collectors_policy_answers_in_the_order_of_its_batch() -> None:
    """Otherwise the columns would be those of other envs."""
    with sync.build_env_group(entry(Plain)) as group:
        collector = Collector(
            group, lambda batch: batch.take([3, 2, 1, 0]).respond(four(batch)), num_transitions=4
        )
        with pytest.raises(BadAction, match="in their order"):
            collector.collect()


def test_half_of_the_envs_are_waited_for() -> None:
    """In each of them, unless a number is given: a network's call for each env would be slow."""
    sizes: list[int] = []

    def policy(batch: BatchedData) -> Any:
        sizes.append(len(batch))
        return four(batch)

    with sync.build_env_group(entry(Plain, 6)) as group:
        evaluate(group, policy, 1)
        evaluate(group, policy, [EpisodeSpec("", seed) for seed in range(6)])
        Collector(group, policy, num_transitions=24).collect()
        assert {*sizes} == {6, 3}
        del sizes[:]
        Collector(group, policy, num_transitions=24, min_results=2).collect()
    assert {*sizes} == {6, 2}
