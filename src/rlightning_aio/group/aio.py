"""The asynchronous `EnvGroup` and the driver that waits on an asyncio event loop.

A call that waits has one future, and any source (a worker, a fork server, an env_server) fulfils
it. With a future for each source, the cost of a collect would grow with the number of workers.
Absent on purpose: rules. All of them are in the core.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rlightning_aio.errors import RLightningError
from rlightning_aio.group.build import PreprocessFn, plan_group
from rlightning_aio.group.facade import Facade, ServerView, check_process, only_result, steps_of

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence
    from types import TracebackType

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.core import Core
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.hosts.base import Host, Membership, Source
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["AioDriver", "EnvGroup", "EnvHandle", "ServerHandle"]

T = TypeVar("T")


def _nothing() -> None: ...


class AioDriver:
    """Watches sources with `loop.add_reader` and waits for procedures to end.

    It belongs to the loop in which `settle` was called; nobody waits in another.
    """

    def __init__(self) -> None:
        # Takes in what sources have told; set by the group.
        self.drain: Callable[[], None] = _nothing
        # Invariant: the future of those who wait now; None while nobody does. A call that starts
        # to wait gets one that is not done: what was told before is in the core already.
        self._told: asyncio.Future[None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._pid = os.getpid()
        self._descriptors: dict[Source, int] = {}
        self._writing: set[Source] = set()
        # What a source's callback has raised, until somebody is told.
        self._raised: BaseException | None = None

    # -- whose it is --------------------------------------------------------------

    def settle(self) -> None:
        """Belong to the running loop from now on.

        Raises:
            RLightningError: it belongs to another, or to another process.
        """
        check_process(self._pid)
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
        self.check_caller()

    def check_caller(self) -> None:
        """See `facade.Driver.check_caller`. While the loop is not running, plain code may ask."""
        check_process(self._pid)
        ours = self._loop
        if ours is None:
            return  # Not initialised, as the core will say.
        try:
            running = asyncio.get_running_loop()
        except RuntimeError:
            running = None
        if running is not ours and (running or ours.is_running() or ours.is_closed()):
            raise self._elsewhere(ours)

    def move(self) -> None:
        """Belong to the running loop, if the one that it belongs to does not run.

        Raises:
            RLightningError: it runs, in another thread; or it is another process's.
        """
        check_process(self._pid)
        ours, loop = self._loop, asyncio.get_running_loop()
        if ours is None or ours is loop:
            return
        if ours.is_running():
            raise self._elsewhere(ours)
        self.wake()
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

    # -- sources ------------------------------------------------------------------

    def watch(self, source: Source) -> None:
        """See `base.Watcher.watch`."""
        # Not the running loop: a replacement may be started by code that no loop runs.
        assert self._loop is not None
        descriptor = source.fileno()
        self._loop.add_reader(descriptor, self._readable, source)
        self._descriptors[source] = descriptor

    def unwatch(self, source: Source) -> None:
        """See `base.Watcher.unwatch`. A call that waits for `source` wakes."""
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
        """See `base.Watcher.watch_writable`."""
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
        """See `base.Watcher.wake`."""
        told, self._told = self._told, None
        if told is not None and not told.done() and not told.get_loop().is_closed():
            told.set_result(None)

    def forget(self) -> None:
        """See `facade.Driver.forget`."""
        self._descriptors.clear()
        self._writing.clear()

    def _readable(self, source: Source) -> None:
        if source not in self._descriptors:
            return  # This process was forked while the loop ran, and it runs on.
        try:
            source.on_readable()
            self.drain()
        except BaseException as error:
            self._keep(error)
        self.wake()

    def _writable(self, source: Source) -> None:
        if source not in self._writing:
            return  # As above.
        try:
            source.on_writable()
        except BaseException as error:
            self._keep(error)
            self.wake()

    def _keep(self, error: BaseException) -> None:
        """Have the next who waits raise `error`: a loop would log it and let them hang."""
        self._raised = self._raised or error

    def _raise_kept(self) -> None:
        """Raise, once, what a callback has raised."""
        error, self._raised = self._raised, None
        if error is not None:
            raise error

    # -- waiting ------------------------------------------------------------------

    async def run(self, procedure: Procedure[T]) -> T:
        """Wait until `procedure` ends; its result. It gets to clean up if it is cancelled.

        Raises:
            RLightningError: the group belongs to another loop, or to another process.
        """
        self.check_caller()
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    await self._block(wait.until)
                    self._raise_kept()
                    self.drain()
                except BaseException as error:
                    # Thrown, not closed: closing down takes waiting, too.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value

    async def run_last(self, procedure: Procedure[None]) -> None:
        """Wait until the group is closed, in whichever loop.

        What a callback has raised before doesn't keep it from closing, and is raised after.
        """
        self.move()
        kept, self._raised = self._raised, None
        await self.run(procedure)
        if kept is not None:
            raise kept

    async def _block(self, until: float | None) -> None:
        timeout = None if until is None else until - time.monotonic()
        if (timeout is None and not self._descriptors) or (timeout is not None and timeout <= 0):
            await asyncio.sleep(0)
            return
        if self._told is None:
            self._told = asyncio.get_running_loop().create_future()
        await asyncio.wait((self._told,), timeout=timeout, return_when=asyncio.FIRST_COMPLETED)


class EnvGroup(Facade):
    """Many envs used as one, from an asyncio event loop.

    Make one with `build_env_group` and use it as a context manager, which initialises it on
    entry and closes it on exit::

        async with build_env_group(load_config("configs/halfcheetah.yaml")) as group:
            batch, _ = await group.reset(seed=0)

    It belongs to the loop that initialised it: use from another, or from another thread, raises
    RLightningError. `close` works in any loop, unless its own is running elsewhere.
    """

    _driver: AioDriver
    _shares_thread = True

    def _new_driver(self) -> AioDriver:
        return AioDriver()

    async def init(self) -> list[EnvMeta]:
        """Start all workers, in parallel, and build their envs.

        Returns one `EnvMeta` for each local env, then one without spaces for each env_server,
        in the order of `env_ids`. If it fails or is cancelled, nothing is left running.

        Raises:
            StartFailed: an env could not be built, or took longer than ``start_timeout``.
            ConfigError: the envs' action spaces have different shapes (a `ValueError`).
            GroupClosed: the group was closed before.
            RLightningError: another event loop has initialised the group.
        """
        self._driver.settle()
        try:
            return await self._driver.run(self._core.start(time.monotonic()))
        except BaseException:
            self._closed()
            raise

    async def __aenter__(self) -> Self:
        await self.init()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if not self._disowned:
            await self.close()

    async def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        """Start a new episode in all envs, or in those of `env_ids`.

        Args:
            seed: env k of the group gets ``seed + k`` (k counts sub-environments); a sequence
                gives one seed for each env, a mapping seeds by id.
            options: passed to each env.
            env_ids: which envs; the results come in this order. None: all local envs, then the
                clients of env_servers, for which it waits.

        Returns the first observations, in fresh arrays (views, where the group was built with
        ``zero_copy``), and flags that are all False. Cancelled, it leaves the results to
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
        return await self._driver.run(self._core.reset(time.monotonic(), seed, options, env_ids))

    async def step(self, batch: BatchedData) -> tuple[BatchedData, list[bool] | None]:
        """Step the envs of `batch` and wait for all of them.

        Args:
            batch: a batch of responses, from `BatchedData.respond` (columns, fast) or made of
                `PolicyResponse` values; any of the local envs, in any order.

        Returns results with the same ids in the same order, in fresh arrays (views, where the
        group was built with ``zero_copy``), and None; inside `auto_reset` a flag for each
        result. Cancelled, it leaves the results to `collect_async`.

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
        return await self._driver.run(self._core.step(batch, time.monotonic()))

    async def collect_async(
        self,
        timeout: float | None = None,  # noqa: ASYNC109  # Of the window, not of the call.
        wait_all: bool = False,
        min_results: int | None = None,
        max_results: int | None = None,
        deadline: float | None = None,
        entries: Sequence[str] | None = None,
        ordered: bool = False,
    ) -> tuple[BatchedData, list[bool]]:
        """Wait for results of `step_async`; never returns an empty batch.

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
        `BatchedData.limit_reached` tells as well. Cancelling loses no result.

        Raises:
            NothingPending: no request is outstanding (of `entries`), and no client can join.
            UnknownEnv: no config entry has such a name.
            ValueError: a time isn't above 0, a number isn't above 0, or `min_results` is above
                `max_results`.
            TimeoutError: `deadline` has passed; the next call returns the results.
            EnvRaised, WorkerDied, EnvHung: the answer to one request; the results of others
                stay for the next call.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another collector is waiting.
        """
        procedure = self._collect(
            timeout, wait_all, min_results, max_results, deadline, entries, ordered
        )
        return await self._driver.run(procedure)

    async def collect_calls(self, deadline: float | None = None) -> list[Any]:
        """Wait for the values of all calls that `call_async` has sent.

        Args:
            deadline: limit in seconds, from now.

        Returns them in the order in which they were sent: from a worker copies, from an inline
        env the objects themselves. Cancelled, it loses none.

        Raises:
            NothingPending: no call is outstanding.
            TimeoutError: `deadline` has passed; the next `collect_calls` gets the values.
            EnvRaised: a method raised, or its value can't be pickled; what else went wrong is
                in ``others``, and the values of the others are gone.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat the call.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another task is waiting in it.
        """
        return await self._driver.run(self._collect_calls(deadline))

    async def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
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
        return await self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    async def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None
    ) -> tuple[BatchedData, list[bool]]:
        """Restore envs to the state of a snapshot: all of them, or none.

        Args:
            snapshot: what `snapshot` returned. It holds pickles, which can make a worker execute
                anything: only use what you have written yourself.
            env_ids: into which envs, all idle, in the order of the snapshot's; None: into those
                of the same ids. Any env of an equal entry will do.

        Returns the envs' last observations at the time of the snapshot, as `reset` returns first
        observations: with `is_reset`, because no transition ends here, and without reward. If it
        is cancelled, the envs start a new episode with their next step, marked as after a
        restart.

        Raises:
            SnapshotError: the bytes are damaged, or of another number of envs, another task,
                other options or another version of a library; nothing was changed.
            EnvBusy: an env has a reply outstanding; nothing was sent.
            UnknownEnv: no env of this group has that id.
            NotImplementedError: an env is a client's.
            EnvRaised, WorkerDied, EnvHung: an env failed; the others are where they were before.
            GroupClosed: the group was not initialised, or is closed.
        """
        return await self._driver.run(self._core.restore(time.monotonic(), snapshot, env_ids))

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

    async def offload(self) -> None:
        """Make every local env free its device memory until `reload`; done when it returns.

        Cancelled, it leaves the envs to free it by themselves; `collect_async` has nothing of
        it.

        Raises:
            EnvBusy: an env has a reply outstanding; nothing was sent.
            EnvRaised: an env can't, or failed to; what else went wrong is in ``others``.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat it.
            GroupClosed: the group was not initialised, or is closed.
        """
        await self._driver.run(self._core.calls.call_all(time.monotonic(), "offload"))

    async def reload(self) -> None:
        """Make every local env allocate its device memory again; done when it returns.

        Cancellation and errors are those of `offload`.
        """
        await self._driver.run(self._core.calls.call_all(time.monotonic(), "reload"))

    async def close(self) -> None:
        """Close all envs and end their workers, by force after a second and a half.

        Idempotent. A task that waits on the group gets `GroupClosed`; results that were not
        collected are gone. Cancelled, it ends what is left by force. An env that raises in its
        own `close` is named in a warning.

        Raises:
            RLightningError: the loop that the group belongs to runs in another thread.
        """
        try:
            await self._driver.run_last(self._core.close(time.monotonic()))
        finally:
            self._closed()


class EnvHandle:
    """One env of an asynchronous group.

    Each method is done when the env has answered, and raises `EnvBusy` while an earlier reply
    of it is outstanding.
    """

    def __init__(self, group: EnvGroup, core: Core, driver: AioDriver, env_id: str) -> None:
        self._group = group
        self._core = core
        self._driver = driver
        self._env_id = env_id

    @property
    def env_id(self) -> str:
        """Its id, as in `EnvGroup.env_ids`."""
        return self._env_id

    async def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        """Start a new episode and wait for its first observation.

        Args:
            seed: the env's own; sub-environment k gets ``seed + k`` (counting
                sub-environments).
            options: passed to the env.

        Returns the result as a value; its arrays are as those of `EnvGroup.reset`. Cancelled,
        it leaves the result to the group's `collect_async`. Errors are those of
        `EnvGroup.reset`.
        """
        seeds = None if seed is None else [seed]
        return only_result(await self._group.reset(seeds, options, [self.env_id]))

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Returns the result as a value, inside `auto_reset` that of a reset where one is due;
        its arrays are as those of `EnvGroup.step`. Cancelled, it leaves the result to the
        group's `collect_async`. Errors are those of `EnvGroup.step`.
        """
        return only_result(await self._group.step(steps_of(self.env_id, response)))

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env, or of the first that has one of its simulator's wrappers,
        from the outermost in, and the simulator.

        Returns its value: from a worker a copy, from an inline env the object itself.
        Cancelled, it leaves the method to end by itself, and its value is dropped.

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
        return await self._driver.run(procedure)

    async def get_attr(self, name: str, target: str = "unwrapped") -> Any:
        """Attribute `name` of the simulator; of its outermost wrapper with target ``outer``.

        Returns it as `call` returns a value, and raises what `call` raises.
        """
        return await self.call("get_attr", name, target)

    async def set_attr(self, name: str, value: Any, target: str = "unwrapped") -> None:
        """Set attribute `name` of the simulator or its outermost wrapper; done on return.

        Raises what `call` raises.
        """
        await self.call("set_attr", name, value, target)

    async def render(self) -> Any:
        """One frame, as the simulator renders it; raises what `call` raises."""
        return await self.call("render")

    async def offload(self) -> None:
        """Free its device memory until `reload`; done on return. Raises what `call` raises."""
        await self.call("offload")

    async def reload(self) -> None:
        """Take its device memory again; done on return. Raises what `call` raises."""
        await self.call("reload")


