"""What `make_vec` and `sb3.make_vec_env` make of a task: never slower than the peer's default."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector.toys import assert_alike

from rlightning_aio.errors import ConfigError
from rlightning_aio.vector import VectorEnv, make_vec
from rlightning_aio.vector.mujoco import MujocoVectorEnv

CLIP = [gym.wrappers.RecordEpisodeStatistics]
INLINE: dict[str, Any] = {"placement": "inline"}
OWN = "own/Pendulum-v0"


@pytest.fixture(autouse=True)
def own_task() -> Any:
    """Register a task whose code nobody knows."""
    gym.register(OWN, entry_point=lambda **kwargs: gym.make("Pendulum-v1", **kwargs).unwrapped)
    yield
    del gym.registry[OWN]


@pytest.mark.parametrize(
    ("task", "num_envs", "arguments", "kind"),
    [
        ("CartPole-v1", 3, {}, CartPoleVectorEnv),
        ("CartPole-v1", 1, {}, CartPoleVectorEnv),
        ("CartPole-v1", 3, {"sutton_barto_reward": True}, CartPoleVectorEnv),
        ("CartPole-v1", 3, {"vector_kwargs": {"shared_memory": False}}, CartPoleVectorEnv),
        ("CartPole-v1", 3, {"autoreset_mode": "SameStep"}, SyncVectorEnv),
        ("CartPole-v1", 3, {"wrappers": CLIP}, SyncVectorEnv),
        ("CartPole-v1", 3, {"disable_env_checker": False}, SyncVectorEnv),
        ("CartPole-v1", 3, {"vector_kwargs": {"observation_mode": "different"}}, SyncVectorEnv),
        ("CartPole-v1", 3, {"vectorization_mode": "async"}, VectorEnv),
        ("CartPole-v1", 1, {"vectorization_mode": "async"}, VectorEnv),
        ("CartPole-v1", 3, INLINE, VectorEnv),
        ("FrozenLake-v1", 3, {"is_slippery": False}, SyncVectorEnv),
        ("Pendulum-v1", 3, {"max_episode_steps": 7}, SyncVectorEnv),
        (OWN, 3, {}, VectorEnv),
        (OWN, 1, {}, SyncVectorEnv),
        (OWN, 1, {"step_timeout": 3600}, VectorEnv),
        ("HalfCheetah-v5", 3, {}, MujocoVectorEnv),
        ("HalfCheetah-v5", 1, {}, MujocoVectorEnv),
        ("HalfCheetah-v5", 1, {"wrappers": CLIP}, SyncVectorEnv),
        ("HalfCheetah-v5", 3, {"vectorization_mode": "async"}, VectorEnv),
        ("HalfCheetah-v5", 3, {"wrappers": CLIP}, VectorEnv),
        ("HalfCheetah-v5", 3, {"disable_env_checker": False}, VectorEnv),
        ("HalfCheetah-v5", 3, INLINE, VectorEnv),
    ],
)
def test_each_task_comes_as_what_steps_it_fastest(
    task: str, num_envs: int, arguments: dict[str, Any], kind: type[Any]
) -> None:
    with contextlib.closing(make_vec(task, num_envs, **arguments)) as env:
        assert type(env) is kind
        assert env.num_envs == num_envs
        assert env.spec is not None
        assert env.spec.id == task
        mode = AutoresetMode(arguments.get("autoreset_mode", "NextStep"))
        assert env.metadata["autoreset_mode"] is mode
        env.reset(seed=0)
        env.step(env.action_space.sample())


@pytest.mark.parametrize("task", ["CartPole-v1", "FrozenLake-v1"])
def test_results_are_those_of_the_peers_default(task: str) -> None:
    ours, theirs = make_vec(task, 4), gym.make_vec(task, 4)
    assert_alike(ours.reset(seed=2), theirs.reset(seed=2))
    for _ in range(60):
        actions = ours.action_space.sample()
        assert_alike(ours.step(actions), theirs.step(actions))
    ours.close()
    theirs.close()


def test_two_modes_are_gymnasiums() -> None:
    """They have no workers; fields that need one are refused."""
    for mode in (gym.VectorizeMode.SYNC, "sync"):
        for task in ("CartPole-v1", "Hopper-v5"):
            with contextlib.closing(make_vec(task, 2, mode, autoreset_mode="SameStep")) as env:
                assert type(env) is SyncVectorEnv
                assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        with pytest.raises(ConfigError, match=r"^placement, step_timeout: leave out"):
            make_vec("Pendulum-v1", 1, mode, INLINE, step_timeout=9)
    with contextlib.closing(make_vec("CartPole-v1", 2, "vector_entry_point")) as env:
        assert type(env) is CartPoleVectorEnv
    with pytest.raises(ValueError, match="'threads' is not a valid VectorizeMode"):
        make_vec("Pendulum-v1", 1, "threads")


def test_stable_baselines3s_function_decides_likewise() -> None:
    vec_env = pytest.importorskip("stable_baselines3.common.vec_env")
    from rlightning_aio.sb3 import VecEnv, make_vec_env

    for task, num_envs, arguments, kind in (
        ("CartPole-v1", 3, {}, vec_env.DummyVecEnv),
        ("CartPole-v1", 3, {"vec_env_kwargs": {"start_method": "fork"}}, vec_env.DummyVecEnv),
        ("CartPole-v1", 3, {"vec_env_kwargs": INLINE}, VecEnv),
        ("CartPole-v1", 1, {"vec_env_cls": vec_env.SubprocVecEnv}, VecEnv),
        (OWN, 3, {}, VecEnv),
        (OWN, 1, {}, vec_env.DummyVecEnv),
        (lambda **_: gym.make("Pendulum-v1"), 1, {}, vec_env.DummyVecEnv),
        (lambda **_: gym.make("Pendulum-v1"), 2, {"vec_env_cls": VecEnv}, VecEnv),
        ("Hopper-v5", 4, {}, vec_env.VecMonitor),
        ("Hopper-v5", 3, {}, vec_env.DummyVecEnv),
        ("Hopper-v5", 1, {"env_kwargs": {"num_threads": 1}}, vec_env.VecMonitor),
        ("Hopper-v5", 3, {"vec_env_cls": vec_env.DummyVecEnv}, vec_env.DummyVecEnv),
        ("Hopper-v5", 3, {"vec_env_cls": vec_env.SubprocVecEnv}, VecEnv),
    ):
        with contextlib.closing(make_vec_env(task, num_envs, 0, **arguments)) as env:
            assert type(env) is kind, (task, arguments)
            env.reset()
    with pytest.raises(ConfigError, match=r"^step_timeout: leave out vec_env_cls to have workers"):
        make_vec_env(OWN, 2, vec_env_cls=vec_env.DummyVecEnv, vec_env_kwargs={"step_timeout": 9})
    for task in ("CartPole-v1", "Hopper-v5"):  # Separate, and stepped together.
        with pytest.raises(
            ValueError, match="object, and these envs are in a VecEnv: leave it out"
        ):
            make_vec_env(task, 1, vec_env_cls=object)
        with pytest.raises(TypeError, match="unexpected keyword argument 'monitor'"):
            make_vec_env(task, 1, monitor=True)
