"""`AgentSteps`: what is asked of one env at a time, by agents, and by tasks that use handles.

An agent is a coroutine that plays one env: it resets and steps it, and calls its tools. What all
ask for in one turn of the event loop is sent as one batch, and results that are ready
together are handed out as one. One call waits for all of them, while any agent waits: a step costs
a row of a batch, and no call of its own. Where hundreds of long steps are outstanding, which end
one after another, results wait for a hundredth of a step's time, so that there are batches.
"""

from __future__ import annotations

import time
from asyncio import CancelledError
from copy import copy
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from rlightning_aio._core.group.drivers.wait import TURN, Wait
from rlightning_aio._core.group.engine.waiting import REPLIES
from rlightning_aio.batch.contents import are_over, lost_rows, values_or_faults
from rlightning_aio.batch.data import BatchedData
from rlightning_aio.errors import EnvAway, EnvFault, WorkerDied

if TYPE_CHECKING:
    from asyncio import Future
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.drivers.wait import Procedure
    from rlightning_aio._core.group.engine.calls import Calls
    from rlightning_aio._core.group.engine.resets import Resets
    from rlightning_aio._core.group.engine.steps import Steps
    from rlightning_aio._core.group.engine.waiting import Waiting
    from rlightning_aio._core.group.state.requests import Ticket
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.outcomes import Outcome
    from rlightning_aio.types import EnvRet, MultiAgentEnvRet, PolicyResponse

_MANY: Final = 400
"""With this number of steps outstanding, several end in a hundredth of the time of one."""
_SHARE: Final = 0.01
"""How much later, as a share of its time, a step may end for a batch with others."""
_SHORTEST_PAUSE, _LONGEST_PAUSE = 0.001, 0.01
"""Seconds; an event loop's timers know no less than the first."""


class StepEnd(NamedTuple):
    """What a step has led to.

    Attributes:
        ret: the result.
        is_over: it ends the episodes of all agents and sub-environments.
        lost: the batch of that result, if it begins an episode in place of what was asked, as the
            one before was lost.
    """

    ret: EnvRet | MultiAgentEnvRet
    is_over: bool
    lost: BatchedData | None


class EpisodeStart(NamedTuple):
    """What an agent's env is reset with; see `Env.reset`."""

    seed: int | None
    options: dict[str, Any] | None


class MethodCall(NamedTuple):
    """A call of a method of an env, such as a tool."""

    name: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]


class AgentStep:
    """A step, a reset or a call that was asked for.

    Args:
        env_id: of its env.
        what: the response that the env is stepped with, what it is reset with, or the call.
        reply: gets its `StepEnd`, the value of a call, or the error; done early if its caller is
            cancelled.

    Attributes:
        env_id, what, reply: as given.
        number: of its request, as it was sent, if it is a reset.
        is_outstanding: it was sent, and has not ended.
        is_collectable: if its caller is cancelled, its result is for the collector.
    """

    __slots__ = ("env_id", "is_collectable", "is_outstanding", "number", "reply", "what")

    def __init__(
        self, env_id: str, what: PolicyResponse | EpisodeStart | MethodCall, reply: Future[Any]
    ) -> None:
        self.env_id = env_id
        self.what = what
        self.reply = reply
        self.number = 0
        self.is_outstanding = self.is_collectable = False

    @property
    def kind(self) -> object:
        """A key that steps share which can be sent as one batch."""
        if isinstance(self.what, MethodCall):
            return "call", self.what.name
        if not isinstance(self.what, EpisodeStart):
            return "step"
        seed, options = self.what
        return ("seeded" if seed is not None else "reset") if options is None else self


