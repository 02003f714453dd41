"""Envs that do as their action says: end, fail or hang.

Left out on purpose: whatever a test needs, as each worker imports this module.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from rlightning_aio.errors import EnvError

GO, END, CUT, RAISE, BLAME, DIE, HANG, BLOCK, DIE_LATER = range(9)
"""In a coroutine, `HANG` waits, `BLOCK` keeps the event loop, and `DIE_LATER` is nobody's code."""


class Deeds:
    """Its action, or the option ``deed`` of its reset, says what it does."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(9)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        del seed
        self._do((options or {}).get("deed", GO))
        return np.zeros(1), {}

    def step(self, action: Any) -> Any:
        self._do(action)
        return np.ones(1), 1.0, bool(action == END), bool(action == CUT), {}

    def _do(self, deed: int) -> None:
        if deed == RAISE:
            raise ValueError("as asked")
        if deed == BLAME:
            raise EnvError("the action is nonsense", blame="policy")
        if deed == DIE:
            os._exit(3)
        if deed in (HANG, BLOCK):
            time.sleep(3600)


class Fails(Deeds, gym.Env[Any, Any]):
    """The same as an env of Gymnasium."""


class Awaited(Deeds):
    """The same with coroutines.

    Attributes:
        waiting: how many steps wait for ever in this process.
    """

    waiting: ClassVar[int] = 0

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        if (options or {}).get("deed") == HANG:
            await asyncio.Event().wait()
        return super().reset(seed=seed, options=options)

    async def step(self, action: Any) -> Any:
        await asyncio.sleep(0)
        if action in (HANG, DIE_LATER):
            Awaited.waiting += 1
            if action == DIE_LATER:
                asyncio.get_running_loop().call_soon(os._exit, 3)
            await asyncio.Event().wait()
        return super().step(action)

    def num_waiting(self) -> int:
        return Awaited.waiting


gym.register("Fails-v0", Fails)
