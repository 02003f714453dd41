"""Behaviour of the vector interface other than results: waiting, errors, closing, wrappers."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.error import (
    AlreadyPendingCallError,
    ClosedEnvironmentError,
    NoAsyncCallError,
    ResetNeeded,
)
from gymnasium.vector import AutoresetMode
from kit.scripted import Awaited
from patience import HANG
from vector.toys import Toy, assert_alike, toy

from rlightning_aio import sync
from rlightning_aio.errors import BadAction, ConfigError, EnvRaised, StartFailed
from rlightning_aio.vector import VectorEnv, make_vec, vector_entry_point

if TYPE_CHECKING:
    from pathlib import Path

POLE = "InvertedPendulum-v5"


class Plain(Toy):
    """Its observations stack."""

    observation_space = spaces.Box(-10, 10, (2,), np.float64)

    def _observed(self) -> Any:
        return self.place.copy()


class Held(Plain):
    """Each step and call waits for the file."""

    def __init__(self, gate: Path) -> None:
        self.gate = gate

    def worker(self) -> int:
        return os.getpid()

    def wait(self) -> int:
        while not self.gate.exists():
            pass
        return self.count

    def step(self, action: Any) -> Any:
        self.wait()
        if action == 2:
            raise RuntimeError("no such action")
        observation, reward, _, _, info = super().step(action)
        return observation, reward, False, False, info


def test_halves_of_a_call_belong_together(tmp_path: Path) -> None:
    """Each `wait` needs its own `async`; after a timeout or an error of a step, all are reset."""
    gate = tmp_path / "open"
    env = VectorEnv([lambda: Held(gate)] * 2, max_concurrency=1)
    assert len(set(env.call("worker"))) == 1
    for wait in (env.reset_wait, env.step_wait):
        with pytest.raises(NoAsyncCallError):
            wait()
    env.reset_async(seed=1)
    with pytest.raises(AlreadyPendingCallError, match="reset_wait"):
        env.step_async(np.zeros(2, np.int64))
    with pytest.raises(AlreadyPendingCallError):
        env.call("double", 1)
    env.reset_wait()
    env.step_async(np.zeros(2, np.int64))
    with pytest.raises(multiprocessing.TimeoutError, match="step_async"):
        env.step_wait(timeout=0.01)
    gate.touch()
    for ask in (partial(env.step, np.zeros(2, np.int64)), env.snapshot, partial(env.call, "wait")):
        with pytest.raises(ResetNeeded, match=r"lost.*timed out"):
            ask()
    env.reset()
    assert env.call("double", 2) == (4, 4)
    assert env.step(np.zeros(2, np.int64))[4]["count"].tolist() == [1, 1]
    with pytest.raises(EnvRaised, match="no such action"):
        env.step(np.array([0, 2]))
    with pytest.raises(ResetNeeded):
        env.step_async(np.zeros(2, np.int64))
    with pytest.raises(ResetNeeded, match="without a mask"):
        env.reset(options={"reset_mask": np.array([False, True])})
    env.reset(options={"reset_mask": np.array([True, True])})
    with pytest.raises(ValueError, match="3"):
        env.step(np.zeros(3, np.int64))
    with pytest.raises(BadAction):
        env.step(np.array([0.0, np.nan]))
    with pytest.raises(TypeError, match="nothing was sent"):
        env.reset(options={"reset_mask": np.array([False, True]), "odd": (_ for _ in ())})
    env.step(np.zeros(2, np.int64))
    with pytest.raises(TypeError, match="can't be sent"):  # The first reset was.
        env.reset(options=[{}, {"odd": (_ for _ in ())}])
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2, np.int64))
    env.reset()
    assert env.step(np.zeros(2, np.int64))[4]["count"].tolist() == [1, 1]
    env.step_async(np.zeros(2, np.int64))
    with pytest.warns(UserWarning, match="pending call to `step`"):
        env.close()
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        env.reset()


@pytest.mark.parametrize(
    ("mode", "why"),
    [
        (AutoresetMode.NEXT_STEP, "'env-0' is awaitable .* step it through build_env_group"),
        (AutoresetMode.DISABLED, "'env-0' is awaitable .* step it through build_env_group"),
        (AutoresetMode.SAME_STEP, "'env-0' .* Expected env to be a `gymnasium.Env`"),
    ],
)
def test_an_awaitable_env_is_refused(mode: AutoresetMode, why: str) -> None:
    """One worker has both, so the first is always built first."""
    with pytest.raises((EnvRaised, StartFailed), match=why):
        VectorEnv([Awaited, Awaited], autoreset_mode=mode, envs_per_process=2)


@pytest.mark.parametrize(
    ("seed", "whose"),
    [
        ([1.9, 2], " of env 0"),
        ([1, "2"], " of env 1"),
        ([True, 2], " of env 0"),
        ([-1, 2], " of env 0"),
        ("12", " of env 0"),
        (1.9, ""),
    ],
)
def test_a_seed_that_is_not_an_int_raises_with_its_env(seed: Any, whose: str) -> None:
    """Nothing is sent, so the next reset works."""
    with contextlib.closing(VectorEnv([Plain] * 2, placement="inline")) as env:
        with pytest.raises(ValueError, match=f"the seed{whose} must be an int from 0 .*, not "):
            env.reset(seed=seed)
        env.reset(seed=[1, None])


class Unsaid(Plain):
    metadata = None  # type: ignore[assignment]


def without_mode() -> Any:
    env: Any = gym.make_vec("CartPole-v1", 2, vectorization_mode="vector_entry_point")
    env.metadata = {}
    return env


def with_mode() -> Any:
    env = without_mode()
    env.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}
    return env


class Old(gym.vector.VectorEnv[Any, Any, Any]):
    """As SuperSuit's are: its spaces are those of one env."""

    metadata: ClassVar = {}
    observation_space = spaces.Discrete(2)
    action_space = spaces.Discrete(2)
    num_envs = 2


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_metadata_must_be_a_dict(mode: str) -> None:
    with pytest.raises(StartFailed, match="the metadata of Unsaid must be a dict, not None"):
        VectorEnv([Unsaid], autoreset_mode=mode, placement="inline")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (without_mode, r"CartPoleVectorEnv has no autoreset_mode.*env\.metadata = "),
        (Old, "Old is no vector environment.*single_observation_space.*backend: pettingzoo"),
    ],
)
def test_an_incomplete_vector_environment_raises_with_the_fix(make: Any, message: str) -> None:
    with pytest.raises(StartFailed, match=message):
        sync.build_env_group({"name": "e", "task": make, "placement": "inline"}).init()


