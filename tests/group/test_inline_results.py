"""Abilities of inline envs beyond those of workers: they hand over their own arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from group import sample_envs
from gymnasium import spaces
from kit.contract import same
from kit.scripted import Counts

import rlightning_aio.sync
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from rlightning_aio import BatchedData


def fresh(task: str, **fields: Any) -> dict[str, Any]:
    entry = {"name": task, "backend": "fresh", "task": task, "placement": "inline"}
    return entry | fields


def step(group: Any, batch: BatchedData) -> BatchedData:
    return group.step(batch.respond(action=np.zeros(len(batch), int)))[0]


class Interrupting(Counts):
    """Its `reset` is interrupted."""

    def observed(self) -> Any:
        raise KeyboardInterrupt


@pytest.mark.timeout(20)
def test_a_drain_has_what_another_entry_did_before_an_interrupt() -> None:
    """Its result is reported although another env was interrupted."""
    quiet = {"name": "quiet", "backend": "gymnasium", "task": "CartPole-v1", "placement": "inline"}
    loud = {"name": "loud", "task": Interrupting, "placement": "inline"}
    with rlightning_aio.sync.build_env_group([quiet, loud]) as group:
        with pytest.raises(KeyboardInterrupt):
            group.reset()
        with pytest.raises(EnvRaised) as raised:
            group.drain()
        assert raised.value.env_id == "loud-0"
        assert raised.value.results.env_ids() == ["quiet-0"]


@pytest.mark.filterwarnings("ignore:.*Casting input x to numpy array:UserWarning")
def test_fresh_observations_equal_those_of_a_worker() -> None:
    """Arrays or not, of one env or several: the placement changes nothing."""
    entries = {
        f"{task} of {count}": fresh(task, name=f"{task} of {count}", num_workers=count)
        for task in sample_envs.Fresh.SPACES
        for count in (1, 2)
    }

    def seen(group: Any) -> list[dict[str, Any]]:
        batch, _ = group.reset()
        batches = [batch, step(group, batch), step(group, batch)]
        return [
            {
                name: (part.observation, [value.observation for value in part.values()])
                for name, part in batch.by_entry().items()
            }
            for batch in batches
        ]

    with rlightning_aio.sync.build_env_group(
        [{**entry, "placement": "process"} for entry in entries.values()]
    ) as group:
        in_workers = seen(group)
    for name, entry in entries.items():
        with rlightning_aio.sync.build_env_group(
            entry
        ) as group:  # A single env: nothing is copied.
            handed_over = seen(group)
        expected = [{name: found[name]} for found in in_workers]
        assert same(handed_over, expected)
        assert repr(handed_over) == repr(expected)


def test_fresh_observations_are_handed_over_uncopied() -> None:
    """The column is a view of the env's array."""
    with rlightning_aio.sync.build_env_group(fresh("array")) as group:
        batch = step(group, group.reset()[0])
        assert np.shares_memory(batch.observation, group["array-0"].get_attr("given"))


def test_fresh_observations_have_the_spaces_dtype_and_shape() -> None:
    """Others are cast if that loses only precision, and otherwise refused."""
    with rlightning_aio.sync.build_env_group(
        fresh("array", env_kwargs={"gives": [0.5, 0.25, 0.0]})
    ) as group:
        batch = step(group, group.reset()[0])
        assert (batch.observation.dtype, batch.observation.tolist()) == (
            np.float32,
            [[0.5, 0.25, 0.0]],
        )
    with rlightning_aio.sync.build_env_group(
        fresh("array", env_kwargs={"gives": [0.5, 0.25]})
    ) as group:
        batch, _ = group.reset()
        with pytest.raises(EnvRaised, match=r"Misfit: observation .* expected shape \(3,\)"):
            step(group, batch)
        assert group.reset()[0].observation.shape == (1, 3)


def test_an_overridden_step_has_its_results_copied() -> None:
    """A subclass may write to its results again; `fresh_results` is about `bare_step`."""
    with rlightning_aio.sync.build_env_group(fresh("array", backend="stale")) as group:
        batch, _ = group.reset()
        batches = [batch := step(group, batch) for _ in range(3)]
    assert [b.observation[0, 0] for b in batches] == [0.25, 0.5, 0.75]


class Telling(gym.Env[Any, Any]):
    """Observes its history, in a space that is too small for all values."""

    observation_space = spaces.Dict(history=spaces.Box(-128, 127, (2,), np.int8))
    action_space = spaces.Discrete(1000)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return {"history": np.array([0, -128])}, {"none": np.zeros((0, 3), np.float32)}

    def step(self, action: Any) -> Any:
        info = {"none": np.zeros((0, 3), np.float32)}
        return {"history": np.array([action, 127])}, 1.0, False, False, info


def test_numbers_that_an_observation_space_can_not_hold_are_an_error() -> None:
    """The error has the number; numbers that fit may have a wider dtype."""
    with rlightning_aio.sync.build_env_group(
        {"name": "t", "task": Telling, "placement": "inline"}
    ) as group:
        batch, _ = group.reset()
        assert batch.observation["history"].tolist() == [[0, -128]]
        with pytest.raises(EnvRaised, match=r"'t-0'.*observation\['history'\] .*holds 300.*int8"):
            group.step(batch.respond(action=np.array([300])))
        batch, _ = group.step(batch.respond(action=np.array([0])))
        assert batch.observation["history"].tolist() == [[0, 127]]


def test_an_info_of_empty_arrays_arrives_unchanged() -> None:
    """It takes no byte of a row."""
    with rlightning_aio.sync.build_env_group(
        {"name": "t", "task": Telling, "placement": "inline"}
    ) as group:
        batch, _ = group.reset()
        (info,) = batch.info()
        assert [*info] == ["none"]
        assert (info["none"].shape, info["none"].dtype) == ((0, 3), np.float32)
