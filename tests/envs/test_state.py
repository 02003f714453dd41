"""Saving and restoring each backend that supports it, with its real simulator."""

from __future__ import annotations

import pickle
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import NormalizeObservation, NormalizeReward
from hypothesis import given, settings
from hypothesis import strategies as st
from kit.scripted import Counts

from rlightning_aio import PolicyResponse
from rlightning_aio._core.hosts.running.build_env import build_env
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.base import initialised

TASKS = (
    *("Ant", "HalfCheetah", "Hopper", "Humanoid", "HumanoidStandup", "InvertedDoublePendulum"),
    *("InvertedPendulum", "Pusher", "Reacher", "Swimmer", "Walker2d"),
)
GYMNASIUM = ("CartPole-v1", "Acrobot-v1", "MountainCarContinuous-v0", "Taxi-v4", "CliffWalking-v1")


class Made:
    """Make an env of an entry, and reset it."""

    def __init__(self, seed: int, **fields: Any) -> None:
        self.env = build_env(EnvConfig(**{"name": "e", **fields}))
        initialised(self.env)
        self.env.reset(seed=seed)

    def run(self, actions: list[Any]) -> list[Any]:
        trace: list[Any] = []
        for action in actions:
            result = self.env.step(PolicyResponse(self.env.env_id, action))
            ends = (result.last_terminated, result.last_truncated)
            trace.append((result.observation, result.last_reward, *ends, result.info))
            over = [all(end.values()) if isinstance(end, dict) else np.all(end) for end in ends]
            if any(over) and self.env.autoreset == "disabled":
                result = self.env.reset()
                trace.append((result.observation, result.info))
        return pickle.loads(pickle.dumps(trace))  # Envs reuse their arrays.


def check_restored(examples: int = 20, **fields: Any) -> None:
    """A restored env, and another one, go on like the first, from any point, several times."""
    one, other = Made(3, **fields), Made(4, **fields)
    space = one.env.get_action_space()

    @settings(max_examples=examples)
    @given(st.integers(0, 2**31), st.integers(0, 60), st.integers(1, 40))
    def check(seed: int, before: int, after: int) -> None:
        space.seed(seed)
        one.run([space.sample() for _ in range(before)])
        actions = [space.sample() for _ in range(after)]
        state = pickle.dumps(one.env.save_state())
        expected = one.run(actions)
        for made in (one, other):
            made.env.load_state(pickle.loads(state))
            np.testing.assert_equal(made.run(actions), expected)

    check()
    for made in (one, other):
        made.env.close()


@pytest.mark.parametrize("task", GYMNASIUM)
def test_gymnasiums_own(task: str) -> None:
    check_restored(backend="gymnasium", task=task)


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize("task", TASKS)
def test_mujoco(task: str, num_envs: int) -> None:
    check_restored(6, backend="mujoco", task=f"{task}-v5", num_envs=num_envs)


class HeavierEachTime(gym.Wrapper[Any, Any, Any, Any]):
    """Changes its model at each reset, and reads results of the last step before the next one."""

    def reset(self, **kwargs: Any) -> Any:
        observation, info = self.env.reset(**kwargs)
        inner: Any = self.unwrapped
        inner.model.body_mass[1] = inner.np_random.uniform(1, 9)
        inner.model.opt.gravity[2] = -inner.np_random.uniform(5, 9)
        return observation, info

    def step(self, action: Any) -> Any:
        before = self.unwrapped.data.xpos.copy()  # type: ignore[attr-defined]
        observation, reward, terminated, truncated, info = self.env.step(action)
        return np.concatenate((observation, before[1])), reward, terminated, truncated, info


def heavier() -> gym.Env[Any, Any]:
    env = HeavierEachTime(gym.make("Hopper-v5"))
    env.observation_space = gym.spaces.Box(-np.inf, np.inf, (14,), np.float64)
    return env


def test_a_model_that_changes() -> None:
    """Masses and gravity are restored, and values that one step computes for the next."""
    check_restored(6, task=heavier)


def wrapped() -> gym.Env[Any, Any]:
    """Make an env whose wrappers have counters, running means and functions."""
    env = NormalizeReward(NormalizeObservation(gym.make("Pendulum-v1", max_episode_steps=9)))
    return gym.wrappers.TransformReward(env, lambda reward: 2 * reward)


