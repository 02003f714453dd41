"""Envs from callables, with any wrappers."""

from __future__ import annotations

import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import wrappers

import rlightning_aio as rl
from rlightning_aio import (
    BaseEnv,
    ConfigError,
    EnvConfig,
    EnvRaised,
    EnvRet,
    StartFailed,
)
from rlightning_aio.sync import build_env_group


def wrapped_pendulum(gravity: float = 10.0) -> gym.Env[Any, Any]:
    """State in every wrapper: frames, statistics, a running mean, a clock."""
    env: Any = gym.make("Pendulum-v1", g=gravity, max_episode_steps=5)
    env = wrappers.RecordEpisodeStatistics(env)
    env = wrappers.ClipAction(env)
    env = wrappers.NormalizeObservation(env)
    return wrappers.FrameStackObservation(env, 2)


def inline(**fields: Any) -> Any:
    return build_env_group({"name": "e", "placement": "inline", **fields})


class Counter(BaseEnv):
    """A `BaseEnv`, made without its entry."""

    def __init__(self) -> None:
        super().__init__(EnvConfig(name="made", backend="made", task="made"))
        self.env = gym.make("CartPole-v1")

    def reset(self, *, seed: Any = None, options: Any = None) -> EnvRet:
        return EnvRet(env_id=self.env_id, observation=np.zeros(4, np.float32))

    def step(self, policy_resp: Any) -> EnvRet:
        action = self._preprocess_fn(policy_resp)
        return EnvRet(env_id=self.env_id, observation=np.zeros(4, np.float32), last_reward=action)


class Maker:
    make = staticmethod(wrapped_pendulum)


def test_a_callable_may_be_in_a_class() -> None:
    with inline(task=f"{__name__}:Maker.make") as group:
        assert group.metas[0].max_episode_steps == 5


def test_one_callable_makes_every_env_of_an_entry() -> None:
    """With the ``env_kwargs`` and the step limit of the entry."""
    fields = {"task": wrapped_pendulum, "env_kwargs": {"gravity": 0.0}, "num_workers": 2}
    with inline(**fields, max_episode_steps=3) as group:
        batch, _ = group.reset(seed=0)
        assert [meta.max_episode_steps for meta in group.init()] == [3, 3]
        for _ in range(3):
            batch, _ = group.step(batch.respond(action=np.zeros((2, 1), np.float32)))
        assert batch.truncated.tolist() == [True, True]
        assert [g.unwrapped.g for g in (group[i].get_attr("unwrapped") for i in group.env_ids)] == [
            0.0,
            0.0,
        ]


def test_errors_name_the_callable_of_the_env() -> None:
    """If there is no task."""
    makers = [wrapped_pendulum, lambda: wrapped_pendulum(5.0)]
    with inline(task=makers, num_workers=2) as group:
        for k, name in enumerate((r"wrapped_pendulum", r"\S+<lambda>")):
            (env_id,) = [env_id for env_id in group.env_ids if env_id.endswith(str(k))]
            said = rf"'{env_id}' \(entry '\w+', backend callable, task {name}\) raised"
            with pytest.raises(EnvRaised, match=said):
                group[env_id].call("nothing")


def test_a_vector_env_determines_num_envs() -> None:
    """And the autoreset mode; the sub-environments have an axis of their own."""
    with inline(task=lambda: gym.make_vec("CartPole-v1", 3)) as group:
        (meta,) = group.init()
        assert (meta.num_envs, meta.autoreset) == (3, "next_step")
        batch, _ = group.reset(seed=3)
        batch, _ = group.step(batch.respond(action=np.zeros((1, 3), np.int64)))
        assert batch.observation.shape == (1, 3, 4)
        assert batch.reward.tolist() == [[1.0] * 3]


def test_a_base_env_gets_the_entry_of_its_callable() -> None:
    """It has the entry's name, and uses the group's preprocess function."""
    config = EnvConfig(name="own", task=Counter, num_workers=2, placement="inline")
    with build_env_group(config, preprocess_fn=lambda response: response.action + 1) as group:
        batch, _ = group.reset()
        assert batch.ids() == ["own-0", "own-1"]
        batch, _ = group.step(batch.respond(action=[1, 2]))
        assert batch.reward.tolist() == [2, 3]


@pytest.mark.parametrize(("task", "entry_point"), [("CartPole-v1", True), ("Pendulum-v1", False)])
def test_many_of_a_gymnasium_task_in_one_env(task: str, entry_point: bool) -> None:
    """By the vector environment of the task, or by a loop; both as made by `make_vec`."""
    vector: Any = gym.make_vec(task, 3)
    assert isinstance(vector, gym.vector.SyncVectorEnv) != entry_point
    with inline(backend="gymnasium", task=task, num_envs=3) as group:
        batch, _ = group.reset(seed=5)
        observation, _ = vector.reset(seed=5)
        np.testing.assert_array_equal(batch.observation[0], observation)
        vector.action_space.seed(0)
        for _ in range(210):
            action = vector.action_space.sample()
            batch, _ = group.step(batch.respond(action=action[None]))
            observation, reward, terminated, truncated, _ = vector.step(action)
            np.testing.assert_array_equal(batch.observation[0], observation)
            np.testing.assert_array_equal(batch.reward[0], reward)
            np.testing.assert_array_equal(batch.terminated[0], terminated)
            np.testing.assert_array_equal(batch.truncated[0], truncated)
    vector.close()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": "e", "task": wrapped_pendulum, "backend": "mujoco"}, "takes a name"),
        ({"name": "e", "task": [Counter], "num_workers": 2}, "1 callables for num_workers: 2"),
        ({"name": "e", "task": "Counter", "backend": "callable"}, "module:function"),
    ],
)
def test_an_invalid_callable_raises_before_anything_starts(given: Any, said: str) -> None:
    """The message names the field, and what to do."""
    with pytest.raises(ConfigError, match=said):
        build_env_group(given)


