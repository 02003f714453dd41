"""`RayHost`: envs in a Ray actor, on any node of the cluster that has room for it.

One remote call carries a batch of requests, with one array for each column, and its reply has the
same form. Threads of Ray put outcomes into an `Inbox`, whose descriptor wakes the trainer. A node
that dies is a worker that dies, and its replacement is another actor.
Left out on purpose: calls to Ray (see `cluster`), and the execution of requests (see `actor`).
"""

from __future__ import annotations

import os
import sys
import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.inbox import Inbox
from rlightning_aio._core.hosts.limits import limits_of
from rlightning_aio._core.hosts.messages import (
    Attached,
    Built,
    Closed,
    Death,
    Died,
    ErrorText,
    Reported,
)
from rlightning_aio._core.hosts.ray.actor import Batch, Late, Reply
from rlightning_aio._core.hosts.ray.cluster import (
    RayConnection,
    actor_class,
    call,
    concurrent,
    ending,
    kill,
    shortage,
)
from rlightning_aio._core.hosts.ray.row_table import RowTable
from rlightning_aio._core.hosts.running.runner import placed
from rlightning_aio.protocol.entries import op_of
from rlightning_aio.protocol.pickling import dumped, dumped_with_code

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, EnvStarted, StartOrder
    from rlightning_aio.protocol.frames import Frame

__all__ = ["RayHost"]

_ON_THE_WAY_NS: Final = 2_000_000_000
"""Time for a batch and its reply to travel, in addition to the time of the envs."""

_OF_ANOTHER_PROCESS: Final[list[_Life]] = []
"""Actors that a forked process inherited. It keeps them, because Ray would report their release to
the cluster, over sockets that the parent uses.
"""


@dataclass
class _Sent:
    """A batch of requests that was sent to an actor.

    Attributes:
        entries: of the requests.
        outcome: what came back; None until then.
    """

    entries: NDArray[np.int64]
    outcome: Reply | Exception | None = None


class _Life:
    """One actor, from its start to its end.

    Attributes:
        actor: Ray's handle.
        inbox: for its replies.
        is_placed: a node has started it.
        is_built: its envs are built.
        sent: unanswered batches, in the order of execution.
        began_ns: estimated start of the first of them.
        late: a request that it reported as late, and the start of that request.
        stacks: of all its threads when it reported that.
    """

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.inbox = Inbox()
        self.is_placed = self.is_built = False
        self.sent: deque[_Sent] = deque()
        self.began_ns = 0
        self.late: tuple[int, int] | None = None
        self.stacks = ""
        # Objects to keep until a call returns, by the number of the call.
        self._kept: dict[int, object] = {}
        self._num_calls = 0

    def call(self, method: Any, then: Callable[[_Life, Any], None], *arguments: Any) -> None:
        """Call a method of the actor; `then` gets the outcome on the thread of the trainer."""
        self._num_calls = number = self._num_calls + 1
        put = self.inbox.put

        def completed(outcome: Any) -> None:
            put(lambda: self._completed(number, then, outcome))

        self._kept[number] = call(method, completed, *arguments)

    def _completed(self, number: int, then: Callable[[_Life, Any], None], outcome: Any) -> None:
        del self._kept[number]
        then(self, outcome)

    def end(self) -> None:
        """Kill the actor, and drop its replies."""
        self.inbox.close()
        self._kept.clear()
        kill(self.actor)


