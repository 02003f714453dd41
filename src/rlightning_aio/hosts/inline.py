"""`InlineHost`: envs in the trainer's own process, with the same rows and rules.

Requests wait in a queue; one is executed whenever a driver has nothing ready and asks
for it (`run_one`), so sending never blocks here either. An env blocks the process
while it steps; nothing protects the trainer from an env that crashes.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.copied import copied
from rlightning_aio.hosts.runner import EnvRunner, Rest
from rlightning_aio.hosts.worker import (
    AttachOrder,
    ErrorText,
    Started,
    StartOrder,
    build_env,
)
from rlightning_aio.protocol.info import InfoSchema, InfoSchemas
from rlightning_aio.protocol.rings import STEP, number_of, op_of, slot_of
from rlightning_aio.protocol.slab import Slab

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Inbox

__all__ = ["InlineHost"]

Execute: TypeAlias = "Callable[[], Any]"
Tell: TypeAlias = "Callable[[int, int, Any], None]"
"""Takes the row, the request's number, and what executing it gave."""


class InlineHost:
    """See `base.Host`. It has no descriptor and is never watched."""

    def __init__(
        self, host_id: int, first_slot: int, order: StartOrder, arena: Arena, inbox: Inbox
    ) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.rows = len(order.worker_indices)
        self.in_flight = 0
        self.ordered = 0
        self.elastic = False
        self.inline = True
        self._order = order
        self._arena = arena
        self._inbox = inbox
        self._runners: list[EnvRunner] = []
        self._queue: deque[tuple[int, int, Execute, Tell]] = deque()
        self._schemas = InfoSchemas(self._announce)

    def fileno(self) -> int:
        """There is none."""
        raise ValueError("an inline host has no descriptor")

    def on_readable(self) -> None:
        """Never called."""

    def on_writable(self) -> None:
        """Never called."""

    def start(self) -> None:
        """Build the envs here and now."""
        order = self._order
        for row, (index, fn) in enumerate(
            zip(order.worker_indices, order.preprocess_fns, strict=True)
        ):
            try:
                env = build_env(order.config, order.env_class, index, fn)
                self._runners.append(EnvRunner(env, inline=True))
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                self._inbox.on_start_error(self, row, ErrorText.of(error))
                return
        self._inbox.on_started(self, [Started.of(runner) for runner in self._runners])

    def attach(self, order: AttachOrder) -> None:
        """See `base.Host.attach`."""
        slabs = [
            Slab(layout, map_shared(self._arena.descriptor, offset, layout.size(rows)), rows)
            for layout, rows, offset in order.slabs
        ]
        for runner, (slab_index, row) in zip(self._runners, order.rows, strict=True):
            runner.attach(slabs[slab_index], row, self._schemas.announce)
        self._inbox.on_attached(self)

    def _announce(self, number: int, schema: InfoSchema) -> None:
        self._inbox.on_schema(self, number, schema)

    def request(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.request`."""
        for entry in cast("list[int]", entries.tolist()):
            row = slot_of(entry) - self.first_slot
            runner = self._runners[row]
            execute = _begun(runner) if op_of(entry) == STEP else runner.reset_from_row
            self._enqueue(row, number_of(entry), execute, self._tell_result)

    def pack(self, content: Any) -> Any:
        """See `base.Host.pack`."""
        return copied(content)

    def request_step(self, row: int, number: int, packed: tuple[Any, dict[str, Any]]) -> None:
        """See `base.Host.request_step`."""
        runner = self._runners[row]
        self._enqueue(row, number, lambda: runner.step_with(*packed), self._tell_result)

    def request_reset(
        self, row: int, number: int, packed: tuple[int | None, dict[str, Any]]
    ) -> None:
        """See `base.Host.request_reset`."""
        runner = self._runners[row]
        self._enqueue(row, number, lambda: runner.reset(*packed), self._tell_result)

    def request_call(
        self, row: int, number: int, packed: tuple[str, tuple[Any, ...], dict[str, Any]]
    ) -> None:
        """See `base.Host.request_call`."""
        runner = self._runners[row]
        self._enqueue(row, number, lambda: runner.call(*packed), self._tell_value)

    def _enqueue(self, row: int, number: int, execute: Execute, tell: Tell) -> None:
        self.in_flight += 1
        self._queue.append((row, number, execute, tell))

    def _tell_result(self, row: int, number: int, rest: Rest | None) -> None:
        self._inbox.on_rest(self, row, number, rest or {})

    def _tell_value(self, row: int, number: int, value: Any) -> None:
        self._inbox.on_value(self, row, number, value)

    def step_now(self, row: int) -> Rest | None:
        """Step with the action in `row`, past the queue, which holds nothing for this env."""
        return self._runners[row].step()

    def order(self, count: int) -> bool:
        """Nothing gets ready by itself here."""
        del count
        return False

    def withdraw(self) -> None:
        """Nothing is ever ordered here."""

    def unread(self) -> int:
        """Nothing waits to be swept here."""
        return 0

    def sweep(self) -> None:
        """Nothing gets ready by itself here."""

    def run_one(self) -> bool:
        """See `base.Host.run_one`."""
        if not self._queue:
            return False
        self.in_flight -= 1
        row, number, execute, tell = self._queue.popleft()
        try:
            tell(row, number, execute())
        except BaseException as error:
            self._inbox.on_error(self, row, number, ErrorText.of(error))
            if isinstance(error, KeyboardInterrupt):
                raise  # It was meant for the program; the request that it struck ends all the same.
        return True

    def executing(self) -> tuple[int, int]:
        """Nothing is being executed while somebody can ask."""
        return 0, 0

    def kill(self, *, dump: bool) -> None:
        """An inline env can't be killed."""

    def close(self) -> None:
        """Close the envs here and now."""
        errors: list[tuple[int, ErrorText]] = []
        for row, runner in enumerate(self._runners):
            try:
                runner.env.close()
            except BaseException as error:
                errors.append((row, ErrorText.of(error)))
        self.release()
        self._inbox.on_closed(self, errors)

    def release(self) -> None:
        """Drop the envs and what was asked of them."""
        self._runners.clear()
        self._queue.clear()
        self.in_flight = 0


def _begun(runner: EnvRunner) -> Callable[[], Rest | None]:
    """Start a step where the simulator computes by itself; what will end it."""
    if runner.begin_step is None:
        return runner.step
    try:
        return runner.begin_step()
    except BaseException as error:
        # When its result is asked for: of several requests all are to be taken first.
        return partial(_reraise, error)


def _reraise(error: BaseException) -> Rest | None:
    raise error
