"""`AwaitedRunner`: executes requests on one env whose `reset` and `step` are coroutine functions.

It is an `EnvRunner` that awaits what its env returns, and that another env may replace meanwhile.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts.messages import EnvState
from rlightning_aio._core.hosts.running.runner import EnvRunner, loaded
from rlightning_aio.envs.hardware import stop_all
from rlightning_aio.protocol.entries import answers_with_value
from rlightning_aio.protocol.pickling import dumped

if TYPE_CHECKING:
    from rlightning_aio._core.hosts.running.row_writer import Execute, ShownResult


class Abandoned(Exception):
    """The env was replaced while it was executing a request; its result is dropped."""


class AwaitedRunner(EnvRunner):
    """See the module.

    Attributes:
        is_abandoned: the env was replaced and may not write to its row any more.
        reset_with: seed and options of the reset that began the episode, of this env, of the one
            before it, or of the one whose snapshot was restored.
    """

    is_awaitable = True
    is_abandoned = False
    reset_with: tuple[Any, Any] = (None, None)

    def _stepper(self) -> Execute:
        """Prepare nothing: `answer` executes everything."""
        return self._not_attached

    def use_rows_of(self, other: AwaitedRunner) -> None:
        """Take over the row of `other`, which this env replaces, and its episode."""
        self.attach(other._slab, other._row, other._announce)
        self.reset_with, self.renewal = other.reset_with, other.renewal

    def note_begin(self) -> None:
        """Say in its row that its request has left the queue."""
        self._writer.note_begin()

    async def answer(self, op: int, arguments: Any) -> Any:
        """Execute one request, as `execute` does."""
        call, finish = self.request(op, arguments)
        began = time.monotonic_ns()
        returned = call()
        # The value of a call may be awaitable without being meant for us.
        is_for_us = inspect.iscoroutine if answers_with_value(op) else inspect.isawaitable
        if is_for_us(returned):
            returned = await returned
        if self.is_abandoned:
            raise Abandoned
        return finish(returned, time.monotonic_ns() - began)

    async def close(self) -> None:  # type: ignore[override]
        """Close the env, once; hardware is stopped before."""
        if self.is_hardware and not self.has_closed:
            await asyncio.to_thread(stop_all, [self.env])
        closing = super().close()
        if inspect.isawaitable(closing):
            await closing

    def _snapshot(self) -> EnvState:
        versions, state = super()._snapshot()
        return EnvState(versions, state and dumped((self.reset_with, state), "its options"))

    def _restore(self, versions: dict[str, str], state: bytes) -> ShownResult:
        reset_with, state = loaded(state)
        shown_result = super()._restore(versions, state)
        self.reset_with = reset_with
        return shown_result

    def _seed_and_options(self, arguments: Any) -> tuple[Any, Any]:
        """Return what to reset the env with, and remember it."""
        if arguments is None and self._slab.take_as_before(self._row):
            arguments = self.reset_with
        seed, options = chosen = super()._seed_and_options(arguments)
        if not (options and "reset_mask" in options):  # It begins no episode of the whole env.
            self.reset_with = seed, arguments[1] if arguments else None
        return chosen