class AgentSteps:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self, tables: Tables, steps: Steps, resets: Resets, calls: Calls, waiting: Waiting
    ) -> None:
        self._tables = tables
        self._requests = tables.requests
        self._steps = steps
        self._resets = resets
        self._calls = calls
        self._waiting = waiting
        self._asked: list[AgentStep] = []
        # Those that are outstanding, by slot.
        self._sent: dict[int, AgentStep] = {}
        self._is_served = self._is_pausing = False

    def ask(self, step: AgentStep) -> bool:
        """Have a step sent.

        Returns True if the caller is to run `serve`, which begins in a later turn of its loop.
        """
        self._asked.append(step)
        if not self._is_served:
            self._is_served = True
            return True
        if len(self._asked) == 1:
            self._waiting.wake()
        return False

    def leave(self, step: AgentStep) -> None:
        """Leave a result to the collector, as its caller was cancelled; a value is dropped."""
        slot = self._tables.envs.find_one(step.env_id)
        is_own = self._requests.owner.item(slot) > 0  # It was not aborted.
        if is_own and self._sent.get(slot) is step:
            self._ended(slot)
            self._waiting.leave(slot)

    def loss(self, env_id: str) -> Outcome | None:
        """The loss of an idle env's episode since its newest result; None if it has not lost it."""
        why = self._tables.episodes.why_lost(self._tables.envs.find_one(env_id))
        return None if why is None else why.outcome(env_id)

    def seconds_in_env(self, env_id: str) -> float | None:
        """Seconds that an env has spent on what is in flight, or else on its newest result.

        None while a request waits in the queue of `max_concurrency`; only entries with one are
        asked for what is in flight.
        """
        slot, layout = self._tables.envs.find_one(env_id), self._tables.layout
        slab = layout.slabs[layout.slab.item(slot)]
        ns = slab.busy_ns.item(layout.row.item(slot))
        if slot in self._sent:
            return (time.monotonic_ns() + ns) / 1e9 if ns < 0 else None
        return max(ns, 0) / 1e9

    def queues(self, env_id: str) -> bool:
        """Return True if requests to an env may wait in a queue of `max_concurrency`."""
        record = self._tables.record_of(self._tables.envs.find_one(env_id))
        return record.config.max_concurrency is not None

    def serve(self, now: float) -> Procedure[None]:
        """Send the steps that agents ask for, and hand out their results, until none is left."""
        try:
            yield from self._waiting.serve(now, self._work, self._sent)
        except BaseException as error:
            self.fail(error)
            if not isinstance(error, Exception):
                raise
        self._is_served = False

    def _work(self, ticket: Ticket, now: float) -> Wait | None:
        """Hand out what is ready and send what is asked for; return what to wait for."""
        if self._is_pausing:
            self._is_pausing = False
        elif until := self._pause(ticket, now):
            self._is_pausing = True
            return Wait(until)
        has_handed_out = self._hand_out(ticket)
        asked = [step for step in self._asked if not step.reply.done()]
        self._asked.clear()
        if asked:
            by_kind: dict[object, list[AgentStep]] = {}
            for step in asked:
                by_kind.setdefault(step.kind, []).append(step)
            for alike in by_kind.values():
                self._send(alike, ticket, now)
            self._waiting.poll()  # Some may have ended at once.
            has_handed_out = self._hand_out(ticket) or has_handed_out
        if has_handed_out:
            return TURN  # Agents ask for their next steps in it.
        return REPLIES if self._sent or self._asked else None

    def _pause(self, ticket: Ticket, now: float) -> float:
        """Return when to hand out a ready result with those that come soon; 0.0: now."""
        if len(self._sent) < _MANY or not ticket.ended or ticket.errors or self._asked:
            return 0.0
        ended = [slot for slots in ticket.ended for slot in slots.tolist()]
        if any(self._sent[slot].reply.done() for slot in ended):
            return 0.0  # Its agent has left, and its env is to be free.
        since = self._requests.sent_ns.item(ticket.ended[0].item(0)) / 1e9
        pause = min((now - since) * _SHARE, _LONGEST_PAUSE)
        return now + pause if pause >= _SHORTEST_PAUSE else 0.0

    def _send(self, asked: Sequence[AgentStep], ticket: Ticket, now: float) -> None:
        """Send steps as one batch; if that can't be, one by one, so that each has its own error.

        Those of a batch are of one kind.
        """
        try:
            slots, send = self._prepared(asked, now)
        except Exception as error:  # noqa: BLE001  # Nothing was sent.
            # A loss is raised once, for all envs that it names.
            named = error.env_ids if isinstance(error, WorkerDied | EnvAway) else ()
            for step in asked:
                if len(asked) == 1 or step.env_id in named:
                    step.reply.set_exception(copy(error))
                else:
                    self._send([step], ticket, now)
            return
        for slot, step in zip(slots.tolist(), asked, strict=True):
            self._sent[slot] = step
            step.is_outstanding = True
        ticket.remaining += len(slots)
        send(ticket)
        if isinstance(asked[0].what, EpisodeStart):
            for slot, step in zip(slots.tolist(), asked, strict=True):
                step.number = self._requests.numbering.number(slot)

    def _prepared(
        self, asked: Sequence[AgentStep], now: float
    ) -> tuple[NDArray[np.intp], Callable[[Ticket], None]]:
        """Check steps of one kind; return their slots, and what sends them."""
        env_ids, first = [step.env_id for step in asked], asked[0].what
        if isinstance(first, EpisodeStart):
            seeds: Any = None
            if first.seed is not None:
                seeds = [cast("EpisodeStart", step.what).seed for step in asked]
            return self._resets.prepared(now, seeds, first.options, env_ids)
        if isinstance(first, MethodCall):
            each = [cast("MethodCall", step.what) for step in asked]
            calls = [(call.name, call.args, call.kwargs) for call in each]
            return self._calls.prepared(now, env_ids, calls)
        batch = BatchedData(env_ids, [step.what for step in asked])
        # Of several, each is sent by itself then, and only one with a wrong action stops.
        slots, packed = self._steps.write(batch, now, stops=len(asked) == 1)
        return slots, partial(self._steps.send, slots, packed, now)

    def _hand_out(self, ticket: Ticket) -> bool:
        """Give each agent whose request has ended its result or error; False if there is none."""
        if not ticket.errors and not ticket.ended:
            return False
        for slot in [slot for slots in ticket.ended for slot in slots.tolist()]:
            step = self._sent[slot]
            if step.is_collectable and step.reply.done():  # Its caller has yet to leave it.
                self.leave(step)
        for slot, fault in ticket.errors.items():
            if not (reply := self._ended(slot)).done():
                reply.set_exception(fault)
        ticket.errors.clear()
        for slot, value in ticket.values.items():
            if not (reply := self._ended(slot)).done():
                reply.set_result(value)
        ticket.values.clear()
        slots = self._requests.take_ended(ticket)
        if len(slots):
            batch, _ = self._steps.hand_out(slots)
            self._resolve(batch, slots)
        return True

    def _resolve(self, batch: BatchedData, slots: NDArray[np.intp]) -> None:
        lost = lost_rows(batch)
        rows = zip(slots.tolist(), values_or_faults(batch), are_over(batch), strict=True)
        for row, (slot, ret, is_over) in enumerate(rows):
            step = self._sent[slot]
            if (reply := self._ended(slot)).done():
                continue
            if isinstance(ret, EnvFault):
                reply.set_exception(ret)
            else:
                is_lost = row in lost and not self._is_begun_as_asked(slot, step)
                loss = batch.take([row]) if is_lost else None
                reply.set_result(StepEnd(ret, is_over, loss))

    def _is_begun_as_asked(self, slot: int, step: AgentStep) -> bool:
        """Return True for a reset that was not sent again: what it reports was lost before it."""
        number = self._requests.numbering.number(slot)
        return isinstance(step.what, EpisodeStart) and step.number == number

    def _ended(self, slot: int) -> Future[Any]:
        step = self._sent.pop(slot)
        step.is_outstanding = False
        return step.reply

    def fail(self, error: BaseException) -> None:
        """Pass an error that has ended `serve` to all who wait."""
        self._is_served = False
        steps = [*self._sent.values(), *self._asked]
        self._sent.clear()
        self._asked.clear()
        for step in steps:
            if step.reply.done():
                continue
            if isinstance(error, CancelledError):
                step.reply.cancel()
            else:
                step.reply.set_exception(error)
