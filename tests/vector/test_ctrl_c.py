"""Ctrl-C at any moment of a call of MuJoCo's batch; random programs press it in the others."""

from __future__ import annotations

import os
from contextlib import closing

import numpy as np
import pytest
from faults.striking import struck

from rlightning_aio.vector import make_vec

STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "61"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than any of the calls below executes."""


@pytest.mark.usefixtures("pressed_again")
@pytest.mark.parametrize("call", ["step", "reset", "get_attr"])
def test_a_reset_goes_on_wherever_a_call_was_interrupted(call: str) -> None:
    """The observations after it, and the steps after that, are those without an interrupt."""
    with closing(make_vec("Hopper-v5", 3)) as envs:
        actions = np.zeros((3, 3), np.float32)
        expected = envs.reset(seed=3)[0]
        following = envs.step(actions)[0]
        uses = {
            "step": lambda: envs.step(actions),
            "reset": lambda: envs.reset(seed=3),
            "get_attr": lambda: envs.get_attr("metadata"),
        }
        for line in range(1, NUM_LINES, STRIDE):
            reached, _, _ = struck(line, uses[call])
            np.testing.assert_array_equal(envs.reset(seed=3)[0], expected)
            np.testing.assert_array_equal(envs.step(actions)[0], following)
            if not reached:
                break
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
