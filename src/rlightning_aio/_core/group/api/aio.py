"""The asynchronous `EnvGroup`: the methods of `interface` as coroutines, and the driver that waits.

Left out: rules and documentation. The rules are in the core, the docstrings in `interface`.
"""

from __future__ import annotations

import asyncio
import os
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rlightning_aio._core.group.api.episode import EnvEpisode
from rlightning_aio._core.group.api.facade import forked_from, only_result, steps_of, this_process
from rlightning_aio._core.group.api.interface import (
    EnvHandleInterface,
    GroupInterface,
    ServerHandleInterface,
)
from rlightning_aio._core.group.setup.plan import PreprocessFn, plan_group
from rlightning_aio._core.hosts.awaiting.event_loop import run_loop
from rlightning_aio.errors import RLightningError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence, Sized

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.hosts.base import Source
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["AioDriver", "EnvEpisode", "EnvGroup", "EnvHandle", "ServerHandle"]

T = TypeVar("T")


def _wake(woken: asyncio.Future[None]) -> None:
    if not woken.done():
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
        self.drain: Callable[[], None]
        # The future of each waiting call, until it is woken.
        self._waiting: list[asyncio.Future[None]] = []
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
        """Check the loop as `facade.Driver` says; plain code may call while the loop is stopped."""
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

    def call(self, function: Callable[..., None], *args: Any) -> None:
        """Call a function that doesn't wait, after `check_caller`."""
        self.check_caller()
        function(*args)

    def interruptible(self, execute: Callable[[], T]) -> T:
        """Call a function that runs an env; asyncio handles Ctrl-C."""
        return execute()

    def check_interrupt(self) -> None:
        """Do nothing: asyncio handles Ctrl-C."""

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
            if not woken.done() and not woken.get_loop().is_closed():
                woken.set_result(None)

    def read(self) -> None:
        """Do nothing: the loop reads."""

    def forget(self) -> None:
        self._descriptors.clear()
        self._writing.clear()

    def _readable(self, source: Source) -> None:
        if source not in self._descriptors:
            return  # In a child forked while the loop ran, which still runs there.
        try:
            source.on_readable()
            if self.completions:
                self.drain()
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
                    await self._block(wait.until)
                    if self._raised is not None:
                        await asyncio.sleep(0)  # Let the loop read the source again.
                        self._raise_kept()
                    if self.completions:
                        self.drain()
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
        if kept is not None:
            raise kept

    async def _block(self, until: float | None) -> None:
        timeout = None if until is None else until - time.monotonic()
        if timeout is not None and timeout <= 0:
            await asyncio.sleep(0)
            return
        loop = asyncio.get_running_loop()
        woken = loop.create_future()
        timer = None if timeout is None else loop.call_later(timeout, _wake, woken)
        self._waiting.append(woken)
        try:
            await woken
        finally:
            if woken in self._waiting:
                self._waiting.remove(woken)
            if timer is not None:
                timer.cancel()


