"""Environments that do nothing, or only let time pass, to measure the runtime around them.

Workers import this module through a config entry's ``imports``.
"""

from __future__ import annotations

import time
from statistics import NormalDist
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box

NO_WORK = "benchmarks/NoWork-v0"
SLEEPS = "benchmarks/Sleeps-v0"
SPENDS = "benchmarks/Spends-v0"
WORKS_5_US = "benchmarks/Works5us-v0"
WORKS_30_US = "benchmarks/Works30us-v0"
WORKS_1_MS = "benchmarks/Works1ms-v0"
NAPS_10_MS = "benchmarks/Naps10ms-v0"


def work(seconds: float) -> None:
    """Keep a core busy for that long, like a simulation."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


class NoWork(gym.Env[Any, Any]):
    """Returns the same four numbers each time."""

    observation_space = Box(-1.0, 1.0, (4,), np.float32)
    action_space = Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self) -> None:
        self._observation = np.zeros(4, np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        return self._observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        del action
        return self._observation, 0.0, False, False, {}


class AwaitsNothing:
    """As `NoWork`, by coroutines."""

    observation_space, action_space = NoWork.observation_space, NoWork.action_space

    def __init__(self) -> None:
        self._observation = np.zeros(4, np.float32)

    async def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        del seed, options
        return self._observation, {}

    async def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        del action
        return self._observation, 0.0, False, False, {}


class Sleeps(NoWork):
    """Sleeps in each step for a log-normal time: median 2 ms, sigma 1.5.

    The times are quantiles of the distribution, in an order that the seed gives, repeated: every
    256 steps take the same total time, so that rounds of a second can be compared.
    """

    MEDIAN, SIGMA, TIMES = 2e-3, 1.5, 256

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        found = super().reset(seed=seed, options=options)
        normal = NormalDist(0.0, self.SIGMA)
        times = [
            self.MEDIAN * float(np.exp(normal.inv_cdf((k + 0.5) / self.TIMES)))
            for k in range(self.TIMES)
        ]
        self._times = self.np_random.permutation(times).tolist()
        self._next = 0
        return found

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._next = (self._next + 1) % self.TIMES
        time.sleep(self._times[self._next])
        return super().step(action)


class Works(NoWork):
    """Works for the same time in each step."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._seconds = seconds

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        work(self._seconds)
        return super().step(action)


class Naps(NoWork):
    """Sleeps in each step for the same time."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self._seconds = seconds

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(self._seconds)
        return super().step(action)


class Spends(NoWork):
    """Works and then sleeps for the seconds in its action; observes the time at its end.

    The time is that of the monotonic clock, which all processes of a machine share.
    """

    observation_space = Box(-np.inf, np.inf, (1,), np.float64)
    action_space = Box(0.0, np.inf, (2,), np.float64)

    def __init__(self) -> None:
        self._observation = np.zeros(1)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        seconds, asleep = action.tolist()
        if seconds:
            work(seconds)
        if asleep:
            time.sleep(asleep)
        self._observation[0] = time.monotonic()
        return super().step(action)


for _id, _entry_point, _kwargs in (
    (NO_WORK, NoWork, {}),
    (SLEEPS, Sleeps, {}),
    (SPENDS, Spends, {}),
    (WORKS_5_US, Works, {"seconds": 5e-6}),
    (WORKS_30_US, Works, {"seconds": 30e-6}),
    (WORKS_1_MS, Works, {"seconds": 1e-3}),
    (NAPS_10_MS, Naps, {"seconds": 1e-2}),
):
    gym.register(_id, _entry_point, disable_env_checker=True, order_enforce=False, kwargs=_kwargs)
