"""`InlineHost`: envs in the trainer's own process, with the same rows and rules.

Requests wait in a queue; one is executed whenever a driver has nothing ready and asks
for it (`execute_next`), so sending never blocks here either. An env blocks the process
while it steps; nothing protects the trainer from an env that crashes.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import numpy as np

from rlightning_aio.hosts.arena import map_shared
from rlightning_aio.hosts.build_env import built_envs
from rlightning_aio.hosts.copied import copied
from rlightning_aio.hosts.messages import (
    Attached,
    Built,
    Closed,
    ErrorText,
    NewSchema,
    NotBuilt,
    Raised,
    Reported,
    Result,
    Saved,
    Value,
)
from rlightning_aio.hosts.runner import attach_all, close_all
from rlightning_aio.protocol.entries import Operation, answers_with_value, op_of, slot_of
from rlightning_aio.protocol.info import InfoSchema, InfoSchemas

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Wiring
    from rlightning_aio.hosts.messages import AttachOrder, OutOfBand, StartOrder
    from rlightning_aio.hosts.runner import EnvRunner, Execute

__all__ = ["InlineHost"]

_Waiting: TypeAlias = "tuple[int, Callable[[], Any]]"
"""An entry, and what executes it."""
_STEP: Final = int(Operation.STEP)


class InlineHost:
    """See `base.Host`, `Executing` and `Polled`. It has no descriptor and is never watched."""

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._order = order
        self._arena = wiring.arena
        self._tell = wiring.completions.append
        self._runners: list[EnvRunner] = []
        self._queue: deque[_Waiting] = deque()
        # Entries of results that lie in their rows, and have still to be told.
        self._done: list[int] = []
        self._schemas = InfoSchemas(self._announce)

    def start(self) -> None:
        """Build the envs here and now."""
        try:
            for runner in built_envs(self._order, inline=True):
                self._runners.append(runner)
            started = [runner.started() for runner in self._runners]
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            index = min(len(self._runners), self.num_envs - 1)
            self._tell(NotBuilt(self.host_id, index, ErrorText.of(error)))
            return
        self._tell(Built(self.host_id, started))

    def attach(self, order: AttachOrder) -> None:
        """See `base.Host.attach`."""
        map_part = partial(map_shared, self._arena.descriptor)
        attach_all(self._runners, order, map_part, self._schemas.announce, self._keep)
        self._tell(Attached(self.host_id))

    def _announce(self, number: int, schema: InfoSchema) -> None:
        self._tell(NewSchema(self.host_id, number, schema))

    def _keep(self, index: int, standing: bytes, before: bool) -> None:
        self._tell(Saved(self.host_id, index, standing, before))

    def packed(self, arguments: Any) -> Any:
        """See `base.Host.packed`."""
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """See `base.Host.submit`."""
        asked = cast("list[int]", entries.tolist())
        for position, entry in enumerate(asked):
            runner = self._runners[slot_of(entry) - self.first_slot]
            if arguments is not None:
                execute = partial(runner.execute, op_of(entry), arguments[position])
            elif op_of(entry) == _STEP:
                execute = runner.step if runner.begin_step is None else _begun(runner.begin_step)
            else:
                execute = runner.reset_from_row
            self._queue.append((entry, execute))

    def execute_next(self) -> bool:
        """See `base.Executing.execute_next`."""
        if not self._queue:
            return False
        entry, execute = self._queue.popleft()
        try:
            outcome = execute()
        except BaseException as error:
            self.poll()  # What came before is told before.
            self._tell(Raised(self.host_id, entry, ErrorText.of(error)))
            if isinstance(error, KeyboardInterrupt):
                raise  # It was meant for the program; the request that it struck ends all the same.
            return True
        if outcome is None and not answers_with_value(op_of(entry)):
            self._done.append(entry)
            return True
        self.poll()
        if answers_with_value(op_of(entry)):
            self._tell(Value(self.host_id, entry, outcome))
        else:
            self._tell(Result(self.host_id, entry, outcome or {}))
        return True

    def poll(self) -> None:
        """See `base.Polled.poll`."""
        if self._done:
            self._tell(Reported(self.host_id, np.array(self._done, np.int64)))
            self._done.clear()

    def step_now(self) -> OutOfBand | None:
        """Step env 0 with the action in its row, past the queue, which holds nothing for it."""
        return self._runners[0].step()

    def close(self) -> None:
        """Close the envs here and now."""
        errors = close_all(self._runners)
        self.release()
        self._tell(Closed(self.host_id, errors))

    def release(self) -> None:
        """Drop the envs and what was asked of them."""
        self._runners.clear()
        self._queue.clear()


def _begun(begin_step: Callable[[], Execute]) -> Execute:
    """Start a step of a simulator that computes by itself; what will end it."""
    try:
        return begin_step()
    except BaseException as error:
        # When its result is asked for: of several requests all are to be taken first.
        return partial(_reraise, error)


def _reraise(error: BaseException) -> OutOfBand | None:
    raise error
