"""The synchronous `EnvGroup`: the methods of `interface`, blocking, and the driver that waits.

It runs the same core as the asynchronous group, without an event loop and without a thread, so it
works in a script, in a thread, and in a notebook cell whose loop is running.

Rule: Ctrl-C never stops a call between two changes of the group's state, nor takes its result. It
is raised where the call waits or runs an env in this process, or once the call has done what it can
without waiting, before it hands out results. If it comes after that, the call returns, and the next
one raises it. A second one is raised at once.
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar, TypeVarTuple

from rlightning_aio._core.group.api.facade import forked_from, only_result, steps_of, this_process
from rlightning_aio._core.group.api.interface import (
    EnvHandleInterface,
    GroupInterface,
    ServerHandleInterface,
)
from rlightning_aio._core.group.drivers.wait import TURN
from rlightning_aio._core.group.setup.plan import PreprocessFn, plan_group
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence, Sized
    from types import FrameType

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.setup.plan import Plan
    from rlightning_aio._core.hosts.base import Source
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["EnvGroup", "EnvHandle", "ServerHandle", "SyncDriver", "driver_of"]

T = TypeVar("T")
A = TypeVarTuple("A")

# The functions of `signal` take ten times as long, because they make enums.
_signal: Any = import_module("_signal")
_SIGINT: Final = int(signal.SIGINT)
_MAIN_THREAD: Final = threading.main_thread().ident


class SyncDriver:
    """Watches sources with one persistent epoll, and runs procedures until they return."""

    def __init__(self) -> None:
        # The queue of completions, the function that applies them, and the one that names the envs
        # for which a call waits; set by the group.
        self.completions: Sized = ()
        self.drain: Callable[[], None]
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
        """Check the thread as `facade.Driver` says; signal handlers of the waiting thread pass."""
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
        epoll = self._epoll or select.epoll()
        descriptor = source.fileno()
        epoll.register(descriptor, select.EPOLLIN)
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
            events = select.EPOLLIN | select.EPOLLOUT if wanted else select.EPOLLIN
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
                            self.drain()
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
        state = self._enter()
        try:
            result = function(*args)
        finally:
            self._leave(*state)
        if result is None and self._was_interrupted:
            self._was_interrupted = False
            raise KeyboardInterrupt
        return result

    # -- one thread at a time, and Ctrl-C ---------------------------------------------

    def _enter(self) -> tuple[bool, bool, bool]:
        """Begin a call.

        Returns True if it is no call within another; True if it holds back Ctrl-C, as a program
        that handles SIGINT in its own way goes on doing so; and True if it was allowed before.
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
                if self._was_interrupted:
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
            self._was_interrupted, self._is_interrupted = self._is_interrupted, False

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
            if source is not None and events & select.EPOLLOUT:
                source.on_writable()
            if source is not None and events & ~select.EPOLLOUT:
                source.on_readable()


