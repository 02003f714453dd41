"""`LoopHost`: awaitable envs on the trainer's own event loop, thousands of them at once.

It counts its results on the group's bell, as a worker does, so that a call that waits for a number
of results is woken once, by the result that completes the number.
Left out: what becomes of a request (see `AwaitedEnvs`).
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
from rlightning_aio._core.hosts.awaiting.event_loop import new_task
from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.messages import Built, Closed, Reported, Result
from rlightning_aio._core.hosts.running.runner import attach_all, stop_one
from rlightning_aio.protocol.rings import WorkerBell, bell_size
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Coroutine, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, Completion, StartOrder


class LoopHost(Host):
    """Runs awaitable envs on the event loop of the trainer; see `base.Host`."""

    on_bell = True
    needs_loop = True

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._wiring = wiring
        self._envs = AwaitedEnvs(host_id, first_slot, order, post=self._post, done=self._note_done)
        offset, size = wiring.bell_offset, bell_size(wiring.num_hosts)
        memory = wiring.arena.map(offset, size)
        self._bell: WorkerBell | None = WorkerBell(memory, wiring.num_hosts, host_id)
        # Results that were not reported, those in rows by their entries; how many there ever were.
        self._done: list[int | Result] = []
        self._num_done = 0
        self._task: asyncio.Task[None] | None = None

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        self._run(self._build())

    def _run(self, coroutine: Coroutine[Any, Any, None]) -> None:
        self._task = new_task(coroutine, asyncio.get_running_loop())

    async def _build(self) -> None:
        started = await self._envs.build()
        if started is not None:
            self._post(Built(self.host_id, started))

    def attach(self, order: AttachOrder) -> None:
        arena = self._wiring.arena
        attach_all(self._envs.runners, order, arena.map, self.host_id, self._post)

    def close(self) -> None:
        """See `base.Host.close`. Requests that are being executed are cancelled."""
        if self._task is not None:
            self._task.cancel()
        self._run(self._close())

    async def _close(self) -> None:
        errors = await self._envs.close()
        self._post(Closed(self.host_id, errors))

    def release(self) -> None:
        task, self._task = self._task, None
        if task is not None and not task.get_loop().is_closed():
            task.cancel()
        self._envs.release()
        self._done.clear()
        self._bell = None

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> Any:
        """See `base.Host.packed`. A copy is enough: nothing leaves the process."""
        return copied(arguments)

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        for position, entry in enumerate(entries.tolist()):
            self._envs.submit(entry, None if arguments is None else arguments[position])

    def abort(self, entries: NDArray[np.int64]) -> None:
        """End requests by a cancellation of what their envs await; see `base.Host.abort`."""
        for entry in entries.tolist():
            self._envs.abort(entry)

    def stop(self, index: int, number: int) -> None:
        del number  # No code of an env is being executed now.
        stop_one(self._envs.runners, index)

    # -- completions --------------------------------------------------------------

    def _note_done(self, result: int | Result) -> None:
        """Count a result, and wake the trainer if it waits for that many."""
        self._done.append(result)
        self._num_done += 1
        bell = self._bell
        if bell is None:
            return
        # Where the trainer waits for all that is in flight, only the last result need look.
        if (bell.publish(self._num_done) or not self._envs.num_busy) and bell.is_due():
            self._wiring.driver.wake()

    def _post(self, completion: Completion) -> None:
        if type(completion) is Result:
            self._note_done(completion)
            return
        self.poll()  # What came before it is reported before it.
        self._wiring.completions.append(completion)
        self._wiring.driver.wake()

    def poll(self) -> None:
        done = self._done
        if not done:
            return
        self._done = []
        self._wiring.bell.took(self.host_id, len(done))
        append = self._wiring.completions.append
        in_rows = [one for one in done if type(one) is int]
        if in_rows:
            append(Reported(self.host_id, np.array(in_rows, np.int64)))
        if len(in_rows) < len(done):
            for one in done:
                if type(one) is Result:
                    append(one)
