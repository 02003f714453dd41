"""`Try`: one try of an attempt on one env, to an outcome, whatever agent and env do."""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
import traceback
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from rlightning_aio.attempts.records import Attempt, success_of
from rlightning_aio.batch.parts import all_agents
from rlightning_aio.errors import EnvFault, GroupClosed
from rlightning_aio.outcomes import BLAMES, Outcome, TimeSpent, own_end
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rlightning_aio.attempts.episode import AttemptEpisode, AttemptInPlay
    from rlightning_aio.attempts.rules import Rules

Agent: TypeAlias = "Callable[[AttemptEpisode], Awaitable[Any]]"
"""Plays one attempt."""

_PATIENCE_SECONDS: Final = 0.5
"""How long a cancelled agent may take to end, before its env continues without it."""
_SHORTEST_SECONDS: Final = 0.01
"""Between looks whether its time is over, while it could not run."""
_log = logging.getLogger("rlightning_aio")

# Errors of clients are known by name, because the packages that define them are not imported.
_PACKAGES: Final = ("openai", "anthropic", "httpx", "httpcore", "aiohttp", "requests", "urllib3")
_NAMES: Final = frozenset(
    (
        # Of openai and anthropic.
        *("APIConnectionError", "RateLimitError", "InternalServerError"),
        # Of httpx and httpcore: all errors below the protocol.
        *("TransportError", "TimeoutException", "NetworkError", "ProtocolError"),
        # Of aiohttp.
        *("ClientConnectionError", "ClientPayloadError"),
        # Of requests and urllib3.
        *("ConnectionError", "Timeout", "ChunkedEncodingError", "HTTPError"),
    )
)
_OF_FILES: Final = (
    *(FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError),
    PermissionError,
)
_TOO_MANY, _SERVERS_OWN = 429, 500


