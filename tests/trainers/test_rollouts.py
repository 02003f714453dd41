"""`rlightning_aio.trl.rollouts`: what TRL is given, without TRL."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

import rlightning_aio as rl
from rlightning_aio.attempts import Rules
from rlightning_aio.trl import reward, rollouts

TRAINER = SimpleNamespace(processing_class=SimpleNamespace(eos_token_id=99))


class Guess:
    """The reward is the action; the prompt says who fails: an attempt of an index, or all."""

    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.prompt = options["prompt"]
        return self.prompt, {"seed": seed}

    async def step(self, action: Any) -> Any:
        if action == 0:
            raise OSError("the sandbox is gone")
        return self.prompt, float(action), True, False, {}


async def agent(episode: Any) -> Any:
    """The second attempt at a task acts 0, if its prompt has a question mark."""
    prompt = episode.last.observation
    action = 0 if prompt == "?!" or (episode.index == 1 and "?" in prompt) else episode.index + 1
    await episode.step(action)
    await asyncio.sleep(9 * episode.index * (prompt == "slow"))
    return {
        "prompt_ids": [ord(one) for one in prompt],
        "completion_ids": [action] * 3,
        "logprobs": [-0.5] * 3,
        "env_mask": [1, 0, 1],
        "seed": episode.spec.seed,
    }


def asked(prompts: list[Any], agent: Any = agent, **more: Any) -> dict[str, Any]:
    group = rl.build_env_group(
        Guess, name="guess", num_workers=4, placement="loop", on_env_error="restart"
    )
    with rollouts(group, agent, **more) as rollout_func:
        rollout_func(["a"], TRAINER)
        return rollout_func(prompts, TRAINER)


def test_each_prompt_gets_a_rollout_in_its_place() -> None:
    """Equal ones are attempts at one task, also where a batch was cut inside of a group."""
    found = asked(["b", "b", *"aaaa", "c", "c"])
    assert found["prompt_ids"] == [[ord(one)] for one in "bbaaaacc"]
    assert found["reward"] == [1, 2, 1, 2, 1, 2, 1, 2]
    assert found["completion_ids"] == [[int(one)] * 3 for one in found["reward"]]
    assert found["env_mask"] == [[1, 0, 1]] * 8
    assert found["logprobs"] == [[-0.5] * 3] * 8
    assert [one.kind for one in found["outcome"]] == ["terminated"] * 8
    assert len(set(found["seed"])) == 3
    assert found["seed"] == asked(["b", "b", *"aaaa", "c", "c"])["seed"]
    assert reward(reward=found["reward"], prompts=[]) == found["reward"]


def test_a_rollout_that_fails_is_masked_and_has_no_reward() -> None:
    """One whose agent was cut has a reward, but not the tokens."""
    rules = Rules(attempt_timeout=0.5, on_timeout="end")
    found = asked(["?", "?", "slow", "slow", "a", "a"], rules=rules)
    assert found["reward"] == [1, None, 1, None, 1, 2]
    assert found["completion_ids"][3] == [99]
    assert found["completion_ids"][1] == found["prompt_ids"][1] == [99]
    assert (found["env_mask"][1], found["logprobs"][1], found["seed"][1]) == ([0], [0.0], None)
    assert "the sandbox is gone" in found["outcome"][1].cause


def test_a_batch_in_which_all_fail_is_an_error() -> None:
    with pytest.raises(rl.RLightningError, match=r"all rollouts.*env_raised.*the sandbox is gone"):
        asked(["?!"])


def test_envs_may_have_a_task_with_a_name() -> None:
    """The tasks of prompts have none, so they are those of the entry."""

    async def steps(episode: Any) -> Any:
        assert episode.spec.task == "CartPole-v1"
        while not episode.is_over:
            await episode.step(0)
        return {"prompt_ids": [1], "completion_ids": [2]}

    with rollouts(rl.build_env_group("CartPole-v1", num_workers=2), steps) as rollout_func:
        found = rollout_func(["a", "a", "b", "b"], TRAINER)
    assert [one.kind for one in found["outcome"]] == ["terminated"] * 4
    assert found["logprobs"] is None
    assert found["env_mask"] == [[1]] * 4


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (None, "returned None; for TRL it returns a dict"),
        ({"prompt_ids": [1], "completion_ids": []}, "not empty"),
        (
            {"prompt_ids": [1], "completion_ids": [1, 2], "logprobs": [0.0]},
            r"different lengths.*'completion_ids': 2, 'logprobs': 1",
        ),
    ],
)
def test_what_is_no_rollout_is_refused(returned: Any, message: str) -> None:
    async def careless(episode: Any) -> Any:
        await episode.step(1)
        return returned

    with pytest.raises(ValueError, match=message):
        asked(["a"], careless)
