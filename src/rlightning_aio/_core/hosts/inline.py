"""`InlineHost`: envs in the process of the trainer, with the same rows and rules.

Requests wait in a queue, so sending never blocks; while a driver waits, it executes the next one
(`Poller.execute`). An env blocks the process while it steps, and one that crashes ends the trainer.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast
from weakref import WeakSet

from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.messages import (
    Built,
    Closed,
    Reported,
    Withdrawn,
)
from rlightning_aio._core.hosts.running.build_env import built_envs, not_built
from rlightning_aio._core.hosts.running.execution import completion_of
from rlightning_aio._core.hosts.running.runner import attach_all, close_all, stop_one
from rlightning_aio.envs.hardware import stopped_by_signals
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import (
        AttachOrder,
        EnvStarted,
        StartOrder,
    )
    from rlightning_aio._core.hosts.running.runner import EnvRunner
    from rlightning_aio.envs.base import BaseEnv

_Waiting: TypeAlias = "tuple[int, NDArray[np.int64], Callable[[], Any]]"
"""An entry, by itself and as an array of one, and the function that executes it."""
_STEP: Final = int(Operation.STEP)
_HARDWARE: Final[WeakSet[BaseEnv]] = WeakSet()
"""Envs of this process that move something real."""


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
        for runner in built_envs(self._order, [0] * self.num_envs, inline=True):
            self._runners.append(runner)
            if self._order.is_hardware:
                _HARDWARE.add(runner.env)
        return [runner.started() for runner in self._runners]

    def attach(self, order: AttachOrder) -> None:
        attach_all(self._runners, order, self._arena.map, self.host_id, self._post)

    def packed(self, arguments: Any) -> Any:
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        asked, own = cast("list[int]", entries.tolist()), entries.copy()
        for position, entry in enumerate(asked):
            runner = self._runners[slot_of(entry) - self.first_slot]
            given = None if arguments is None else arguments[position]
            if given is not None or op_of(entry) != _STEP:
                execute = partial(runner.execute, op_of(entry), given)
            else:
                execute = runner.step
            self._queue.append((entry, own[position : position + 1], execute))

    def abort(self, entries: NDArray[np.int64]) -> None:
        aborted = set(cast("list[int]", entries.tolist()))
        for waiting in list(self._queue):
            if waiting[0] in aborted:
                self._queue.remove(waiting)
                self._post(Withdrawn(self.host_id, waiting[0]))

    def stop(self, index: int, number: int) -> None:
        del number  # None is being executed now.
        stop_one(self._runners, index)

    def execute_next(self) -> bool:
        if not self._queue:
            return False
        entry, alone, execute = self._queue.popleft()
        outcome = error = None
        runner = self._runners[slot_of(entry) - self.first_slot]
        try:
            if self._order.is_hardware:
                with stopped_by_signals(_HARDWARE):
                    outcome = self._driver.interruptible(execute)
            else:
                outcome = self._driver.interruptible(execute)
        except BaseException as raised:
            error = raised
        completion = None
        if outcome is not None or error is not None or op_of(entry) != _STEP:
            completion = completion_of(self.host_id, runner, entry, outcome, error)
        # The group records all that are reported side by side in one go.
        self._post(completion or Reported(self.host_id, alone))
        if isinstance(error, KeyboardInterrupt):
            raise error  # It is meant for the program, but the request ends, too.
        return True

    def close(self) -> None:
        """Close the envs immediately."""
        errors = self._driver.interruptible(partial(close_all, self._runners))
        self.release()
        self._post(Closed(self.host_id, errors))
        if any(error.type_name == "KeyboardInterrupt" for _, error in errors):
            raise KeyboardInterrupt  # It is meant for the program.

    def release(self) -> None:
        """Drop the envs and their requests."""
        self._runners.clear()
        self._queue.clear()