class Try:
    """See the module.

    Args:
        view: what the agent gets, on an idle env.
        agent: plays it.
        rules: of the attempts.
        waited: seconds until an env was free.
        logged: types of agents' errors that are in the log; more are added.
        turns: lets as many agents play as may at once; its env is reset before that.

    Attributes:
        error: what the agent or the reset has raised, if they have.
    """

    def __init__(
        self,
        view: AttemptInPlay,
        agent: Agent,
        rules: Rules,
        waited: float,
        logged: set[type[BaseException]],
        turns: asyncio.Semaphore,
    ) -> None:
        self._view, self._agent, self._rules, self._waited = view, agent, rules, waited
        self._logged, self._turns = logged, turns
        # Why it was stopped, if it was; and what `_either` waits for.
        self._stopped: str | None = None
        self._woken: asyncio.Future[None] | None = None
        self.error: BaseException | None = None
        self._has_ended = False
        self._prepared = 0.0  # Seconds from when its env was ready until its agent could play.

    @property
    def env_id(self) -> str:
        """Id of its env."""
        return self._view.env_id

    @property
    def goes_well(self) -> bool:
        """It has stepped, and has not ended."""
        return not self._has_ended and bool(self._view.rewards)

    def stop(self, why: str) -> None:
        """End it soon, as cancelled."""
        if self._stopped is None:
            self._stopped = why
            self._wake()

    async def run(self) -> Attempt:
        """Play; the env is idle after that.

        Raises:
            RLightningError, TypeError, ValueError: the env can't be reset like this at all, or the
                agent is no coroutine function.
        """
        began = time.monotonic()
        limit = self._rules.attempt_timeout
        view, result = self._view, None
        begin = asyncio.ensure_future(view.begin())
        await self._within(begin, limit)
        if not begin.done():
            begin.cancel()
            await surely({begin})
            ended = self._cut_short(has_begun=False)
        elif (error := begin.exception()) is not None:
            self.error = error
            if not isinstance(error, EnvFault):
                raise error
            ended = error.outcome
        elif view.fault is not None:
            ended = view.fault
            await self._leave()
        else:
            del begin  # A task keeps its coroutine.
            ended, result = await self._play(limit)
            await self._leave()
        if ended.kind in ("env_raised", "not_started"):
            await self._renew()
        self._has_ended = True
        if isinstance(self.error, _NoCoroutine):
            raise TypeError(*self.error.args)
        return self._record(ended, result, time.monotonic() - began)

    async def _play(self, limit: float | None) -> tuple[Outcome, Any]:
        """Have the agent play once its turn has come; return how that ended, and its result."""
        if not await self._enter():
            return self._cut_short(has_begun=True), None
        playing = asyncio.ensure_future(_awaited(self._agent, self._view))
        await self._within(playing, limit)
        ended = self._end_of(playing)
        is_cut = not playing.done()
        if is_cut:
            playing.cancel()
            await surely({playing}, _PATIENCE_SECONDS, self._view.now)
            self._abandon(playing)
            if self._stopped is None:  # Its time was over, but its env was lost before that.
                ended = self._view.fault or ended
        self._turns.release()
        return ended, None if is_cut or ended.is_failure else playing.result()

    async def _enter(self) -> bool:
        """Wait until its agent may play; its time stands still. False if it is stopped."""
        began = self._view.ran()
        entering = asyncio.ensure_future(self._turns.acquire())
        await self._either(entering, None)
        if not entering.done():
            entering.cancel()
            await surely({entering})
        if entering.cancelled():
            return False
        self._prepared = self._view.ran() - began
        self._view.note_wait(self._prepared)
        return True

    async def _within(self, task: asyncio.Task[Any], limit: float | None) -> None:
        """Wait for a task, until this try is stopped, or has run for `limit` seconds."""
        left = limit
        while self._stopped is None and not task.done():
            await self._either(task, left)
            if limit is None or (left := limit - self._view.ran()) <= 0:
                return
            left = max(left, _SHORTEST_SECONDS)

    async def _either(self, task: asyncio.Task[Any], limit: float | None) -> None:
        """Wait for a task, until this try is stopped, or for `limit` seconds.

        Thousands wait here at once: `asyncio.wait` would make a dozen objects for each.
        """
        if self._stopped is not None:
            return
        loop = asyncio.get_running_loop()
        self._woken = loop.create_future()
        task.add_done_callback(self._wake)
        timer = None if limit is None else loop.call_later(limit, self._wake)
        try:
            await self._woken
        except asyncio.CancelledError:
            self.stop("the program is ending")
        finally:
            if timer is not None:
                timer.cancel()

    def _wake(self, task: asyncio.Task[Any] | None = None) -> None:
        del task
        if self._woken is not None and not self._woken.done():
            self._woken.set_result(None)

    async def _leave(self) -> None:
        self._view.end("is over")
        await surely({asyncio.ensure_future(self._view.leave())})

    async def _renew(self) -> None:
        renewing = asyncio.ensure_future(self._view.renew())
        await self._within(renewing, None)  # It may wait for another env, which still closes.
        if not renewing.done():
            renewing.cancel()
            await self._leave()

    def _abandon(self, playing: asyncio.Task[Any]) -> None:
        if playing.done():
            _ = playing.cancelled() or playing.exception()
            return
        _log.warning(
            "the agent of env %r continues although it was cancelled; its env is given to others: "
            "let CancelledError through",
            self.env_id,
        )
        playing.add_done_callback(lambda task: task.cancelled() or task.exception())

    # -- outcomes ---------------------------------------------------------------------

    def _cut_short(self, *, has_begun: bool) -> Outcome:
        """The outcome of a try that did not end by itself."""
        if self._stopped is not None:
            return Outcome("cancelled", "caller", self._stopped, self.env_id)
        if self._view.is_finished:
            return self._own_end()
        assert self._rules.attempt_timeout is not None
        cause = f"its {self._rules.attempt_timeout:g} s were over"
        if not has_begun:
            return Outcome("timed_out", "env", f"{cause} before its reset was done", self.env_id)
        if self._rules.on_timeout == "end":
            if self._view.has_ended:
                return self._own_end()
            if self._view.in_step > self._rules.attempt_timeout / 2:
                cause += ", most of them in a step"
                return Outcome("env_hung", "either", cause, self.env_id)
            if self._view.rewards:
                return Outcome("truncated", "policy", cause, self.env_id)
        return Outcome("timed_out", "either", cause, self.env_id)

    def _end_of(self, playing: asyncio.Task[Any]) -> Outcome:
        if not playing.done():
            return self._cut_short(has_begun=True)
        if playing.cancelled():
            self.error = asyncio.CancelledError("the agent was cancelled by something else")
        else:
            self.error = playing.exception()
        if self._view.fault is not None:
            return self._view.fault
        if isinstance(self.error, GroupClosed):
            raise self.error  # It is not the agent's, and ends all attempts.
        if self.error is not None:
            return self._raised(self.error)
        if self._view.is_over:
            return self._own_end()
        cause = "the agent returned before the end, without episode.finish()"
        return Outcome("agent_stopped", "caller", cause, self.env_id)

    def _own_end(self) -> Outcome:
        """The outcome of a try that its env has ended, or else its agent."""
        last = self._view.last
        if self._view.has_ended:
            terminated = bool(np.all(all_agents(last.last_terminated)))
            return own_end(self.env_id, last.info, terminated=terminated)
        return Outcome("truncated", "policy", "the agent finished it", self.env_id)

    def _raised(self, error: BaseException) -> Outcome:
        """The outcome of an agent that raised; an error of ours, or with a blame, says more."""
        blame: Any = getattr(error, "blame", None)
        if blame not in BLAMES:
            blame = "infrastructure" if _is_connections(error) else "caller"
        if blame == "caller" and type(error) not in (*self._logged, _NoCoroutine):
            self._logged.add(type(error))
            _log.warning(
                "the agent of env %r has raised; it isn't said again of this type of error:\n%s",
                self.env_id,
                # As text, because a kept record would keep the agent's frames, and so the group.
                "".join(traceback.format_exception(error)),
            )
        return Outcome("agent_raised", blame, repr(error), self.env_id)

    def _record(self, ended: Outcome, result: Any, seconds: float) -> Attempt:
        view = self._view
        agent = max(seconds - view.seconds - self._prepared, 0.0)
        spent = TimeSpent(view.seconds, agent, waiting=self._waited + self._prepared)
        last = None if view.first is None else copied(view.last.observation)
        return Attempt(
            view.spec,
            view.index,
            replace(ended, seconds=spent),
            reward=None if ended.is_failure else view.earned,
            length=len(view.rewards),
            success_value=None if ended.is_failure else success_of(view.last.info),
            rewards=view.rewards,
            columns=view.columns,
            first=view.first,
            last=last,
            result=result,
        )


