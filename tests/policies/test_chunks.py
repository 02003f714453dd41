"""`ActionChunks`: each env plays its own chunks open loop, and none outlives its episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from policies.counting import QUEUE, Counting, check, chunk_of, evaluated

import rlightning_aio as rl
from rlightning_aio import sync
from rlightning_aio.evaluation import evaluate
from rlightning_aio.policies import ActionChunks


def chunks(batch: rl.BatchedData) -> Any:
    return np.stack([chunk_of(observation) for observation in batch.observation])


class Asked:
    """Notes the seed and step of each env that needs a chunk."""

    def __init__(self) -> None:
        self.seen = list[tuple[float, float]]()

    def __call__(self, batch: rl.BatchedData) -> Any:
        self.seen += map(tuple, batch.observation.tolist())
        return chunks(batch)


@pytest.mark.parametrize("place", ["inline", "process"])
def test_a_policy_is_asked_when_actions_are_used_up_and_at_a_reset(place: str) -> None:
    """An episode of 4 steps leaves two actions of its last chunk, which no other episode plays."""
    asked = Asked()
    check(evaluated(ActionChunks(asked, 3), placement=place))
    steps = [(one.seed, step) for one in QUEUE for step in range(0, one.seed + 4, 3)]
    assert sorted(asked.seen) == steps


def test_whole_chunks_are_played_without_a_number() -> None:
    """Their length may change."""
    check(evaluated(ActionChunks(chunks), env_kwargs={"period": 5}))


def test_no_action_is_left_over_after_a_lost_episode() -> None:
    """Every second episode of an env is lost in its third step, and played again."""
    found = evaluated(ActionChunks(chunks, 3), env_kwargs={"breaks": True})
    check(found)
    assert found.failures["env_raised"] > 0


class Averaged(Counting):
    """The reward is 1 for the average of what was predicted for a step, of the last five chunks."""

    def does(self, action: Any) -> float:
        super().does(action)  # It sets the length, and may raise.
        asked = np.arange(max(self.steps - 4, 0), self.steps + 1)
        weights = np.exp(-0.5 * np.arange(len(asked)))
        expected = [self.seed, *(np.stack([asked, self.steps - asked]) @ weights / weights.sum())]
        return float(np.allclose(action, expected))


@pytest.mark.parametrize("breaks", [False, True])
def test_predictions_for_a_step_are_averaged(breaks: bool) -> None:
    """Of one episode alone, the oldest with the largest weight."""
    policy = ActionChunks(chunks, temporal_ensemble=0.5)
    check(evaluated(policy, task=Averaged, env_kwargs={"breaks": breaks}))


def test_only_floats_are_averaged_and_every_step_asks() -> None:
    with pytest.raises(ValueError, match="no n_action_steps"):
        ActionChunks(chunks, 3, temporal_ensemble=0.0)
    whole = ActionChunks(lambda batch: chunks(batch).astype(int), temporal_ensemble=0.0)
    with pytest.raises(rl.BadAction, match="must be floats"):
        evaluated(whole)


async def test_the_policy_may_be_a_coroutine_function() -> None:
    """It is awaited over an asynchronous group."""

    async def policy(batch: rl.BatchedData) -> Any:
        return chunks(batch)

    entry = {"name": "env", "task": Counting, "placement": "inline", "num_workers": 3}
    async with rl.build_env_group(entry) as group:
        with group.auto_reset(100):
            check(await evaluate(group, ActionChunks(policy, 3), QUEUE))


def test_a_policy_may_reuse_its_memory() -> None:
    """What it returns is copied, because envs play it while others are answered."""
    memory = np.zeros((4, 5, 3))

    def policy(batch: rl.BatchedData) -> Any:
        memory[: len(batch)] = chunks(batch)
        return memory[: len(batch)]

    check(evaluated(ActionChunks(policy, 3), 4))


def test_it_serves_an_evaluation_of_a_number_of_episodes() -> None:
    """Envs that reset themselves begin an episode in the step that ends one."""
    config = {
        "name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "placement": "inline",
    }  # fmt: skip
    calls: list[float] = []

    def policy(batch: rl.BatchedData) -> Any:
        calls.extend(batch.is_reset.tolist())
        return np.tile(np.arange(2), (len(batch), 3))

    with sync.build_env_group(config) as group, group.auto_reset(8):
        found = evaluate(group, ActionChunks(policy), 3, seed=0)
    assert [one.length for one in found.attempts] == [8, 8, 8]
    assert calls == [True, False] * 3


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (np.zeros((2, 3)), r"returned \(2, 3\); .* for 1 envs should be \(1, horizon, \*action\)"),
        (np.zeros(1), r"returned \(1,\)"),
        (np.zeros((1, 0, 3)), "as many as"),
        (np.zeros((1, 2, 3)), "have 2 actions, fewer than n_action_steps=3"),
    ],
)
def test_an_answer_that_is_no_chunk_is_refused(answer: Any, message: str) -> None:
    """The message says what it is, and what it should be."""
    with pytest.raises(rl.BadAction, match=message):
        evaluated(ActionChunks(lambda batch: answer, 3), 1)


def test_sub_environments_and_a_number_below_one_are_refused() -> None:
    """Sub-environments of an env begin their episodes at different times."""
    with pytest.raises(ValueError, match="at least 1"):
        ActionChunks(chunks, 0)
    entry = {"name": "pole", "backend": "gymnasium", "task": "CartPole-v1", "num_envs": 2}
    with (
        sync.build_env_group({**entry, "placement": "inline"}) as group,
        group.auto_reset(100),
        pytest.raises(ValueError, match="pole-0 has sub-environments"),
    ):
        evaluate(group, ActionChunks(chunks), 1)
