"""Inputs and outputs of envs: actions, extras and values of all kinds."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from group import sample_envs
from gymnasium import spaces
from kit.scripted import Counts
from vector.toys import assert_alike

from rlightning_aio import (
    BadAction,
    BatchedData,
    ConfigError,
    EnvMeta,
    MultiAgentEnvRet,
    PolicyResponse,
    build_env_group,
)
from rlightning_aio._core.group.state.slab_layout import check_actions

# Values are made and read independently of the loop.
pytestmark = pytest.mark.one_driver_for_each_place

PROBE = {"name": "probe", "backend": "probe", "task": "x", "num_workers": 2}
CARTPOLE = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_workers": 2}


def gym_entry(task: str, **fields: Any) -> dict[str, Any]:
    return {
        "name": "e",
        "backend": "gymnasium",
        "task": task,
        "num_workers": 2,
        "imports": ["group.sample_envs"],
        **fields,
    }


# -- preprocess functions


def scaled(factor: float, response: PolicyResponse) -> Any:
    return np.array([0.0, response.action * factor])


class Adder:
    """A callable without a hash."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, number: float) -> None:
        self.number = number

    def __call__(self, response: PolicyResponse) -> Any:
        return [0.0, response.action + self.number]


async def test_one_function_serves_every_env(start: Any) -> None:
    """A lambda with a captured variable; its action may have any shape."""
    offset = 100.0
    two = {**PROBE, "name": "two", "num_workers": 1}
    group = await start([PROBE, two], preprocess_fn=lambda r: [0, r.action.sum() + offset])
    batch, _ = await group.reset()
    batch, _ = await group.step(batch.respond(action=np.ones((3, 4, 5))))
    assert batch.reward.tolist() == [120.0] * 3


async def test_functions_are_given_by_entry_or_by_env(start: Any) -> None:
    """An entry's function serves all of its envs; None is the default."""
    two = {**PROBE, "name": "two", "num_workers": 1}
    group = await start([PROBE, two], preprocess_fn=[partial(scaled, 2.0), Adder(0.5)])
    batch, _ = await group.reset()
    batch, _ = await group.step(batch.respond(action=np.array([1.0, 2.0, 3.0])))
    assert batch.reward.tolist() == [2.0, 4.0, 3.5]
    group = await start([PROBE, two], preprocess_fn=[partial(scaled, 3.0), None, Adder(7)])
    batch, _ = await group.reset()
    actions = [1.0, [0, 50.0], 3.0]
    batch, _ = await group.step(batch.respond(action=actions))
    assert batch.reward.tolist() == [3.0, 50.0, 10.0]


async def test_a_function_serves_built_in_backends(start: Any) -> None:
    """It converts the policy's output, here logits, into the simulator's action."""
    group = await start(CARTPOLE, preprocess_fn=lambda response: int(np.argmax(response.logits)))
    plain = await start(CARTPOLE)
    batch, _ = await group.reset(seed=3)
    await plain.reset(seed=3)
    for left in (0, 1, 1):
        logits = np.eye(2)[[left, 1 - left]]
        batch, _ = await group.step(batch.respond(action=[None, None], logits=logits))
        expected, _ = await plain.step(
            BatchedData(
                plain.env_ids, [PolicyResponse(f"pole-{k}", [left, 1 - left][k]) for k in (0, 1)]
            )
        )
        assert (batch.observation == expected.observation).all()


def test_a_function_that_cannot_be_pickled_is_named_before_anything_starts() -> None:
    """With what it captures, or with the expected number of functions."""
    lock = threading.Lock()

    def locked(response: PolicyResponse) -> Any:
        with lock:
            return response.action

    with pytest.raises(ConfigError, match=r"'probe'.*locked.*captures 'lock'"):
        build_env_group(PROBE, preprocess_fn=locked)
    with pytest.raises(ConfigError, match="3 preprocess functions for 1 entries with 2 envs"):
        build_env_group(PROBE, preprocess_fn=[locked] * 3)
    with pytest.raises(ConfigError, match="must be callable, not int"):
        build_env_group(PROBE, preprocess_fn=[1])
    inline = {**PROBE, "placement": "inline"}
    assert build_env_group(inline, preprocess_fn=locked).size() == 2


# -- extras


@dataclass
class Thought:
    """A class that only the policy knows."""

    depth: int


