"""Clients that are bound to a task live in awaitable envs, from one reset to the next."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import pytest
from hosts.beside_others import steps
from hosts.spanning import ADD, CRASH, HANG, OWN, RAISE

import rlightning_aio as rl
from rlightning_aio.errors import EnvRaised, EpisodeLost, WorkerDied

if TYPE_CHECKING:
    from pathlib import Path

SOON = 1.0


@pytest.fixture(params=["loop", "process"])
def config(request: pytest.FixtureRequest, tmp_path: Path) -> dict[str, Any]:
    fields = {"num_workers": 2, "env_kwargs": {"file": str(tmp_path / "left")}}
    if request.param == "process":
        fields["envs_per_process"] = 2
    return {"name": "e", "placement": request.param, **OWN, **fields}


def num_left(config: dict[str, Any]) -> int:
    """How often a client was left properly."""
    with open(config["env_kwargs"]["file"]) as file:  # noqa: PTH123
        return len(file.readlines())


@pytest.fixture(autouse=True)
def no_warning() -> Any:
    """No env may fail to close."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


async def test_a_scope_is_left_by_the_task_that_entered_it(config: dict[str, Any]) -> None:
    async with rl.build_env_group(config) as group:
        for _ in range(3):
            batch, _ = await group.reset(seed=5)
            for count in (1, 2):
                batch, _ = await group.step(steps(e_0=ADD, e_1=ADD))
                assert batch.observation.tolist() == [count, count]
    assert num_left(config) == 6


async def test_a_scope_is_left_after_an_error_and_after_a_hang(config: dict[str, Any]) -> None:
    async with rl.build_env_group({**config, "step_timeout": SOON}) as group:
        await group.reset(seed=5)
        with pytest.raises(EnvRaised, match="as it was asked to"):
            await group.step(steps(e_0=RAISE))
        batch, _ = await group.step(steps(e_0=ADD, e_1=HANG))
        assert batch.restarted.tolist() == [False, True]
        batch, _ = await group.step(steps(e_0=ADD, e_1=ADD))
        assert batch.observation.tolist() == [2, 1]
    assert num_left(config) == 3


async def test_an_env_whose_scope_is_cancelled_while_it_is_idle_is_replaced(
    config: dict[str, Any],
) -> None:
    """Its next step is answered by the first result of another, and a reset keeps its seed."""
    async with rl.build_env_group(config) as group:
        await group.reset(seed=5)
        batch, _ = await group.step(steps(e_0=CRASH, e_1=CRASH))
        batch, _ = await group.step(steps(e_0=ADD))
        while not batch.restarted.any():  # It may answer until its background has ended.
            batch, _ = await group.step(steps(e_0=ADD))
        assert batch.restarted.tolist() == batch.is_reset.tolist() == [True]
        assert "ended while it was idle: hosts.spanning.Crash" in batch.info("worker_restarted")[0]
        assert (batch.info("seed"), batch.info("options")) == ([5], [None])
        batch, _ = await group.reset(seed=7, env_ids=["e-1"])
        assert batch.is_reset.tolist() == [True]
        assert batch.info("seed") == [8]
        batch, _ = await group.step(steps(e_0=ADD, e_1=ADD))
        assert batch.observation.tolist() == [1, 1]


async def call_for_ever(episode: Any) -> None:
    """Call a method again and again: the env may answer until its background has ended."""
    while True:
        await episode.call("get_attr", "env_id")


async def test_no_call_is_answered_for_an_episode_by_an_env_that_was_built_since(
    config: dict[str, Any],
) -> None:
    """And the new env is reset before it is stepped."""
    async with rl.build_env_group(config) as group:
        async with group.episode("e-0", seed=5) as episode:
            await episode.step(CRASH)
            with pytest.raises((EpisodeLost, WorkerDied), match="ended while it was idle: hosts"):
                await call_for_ever(episode)
        batch, _ = await group.step(steps(e_0=ADD))
        assert batch.restarted.tolist() == batch.is_reset.tolist() == [True]
        assert "ended while it was idle: hosts.spanning.Crash" in batch.info("worker_restarted")[0]
        assert (batch.info("seed"), batch.info("options")) == ([5], [None])
        assert group.metrics()["envs/restarts"] == 1