class RayHost(Host):
    """The trainer's handle on one actor; see `base.Host`, `Source` and `Killable`.

    Raises:
        ConfigError: `ray_options` can't be used.
    """

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self._config = order.config
        self._limits = limits_of(order.config)
        self._actor_class = actor_class(order.config, watched=bool(self._limits))
        self._start_payload = dumped_with_code(order)
        self._wiring = wiring
        self._post = wiring.completions.append
        self._pid = os.getpid()
        self._life: _Life | None = None
        self._started: list[EnvStarted] = []
        self._table: RowTable | None = None
        self._closing = False
        # Only Ray knows the progress of a transfer.
        self.traffic = 0

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        self._closing = False
        try:
            RayConnection.share(self._config, self._wiring)
            actor = self._actor_class.remote(self.first_slot, self._limits, list(sys.path))
        except ConnectionError:
            raise  # As for any worker that can't be started: there is no second attempt.
        except Exception as error:
            self._post(Died(self.host_id, Death(f"has no Ray cluster to live in: {error}")))
            return
        life = self._life = _Life(actor)
        self._wiring.driver.watch(self)
        life.call(actor.hello, self._on_placed)
        life.call(actor.build, self._on_built, self._start_payload)
        if self._limits:
            life.call(concurrent(actor.watch), self._on_late)

    def attach(self, order: AttachOrder) -> None:
        """Map the rows of the trainer; the actor has its own."""
        if self._table is None:
            found = placed(self._started, order, self._wiring.arena.map)
            places = [(slab, row) for _, slab, row in found]
            self._table = RowTable(self.first_slot, places)
        # A replacement is not built yet.
        if self._life is not None and self._life.is_built:
            self._post(Attached(self.host_id))

    def kill(self, *, dump: bool) -> None:
        """Kill the actor; it sent its stacks when it reported a late request."""
        del dump
        if self._life is None:
            return
        if self._closing:
            self._end("did not close in time and was killed")
        elif not self._life.is_placed:
            self._end(f"could not be placed: {shortage(self._config)}")
        else:
            self._end("was killed", -9)

    def destroy(self) -> None:
        """Kill the actor; `kill` always has an effect."""
        self.kill(dump=False)

    def close(self) -> None:
        self._closing = True
        if self._life is not None and self._life.is_placed:
            self._life.call(self._life.actor.close, self._on_closed)
        else:
            self.release()
            self._post(Closed(self.host_id, []))

    def release(self) -> None:
        life, self._life = self._life, None
        if life is None:
            return
        if os.getpid() != self._pid:
            _OF_ANOTHER_PROCESS.append(life)
            return
        self._wiring.driver.unwatch(self)
        life.end()

    def _end(self, cause: str, exit_code: int | None = None) -> None:
        """Release the actor, and report its death."""
        life = self._life
        if life is None:
            return
        # It was executing the first batch.
        requests: list[int] = [entry for sent in life.sent for entry in sent.entries.tolist()]
        self.release()
        if self._closing:
            text = ErrorText("WorkerDied", f"its worker {cause}", life.stacks)
            errors = [(index, text) for index in range(self.num_envs)]
            self._post(Closed(self.host_id, errors))
        else:
            death = Death(cause, exit_code, life.stacks, tuple(requests))
            self._post(Died(self.host_id, death))

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> bytes:
        return dumped(arguments, "it")

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None = None) -> None:
        life = self._life
        if life is None:
            return
        assert self._table is not None
        columns = self._table.requests(entries, seeds=arguments is None)
        if not life.sent:
            life.began_ns = time.monotonic_ns()
        sent = _Sent(entries)
        life.sent.append(sent)
        then = partial(self._on_reply, sent)
        life.call(life.actor.execute, then, Batch(entries, columns, arguments))

    def current_request(self) -> tuple[int, int]:
        """Return the entry being executed and its start, as of `base.Killable`.

        An actor reports a late request itself. Without a report, a batch may take as long as the
        limits of all its requests together, so an actor that is stopped or cut off is found, too.
        """
        life = self._life
        if life is None or not life.sent:
            return 0, 0
        if life.late is not None:
            return life.late
        entries: list[int] = life.sent[0].entries.tolist()
        now_ns, since_ns = time.monotonic_ns(), life.began_ns + _ON_THE_WAY_NS
        for entry in entries[:-1]:
            limit = self._limits.get(op_of(entry))
            if limit is None or now_ns < since_ns + limit * 1e9:
                return entry, since_ns
            since_ns += int(limit * 1e9)
        return entries[-1], since_ns

    def catch_up(self) -> bool:
        posted = len(self._wiring.completions)
        self.on_readable()
        return len(self._wiring.completions) != posted

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        assert self._life is not None
        return self._life.inbox.fileno()

    def on_readable(self) -> None:
        life = self._life
        for task in life.inbox.pop_all() if life is not None else ():
            if self._life is life:  # A task may end it.
                task()

    def on_writable(self) -> None:
        """Do nothing: Ray sends by itself."""

    def _has_returned(self, outcome: Any) -> bool:
        """Return True if a call returned a value; otherwise handle the end of the actor."""
        if isinstance(outcome, BaseException):
            self._end(*ending(outcome))
            return False
        return True

    def _on_placed(self, life: _Life, outcome: Any) -> None:
        if self._has_returned(outcome):
            life.is_placed = True

    def _on_built(self, life: _Life, outcome: Frame | Exception) -> None:
        if not self._has_returned(outcome):
            return
        assert not isinstance(outcome, Exception)
        completion = completion_in(self.host_id, outcome)
        self._post(completion)
        if not isinstance(completion, Built):
            return
        self._started = completion.started
        life.is_built = True
        if self._table is not None:  # A replacement has its rows already.
            self._post(Attached(self.host_id))

    def _on_late(self, life: _Life, outcome: Late | Exception) -> None:
        if self._has_returned(outcome):
            assert isinstance(outcome, Late)
            life.late = outcome.entry, time.monotonic_ns() - outcome.taken_ns
            life.stacks = outcome.stacks

    def _on_reply(self, sent: _Sent, life: _Life, outcome: Reply | Exception) -> None:
        """Apply replies in the order of execution: results need the schemas of earlier ones.

        Ray may deliver a large reply later than a small one that came after it.
        """
        sent.outcome = outcome
        while life.sent and (first := life.sent[0].outcome) is not None:
            if not self._has_returned(first):
                return
            assert isinstance(first, Reply)
            life.sent.popleft()
            life.began_ns = time.monotonic_ns()
            self._apply(first)

    def _apply(self, reply: Reply) -> None:
        """Write results into their rows, and post the completions of a batch."""
        assert self._table is not None
        self._table.put_results(reply.with_rows(), reply.columns, time.monotonic_ns())
        for frame in reply.frames:
            self._post(completion_in(self.host_id, frame))
        if len(reply.done):
            self._post(Reported(self.host_id, reply.done))

    def _on_closed(self, life: _Life, outcome: Any) -> None:
        del life
        if self._has_returned(outcome):
            self.release()
            self._post(Closed(self.host_id, outcome))
