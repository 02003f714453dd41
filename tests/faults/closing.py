"""Envs that note how they end, and may take their time to close, as one does that deletes a
sandbox.
"""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

from gymnasium import spaces

from rlightning_aio import ENVS, BaseEnv, EnvRet

IMPORTS = {"task": "-", "imports": ["faults.closing"]}
HANG = 1
"""The action of an awaitable env's step that never ends."""


@ENVS.register("closing")
class Closing(BaseEnv):
    """``env_kwargs``: `seconds` that a close takes; `hangs`, the index of the env whose close never
    ends; `folder`, where a file of the env's name says that it was left alone, and that it closed.
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

    def _note(self, what: str) -> None:
        with (Path(self.config.env_kwargs["folder"]) / self.env_id).open("a") as file:
            file.write(f"{what}\n")

    def on_disconnect(self) -> None:
        self._note("left alone")

    def close(self) -> Any:
        time.sleep(self._seconds)
        self._note("closed")


@ENVS.register("closing, awaitable")
class AwaitableClosing(Closing):
    async def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        await asyncio.sleep(0)
        return super().reset(seed=seed, options=options)

    async def step(self, policy_resp: Any) -> Any:
        if policy_resp.action == HANG:
            await asyncio.Event().wait()
        return super().step(policy_resp)

    async def close(self) -> None:
        await asyncio.sleep(self._seconds)
        self._note("closed")


def closed_in(folder: Path) -> list[str]:
    """Return the envs that have closed."""
    return sorted(file.name for file in folder.iterdir() if "closed\n" in file.read_text())
