"""Many MuJoCo simulations in one env: to the bit what as many of Gymnasium's are."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import SyncVectorEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from vector.toys import assert_alike

from rlightning_aio import sync
from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.gymnasium import MujocoEnv, outdated_assets_accepted
from rlightning_aio.envs.mujoco_batch import MujocoBatch

if TYPE_CHECKING:
    from collections.abc import Callable

WEIGHT = st.floats(0.001, 3) | st.integers(1, 3)
NOISE = st.floats(0, 0.3)
RANGE = st.tuples(st.floats(-2, 0.9), st.floats(1, 3))
WALK = {
    "forward_reward_weight": WEIGHT,
    "ctrl_cost_weight": WEIGHT,
    "reset_noise_scale": NOISE,
    "exclude_current_positions_from_observation": st.booleans(),
}
HEALTH = {
    "healthy_reward": WEIGHT,
    "terminate_when_unhealthy": st.booleans(),
    "healthy_z_range": RANGE,
}
PARTS = {
    f"include_{part}_in_observation": st.booleans()
    for part in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
}
REACH = {"reward_dist_weight": WEIGHT, "reward_control_weight": WEIGHT}
TASKS: dict[str, dict[str, Any]] = {
    "Ant-v5": WALK
    | HEALTH
    | {
        "contact_cost_weight": WEIGHT,
        "contact_force_range": RANGE,
        "main_body": st.sampled_from([1, "torso"]),
        "include_cfrc_ext_in_observation": st.booleans(),
    },
    "HalfCheetah-v5": WALK | {"frame_skip": st.just(5)},
    "Hopper-v5": WALK | HEALTH | {"healthy_state_range": RANGE, "healthy_angle_range": RANGE},
    "Humanoid-v5": WALK
    | HEALTH
    | PARTS
    | {"contact_cost_weight": WEIGHT, "contact_cost_range": RANGE},
    "HumanoidStandup-v5": PARTS
    | {
        "uph_cost_weight": WEIGHT,
        "ctrl_cost_weight": WEIGHT,
        "impact_cost_weight": WEIGHT,
        "impact_cost_range": RANGE,
        "reset_noise_scale": NOISE,
        "exclude_current_positions_from_observation": st.booleans(),
    },
    "InvertedDoublePendulum-v5": {"healthy_reward": WEIGHT, "reset_noise_scale": NOISE},
    "InvertedPendulum-v5": {"reset_noise_scale": NOISE},
    "Pusher-v5": REACH | {"reward_near_weight": WEIGHT},
    "Reacher-v5": REACH,
    "Swimmer-v5": WALK,
    "Walker2d-v5": WALK | HEALTH | {"healthy_angle_range": RANGE},
}
OPTIONS = {
    task: st.fixed_dictionaries({}, optional=fields | {"max_episode_steps": st.integers(3, 60)})
    for task, fields in TASKS.items()
}


def make(task: str, options: dict[str, Any]) -> Callable[[], gym.Env[Any, Any]]:
    return lambda: gym.make(task, disable_env_checker=True, **options)


def compare(task: str, options: dict[str, Any], seed: int, num_steps: int) -> None:
    """Observations, rewards, ends, infos and their dtypes, over ends; the seeds differ."""
    with outdated_assets_accepted():
        ours = MujocoBatch(make(task, options)(), 3)
        theirs: Any = SyncVectorEnv([make(task, options)] * 3)
    seeds = [seed, seed + 10, seed + 5]
    assert_alike(ours.reset(seed=seeds), theirs.reset(seed=seeds))
    actions = np.random.default_rng(seed)
    low, high = ours.action_space.low, ours.action_space.high  # pyright: ignore[reportAttributeAccessIssue]
    for step in range(num_steps):
        # Beyond the bounds, too, where MuJoCo clips.
        action = (1.2 * actions.uniform(low, high)).astype(np.float32)
        assert_alike(ours.step(action), theirs.step(action), f"{task} {options}, step {step}")
    ours.close()
    theirs.close()


@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_gymnasiums(task: str) -> None:
    """As it is made without options, and with short episodes."""
    compare(task, {}, 1, 30)
    compare(task, {"max_episode_steps": 4}, 2, 12)


def compare_with_any_options(task: str, examples: int, num_steps: int) -> None:
    @settings(max_examples=examples)
    @given(OPTIONS[task], st.integers(0, 1000))
    def check(options: dict[str, Any], seed: int) -> None:
        compare(task, options, seed, num_steps)

    check()


@pytest.mark.parametrize("task", TASKS)
def test_options_mean_what_they_mean_to_gymnasium(task: str) -> None:
    """Whatever a task's constructor takes."""
    compare_with_any_options(task, 3, 15)


