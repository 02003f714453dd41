"""Ctrl-C in the middle of the trainer's own work for a synchronous step."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import rlightning_aio.sync

if TYPE_CHECKING:
    from types import FrameType

ENTRY = {
    "name": "pole",
    "backend": "gymnasium",
    "task": "CartPole-v1",
    "num_workers": 2,
    "envs_per_process": 1,
}


class Strike:
    """A trace function that raises an interrupt at the n-th line of this library."""

    def __init__(self, line: int) -> None:
        self.left = line

    def __call__(self, frame: FrameType, event: str, arg: Any) -> Any:
        return self._line if "/rlightning_aio/" in frame.f_code.co_filename else None

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line":
            self.left -= 1
            if self.left == 0:
                raise KeyboardInterrupt
        return self._line


# A step executes some 500 lines; these are a sample, and the last ones come after its end.
@pytest.mark.parametrize("line", range(1, 800, 113))
def test_a_group_can_be_closed_wherever_its_step_was_interrupted(line: int) -> None:
    """The interrupt reaches the program unchanged; the fixtures check that no worker is left."""
    strike = Strike(line)
    interrupted = False
    with rlightning_aio.sync.build_env_group(ENTRY) as group:
        batch, _ = group.reset(seed=0)
        sys.settrace(strike)
        try:
            group.step(batch.respond(action=np.zeros(2, int)))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            sys.settrace(None)
    assert interrupted == (strike.left <= 0)
