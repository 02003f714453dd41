"""Workers are renewed between two episodes, and nobody notices but for their memory."""

from __future__ import annotations

import os
import random
import time
from collections import OrderedDict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from kit.scripted import Counts

import rlightning_aio.sync as rl
from rlightning_aio import ConfigError, EnvConfig
from rlightning_aio._core.group.state.host_record import Stage
from rlightning_aio.errors import WorkerDied
from rlightning_aio.vector import VectorEnv


class Walk(Counts):
    """Episodes of random lengths, of several generators, each of which may leave memory behind."""

    observation_space = spaces.Box(-10, 10, (4,), np.float64)

    def __init__(self, leaks_mb: float = 0.0) -> None:
        self.leaks_mb, self.kept = leaks_mb, list[Any]()
        self.draws, self.more = random.Random(3), OrderedDict[str, Any]()
        self.more["dice"] = [np.random.default_rng(5)]
        kinds = random.Random, np.random.RandomState, np.random.default_rng
        self.more["several"] = tuple(kind(5) for kind in kinds)

    def does(self, action: Any) -> float:
        return float(action)

    def observed(self) -> Any:
        if not self.steps:
            self.kept.append(np.ones(int(self.leaks_mb * 1e6), np.uint8))
            self.length = int(self.np_random.integers(2, 9))
        dice = sum(one.random() for all_of in self.more.values() for one in all_of)
        return np.array([self.np_random.random(), self.draws.random(), dice, self.steps])


def played(make: Any, num_steps: int = 120, **fields: Any) -> tuple[list[Any], dict[str, float]]:
    """What six envs in two workers show in a vector env, and its numbers."""
    envs = VectorEnv([make] * 6, envs_per_process=3, **fields)
    shown = [envs.reset(seed=3)[0]]
    for k in range(num_steps):
        *some, infos = envs.step(np.full(6, k % 3))
        shown += [*some, *(one for one in infos.get("final_obs", ()) if one is not None)]
    numbers = envs.group.metrics()
    envs.close()
    return shown, numbers


@pytest.mark.parametrize("recycle", [{"episodes": 1}, {"episodes": 9}, {"memory_mb": 90}])
def test_results_are_those_of_one_env_bit_for_bit(recycle: dict[str, int]) -> None:
    """Three envs of a worker end at different times, and none waits for the others."""
    shown, _ = played(Walk)
    renewed, numbers = played(partial(Walk, 1.0), recycle=recycle)
    assert len(shown) == len(renewed)
    assert all(map(np.array_equal, shown, renewed))
    assert numbers["envs/recycled"] >= 2
    assert numbers["envs/restarts"] == 0
    assert numbers["envs/outcomes_env_died"] == 0
    assert 0 < numbers["envs/largest_resident_mb"] < (120 if "memory_mb" in recycle else 1000)


class Fresh(Walk):
    """An env that can't be started twice while `path` exists, or whose generator can't be read."""

    def __init__(self, path: str = "", *, hides: bool = False) -> None:
        super().__init__()
        if path:
            Path(path).touch(exist_ok=False)
        if hides:
            self.draws = Hidden()


class Hidden(random.Random):
    def getstate(self) -> Any:
        raise TypeError("it can't be read")


def test_env_that_cannot_be_read_begins_with_a_fresh_generator() -> None:
    with rl.build_env_group(
        EnvConfig(task=partial(Fresh, hides=True), recycle={"episodes": 1})
    ) as group:
        reset_until_recycled(group)


def test_worker_goes_on_if_the_next_one_cannot_be_started(tmp_path: Path) -> None:
    path = str(tmp_path / "there")
    config = EnvConfig(task=partial(Fresh, path), recycle={"episodes": 1}, max_restarts=0)
    with rl.build_env_group(config) as group:
        for _ in range(3):
            batch, _ = group.reset()
            assert batch.restarted is None or not batch.restarted.any()
        Path(path).unlink()
        reset_until_recycled(group)


class Mortal(Walk):
    """Ends its worker with action 9, or while it is made once `path` exists."""

    def __init__(self, path: str) -> None:
        super().__init__()
        if Path(path).exists():
            time.sleep(0.5)
            os._exit(4)

    def does(self, action: Any) -> float:
        return float(action) if action < 9 else os._exit(3)


def test_a_worker_that_inherits_envs_inherits_whom_they_died_of(tmp_path: Path) -> None:
    """Not whom an earlier worker of its host died of; it is no restart more, either."""
    path = tmp_path / "there"
    config = {"task": partial(Mortal, str(path)), "recycle": {"episodes": 4}, "max_restarts": 1}
    with rl.build_env_group(num_workers=2, envs_per_process=2, **config) as group:
        first, _ = group._core.supervisor.records
        batch, _ = group.reset()
        for actions in ([0, 9], [0, 0]):
            group.step(batch.respond(actions))
        while first.stage is not Stage.CLOSED:
            group.reset()
        path.touch()
        while first.stage is Stage.CLOSED:
            group.reset()
        with pytest.raises(WorkerDied, match=r"env 'Mortal-0'.*code 4.*1 restarts in a row"):
            group.step(batch.take([0]).respond([9]))


def reset_until_recycled(group: Any) -> None:
    """Reset until a worker was renewed: the one before may still close, or the next one pause."""
    deadline = time.monotonic() + 60
    while not group.metrics()["envs/recycled"]:
        group.reset()
        assert "1 env, placement process" in repr(group)
        assert time.monotonic() < deadline


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"recycle": {"episode": 1}}, "should be 'episodes' or 'memory_mb'"),
        ({"recycle": {"episodes": 0}}, "greater than or equal to 1"),
        ({"recycle": {"episodes": 1}, "placement": "inline"}, "no worker that could die"),
        ({"recycle": {"episodes": 1}, "placement": "loop"}, "no worker that could die"),
    ],
)
def test_wrong_settings_are_refused(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        rl.build_env_group(Walk, **fields)