class EnvGroup(GroupInterface):
    """Many envs used as one, from plain code: a script, a thread, a notebook cell.

    Make one with `rlightning_aio.sync.build_env_group` and use it as a context manager, which
    initialises it on entry and closes it on exit::

        with build_env_group(load_config("configs/halfcheetah.yaml")) as group:
            batch, _ = group.reset(seed=0)

    Each method blocks the calling thread until it is done. Ctrl-C raises KeyboardInterrupt, leaves
    outstanding results to `collect_async`, and the group remains usable (docs/faults.md). If it
    comes while results are being handed out, the next call raises it. Any thread may use the group,
    one at a time: a call while another thread is in one raises RLightningError.
    """

    _driver: SyncDriver

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._driver.awaited = self._core.awaited

    def _new_driver(self) -> SyncDriver:
        return SyncDriver()

    def init(self) -> list[EnvMeta]:
        try:
            return self._driver.run(self._steps.start(time.monotonic()))
        except BaseException:
            self._closed()
            raise

    def __enter__(self) -> Self:
        self.init()
        return self

    def __exit__(self, *error: object) -> None:
        if not self._disowned:
            self.close()

    def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        return self._driver.run(self._core.reset(time.monotonic(), seed, options, env_ids))

    def step(self, batch: BatchedData) -> tuple[BatchedData, list[bool] | None]:
        return self._driver.run(self._steps.step(batch, time.monotonic()))

    def collect_async(
        self,
        timeout: float | None = None,
        wait_all: bool = False,
        min_results: int | None = None,
        max_results: int | None = None,
        deadline: float | None = None,
        entries: Sequence[str] | None = None,
        ordered: bool = False,
    ) -> tuple[BatchedData, list[bool]]:
        procedure = self._collect(
            timeout, wait_all, min_results, max_results, deadline, entries, ordered
        )
        return self._driver.run(procedure)

    def abort(self, env_ids: Sequence[str] | None = None) -> None:
        self._driver.run(self._core.abort(time.monotonic(), env_ids))

    def drain(self, deadline: float | None = None) -> tuple[BatchedData, list[bool]]:
        return self._driver.run(self._drain(deadline))

    def collect_calls(self, deadline: float | None = None) -> list[Any]:
        return self._driver.run(self._collect_calls(deadline))

    def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
        return self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None
    ) -> tuple[BatchedData, list[bool]]:
        return self._driver.run(self._core.restore(time.monotonic(), snapshot, env_ids))

    def __getitem__(self, env_id: str) -> EnvHandle:
        """Return a handle on one env (`EnvHandle`), or on one env_server (`ServerHandle`).

        Raises:
            UnknownEnv: the group has neither of that id.
        """
        server = self._core.supervisor.members.server(env_id)
        if server is not None:
            return ServerHandle(self, self._core, self._driver, server)
        self._core.envs.find_one(env_id)
        return EnvHandle(self, self._core, self._driver, env_id)

    def offload(self) -> None:
        self._driver.run(self._core.calls.call_all(time.monotonic(), "offload"))

    def reload(self) -> None:
        self._driver.run(self._core.calls.call_all(time.monotonic(), "reload"))

    def close(self) -> None:
        try:
            self._driver.run_last(self._core.close(time.monotonic()))
        finally:
            self._closed()


class EnvHandle(EnvHandleInterface):
    """One env of a synchronous group.

    Each method raises `EnvBusy` while an earlier reply of the env is outstanding.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        seeds = None if seed is None else [seed]
        return self._only(partial(self._group.reset, seeds, options, [self.env_id]))

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        return self._only(partial(self._group.step, steps_of(self.env_id, response)))

    def _only(self, ask: Callable[[], Any]) -> EnvRet | MultiAgentEnvRet:
        """Return the only result of `ask`; a Ctrl-C after the reply doesn't take it."""
        return self._driver.call(lambda: only_result(ask()))

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        slot = self._core.envs.find_one(self._env_id)
        procedure = self._core.calls.call(time.monotonic(), slot, (name, args, kwargs))
        return self._driver.run(procedure)


class ServerHandle(ServerHandleInterface, EnvHandle):
    """An env_server of a synchronous group; its clients' envs have handles of their own.

    Methods of remote envs can't be called: `call`, `get_attr`, `set_attr`, `render`, `offload`
    and `reload` raise NotImplementedError.
    """

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # One for each client.
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[EnvRet | MultiAgentEnvRet]:
        procedure = self._core.reset_members(time.monotonic(), self._server, seed, options)

        def results() -> list[EnvRet | MultiAgentEnvRet]:
            return self._driver.run(procedure)[0].values()

        return self._driver.call(results)


def driver_of(group: EnvGroup) -> SyncDriver:
    """Return the driver of a group, for code that makes one call of several calls."""
    return group._driver  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # Same module.


def build_env_group(
    env_cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
) -> EnvGroup:
    """Build a synchronous group; nothing is started yet.

    Arguments and errors are those of `rlightning_aio.build_env_group`.
    """
    plan = plan_group(env_cfgs, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy)
    return EnvGroup(plan)
