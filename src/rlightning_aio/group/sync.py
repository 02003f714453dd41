"""The synchronous `EnvGroup` and the driver that waits in `epoll`.

The same core as the asynchronous one, driven without an event loop and without a
thread: it works in a script, in a thread, and in a notebook cell whose loop is running.
"""

from __future__ import annotations

import select
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rlightning_aio.group.build import PreprocessFn, plan_group
from rlightning_aio.group.facade import Facade, ServerView, only_result, steps_of

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

    def watch(self, source: Source) -> None:
        """See `base.Watcher.watch`."""
        if self._epoll is None:
            self._epoll = select.epoll()
        descriptor = source.fileno()
        self._sources[descriptor] = source
        self._descriptors[source] = descriptor
        self._epoll.register(descriptor, select.EPOLLIN)

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

    def run(self, procedure: Procedure[T]) -> T:
        """Wait until `procedure` ends; its result. It gets to clean up if it is interrupted."""
        try:
            wait = procedure.send(None)  # pyright: ignore[reportArgumentType]
            while True:
                try:
                    self._block(wait.until)
                    self.drain()
                except BaseException as error:
                    # Thrown, not closed: closing down takes waiting, too.
                    wait = procedure.throw(error)
                else:
                    wait = procedure.send(time.monotonic())
        except StopIteration as stop:
            return stop.value

    def _block(self, until: float | None) -> None:
        if self._epoll is None:
            if until:
                time.sleep(max(0.0, until - time.monotonic()))
            return
        timeout = -1.0 if until is None else max(0.0, until - time.monotonic())
        for descriptor, events in self._epoll.poll(timeout):
            source = self._sources.get(descriptor)
            if source is not None and events & select.EPOLLOUT:
                source.on_writable()
            if source is not None and events & ~select.EPOLLOUT:
                source.on_readable()


class EnvGroup(Facade):
    """Many envs used as one, from plain code; the methods of the asynchronous `EnvGroup`.

    Make one with `rlightning_aio.sync.build_env_group` and use it in a ``with`` block.
    Not thread-safe: use it from one thread at a time.
    """

    _driver: SyncDriver

    def _new_driver(self) -> SyncDriver:
        return SyncDriver()

    def init(self) -> list[EnvMeta]:
        """See `rlightning_aio.EnvGroup.init`."""
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
        self.close()

    def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        """See `rlightning_aio.EnvGroup.reset`."""
        return self._driver.run(self._core.reset(time.monotonic(), seed, options, env_ids))

    def step(self, batch: BatchedData) -> tuple[BatchedData, list[bool] | None]:
        """See `rlightning_aio.EnvGroup.step`."""
        return self._driver.run(self._core.step(batch, time.monotonic()))

    def collect_async(
        self,
        timeout: float | None = None,
        wait_all: bool = False,
        min_results: int = 1,
        max_results: int | None = None,
        deadline: float | None = None,
        entries: Sequence[str] | None = None,
        ordered: bool = False,
    ) -> tuple[BatchedData, list[bool]]:
        """See `rlightning_aio.EnvGroup.collect_async`."""
        procedure = self._collect(
            timeout, wait_all, min_results, max_results, deadline, entries, ordered
        )
        return self._driver.run(procedure)

    def __getitem__(self, env_id: str) -> EnvHandle:
        """A handle on one env, or on one env_server; raises `UnknownEnv`."""
        server = self._core.supervisor.server(env_id)
        if server is not None:
            return ServerHandle(self, self._core, self._driver, server)
        return EnvHandle(self, self._core, self._driver, self._core.envs.find_one(env_id))

    def offload(self) -> None:
        """See `rlightning_aio.EnvGroup.offload`."""
        self._driver.run(self._core.call_all(time.monotonic(), "offload"))

    def reload(self) -> None:
        """See `rlightning_aio.EnvGroup.reload`."""
        self._driver.run(self._core.call_all(time.monotonic(), "reload"))

    def close(self) -> None:
        """See `rlightning_aio.EnvGroup.close`."""
        self._driver.run(self._core.close(time.monotonic()))
        self._closed()


class EnvHandle:
    """One env of a synchronous group; see `rlightning_aio.EnvHandle` for the methods."""

    def __init__(self, group: EnvGroup, core: Core, driver: SyncDriver, slot: int) -> None:
        self._group = group
        self._core = core
        self._driver = driver
        self._slot = slot

    @property
    def env_id(self) -> str:
        """Its id."""
        return self._core.envs.env_ids[self._slot]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        """Start a new episode; `seed` is the env's own."""
        seeds = None if seed is None else [seed]
        return only_result(self._group.reset(seeds, options, [self.env_id]))

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Step with a `PolicyResponse`, or with a bare action."""
        return only_result(self._group.step(steps_of(self.env_id, response)))

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env (or, if it has none, of its simulator); its value."""
        procedure = self._core.call(time.monotonic(), self._slot, name, args, kwargs)
        return self._driver.run(procedure)

    def get_attr(self, name: str, target: str = "unwrapped") -> Any:
        """Attribute `name` of the simulator; of its outermost wrapper with target ``outer``."""
        return self.call("get_attr", name, target)

    def set_attr(self, name: str, value: Any, target: str = "unwrapped") -> None:
        """Set attribute `name` of the simulator or its outermost wrapper; done on return."""
        self.call("set_attr", name, value, target)

    def render(self) -> Any:
        """One frame, as the simulator renders it."""
        return self.call("render")

    def offload(self) -> None:
        """Free device memory until `reload`."""
        self.call("offload")

    def reload(self) -> None:
        """Take device memory again."""
        self.call("reload")


class ServerHandle(ServerView, EnvHandle):
    """An env_server of a synchronous group; see `rlightning_aio.ServerHandle`."""

    def __init__(
        self,
        group: EnvGroup,
        core: Core,
        driver: SyncDriver,
        server: tuple[Host, Membership],
    ) -> None:
        super().__init__(group, core, driver, -1)
        self._server = server
        self._membership = server[1]

    def reset(  # pyright: ignore[reportIncompatibleMethodOverride]  # One for each client.
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> list[EnvRet | MultiAgentEnvRet]:
        """Reset all clients, of which there must be ``min_clients`` within ``connect_timeout``.

        Args:
            seed: client k, in the order of their names, gets ``seed + k`` (counting
                sub-environments).
            options: passed to each.

        Raises:
            TimeoutError: too few clients have joined.
        """
        procedure = self._core.reset_members(time.monotonic(), self._server, seed, options)
        return self._driver.run(procedure)[0].values()

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        """Raises NotImplementedError: remote envs answer when they can."""
        raise NotImplementedError(
            f"{self.env_id} is an env_server; use the group's step_async and collect_async"
        )

    def call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        """Raises NotImplementedError: methods of remote envs can't be called."""
        raise NotImplementedError(f"{self.env_id} is an env_server; it can't call {name}()")


def build_env_group(
    cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
) -> EnvGroup:
    """A synchronous group; see `rlightning_aio.build_env_group`."""
    plan = plan_group(cfgs, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy)
    return EnvGroup(plan)