class EnvGroup(GroupInterface):
    """Many envs used as one, from an asyncio event loop.

    Make one with `build_env_group` and use it as a context manager, which initialises it on
    entry and closes it on exit::

        async with build_env_group(load_config("configs/halfcheetah.yaml")) as group:
            batch, _ = await group.reset(seed=0)

    The group belongs to the loop that initialised it: use from another loop, or from another
    thread, raises RLightningError. `close` works in any loop, unless the group's own loop is
    running in another thread.
    """

    _driver: AioDriver
    _shares_thread = True

    def _new_driver(self) -> AioDriver:
        return AioDriver()

    async def init(self) -> list[EnvMeta]:
        self._driver.settle()
        try:
            return await self._driver.run(self._steps.start(time.monotonic()))
        except BaseException:
            self._closed()
            raise

    async def __aenter__(self) -> Self:
        await self.init()
        return self

    async def __aexit__(self, *error: object) -> None:
        if not self._disowned:
            await self.close()

    async def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        return await self._driver.run(self._core.reset(time.monotonic(), seed, options, env_ids))

    async def step(self, batch: BatchedData) -> tuple[BatchedData, list[bool] | None]:
        return await self._driver.run(self._steps.step(batch, time.monotonic()))

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
        procedure = self._collect(
            timeout, wait_all, min_results, max_results, deadline, entries, ordered
        )
        return await self._driver.run(procedure)

    async def abort(self, env_ids: Sequence[str] | None = None) -> None:
        await self._driver.run(self._core.abort(time.monotonic(), env_ids))

    async def drain(self, deadline: float | None = None) -> tuple[BatchedData, list[bool]]:
        return await self._driver.run(self._drain(deadline))

    async def collect_calls(self, deadline: float | None = None) -> list[Any]:
        return await self._driver.run(self._collect_calls(deadline))

    async def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
        return await self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    async def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None
    ) -> tuple[BatchedData, list[bool]]:
        return await self._driver.run(self._core.restore(time.monotonic(), snapshot, env_ids))

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

    def episode(
        self, env_id: str, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvEpisode:
        """Play one episode of one env, in an agent that is one coroutine for each env::

            async with group.episode("tools-3", seed=7) as episode:
                while not episode.is_over:
                    await episode.step(await choose(episode.last.observation))

        On entry the env is reset. On exit it is idle: a step that is in flight, because the agent
        was cancelled or raised, is aborted (see `abort`). Other envs can be collected in batches
        meanwhile.

        Args:
            env_id: which env, idle.
            seed: of its reset.
            options: passed to the env.

        Raises:
            UnknownEnv: no env of this group has that id.
        """
        return EnvEpisode(self, self[env_id], seed, options)

    async def offload(self) -> None:
        await self._driver.run(self._core.calls.call_all(time.monotonic(), "offload"))

    async def reload(self) -> None:
        await self._driver.run(self._core.calls.call_all(time.monotonic(), "reload"))

    async def close(self) -> None:
        try:
            await self._driver.run_last(self._core.close(time.monotonic()))
        finally:
            self._closed()


class EnvHandle(EnvHandleInterface):
    """One env of an asynchronous group.

    Each method raises `EnvBusy` while an earlier reply of the env is outstanding.
    """

    async def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        seeds = None if seed is None else [seed]
        return only_result(await self._group.reset(seeds, options, [self.env_id]))

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        return only_result(await self._group.step(steps_of(self.env_id, response)))

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        slot = self._core.envs.find_one(self._env_id)
        procedure = self._core.calls.call(time.monotonic(), slot, (name, args, kwargs))
        return await self._driver.run(procedure)

    async def get_attr(self, name: str, target: str = "unwrapped") -> Any:
        return await super().get_attr(name, target)

    async def set_attr(self, name: str, value: Any, target: str = "unwrapped") -> None:
        await super().set_attr(name, value, target)

    async def render(self) -> Any:
        return await super().render()

    async def offload(self) -> None:
        await super().offload()

    async def reload(self) -> None:
        await super().reload()


class ServerHandle(ServerHandleInterface, EnvHandle):
    """An env_server of an asynchronous group; its clients' envs have handles of their own.

    Methods of remote envs can't be called: `call`, `get_attr`, `set_attr`, `render`, `offload`
    and `reload` raise NotImplementedError.
    """

    async def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # One for each client.
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[EnvRet | MultiAgentEnvRet]:
        procedure = self._core.reset_members(time.monotonic(), self._server, seed, options)
        return (await self._driver.run(procedure))[0].values()


def build_env_group(
    env_cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
) -> EnvGroup:
    """Build a group of the configured envs; nothing is started yet.

    Args:
        env_cfgs: an `EnvConfig`, a list of them, plain dicts, or OmegaConf nodes.
        preprocess_fn: turns a `PolicyResponse` into what the simulator steps with; one for
            all, a list with one for each entry, or one for each env. Anything that
            cloudpickle can pickle.
        mixed_actions: allow envs whose action spaces have different shapes.
        zero_copy: return observations as read-only views, valid until that env's next
            request, if the envs' rows are contiguous.

    Raises:
        ConfigError: something is wrong with the configuration or a preprocess function.
    """
    plan = plan_group(env_cfgs, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy)
    return EnvGroup(plan)


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a uvloop event loop, or on asyncio's if uvloop is missing.

    Raises:
        RuntimeError: an event loop already runs in this thread.
    """
    if _is_loop_running():
        main.close()
        raise RuntimeError(
            "an event loop runs here already, as in a notebook: `await` the coroutine instead of "
            "giving it to rlightning_aio.run"
        )
    return run_loop(main)


def _is_loop_running() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True
