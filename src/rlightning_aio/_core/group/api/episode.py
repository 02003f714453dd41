"""`EnvEpisode`: one episode of one env, for an agent that is one coroutine for each env.

Invariant: its env is idle at its end, even where the agent was cancelled during a step. So no
result of it ever comes to a call that collects those of other envs.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio._core.group.api.facade import only_result, steps_of
from rlightning_aio.batch.contents import all_agents
from rlightning_aio.errors import EpisodeLost

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rlightning_aio._core.group.api.interface import EnvHandleInterface, GroupInterface
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

    Answer = Coroutine[Any, Any, tuple[BatchedData, Any]]

__all__ = ["EnvEpisode"]


class EnvEpisode:
    """What `EnvGroup.episode` returns; an asynchronous context manager.

    Attributes:
        env: the handle of the env.
        last: its newest result; after entry that of the reset, and that of the step before where a
            step was lost.
        is_over: the newest result has ended the episode, of all agents and sub-environments; a
            step limit of `auto_reset` ends it, too, and so does a loss.
        lost: why the env was replaced or its client is gone, if it was: the episode has no end.
    """

    last: EnvRet | MultiAgentEnvRet
    is_over: bool

    def __init__(
        self,
        group: GroupInterface,
        env: EnvHandleInterface,
        seed: int | None,
        options: dict[str, Any] | None,
    ) -> None:
        self._group, self.env = group, env
        self._seed, self._options = seed, options
        self.lost: str | None = None
        # The newest call, and earlier ones that were cancelled or raised.
        self._tasks: list[asyncio.Task[tuple[BatchedData, Any]]] = []

    async def __aenter__(self) -> Self:
        try:
            seeds = None if self._seed is None else [self._seed]
            found = await self._answer(self._group.reset(seeds, self._options, [self.env.env_id]))
            self._note(found)
        except BaseException:
            await self.__aexit__()  # Nobody else calls it for a context that was not entered.
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        tasks, self._tasks = self._tasks, []
        if any(not task.done() for task in tasks):
            tasks.append(asyncio.ensure_future(self._group.abort([self.env.env_id])))
            # However often this is cancelled, they go on, and the env is idle in the end.
            await asyncio.wait(tasks)
        for task in tasks:
            # Read, so that asyncio doesn't log an error that nobody asks for.
            _ = task.cancelled() or task.exception()

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Cancelled, it leaves the result to the end of the episode, which aborts the step; until
        then, further steps raise `EnvBusy`. Other errors are those of `EnvHandle.step`, and:

        Raises:
            EpisodeLost: the env was replaced during this step or an earlier one, so there is no
                result; the env has begun another episode.
        """
        found: BatchedData | None = None
        if self.lost is None:
            answer = await self._answer(self._group.step(steps_of(self.env.env_id, response)))
            found = answer[0]
            if not found.restarted.any():
                self._note(answer)
                return self.last
            info = found.values()[0].info
            self.lost = str(info.get("worker_restarted") or info.get("client_lost"))
            self.is_over = True
        lost = EpisodeLost(
            f"the episode of env {self.env.env_id!r} is lost: its env {self.lost}",
            env_id=self.env.env_id,
        )
        lost.results = found
        raise lost

    async def _answer(self, answer: Answer) -> tuple[BatchedData, Any]:
        task = asyncio.ensure_future(answer)
        self._tasks.append(task)
        found = await asyncio.shield(task)
        self._tasks.remove(task)
        return found

    def _note(self, found: tuple[BatchedData, Any]) -> None:
        self.last = only_result(found)
        self.is_over = bool(all_agents(found[0].done).all())