async def test_extras_reach_the_function_and_the_step(start: Any) -> None:
    """From columns and from single responses, with actions that fit their rows."""
    group = await start(PROBE, preprocess_fn=lambda r: [0, r.action[1] * r.weight])
    batch, _ = await group.reset()
    columns = batch.respond(action=np.array([[0, 2.0], [0, 3.0]]), weight=np.array([10.0, 20.0]))
    batch, _ = await group.step(columns)
    assert batch.reward.tolist() == [20.0, 60.0]
    assert batch.info() == [{"extras": {"weight": 10.0}}, {"extras": {"weight": 20.0}}]
    one = PolicyResponse("probe-1", np.array([0, 4.0]), weight=2.0, thought=Thought(3))
    group.step_async(BatchedData(["probe-1"], [one]))
    batch, _ = await group.collect_async()
    assert batch.reward.tolist() == [8.0]
    assert batch.info()[0]["extras"]["thought"].depth == 3


async def test_extras_that_no_env_reads_are_not_sent(start: Any) -> None:
    """A built-in backend with the default function: extras stay in the trainer."""
    group = await start(CARTPOLE)
    batch, _ = await group.reset(seed=0)
    unpicklable = [threading.Lock(), threading.Lock()]
    batch, _ = await group.step(batch.respond(action=np.array([0, 1]), lock=unpicklable))
    ids = batch.ids()
    responses = [
        PolicyResponse(id_, 1, lock=lock) for id_, lock in zip(ids, unpicklable, strict=True)
    ]
    batch, _ = await group.step(BatchedData(ids, responses))
    assert batch.ids() == ids


# -- actions


async def test_actions_of_every_space_that_fits_in_rows(start: Any) -> None:
    """Box, Discrete, MultiBinary and MultiDiscrete in Dict and Tuple, as columns and as lists; the
    env checks each.
    """
    from gymnasium.vector.utils import batch_space

    group = await start(gym_entry("Tree-v0"))
    batch, _ = await group.reset(seed=0)
    drawn = batch_space(sample_envs.MOVES, 2)
    for _ in range(3):
        batch, _ = await group.step(batch.respond(action=drawn.sample()))
        one_by_one = [sample_envs.MOVES.sample() for _ in range(2)]
        batch, _ = await group.step(batch.respond(action=one_by_one))
    ids = batch.ids()
    single = [PolicyResponse(id_, sample_envs.MOVES.sample()) for id_ in ids]
    batch, _ = await group.step(BatchedData(ids, single))
    partly = sample_envs.MOVES.sample()
    del partly["jump"]
    with pytest.raises(BadAction, match=r"no part \['jump'\]"):
        await group["e-0"].step(partly)
    wrong = sample_envs.MOVES.sample()
    wrong["hands"] = (wrong["hands"][0], np.zeros(3, int))
    with pytest.raises(BadAction, match=r"\['hands'\]\[1\].*\(2,\).*\(3,\)"):
        await group["e-0"].step(wrong)


class Echo(Counts):
    """Reports each action."""

    action_space = spaces.Text(99)
    heard = ""

    def does(self, action: Any) -> None:
        self.heard = action

    def told(self) -> dict[str, Any]:
        return {"heard": self.heard}


@pytest.mark.parametrize("text", ["the action is in the row", "ACTION_IN_ROW", "None", ""])
async def test_any_text_is_an_action(start: Any, text: str) -> None:
    """None has a meaning of its own on the way to the env."""
    group = await start({"name": "e", "backend": "callable", "task": Echo, "num_workers": 2})
    batch, _ = await group.reset()
    batch, _ = await group.step(batch.respond(action=[text, "other"]))
    assert batch.info("heard") == [text, "other"]


async def test_an_env_that_transforms_actions_takes_any(start: Any) -> None:
    """Chunks of any length, dicts, and actions that would fit in its row."""
    chunked = {**PROBE, "name": "chunked", "backend": "chunked"}
    group = await start(chunked)
    batch, _ = await group.reset()
    batch, _ = await group.step(batch.respond(action=[[1.0] * 9, {"chunk": np.ones((2, 2))}]))
    assert batch.reward.tolist() == [9.0, 4.0]
    assert [info["type"] for info in batch.info()] == ["list", "dict"]
    batch, _ = await group.step(batch.respond(action=np.full((2, 2), 3.0)))
    assert batch.reward.tolist() == [6.0, 6.0]
    group.step_async(batch.respond(action=np.ones((2, 7, 3))))
    batch, _ = await group.collect_async(wait_all=True)
    assert batch.reward.tolist() == [21.0, 21.0]


# -- observations


# -- several sub-environments, several agents, several kinds of env