@pytest.mark.simulators
@pytest.mark.parametrize("task", TASKS)
def test_a_thousand_steps_with_any_options(task: str) -> None:
    """As above, for long."""
    compare_with_any_options(task, 6, 1000)


@pytest.mark.parametrize("placement", ["inline", "process"])
def test_a_group_of_batches_is_as_many_envs(placement: str) -> None:
    """Two envs of three each, seeded one after the other; they reset themselves."""
    fields = {"max_episode_steps": 6, "env_kwargs": {"reset_noise_scale": 0.2}}
    entry = {"name": "hop", "backend": "mujoco", "task": "Hopper-v5", "num_envs": 3, **fields}
    plain = SyncVectorEnv(
        [make("Hopper-v5", {"max_episode_steps": 6, "reset_noise_scale": 0.2})] * 6
    )
    with sync.build_env_group({**entry, "num_workers": 2, "placement": placement}) as group:
        (meta, _) = group.init()
        assert (meta.num_envs, meta.autoreset, meta.max_episode_steps) == (3, "next_step", 6)
        batch, _ = group.reset(seed=7)
        observation, infos = plain.reset(seed=7)
        actions = np.random.default_rng(0).uniform(-1, 1, (20, 6, 3)).astype(np.float32)
        for action in actions:
            assert_alike(batch.observation, observation.reshape(2, 3, -1))
            for name, column in infos.items():
                assert_alike(batch.infos[name], column.reshape(2, 3))
            batch, _ = group.step(batch.respond(action=action.reshape(2, 3, 3)))
            observation, rewards, terminated, truncated, infos = plain.step(action)
            assert_alike(batch.reward, rewards.reshape(2, 3))
            assert_alike(batch.terminated, terminated.reshape(2, 3))
            assert_alike(batch.truncated, truncated.reshape(2, 3))
    plain.close()


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
def test_what_can_not_be_batched_is_stepped_in_a_loop_and_says_so() -> None:
    """Older versions, and tasks that are wrapped."""
    config = EnvConfig(name="old", backend="mujoco", task="Hopper-v4", num_envs=2)
    with pytest.warns(RuntimeWarning, match=r"one after the other: HopperEnv is not one of"):
        env = MujocoEnv(config)
    assert env.reset(seed=0).observation.shape == (2, 11)
    env.close()
    checked = config.model_copy(
        update={"task": "Hopper-v5", "env_kwargs": {"disable_env_checker": False}}
    )
    with pytest.warns(RuntimeWarning, match="wrapped in PassiveEnvChecker"):
        MujocoEnv(checked).close()


def test_misuse_is_refused() -> None:
    """A step before the first reset, actions of another shape, seeds of another number."""
    batch = MujocoBatch(make("InvertedPendulum-v5", {})(), 2)
    with pytest.raises(gym.error.ResetNeeded):
        batch.step(np.zeros((2, 1), np.float32))
    with pytest.raises(ValueError, match="1 seeds for num_envs=2"):
        batch.reset(seed=[1])
    batch.reset()
    with pytest.raises(ValueError, match=r"shape \(2, 1\), not \(2,\)"):
        batch.step(np.zeros(2, np.float32))
    batch.close()


def test_one_of_them_is_rendered() -> None:
    """As Gymnasium renders the env with that seed."""
    if os.environ.get("MUJOCO_GL") not in ("egl", "osmesa", "glfw"):
        pytest.skip("needs MUJOCO_GL")
    look = {"render_mode": "rgb_array", "width": 64, "height": 64}
    batch, alone = MujocoBatch(make("Hopper-v5", look)(), 2), make("Hopper-v5", look)()
    batch.reset(seed=3)
    alone.reset(seed=4)
    action = np.ones((2, 3), np.float32)
    for _ in range(5):
        batch.step(action)
        alone.step(action[0])
    np.testing.assert_array_equal(batch.render()[1], alone.render())
    assert (batch.render_one(0) != batch.render_one(1)).any()
    batch.close()
    alone.close()
