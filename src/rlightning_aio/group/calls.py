"""`Calls`: calls of envs' methods, and whatever else is answered by a value of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from rlightning_aio.errors import NothingPending, RLightningError
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.group.auto_reset import AutoReset
    from rlightning_aio.group.dispatch import Dispatch
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.intake import Intake
    from rlightning_aio.group.requests import Requests, Ticket
    from rlightning_aio.group.resumption import Resumption
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.group.waiting import Waiting

__all__ = ["Calls", "values_of"]

Call: TypeAlias = "tuple[str, tuple[Any, ...], dict[str, Any]]"
"""Name of a method and its arguments."""


class Calls:
    """See the module; its arguments are the group's parts."""

    def __init__(
        self,
        envs: EnvTable,
        requests: Requests,
        supervisor: Supervisor,
        dispatch: Dispatch,
        intake: Intake,
        auto: AutoReset,
        resumption: Resumption,
        waiting: Waiting,
    ) -> None:
        self._envs = envs
        self._requests = requests
        self._supervisor = supervisor
        self._dispatch = dispatch
        self._intake = intake
        self._auto = auto
        self._resumption = resumption
        self._waiting = waiting
        # Calls that `collect_calls` will answer.
        self._sent: list[Ticket] = []
        self._collecting = False

    def call(self, now: float, slot: int, call: Call) -> Procedure[Any]:
        """Call a method of one env; its value."""
        return (yield from self._call(now, self._requests.alone(slot), call))[0]

    def call_all(self, now: float, name: str) -> Procedure[None]:
        """Call a method of every env, all at once."""
        yield from self._call(now, self._envs.all, (name, (), {}))

    def _call(self, now: float, slots: NDArray[np.intp], call: Call) -> Procedure[list[Any]]:
        ticket = self._send_calls(now, slots, call)
        yield from self._waiting.until_replied(ticket)
        return values_of([ticket])

    def call_async(self, now: float, env_ids: Sequence[str] | None, call: Call) -> None:
        """Send calls of a method that `collect_calls` will answer."""
        slots = self._envs.all if env_ids is None else self._dispatch.distinct(env_ids)
        self._sent.append(self._send_calls(now, slots, call))

    def _send_calls(self, now: float, slots: NDArray[np.intp], call: Call) -> Ticket:
        return self.ask(
            now,
            slots,
            Operation.CALL,
            call[0],
            [call] * len(slots),
            f"the arguments of {call[0]}()",
        )

    def ask(
        self,
        now: float,
        slots: NDArray[np.intp],
        op: Operation,
        name: str,
        arguments: Sequence[Any],
        what: str,
    ) -> Ticket:
        """Send what is answered by a value: to each slot `op`, known as `name`, with one of the
        `arguments`, known as `what`.
        """
        self._intake.drain()
        self._dispatch.check_local(slots, f"call {name} of")
        self._dispatch.check_sendable(slots, f"call {name} of")
        packed = [
            self._dispatch.packed(slot, own, what)
            for slot, own in zip(slots.tolist(), arguments, strict=True)
        ]
        ticket = self._requests.open_ticket(slots, method=name)
        entries = self._requests.submit(slots, op, ticket.owner, now)
        self._auto.not_completed(slots)
        self._resumption.note_no_step(slots.tolist())
        self._dispatch.hand_over(slots, entries, packed)
        return ticket

    def collect_calls(self, now: float, deadline: float | None) -> Procedure[list[Any]]:
        """See `EnvGroup.collect_calls`."""
        self._supervisor.check_open()
        if self._collecting:
            raise RLightningError(
                "another collect_calls is already waiting on this group; one at a time"
            )
        if not self._sent:
            raise NothingPending("no call is outstanding; send one with call_async")
        end = None if deadline is None else now + deadline
        self._collecting = True
        try:
            while True:
                self._waiting.poll()
                remaining = sum(ticket.remaining for ticket in self._sent)
                if not remaining:
                    break
                if end is not None and now >= end:
                    raise TimeoutError(
                        f"{remaining} calls have not returned within {deadline} s; nothing is "
                        "lost, the next collect_calls gets their values"
                    )
                now = yield from self._waiting.turn(remaining, end)
        finally:
            self._collecting = False
            self._waiting.end()
        tickets, self._sent = self._sent, []
        for ticket in tickets:
            self._requests.settle(ticket)
        return values_of(tickets)


def values_of(tickets: Sequence[Ticket]) -> list[Any]:
    """What calls have returned, in the order in which they were sent.

    Raises their faults instead, if there are any: the first, with the others.
    """
    faults = [fault for ticket in tickets for fault in ticket.faults]
    if faults:
        faults[0].others = tuple(faults[1:])
        raise faults[0]
    return [ticket.values[slot] for ticket in tickets for slot in ticket.slots.tolist()]
