"""Results that can't be unpickled here: failures of their own env, named, and of nobody else."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from kit.scripted import Counts

import rlightning_aio
from rlightning_aio import Collector, evaluate, sync
from rlightning_aio.attempts import EpisodeSpec, Rules, play
from rlightning_aio.errors import EnvRaised


class HttpError(Exception):
    """As those of HTTP clients: pickle calls it with its message alone."""

    def __init__(self, message: str, *, response: int) -> None:
        super().__init__(message)
        self.response = response


class Failing(Counts):
    """Reports such an error in a reset, or in the second step, of its first episodes."""

    switches_task = True
    length = 3

    def __init__(self, where: str, last: int) -> None:
        self.where, self.last = where, last

    def told(self) -> dict[str, Any]:
        where = {0: "reset", 2: "step"}.get(self.steps)
        fails = where == self.where and self.resets <= self.last
        return {"error": HttpError("not found", response=404)} if fails else {"text": "fine"}


def entries(where: str, last: int = 1) -> list[dict[str, Any]]:
    return [
        {"name": name, "backend": "callable", "task": partial(Failing, place, last)}
        for name, place in (("good", "nowhere"), ("bad", where))
    ]


def policy(batch: Any) -> Any:
    return batch.respond(action=np.zeros(len(batch), np.int64))


def collect_for_ever(collector: Collector) -> None:
    """The other env alone may fill rollouts before the bad one has answered."""
    while True:
        collector.collect()


WHERE = pytest.mark.parametrize("where", ["reset", "step"])


@WHERE
async def test_in_play_an_attempt_of_its_env_fails(where: str) -> None:
    async def agent(episode: Any) -> None:
        while not episode.is_over:
            await episode.step(0)

    async with rlightning_aio.build_env_group(entries(where, last=99)) as group:
        tasks = [EpisodeSpec("t", seed=k, entry=name) for k in range(2) for name in ("good", "bad")]
        playing = play(group, tasks, agent, rules=Rules(retries=0))
        attempts = [one for done in [a async for a in playing] for one in done]
    outcomes = [(one.outcome.kind, one.outcome.blame) for one in attempts]
    assert outcomes.count(("terminated", "policy")) == outcomes.count(("env_raised", "env")) == 2
    failed = [one.outcome for one in attempts if one.outcome.is_failure]
    assert {one.env_id for one in failed} == {"bad-0"}
    assert "HttpError" in failed[0].cause


@WHERE
def test_in_an_evaluation_an_episode_of_its_env_fails(where: str) -> None:
    with sync.build_env_group(entries(where, last=99)) as group:
        attempts = evaluate(group, policy, episodes=4, retries=0).attempts
    failed = [one.outcome for one in attempts if one.outcome.is_failure]
    assert {(one.kind, one.env_id) for one in failed} == {("env_raised", "bad-0")}
    assert len(failed) == len(attempts) - len(failed) == 4


@WHERE
@pytest.mark.parametrize("wait_all", [False, True])
def test_a_collector_raises_it_once_and_goes_on(where: str, *, wait_all: bool) -> None:
    """With all of its envs, in each block."""
    with sync.build_env_group(entries(where)) as group:
        collector = Collector(group, policy, num_transitions=8, wait_all=wait_all)
        with pytest.raises(EnvRaised, match=r"'bad-0'.*can't be read") as raised:
            collect_for_ever(collector)
        assert raised.value.env_id == "bad-0"
        seen = set[int]()
        while seen != {0, 1}:
            rollout = collector.collect()
            assert rollout.reward.size == 8
            seen.update(rollout.index.ravel().tolist())
            assert not wait_all or rollout.index.tolist() == [[0, 1]] * 4


@WHERE
def test_a_batch_raises_it_where_its_row_is_read(where: str) -> None:
    with sync.build_env_group(entries(where)) as group:
        batch, _ = group.reset()
        for _ in range(2 if where == "step" else 0):
            batch, _ = group.step(policy(batch))
        assert batch.reward.tolist() == [0.0 if where == "reset" else 1.0] * 2
        assert batch.take([0]).info() == [{"text": "fine"}]
        for read in (lambda: batch.infos, lambda: batch["bad-0"], batch.info, batch.values):
            with pytest.raises(EnvRaised, match=r"'bad-0'.*HttpError.*'response'.*str\(error\)"):
                read()
        batch, _ = group.reset()
        assert batch.info() == [{"text": "fine"}] * 2
