"""`SyncDriver`: waits for a synchronous group, and holds Ctrl-C back.

Rule: Ctrl-C never stops a call between two changes of the group's state, nor takes its result. It
is raised where the call waits or runs an env in this process, or once the call has done what it can
without waiting, before it hands out results. If it comes after that, the call returns, and the next
one raises it. A second one is raised at once.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from rlightning_aio._core.group.drivers.wait import TURN, forked_from, this_process
from rlightning_aio._core.hosts.descriptors import READABLE, WRITABLE, new_descriptor_set
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    import select
    from collections.abc import Callable, Sized
    from types import FrameType

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.hosts.base import Source

__all__ = ["SyncDriver"]

T = TypeVar("T")
A = TypeVarTuple("A")

# The functions of `signal` take ten times as long, because they make enums.
_signal: Any = import_module("_signal")
_SIGINT: Final = int(signal.SIGINT)
_MAIN_THREAD: Final = threading.main_thread().ident


class SyncDriver:
    """Watches sources with one set of descriptors, and runs procedures until they return."""

    def __init__(self) -> None:
        # The queue of completions, the function that applies them, and the one that names the envs
        # for which a call waits; set by the group.
        self.completions: Sized = ()
        self.apply_completions: Callable[[], None]
        self.awaited: Callable[[float], str]
        self._epoll: select.epoll | None = None
        self._sources: dict[int, Source] = {}
        self._descriptors: dict[Source, int] = {}
        self._pid = os.getpid()
        # The thread that is in a call now; 0 if none is.
        self._thread = 0
        # Ctrl-C may be raised; there was one when it could not be; the next call raises it.
        self._is_interruptible = self._is_interrupted = self._was_interrupted = False

    def check_caller(self) -> None:
        """Check the thread as `GroupDriver` says; signal handlers of the waiting thread pass."""
        if this_process[0] != self._pid or self._thread not in (0, threading.get_ident()):
            raise self._refusal()

    def _refusal(self) -> RLightningError:
        if this_process[0] != self._pid:
            return forked_from(self._pid)
        return RLightningError(
            f"thread {self._thread} is using this group, and only one thread may at a time; "
            "nothing was sent; guard the group with a lock, or give each thread its own group"
        )

    def watch(self, source: Source) -> None:
        epoll = self._epoll or new_descriptor_set()
        descriptor = source.fileno()
        epoll.register(descriptor, READABLE)
        self._epoll = epoll
        self._sources[descriptor] = source
        self._descriptors[source] = descriptor

    def unwatch(self, source: Source) -> None:
        descriptor = self._descriptors.pop(source, None)
        if descriptor is None or self._epoll is None:
            return
        del self._sources[descriptor]
        self._epoll.unregister(descriptor)
        if not self._sources:
            self._epoll.close()
            self._epoll = None

    def watch_writable(self, source: Source, wanted: bool) -> None:
        descriptor = self._descriptors.get(source)
        if descriptor is not None and self._epoll is not None:
            events = READABLE | WRITABLE if wanted else READABLE
            self._epoll.modify(descriptor, events)

    def wake(self) -> None:
        """Do nothing: one procedure runs at a time, so no other call waits."""

    def read(self) -> None:
        self._block(0.0)

    def forget(self) -> None:
        if self._epoll is not None:
            self._epoll.close()
            self._epoll = None
        self._sources.clear()
        self._descriptors.clear()

    def run(self, procedure: Procedure[T]) -> T:
        """Run `procedure` and return its result; an interrupt is thrown into it.

        Raises:
            RLightningError: another thread is using the group, or it belongs to another process.
        """
        return self.call(self._run, procedure)

    def run_last(self, procedure: Procedure[None]) -> None:
        """Run the procedure that closes the group; raise an earlier interrupt after that."""
        was_interrupted, self._was_interrupted = self._was_interrupted, False
        self.run(procedure)
        if was_interrupted:
            raise KeyboardInterrupt

    def _run(self, procedure: Procedure[T]) -> T:
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    if wait is not TURN:  # No other procedure can run.
                        self._block(wait.until)
                        if self.completions:
                            self.apply_completions()
                    self.check_interrupt()
                except BaseException as error:
                    if isinstance(error, KeyboardInterrupt):
                        error.add_note(self.awaited(time.monotonic()))
                    # Thrown, as a closed generator couldn't wait while cleaning up.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value

    def call(self, function: Callable[[*A], T], *args: *A) -> T:
        """Call a function of the group; errors are those of `run`.

        Of an interrupt that it has not raised, the next call hears: it must not take a result or an
        error. Where there is none of these, it is raised at once.
        """
        state = self._enter(hears=True)
        try:
            result = function(*args)
        finally:
            self._leave(*state)
        if result is None and self._was_interrupted:
            self._was_interrupted = False
            raise KeyboardInterrupt
        return result

    def look(self, function: Callable[[*A], T], *args: *A) -> T:
        """Call a function that only looks at the group; an interrupt is for the next `call`."""
        state = self._enter(hears=False)
        try:
            return function(*args)
        finally:
            self._leave(*state)

    # -- one thread at a time, and Ctrl-C ---------------------------------------------

    def _enter(self, *, hears: bool) -> tuple[bool, bool, bool]:
        """Begin a call, which raises an interrupt that the last one has not raised if it `hears`.

        Returns True if it is no call within another; True if it holds back Ctrl-C, as a program
        that handles SIGINT in its own way continues doing so; and True if it was allowed before.
        """
        me = threading.get_ident()
        # No function call before the assignment, so no other thread can run in between.
        if this_process[0] != self._pid or self._thread not in (0, me):
            raise self._refusal()
        outermost, was_interruptible = not self._thread, self._is_interruptible
        try:
            self._thread = me
            holds_back = (
                outermost
                and me == _MAIN_THREAD
                and _signal.getsignal(_SIGINT) is signal.default_int_handler
            )
            if holds_back:
                if hears and self._was_interrupted:
                    self._was_interrupted = False
                    raise KeyboardInterrupt
                self._is_interrupted = False
                _signal.signal(_SIGINT, self._on_interrupt)
            self._is_interruptible = False
        except BaseException:  # Ctrl-C, just before it is held back.
            if outermost:
                self._thread = 0
            raise
        return outermost, holds_back, was_interruptible

    def _leave(self, outermost: bool, holds_back: bool, was_interruptible: bool) -> None:
        self._is_interruptible = was_interruptible
        if outermost:
            self._thread = 0
        if holds_back:
            try:
                self._stop_holding_back()
            except KeyboardInterrupt:  # It came before the call could return.
                self._is_interrupted = True
                self._stop_holding_back()
            # Nothing is called from here on, so Python handles no signal before the call returns.
            self._was_interrupted |= self._is_interrupted
            self._is_interrupted = False

    def _stop_holding_back(self) -> None:
        if _signal.getsignal(_SIGINT) == self._on_interrupt:  # An env may have set another.
            _signal.signal(_SIGINT, signal.default_int_handler)

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle Ctrl-C during a call."""
        del number, frame
        if self._is_interruptible or self._is_interrupted:
            self._is_interrupted = False
            raise KeyboardInterrupt
        self._is_interrupted = True

    def check_interrupt(self) -> None:
        if self._is_interrupted:
            self._is_interrupted = False
            raise KeyboardInterrupt

    def interruptible(self, execute: Callable[[], T]) -> T:
        before, self._is_interruptible = self._is_interruptible, True
        try:
            self.check_interrupt()  # Of a moment ago.
            return execute()
        finally:
            self._is_interruptible = before

    # -- waiting ----------------------------------------------------------------------

    def _block(self, until: float | None) -> None:
        epoll = self._epoll
        seconds = -1.0 if until is None else max(0.0, until - time.monotonic())
        if epoll is None:
            if until:
                self.interruptible(partial(time.sleep, seconds))
            return
        try:
            found = self.interruptible(partial(epoll.poll, seconds))
        except OSError:
            if not epoll.closed:
                raise
            return  # A signal handler closed the group.
        for descriptor, events in found:
            source = self._sources.get(descriptor)
            if source is not None and events & WRITABLE:
                source.on_writable()
            if source is not None and events & ~WRITABLE:
                source.on_readable()
