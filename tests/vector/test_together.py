"""Envs that are stepped together behind the vector interface: conditions and errors."""

from __future__ import annotations

import functools
import multiprocessing
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector.toys import Toy, assert_alike

from rlightning_aio.envs import mujoco_tasks
from rlightning_aio.errors import EnvRaised, StartFailed
from rlightning_aio.vector import VectorEnv, make_vec
from rlightning_aio.vector.making import steps_together

if TYPE_CHECKING:
    from pathlib import Path

INLINE: dict[str, Any] = {"placement": "inline"}
PENDULUM = "InvertedPendulum-v5"


@pytest.mark.parametrize(
    ("task", "num_envs", "arguments", "num_results"),
    [
        (PENDULUM, 6, {}, 1),
        (PENDULUM, 1, {}, 1),
        (PENDULUM, 6, {"vectorization_mode": "async"}, 6),
        (PENDULUM, 6, {"wrappers": [gym.wrappers.ClipAction]}, 6),
        (PENDULUM, 6, {"disable_env_checker": False}, 6),
        ("CartPole-v1", 6, {}, 6),
        ("CartPole-v1", 6, {"vectorization_mode": "vector_entry_point"}, 1),
    ],
)
def test_envs_are_stepped_together_if_results_are_the_same(
    task: str, num_envs: int, arguments: dict[str, Any], num_results: int
) -> None:
    """Not with wrappers; tasks with other results only on request."""
    env = make_vec(task, num_envs, vector_kwargs=INLINE, **arguments)
    assert len(env.group.env_ids) == num_results
    observations, infos = env.reset(seed=1)
    assert observations.shape == (num_envs, 4)
    observations, rewards, terminated, truncated, infos = env.step(env.action_space.sample())
    assert observations in env.observation_space
    assert {len(column) for column in (rewards, terminated, truncated)} == {num_envs}
    assert all(len(column) == num_envs for column in infos.values())
    env.close()


@pytest.mark.parametrize(
    ("arguments", "num_results"),
    [({"max_concurrency": 2}, 2), ({"envs_per_process": 4}, 3), (INLINE, 1)],
)
def test_numbers_in_arguments_count_envs(arguments: dict[str, Any], num_results: int) -> None:
    """Twelve envs, over the requested number of workers."""
    env = make_vec(PENDULUM, 12, vector_kwargs=arguments)
    found = len(env.group.env_ids), env.num_envs
    env.reset(seed=[*range(0, 24, 2)])
    seeds = env.get_attr("np_random_seed")
    env.close()
    assert found == (num_results, 12)
    assert seeds == tuple(range(0, 24, 2))


