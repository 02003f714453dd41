"""`InlineHost`: envs in the process of the trainer, with the same rows and rules.

Requests wait in a queue, so sending never blocks. A call that waits for results has them executed
(`Poller.execute`): several, one after another, if no other host is busy and no other task shares
the thread. An env blocks the process while it steps, and one that crashes ends the trainer.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from itertools import repeat
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

import numpy as np

from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.messages import (
    Built,
    Closed,
    Raised,
    Reported,
)
from rlightning_aio._core.hosts.running.build_env import built_envs, not_built
from rlightning_aio._core.hosts.running.execution import completion_of
from rlightning_aio._core.hosts.running.runner import attach_all, close_all, stop_one
from rlightning_aio.envs.hardware import stop_all, stopped_by_signals
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import (
        AttachOrder,
        EnvStarted,
        StartOrder,
    )
    from rlightning_aio._core.hosts.running.runner import EnvRunner

_Waiting: TypeAlias = "tuple[int, Any]"
"""An entry and its arguments, which are None if they are in the row."""
_STEP: Final = int(Operation.STEP)


class InlineHost(Host):
    """Runs envs in this process; see `base.Host` and `Executing`."""

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._order = order
        self._arena = wiring.arena
        self._post = wiring.completions.append
        self._runners: list[EnvRunner] = []
        self._queue: deque[_Waiting] = deque()
        self._driver = wiring.driver

    def start(self) -> None:
        """Build the envs immediately."""
        try:
            started = self._driver.interruptible(self._built)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self._post(not_built(self.host_id, self._order, len(self._runners), error))
            return
        self._post(Built(self.host_id, started))

    def _built(self) -> list[EnvStarted]:
        for runner in built_envs(self._order, inline=True):
            self._runners.append(runner)
        return [runner.started() for runner in self._runners]

    def attach(self, order: AttachOrder) -> None:
        attach_all(self._runners, order, self._arena.map, self.host_id, self._post)

    def packed(self, arguments: Any) -> Any:
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        asked = cast("list[int]", entries.tolist())
        self._queue.extend(zip(asked, arguments or repeat(None), strict=False))

    def abort(self, entries: NDArray[np.int64]) -> None:
        aborted = set(cast("list[int]", entries.tolist()))
        for waiting in list(self._queue):
            if waiting[0] in aborted:
                self._queue.remove(waiting)
                error = ErrorText("CancelledError", "aborted", "")
                self._post(Raised(self.host_id, waiting[0], error))

    def stop(self, index: int, number: int) -> None:
        del number  # None is being executed now.
        stop_one(self._runners, index)

    def execute(self, most: int, is_over: Callable[[], bool] | None) -> int:
        queue, first, in_rows, count = self._queue, self.first_slot, cast("list[int]", []), 0
        run = self._run_hardware if self._order.is_hardware else self._driver.interruptible
        while queue and count < most:
            entry, arguments = queue.popleft()
            count += 1
            runner = self._runners[slot_of(entry) - first]
            is_plain = arguments is None and op_of(entry) == _STEP
            outcome = error = None
            try:
                outcome = run(
                    runner.step if is_plain else partial(runner.execute, op_of(entry), arguments)
                )
            except BaseException as raised:
                error = raised
            completion = None
            if outcome is not None or error is not None or not is_plain:
                completion = completion_of(self.host_id, runner, entry, outcome, error)
            if completion is None:
                in_rows.append(entry)
            else:
                self._report(in_rows)
                self._post(completion)
            if isinstance(error, KeyboardInterrupt):
                raise error  # It is meant for the program, but the request ends, too.
            if is_over is not None and is_over():
                break
        self._report(in_rows)
        return count

    def _run_hardware(self, execute: Callable[[], Any]) -> Any:
        with stopped_by_signals():
            return self._driver.interruptible(execute)

    def _report(self, in_rows: list[int]) -> None:
        """Report what has its whole result in its row, and empty the list."""
        if in_rows:
            self._post(Reported(self.host_id, np.array(in_rows, np.int64)))
            in_rows.clear()

    def close(self) -> None:
        """Close the envs immediately."""
        errors = self._driver.interruptible(partial(close_all, self._runners))
        self.release()
        self._post(Closed(self.host_id, errors))
        if any(error.type_name == "KeyboardInterrupt" for _, error in errors):
            raise KeyboardInterrupt  # It is meant for the program.

    def release(self) -> None:
        """Drop the envs, hardware after it was stopped, and their requests."""
        stop_all([runner.env for runner in self._runners if runner.is_hardware])
        self._runners.clear()
        self._queue.clear()
