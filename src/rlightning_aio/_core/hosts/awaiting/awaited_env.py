"""`AwaitedEnv`: one awaitable env, in a task of its own from its making to its close.

Clients may be bound to the task that has opened them, as those of anyio and MCP are, so all
requests to an env are executed in one task, and so is its close.
Left out: which request comes when, and what takes the place of an env (see `AwaitedEnvs`).
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, TypeAlias

from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.awaiting.event_loop import new_task
from rlightning_aio.protocol.entries import op_of
from rlightning_aio.protocol.error_text import ErrorText

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Collection, Coroutine
    from contextvars import Context
    from typing import NoReturn

    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner

OnOutcome: TypeAlias = "Callable[[AwaitedEnv, int, Any, BaseException | None], None]"
"""Gets the env, the entry of a request, its outcome, and the error that it raised instead."""


class AwaitedEnv:
    """See the module.

    Args:
        index: of the env in its host.
        make: makes the runner; called in the task.
        context: a copy of it is the context of the task.
        watch: wraps the coroutine that answers a request, given the entry.
        on_outcome: is called when a request has ended, unless the env has left before.
        broke: is called when the task ends by itself: a cancel scope that the env has left open
            was cancelled while the env was idle, or the event loop ends.

    Attributes:
        runner: of the env, once it is made.
        made: the error of making it, or None; cancelled if it is not made.
        stopped: done when it executes nothing any more.
        task: its task.
        answering: the coroutine that answers the current request.
        is_leaving: it takes no more requests, and closes.
    """

    def __init__(
        self,
        index: int,
        make: Callable[[], AwaitedRunner],
        context: Context,
        watch: Callable[[Coroutine[Any, Any, Any], int], Awaitable[Any]],
        on_outcome: OnOutcome,
        broke: Callable[[AwaitedEnv], None],
    ) -> None:
        self.index = index
        self.runner: AwaitedRunner
        self._watch = watch
        self._on_outcome = on_outcome
        self._broke = broke
        self._loop = loop = asyncio.get_running_loop()
        self.made: asyncio.Future[BaseException | None] = loop.create_future()
        self.stopped: asyncio.Future[None] = loop.create_future()
        self.answering: Coroutine[Any, Any, Any] | None = None
        self.is_leaving = False
        self._close_error: ErrorText | None = None
        self._request: tuple[int, Any] | None = None
        self._idle: asyncio.Future[None] | None = None
        self._is_cancelled = False
        self._context = context.copy()
        self._closing: asyncio.Task[None] | None = None
        self.task = new_task(self._live(make), loop, self._context)
        self.task.add_done_callback(self._on_end)

    @property
    def name(self) -> str:
        """The env's id, for messages."""
        return self.runner.env.env_id

    # -- requests -----------------------------------------------------------------

    def give(self, entry: int, arguments: Any) -> None:
        """Execute a request; the env must be idle.

        Args:
            entry: of the request.
            arguments: as of `AwaitedRunner.answer`.
        """
        self._request = entry, arguments
        if self._idle is not None and not self._idle.done():
            self._idle.set_result(None)

    async def _live(self, make: Callable[[], AwaitedRunner]) -> None:
        try:
            self.runner = make()
        except BaseException as error:  # Whoever asked for it gets it.
            self.made.set_result(error)
            return
        self.runner.is_abandoned = self.is_leaving
        self.made.set_result(None)
        while not self.is_leaving:
            if self._request is None:
                await self._wait()
            else:
                await self._execute(*self._request)
        if self._is_cancelled:
            self.task.uncancel()  # A timeout in `close` must not take it for its own.
        self.stopped.set_result(None)
        if self._closing is None:
            await self._close()

    async def _wait(self) -> None:
        """Wait for a request."""
        self._idle = self._loop.create_future()
        try:
            await self._idle
        except asyncio.CancelledError:
            if not self.is_leaving:
                self.is_leaving = True
                self._broke(self)
        finally:
            self._idle = None

    async def _execute(self, entry: int, arguments: Any) -> None:
        self.answering = answering = self.runner.answer(op_of(entry), arguments)
        outcome = None
        error: BaseException | None = None
        try:
            outcome = await self._watch(answering, entry)
        except BaseException as raised:  # A CancelledError, too, is the env's own.
            if asyncio.current_task(self._loop) is not self.task:
                raise  # Nobody runs it any more: it is thrown away with its event loop.
            error = raised
        # In the trainer it may be the user's Ctrl-C; a worker gets none.
        if self.runner.inline and isinstance(error, KeyboardInterrupt):
            self._loop.call_soon(reraise, error)
        self._request = self.answering = None
        if not self.is_leaving:
            self._on_outcome(self, entry, outcome, error)
        error = None  # Its traceback refers to this frame.

    # -- the end ------------------------------------------------------------------

    def leave(self) -> None:
        """Cancel what it executes, and close it after that; see `end_all`. Idempotent."""
        if self.is_leaving:
            return
        self.is_leaving = True
        if not self.made.done():
            return
        self.runner.is_abandoned = True
        if self.answering is not None:
            self._is_cancelled = True
            self.task.cancel()
        elif self._idle is not None and not self._idle.done():
            self._idle.set_result(None)

    async def _close(self) -> None:
        try:
            await self.runner.close()
        except BaseException as error:  # Whoever closes it gets it.
            self._close_error = self._close_error or ErrorText.of(error)

    def closing(self) -> asyncio.Task[None]:
        """Return the task that closes it: its own, or another if what it executes continues."""
        if self.stopped.done():
            return self.task
        if self._closing is None:
            self._closing = new_task(self._close(), self._loop, self._context)
        return self._closing

    def cut_short(self, seconds: float) -> None:
        """Cancel its close, which has taken longer than that."""
        self._close_error = _late(f"close() took longer than {seconds:g} s and was cancelled")
        self.closing().cancel()

    @property
    def has_closed(self) -> bool:
        """True if it was closed, well or not."""
        return (self._closing or self.task).done()

    @property
    def close_error(self) -> ErrorText | None:
        """Return what is wrong with an env that should have closed by now."""
        if self._close_error is None and not self.stopped.done():
            return _late("its step or reset goes on although it was cancelled")
        return self._close_error

    def tasks(self) -> list[asyncio.Task[None]]:
        """Return the tasks that execute and close it."""
        return [self.task] if self._closing is None else [self.task, self._closing]

    def _on_end(self, task: asyncio.Task[None]) -> None:
        del task
        for future in (self.made, self.stopped):
            if not future.done():
                future.cancel()


def reraise(error: BaseException) -> NoReturn:
    """Raise an interrupt of an env, called by the event loop: it is meant for the program."""
    raise error


def _late(text: str) -> ErrorText:
    return ErrorText("TimeoutError", text, text)


async def end_all(envs: Collection[AwaitedEnv], seconds: float) -> None:
    """Have envs leave, and wait until they have closed; cut those short that take too long.

    Args:
        envs: of one event loop.
        seconds: how long they may take to close, after `times.CANCEL` at most.
    """
    for env in envs:
        env.leave()
    stopping = [env.stopped for env in envs if not env.stopped.done()]
    if stopping:
        await asyncio.wait(stopping, timeout=times.CANCEL)
    by_task = {env.closing(): env for env in envs}
    late = {task for task in by_task if not task.done()}
    if late:
        late = (await asyncio.wait(late, timeout=seconds))[1]
    for task in late:
        by_task[task].cut_short(seconds)
    if late:
        await asyncio.wait(late, timeout=times.LATE_CANCEL)
