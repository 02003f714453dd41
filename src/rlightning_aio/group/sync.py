"""The synchronous `EnvGroup` and the driver that waits in `epoll`.

The same core as the asynchronous one, driven without an event loop and without a
thread: it works in a script, in a thread, and in a notebook cell whose loop is running.
"""

from __future__ import annotations

import os
import select
import threading
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rlightning_aio.errors import RLightningError
from rlightning_aio.group.build import PreprocessFn, plan_group
from rlightning_aio.group.facade import Facade, ServerView, check_process, only_result, steps_of
from rlightning_aio.group.wait import TURN

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from types import TracebackType

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.core import Core
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.hosts.base import Host, Membership, Source
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["EnvGroup", "EnvHandle", "ServerHandle", "SyncDriver"]

T = TypeVar("T")


def _nothing() -> None: ...


class SyncDriver:
    """Watches sources with one persistent epoll and waits for procedures to end."""

    def __init__(self) -> None:
        # Takes in what sources have told; set by the group.
        self.drain: Callable[[], None] = _nothing
        self._epoll: select.epoll | None = None
        self._sources: dict[int, Source] = {}
        self._descriptors: dict[Source, int] = {}
        self._pid = os.getpid()
        # That is in a call now; 0 if none is.
        self._thread = 0

    def check_caller(self) -> None:
        """See `facade.Driver.check_caller`. A signal handler of the thread that waits may ask."""
        check_process(self._pid)
        if self._thread and self._thread != threading.get_ident():
            raise self._in_use()

    def _in_use(self) -> RLightningError:
        return RLightningError(
            f"thread {self._thread} is using this group, and only one may at a time; nothing was "
            "sent; guard the group by a lock, or give each thread a group of its own"
        )

    def watch(self, source: Source) -> None:
        """See `base.Watcher.watch`."""
        epoll = self._epoll or select.epoll()
        descriptor = source.fileno()
        epoll.register(descriptor, select.EPOLLIN)
        self._epoll = epoll
        self._sources[descriptor] = source
        self._descriptors[source] = descriptor

    def unwatch(self, source: Source) -> None:
        """See `base.Watcher.unwatch`."""
        descriptor = self._descriptors.pop(source, None)
        if descriptor is None or self._epoll is None:
            return
        del self._sources[descriptor]
        self._epoll.unregister(descriptor)
        if not self._sources:
            self._epoll.close()
            self._epoll = None

    def watch_writable(self, source: Source, wanted: bool) -> None:
        """See `base.Watcher.watch_writable`."""
        descriptor = self._descriptors.get(source)
        if descriptor is not None and self._epoll is not None:
            events = select.EPOLLIN | select.EPOLLOUT if wanted else select.EPOLLIN
            self._epoll.modify(descriptor, events)

    def wake(self) -> None:
        """See `base.Watcher.wake`. One procedure runs at a time: nobody else waits."""

    def forget(self) -> None:
        """See `facade.Driver.forget`."""
        if self._epoll is not None:
            self._epoll.close()
            self._epoll = None
        self._sources.clear()
        self._descriptors.clear()

    def run(self, procedure: Procedure[T]) -> T:
        """Wait until `procedure` ends; its result. It gets to clean up if it is interrupted.

        Raises:
            RLightningError: another thread is using the group, or it is another process's.
        """
        check_process(self._pid)
        me = threading.get_ident()
        # Nothing is called from here to the note, so that no other thread gets in between.
        outermost = not self._thread
        if outermost:
            self._thread = me
        elif self._thread != me:
            raise self._in_use()
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    if wait is not TURN:  # One procedure runs at a time.
                        self._block(wait.until)
                        self.drain()
                except BaseException as error:
                    # Thrown, not closed: closing down takes waiting, too.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value
        finally:
            if outermost:
                self._thread = 0

    def _block(self, until: float | None) -> None:
        if self._epoll is None:
            if until:
                time.sleep(max(0.0, until - time.monotonic()))
            return
        timeout = -1.0 if until is None else max(0.0, until - time.monotonic())
        epoll = self._epoll
        try:
            found = epoll.poll(timeout)
        except OSError:
            if not epoll.closed:
                raise
            return  # A signal handler has closed the group meanwhile.
        for descriptor, events in found:
            source = self._sources.get(descriptor)
            if source is not None and events & select.EPOLLOUT:
                source.on_writable()
            if source is not None and events & ~select.EPOLLOUT:
                source.on_readable()