def _is_connections(error: BaseException) -> bool:
    """Return True if an error, or a cause of it, says that a connection or a server has failed.

    Builtin ones do (`OSError`, and so `TimeoutError`, but not those about files), those of the
    usual clients, and any with the status 429 or 5xx. Any other status is about the request.
    """
    seen = set[int]()
    one: BaseException | None = error
    while one is not None and id(one) not in seen:
        seen.add(id(one))
        status = _status_of(one)
        if status is not None:
            return status == _TOO_MANY or status >= _SERVERS_OWN
        if isinstance(one, OSError) and not isinstance(one, _OF_FILES):
            return True
        if any(map(_is_named, type(one).__mro__)):
            return True
        one = one.__cause__
    return False


def _is_named(kind: type) -> bool:
    return kind.__name__ in _NAMES and kind.__module__.partition(".")[0] in _PACKAGES


def _status_of(error: Any) -> int | None:
    """The status of the reply that a client's error is about."""
    for holder in (error, getattr(error, "response", None)):
        for name in ("status_code", "status"):
            status = getattr(holder, name, None)
            if type(status) is int and status > 0:
                return status
    return None


class _NoCoroutine(TypeError):
    """An agent is no coroutine function."""


async def _awaited(agent: Agent, view: AttemptEpisode) -> Any:
    answer: Any = agent(view)
    if not inspect.isawaitable(answer):
        raise _NoCoroutine(f"the agent returned {answer!r}; it must be a coroutine function")
    return await answer


async def surely(
    tasks: set[asyncio.Task[Any]],
    seconds: float | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Wait for tasks, for `seconds` of a clock at most, also if the caller is cancelled."""
    deadline = None if seconds is None else clock() + seconds
    while left := {task for task in tasks if not task.done()}:
        limit = None if deadline is None else deadline - clock()
        if limit is not None and limit <= 0:
            return
        try:
            await asyncio.wait(left, timeout=limit)
        except asyncio.CancelledError:
            continue  # It is on its way to the end already.
