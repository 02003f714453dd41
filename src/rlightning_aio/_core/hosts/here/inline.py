"""`InlineHost`: envs in the process of the trainer, with the same rows and rules.

Requests wait in a queue, so sending never blocks; while a driver waits, it executes the next one
(`Poller.execute`). An env blocks the process while it steps, unless its own thread
computes the step and an event loop waits for it (`_Threads`). An env that crashes ends the trainer.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias, cast

from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.inbox import Inbox
from rlightning_aio._core.hosts.messages import (
    Built,
    Closed,
    ErrorText,
    Result,
    Withdrawn,
)
from rlightning_aio._core.hosts.running.build_env import built_envs, not_built
from rlightning_aio._core.hosts.running.execution import completion_of
from rlightning_aio._core.hosts.running.runner import attach_all, close_all
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Driver, Wiring
    from rlightning_aio._core.hosts.messages import (
        AttachOrder,
        EnvStarted,
        OutOfBand,
        StartOrder,
    )
    from rlightning_aio._core.hosts.running.runner import EnvRunner

__all__ = ["InlineHost"]

_Waiting: TypeAlias = "tuple[int, Callable[[], Any]]"
"""An entry, and the function that executes it."""
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
        self._shares_thread = wiring.shares_thread
        self._threads: _Threads | None = None

    def start(self) -> None:
        """Build the envs immediately."""
        try:
            started = self._driver.interruptible(self._built)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self._post(not_built(self.host_id, self._order, len(self._runners), error))
            return
        if self._shares_thread:
            self._threads = _Threads(self._runners, self._queue, self._driver)
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
        for position, entry in enumerate(asked):
            index = slot_of(entry) - self.first_slot
            runner = self._runners[index]
            given = None if arguments is None else arguments[position]
            if given is not None or op_of(entry) != _STEP:
                execute = partial(runner.execute, op_of(entry), given)
            elif runner.begin_step is None or runner.fast_path.steps_briefly:
                execute = runner.step
            else:
                try:
                    execute = runner.begin_step()
                except BaseException as error:
                    # Raised later: the other requests of this batch must be sent first.
                    execute = partial(_reraise, error)
                else:
                    if self._threads is not None and index in self._threads.indices:
                        self._threads.unfinished[index] = entry, execute
                        continue
            self._queue.append((entry, execute))

    def abort(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.abort`. Steps that simulators have begun by themselves are executed."""
        aborted = set(cast("list[int]", entries.tolist()))
        for waiting in list(self._queue):
            entry = waiting[0]
            runner = self._runners[slot_of(entry) - self.first_slot]
            if entry in aborted and runner.begin_step is None:
                self._queue.remove(waiting)
                self._post(Withdrawn(self.host_id, entry))

    def execute_next(self) -> bool:
        if not self._queue:
            return False
        entry, execute = self._queue.popleft()
        outcome = error = None
        try:
            outcome = self._driver.interruptible(execute)
        except BaseException as raised:
            error = raised
        runner = self._runners[slot_of(entry) - self.first_slot]
        completion = completion_of(self.host_id, runner, entry, outcome, error)
        self._post(completion or Result(self.host_id, entry, {}))
        if isinstance(error, KeyboardInterrupt):
            raise error  # It is meant for the program, but the request ends, too.
        return True

    def step_now(self) -> OutOfBand | None:
        runner = self._runners[0]
        try:
            return self._driver.interruptible(runner.step)
        except BaseException as error:
            runner.note_error(_STEP, ErrorText.of(error))
            raise

    def close(self) -> None:
        """Close the envs immediately."""
        errors = close_all(self._runners)
        self.release()
        self._post(Closed(self.host_id, errors))

    def release(self) -> None:
        """Drop the envs and their requests."""
        self._runners.clear()
        self._queue.clear()
        if self._threads is not None:
            self._threads.close()
            self._threads = None


class _Threads:
    """Steps that envs compute in their own threads; see `base.Source`.

    Such a step joins the queue when the thread is done, so executing the rest of it doesn't wait.

    Args:
        runners: of the host's envs.
        queue: of the host.
        driver: of the group.

    Attributes:
        indices: of the envs that report the end of a step.
        unfinished: running steps, by the index of their env.
    """

    def __init__(
        self, runners: Sequence[EnvRunner], queue: deque[_Waiting], driver: Driver
    ) -> None:
        self.unfinished: dict[int, _Waiting] = {}
        self._queue, self._driver = queue, driver
        self._inbox = inbox = Inbox()
        self.indices = {
            index
            for index, runner in enumerate(runners)
            if runner.on_stepped(partial(inbox.put, partial(self._ended, index)))
        }
        driver.watch(self)

    def _ended(self, index: int) -> None:
        self._queue.append(self.unfinished.pop(index))

    def fileno(self) -> int:
        return self._inbox.fileno()

    def on_readable(self) -> None:
        for task in self._inbox.pop_all():
            task()

    def on_writable(self) -> None:
        """Do nothing: it has nothing to write."""

    def close(self) -> None:
        """Forget running steps."""
        self._driver.unwatch(self)
        self._inbox.close()


def _reraise(error: BaseException) -> OutOfBand | None:
    raise error
