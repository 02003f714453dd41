"""`Agents`: what is asked of one env at a time; `EnvEpisode`: one episode, for one coroutine.

Invariant: the env is idle at the end of an episode, even where the agent was cancelled during a
step. So no result of it ever comes to a call that collects those of other envs.
"""

from __future__ import annotations

import asyncio
import time
from contextvars import Context
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio._core.group.api.facade import response_to, stop_hardware
from rlightning_aio._core.group.engine.agent_steps import AgentStep, EpisodeStart, MethodCall
from rlightning_aio._core.hosts.awaiting.event_loop import new_task
from rlightning_aio.errors import EpisodeLost

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.interface import EnvHandleInterface, GroupInterface
    from rlightning_aio._core.group.drivers.aio_driver import AioDriver
    from rlightning_aio._core.group.engine.agent_steps import AgentSteps, StepEnd
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.outcomes import Outcome
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse


class Agents:
    """`AgentSteps` of one group, on its event loop.

    Args:
        steps, driver: of the group.

    Attributes:
        steps: as given.
    """

    def __init__(self, steps: AgentSteps, driver: AioDriver) -> None:
        self.steps = steps
        self._driver = driver
        self._serving: asyncio.Task[None] | None = None

    def ask(
        self, env_id: str, what: PolicyResponse | EpisodeStart | MethodCall
    ) -> tuple[AgentStep, asyncio.Future[Any]]:
        """Have something sent in the next turn of the loop; return it, and its outcome."""
        self._driver.check_caller()
        loop = asyncio.get_running_loop()
        reply: asyncio.Future[Any] = loop.create_future()
        step = AgentStep(env_id, what, reply)
        if self.steps.ask(step):
            serving = self._driver.run(self.steps.serve(time.monotonic()))
            self._serving = new_task(serving, loop, Context())  # In no agent's context.
            self._serving.add_done_callback(self._on_end)
        return step, reply

    async def asked(self, env_id: str, what: PolicyResponse | EpisodeStart | MethodCall) -> Any:
        """Ask for something and return its outcome; cancelled, leave a result to the collector."""
        step, reply = self.ask(env_id, what)
        step.is_collectable = True
        try:
            return await outcome_of(reply)
        except asyncio.CancelledError:
            self.steps.leave(step)
            raise

    def _on_end(self, task: asyncio.Task[None]) -> None:
        if task is self._serving and task.cancelled():
            self.steps.fail(asyncio.CancelledError())  # Perhaps before it had begun.


async def outcome_of(reply: asyncio.Future[Any]) -> Any:
    """Wait for a reply, and return it.

    A cancellation arrives only where this waits. If the reply was there first, it is returned, and
    the cancellation comes again where the task waits next.
    """
    try:
        return await reply
    except asyncio.CancelledError:
        if reply.cancelled() or not reply.done():
            raise
        asyncio.get_running_loop().call_soon(_cancel_again, asyncio.current_task())
        return reply.result()


def _cancel_again(task: asyncio.Task[Any] | None) -> None:
    if task is not None and task.cancelling():  # Else the cancellation was taken back.
        task.uncancel()
        task.cancel()


def _read(ended: asyncio.Future[Any]) -> None:
    _ = ended.cancelled() or ended.exception()


class EnvEpisode:
    """What `EnvGroup.episode` returns; an asynchronous context manager.

    Attributes:
        env: the handle of the env.
        last: its newest result; after entry that of the reset, and that of the step before where a
            step was lost.
        is_over: the newest result has ended the episode, of all agents and sub-environments; a
            step limit of `auto_reset` ends it, too, and so does a loss.
        lost: the outcome, if the env was replaced, its client is gone, or its request was aborted:
            the episode has no end.
    """

    last: EnvRet | MultiAgentEnvRet
    is_over = False

    def __init__(
        self,
        group: GroupInterface,
        agents: Agents,
        env: EnvHandleInterface,
        seed: int | None,
        options: dict[str, Any] | None,
    ) -> None:
        self._group, self._agents, self.env = group, agents, env
        self._start = EpisodeStart(seed, options)
        self.lost: Outcome | None = None
        # Steps, the reset, and calls that were not answered, also of an agent that awaits them no
        # more: it was cancelled, or has left them to a task of its own.
        self._open_steps: list[AgentStep] = []

    async def __aenter__(self) -> Self:
        try:
            self.last, self.is_over, loss = await self._asked(self._start)
        except BaseException:
            await self.__aexit__()  # Nobody else calls it for a context that was not entered.
            raise
        if loss is not None:  # The env was replaced in the reset, perhaps without its seed.
            self._lose(loss.outcome.ravel().tolist()[0])
        return self

    async def __aexit__(self, *exc: object) -> None:
        if not self.is_over:  # Nobody drives the env any more.
            stop_hardware(self._group, [self.env.env_id])
        for step in self._open_steps:
            if not step.is_outstanding:
                step.reply.cancel()  # It will not be sent.
        if any(step.is_outstanding for step in self._open_steps):
            abort: Any = self._group.abort([self.env.env_id])
            aborting: asyncio.Future[Any] = asyncio.ensure_future(abort)
            aborting.add_done_callback(_read)  # Else asyncio logs its error.
            # However often this is cancelled, it continues, and the env is idle in the end.
            await asyncio.wait([aborting])

    async def _asked(self, what: PolicyResponse | EpisodeStart | MethodCall) -> Any:
        step, reply = self._agents.ask(self.env.env_id, what)
        self._open_steps.append(step)
        try:
            return await outcome_of(reply)
        except EpisodeLost as aborted:
            self._lose(aborted.outcome)
            raise
        finally:
            if not step.is_outstanding:
                self._open_steps.remove(step)

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Cancelled, it leaves the result to the end of the episode, which aborts the step; until
        then, further steps raise `EnvBusy`. Other errors are those of `EnvHandle.step`, and:

        Raises:
            EpisodeLost: the env was replaced during this step or an earlier one, so there is no
                result; the env has begun another episode.
        """
        loss: BatchedData | None = None
        if self.lost is None:
            end: StepEnd = await self._asked(response_to(self.env.env_id, response))
            ret, is_over, loss = end
            if loss is None:
                self.last, self.is_over = ret, is_over
                return ret
            self._lose(loss.outcome.ravel().tolist()[0])
        raise self._error(loss)

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the env, such as a tool, and return its value.

        Cancelled, it leaves the call to the end of the episode, which aborts it. Other errors are
        those of `EnvHandle.call`, and:

        Raises:
            EpisodeLost: the env was replaced since the newest result, so the value would be that of
                another episode.
        """
        if self.lost is None:
            value = await self._asked(MethodCall(name, args, kwargs))
            if (lost := self._agents.steps.loss(self.env.env_id)) is None:
                return value
            self._lose(lost)
        raise self._error(None)

    @property
    def queues(self) -> bool:
        """Return True if steps may wait in a queue of `max_concurrency`."""
        return self._agents.steps.queues(self.env.env_id)

    @property
    def seconds_in_env(self) -> float | None:
        """Seconds that the env has spent on the step in flight, or else on the newest one.

        None while a step waits in a queue.
        """
        return self._agents.steps.seconds_in_env(self.env.env_id)

    def _lose(self, lost: Outcome) -> None:
        self.lost, self.is_over = lost, True

    def _error(self, results: BatchedData | None) -> EpisodeLost:
        assert self.lost is not None
        lost = EpisodeLost(
            f"the episode of env {self.env.env_id!r} is lost: its env {self.lost.cause}",
            env_id=self.env.env_id,
        )
        lost.results, lost.outcome = results, self.lost
        return lost