class ServerHandle(ServerView, EnvHandle):
    """An env_server of an asynchronous group; its clients' envs have handles of their own.

    Methods of remote envs can't be called: `call`, `get_attr`, `set_attr`, `render`, `offload`
    and `reload` raise NotImplementedError.
    """

    def __init__(
        self,
        group: EnvGroup,
        core: Core,
        driver: AioDriver,
        server: tuple[Host, Membership],
    ) -> None:
        super().__init__(group, core, driver, server[1].server_id)
        self._server = server
        self._membership = server[1]

    async def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # One for each client.
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[EnvRet | MultiAgentEnvRet]:
        """Reset all clients and wait for them; each env_server must have ``min_clients`` first.

        Args:
            seed: client k, in the order of their names, gets ``seed + k`` (counting
                sub-environments).
            options: passed to each.

        Returns one result for each client, in the order of their names. Cancelled while the
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
        return (await self._driver.run(procedure))[0].values()

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Raises NotImplementedError: remote envs answer when they can."""
        raise NotImplementedError(
            f"{self.env_id} is an env_server; use the group's step_async and collect_async"
        )

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Raises NotImplementedError: methods of remote envs can't be called."""
        raise NotImplementedError(f"{self.env_id} is an env_server; it can't call {name}()")


def build_env_group(
    env_cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
) -> EnvGroup:
    """A group of the configured envs; nothing is started yet.

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


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a uvloop event loop (or asyncio's, where uvloop is missing).

    Raises:
        RuntimeError: an event loop runs already in this thread.
    """
    if _is_loop_running():
        main.close()
        raise RuntimeError(
            "an event loop runs here already, as in a notebook: `await` the coroutine instead of "
            "giving it to rlightning_aio.run"
        )
    try:
        import uvloop  # noqa: PLC0415  # There is none for Windows.
    except ImportError:
        return asyncio.run(main)
    return uvloop.run(main)


def _is_loop_running() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True
