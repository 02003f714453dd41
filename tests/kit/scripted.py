"""The env that tests script: it counts its steps, and does what its actions say.

A test that needs another one derives it and says what differs. Left out on purpose: whatever a test
needs, as each worker imports this module.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from rlightning_aio.errors import EnvError

if TYPE_CHECKING:
    from collections.abc import Callable

GO, END, CUT, RAISE, BLAME, DIE, HANG, BLOCK, DIE_LATER = range(9)
"""In a coroutine, `HANG` waits, `BLOCK` keeps the event loop, and `DIE_LATER` is nobody's code."""


class Counts(gym.Env[Any, Any]):
    """Counts its steps, whatever is done.

    Attributes:
        length: of its episodes, if nothing ends them before.
        seed, options: of the last reset.
        resets: so far; steps: of the episode.
        over, cut: this step ends the episode.
    """

    observation_space: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space: gym.Space[Any] = gym.spaces.Discrete(9)
    length = math.inf
    resets = steps = 0
    over = cut = False

    def does(self, action: Any) -> Any:
        """Do what an action says; return the reward if it is not 1."""

    def observed(self) -> Any:
        """Return the observation."""
        return np.array([self.steps], np.float64)

    def told(self) -> dict[str, Any]:
        """Return the info."""
        return {}

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.seed, self.options = seed, options or {}
        self.resets, self.steps = self.resets + 1, 0
        self.over = self.cut = False
        if "deed" in self.options:
            self.does(self.options["deed"])
        return self.observed(), self.told()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.over = self.cut = False
        reward = self.does(action)
        self.steps += 1
        self.over = self.over or self.steps >= self.length
        return self.observed(), 1.0 if reward is None else reward, self.over, self.cut, self.told()


class Scripted(Counts):
    """Its action, or the option ``deed`` of its reset, says what it does."""

    def does(self, action: Any) -> Any:
        self.over, self.cut = bool(action == END), bool(action == CUT)
        if action == RAISE:
            raise ValueError("as asked")
        if action == BLAME:
            raise EnvError("the action is nonsense", blame="policy")
        if action == DIE:
            os._exit(3)
        if action in (HANG, BLOCK):
            time.sleep(3600)


class Saved(Counts):
    """Its state is its number of steps."""

    def save_state(self) -> Any:
        return self.steps

    def load_state(self, state: Any) -> None:
        self.steps = state


class Awaitable:
    """Any env of Gymnasium, with coroutines and its own methods.

    Args:
        make: makes it.
    """

    def __init__(self, make: Callable[[], gym.Env[Any, Any]]) -> None:
        self.env = make()

    def __getattr__(self, name: str) -> Any:
        if name == "env" or name.startswith("_"):
            raise AttributeError(name)
        return getattr(self.env, name)

    async def pause(self, action: Any = None) -> None:
        """Let others continue before a step; before a reset, there is no action."""
        del action
        await asyncio.sleep(0)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await self.pause()
        return self.env.reset(seed=seed, options=options)

    async def step(self, action: Any) -> Any:
        await self.pause(action)
        return self.env.step(action)

    async def close(self) -> None:
        await asyncio.sleep(0)
        self.env.close()


class Awaited(Awaitable):
    """A `Scripted` env with coroutines.

    Attributes:
        waiting: how many steps wait for ever in this process.
    """

    waiting: ClassVar[int] = 0

    def __init__(self) -> None:
        super().__init__(Scripted)

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        if (options or {}).get("deed") == HANG:
            await asyncio.Event().wait()
        return await super().reset(seed=seed, options=options)

    async def pause(self, action: Any = None) -> None:
        if action in (HANG, DIE_LATER):
            Awaited.waiting += 1
            if action == DIE_LATER:
                asyncio.get_running_loop().call_soon(os._exit, 3)
            await asyncio.Event().wait()
        await super().pause()

    def num_waiting(self) -> int:
        return Awaited.waiting


gym.register("Scripted-v0", Scripted)
