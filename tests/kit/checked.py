"""`CheckedRequests`: each change of a request's state is checked against the table `LEGAL`.

It applies each event to a copy of the table by `LEGAL`, and compares the two. So it refuses an
event that can't happen, a change that the event doesn't make, and a change without an event.
`install` has all groups of this process use it.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from rlightning_aio._core.group.setup import build
from rlightning_aio._core.group.state.request_states import (
    COLLECTOR,
    LEGAL,
    NOBODY,
    Event,
    Owner,
    State,
)
from rlightning_aio._core.group.state.requests import Requests
from rlightning_aio.protocol.entries import ANSWERS_WITH_VALUE

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.conditions import Conditions
    from rlightning_aio._core.group.state.requests import Ticket

Change: TypeAlias = "tuple[Event, NDArray[np.intp]]"
Changes: TypeAlias = "list[Change]"
Rules: TypeAlias = "dict[str, Callable[[Any, Any], Changes]]"

_OWNERS: Final = list(Owner)
_TICKET: Final = _OWNERS.index(Owner.TICKET)
_NOBODY: Final = _OWNERS.index(Owner.NOBODY)
_IDLE: Final = int(State.IDLE)
_ILLEGAL: Final = -1


def _code(state: State, owner: Owner) -> int:
    """Number a situation: a state, and the kind of its owner."""
    return state * len(_OWNERS) + _OWNERS.index(owner)


def _codes_after(event: Event) -> NDArray[np.int64]:
    """Return the situation after `event`, by the situation before it."""
    after = np.full(len(State) * len(Owner), _ILLEGAL)
    for (state, owner, possible), situation in LEGAL.items():
        if possible is event:
            after[_code(state, owner)] = _code(*situation)
    return after


_AFTER: Final = {event: _codes_after(event) for event in Event}


def _asked(slots: NDArray[np.intp], owner: int) -> Changes:
    return [(Event.SENT if owner == COLLECTOR else Event.SENT_FOR_CALL, slots)]


def _left(requests: Requests, ticket: Ticket) -> Changes:
    slots = ticket.own_slots(requests.owner)
    slots = slots[requests.state[slots] != State.IDLE]  # An interrupt came before it was sent.
    values = slots[ANSWERS_WITH_VALUE[requests.numbering.ops(slots)]]
    return [(Event.METHOD_LEFT, values), (Event.LEFT, np.setdiff1d(slots, values))]


_OF_REQUESTS: Final[Rules] = {
    "issue": lambda _, args: _asked(args[0], owner=args[2]),
    "publish": lambda _, args: _asked(args[0], owner=args[2]),
    "ask_again": lambda _, args: [(Event.ASKED_AGAIN, args[1])],
    "deliver": lambda _, args: [(Event.RESULT, args[0])],
    "set_value": lambda it, args: [(Event.VALUE, it.alone(args[0]))],
    "fail": lambda _, args: [(Event.FAULT, args[0])],
    "hand_out": lambda _, args: [(Event.HANDED_OUT, args[0])],
    "abort": lambda _, args: [(Event.ABORTED, args[0])],
    "drop_unwanted": lambda it, args: [(Event.DROPPED, args[0][it.owner[args[0]] == NOBODY])],
    "drop": lambda _, args: [(Event.DROPPED, args[0])],
    "close": lambda _, args: [(Event.CLOSED, args[0].slots)],
    "take_ended": lambda _, args: [(Event.CLOSED, slots) for slots in args[0].ended],
    "leave": lambda it, args: _left(it, *args),
}
"""The changes that each method makes, by its arguments."""
_OF_QUEUE: Final[Rules] = {
    "free": lambda it, args: [(Event.FREED, np.array([k for k in args[0] if k in it.errors], int))],
}


def _check(table: Any, owner: Any, methods: Rules) -> None:
    """Have `table` check what the methods of `owner`, a part of it or itself, change."""

    def wrap(name: str) -> None:
        method, changes = getattr(owner, name), methods[name]

        def checked(*args: Any) -> Any:
            with table.changes(*changes(owner, args)):
                return method(*args)

        setattr(owner, name, checked)

    for name in methods:
        wrap(name)


class CheckedRequests(Requests):
    """`Requests` that raises `RuntimeError` at a change that `LEGAL` doesn't allow."""

    def __init__(
        self, host_of: NDArray[np.int64], num_hosts: int, conditions: Conditions | None = None
    ) -> None:
        super().__init__(host_of, num_hosts, conditions)
        self._known = self._situations()
        self._is_changing = False
        _check(self, self, _OF_REQUESTS)
        _check(self, self.collector, _OF_QUEUE)

    def _situations(self) -> NDArray[np.int64]:
        """Return the situation of each slot; an idle slot has no owner."""
        kinds = np.where(self.owner > 0, _TICKET, 0)
        kinds[self.owner < 0] = _NOBODY
        kinds[self.state == _IDLE] = 0
        return self.state.astype(np.int64) * len(_OWNERS) + kinds

    @contextlib.contextmanager
    def changes(self, *events: Change) -> Generator[None]:
        """Check that the context does to slots what these events mean, and nothing else."""
        if self._is_changing:  # The event is a part of another.
            yield
            return
        self._compare(self._known, "without an event")
        expected = self._known.copy()
        for event, slots in events:
            before = self._known[slots]
            after = _AFTER[event][before]
            illegal = np.flatnonzero(after == _ILLEGAL)
            if len(illegal):
                k = illegal.item(0)
                raise RuntimeError(
                    f"{event.name} can't happen to slot {slots[k]}, which is "
                    f"{_named(before.item(k))}"
                )
            expected[slots] = after
        try:
            self._is_changing = True
            yield
            self._compare(expected, f"by {', '.join(event.name for event, _ in events)}")
            self._known = expected
        except BaseException:
            self._known = self._situations()
            raise
        finally:
            self._is_changing = False

    def _compare(self, expected: NDArray[np.int64], how: str) -> None:
        found = self._situations()
        wrong = np.flatnonzero(found != expected)
        if len(wrong):
            slot = wrong.item(0)
            raise RuntimeError(
                f"slot {slot} became {_named(found.item(slot))} {how}; it would be "
                f"{_named(expected.item(slot))}"
            )


def _named(code: int) -> str:
    state, owner = divmod(code, len(_OWNERS))
    return f"{State(state).name} for {_OWNERS[owner].name}"


def install() -> None:
    """Have each group that is built from now on check its requests."""
    build.Requests = CheckedRequests