def test_a_vector_env_with_a_declared_mode_is_accepted() -> None:
    with sync.build_env_group({"name": "e", "task": with_mode, "placement": "inline"}) as group:
        batch, _ = group.reset()
        assert batch.observation.shape == (1, 2, 4)


class Late(Plain):
    """Its simulator gives up waiting."""

    def step(self, action: Any) -> Any:
        raise TimeoutError("the simulator does not answer")


def test_an_error_of_an_env_keeps_its_class() -> None:
    """If it is builtin; and a timeout of the env is not mistaken for the caller's."""
    with contextlib.closing(VectorEnv([Late] * 2, max_concurrency=1)) as env:
        for ask in (env.call, env.get_attr):
            with pytest.raises(AttributeError, match="no_such") as caught:
                ask("no_such")
            assert isinstance(caught.value, EnvRaised)
            assert "get_wrapper_attr" in caught.value.traceback_text
        env.reset()
        env.step_async(np.zeros(2, np.int64))
        with pytest.raises(TimeoutError, match="does not answer"):
            env.step_wait(timeout=HANG)


def test_a_value_that_cannot_be_sent_leaves_nothing_behind() -> None:
    """One of several values can't be pickled."""
    env = VectorEnv([Plain] * 2, max_concurrency=1)
    with pytest.raises(TypeError, match="pickle"):
        env.set_attr("note", [1, threading.Lock()])
    env.set_attr("note", 2)
    assert env.get_attr("note") == (2, 2)
    env.close()


def test_bad_arguments_raise_as_in_gymnasium() -> None:
    """The same classes, and nothing is sent."""
    env = VectorEnv([toy] * 2, placement="inline")
    env.reset()
    for actions, kind in ((np.zeros(3, np.int64), ValueError), (np.int64(1), TypeError)):
        with pytest.raises(kind):
            env.step(actions)
    with pytest.raises(ValueError, match="itself"):
        env.call("step", 1)
    with pytest.raises(ValueError, match="3 values for num_envs=2"):
        env.set_attr("speed", [1, 2, 3])
    env.step(np.zeros(2, np.int64))
    env.close()
    for wrong in (0, 1.5, "2"):
        with pytest.raises(ValueError, match="max_concurrency"):
            VectorEnv([toy], max_concurrency=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="worker"):
        VectorEnv([toy], worker=print)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"^task: .*make_vec takes the name of a task"):
        VectorEnv([toy], task="CartPole-v1")


class Sized(Plain):
    def __init__(self, high: float, actions: int) -> None:
        self.observation_space = spaces.Box(-high, high, (2,), np.float64)
        self.action_space = spaces.Discrete(actions)


def test_make_vec_takes_the_arguments_of_gymnasiums() -> None:
    """Wrappers, arguments of the task and of the vector env; the spec has those of the task."""
    kwargs = {"max_episode_steps": 9, "wrappers": [gym.wrappers.RecordEpisodeStatistics]}
    ours: Any = make_vec("Pendulum-v1", 2, vector_kwargs={"placement": "inline"}, g=3.0, **kwargs)
    theirs = gym.make_vec("Pendulum-v1", 2, vectorization_mode="sync", g=3.0, **kwargs)
    assert ours.spec is not None
    assert ours.spec.id == "Pendulum-v1"
    assert ours.get_attr("g") == (3.0, 3.0)
    assert_alike(ours.reset(seed=4), theirs.reset(seed=4))
    for _ in range(9):
        actions = ours.action_space.sample()
        found, expected = ours.step(actions), theirs.step(actions)
    for one in (found, expected):
        del one[4]["episode"]["t"], one[4]["episode"]["_t"]
    assert_alike(found, expected)
    for one in (ours, theirs):
        one.close()


