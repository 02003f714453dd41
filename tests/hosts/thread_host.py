"""`ThreadHost`: envs in a thread of the trainer; a complete example of a host.

A new kind of host needs only a class with the methods of `base.Host`, and a row in
`registry.PLACEMENTS`. Nothing else in the package depends on it.
Rule: only its own thread touches an env, and only the trainer's thread touches the completions of
the group. Everything between the two goes through a queue.
Left out on purpose: `base.Killable`. A thread can't be killed, so time limits of steps don't apply.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from functools import partial
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.hosts.arena import map_shared
from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.messages import Built, Closed, Death, Died, NotBuilt, Reported
from rlightning_aio._core.hosts.running.build_env import built_envs
from rlightning_aio._core.hosts.running.execution import execute
from rlightning_aio._core.hosts.running.runner import attach_all, close_all
from rlightning_aio.protocol.entries import slot_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, Completion, StartOrder
    from rlightning_aio._core.hosts.running.runner import EnvRunner

__all__ = ["ThreadHost"]

JOIN_SECONDS = 1.0
"""Time for a thread to end before the host stops waiting for it."""


class ThreadHost(Host):
    """The side of the trainer; see `base.Host` and `base.Source`.

    Args:
        host_id: its index among the hosts of the group, which every completion has.
        first_slot: slot of its first env in the group.
        order: the envs to build.
        wiring: parts of the group.
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
        """Start a thread, and a new one after `Died`."""
        self.release()
        thread = EnvThread(self.host_id, self.first_slot)
        try:
            thread.start()
        except RuntimeError as error:
            os.close(thread.bell)
            # The group expects an OSError from a start that fails.
            raise OSError(str(error)) from error
        self._thread = thread
        self._wiring.driver.watch(self)
        thread.tasks.put(partial(thread.build, self._order))

    def attach(self, order: AttachOrder) -> None:
        """Give the envs their rows in the shared arena."""
        map_part = partial(map_shared, self._wiring.arena.descriptor)
        if self._thread is not None:
            self._thread.tasks.put(partial(self._thread.attach, order, map_part))

    def close(self) -> None:
        """Close the envs; drop requests that have not begun."""
        if self._thread is None:
            self._wiring.completions.append(Closed(self.host_id, []))
            return
        self._thread.closing = True
        self._thread.tasks.put(self._thread.close)

    def release(self) -> None:
        """End the thread; this may be called at any time, more than once."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._wiring.driver.unwatch(self)  # Before the thread closes the descriptor.
            thread.closing = True
            thread.tasks.put(None)
            thread.join(JOIN_SECONDS)

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> Any:
        """Copy the arguments; they stay in this process."""
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        if self._thread is None:
            return
        for position, entry in enumerate(entries.tolist()):
            given = None if arguments is None else arguments[position]
            self._thread.tasks.put(partial(self._thread.execute, entry, given))

    # -- completions --------------------------------------------------------------

    def fileno(self) -> int:
        assert self._thread is not None
        return self._thread.bell

    def on_readable(self) -> None:
        """Pass completions on; a later one makes the bell readable again."""
        thread = self._thread
        if thread is not None:
            os.eventfd_read(thread.bell)
            while thread.posted:
                self._wiring.completions.append(thread.posted.popleft())

    def on_writable(self) -> None:
        """Do nothing: it writes nothing that could block."""


class EnvThread(threading.Thread):
    """The side of the envs: executes `tasks` in order.

    It is a daemon, so that an env that hangs doesn't keep the program from ending.

    Attributes:
        tasks: to execute; None to end.
        posted: completions for the trainer.
        bell: an eventfd, readable while the trainer has not read all of them. The thread closes it
            at its end, because a thread that the trainer no longer waits for may still use it.
        closing: no further requests are executed.
    """

    def __init__(self, host_id: int, first_slot: int) -> None:
        super().__init__(name=f"envs from slot {first_slot} on", daemon=True)
        self.tasks: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self.posted: deque[Completion] = deque()
        self.bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.closing = False
        self._host_id = host_id
        self._first_slot = first_slot
        self._runners: list[EnvRunner] = []

    def run(self) -> None:
        """Execute the tasks, which report errors of envs; any other error ends the worker."""
        try:
            while (task := self.tasks.get()) is not None:
                task()
        except BaseException as error:  # noqa: BLE001  # No caller may wait forever.
            death = Death(f"ended in {type(error).__name__}: {error}")
            self._post(Died(self._host_id, death))
            while self.tasks.get() is not None:
                pass
        finally:
            os.close(self.bell)

    def _post(self, completion: Completion) -> None:
        self.posted.append(completion)
        os.eventfd_write(self.bell, 1)

    # -- tasks --------------------------------------------------------------------

    def build(self, order: StartOrder) -> None:
        """Build the envs, and post their descriptions, or which of them can't be built."""
        try:
            for runner in built_envs(order, inline=True):
                self._runners.append(runner)
            started = [runner.started() for runner in self._runners]
        except BaseException as error:  # noqa: BLE001  # An env may raise anything.
            index = min(len(self._runners), len(order.worker_indices) - 1)
            self._post(NotBuilt(self._host_id, index, ErrorText.of(error)))
        else:
            self._post(Built(self._host_id, started))

    def attach(self, order: AttachOrder, map_part: Callable[[int, int], memoryview]) -> None:
        """Give each env its row, except while closing, when the arena may be gone."""
        if not self.closing:
            attach_all(self._runners, order, map_part, self._host_id, self._post)

    def execute(self, entry: int, arguments: Any) -> None:
        """Execute one request, and post its completion."""
        if self.closing:
            return
        runner = self._runners[slot_of(entry) - self._first_slot]
        completion = execute(self._host_id, runner, entry, arguments)
        if completion is None:  # The row holds the whole result.
            completion = Reported(self._host_id, np.array([entry], np.int64))
        self._post(completion)

    def close(self) -> None:
        """Close the envs, and post what they raised."""
        self._post(Closed(self._host_id, close_all(self._runners)))
