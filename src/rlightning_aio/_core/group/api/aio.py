"""The asynchronous `EnvGroup`: the methods of `interface` as coroutines.

Left out: rules and documentation. The rules are in the core, the docstrings in `interface`.
"""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from typing import TYPE_CHECKING, Any, Self, TypeVar

from rlightning_aio._core.group.api.episode import Agents, EnvEpisode
from rlightning_aio._core.group.api.facade import response_to
from rlightning_aio._core.group.api.interface import (
    EnvHandleInterface,
    GroupInterface,
    ServerHandle,
)
from rlightning_aio._core.group.drivers.aio_driver import AioDriver
from rlightning_aio._core.group.engine.agent_steps import EpisodeStart, MethodCall
from rlightning_aio._core.group.setup.plan import PreprocessFn, plan_group
from rlightning_aio._core.hosts.awaiting.event_loop import run_loop

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from rlightning_aio._core.group.setup.plan import Plan
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["EnvEpisode", "EnvGroup", "EnvHandle", "ServerHandle"]

T = TypeVar("T")


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

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._agents = Agents(self._core.agent_steps, self._driver)
        self._closing: asyncio.Future[None] | None = None

    def _new_driver(self) -> AioDriver:
        return AioDriver()

    async def init(self) -> list[EnvMeta]:
        self._driver.settle()
        try:
            metas = await self._driver.run(self._core.start(time.monotonic()))
        except BaseException:
            self._after_close()
            raise
        return metas

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
        min_results: int = 1,
        max_results: int | None = None,
        deadline: float | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        procedure = self._collect(timeout, wait_all, min_results, max_results, deadline)
        return await self._driver.run(procedure)

    async def drain(self, deadline: float | None = None) -> tuple[BatchedData, list[bool]]:
        return await self._driver.run(self._drain(deadline))

    async def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
        return await self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    async def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None, source: str | None = None
    ) -> tuple[BatchedData, list[bool]]:
        return await self._driver.run(
            self._core.restore(time.monotonic(), snapshot, env_ids, source)
        )

    def __getitem__(self, env_id: str) -> Any:
        return self._handle(env_id, EnvHandle)

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
        self._core.envs.find_one(env_id)  # An env_server has a handle, too, but no episodes.
        return EnvEpisode(self, self._agents, self[env_id], seed, options)

    async def close(self) -> None:
        other, closing = self._closing, None
        if other is not None and other.get_loop() is asyncio.get_running_loop():
            await asyncio.wait([other])
            return
        if not self._core.lifetime.closed:  # As it is in a forked child, where no loop runs.
            closing = self._closing = asyncio.get_running_loop().create_future()
        try:
            await self._driver.run_last(self._core.close(time.monotonic()))
        finally:
            if closing is not None:
                self._closing = None
                closing.set_result(None)
            self._after_close()


class EnvHandle(EnvHandleInterface):
    """One env of an asynchronous group.

    Each method raises `EnvBusy` while an earlier reply of the env is outstanding.
    """

    async def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        return (await self._asked(EpisodeStart(seed, options))).ret

    async def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        return (await self._asked(response_to(self.env_id, response))).ret

    async def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        return await self._asked(MethodCall(name, args, kwargs))

    async def _asked(self, what: PolicyResponse | EpisodeStart | MethodCall) -> Any:
        return await self._group._agents.asked(self._env_id, what)  # noqa: SLF001


def build_env_group(
    env_cfgs: Any = None,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
    **fields: Any,
) -> EnvGroup:
    """Build a group of the configured envs; nothing is started yet.

    Args:
        env_cfgs: a task's name, a callable that makes an env, an `EnvConfig`, a dict of its
            fields or an OmegaConf node; or a list of these, in which callables that follow one
            another make one entry.
        preprocess_fn: turns a `PolicyResponse` into what the simulator steps with; one for
            all, a list with one for each entry, or one for each env. Anything that
            cloudpickle can pickle.
        mixed_actions: allow envs whose action spaces have different shapes.
        zero_copy: return observations as read-only views, valid until that env's next
            request, if the envs' rows are contiguous.
        fields: of `EnvConfig`, for the one entry of a name or of callables; without `env_cfgs`,
            the whole entry.

    Raises:
        ConfigError: something is wrong with the configuration or a preprocess function.
    """
    plan = plan_group(
        env_cfgs, fields, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy
    )
    return EnvGroup(plan)


def run(main: Coroutine[Any, Any, T]) -> T:
    """Run `main` to its end on a uvloop event loop, or on asyncio's if uvloop is missing.

    SIGTERM, as Slurm and Kubernetes send it, ends it as Ctrl-C does: `main` is cancelled, so groups
    close their envs. `asyncio.to_thread` has up to 256 threads.

    Raises:
        RuntimeError: an event loop already runs in this thread.
    """
    if _is_loop_running():
        main.close()
        raise RuntimeError(
            "an event loop runs here already, as in a notebook: `await` the coroutine instead of "
            "giving it to rlightning_aio.run"
        )
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        return run_loop(main)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        return run_loop(main)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _interrupt(number: int, frame: Any) -> None:
    del number, frame
    signal.raise_signal(signal.SIGINT)


def _is_loop_running() -> bool:
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    return True
