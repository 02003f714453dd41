"""The synchronous `EnvGroup`: the methods of `interface`, blocking.

It runs the same core as the asynchronous group, without an event loop and without a thread, so it
works in a script, in a thread, and in a notebook cell whose loop is running.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Self

from rlightning_aio._core.group.api.facade import only_result, response_to
from rlightning_aio._core.group.api.interface import (
    EnvHandleInterface,
    GroupInterface,
    ServerHandle,
)
from rlightning_aio._core.group.drivers.sync_driver import SyncDriver
from rlightning_aio._core.group.setup.plan import PreprocessFn, plan_group
from rlightning_aio.batch import BatchedData

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.setup.plan import Plan
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

__all__ = ["EnvGroup", "EnvHandle", "ServerHandle", "due_for_reset"]


class EnvGroup(GroupInterface):
    """Many envs used as one, from plain code: a script, a thread, a notebook cell.

    Make one with `rlightning_aio.sync.build_env_group` and use it as a context manager, which
    initialises it on entry and closes it on exit::

        with build_env_group(load_config("configs/halfcheetah.yaml")) as group:
            batch, _ = group.reset(seed=0)

    Each method blocks the calling thread until it is done. Ctrl-C raises KeyboardInterrupt where
    the call waits, or in the code of an inline env; what was in flight is left to `collect_async`,
    and `reset` drops it. If it comes while a call moves data, the call ends first, and Ctrl-C is
    raised a moment after that (docs/faults.md). Any thread may use the group, one at a time: a call
    while another thread is in one raises RLightningError.
    """

    _driver: SyncDriver

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self._driver.interrupted = self._core.interrupted

    def _new_driver(self) -> SyncDriver:
        return SyncDriver()

    def init(self) -> list[EnvMeta]:
        try:
            metas = self._driver.run(self._core.start(time.monotonic()))
        except BaseException:
            self._after_close()
            raise
        return metas

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
        min_results: int = 1,
        max_results: int | None = None,
        deadline: float | None = None,
    ) -> tuple[BatchedData, list[bool]]:
        procedure = self._collect(timeout, wait_all, min_results, max_results, deadline)
        return self._driver.run(procedure)

    def drain(self, deadline: float | None = None) -> tuple[BatchedData, list[bool]]:
        return self._driver.run(self._drain(deadline))

    def snapshot(self, env_ids: Sequence[str] | None = None) -> bytes:
        return self._driver.run(self._core.snapshot(time.monotonic(), env_ids))

    def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None, source: str | None = None
    ) -> tuple[BatchedData, list[bool]]:
        return self._driver.run(self._core.restore(time.monotonic(), snapshot, env_ids, source))

    def __getitem__(self, env_id: str) -> Any:
        return self._handle(env_id, EnvHandle)

    def close(self) -> None:
        try:
            self._driver.run(self._core.close(time.monotonic()))
        finally:
            self._after_close()


class EnvHandle(EnvHandleInterface):
    """One env of a synchronous group.

    Each method raises `EnvBusy` while an earlier reply of the env is outstanding.
    """

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet | MultiAgentEnvRet:
        seeds = None if seed is None else [seed]
        return only_result(self._group.reset(seeds, options, [self.env_id]))

    def step(self, response: PolicyResponse | Any) -> EnvRet | MultiAgentEnvRet:
        batch = BatchedData([self.env_id], [response_to(self.env_id, response)])
        return only_result(self._group.step(batch))

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        return self._group.call_with(name, args, kwargs, [self.env_id])[0]


def due_for_reset(group: EnvGroup) -> NDArray[np.bool_]:
    """Return for each env whether its next step is a reset, while `auto_reset` is open."""
    core = group._core  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # Same module.
    return core.tables.episodes.due.copy()


def build_env_group(
    env_cfgs: Any = None,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None = None,
    mixed_actions: bool = False,
    zero_copy: bool = False,
    **fields: Any,
) -> EnvGroup:
    """Build a synchronous group; nothing is started yet.

    Arguments and errors are those of `rlightning_aio.build_env_group`.
    """
    plan = plan_group(
        env_cfgs, fields, preprocess_fn, mixed_actions=mixed_actions, zero_copy=zero_copy
    )
    return EnvGroup(plan)
