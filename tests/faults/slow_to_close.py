"""Envs that take their time to close, as one does that deletes a sandbox."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet

IMPORTS = {"task": "-", "imports": ["faults.slow_to_close"]}


@ENVS.register("slow to close")
class SlowToClose(BaseEnv):
    """``env_kwargs``: `seconds` that a close takes; `hangs`, the index of the env whose close never
    ends; `folder`, where a closed env leaves a file of its name.
    """

    def get_observation_space(self) -> Any:
        return spaces.Discrete(2)

    get_action_space = get_observation_space

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return EnvRet(env_id=self.env_id, observation=0)

    def step(self, policy_resp: Any) -> Any:
        return EnvRet(env_id=self.env_id, observation=1)

    @property
    def _seconds(self) -> float:
        kwargs = self.config.env_kwargs
        return 1e6 if kwargs.get("hangs") == self.worker_index else kwargs.get("seconds", 0.0)

    def _closed(self) -> None:
        (Path(self.config.env_kwargs["folder"]) / self.env_id).touch()

    def close(self) -> Any:
        time.sleep(self._seconds)
        self._closed()


@ENVS.register("slow to close, awaitable")
class AwaitableSlowToClose(SlowToClose):
    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await asyncio.sleep(0)
        return super().reset(seed=seed, options=options)

    async def step(self, policy_resp: Any) -> Any:
        await asyncio.sleep(0)
        return super().step(policy_resp)

    async def close(self) -> None:
        await asyncio.sleep(self._seconds)
        self._closed()
