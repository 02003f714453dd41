"""`Intake`: what completions mean: for requests, for results, and after a death.

Hosts append to one queue. What they report takes effect here, and nowhere else.
Rule: it sends no requests of its own, except those that a dead worker owed; the replacement
answers them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.errors import ActionRefused, BadAction, EnvAway, EnvRaised
from rlightning_aio.group.requests import COLLECTOR
from rlightning_aio.group.supervisor import GivenUp, Replaced
from rlightning_aio.hosts.messages import (
    Attached,
    Built,
    Closed,
    Died,
    ErrorText,
    Failed,
    Joined,
    NewSchema,
    NotBuilt,
    Raised,
    Reported,
    Result,
    Saved,
    Value,
    Withdrawn,
)
from rlightning_aio.protocol.entries import Operation, answers_with_value

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.errors import EnvFault
    from rlightning_aio.group.auto_reset import AutoReset
    from rlightning_aio.group.dispatch import Dispatch
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.recovery import Recovery
    from rlightning_aio.group.requests import Requests
    from rlightning_aio.group.results import Results
    from rlightning_aio.group.resumption import Resumption
    from rlightning_aio.group.slab_layout import SlabLayout
    from rlightning_aio.group.stats import Stats
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.hosts.base import Host
    from rlightning_aio.hosts.messages import Completions

__all__ = ["Intake"]

_BAD_ACTION = f"{BadAction.__module__}.{BadAction.__qualname__}"


class Intake:
    """See the module; its arguments are the group's parts.

    Attributes:
        now: when the driver looked last (monotonic seconds).
        held_back: envs that have come back before the last result of their going was
            collected, by slot; see `admit`.
    """

    def __init__(
        self,
        completions: Completions,
        envs: EnvTable,
        requests: Requests,
        layout: SlabLayout,
        supervisor: Supervisor,
        dispatch: Dispatch,
        results: Results,
        recovery: Recovery,
        resumption: Resumption,
        auto: AutoReset,
        stats: Stats,
    ) -> None:
        self.now = 0.0
        self._completions = completions
        self._envs = envs
        self._requests = requests
        self._layout = layout
        self._supervisor = supervisor
        self._dispatch = dispatch
        self._results = results
        self._recovery = recovery
        self._resumption = resumption
        self._auto = auto
        self._stats = stats
        self.held_back: dict[int, Joined] = {}
        self._handlers: dict[type, Callable[[Any], None]] = {
            Reported: self._on_reported,
            Result: self._on_result,
            Value: self._on_value,
            Raised: self._on_raised,
            Failed: self._on_failed,
            Withdrawn: self._on_withdrawn,
            NewSchema: self._on_new_schema,
            Joined: self._on_joined,
            Saved: self._on_saved,
            Died: self._on_died,
            **dict.fromkeys((Built, NotBuilt, Attached, Closed), supervisor.handle),
        }

    def drain(self) -> None:
        """Take in what hosts have told. Here, and nowhere else, completions take effect."""
        completions, handlers = self._completions, self._handlers
        while completions:
            told = completions.popleft()
            handlers[type(told)](told)

    def _on_reported(self, told: Reported) -> None:
        reports = [told]
        completions = self._completions
        while completions and type(completions[0]) is Reported:
            reports.append(cast("Reported", completions.popleft()))
        slots = self._requests.complete(reports)
        if self._supervisor.recovering:
            self._note_recovered(slots)

    def _on_result(self, told: Result) -> None:
        slot = self._requests.complete_one(told.host_id, told.entry)
        if slot is not None:
            self._results.keep(slot, told.out_of_band)
            if told.is_loss:
                self._results.mark_lost(slot)
            if self._supervisor.recovering:
                self._note_recovered(self._requests.alone(slot))

    def _on_value(self, told: Value) -> None:
        slot = self._requests.end(told.host_id, told.entry)
        if slot is not None:
            self._requests.set_value(slot, told.value)

    def _on_raised(self, told: Raised) -> None:
        slot = self._requests.end(told.host_id, told.entry)
        if slot is not None:
            self._fail(self._requests.alone(slot), lambda _: self.raised(slot, told.error))

    def raised(self, slot: int, error: ErrorText) -> EnvRaised:
        """What the caller is told of `error`, in which the current request of `slot` ended."""
        cause = self._recovery.failed(slot)
        after = f" (its worker {cause}, and was replaced)" if cause else ""
        op = self._requests.op(slot)
        doing = Operation(op).name.lower()
        go_on = "reset the env to go on"
        if answers_with_value(op):
            doing = f"the call of {self._requests.method(slot)}()"
            go_on = "the env is still usable"
        kind = ActionRefused if error.type_name == _BAD_ACTION else EnvRaised
        return kind(
            f"{self._envs.describe(slot)} raised in {doing}: {error.summary}{after}; the remote "
            f"traceback is above; {go_on}",
            env_id=self._envs.env_ids[slot],
            exception_type=error.type_name,
            exception_text=error.text,
            traceback_text=error.traceback,
        )

    def _on_failed(self, told: Failed) -> None:
        slot = self._requests.end(told.host_id, told.entry)
        if slot is not None:
            self._fail(self._requests.alone(slot), lambda _: told.fault)

    def _on_withdrawn(self, told: Withdrawn) -> None:
        slot = self._requests.end(told.host_id, told.entry)
        if slot is None:
            return
        if self._requests.owner[slot] == COLLECTOR:
            self._requests.withdraw(slot)
            self._auto.not_completed(self._requests.alone(slot))
            return
        text = (
            f"the client of {self._envs.describe(slot)} is not connected; its next first result "
            "comes through collect_async when it is back"
        )
        away = EnvAway(text, env_id=self._envs.env_ids[slot])
        self._fail(self._requests.alone(slot), lambda _: away)

    def _on_new_schema(self, told: NewSchema) -> None:
        host = self._supervisor.hosts[told.host_id]
        self._results.note_schema(host.first_slot, told.number, told.schema)

    def _on_joined(self, told: Joined) -> None:
        host = self._supervisor.hosts[told.host_id]
        slot = host.first_slot + told.env_index
        if told.slab is not None:
            self._layout.add(told.slab, host.first_slot)
        if not self._requests.is_idle(slot):
            self.held_back[slot] = told
            return
        has_row = self._layout.of(slot)[0].action is not None
        if self._envs.env_ids[slot] not in ("", told.meta.env_id):
            self._stats.begin_anew(slot)
        self._envs.note_joined(slot, host.first_slot, told.meta, told.traits, has_row=has_row)
        self._auto.note_joined(slot)
        self._requests.join(slot, self.now)
        self._results.note_sent(self._requests.alone(slot), None)
        self._results.keep(slot, told.write() or {})

    def _on_saved(self, told: Saved) -> None:
        slot = self._supervisor.hosts[told.host_id].first_slot + told.env_index
        self._resumption.note_saved(slot, told.standing, before=told.before)

    def _fail(
        self, slots: NDArray[np.intp], error_for: Callable[[NDArray[np.intp]], EnvFault]
    ) -> None:
        """End requests that are in flight no more with one error for each caller."""
        self._auto.not_completed(slots[~self._awaits_value(slots)])
        for owner, mine in self._requests.owners(slots).items():
            self._requests.fail(mine, owner, error_for(mine))

    def _on_died(self, told: Died) -> None:
        verdict = self._supervisor.bury(told)
        if isinstance(verdict, GivenUp):
            self._recovery.give_up(_slots_of_host(verdict.host))
            self._resumption.forget(_slots_of_host(verdict.host))
            self._supervisor.note_recovery(any_telling=self._recovery.any_telling)
            self._fail(verdict.owed, verdict.error_for)
        elif verdict is not None:
            self._go_on(verdict)

    def _go_on(self, verdict: Replaced) -> None:
        """Have the replacement of a worker answer what its predecessor owed."""
        host, owed = verdict.host, verdict.owed
        slots = _slots_of_host(host)
        for slot in self._requests.ready(np.array(slots, np.intp)).tolist():
            # Decoded now: what can read it is about to change.
            self._results.detach_info(slot)
        self._results.begin_schemas(slots)
        if not verdict.resets:
            self._fail(owed, verdict.error_for)
            return
        self._recovery.lose(slots, verdict.cause)
        # A replacement answers for steps and resets, but not for calls.
        calls = self._awaits_value(owed)
        self._fail(owed[calls], verdict.error_for)
        owed = owed[~calls]
        if len(owed):
            self._recovery.tell(owed)
            stepped = self._requests.ops(owed) == int(Operation.STEP)
            seeds, lost = self._resumption.seeds(owed, stepped)
            for slot, num_steps in lost.items():
                self._auto.rewind(slot, num_steps, owes=True)
            entries = self._requests.restart(owed)
            self._layout.write_seeds(owed, seeds)
            self._dispatch.hand_over(owed, entries)

    def _awaits_value(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` were asked for a value, and not for a result."""
        ops: list[int] = self._requests.ops(slots).tolist()
        return np.array([answers_with_value(op) for op in ops], np.bool_)

    def _note_recovered(self, slots: NDArray[np.intp]) -> None:
        """Mark replies that come from a replacement; count what shows that it works."""
        for slot in slots.tolist():
            cause = self._recovery.told(slot)
            if cause is not None:
                self._results.mark_restarted(slot, cause, self._resumption.told(slot))
            elif self._requests.op(slot) == Operation.STEP:
                self._supervisor.note_step(slot)
        self._supervisor.note_recovery(any_telling=self._recovery.any_telling)

    def admit(self, slots: NDArray[np.intp]) -> None:
        """Take in those that have come back to `slots`, whose rows are free now."""
        for slot in slots.tolist():
            if slot in self.held_back:
                self._on_joined(self.held_back.pop(slot)._replace(slab=None))


def _slots_of_host(host: Host) -> range:
    return range(host.first_slot, host.first_slot + host.num_envs)
