"""The global generators of NumPy and Python, which many envs use, in workers and replacements."""

from __future__ import annotations

import random
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from kit.scripted import DIE, GO, Awaitable, Scripted

from rlightning_aio import EnvConfig, sync


class Dice(Scripted):
    """Observes numbers of the global generators."""

    observation_space = spaces.Box(0, 1, (2,), np.float64)

    def observed(self) -> Any:
        return np.array([np.random.random(), random.random()])  # noqa: NPY002


def rolled(make: Any, seed: int | None, *, count: int = 2) -> list[Any]:
    """The numbers of a reset, three steps, a death, three steps, and all of it again, by env."""
    found: list[Any] = []
    config = EnvConfig(name="d", task=make, num_workers=count, envs_per_process=1)
    with sync.build_env_group(config) as group:
        for _ in range(2):
            batch, _ = group.reset(seed=seed)
            for deed in (GO, GO, GO, DIE, GO, GO, GO):
                found.append(batch.observation)
                batch, _ = group.step(batch.respond(action=np.full(count, deed)))
            assert batch.restarted.sum() == 0
    return np.array(found).tolist()


@pytest.mark.parametrize("make", [Dice, partial(Awaitable, Dice)])
@pytest.mark.parametrize("seed", [None, 5])
def test_every_worker_and_every_replacement_has_other_numbers(make: Any, seed: int | None) -> None:
    """No number comes twice, also in another group of the same program: a seed is the env's, and
    attempts at one task would draw the same random port otherwise.
    """
    found = np.array([rolled(make, seed), rolled(make, seed)])
    assert len(set(found.ravel().tolist())) == found.size


def test_an_env_in_this_process_leaves_the_generators_to_their_owner() -> None:
    config = EnvConfig(name="d", task=Dice, placement="inline")
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    with sync.build_env_group(config) as group:
        batch, _ = group.reset(seed=9)
    random.seed(3)
    np.random.seed(3)  # noqa: NPY002
    assert batch.observation.tolist() == [Dice().observed().tolist()]
