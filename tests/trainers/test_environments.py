"""`rlightning_aio.trl` without TRL: what `GRPOTrainer` does to envs, done by hand."""

from __future__ import annotations

import asyncio
import inspect
import os
import time
from pathlib import Path
from typing import Any

import pytest

from rlightning_aio.errors import EnvError, RLightningError
from rlightning_aio.trl import Environments


class Counter:
    """Its tools add, fail in several ways, or read an attribute."""

    def reset(self, row: Any = None, **more: Any) -> Any:
        self.row, self.total = row, 0.0
        if row == "die":
            self.die()
        if isinstance(row, int):
            if row < 0:
                raise ValueError("as asked")
            return f"begins with {row}"
        return None

    def add(self, number: float, *, times: int = 1) -> str:
        """Add."""
        if number == 13:
            raise ValueError("13 brings bad luck")
        self.total += number * times
        return f"{self.total:g}"

    def hang(self) -> None:
        """Take too long."""
        time.sleep(3600)

    def die(self) -> None:
        """End the process."""
        os._exit(3)

    def get_reward(self) -> float:
        if self.total > 100:
            raise OverflowError("too much")
        return self.total


class Meeting:
    """Its reset ends when as many have begun."""

    def reset(self, folder: str, number: int, of: int) -> str:
        """Wait for the others."""
        Path(folder, str(number)).touch()
        while len(list(Path(folder).iterdir())) < of:
            time.sleep(0.001)
        return f"{number} met the others"


class Awaited:
    """Its methods are coroutine functions, or not."""

    async def reset(self, **row: Any) -> str:
        await asyncio.sleep(0)
        return "awaited"

    async def ask(self) -> int:
        """Ask."""
        await asyncio.sleep(0)
        return 7

    def get_reward(self) -> float:
        return 1.0


class Trainer:
    """The part of `GRPOTrainer` that meets envs."""

    def __init__(self, factories: dict[str | None, Any]) -> None:
        self.environment_factories = factories
        self.interrupted = False
        self.pools: dict[Any, list[Any]] = {name: [] for name in factories}

    def _generate_and_score_completions(self, inputs: list[dict[str, Any]]) -> list[Any]:
        used: dict[Any, int] = {}
        texts: list[Any] = []
        for row in inputs:
            name = None if None in self.environment_factories else row["environment"]
            pool, number = self.pools[name], used.get(name, 0)
            used[name] = number + 1
            if number == len(pool):
                pool.append(self.environment_factories[name]())
            rest = dict(row)
            if name is not None:
                del rest["environment"]
            texts.append(pool[number].reset(**rest))
            if self.interrupted:
                raise KeyboardInterrupt
        return texts

    def batch(self, inputs: list[dict[str, Any]]) -> list[Any]:
        """Reset the envs of a batch, as TRL does."""
        return self._generate_and_score_completions(inputs)


def test_tools_rewards_and_attributes() -> None:
    """They are those of the class, and so is its signature; an error of a tool is no failure."""
    with Environments(Counter, num_envs=1) as environments:
        one = environments()
        assert type(one).__name__ == "Counter"
        assert inspect.signature(one.add) == inspect.signature(Counter().add)
        with pytest.raises(RLightningError, match="not reset"):
            one.add(1)
        assert one.reset(row=3, prompt=[{"role": "user"}]) == "begins with 3"
        assert one.add(2, times=3) == "6"
        with pytest.raises(EnvError, match="13 brings bad luck"):
            one.add(13)
        assert (one.get_reward(), one.total, one.failure) == (6.0, 6.0, None)
        assert not hasattr(one, "nothing")
        assert one.reset() is None
        assert one.get_reward() == 0.0
        one.add(101)
        assert one.get_reward() is None
        assert (one.failure.kind, one.failure.cause) == ("env_raised", one.failure.cause)


@pytest.mark.parametrize(("tool", "kind"), [("hang", "env_hung"), ("die", "env_died")])
def test_a_failure_has_no_reward(tool: str, kind: str) -> None:
    """And no tools; the next rollout has an env again."""
    with Environments(Counter, num_envs=1, step_timeout=2.0) as environments:
        one = environments()
        one.reset(row=1)
        one.add(5)
        with pytest.raises(EnvError):
            getattr(one, tool)()
        assert one.failure.kind == kind
        assert one.get_reward() is None
        assert one.total is None
        with pytest.raises(EnvError):
            one.add(5)
        assert one.reset(row=2) == "begins with 2"
        assert (one.failure, one.get_reward()) == (None, 0.0)
        assert environments.metrics()[f"envs/outcomes_{kind}"] == 1


def test_a_reset_that_fails_is_a_failure() -> None:
    """After its retries, which go to other envs; the trainer goes on."""
    with Environments(Counter, num_envs=2, retries=1) as environments:
        one = environments()
        assert one.reset(row=-1) is None
        assert one.failure.kind == "not_started"
        assert one.get_reward() is None
        assert environments.metrics()["envs/outcomes_not_started"] == 2
        assert one.reset(row=1) == "begins with 1"


def test_a_reset_that_costs_the_last_idle_env_is_a_failure() -> None:
    """Its retry would wait for an env of this batch, which ends after this reset."""
    with Environments(Counter, num_envs=2, max_restarts=0, on_worker_death="raise") as environments:
        other, one = environments(), environments()
        other.reset(row=1)
        assert one.reset(row="die") is None
        assert one.failure.kind in ("env_died", "not_started")
        assert other.add(1) == "1"


def test_a_batch_is_reset_at_the_same_time(tmp_path: Path) -> None:
    """Each reset waits for all others."""
    with Environments(Meeting, num_envs=4) as environments:
        trainer = Trainer({None: environments})
        environments.join(trainer)
        for batch in range(2):
            folder = tmp_path / str(batch)
            folder.mkdir()
            rows = [{"folder": str(folder), "number": number, "of": 4} for number in range(4)]
            assert trainer.batch(rows) == [f"{number} met the others" for number in range(4)]


def test_too_few_envs_are_an_error() -> None:
    """It says what to raise."""
    with Environments(Counter, num_envs=1) as environments:
        environments().reset(row=1)
        with pytest.raises(RLightningError, match="raise num_envs"):
            environments().reset(row=1)


def test_factories_by_name_and_coroutine_functions() -> None:
    """Each gets its rows."""
    with Environments(Counter, num_envs=2) as counters, Environments(Awaited, 2) as awaited:
        trainer = Trainer({"counter": counters, "awaited": awaited})
        counters.join(trainer)
        awaited.join(trainer)
        names = ["awaited", "counter", "awaited", "counter"]
        rows = [{"environment": name, "row": row} for row, name in enumerate(names)]
        assert trainer.batch(rows) == ["awaited", "begins with 1", "awaited", "begins with 3"]
        one = trainer.pools["awaited"][0]
        assert (one.ask(), one.get_reward()) == (7, 1.0)


def test_after_an_interrupted_batch_all_envs_are_there() -> None:
    """TRL stopped in the middle of its resets."""
    with Environments(Counter, num_envs=2) as environments:
        trainer = Trainer({None: environments})
        environments.join(trainer)
        trainer.interrupted = True
        with pytest.raises(KeyboardInterrupt):
            trainer.batch([{"row": 1}, {"row": 2}])
        trainer.interrupted = False
        assert trainer.batch([{"row": 1}, {"row": 2}]) == ["begins with 1", "begins with 2"]
