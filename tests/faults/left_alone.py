"""Envs that say on stderr when they are left alone and when they are closed."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet

HANG = 1
"""The action of a step that never ends."""


@ENVS.register("left alone")
class LeftAlone(BaseEnv):
    """Its steps end at once."""

    def get_observation_space(self) -> Any:
        return spaces.Discrete(2)

    get_action_space = get_observation_space

    def _say(self, what: str) -> None:
        sys.stderr.write(f"{self.env_id} {what}\n")
        sys.stderr.flush()

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return EnvRet(env_id=self.env_id, observation=0)

    def step(self, policy_resp: Any) -> Any:
        return EnvRet(env_id=self.env_id, observation=1)

    def on_disconnect(self) -> None:
        self._say("is left alone")

    def close(self) -> Any:
        self._say("is closed")


@ENVS.register("left alone, awaitable")
class AwaitableLeftAlone(LeftAlone):
    """A step with the action `HANG` takes too long, and the env is rebuilt."""

    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await asyncio.sleep(0)
        return super().reset(seed=seed, options=options)

    async def step(self, policy_resp: Any) -> Any:
        if policy_resp.action == HANG:
            await asyncio.Event().wait()
        return super().step(policy_resp)

    async def close(self) -> None:
        await asyncio.sleep(0)
        self._say("is closed")
