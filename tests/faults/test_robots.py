"""After a worker's death, only an explicit reset moves real hardware."""

from __future__ import annotations

import asyncio
import contextlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from kit.processes import kill

import rlightning_aio as rl
from rlightning_aio import ENVS, BaseEnv, EnvConfig, EnvRet, PolicyResponse, sync
from rlightning_aio._core.group.api.facade import lost_hardware
from rlightning_aio.attempts import Attempt, EpisodeSpec
from rlightning_aio.errors import BadAction, EnvRaised, EpisodeLost, RLightningError, WorkerDied

if TYPE_CHECKING:
    from collections.abc import Iterator

REFUSE, DIE = 6, 7


class Robot(BaseEnv):
    """Counts its movements, and dies of one action."""

    def __init__(self, config: EnvConfig, worker_index: int = 0, preprocess_fn: Any = None) -> None:
        super().__init__(config, worker_index, preprocess_fn)
        self.num_moves = 0
        self.env = self

    def get_observation_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(0, np.inf, (1,), np.float32)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Discrete(DIE + 1)

    def _moved(self) -> EnvRet:
        self.num_moves += 1
        if log := self.config.env_kwargs.get("log"):
            with Path(log).open("a") as file:
                file.write(f"{self.env_id} {os.getpid()}\n")
        return EnvRet(env_id=self.env_id, observation=np.array([self.num_moves], np.float32))

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        return self._moved()

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        if policy_resp.action == DIE:
            os._exit(3)
        if policy_resp.action == REFUSE:
            raise BadAction("beyond its limits")
        return self._moved()


@pytest.fixture
def robots() -> Iterator[dict[str, Any]]:
    """Return the fields of an entry of two robots."""
    ENVS.register("robot", hardware=True)(Robot)
    yield {"name": "robot", "backend": "robot", "task": "any", "num_workers": 2}
    del ENVS._classes["robot"]


def test_a_robots_worker_is_not_replaced_by_default(robots: dict[str, Any]) -> None:
    """The registration of the backend says that it is hardware, or the row of a built-in one."""
    piper = EnvConfig(name="arm", backend="piper", task="any")
    assert (piper.on_worker_death, EnvConfig(**robots).on_worker_death) == ("raise", "raise")
    assert EnvConfig(name="e", backend="mujoco", task="any").on_worker_death == "restart"
    assert EnvConfig(**robots, on_worker_death="restart").on_worker_death == "restart"
    ENVS.register("robot")(Robot)
    assert EnvConfig(**robots).on_worker_death == "restart"


def test_a_robot_whose_worker_was_replaced_waits_for_a_reset(robots: dict[str, Any]) -> None:
    """A step raises the death's error, and nothing moves before a requested reset."""
    with sync.build_env_group({**robots, "on_worker_death": "restart"}) as group:
        batch, _ = group.reset()
        with pytest.raises(WorkerDied, match="it moves nothing until you reset it") as caught:
            group.step(batch.respond(action=np.array([0, DIE])))
        assert caught.value.env_ids == ("robot-1",)
        assert caught.value.results.observation.tolist() == [[2.0]]
        assert group["robot-1"].get_attr("num_moves") == 0
        for _ in range(2):
            with pytest.raises(EpisodeLost, match=r"exited with code 3.*reset it to go on"):
                group.step(batch.respond(action=np.array([0, 0])))
        batch, _ = group.reset(env_ids=["robot-1"])
        assert batch.observation.tolist() == [[1.0]]
        assert batch.restarted.all()
        group["robot-1"].step(PolicyResponse("robot-1", 0))


def test_an_action_that_an_env_refuses_is_a_bad_action(robots: dict[str, Any]) -> None:
    """Like one that the group refuses, except that the other envs have stepped."""
    with sync.build_env_group({**robots, "placement": "inline"}) as group:
        batch, _ = group.reset()
        with pytest.raises(BadAction, match="BadAction: beyond its limits") as caught:
            group.step(batch.respond(action=np.array([0, REFUSE])))
        fault = caught.value
        assert isinstance(fault, EnvRaised)
        assert (fault.env_id, fault.results.ids()) == ("robot-1", ["robot-0"])


def end_idle(group: sync.EnvGroup, env_id: str) -> int:
    """Kill an env's worker while it owes nothing; return its pid, once the group knows of it."""
    (worker,) = (one for one in group.get_workers() if env_id in one["env_ids"])
    kill(worker["pid"])
    while any(env_id in one["env_ids"] and one["state"] == "up" for one in group.get_workers()):
        group._core.tables.driver.read()  # No call waits, which would do this.
        group._core.apply_completions()
    return worker["pid"]


def still(batch: Any) -> Any:
    return batch.respond(action=np.zeros(len(batch), int))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "moves"


def pids_that_moved(log: Path, env_id: str) -> set[int]:
    lines = map(str.split, log.read_text().splitlines())
    return {int(pid) for name, pid in lines if name == env_id}


