"""Envs that are stepped together behind the vector interface: conditions and errors."""

from __future__ import annotations

import copy
import functools
import math
import multiprocessing
import pickle
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import (
    AlreadyPendingCallError,
    ClosedEnvironmentError,
    NoAsyncCallError,
    ResetNeeded,
)
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector.toys import Toy, assert_alike

from rlightning_aio import sync
from rlightning_aio.envs.mujoco import tasks as mujoco_tasks
from rlightning_aio.errors import EnvRaised, StartFailed
from rlightning_aio.vector import VectorEnv, make_vec
from rlightning_aio.vector.making import steps_together
from rlightning_aio.vector.mujoco import MujocoVectorEnv

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
    """They are one batch in this process, unless a field asks for a group or MuJoCo has no
    batches.
    """
    alone = make_vec(
        PENDULUM, 4, None, {"shared_memory": True}, num_threads=2, autoreset_mode="SameStep"
    )
    assert isinstance(alone, MujocoVectorEnv)
    assert alone.metadata["autoreset_mode"] == alone.autoreset_mode == AutoresetMode.SAME_STEP
    with pytest.raises(AttributeError, match=r"without a group. Pass placement="):
        _ = alone.group
    alone.close()
    workers = {"step_timeout": 60.0, "max_concurrency": 1}
    for arguments, pids in ((INLINE, [None]), (workers, [int])):
        env = make_vec(PENDULUM, 4, vector_kwargs=arguments, num_threads=2)
        found = [worker["pid"] for worker in env.group.get_workers()]
        assert [pid if pid is None else type(pid) for pid in found] == pids
        env.close()
    assert steps_together(gym.spec(PENDULUM), {})
    monkeypatch.setattr(mujoco_tasks, "version", lambda _: "3.12.0")
    assert not steps_together(gym.spec(PENDULUM), {})


def test_a_batch_is_called_in_two_halves_as_gymnasiums() -> None:
    """The second half computes; errors are Gymnasium's, also those of a closed one."""
    env: Any = make_vec(PENDULUM, 3)
    with pytest.raises(NoAsyncCallError, match="without any prior call to `step_async`"):
        env.step_wait()
    env.reset_async(seed=4, options={})
    with pytest.raises(AlreadyPendingCallError, match="pending call to `reset`"):
        env.call("dt")
    first, _ = env.reset_wait(timeout=1.0)
    actions = env.action_space.sample()
    env.step_async(actions)
    expected = actions.copy()
    actions[:] = 0.0  # The call has a copy.
    found = env.step_wait()
    env.call_async("state_vector")
    assert len(env.call_wait()) == 3
    again, _ = env.reset(seed=4)
    np.testing.assert_array_equal(again, first)
    assert_alike(env.step(expected), found)
    with pytest.raises(ResetNeeded):
        make_vec(PENDULUM, 2).step(np.zeros((2, 1), np.float32))
    env.close()
    for use in (lambda: env.step(actions), env.save_state, lambda: env.render_one(0)):
        with pytest.raises(ClosedEnvironmentError, match="this MujocoVectorEnv is closed"):
            use()


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
@pytest.mark.parametrize("task", ["Hopper-v5", "Reacher-v5"])
def test_a_state_of_a_batch_can_be_restored_again(task: str, mode: AutoresetMode) -> None:
    """Also after more steps, and in another one; what was returned doesn't change."""
    one, other = (make_vec(task, 3, autoreset_mode=mode, max_episode_steps=6) for _ in range(2))
    one.reset(seed=1)
    one.action_space.seed(0)
    actions = [one.action_space.sample() for _ in range(9)]
    one.step(actions[0])
    kept = pickle.loads(pickle.dumps(one.save_state()))

    def steps(env: Any) -> list[Any]:
        found = [env.step(each) for each in actions[1:5]]
        return [*found, env.reset(options={"reset_mask": np.array([True, False, True])})]

    found = steps(one)
    copies = copy.deepcopy(found)
    for env in (one, one, other):
        env.load_state(kept)
        assert_alike(steps(env), copies)
    assert_alike(found, copies)
    one.close()
    other.close()


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_batches_in_two_workers_form_one_vector_env(mode: AutoresetMode) -> None:
    """A batch of two in each."""
    kwargs: dict[str, Any] = {"placement": "process", "envs_per_process": 2, "autoreset_mode": mode}
    ours = make_vec(PENDULUM, 4, vector_kwargs=kwargs, max_episode_steps=5)
    make = functools.partial(gym.make, PENDULUM, disable_env_checker=True, max_episode_steps=5)
    theirs = SyncVectorEnv([make] * 4, autoreset_mode=mode)
    assert [worker["pid"] is None for worker in ours.group.get_workers()] == [False, False]
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
    """Its observations and infos have a fixed size; a part of an observation is empty."""

    observation_space = gym.spaces.Dict(
        place=gym.spaces.Box(-10, 10, (2,), np.float64), nothing=gym.spaces.Box(-1, 1, (0,))
    )
    metadata: ClassVar = {**Toy.metadata}

    def _observed(self) -> Any:
        return {"place": self.place.copy(), "nothing": np.zeros(0, np.float32)}


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
    for options in (None, {}, {"more": 1}):
        for seed in (None, 3, [3, None, 5, 6, 7, 2]):
            found, expected = (env.reset(seed=seed, options=options) for env in (ours, theirs))
            assert_alike(found, expected, f"reset with {options} and {seed}")
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