@pytest.mark.parametrize(
    ("task", "mode"),
    [("CartPole-v1", None), (POLE, None), (POLE, "async")],
)
def test_make_vec_passes_on_what_the_runtime_needs(task: str, mode: Any) -> None:
    """Whatever makes the envs; what the task needs goes to the task."""
    fields: dict[str, Any] = {"envs_per_process": 1, "step_timeout": HANG, "max_restarts": 0}
    rendered = {"render_mode": "rgb_array"}
    fields["autoreset_mode"] = AutoresetMode.SAME_STEP
    env: Any = make_vec(task, 2, mode, vector_kwargs={"max_restarts": 7}, **fields, **rendered)
    with contextlib.closing(env):
        config = env.group._core.envs.configs[0]
        assert (config.envs_per_process, config.step_timeout) == (1, HANG)
        assert config.max_restarts == 0
        assert env.autoreset_mode == AutoresetMode.SAME_STEP
        assert env.render_mode == "rgb_array"
        assert env.spec is not None
        assert env.spec.kwargs.keys() & fields.keys() == set()


def test_errors_name_what_the_user_has_given() -> None:
    """The task, the class or the function, and not what this package puts around it."""
    with pytest.raises(StartFailed, match=r"task CartPole-v1\).*'unknown'"):
        make_vec("CartPole-v1", 2, "async", unknown=3)
    with pytest.raises(StartFailed, match=r"task Sized\)"):
        VectorEnv([partial(Sized, high=3)] * 2)


def test_own_envs_step_all_at_once() -> None:
    """As in `AsyncVectorEnv`: none waits for a worker that another one uses."""
    with contextlib.closing(VectorEnv([Plain] * 3)) as env:
        assert [worker["env_ids"] for worker in env.group.get_workers()] == [
            [f"env-{k}"] for k in range(3)
        ]


def test_callables_are_one_for_each_env() -> None:
    """A class and a number, and envs in place of callables, say how to write it."""
    for wrong in ((Plain, 4), (partial(Plain), 4)):
        with pytest.raises(TypeError, match=r"env_fns must be a list .*\] \* 4"):
            VectorEnv(*wrong)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"env_fns\[1\] is a Plain, which is not callable"):
        VectorEnv([Plain, Plain()])  # type: ignore[list-item]


def test_what_makes_no_vector_env_is_refused_with_what_to_do() -> None:
    """Before anything starts."""
    with pytest.raises(ValueError, match="a callable for each"):
        VectorEnv([])
    for task in ("CartPole-v1", "Acrobot-v1", "HalfCheetah-v5"):
        for mode in (None, "sync", "async"):
            with pytest.raises(ValueError, match="num_envs must be at least 1, not 0"):
                make_vec(task, 0, mode)
    with pytest.raises(TypeError, match=r"use VectorEnv\(\[.*CartPoleEnv\] \* n\)"):
        make_vec(CartPoleEnv, 2)  # pyright: ignore[reportArgumentType]


def test_an_unknown_autoreset_mode_is_refused_with_the_known_ones() -> None:
    for make in (partial(VectorEnv, [Plain]), partial(make_vec, POLE)):
        with pytest.raises(ValueError, match=r"autoreset_mode .*'SameStep'.*not 'same_step'"):
            make(autoreset_mode="same_step")


def test_a_tuple_of_actions_is_one_for_each_env() -> None:
    """Like a list; only actions of Tuple and Dict spaces are trees."""
    with contextlib.closing(make_vec("CartPole-v1", 3, "async")) as env:
        env.reset(seed=0)
        listed = env.step([0, 1, 0])
        env.reset(seed=0)
        assert_alike(env.step((0, 1, 0)), listed)
        env.step(tuple(np.int64(1) for _ in range(3)))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_step_limit_of_the_entry_ends_episodes(mode: AutoresetMode) -> None:
    """In the requested mode, repeatedly."""
    makers = [lambda: gym.make("Pendulum-v1")] * 2
    with contextlib.closing(VectorEnv(makers, autoreset_mode=mode, max_episode_steps=3)) as env:
        env.reset()
        period = 4 if mode == AutoresetMode.NEXT_STEP else 3
        for step in range(1, 10):
            truncated = env.step(np.zeros((2, 1), np.float32))[3]
            assert truncated.tolist() == [step % period == 3 % period] * 2


def test_gymnasium_makes_it_by_a_vector_entry_point() -> None:
    """As RLlib does, for example."""
    gym.register(
        "served/Pendulum-v1",
        entry_point="gymnasium.envs.classic_control:PendulumEnv",
        vector_entry_point=vector_entry_point("Pendulum-v1", placement="inline"),
    )
    try:
        env = gym.make_vec("served/Pendulum-v1", 2, vectorization_mode="vector_entry_point")
        assert isinstance(env.unwrapped, VectorEnv)
        assert env.reset(seed=1)[0].shape == (2, 3)
        env.close()
    finally:
        del gym.registry["served/Pendulum-v1"]