@pytest.fixture(params=["raise", "restart"])
def entry(request: pytest.FixtureRequest, robots: dict[str, Any], log: Path) -> dict[str, Any]:
    fields = {"max_episode_steps": 2, "on_worker_death": request.param}
    return {**robots, **fields, "env_kwargs": {"log": str(log)}}


@pytest.mark.parametrize("wait_all", [False, True])
def test_a_collector_resets_no_robot_that_was_lost_between_its_calls(
    entry: dict[str, Any], log: Path, wait_all: bool
) -> None:
    """It goes on with it once its user has reset it."""
    with sync.build_env_group(entry) as group:
        collector = rl.Collector(group, still, num_transitions=4, wait_all=wait_all)
        collector.collect()
        while "robot-1" in group.pending:
            collector.collect()
        pid = end_idle(group, "robot-1")
        errors = 0
        for _ in range(4):
            try:
                collector.collect()
            except RLightningError:
                errors += 1
        assert errors
        assert pids_that_moved(log, "robot-1") == {pid}
        with contextlib.suppress(WorkerDied):  # If it was not raised before.
            group.reset_async(env_ids=["robot-1"])
        if "robot-1" not in group.pending:
            group.reset_async(env_ids=["robot-1"])
        while len(pids_that_moved(log, "robot-1")) == 1:  # Its worker starts beside the others.
            collector.collect()


def test_a_new_collector_resets_no_robot_that_was_lost_before(
    entry: dict[str, Any], log: Path
) -> None:
    with sync.build_env_group(entry) as group:
        group.reset()
        pid = end_idle(group, "robot-1")
        collector = rl.Collector(group, still, num_transitions=4)
        with pytest.raises(RLightningError, match="reset only if you ask for it: restart"):
            collector.collect()
        assert pids_that_moved(log, "robot-1") == {pid}
        collector.restart()
        collector.collect()
    assert len(pids_that_moved(log, "robot-1")) == 2


def test_an_evaluation_gives_no_episode_to_a_robot_that_was_lost_while_it_was_idle(
    entry: dict[str, Any], log: Path
) -> None:
    ended: list[int] = []
    with sync.build_env_group(entry) as group:

        def end_its_worker(attempt: Attempt) -> None:
            if attempt.env_id == "robot-1" and not ended:
                ended.append(end_idle(group, "robot-1"))

        queue = [EpisodeSpec("any", seed) for seed in range(6)]
        found = rl.evaluate(group, still, queue, on_episode=end_its_worker)
    assert len(found.attempts) == 6
    assert {*ended} == pids_that_moved(log, "robot-1")


def test_an_abort_keeps_why_an_env_was_lost(entry: dict[str, Any]) -> None:
    """So that it stays one that only its user resets."""
    with sync.build_env_group(entry) as group:
        group.reset()
        end_idle(group, "robot-1")
        for _ in range(2):
            with contextlib.suppress(WorkerDied):
                group.reset_async(env_ids=["robot-1"])
                group.abort(["robot-1"])
        assert lost_hardware(group) == ["robot-1"]
        batch, _ = group.reset()
        assert [one.kind for one in batch.outcome if one is not None] == ["env_died"]
        assert lost_hardware(group) == []


def test_a_reset_of_all_drops_a_death_that_nobody_has_read(robots: dict[str, Any]) -> None:
    with sync.build_env_group(robots) as group:
        group.reset()
        kill(group.get_workers()[1]["pid"])
        while not group._core.tables.completions:
            group._core.tables.driver.read()
        batch, _ = group.reset()
        assert batch.restarted.tolist() == [False, True]


async def test_agents_of_several_dead_workers_each_get_their_error(robots: dict[str, Any]) -> None:
    """Though their steps are sent as one batch, which raises the first alone."""
    async with rl.build_env_group(robots) as group:

        async def play(env_id: str) -> None:
            async with group.episode(env_id) as episode:
                await both.wait()
                await both.wait()
                await episode.step(0)

        both = asyncio.Barrier(3)
        playing = [asyncio.create_task(play(env_id)) for env_id in group.env_ids]
        await both.wait()
        for worker in group.get_workers():
            kill(worker["pid"])
        while any(worker["state"] == "up" for worker in group.get_workers()):  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        await both.wait()
        for env_id, error in zip(
            group.env_ids, await asyncio.gather(*playing, return_exceptions=True), strict=True
        ):
            assert isinstance(error, WorkerDied)
            assert error.env_ids == (env_id,)


def test_a_reset_of_all_with_a_wrong_seed_drops_nothing(robots: dict[str, Any]) -> None:
    with sync.build_env_group(robots) as group:
        batch, _ = group.reset()
        group.step_async(still(batch))
        with pytest.raises(ValueError, match="3 seeds for 2 envs"):
            group.reset(seed=[1, 2, 3])
        assert len(group.collect_async(wait_all=True)[0]) == 2
