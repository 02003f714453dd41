"""`Intake`: applies completions to requests and results, and carries out what a death means.

Hosts post to one queue, and only this module applies its completions.
Rule: it sends no requests of its own. It sends outstanding ones again after a loss, held ones to a
client that has come, and to the next worker a reset that a recycled one has handed on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio._core.group.supervision.fault_messages import without_terminal
from rlightning_aio._core.hosts.messages import (
    Attached,
    Built,
    Closed,
    Died,
    Lost,
    Moved,
    NewSchema,
    NotBuilt,
    Raised,
    Reported,
    Result,
    Taken,
    Value,
)
from rlightning_aio.errors import EnvAway, env_raised
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation, answers_with_value, op_of
from rlightning_aio.protocol.slab import AS_BEFORE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.engine.results import Results
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.supervision.supervisor import Supervisor
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.errors import EnvFault, EnvRaised
    from rlightning_aio.outcomes import Blame
    from rlightning_aio.protocol.error_text import ErrorText

_ASKED_AGAIN: Final = (int(Operation.STEP), int(Operation.RESET))


class Intake:
    """See the module; the arguments are the group's parts."""

    def __init__(
        self,
        tables: Tables,
        supervisor: Supervisor,
        results: Results,
    ) -> None:
        self._completions = tables.completions
        self._conditions = tables.conditions
        self._envs = tables.envs
        self._requests = tables.requests
        self._record_of = tables.record_of
        self._slots_of = tables.slots_of
        self._layout = tables.layout
        self._lifetime = tables.lifetime
        self._supervisor = supervisor
        self._results = results
        self._episodes = tables.episodes
        self._sums = tables.sums
        self._handlers: dict[type, Callable[[Any], None]] = {
            Reported: self._on_reported,
            Result: self._on_result,
            Value: self._on_value,
            Raised: self._on_raised,
            Lost: self._on_lost,
            Moved: self._on_moved,
            NewSchema: self._on_new_schema,
            Taken: self._on_taken,
            Died: self._on_died,
            Built: self._on_built,
            **dict.fromkeys((NotBuilt, Attached, Closed), supervisor.handle),
        }

    def apply_completions(self) -> None:
        """Apply queued completions."""
        completions, handlers = self._completions, self._handlers
        while completions:
            completion = completions.popleft()
            handlers[type(completion)](completion)

    def _on_built(self, completion: Built) -> None:
        """Pass it on: from now on a worker announces its own ways of holding infos."""
        slots: list[int] = self._slots_of(self._supervisor.records[completion.host_id]).tolist()
        self._results.begin_schemas(completion.host_id, slots)
        self._supervisor.handle(completion)

    def _on_reported(self, completion: Reported) -> None:
        reports = [completion]
        completions = self._completions
        while completions and type(completions[0]) is Reported:
            reports.append(cast("Reported", completions.popleft()))
        self._note_answered(self._requests.complete(reports))

    def _on_result(self, completion: Result) -> None:
        slot = self._requests.end(completion.host_id, completion.entry)
        if slot is None:
            return
        self._requests.deliver(self._requests.alone(slot))
        if completion.out_of_band:
            self._results.keep(slot, completion.out_of_band)
        self._record_of(slot).was_shown = True
        if self._conditions.unusual:
            self._note_answered(self._requests.alone(slot))

    def _on_value(self, completion: Value) -> None:
        slot = self._requests.end(completion.host_id, completion.entry)
        if slot is not None:
            self._requests.set_value(slot, completion.value)

    def _on_raised(self, completion: Raised) -> None:
        slot = self._requests.end(completion.host_id, completion.entry)
        if slot is None:
            return
        fault = self.apply_error(slot, completion.error)
        if fault is not None:
            self._fail(self._requests.alone(slot), lambda _: fault)
            return
        # What is in flight has changed, and nobody gets a reply.
        self._requests.anything_ended = True
        self._send_again(completion.host_id, self._requests.alone(slot))

    def apply_error(self, slot: int, error: ErrorText) -> EnvRaised | None:
        """Return the error that the current request of `slot` ends in, as its env raised `error`.

        None if the env is restarted instead: its episode is lost, which its next result reports.
        """
        lost = self._episodes.ended_without_result(slot)
        fault = self._fault_of(slot, error, lost)
        if self._requests.numbering.op(slot) == Operation.RESTORE:  # It is in no known state.
            self._episodes.lose([slot], _not_restored(fault))
            return fault
        if not self._supervisor.losses.ends_env(slot, error):
            return fault
        kind, blame = fault.outcome.kind, fault.outcome.blame
        why = lost or Loss(f"raised {error.summary}", kind, blame, fault.env_id)
        self._episodes.lose([slot], why)
        return None if self._supervisor.losses.count_restart(slot, error, fault) else fault

    def _fault_of(self, slot: int, error: ErrorText, lost: Loss | None) -> EnvRaised:
        """Make the error; `lost`: the loss that the result would have reported."""
        after = f" (its worker or env {lost.cause}, and was replaced)" if lost is not None else ""
        after += without_terminal(error, self._record_of(slot))
        op = self._requests.numbering.op(slot)
        doing = Operation(op).name.lower()
        go_on = "reset the env to go on"
        if answers_with_value(op):
            doing = f"the call of {self._requests.methods[slot]}()"
            go_on = "the env is still usable"
        raised = env_raised(
            f"{self._envs.describe(slot)} raised in {doing}: {error.summary}{after}; its "
            f"__cause__ is the remote traceback; {go_on}",
            env_id=self._envs.env_ids[slot],
            exception_type=error.type_name,
            exception_text=error.text,
            traceback_text=error.traceback,
        )
        begins = op in (Operation.RESET, Operation.RESTORE)
        known = raised.outcome
        if lost is not None:  # That is how the episode of the request has ended.
            raised.outcome = lost.outcome(known.env_id)
            return raised
        raised.outcome = replace(
            known,
            kind="not_started" if begins else known.kind,
            blame=cast("Blame", error.blame) or ("env" if begins else known.blame),
            cause=error.summary,
        )
        return raised

    def _on_lost(self, completion: Lost) -> None:
        """Carry out what the loss of one env means: as of a death, for it alone."""
        host_id, why = completion.host_id, completion.why
        slot = self._supervisor.records[host_id].slots[completion.env_index]
        if completion.answered and self._requests.is_current(completion.answered):
            # That answer was given before the loss, but travels in a ring, and not in a frame.
            self._supervisor.hosts[host_id].poll()
            self._completions.append(completion._replace(answered=0))
            return
        wanted = completion.entry and self._requests.end(host_id, completion.entry) is not None
        if not wanted:
            if self._episodes.why_lost(slot) is None:  # Else that is known, as after an abort.
                self._episodes.lose([slot], why)
                entry = self._requests.numbering.entry.item(slot)
                is_stepped = op_of(entry) == Operation.STEP and self._requests.is_current(entry)
                if not is_stepped:  # Else its step is lost, too.
                    losses = self._supervisor.losses
                    replaced, fault = losses.count_env(slot, why, completion.message)
                    if not replaced:
                        losses.raise_later([slot], fault)
            return
        self._episodes.lose([slot], why)
        replaced, fault = self._supervisor.losses.count_env(slot, why, completion.message)
        alone = self._requests.alone(slot)
        resets = not self._record_of(slot).is_hardware
        if replaced and resets and self._requests.numbering.op(slot) in _ASKED_AGAIN:
            self._requests.anything_ended = True
            self._send_again(host_id, alone)
        else:
            self._fail(alone, lambda _: fault)

    def _on_taken(self, completion: Taken) -> None:
        """Give a client the request that was held for it.

        What moves something real gets a reset that its user has asked for, and nothing else: a
        request without arguments is one that was made of a step, or of one that was lost.
        """
        record = self._supervisor.records[completion.host_id]
        for entries, arguments in self._supervisor.take(completion):
            if record.is_hardware and arguments is None:
                self._requests.in_flight[completion.host_id] -= len(entries)
                self._fail(self._supervisor.places.drop([record]), self._away)
            else:
                record.host.submit(entries, arguments)
        self._requests.anything_ended = True

    def _away(self, slots: NDArray[np.intp]) -> EnvAway:
        slot = slots.item(0)
        return EnvAway(
            f"{self._envs.describe(slot)} moves something real now, and only a reset that you ask "
            "for may set that in motion; reset it to go on",
            env_id=self._envs.env_ids[slot],
        )

    def end_held(self, records: Sequence[HostRecord]) -> None:
        """End requests that have waited for clients for too long, with one error for each call."""
        slots = self._supervisor.places.drop(records)
        away = self._supervisor.places.away
        self._fail(slots, lambda mine: away([self._record_of(slot) for slot in mine.tolist()]))

    def _on_new_schema(self, completion: NewSchema) -> None:
        self._results.note_schema(completion.host_id, completion.number, completion.schema)

    def _on_moved(self, completion: Moved) -> None:
        """Send a reset that a worker has not executed to the next one, or back to it."""
        slot = self._requests.end(completion.host_id, completion.entry)
        if slot is None or self._lifetime.closed:  # The next worker has its order to close.
            return
        renewals = self._supervisor.renewals
        host_id = renewals.take_over(completion, slot)
        self._requests.anything_ended = True  # To start a worker disarms the bell.
        self._requests.in_flight[host_id] += 1
        entries = np.array([completion.entry], np.int64)
        self._supervisor.submit(host_id, entries, [completion.arguments])
        renewals.close_if_left(completion.host_id)

    def _fail(
        self, slots: NDArray[np.intp], error_for: Callable[[NDArray[np.intp]], EnvFault]
    ) -> None:
        """End requests that are no longer in flight, with one error for each caller."""
        for owner, mine in self._requests.owners(slots):
            fault = error_for(mine)
            counted = self._sums.note_failures(mine, fault.outcome.kind)
            self._episodes.note_counted(counted.tolist())
            self._requests.fail(mine, owner, fault)

    def _on_died(self, completion: Died) -> None:
        """Carry out what a death means: mark lost, end requests, replace, send again."""
        loss = self._supervisor.handle_exit(completion)
        if loss is None:
            return
        requests, episodes = self._requests, self._episodes
        requests.in_flight[loss.host_id] = 0  # It answers none of them.
        unwanted = requests.unwanted & {*loss.owed.tolist()}
        owed = requests.drop_unwanted(loss.owed)
        self._keep_ready(loss.slots)
        record = self._supervisor.records[loss.host_id]
        if record.place is None or record.was_shown:  # Else it has no episode yet.
            # The episodes of aborted requests were lost before.
            over = {slot for slot in unwanted if episodes.why_lost(slot) is not None}
            episodes.lose([slot for slot in loss.slots if slot not in over], loss.why)
        # A replacement answers steps and resets only.
        again = np.isin(requests.numbering.ops(owed), _ASKED_AGAIN)
        again &= loss.resets and loss.replaced
        if record.place is not None and not again.any():
            record.place.drop_reset()  # Nobody waits for what the client owed.
        self._fail(owed[~again], loss.error)
        if not (loss.replaced or len(owed)):
            self._supervisor.losses.raise_later(loss.slots, loss.refusal())
        host_id = self._supervisor.replace(loss.host_id)
        self._send_again(host_id, owed[again])

    def _keep_ready(self, slots: Sequence[int]) -> None:
        """Decode infos of results that are ready, as a replacement announces other schemas."""
        for slot in self._requests.ready(np.array(slots, np.intp)).tolist():
            self._results.detach_info(slot)

    def _send_again(self, host_id: int, slots: NDArray[np.intp]) -> None:
        """Send outstanding steps and resets again, as resets: their worker or env is gone."""
        if not len(slots):
            return
        self._episodes.report_losses(slots)
        entries = self._requests.ask_again(host_id, slots)
        if self._supervisor.records[host_id].place is None:  # Which remembers its reset itself.
            self._layout.write_seeds(slots, np.full(len(slots), AS_BEFORE))
        self._supervisor.submit(host_id, entries, None)

    def _note_answered(self, slots: NDArray[np.intp]) -> None:
        """Mark results that report a loss, and let steps show that a replacement works."""
        if self._episodes.exceptional:
            for report in self._episodes.take_answers(slots):
                self._results.mark_restarted(report)
                if not report.is_counted:
                    self._sums.note_loss(report.slot, report.why)
        if self._supervisor.any_deaths:
            for slot in slots.tolist():
                if self._requests.numbering.op(slot) == Operation.STEP:
                    self._supervisor.note_step(slot)


def _not_restored(fault: EnvRaised) -> Loss:
    outcome = fault.outcome
    return Loss("could not be restored", outcome.kind, outcome.blame, fault.env_id)