def test_a_callable_that_cannot_be_pickled_raises_before_anything_starts() -> None:
    """The message names the captured object; inline envs need no pickle."""
    lock = threading.Lock()

    def locked() -> Any:
        return lock and gym.make("CartPole-v1")

    with pytest.raises(ConfigError, match=r"task .*locked can't be sent.*captures 'lock'"):
        build_env_group([locked])
    with inline(task=locked) as group:
        assert len(group) == 1


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"task": dict}, "must return a gymnasium.Env.*not dict"),
        ({"task": wrapped_pendulum, "num_envs": 2}, "returned a single env; leave num_envs"),
        (
            {"task": lambda: gym.make_vec("CartPole-v1", 3), "num_envs": 2},
            "returned 3 of them; leave num_envs",
        ),
        (
            {"task": lambda: gym.make_vec("CartPole-v1", 3), "max_episode_steps": 9},
            "a vector env keeps its own limits",
        ),
    ],
)
def test_a_wrong_return_value_of_a_callable_fails_the_start(fields: Any, said: str) -> None:
    """The message has the value and the requirement."""
    with pytest.raises((StartFailed, ConfigError), match=said):
        inline(**fields).init()


class OldGym(gym.Env[Any, Any]):
    """Has the interface of Gym, Gymnasium's predecessor."""

    observation_space = gym.spaces.Discrete(3)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0

    def step(self, action: Any) -> Any:
        return 0, 0.0, False, {}


class OldStep(OldGym):
    """Its reset is Gymnasium's."""

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0, {}


class Wrong(OldStep):
    """Unpacks in its own code."""

    def step(self, action: Any) -> Any:
        _, _ = (1, 2, 3)


class OfCoroutines(gym.Env[Any, Any]):
    observation_space = OldGym.observation_space
    action_space = OldGym.action_space

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return 0, {}

    async def step(self, action: Any) -> Any:
        return 1, 0.0, False, False, {}


def decorated(function: Any) -> Any:
    def call(*args: Any, **kwargs: Any) -> Any:
        return function(*args, **kwargs)

    return call


class Decorated:
    """Nobody sees before a call that these are coroutine functions."""

    observation_space = OldGym.observation_space
    action_space = OldGym.action_space
    reset = decorated(OfCoroutines.reset)
    step = decorated(OfCoroutines.step)


class OldDecorated(Decorated):
    @decorated
    async def step(self, action: Any) -> Any:
        return 0, 0.0, False, {}


class Plain(Decorated):
    """Has neither Gymnasium's base class nor coroutine functions."""

    reset = OldStep.reset
    step = OldStep.step


class DecoratedGym(OldGym):
    reset = Decorated.reset
    step = Decorated.step


def old_registered() -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(OldStep(), 9)


async def stepped(task: Any, placement: str) -> Any:
    async with rl.build_env_group(task, name="env", num_workers=1, placement=placement) as group:
        batch, _ = await group.reset()
        batch, _ = await group.step(batch.respond(action=[0]))
        return batch.observation.tolist()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Never awaited.
@pytest.mark.parametrize("placement", ["inline", "process"])
@pytest.mark.parametrize(
    ("task", "said"),
    [
        (OldGym, "non-iterable int object: .*reset .observation, info.*shimmy.GymV21"),
        (OldStep, "expected 5, got 4.: a step returns .*shimmy.GymV21"),
        (old_registered, "expected 5, got 4.: a step returns .*shimmy.GymV21"),
        (DecoratedGym, "coroutine object: .*leave that base class out"),
        (Plain, "must return a gymnasium.Env.*not Plain.*shimmy.GymV21"),
    ],
)
async def test_an_old_interface_is_named(task: Any, said: str, placement: str) -> None:
    """With the wrapper that converts it."""
    with pytest.raises((EnvRaised, StartFailed), match=said):
        await stepped(task, placement)


async def test_an_error_of_the_envs_own_code_is_left_alone() -> None:
    """It unpacks something else."""
    with pytest.raises(ValueError, match=r"too many values to unpack \(expected 2\);"):
        await stepped(Wrong, "process")


@pytest.mark.parametrize("placement", ["loop", "process"])
@pytest.mark.parametrize("task", [OfCoroutines, Decorated])
async def test_what_reset_returns_says_that_an_env_is_awaitable(task: Any, placement: str) -> None:
    """Whatever its base class is, and whatever decorates its methods."""
    assert await stepped(task, placement) == [1]
    with pytest.raises(TypeError, match=r"expected 5, got 4.: a step returns"):
        await stepped(OldDecorated, placement)
