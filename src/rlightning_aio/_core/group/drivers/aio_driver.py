"""`AioDriver`: waits for an asynchronous group, on its event loop."""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rlightning_aio._core.group.drivers.wait import (
    LONGEST_SECONDS,
    Patient,
    forked_from,
    this_process,
)
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Sized

    from rlightning_aio._core.group.drivers.wait import Procedure, Wait
    from rlightning_aio._core.hosts.base import Source

T = TypeVar("T")


def _wake(woken: asyncio.Future[None]) -> None:
    if not woken.done() and not woken.get_loop().is_closed():
        woken.set_result(None)


class AioDriver:
    """Watches sources with `loop.add_reader`, and runs procedures until they return.

    Each waiting call has one future that any source (a worker, a fork server, an env_server) sets.
    With one future per source, the cost of a collect would grow with the number of workers. Calls
    don't share futures, so cancelling one call doesn't affect the others.

    The driver belongs to the event loop that ran when `settle` was called.
    """

    def __init__(self) -> None:
        # The queue of completions, and the function that applies them; set by the group.
        self.completions: Sized = ()
        self.apply_completions: Callable[[], None]
        # The future of each waiting call, until it is woken.
        self._waiting: list[asyncio.Future[None]] = []
        self._nudge: asyncio.TimerHandle | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pid = os.getpid()
        self._descriptors: dict[Source, int] = {}
        self._writing: set[Source] = set()
        # An error from a source's callback, until a call raises it.
        self._raised: BaseException | None = None

    # -- ownership --------------------------------------------------------------

    def settle(self) -> None:
        """Bind the driver to the running loop.

        Raises:
            RLightningError: it belongs to another loop, or to another process.
        """
        if this_process[0] != self._pid:
            raise forked_from(self._pid)
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
        self.check_caller()

    def check_caller(self) -> None:
        """Check the loop as `GroupDriver` says; plain code may call while the loop is stopped."""
        if this_process[0] != self._pid:
            raise forked_from(self._pid)
        ours = self._loop
        if ours is None:
            return  # Not initialised; the core raises.
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:
            running = None
        if running is not ours and (running or ours.is_running() or ours.is_closed()):
            raise self._elsewhere(ours)

    def call(self, function: Callable[..., T], *args: Any) -> T:
        """Call a function that doesn't wait, after `check_caller`."""
        self.check_caller()
        return function(*args)

    def look(self, function: Callable[..., T], *args: Any) -> T:
        """Call a function that only looks at the group, which may outlive its loop."""
        if self._loop is None or not self._loop.is_closed() or this_process[0] != self._pid:
            self.check_caller()
        return function(*args)

    def interruptible(self, execute: Callable[[], T]) -> T:
        """Call a function that runs an env; asyncio handles Ctrl-C."""
        return execute()

    def move(self) -> None:
        """Bind the driver to the running loop, if its own loop is not running.

        Raises:
            RLightningError: its loop runs in another thread, or it belongs to another process.
        """
        if this_process[0] != self._pid:
            raise forked_from(self._pid)
        ours, loop = self._loop, asyncio.get_running_loop()
        if ours is None or ours is loop:
            return
        if ours.is_running():
            raise self._elsewhere(ours)
        self.wake()
        self._end_nudge()
        self._loop = loop
        for source, descriptor in self._descriptors.items():
            self._forget(ours, descriptor)
            loop.add_reader(descriptor, self._readable, source)
            if source in self._writing:
                loop.add_writer(descriptor, self._writable, source)

    def _elsewhere(self, ours: asyncio.AbstractEventLoop) -> RLightningError:
        if ours.is_closed():
            state = "is closed"
            do = "build, use and close a group within one asyncio.run(), or use rlightning_aio.sync"
        elif ours.is_running():
            state = "runs in another thread"
            do = "pass work to it with asyncio.run_coroutine_threadsafe()"
        else:
            state = "is not running"
            do = "use it there, or close it and build another here"
        return RLightningError(
            f"this group belongs to the event loop that initialised it ({ours!r}), which {state}; "
            f"{do}; nothing was sent"
        )

    def others(self, held: object) -> str:
        """See `base.Driver.others`; also say where the tasks wait. Only errors ask for them."""
        loop, found = self._loop, list[str]()
        for task in asyncio.all_tasks(loop) if loop is not None and loop.is_running() else ():
            where, holds, step = "", False, task.get_coro()
            while (frame := getattr(step, "cr_frame", getattr(step, "gi_frame", None))) is not None:
                holds = holds or any(value is held for value in frame.f_locals.values())
                if not frame.f_globals.get("__name__", "").startswith("rlightning_aio."):
                    where = f"{frame.f_code.co_filename}:{frame.f_lineno}"
                inner = getattr(step, "cr_await", getattr(step, "gi_yieldfrom", None))
                step = frame.f_locals["procedure"] if frame.f_code is _RUN else inner
            if holds and task is not asyncio.current_task():
                found.append(f"task {task.get_name()!r} ({where})")
        if not found:
            return ""
        return (
            f"; it waits in {' and '.join(found)}, which asyncio.all_tasks() has, to be awaited or "
            "cancelled"
        )

    # -- sources ------------------------------------------------------------------

    def watch(self, source: Source) -> None:
        # The running loop won't do: plain code may start a replacement while no loop runs.
        assert self._loop is not None
        descriptor = source.fileno()
        self._loop.add_reader(descriptor, self._readable, source)
        self._descriptors[source] = descriptor

    def unwatch(self, source: Source) -> None:
        """Stop watching `source`, and wake calls that wait for it."""
        descriptor = self._descriptors.pop(source, None)
        if descriptor is None or self._loop is None:
            return
        self._forget(self._loop, descriptor)
        self._writing.discard(source)
        self.wake()

    @staticmethod
    def _forget(loop: asyncio.AbstractEventLoop, descriptor: int) -> None:
        if not loop.is_closed():
            loop.remove_reader(descriptor)
            loop.remove_writer(descriptor)

    def watch_writable(self, source: Source, wanted: bool) -> None:
        descriptor = self._descriptors.get(source)
        if descriptor is None or self._loop is None:
            return
        if wanted:
            self._writing.add(source)
            self._loop.add_writer(descriptor, self._writable, source)
        elif source in self._writing:
            self._writing.discard(source)
            self._loop.remove_writer(descriptor)

    def wake(self) -> None:
        waiting, self._waiting = self._waiting, []
        for woken in waiting:
            _wake(woken)

    def read(self) -> None:
        """Do nothing: the loop reads."""

    def disown(self) -> None:
        self._descriptors.clear()
        self._writing.clear()

    def _readable(self, source: Source) -> None:
        if source not in self._descriptors:
            return  # In a child forked while the loop ran, which still runs there.
        try:
            source.on_readable()
            if self.completions:
                self.apply_completions()
        except BaseException as error:
            self._keep(error)
        self.wake()

    def _writable(self, source: Source) -> None:
        if source not in self._writing:
            return  # In a forked child, as in `_readable`.
        try:
            source.on_writable()
        except BaseException as error:
            self._keep(error)
            self.wake()

    def _keep(self, error: BaseException) -> None:
        """Keep `error` for the next call that waits, as the loop would only log it."""
        self._raised = self._raised or error

    def _raise_kept(self) -> None:
        """Raise the error of a callback, once."""
        error, self._raised = self._raised, None
        if error is not None:
            raise error

    # -- waiting ------------------------------------------------------------------

    async def run(self, procedure: Procedure[T]) -> T:
        """Run `procedure` and return its result; cancellation is thrown into it.

        Raises:
            RLightningError: the group belongs to another loop, or to another process.
        """
        self.check_caller()
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    await self._block(wait)
                    if self._raised is not None:
                        await asyncio.sleep(0)  # Let the loop read the source again.
                        self._raise_kept()
                    if self.completions:
                        self.apply_completions()
                except BaseException as error:
                    # Thrown, as a closed generator couldn't wait while cleaning up.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value

    async def run_last(self, procedure: Procedure[None]) -> None:
        """Run the procedure that closes the group, on any loop.

        An earlier error of a callback is raised after the group is closed.
        """
        self.move()
        kept, self._raised = self._raised, None
        await self.run(procedure)
        self._end_nudge()
        if kept is not None:
            raise kept

    def _end_nudge(self) -> None:
        if self._nudge is not None:
            self._nudge.cancel()
            self._nudge = None

    def _on_nudge(self) -> None:
        """Wake calls that wait patiently, as they may have waited for long."""
        self._nudge = None
        self.wake()

    async def _block(self, wait: Wait) -> None:
        timeout = None
        if wait.until is not None:
            timeout = min(wait.until - time.monotonic(), LONGEST_SECONDS)
        if timeout is not None and timeout <= 0:
            await asyncio.sleep(0)
            return
        loop = asyncio.get_running_loop()
        woken = loop.create_future()
        timer = None
        if type(wait) is Patient:
            if timeout is not None and self._nudge is None:
                self._nudge = loop.call_later(timeout, self._on_nudge)
        elif timeout is not None:
            timer = loop.call_later(timeout, _wake, woken)
        self._waiting.append(woken)
        try:
            await woken
        finally:
            if woken in self._waiting:
                self._waiting.remove(woken)
            if timer is not None:
                timer.cancel()


_RUN: Final = AioDriver.run.__code__
"""The frames of calls that wait."""
