"""Envs whose steps wait for 20 to 500 ms (brief ones: a tenth of that) and do nothing else,
awaitable and not.

The latencies are log-normal and drawn beforehand; each env begins at another one of them.
"""

from __future__ import annotations

import asyncio
import time
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
    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place = 97 * (seed or 0)
        return IDLE, {}

    async def step(self, action: Any) -> Any:
        del action
        await asyncio.sleep(self.latency())
        return IDLE, 1.0, False, False, {}


class Sleeping(Waits, gym.Env[Any, Any]):
    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del options
        self.place = 97 * (seed or 0)
        return IDLE, {}

    def step(self, action: Any) -> Any:
        del action
        time.sleep(self.latency())
        return IDLE, 1.0, False, False, {}


class _Brief(Waits):
    def latency(self) -> float:
        return super().latency() / 10


class BriefAwaiting(_Brief, Awaiting):
    pass


class BriefSleeping(_Brief, Sleeping):
    pass