class EnvGroup(Facade):
    """Many envs used as one, from plain code: a script, a thread, a notebook cell.

    Make one with `rlightning_aio.sync.build_env_group` and use it as a context manager, which
    initialises it on entry and closes it on exit::

        with build_env_group(load_config("configs/halfcheetah.yaml")) as group:
            batch, _ = group.reset(seed=0)

    Each method returns when it is done; the calling thread waits meanwhile. A wait that Ctrl-C
    interrupts raises KeyboardInterrupt and leaves its results to `collect_async`; one that
    comes while a request is being sent leaves only `close` (docs/faults.md).
    Any thread may use it, one at a time: a call while another thread is in one raises
    RLightningError.
    """

    _driver: SyncDriver

    def _new_driver(self) -> SyncDriver:
        return SyncDriver()

    def init(self) -> list[EnvMeta]:
        """Start all workers, in parallel, and build their envs; return when all are built.

        Returns one `EnvMeta` for each local env, then one without spaces for each env_server,
        in the order of `env_ids`. If it fails or is interrupted, nothing is left running.

        Raises:
            StartFailed: an env could not be built, or took longer than ``start_timeout``.
            ConfigError: the envs' action spaces have different shapes (a `ValueError`).
            GroupClosed: the group was closed before.
        """
        try:
            return self._driver.run(self._core.start(time.monotonic()))
        except BaseException:
            self._closed()
            raise

    def __enter__(self) -> Self:
        self.init()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self._disowned:
            self.close()

    def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        """Start a new episode in all envs, or in those of `env_ids`, and wait for all of them.

        Args:
            seed: env k of the group gets ``seed + k`` (k counts sub-environments); a sequence
                gives one seed for each env, a mapping seeds by id.
            options: passed to each env.
            env_ids: which envs; the results come in this order. None: all local envs, then the
                clients of env_servers, for which it waits.

        Returns the first observations, in fresh arrays (views, where the group was built with
        ``zero_copy``), and flags that are all False. Interrupted, it leaves the results to
        `collect_async`.

        Raises:
            EnvBusy: an env has a reply outstanding, or appears twice; nothing was sent.
            UnknownEnv: no env of this group has that id.
            ValueError: a seed is not an int from 0 to 2**62 - 1, or there isn't one for each env.
            TypeError: the options can't be sent to a worker or a client.
            TimeoutError: too few clients of an env_server have joined in time.
            EnvRaised, WorkerDied, EnvHung, EnvAway: an env failed, or its client is away; the
                others' results are in the error's ``results``.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._driver.run(self._core.reset(time.monotonic(), seed, options, env_ids))

    def step(self, batch: BatchedData) -> tuple[BatchedData, list[bool] | None]:
        """Step the envs of `batch` and wait for all of them.

        Args:
            batch: a batch of responses, from `BatchedData.respond` (columns, fast) or made of
                `PolicyResponse` values; any of the local envs, in any order.

        Returns results with the same ids in the same order, in fresh arrays (views, where the
        group was built with ``zero_copy``), and None; inside `auto_reset` a flag for each
        result. Interrupted, it leaves the results to `collect_async`.

        Raises:
            BadAction: an action's shape, dtype or count doesn't fit; it holds NaN, a number that
                its dtype can't hold, or infinity where its space is bounded; or this is not a
                batch.
                Nothing was sent.
            EnvBusy: an env has a reply outstanding, or appears twice; nothing was sent.
            UnknownEnv: no env of this group has that id.
            NotImplementedError: the env is a client's, which answers when it can.
            EnvRaised, WorkerDied, EnvHung: an env failed; the others' results are in the
                error's ``results``.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._driver.run(self._core.step(batch, time.monotonic()))

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
        """Wait for results of `step_async`; never returns an empty batch.

        The name is that of the asynchronous group's method; this one blocks until it returns.

        Args:
            timeout: seconds of a further window, opened when the first result is ready, in
                which more results join.
            wait_all: wait for all that are pending; `timeout` is ignored then, with a warning.
            min_results: don't return before this many are ready (or all that are pending). None
                is the sum of the config entries' ``min_results``, or 1.
            max_results: leave results above this number to the next call, first come, first
                served.
            deadline: limit in seconds, from now.
            entries: take results of these config entries only; those of others stay.
            ordered: in the group's order instead of that of arrival. With ``wait_all`` that
                makes a run reproducible.

        Returns results, in fresh arrays (views, where the group was built with ``zero_copy``),
        and a flag for each: inside `auto_reset` whether it reached the step limit, which
        `BatchedData.limit_reached` tells as well. Interrupted, it loses no result.

        Raises:
            NothingPending: no request is outstanding (of `entries`), and no client can join.
            UnknownEnv: no config entry has such a name.
            ValueError: a time isn't above 0, a number isn't above 0, or `min_results` is above
                `max_results`.
            TimeoutError: `deadline` has passed; the next call returns the results.
            EnvRaised, WorkerDied, EnvHung: the answer to one request; the results of others
                stay for the next call.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: it was called within itself, as from a signal handler.
        """
        procedure = self._collect(
            timeout, wait_all, min_results, max_results, deadline, entries, ordered
        )
        return self._driver.run(procedure)

    def collect_calls(self, deadline: float | None = None) -> list[Any]:
        """Wait for the values of all calls that `call_async` has sent.

        Args:
            deadline: limit in seconds, from now.

        Returns them in the order in which they were sent: from a worker copies, from an inline
        env the objects themselves. Interrupted, it loses none.

        Raises:
            NothingPending: no call is outstanding.
            TimeoutError: `deadline` has passed; the next `collect_calls` gets the values.
            EnvRaised: a method raised, or its value can't be pickled; what else went wrong is
                in ``others``, and the values of the others are gone.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat the call.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: it was called within itself, as from a signal handler.
        """
        return self._driver.run(self._collect_calls(deadline))

    def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
        """Everything that envs need to continue from here exactly as they would have, as bytes.

        Args:
            env_ids: which envs, all idle and reset before; None: all local ones.

        It holds the simulators' and wrappers' state, their generators, the sums of the current
        episodes, the counters of `auto_reset`, and which envs are due for a reset. docs/state.md
        also says what it leaves out. The bytes can be stored, and `restore` takes them in
        this group or another, in this process or another.

        Raises:
            EnvBusy: an env has a reply outstanding; nothing was sent.
            UnknownEnv: no env of this group has that id.
            SnapshotError: an env is a robot's, or was never reset.
            NotImplementedError: an env is a client's.
            EnvRaised: an env can't give its state; the message says why.
            WorkerDied, EnvHung: a worker ended meanwhile.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None
    ) -> tuple[BatchedData, list[bool]]:
        """Restore envs to the state of a snapshot: all of them, or none.

        Args:
            snapshot: what `snapshot` returned. It holds pickles, which can make a worker execute
                anything: only use what you have written yourself.
            env_ids: into which envs, all idle, in the order of the snapshot's; None: into those
                of the same ids. Any env of an equal entry will do.

        Returns what the envs showed last when the snapshot was taken, as `reset` returns first
        observations: `is_reset`, since no transition ends here, with no reward. Interrupted,
        the envs begin anew with their next step, which says so as after a restart.

        Raises:
            SnapshotError: the bytes are damaged, or of another number of envs, another task,
                other options or another version of a library; nothing was changed.
            EnvBusy: an env has a reply outstanding; nothing was sent.
            UnknownEnv: no env of this group has that id.
            NotImplementedError: an env is a client's.
            EnvRaised, WorkerDied, EnvHung: an env failed; the others are where they were before.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._driver.run(self._core.restore(time.monotonic(), snapshot, env_ids))

    def __getitem__(self, env_id: str) -> EnvHandle:
        """A handle on one env (an `EnvHandle`), or on one env_server (a `ServerHandle`).

        Raises:
            UnknownEnv: the group has neither of that id.
        """
        server = self._core.supervisor.env_server(env_id)
        if server is not None:
            return ServerHandle(self, self._core, self._driver, server)
        self._core.envs.find_one(env_id)
        return EnvHandle(self, self._core, self._driver, env_id)

    def offload(self) -> None:
        """Have every local env free its device memory until `reload`; return when all have.

        Interrupted, it leaves the envs to free it by themselves; `collect_async` has nothing
        of it.

        Raises:
            EnvBusy: an env has a reply outstanding; nothing was sent.
            EnvRaised: an env can't, or failed to; what else went wrong is in ``others``.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat it.
            GroupClosed: the group was not initialised, or is closed.
        """
        self._driver.run(self._core.calls.call_all(time.monotonic(), "offload"))

    def reload(self) -> None:
        """Have every local env take its device memory again; return when all have.

        Interruption and errors are those of `offload`.
        """
        self._driver.run(self._core.calls.call_all(time.monotonic(), "reload"))

    def close(self) -> None:
        """Close all envs and end their workers, by force after a second and a half.

        Idempotent. Returns when nothing is left running; interrupted, it ends what is left by
        force. From a signal handler it closes the group as well; the call that it interrupts
        raises `GroupClosed` if it was waiting. Results that were not collected are gone. An env
        that raises in its own `close` is named in a warning.
        """
        self._driver.run(self._core.close(time.monotonic()))
        self._closed()