def test_envs_that_are_stepped_together_need_no_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are in this process, unless an argument needs workers or MuJoCo has no batches."""
    for arguments, pids in (({}, [None]), ({"step_timeout": 60.0, "max_concurrency": 1}, [int])):
        env = make_vec(PENDULUM, 4, vector_kwargs=arguments, num_threads=2)
        found = [worker["pid"] for worker in env.group.get_workers()]
        assert [pid if pid is None else type(pid) for pid in found] == pids
        env.close()
    assert steps_together(gym.spec(PENDULUM), {})
    monkeypatch.setattr(mujoco_tasks, "version", lambda _: "3.12.0")
    assert not steps_together(gym.spec(PENDULUM), {})


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_batches_here_and_in_a_worker_form_one_vector_env(mode: AutoresetMode) -> None:
    """Results of this process are passed as objects, those of a worker in shared memory."""
    kwargs: dict[str, Any] = {"placement": "split", "envs_per_process": 2, "autoreset_mode": mode}
    ours = make_vec(PENDULUM, 4, vector_kwargs=kwargs, max_episode_steps=5)
    make = functools.partial(gym.make, PENDULUM, disable_env_checker=True, max_episode_steps=5)
    theirs = SyncVectorEnv([make] * 4, autoreset_mode=mode)
    assert [worker["pid"] is None for worker in ours.group.get_workers()] == [False, True]
    assert_alike(ours.reset(seed=2), theirs.reset(seed=2))
    ours.action_space.seed(0)
    for turn in range(12):
        actions = ours.action_space.sample()
        found, expected = ours.step(actions), theirs.step(actions)
        assert_alike(found, expected, f"{turn}")
        due = expected[2] | expected[3]
        if mode == AutoresetMode.DISABLED and due.any():
            options = {"reset_mask": due}
            assert_alike(ours.reset(options=dict(options)), theirs.reset(options=dict(options)))
    ours.close()
    theirs.close()


def test_unsupported_modes_raise() -> None:
    """An unknown mode, a missing entry point, and wrappers that would be lost."""
    with pytest.raises(ValueError, match="'async' or 'vector_entry_point', not 'sync'"):
        make_vec(PENDULUM, 2, "sync")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="has no such entry point"):
        make_vec(PENDULUM, 2, "vector_entry_point")
    with pytest.raises(ValueError, match="takes no wrappers"):
        make_vec("CartPole-v1", 2, "vector_entry_point", wrappers=[gym.wrappers.ClipAction])
    with pytest.raises(ValueError, match="max_concurrency"):
        make_vec(PENDULUM, 2, vector_kwargs={"max_concurrency": 0})
    with pytest.raises(StartFailed, match="has autoreset_mode"):
        make_vec("CartPole-v1", 2, "vector_entry_point", {"autoreset_mode": "SameStep", **INLINE})


def test_attributes_that_would_make_them_differ_raise() -> None:
    """Attributes of some envs, and attributes of each env; the error says what to do."""
    env = make_vec(PENDULUM, 3, vector_kwargs=INLINE)
    env.reset(seed=0)
    for name, values in (("frame_skip", [1, 2, 3]), ("model", 1), ("data", 1)):
        with pytest.raises(EnvRaised, match=r"make separate envs \(vectorization_mode='async'\)"):
            env.set_attr(name, values)
    env.set_attr("frame_skip", [3, 3, 3])
    assert env.get_attr("frame_skip") == (3, 3, 3)
    env.step(env.action_space.sample())
    env.close()


def test_missing_features_of_a_tasks_vector_environment_raise() -> None:
    """Methods of single envs, and resets of some; a mask of all is allowed."""
    env = make_vec("CartPole-v1", 4, "vector_entry_point", {"max_concurrency": 2})
    first, _ = env.reset(seed=3)
    with pytest.raises(EnvRaised, match=r"has no call\(\) for each; make separate envs"):
        env.call("spec")
    with pytest.raises(ValueError, match="reset all of their sub-environments"):
        env.reset(options={"reset_mask": np.array([True, False, True, True])})
    again, _ = env.reset(seed=3, options={"reset_mask": np.ones(4, np.bool_)})
    half, _ = env.reset(seed=9, options={"reset_mask": np.array([True, True, False, False])})
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(half[2:], first[2:])
    assert (half[:2] != first[:2]).any()
    env.step(env.action_space.sample())
    env.close()


class Short(Toy):
    """Its observations and infos have a fixed size."""

    observation_space = gym.spaces.Dict(place=gym.spaces.Box(-10, 10, (2,), np.float64))
    metadata: ClassVar = {**Toy.metadata}

    def _observed(self) -> Any:
        return {"place": self.place.copy()}


def loops(mode: AutoresetMode, num_envs: int) -> Any:
    return SyncVectorEnv([Short] * num_envs, autoreset_mode=mode)


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_callables_may_return_vector_environments(mode: AutoresetMode) -> None:
    """Two with three envs form one of six: results, masks, methods, attributes, frames."""
    ours = VectorEnv([functools.partial(loops, mode, 3)] * 2, autoreset_mode=mode, **INLINE)
    theirs = loops(mode, 6)
    assert (ours.num_envs, ours.observation_space) == (6, theirs.observation_space)
    assert_alike(ours.reset(seed=5), theirs.reset(seed=5))
    draws = np.random.default_rng(0)
    for turn in range(30):
        actions = draws.integers(0, 3, 6)
        found, expected = ours.step(actions), theirs.step(actions)
        assert_alike(found, expected, f"{turn}")
        due = expected[2] | expected[3]
        if mode == AutoresetMode.DISABLED and due.any():
            seeds = [None if k % 2 else turn + k for k in range(6)]
            found, expected = (
                env.reset(seed=seeds, options={"reset_mask": due.copy(), "more": 1})
                for env in (ours, theirs)
            )
            assert_alike(found, expected, f"reset after {turn}")
    for env in (ours, theirs):
        env.set_attr("speed", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert_alike(ours.get_attr("speed"), theirs.get_attr("speed"))
    assert_alike(ours.call("double", 2.0, plus=1.0), theirs.call("double", 2.0, plus=1.0))
    assert_alike(ours.render(), theirs.render())
    for env in (ours, theirs):
        env.close()


def test_vector_environments_must_match() -> None:
    """In their number of envs and in their autoreset mode."""
    makers = [functools.partial(loops, AutoresetMode.NEXT_STEP, count) for count in (2, 3)]
    with pytest.raises(RuntimeError, match="the number must be the same everywhere"):
        VectorEnv(makers, **INLINE)
    with pytest.raises(StartFailed, match="has autoreset_mode"):
        VectorEnv(makers[:1], autoreset_mode="SameStep", **INLINE)


class Gated(Short):
    """Its first step waits for the file."""

    def __init__(self, gate: Path) -> None:
        self.gate = gate

    def step(self, action: Any) -> Any:
        while not self.gate.exists():
            pass
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_results_after_a_timeout_are_dropped(tmp_path: Path) -> None:
    """Also for envs that are stepped together."""
    gate = tmp_path / "open"
    batch = functools.partial(SyncVectorEnv, [functools.partial(Gated, gate)] * 2)
    env = VectorEnv([batch] * 2, max_concurrency=2)
    env.reset(seed=0)
    env.step_async(np.zeros(4, np.int64))
    with pytest.raises(multiprocessing.TimeoutError):
        env.step_wait(timeout=0.01)
    gate.touch()
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(4, np.int64))
    env.reset(seed=0)
    assert env.step(np.zeros(4, np.int64))[4]["count"].tolist() == [1, 1, 1, 1]
    with pytest.raises(ValueError, match="3 actions for num_envs=4"):
        env.step(np.zeros(3, np.int64))
    with pytest.raises(TypeError, match="not a scalar"):
        env.step(np.int64(0))
    env.close()