@pytest.mark.parametrize("num_envs", [1, 2, 3, 5])
def test_a_few_envs_of_a_vector_entry_point_have_the_shapes_of_gymnasiums(num_envs: int) -> None:
    """Also where each core could have one of them."""
    ours = make_vec("CartPole-v1", num_envs, "vector_entry_point")
    theirs = gym.make_vec("CartPole-v1", num_envs, vectorization_mode="vector_entry_point")
    assert ours.action_space == theirs.action_space
    assert ours.reset(seed=0)[0].shape == theirs.reset(seed=0)[0].shape
    ours.step(np.zeros(num_envs, np.int64))
    ours.set_attr("gravity", 5.0)
    assert ours.get_attr("gravity") == (5.0,) * num_envs
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_vector_environments_of_one_are_that_env(mode: AutoresetMode) -> None:
    """Two of them return what a vector environment of two returns."""
    theirs = SyncVectorEnv([Toy, Toy], autoreset_mode=mode)
    maker = functools.partial(SyncVectorEnv, [Toy], autoreset_mode=mode)
    ours = VectorEnv([maker, maker], autoreset_mode=mode, **INLINE)
    assert_alike(ours.reset(seed=3), theirs.reset(seed=3))
    for actions in np.random.default_rng(0).integers(0, 3, (40, 2)):
        expected = theirs.step(actions)
        assert_alike(ours.step(actions), expected)
        ended = expected[2] | expected[3]
        if mode == AutoresetMode.DISABLED and ended.any():
            options = {"reset_mask": ended, "more": 1}
            assert_alike(ours.reset(options=dict(options)), theirs.reset(options=options))
    ours.set_attr("speed", [0.5, 2.0])
    assert ours.get_attr("speed") == (0.5, 2.0)
    assert ours.call("double", 3, plus=1) == theirs.call("double", 3, plus=1)
    assert_alike(ours.render(), theirs.render())
    ours.close()
    theirs.close()


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.value)
def test_an_entry_of_vector_environments_of_one_has_results_of_single_envs(
    mode: AutoresetMode,
) -> None:
    """Results have no axis for the only sub-environment; a snapshot holds its state."""
    makers: dict[str, Any] = {
        "wrapped": lambda: SyncVectorEnv([lambda: gym.make("CartPole-v1")], autoreset_mode=mode),
        "plain": lambda: gym.make("CartPole-v1"),
    }
    found: list[Any] = []
    for make in makers.values():
        config: Any = {"name": "e", "task": make}
        with sync.build_env_group(config) as group, group.auto_reset(math.inf):
            batch, _ = group.reset(seed=1)
            rewards = 0
            for _ in range(40):
                batch, _ = group.step(batch.respond(action=np.ones(1, np.int64)))
                rewards += batch.reward[0]
            saved = group.snapshot()
            group.step(batch.respond(action=np.zeros(1, np.int64)))
            batch, _ = group.restore(saved)
            found.append((batch.observation, rewards, group.get_env_stats()["e-0"]["episodes"]))
    if mode == AutoresetMode.SAME_STEP:  # Its resets take no steps.
        found = [one[2] > 3 for one in found]
    assert_alike(found[0], found[1])


class Talking(gym.vector.VectorEnv[Any, Any, Any]):
    """Two envs that report `words` in each info."""

    metadata: ClassVar = {"autoreset_mode": AutoresetMode.NEXT_STEP}
    num_envs = 2
    single_observation_space = single_action_space = gym.spaces.Discrete(3)
    observation_space = action_space = gym.spaces.MultiDiscrete([3, 3])

    def __init__(self, words: Any) -> None:
        self._words = words

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return np.zeros(2, np.int64), {"words": self._words}

    def step(self, actions: Any) -> Any:
        return (
            np.zeros(2, np.int64),
            np.zeros(2),
            *np.zeros((2, 2), np.bool_),
            {"words": self._words},
        )


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize(
    ("words", "expected"),
    [(["a", "b"], ["a", "b"]), (["a"], [["a"]] * 2), (("a", "b", "c"), [("a", "b", "c")] * 2)],
)
def test_a_list_in_infos_is_of_each_env_if_it_has_as_many_values(
    words: Any, expected: list[Any], count: int
) -> None:
    envs = VectorEnv([lambda: Talking(words)] * count, **INLINE)
    for infos in (envs.reset()[1], envs.step(np.zeros(2 * count, np.int64))[4]):
        assert infos["words"].tolist() == expected * count
        assert infos["_words"].all()
    envs.close()
