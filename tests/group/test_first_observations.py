"""Observations outside their space cause one warning per entry, and are returned unchanged."""

from __future__ import annotations

import warnings

import gymnasium as gym
import numpy as np
import pytest
from kit.scripted import Counts

from rlightning_aio import EnvConfig, sync


class Exceeding(Counts):
    """Observes its number of steps, which exceeds its space."""

    def __init__(self, announced: int) -> None:
        self.observation_space = gym.spaces.Box(0, announced, (1,), np.float64)


gym.register("Exceeding-v0", Exceeding)


def entries(**announced: int) -> list[EnvConfig]:
    return [
        EnvConfig(
            name=name, backend="gymnasium", task="Exceeding-v0", env_kwargs={"announced": most},
            placement="inline", num_workers=2,
        )
        for name, most in announced.items()
    ]  # fmt: skip


def rollout(configs: list[EnvConfig], num_steps: int = 20) -> tuple[list[float], list[str]]:
    """Return the first env's observations and the warnings."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with sync.build_env_group(configs) as group:
            batch, _ = group.reset(seed=0)
            observed = []
            for _ in range(num_steps):
                actions = np.zeros(len(batch), np.int64)
                batch, _ = group.step(batch.respond(action=actions))
                observed.append(float(batch.observation[0, 0]))
    return observed, [str(one.message) for one in said]


def test_each_entry_that_exceeds_its_space_is_warned_of_once() -> None:
    """With name, task, found and expected values; other entries get no warning."""
    observed, said = rollout(entries(low=2, lower=1, high=10**6))
    assert observed == list(range(1, 21))
    assert [text.partition(" (entry")[0] for text in said] == ["env 'lower-0'", "env 'low-0'"]
    assert (
        "task 'Exceeding-v0'): an observation holds 2.0, and the space goes from 0.0 to 1.0"
        in said[0]
    )


def test_later_observations_are_not_checked() -> None:
    """A check costs as much as a step of a small env."""
    assert rollout(entries(far=15))[1] == []


def test_a_warning_that_is_an_error_loses_no_result() -> None:
    """The next collect returns the results that the error held back."""
    with sync.build_env_group(entries(low=0)) as group:
        batch, _ = group.reset(seed=0)
        group.step_async(batch.respond(action=np.zeros(2, np.int64)))
        with pytest.raises(UserWarning, match=r"an observation holds 1\.0"):
            group.collect_async(wait_all=True)
        batch, _ = group.collect_async(wait_all=True)
        assert batch.observation.tolist() == [[1.0], [1.0]]
