"""`SyncDriver`: waits for a synchronous group, and holds Ctrl-C back.

Rule: Ctrl-C is raised where a call waits, and in the code of an env of this process. Where it comes
while a call moves data, the call ends first, and the signal comes again a moment after that.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple, cast

from rlightning_aio._core.group.drivers.wait import LONGEST_SECONDS, TURN, forked_from, this_process
from rlightning_aio._core.hosts.descriptors import READABLE, WRITABLE, new_descriptor_set
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    import select
    from collections.abc import Callable, Sized
    from types import FrameType

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.hosts.base import Source

T = TypeVar("T")
A = TypeVarTuple("A")

# The functions of `signal` take ten times as long, because they make enums.
_signal: Any = import_module("_signal")
_SIGINT: Final = int(signal.SIGINT)
_MAIN_THREAD: Final = cast("int", threading.main_thread().ident)
_MOMENT: Final = 0.01
"""Seconds after which a Ctrl-C that was held back comes again."""


def press_again() -> None:
    """Send Ctrl-C once more, a moment after the call that held it back has returned."""
    timer = threading.Timer(_MOMENT, signal.pthread_kill, (_MAIN_THREAD, _SIGINT))
    timer.daemon = True
    timer.start()


class SyncDriver:
    """Watches sources with one set of descriptors, and runs procedures until they return."""

    def __init__(self) -> None:
        # The queue of completions, the function that applies them, and the one that stops
        # hardware on Ctrl-C and names the envs for which the call waited; set by the group.
        self.completions: Sized = ()
        self.apply_completions: Callable[[], None]
        self.interrupted: Callable[[float], str]
        self._epoll: select.epoll | None = None
        self._sources: dict[int, Source] = {}
        self._descriptors: dict[Source, int] = {}
        self._pid = os.getpid()
        # The thread that is in a call now; 0 if none is.
        self._thread = 0
        # Ctrl-C may be raised; there was one when it could not be.
        self._is_interruptible = self._is_interrupted = False

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

    def disown(self) -> None:
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

    def _run(self, procedure: Procedure[T]) -> T:
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    if wait is not TURN:  # No other procedure can run.
                        self._block(wait.until)
                        if self.completions:
                            self.apply_completions()
                    self._check_interrupt()
                except BaseException as error:
                    if isinstance(error, KeyboardInterrupt):
                        error.add_note(self.interrupted(time.monotonic()))
                    # Thrown, as a closed generator couldn't wait while cleaning up.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value

    # -- one thread at a time, and Ctrl-C ---------------------------------------------

    def call(self, function: Callable[[*A], T], *args: *A) -> T:
        """Call a function of the group; errors are those of `run`.

        A program that handles SIGINT in its own way continues doing so.
        """
        me = threading.get_ident()
        # No function call before the assignment, so no other thread can run in between.
        if this_process[0] != self._pid or self._thread not in (0, me):
            raise self._refusal()
        outermost, was_interruptible = not self._thread, self._is_interruptible
        holds_back = False
        try:
            self._thread, self._is_interruptible = me, False
            if (
                outermost
                and me == _MAIN_THREAD
                and _signal.getsignal(_SIGINT) is signal.default_int_handler
            ):
                _signal.signal(_SIGINT, self._on_interrupt)
                holds_back = True
            return function(*args)
        finally:
            self._is_interruptible = was_interruptible
            if outermost:
                self._thread = 0
            if holds_back:
                self._stop_holding_back()

    def look(self, function: Callable[..., T], *args: Any) -> T:
        return self.call(function, *args)

    def _stop_holding_back(self) -> None:
        try:
            if _signal.getsignal(_SIGINT) == self._on_interrupt:  # An env may have set another.
                _signal.signal(_SIGINT, signal.default_int_handler)
        except KeyboardInterrupt:  # It came before the call could return.
            self._is_interrupted = True
        # If it is not set, nothing is called from here on, so Python handles no signal before the
        # call returns.
        if self._is_interrupted:
            self._is_interrupted = False
            press_again()

    def _on_interrupt(self, number: int, frame: FrameType | None) -> None:
        """Handle Ctrl-C during a call."""
        del number, frame
        if self._is_interruptible:
            raise KeyboardInterrupt
        self._is_interrupted = True

    def _check_interrupt(self) -> None:
        """Raise a Ctrl-C that came while it could not be raised."""
        if self._is_interrupted:
            self._is_interrupted = False
            raise KeyboardInterrupt

    def interruptible(self, execute: Callable[[], T]) -> T:
        before, self._is_interruptible = self._is_interruptible, True
        try:
            self._check_interrupt()
            return execute()
        finally:
            self._is_interruptible = before

    def others(self, held: object) -> str:
        del held
        return ""

    # -- waiting ----------------------------------------------------------------------

    def _block(self, until: float | None) -> None:
        epoll = self._epoll
        left = LONGEST_SECONDS if until is None else until - time.monotonic()
        seconds = min(max(0.0, left), LONGEST_SECONDS)
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
