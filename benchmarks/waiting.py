"""Envs whose steps wait for 20 to 500 ms (brief ones: a tenth of that) and do nothing else,
awaitable and not.

The latencies are log-normal and drawn beforehand; each env begins at another one of them. `Uneven`
sleeps for log-normal times as well, whose spread is wider.
"""

from __future__ import annotations

import asyncio
import math
import time
from statistics import NormalDist
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

_DRAW = np.random.default_rng(0)
LATENCIES: list[float] = np.clip(
    _DRAW.lognormal(np.log(0.08), 0.7, 100_003), 0.02, 0.5
).tolist()  # fmt: skip
MEAN = sum(LATENCIES) / len(LATENCIES)
"""An env that always waits makes so many seconds of a step."""
CYCLE = 256
"""Steps of `Uneven` after which its times repeat."""
IDLE = np.zeros(8, np.float32)


class Waits:
    """What both have in common."""

    observation_space = spaces.Box(-1, 1, (8,), np.float32)
    action_space = spaces.Discrete(4)
    place = 0

    def latency(self) -> float:
        self.place = (self.place + 1) % len(LATENCIES)
        return LATENCIES[self.place]


class Awaiting(Waits):
    """An awaitable one, whose steps take `mean` seconds, and episodes `length` steps."""

    def __init__(self, mean: float = MEAN, length: float = math.inf) -> None:
        self.share, self.length = mean / MEAN, length

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place, self.steps = 97 * (seed or 0), 0
        return IDLE, {}

    async def step(self, action: Any) -> Any:
        del action
        await asyncio.sleep(self.share * self.latency())
        self.steps += 1
        return IDLE, 1.0, self.steps >= self.length, False, {}


class BriefSleeping(Waits, gym.Env[Any, Any]):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place = 97 * (seed or 0)
        return IDLE, {}

    def step(self, action: Any) -> Any:
        del action
        time.sleep(self.latency() / 10)
        return IDLE, 1.0, False, False, {}


class Uneven(Waits, gym.Env[Any, Any]):
    """Sleeps for 2 ms in the median; of 64 that step at once, the slowest takes thirty times that.

    The times are quantiles of the distribution, in an order that the seed gives, repeated: every
    256 steps take the same total time, 1.6 s, so that rounds of several seconds can be compared.
    """

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed, options=options)
        normal = NormalDist(np.log(2e-3), 1.5)
        times = [np.exp(normal.inv_cdf((k + 0.5) / CYCLE)) for k in range(CYCLE)]
        self._times = self.np_random.permutation(times).tolist()
        return IDLE, {}

    def step(self, action: Any) -> Any:
        del action
        self.place = (self.place + 1) % CYCLE
        time.sleep(self._times[self.place])
        return IDLE, 0.0, False, False, {}


for _name, _made in (("Sleeping", BriefSleeping), ("Uneven", Uneven)):
    gym.register(f"benchmarks/{_name}-v0", _made, disable_env_checker=True, order_enforce=False)
