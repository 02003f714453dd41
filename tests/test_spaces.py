"""`spaces.Anything`: columns of plain Python values, wherever columns go."""

from __future__ import annotations

import pickle
from typing import Any
from unittest import mock

import numpy as np
import pytest
from gymnasium import spaces

import rlightning_aio as rl
from rlightning_aio.spaces import Anything


class Talk:
    """Answers each message with a dict; another part of the observation counts. Ends after four."""

    observation_space = spaces.Dict(
        messages=Anything(), count=spaces.Box(0, 9, (1,), np.float32), tokens=Anything()
    )
    action_space = Anything()

    def _observation(self) -> Any:
        tokens = list(range(self.count))
        count = np.full(1, self.count, np.float32)
        return {"messages": list(self.messages), "count": count, "tokens": tokens}

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.count, self.messages = 0, [{"role": "system", "content": f"seed {seed}"}]
        return self._observation(), {"task": {"seed": seed}}

    async def step(self, action: Any) -> Any:
        self.count += 1
        self.messages.append({"role": "assistant", **action})
        return self._observation(), 1.0, self.count >= 4, False, {"said": action["content"]}


def entry(placement: str = "loop") -> rl.EnvConfig:
    fields = {} if placement == "loop" else {"envs_per_process": 3}
    return rl.EnvConfig(name="t", task=Talk, num_workers=3, placement=placement, **fields)


def say(batch: Any) -> list[Any]:
    return [
        {"content": f"{len(m)} to {i}"}
        for i, m in zip(batch.ids(), batch.observation["messages"], strict=True)
    ]


@pytest.mark.parametrize("placement", ["loop", "process"])
async def test_columns_are_lists_next_to_arrays(placement: str) -> None:
    async with rl.build_env_group(entry(placement)) as group:
        batch, _ = await group.reset(seed=4)
        assert batch.observation["count"].tolist() == [[0], [0], [0]]
        assert [m[0]["content"] for m in batch.observation["messages"]] == [
            "seed 4",
            "seed 5",
            "seed 6",
        ]
        actions = say(batch)
        group.step_async(batch.respond(action=actions, tokens=[[1], [2, 3], []]))
        batch, _ = await group.collect_async(wait_all=True)
        assert batch.sent.action == actions
        assert batch.sent.tokens == [[1], [2, 3], []]
        assert batch.observation["tokens"] == [[0], [0], [0]]
        assert batch.observation["messages"][1][1] == {"role": "assistant", **actions[1]}
        assert batch.info("said") == [action["content"] for action in actions]
        assert batch.take([2, 0]).observation["messages"][0][0]["content"] == "seed 6"


async def test_a_single_response_makes_a_list_of_one_action() -> None:
    async with rl.build_env_group(entry()) as group:
        await group.reset()
        ret = await group["t-1"].step({"content": "hello", "tool": "search"})
        assert ret.observation["messages"][-1]["tool"] == "search"
        group.step_async(rl.BatchedData(["t-1"], [rl.PolicyResponse("t-1", {"content": "x"})]))
        batch, _ = await group.collect_async()
        assert batch.sent.action == [{"content": "x"}]


async def test_nothing_is_pickled_on_the_loop() -> None:
    async with rl.build_env_group(entry()) as group:
        with (
            mock.patch.object(pickle, "dumps", side_effect=AssertionError),
            mock.patch.object(pickle, "loads", side_effect=AssertionError),
        ):
            batch, _ = await group.reset(seed=1)
            for _ in range(3):
                batch, _ = await group.step(batch.respond(action=say(batch)))
                assert len(batch.observation["messages"]) == len(batch.info("said")) == 3


class Echo:
    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return f"seed {seed}", {}

    async def step(self, action: Any) -> Any:
        return f"not {action}", 1.0, False, False, {}


@pytest.mark.parametrize("placement", ["loop", "process"])
async def test_an_awaitable_env_needs_no_spaces(placement: str) -> None:
    """They are `Anything`."""
    async with rl.build_env_group(Echo, num_workers=2, placement=placement) as group:
        assert group.get_observation_spaces() == group.get_action_spaces() == [Anything()] * 2
        batch, _ = await group.reset(seed=3)
        assert batch.observation == ["seed 3", "seed 4"]
        batch, _ = await group.step(batch.respond(action=["this", "that"]))
        assert batch.items() == [("Echo-0", batch["Echo-0"]), ("Echo-1", batch["Echo-1"])]
        assert batch.observation == ["not this", "not that"]


def test_it_is_a_space() -> None:
    space = Anything()
    assert {"any": [object()]} in space
    assert space == pickle.loads(pickle.dumps(space))
    assert repr(spaces.Tuple([space])) == "Tuple(Anything())"
    with pytest.raises(NotImplementedError, match="give a policy"):
        space.sample()
