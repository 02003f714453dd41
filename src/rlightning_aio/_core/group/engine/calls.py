"""`Calls`: method calls of envs, and other requests that return a value instead of a result."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables

Call: TypeAlias = "tuple[str, tuple[Any, ...], dict[str, Any]]"
"""Name of a method and its arguments."""


class Calls:
    """Call methods, and wait for the returned values."""

    def __init__(self, tables: Tables, supervisor: Supervisor, waiting: Waiting) -> None:
        self._observed = tables.observed
        self._envs = tables.envs
        self._requests = tables.requests
        self._supervisor = supervisor
        self._waiting = waiting

    def call(self, now: float, env_ids: Sequence[str] | None, call: Call) -> Procedure[list[Any]]:
        """Call a method of envs, or of all, in parallel and return its values."""
        with self._observed.call("call", now):
            slots = self._envs.chosen(env_ids)
            send = self._prepared(now, slots, [call] * len(slots), call[0])
            ticket, _ = yield from self._waiting.ask(now, slots, send)
            return values_of(ticket)

    def prepared(
        self, now: float, env_ids: Sequence[str], calls: Sequence[Call]
    ) -> tuple[NDArray[np.intp], Callable[[Ticket], None]]:
        """Check a call of one method for each env; return the slots, and what sends the calls."""
        slots = self._envs.chosen(env_ids)
        return slots, self._prepared(now, slots, calls, calls[0][0])

    def _prepared(
        self, now: float, slots: NDArray[np.intp], calls: Sequence[Call], name: str
    ) -> Callable[[Ticket], None]:
        return self.request(now, slots, Operation.CALL, name, calls, f"the arguments of {name}()")

    def request(
        self,
        now: float,
        slots: NDArray[np.intp],
        op: Operation,
        name: str,
        arguments: Sequence[Any],
        what: str,
    ) -> Callable[[Ticket], None]:
        """Check and pack requests that return a value; return what sends them for a ticket.

        Args:
            now: monotonic seconds.
            slots: of local envs.
            op: the operation.
            name: of the method that is called, or of the operation.
            arguments: of the request to each slot.
            what: describes the arguments in messages.
        """
        self._envs.check_local(slots, f"call {name} of")
        self._waiting.check_sendable(now, slots, f"call {name} of")
        packed = [
            self._supervisor.packed(slot, own, what)
            for slot, own in zip(slots.tolist(), arguments, strict=True)
        ]

        def send(ticket: Ticket) -> None:
            entries = self._requests.issue(slots, op, ticket.owner, now)
            self._requests.methods.update(dict.fromkeys(slots.tolist(), name))
            self._supervisor.hand_over(slots, entries, packed)

        return send


def values_of(ticket: Ticket) -> list[Any]:
    """The values that calls returned, in the order of their slots.

    If calls failed, the first error is raised, with the rest as its `others`.
    """
    if ticket.faults:
        fault, *others = ticket.faults
        fault.others = tuple(others)
        raise fault
    return [ticket.values[slot] for slot in ticket.slots.tolist()]