class EnvHandle:
    """One env of a synchronous group.

    Each method returns when the env has answered, and raises `EnvBusy` while an earlier reply
    of it is outstanding.
    """

    def __init__(self, group: EnvGroup, core: Core, driver: SyncDriver, env_id: str) -> None:
        self._group = group
        self._core = core
        self._driver = driver
        self._env_id = env_id

    @property
    def env_id(self) -> str:
        """Its id, as in `EnvGroup.env_ids`."""
        return self._env_id

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        """Start a new episode and wait for its first observation.

        Args:
            seed: the env's own; sub-environment k gets ``seed + k`` (counting
                sub-environments).
            options: passed to the env.

        Returns the result as a value; its arrays are as those of `EnvGroup.reset`.
        Interrupted, it leaves the result to the group's `collect_async`. Errors are those of
        `EnvGroup.reset`.
        """
        seeds = None if seed is None else [seed]
        return only_result(self._group.reset(seeds, options, [self.env_id]))

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Returns the result as a value, inside `auto_reset` that of a reset where one is due;
        its arrays are as those of `EnvGroup.step`. Interrupted, it leaves the result to the
        group's `collect_async`. Errors are those of `EnvGroup.step`.
        """
        return only_result(self._group.step(steps_of(self.env_id, response)))

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env, or of the first that has one of its simulator's wrappers,
        from the outermost in, and the simulator.

        Returns its value: from a worker a copy, from an inline env the object itself.
        Interrupted, it leaves the method to end by itself, and its value is dropped.

        Raises:
            EnvRaised: the method raised, or its value can't be pickled.
            EnvBusy: the env has a reply outstanding; nothing was sent.
            TypeError: the arguments can't be sent to a worker; nothing was sent.
            WorkerDied, EnvHung: the worker ended meanwhile; a replacement does not repeat it.
            UnknownEnv: a client that has gone, and another has its place.
            GroupClosed: the group was not initialised, or is closed.
        """
        slot = self._core.envs.find_one(self._env_id)
        procedure = self._core.calls.call(time.monotonic(), slot, (name, args, kwargs))
        return self._driver.run(procedure)

    def get_attr(self, name: str, target: str = "unwrapped") -> Any:
        """Attribute `name` of the simulator; of its outermost wrapper with target ``outer``.

        Returns it as `call` returns a value, and raises what `call` raises.
        """
        return self.call("get_attr", name, target)

    def set_attr(self, name: str, value: Any, target: str = "unwrapped") -> None:
        """Set attribute `name` of the simulator or its outermost wrapper; done on return.

        Raises what `call` raises.
        """
        self.call("set_attr", name, value, target)

    def render(self) -> Any:
        """One frame, as the simulator renders it; raises what `call` raises."""
        return self.call("render")

    def offload(self) -> None:
        """Free its device memory until `reload`; done on return. Raises what `call` raises."""
        self.call("offload")

    def reload(self) -> None:
        """Take its device memory again; done on return. Raises what `call` raises."""
        self.call("reload")


