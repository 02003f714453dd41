"""Ctrl-C at any moment of a call of the drop-in interfaces: they go on after a reset."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from faults.striking import struck

from rlightning_aio.vector import VectorEnv, make_vec

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.usefixtures("pressed_again")
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "61"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than any of the calls below executes."""
MAKERS = [lambda: gym.make("CartPole-v1")] * 3
KINDS: dict[str, Callable[[], Any]] = {
    "NEXT_STEP": lambda: VectorEnv(MAKERS),
    "SAME_STEP": lambda: VectorEnv(MAKERS, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP),
    "stepped together": lambda: make_vec("Hopper-v5", 3),
    "sb3": lambda: of_sb3(MAKERS),
}


def of_sb3(makers: Any) -> Any:
    pytest.importorskip("stable_baselines3")
    from rlightning_aio import sb3  # It needs that package.

    return sb3.VecEnv(makers)


def first(envs: Any) -> Any:
    """Reset to the same states as before, and return the observations."""
    if isinstance(envs, gym.vector.VectorEnv):
        return envs.reset(seed=3)[0]
    envs.seed(3)
    return envs.reset()


@pytest.mark.parametrize("call", ["step", "reset", "get_attr"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_reset_goes_on_wherever_a_call_was_interrupted(kind: str, call: str) -> None:
    """The observations after it, and the steps after that, are those without an interrupt."""
    envs = KINDS[kind]()
    try:
        space = getattr(envs, "single_action_space", envs.action_space)
        actions = np.zeros((3, *space.shape), space.dtype)
        expected = first(envs)
        following = envs.step(actions)[0]
        uses = {
            "step": lambda: envs.step(actions),
            "reset": lambda: first(envs),
            "get_attr": lambda: envs.get_attr("metadata"),
        }
        for line in range(1, NUM_LINES, STRIDE):
            reached, _, _ = struck(line, uses[call])
            np.testing.assert_array_equal(first(envs), expected)
            np.testing.assert_array_equal(envs.step(actions)[0], following)
            if not reached:
                break
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
    finally:
        envs.close()
