"""`EnvEpisode`: one episode of one env, for an agent that is one coroutine for each env.

Invariant: its env is idle at its end, even where the agent was cancelled during a step. So no
result of it ever comes to a call that collects those of other envs.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rlightning_aio.group.interface import EnvHandleInterface
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["EnvEpisode"]


class EnvEpisode:
    """What `EnvGroup.episode` returns; an asynchronous context manager.

    Attributes:
        env: the handle of the env.
        last: its newest result; after entry that of the reset.
    """

    last: EnvRet | MultiAgentEnvRet

    def __init__(
        self, env: EnvHandleInterface, seed: int | None, options: dict[str, Any] | None
    ) -> None:
        self.env = env
        self._seed, self._options = seed, options
        # The newest call, and earlier ones that were cancelled or raised.
        self._tasks: list[asyncio.Task[EnvRet | MultiAgentEnvRet]] = []

    async def __aenter__(self) -> Self:
        try:
            await self._wait_for(self.env.reset(self._seed, self._options))
        except BaseException:
            await self.__aexit__()  # Nobody else calls it for a context that was not entered.
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            await asyncio.wait({task})
            # Read, so that asyncio doesn't log an error that nobody asks for.
            _ = task.cancelled() or task.exception()

    @property
    def is_over(self) -> bool:
        """True if the newest result ended the episode."""
        return bool(self.last.last_terminated or self.last.last_truncated)

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Cancelled, it leaves the result to the end of the episode; until the env has replied,
        further steps raise `EnvBusy`. Other errors are those of `EnvHandle.step`.
        """
        return await self._wait_for(self.env.step(response))

    async def _wait_for(
        self, answer: Coroutine[Any, Any, EnvRet | MultiAgentEnvRet]
    ) -> EnvRet | MultiAgentEnvRet:
        task = asyncio.ensure_future(answer)
        self._tasks.append(task)
        self.last = await asyncio.shield(task)
        self._tasks.remove(task)
        return self.last
