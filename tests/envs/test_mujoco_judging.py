"""What MuJoCo's threads compute besides simulations: noise of resets, rewards and ends."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from vector.toys import assert_alike

from rlightning_aio.envs.mujoco import outputs, resets
from rlightning_aio.envs.mujoco.batch import MujocoBatch

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.usefixtures("implementation")


@contextmanager
def pair(
    task: str, mode: AutoresetMode = AutoresetMode.NEXT_STEP, **options: Any
) -> Iterator[tuple[MujocoBatch, SyncVectorEnv]]:
    """Yield a batch and Gymnasium's vector env, which were reset."""

    def make() -> Any:
        return gym.make(task, disable_env_checker=True, max_episode_steps=7, **options)

    ours = MujocoBatch(make(), 3, mode, num_threads=2)
    theirs = SyncVectorEnv([make] * 3, autoreset_mode=mode)
    assert_alike(ours.reset(seed=3), theirs.reset(seed=3))
    yield ours, theirs
    ours.close()
    theirs.close()


def compare(ours: MujocoBatch, theirs: SyncVectorEnv, num_steps: int = 30) -> None:
    actions = np.random.default_rng(5)
    for step in range(num_steps):
        action = actions.uniform(-1, 1, ours.action_space.shape).astype(np.float32)
        assert_alike(ours.step(action), theirs.step(action), f"step {step}")


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("task", ["Hopper-v5", "Ant-v5"])
def test_generators_go_on_as_gymnasiums(task: str, mode: AutoresetMode) -> None:
    """After resets that drew uniform, and normal, noise from them; also after a draw by a call."""
    with pair(task, mode) as (ours, theirs):
        for _ in range(2):
            compare(ours, theirs)
            drawn = [
                [each.bit_generator.state for each in envs.call("np_random")]
                for envs in (ours, theirs)
            ]
            assert drawn[0] == drawn[1]
            for generators in (ours.call("np_random"), theirs.call("np_random")):
                for generator in generators:
                    generator.random(3)


def test_noise_is_the_same_where_numpy_hides_its_normal_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resets, "_normal", lambda: None)
    with pair("Ant-v5") as both:
        compare(*both)


@pytest.mark.parametrize("task", ["Swimmer-v5", "Walker2d-v5", "Humanoid-v5"])
def test_weights_may_be_numbers_of_numpy(task: str) -> None:
    """Then Gymnasium computes with other types than with Python's numbers."""
    weights = {"forward_reward_weight": np.float64(1.5), "ctrl_cost_weight": np.float32(0.3)}
    with pair(task, **weights) as both:
        compare(*both)


@pytest.mark.parametrize("task", ["HalfCheetah-v5", "Ant-v5"])
def test_actions_may_have_any_type(task: str) -> None:
    """Costs are computed in their type, by NumPy for some; they may be a part of something else."""
    with pair(task) as (ours, theirs):
        count, width = ours.action_space.shape or ()
        for kind in (np.float32, np.float16, np.float64, np.int64, np.float16, np.float32):
            wide = np.random.default_rng(5).uniform(-2, 2, (count, 2 * width)).astype(kind)
            for _ in range(9):
                assert_alike(ours.step(wide[:, ::2]), theirs.step(wide[:, ::2]), str(kind))


def test_a_build_of_another_version_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of an older checkout: its function would take the plan for another structure."""
    built = pytest.importorskip("rlightning_aio.envs.mujoco._advance")
    monkeypatch.setattr(built, "PLAN_SIZE", 8)
    assert outputs.compiled() is None


@pytest.mark.parametrize("task", ["Hopper-v5", "Humanoid-v5"])
def test_memory_that_nobody_has_written_is_not_read(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where some simulations are reset instead of a step: such values overflow in infos."""

    def garbage(shape: Any, dtype: Any = np.float64) -> Any:
        return np.full(shape, 1e300, dtype) if dtype == np.float64 else np.zeros(shape, dtype)

    monkeypatch.setattr(outputs.np, "empty", garbage)
    env = gym.make(task, disable_env_checker=True)
    batch = MujocoBatch(env, 3, AutoresetMode.NEXT_STEP, num_threads=2)
    batch.reset(seed=3)
    batch.action_space.seed(3)
    # Arrays that somebody has are not written again.
    steps = [batch.step(batch.action_space.sample()) for _ in range(60)]
    reset = [infos["_reward_ctrl"] for *_, infos in steps if "_reward_ctrl" in infos]
    assert any(not all(each) and any(each) for each in reset)
    batch.close()