async def test_agents_have_their_own_columns(start: Any) -> None:
    """With different spaces; an episode ends when it has ended for all of them."""
    group = await start({**PROBE, "name": "c", "backend": "crowd", "max_episode_steps": 9})
    metas = await group.init()
    assert metas[0].agents == ("tall", "small")
    batch, _ = await group.reset()
    assert batch.observation["tall"].shape == (2, 3)
    actions = {"tall": np.array([[0.5], [0.25]], np.float32), "small": np.array([1, 0])}
    with group.auto_reset():
        for step in (1, 2, 3):
            batch, _ = await group.step(batch.respond(action=actions))
            assert batch.observation["small"].tolist() == [step, step]
            assert batch.terminated["tall"].tolist() == [step >= 2] * 2
        assert {agent: r.tolist() for agent, r in batch.reward.items()} == {
            "tall": [0.5, 0.25],
            "small": [1.0, 0.0],
        }
        value = batch["c-1"]
        assert isinstance(value, MultiAgentEnvRet)
        assert value.last_reward == {"tall": 0.25, "small": 0.0}
        assert value.last_terminated == {"tall": True, "small": True}
        batch, _ = await group.step(batch.respond(action=actions))
        assert batch.observation["small"].tolist() == [0, 0]


UNFIXED = ["words", "lines", "titled count", "titled value", "value of two titles", "further keys"]


@pytest.mark.parametrize("task", UNFIXED)
async def test_each_entry_is_read_by_its_own_space(start: Any, task: str) -> None:
    """Also if no space has a fixed size: each column holds what the values of its envs hold."""
    tasks = [task, *(other for other in UNFIXED if other != task)]
    entries = [{**PROBE, "name": t, "backend": "fresh", "task": t, "num_workers": 1} for t in tasks]
    group = await start(entries)
    batch, _ = await group.reset()
    for _ in range(3):
        for part in batch.by_entry().values():
            assert_alike(first_row(part.observation), part.values()[0].observation)
        batch, _ = await group.step(batch.respond(action=np.zeros(len(tasks), int)))


def first_row(column: Any) -> Any:
    if isinstance(column, dict):
        return {key: first_row(part) for key, part in column.items()}
    return tuple(map(first_row, column)) if isinstance(column, tuple) else column[0]


def test_custom_spaces_are_compared_by_their_repr() -> None:
    """Without the object's address."""

    class Words(spaces.Space[str]):
        pass

    class Sized(Words):
        def __init__(self, size: int) -> None:
            super().__init__()
            self.size = size

        def __repr__(self) -> str:
            return f"Sized({self.size})"

    def check(*actions: spaces.Space[Any]) -> None:
        check_actions(
            [
                EnvMeta(env_id=f"e-{k}", observation_space=None, action_space=space)
                for k, space in enumerate(actions)
            ]
        )

    check(Words(), Words())
    check(Sized(2), Sized(2))
    with pytest.raises(ValueError, match=r"'e-0' and 'e-1'.*Sized\(2\).*Sized\(3\)"):
        check(Sized(2), Sized(3))
    with pytest.raises(ValueError, match="Words"):
        check(Words(), Sized(2))


async def test_different_action_shapes_need_an_option(place: Any, start: Any) -> None:
    """The error names both envs; the axis of sub-environments is ignored; nothing stays running."""
    wide = {**PROBE, "name": "wide", "env_kwargs": {"action_shape": [3]}}
    with pytest.raises(ValueError, match=r"'probe-0' and 'wide-0'.*\(2,\).*\(3,\).*mixed_actions"):
        await start([PROBE, wide])
    group = await start([PROBE, wide], mixed_actions=True)
    batch, _ = await group.reset()
    ids = ["wide-1", "probe-0"]
    batch, _ = await group.step(
        BatchedData(ids, [PolicyResponse("wide-1", [0, 1, 2]), PolicyResponse("probe-0", [0, 3])])
    )
    assert (batch.ids(), batch.reward.tolist()) == (ids, [1, 3])
    two, three = (
        {**PROBE, "name": f"b{n}", "backend": "batched", "num_envs": n, "num_workers": 1}
        for n in (2, 3)
    )
    group = await start([two, three])
    assert [space.shape for space in group.get_action_spaces()] == [(2,), (3,)]


def test_spaces_of_workers_equal_those_of_the_simulator() -> None:
    """After the pickling between processes."""
    from rlightning_aio import sync

    with sync.build_env_group(gym_entry("Words-v0", num_workers=1)) as group:
        assert group.get_observation_spaces() == [sample_envs.WORDS]
        assert group.get_action_spaces() == [spaces.Discrete(3)]