def test_wrappers() -> None:
    check_restored(6, task=wrapped)


def test_a_model_of_another_structure_raises() -> None:
    """Nothing is changed."""
    one, other = (Made(1, backend="mujoco", task=task) for task in ("Hopper-v5", "Walker2d-v5"))
    with pytest.raises(ValueError, match="in the snapshot"):
        other.env.load_state(one.env.save_state())


@pytest.mark.simulators
@pytest.mark.parametrize(
    "task", ["mpe2.simple_spread_v3", "pettingzoo.butterfly.pistonball_v6", "sisl/pursuit-v5"]
)
def test_pettingzoo(task: str) -> None:
    pytest.importorskip("pettingzoo")
    if task.startswith("pettingzoo"):
        pytest.importorskip("pymunk")
    check_restored(backend="pettingzoo", task=task)


@pytest.mark.simulators
@pytest.mark.parametrize(
    ("game", "kwargs"),
    [
        ("Breakout", {}),
        ("SpaceInvaders", {"frameskip": (2, 5)}),
        ("Pong", {"preprocessing": True, "frame_stack": 4}),
        ("Boxing", {"repeat_action_probability": 0.9, "obs_type": "ram"}),
        ("Breakout", {"repeat_action_probability": 0.0}),
        ("Breakout", {"continuous": True}),
    ],
    ids=str,
)
def test_ale(game: str, kwargs: dict[str, Any]) -> None:
    pytest.importorskip("ale_py")
    check_restored(backend="ale", task=f"ALE/{game}-v5", env_kwargs=kwargs)


def test_a_vector_env_of_gymnasium() -> None:
    check_restored(backend="gymnasium", task="CartPole-v1", num_envs=3)


class Sampling(Counts):
    """Its observations are samples of its space."""

    def __init__(self, space: gym.Space[Any]) -> None:
        self.observation_space = space

    def observed(self) -> Any:
        if not self.steps:
            self.observation_space.seed(self.seed)
        return self.observation_space.sample()


BOX = gym.spaces.Box(-1, 1, (1,), np.float64)


@pytest.mark.parametrize(
    "space",
    [
        BOX,
        gym.spaces.Dict(a=BOX, b=gym.spaces.Sequence(BOX)),
        gym.spaces.Tuple((BOX, gym.spaces.Text(9))),
        gym.spaces.Sequence(BOX, stack=True),
        gym.spaces.Graph(BOX, gym.spaces.Discrete(3)),
        gym.spaces.Graph(BOX, None),
        gym.spaces.OneOf((BOX, gym.spaces.Discrete(3))),
    ],
    ids=lambda space: type(space).__name__,
)
def test_generators_of_nested_spaces_are_restored(space: gym.Space[Any]) -> None:
    check_restored(6, task=partial(Sampling, space))


@pytest.mark.simulators
def test_sticky_actions_of_any_other_env_raise() -> None:
    """The console in a callable's env is ale-py's, which doesn't reveal its last action."""
    pytest.importorskip("ale_py")
    for probability in (0.25, 0.0):
        made = Made(0, task=partial(atari, repeat_action_probability=probability))
        if probability:
            with pytest.raises(NotImplementedError, match="use backend: ale"):
                made.env.save_state()
        else:
            made.env.save_state()
        made.env.close()


def atari(**kwargs: Any) -> gym.Env[Any, Any]:
    import ale_py

    gym.register_envs(ale_py)
    return gym.make("ALE/Breakout-v5", **kwargs)


@pytest.mark.simulators
@pytest.mark.filterwarnings("ignore:.*precision lowered")
@pytest.mark.parametrize(
    ("fields", "part"),
    [
        ({"backend": "ale", "task": "ALE/Pong-v5", "num_envs": 2}, "env.env"),
        ({"backend": "maniskill", "task": "PushCube-v1"}, "BackendInfo"),
    ],
    ids=["ale", "maniskill"],
)
def test_an_env_that_cannot_be_saved_raises(fields: dict[str, Any], part: str) -> None:
    """The message names the part."""
    pytest.importorskip({"ale": "ale_py", "maniskill": "mani_skill"}[fields["backend"]])
    made = Made(0, **fields)
    with pytest.raises(NotImplementedError, match=part):
        made.env.save_state()
    made.env.close()
