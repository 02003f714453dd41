"""`ThreadHost`: envs in a thread of the trainer's process; the worked example of a host.

This is all that a new kind of host takes: a class with the methods of `base.Host`, and a row
in `registry.PLACEMENTS`. Nothing else in the package knows of it.
Rule: an env is touched by its own thread alone, and the group's completions by the trainer's;
all that crosses between the two lies in a queue for one of them.
Absent on purpose: force. A thread can't be killed, so the host is not `base.Killable`, and
limits on the time of a step don't apply to it.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from functools import partial
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.hosts.arena import map_shared
from rlightning_aio.hosts.build_env import built_envs
from rlightning_aio.hosts.copied import copied
from rlightning_aio.hosts.messages import (
    Attached,
    Built,
    Closed,
    Death,
    Died,
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
    from rlightning_aio.hosts.messages import AttachOrder, Completion, StartOrder
    from rlightning_aio.hosts.runner import EnvRunner

__all__ = ["ThreadHost"]

JOIN_SECONDS = 1.0
"""How long a thread that was told to end may take before it is left to itself."""


class ThreadHost:
    """The trainer's side; see `base.Host` and `base.Source`.

    Args:
        host_id: position among the group's hosts; every completion says it.
        first_slot: the group's slot of our first env, which entries count from.
        order: what to build.
        wiring: what the group gives its hosts.
    """

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._order = order
        self._wiring = wiring
        self._thread: EnvThread | None = None

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """See `base.Host.start`. It is called again after a host has told of its death."""
        self.release()
        thread = EnvThread(self.host_id, self.first_slot)
        try:
            thread.start()
        except RuntimeError as error:
            os.close(thread.bell)
            # An OSError is what the group takes for a start that failed.
            raise OSError(str(error)) from error
        self._thread = thread
        self._wiring.watcher.watch(self)
        thread.tasks.put(partial(thread.build, self._order))

    def attach(self, order: AttachOrder) -> None:
        """See `base.Host.attach`. The slabs lie in the arena, which we share with everybody."""
        map_part = partial(map_shared, self._wiring.arena.descriptor)
        if self._thread is not None:
            self._thread.tasks.put(partial(self._thread.attach, order, map_part))

    def close(self) -> None:
        """See `base.Host.close`. What was asked before and has not begun is dropped."""
        if self._thread is None:
            self._wiring.completions.append(Closed(self.host_id, []))
            return
        self._thread.closing = True
        self._thread.tasks.put(self._thread.close)

    def release(self) -> None:
        """See `base.Host.release`. It may come at any time, and more than once."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._wiring.watcher.unwatch(self)  # Before the thread closes what is watched.
            thread.closing = True
            thread.tasks.put(None)
            thread.join(JOIN_SECONDS)

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> Any:
        """See `base.Host.packed`. A copy is enough: nothing leaves the process."""
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """See `base.Host.submit`."""
        if self._thread is None:
            return
        for position, entry in enumerate(entries.tolist()):
            given = None if arguments is None else arguments[position]
            self._thread.tasks.put(partial(self._thread.execute, entry, given))

    # -- what the thread tells ----------------------------------------------------

    def fileno(self) -> int:
        """See `base.Source.fileno`."""
        assert self._thread is not None
        return self._thread.bell

    def on_readable(self) -> None:
        """See `base.Source.on_readable`. What is told after this look rings once more."""
        thread = self._thread
        if thread is not None:
            os.eventfd_read(thread.bell)
            while thread.told:
                self._wiring.completions.append(thread.told.popleft())

    def on_writable(self) -> None:
        """Never asked for: nothing is written that could block."""


class EnvThread(threading.Thread):
    """The envs' side: does what it finds in `tasks`, in order.

    A daemon, so that an env that hangs doesn't keep the program from ending.

    Attributes:
        tasks: what to do next; None to end.
        told: completions on their way to the trainer.
        bell: an eventfd, readable while any of them have not been announced. The thread
            closes it at its end: one that the trainer no longer waits for may still ring.
        closing: nothing is to be executed any more.
    """

    def __init__(self, host_id: int, first_slot: int) -> None:
        super().__init__(name=f"envs from slot {first_slot} on", daemon=True)
        self.tasks: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.told: deque[Completion] = deque()
        self.bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.closing = False
        self._host_id = host_id
        self._first_slot = first_slot
        self._runners: list[EnvRunner] = []
        self._schemas = InfoSchemas(self._announce)

    def run(self) -> None:
        """Do the tasks. What an env raises they tell themselves; anything else is our death."""
        try:
            while (task := self.tasks.get()) is not None:
                task()
        except BaseException as error:  # noqa: BLE001  # Nobody may wait for us in vain.
            death = Death(f"ended in {type(error).__name__}: {error}")
            self._tell(Died(self._host_id, death))
            while self.tasks.get() is not None:
                pass
        finally:
            os.close(self.bell)

    def _tell(self, completion: Completion) -> None:
        self.told.append(completion)
        os.eventfd_write(self.bell, 1)

    def _announce(self, number: int, schema: InfoSchema) -> None:
        """Say how infos lie in the rows, before the first that lies there so."""
        self._tell(NewSchema(self._host_id, number, schema))

    def _keep(self, index: int, standing: bytes, before: bool) -> None:
        self._tell(Saved(self._host_id, index, standing, before))

    # -- tasks --------------------------------------------------------------------

    def build(self, order: StartOrder) -> None:
        """Build the envs and say what they are like, or which of them can't be built."""
        try:
            if order.core is not None:
                os.sched_setaffinity(0, {order.core})  # Of this thread alone.
            for runner in built_envs(order, inline=True):
                self._runners.append(runner)
            started = [runner.started() for runner in self._runners]
        except BaseException as error:  # noqa: BLE001  # An env may raise anything.
            index = min(len(self._runners), len(order.worker_indices) - 1)
            self._tell(NotBuilt(self._host_id, index, ErrorText.of(error)))
        else:
            self._tell(Built(self._host_id, started))

    def attach(self, order: AttachOrder, map_part: Callable[[int, int], memoryview]) -> None:
        """Give each env the row for its results. Once we are closing, the arena may be gone."""
        if self.closing:
            return
        attach_all(self._runners, order, map_part, self._schemas.announce, self._keep)
        self._tell(Attached(self._host_id))

    def execute(self, entry: int, arguments: Any) -> None:
        """Execute one request, and say with its entry what has become of it."""
        if self.closing:
            return
        runner, op = self._runners[slot_of(entry) - self._first_slot], op_of(entry)
        try:
            if arguments is not None:
                outcome = runner.execute(op, arguments)
            else:
                outcome = runner.step() if op == Operation.STEP else runner.reset_from_row()
        except BaseException as error:  # noqa: BLE001  # An env may raise anything.
            self._tell(Raised(self._host_id, entry, ErrorText.of(error)))
            return
        if answers_with_value(op):
            self._tell(Value(self._host_id, entry, outcome))
        elif outcome is None:  # The row holds all of it.
            self._tell(Reported(self._host_id, np.array([entry], np.int64)))
        else:
            self._tell(Result(self._host_id, entry, outcome))

    def close(self) -> None:
        """Close the envs, and say what they raised."""
        self._tell(Closed(self._host_id, close_all(self._runners)))
