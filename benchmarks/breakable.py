"""An environment that fails when its action says so, and identifies each of its answers.

An observation has the environment's index, process, episode and step, and the token of the action
that it answers. So data of another environment, another step or an earlier life can't pass for the
right answer. Workers import this module through a config entry's ``imports``.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

from rlightning_aio import ENVS
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv

INDEX, PID, EPISODE, STEPS, TOKEN = range(5)
NOTHING, RAISE, EXIT, HANG, KILL, RAISE_ODDLY, WAIT_FOR_GATE = range(7)


class OddError(Exception):
    """Can't be rebuilt from its text, like many exceptions of simulators."""

    def __init__(self, *, code: int) -> None:
        super().__init__(f"the simulator failed with code {code}")


class Breakable(gym.Env[Any, Any]):
    """Steps in a few microseconds, or fails; see the module's docstring.

    Args:
        index: its number in observations.
        clock: a file of one float64 for each environment, where it writes the monotonic
            time at which it begins to die or hang.
        gate: a FIFO; `WAIT_FOR_GATE` waits until another process has opened and closed it.
    """

    observation_space = Box(-np.inf, np.inf, (5,), np.float64)
    action_space = Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, index: int = 0, clock: str | None = None, gate: str | None = None) -> None:
        self._index = index
        self._clock = None if clock is None else np.memmap(clock, np.float64, "r+")
        self._gate = gate
        self._episode = self._steps = 0

    def _result(self, token: float) -> tuple[Any, dict[str, Any]]:
        found = np.array([self._index, os.getpid(), self._episode, self._steps, token])
        return found, {"index": self._index, "steps": self._steps}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self._episode += 1
        self._steps = 0
        return self._result(0.0)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        fault, token = action
        if fault:
            self._break(int(fault))
        self._steps += 1
        observation, info = self._result(token)
        return observation, float(token), False, False, info

    def _break(self, fault: int) -> None:
        if self._clock is not None:
            self._clock[self._index] = time.monotonic()
        if fault == RAISE:
            raise ValueError(f"environment {self._index} was told to fail")
        if fault == EXIT:
            os._exit(3)
        elif fault == HANG:
            threading.Event().wait()
        elif fault == KILL:
            os.kill(os.getpid(), signal.SIGKILL)
        elif fault == RAISE_ODDLY:
            raise OddError(code=7)
        elif fault == WAIT_FOR_GATE:
            assert self._gate is not None
            Path(self._gate).read_bytes()


@ENVS.register("breakable")
class BreakableEnv(GymnasiumEnv):
    """`Breakable` as a backend: its index is the worker index."""

    def _make(self) -> Any:
        return Breakable(self.worker_index, **self.config.env_kwargs)