class ServerHandle(ServerView, EnvHandle):
    """An env_server of a synchronous group; its clients' envs have handles of their own.

    Methods of remote envs can't be called: `call`, `get_attr`, `set_attr`, `render`, `offload`
    and `reload` raise NotImplementedError.
    """

    def __init__(
        self,
        group: EnvGroup,
        core: Core,
        driver: SyncDriver,
        server: tuple[Host, Membership],
    ) -> None:
        super().__init__(group, core, driver, server[1].server_id)
        self._server = server
        self._membership = server[1]

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # One for each client.
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[EnvRet | MultiAgentEnvRet]:
        """Reset all clients and wait for them; each env_server must have ``min_clients`` first.

        Args:
            seed: client k, in the order of their names, gets ``seed + k`` (counting
                sub-environments).
            options: passed to each.

        Returns one result for each client, in the order of their names. Interrupted while the
        clients reset, it leaves the results to the group's `collect_async`.

        Raises:
            TimeoutError: too few clients have joined within ``connect_timeout``.
            EnvBusy: a client has a reply outstanding; nothing was sent.
            TypeError: the options can't be sent to a client; nothing was sent.
            EnvRaised, EnvAway: a client's env failed, or the client is away; the others'
                results are in the error's ``results``.
            GroupClosed: the group was not initialised, or is closed.
        """
        procedure = self._core.reset_members(time.monotonic(), self._server, seed, options)
        return self._driver.run(procedure)[0].values()

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Raises NotImplementedError: remote envs answer when they can."""
        raise NotImplementedError(
            f"{self.env_id} is an env_server; use the group's step_async and collect_async"
        )

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Raises NotImplementedError: methods of remote envs can't be called."""
        raise NotImplementedError(f"{self.env_id} is an env_server; it can't call {name}()")


def build_env_group(
    env_cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
) -> EnvGroup:
    """A synchronous group of the configured envs; nothing is started yet.

    Args:
        env_cfgs: an `EnvConfig`, a list of them, plain dicts, or OmegaConf nodes.
        preprocess_fn: turns a `PolicyResponse` into what the simulator steps with; one for
            all, a list with one for each entry, or one for each env. Anything that
            cloudpickle takes.
        mixed_actions: allow envs whose action spaces have different shapes.
        zero_copy: return observations as read-only views, valid until that env's next
            request, where the envs' rows are contiguous.

    Raises:
        ConfigError: something is wrong with the configuration or a preprocess function.
    """
    plan = plan_group(env_cfgs, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy)
    return EnvGroup(plan)
