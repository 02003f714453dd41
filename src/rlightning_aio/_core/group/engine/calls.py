"""`Calls`: method calls of envs, and other requests that return a value instead of a result."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.dispatch import Dispatch
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.tables import Tables

__all__ = ["Calls", "values_of"]

Call: TypeAlias = "tuple[str, tuple[Any, ...], dict[str, Any]]"
"""Name of a method and its arguments."""


class Calls:
    """Call methods, and wait for the returned values."""

    def __init__(self, tables: Tables, dispatch: Dispatch, waiting: Waiting) -> None:
        self._observed = tables.observed
        self._envs = tables.envs
        self._requests = tables.requests
        self._dispatch = dispatch
        self._intake = waiting.intake
        self._waiting = waiting

    def call_one(self, now: float, slot: int, call: Call) -> Procedure[Any]:
        """Call a method of one env and return its value."""
        with self._observed.call("call", now):
            return (yield from self._call(now, self._requests.alone(slot), call))[0]

    def call(self, now: float, env_ids: Sequence[str] | None, call: Call) -> Procedure[list[Any]]:
        """Call a method of envs, or of every local env, in parallel and return its values."""
        with self._observed.call("call", now):
            return (yield from self._call(now, self._slots(env_ids), call))

    def _slots(self, env_ids: Sequence[str] | None) -> NDArray[np.intp]:
        return self._envs.all if env_ids is None else self._dispatch.distinct(env_ids)

    def _call(self, now: float, slots: NDArray[np.intp], call: Call) -> Procedure[list[Any]]:
        send = partial(self._send_calls, now, slots, call)
        ticket, _ = yield from self._waiting.ask(now, slots, send, call[0])
        return values_of([ticket])

    def _send_calls(self, now: float, slots: NDArray[np.intp], call: Call, ticket: Ticket) -> None:
        what = f"the arguments of {call[0]}()"
        self.send(now, slots, Operation.CALL, [call] * len(slots), what, ticket)

    def send(
        self,
        now: float,
        slots: NDArray[np.intp],
        op: Operation,
        arguments: Sequence[Any],
        what: str,
        ticket: Ticket,
    ) -> None:
        """Send requests that return a value.

        Args:
            now: monotonic seconds.
            slots: of local envs.
            op: the operation.
            arguments: of the request to each slot.
            what: describes the arguments in messages.
            ticket: of the call, with the name of the operation as its method.
        """
        self._intake.apply_completions()
        self._dispatch.check_local(slots, f"call {ticket.method} of")
        self._dispatch.check_sendable(now, slots, f"call {ticket.method} of")
        packed = [
            self._dispatch.packed(slot, own, what)
            for slot, own in zip(slots.tolist(), arguments, strict=True)
        ]
        entries = self._requests.issue(slots, op, ticket.owner, now)
        self._dispatch.hand_over(slots, entries, packed)


def values_of(tickets: Sequence[Ticket]) -> list[Any]:
    """The values that calls returned, in order of sending.

    If calls failed, the first error is raised, with the rest as its `others`.
    """
    faults = [fault for ticket in tickets for fault in ticket.faults]
    if faults:
        faults[0].others = tuple(faults[1:])
        raise faults[0]
    return [ticket.values[slot] for ticket in tickets for slot in ticket.slots.tolist()]
