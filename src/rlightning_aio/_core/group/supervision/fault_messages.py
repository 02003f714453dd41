"""Messages about dead, hung and late workers: the env at fault, the cause, lost replies.

`CrashLog` keeps those about restarts from filling the log.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import TYPE_CHECKING, Final

from rlightning_aio._core.group.state.host_record import HostLoss, last_lines
from rlightning_aio._core.hosts.limits import hung
from rlightning_aio.errors import StartFailed
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation, slot_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio._core.hosts.messages import Death
    from rlightning_aio.protocol.error_text import ErrorText

_LINES: Final = 3
_EVERY: Final = 100

_log = logging.getLogger("rlightning_aio")


def start_fault(envs: EnvTable, record: HostRecord, death: Death) -> StartFailed:
    """The error for a worker that exited while starting."""
    if record.late:
        return late_fault(envs, record, death)
    slot = _starting(record, death)
    return StartFailed(
        f"{envs.describe(slot)} could not be started: its worker {death.cause}"
        + last_lines(death.stderr_tail),
        env_id=envs.env_ids[slot],
    )


def late_fault(envs: EnvTable, record: HostRecord, death: Death) -> StartFailed:
    """The error for a worker that exceeded `start_timeout`."""
    slot = _starting(record, death)
    # An exit code only shows that it was killed; any other cause may explain the delay.
    why = f" (it {death.cause})" if death.cause and death.exit_code is None else ""
    return StartFailed(
        f"{envs.describe(slot)} did not start within {record.config.start_timeout} s"
        f"{why}; raise start_timeout if it needs longer" + last_lines(death.stderr_tail),
        env_id=envs.env_ids[slot],
    )


def _starting(record: HostRecord, death: Death) -> int:
    """The slot of the env that a worker was building when it died."""
    slot = slot_of(death.requests[0]) if death.requests else 0
    return max(slot, record.slots.start)


def culprit_of(
    record: HostRecord,
    entries: Sequence[int],
    requests: Requests,
    unanswered: NDArray[np.intp],
) -> int | None:
    """The slot of the env that a worker was executing when it hung or died; None if it is unknown.

    Args:
        record: of its host.
        entries: as in `Death.requests`.
        requests: of the group.
        unanswered: its slots with a request in flight.
    """
    if record.aborted_slot is not None:
        return record.aborted_slot
    if record.awaits_several:
        # The worker marks whose code runs, and that of one whose request is over may run, too.
        if entries and entries[0]:
            slot = slot_of(entries[0])
            return slot if slot in record.slots else None
        return int(unanswered[0]) if len(unanswered) == 1 else None
    slot_of_entry = {requests.numbering.entry.item(slot): slot for slot in unanswered.tolist()}
    for entry in entries:
        if entry in slot_of_entry:
            return slot_of_entry[entry]
    return int(unanswered[0]) if len(unanswered) else None


def cause_of(record: HostRecord, death: Death, requests: Requests) -> str:
    """The cause of a worker's end: the supervisor's reason for killing it, else its exit."""
    if record.is_hung:
        where = "" if record.culprit is None else f" in {_doing(requests, record.culprit)}"
        return f"hung{where} and was killed"
    if record.aborted_slot is not None:
        return f"was killed because {_doing(requests, record.aborted_slot)} was aborted"
    if record.rebuild_error is not None:
        error = record.rebuild_error
        return f"could not be rebuilt: {error.summary}"
    if record.late:
        why = f" (it {death.cause})" if death.exit_code is None else ""
        return f"did not start again within {record.config.start_timeout} s and was killed{why}"
    return death.cause


def _doing(requests: Requests, slot: int) -> str:
    op = requests.numbering.op(slot)
    if op in (Operation.STEP, Operation.RESET, Operation.SNAPSHOT, Operation.RESTORE):
        return f"a {Operation(op).name.lower()}"
    return f"a call of {requests.methods[slot]}()" if slot in requests.methods else "a call"


def without_terminal(error: ErrorText, record: HostRecord) -> str:
    """A hint for the error of a debugger in a worker; empty for any other error."""
    if error.type_name != "bdb.BdbQuit" or record.killable is None:
        return ""
    return " (a worker has no terminal: debug with placement='inline')"


def host_loss(
    envs: EnvTable,
    requests: Requests,
    record: HostRecord,
    death: Death,
    slots: Sequence[int],
    owed: NDArray[np.intp],
    then: str,
    *,
    replaced: bool,
) -> HostLoss:
    """Describe a death; `then` says what happens to the worker now."""
    slot = record.slots.start if record.culprit is None else record.culprit
    doing, number = _doing(requests, slot), requests.numbering.number(slot)
    last = f"last request: {f'request {number}, {doing}' if number else 'none'}"
    what = f"the worker of {envs.describe(slot)} {death.cause}"
    if record.place is not None:
        what = f"the client of {envs.describe(slot)} was lost ({death.cause})"
    if record.culprit is None and record.awaits_several:
        last = "no env's code was running"
    elif record.is_hung:
        # Of a stopped worker, whose env may have been called, the shortest one counts.
        limit = record.limits.get(requests.numbering.op(slot), min(record.limits.values()))
        what = f"{envs.describe(slot)} took longer than {limit} s for {doing} and was killed"
    return HostLoss(
        host_id=record.host.host_id,
        slots=slots,
        owed=owed,
        death=death,
        replaced=replaced,
        resets=not record.is_hardware,
        what=what,
        last=last,
        then=then,
        env_ids=envs.env_ids,
        env_id=envs.env_ids[slot],
        why=_why(envs, requests, record, death),
    )


def _why(envs: EnvTable, requests: Requests, record: HostRecord, death: Death) -> Loss:
    cause, at_fault = death.cause, None
    if record.culprit is not None:
        at_fault = envs.env_ids[record.culprit]
    if record.aborted_slot is not None:
        return Loss(cause, "cancelled", "caller", at_fault)
    if record.is_hung:
        op = 0 if record.culprit is None else requests.numbering.op(record.culprit)
        why = hung(cause, op, at_fault)
    elif record.place is not None:
        return Loss(cause, "env_away", "infrastructure")
    else:
        is_start = death.refused or record.late or record.rebuild_error is not None
        blame = "infrastructure" if death.refused or death.with_server else "env"
        why = Loss(cause, "not_started" if is_start else "env_died", blame, at_fault)
    if at_fault is None and record.awaits_several:
        return why._replace(blame="infrastructure")  # All were waiting, so none is named.
    return why


class CrashLog:
    """Restarts in the log: of each entry the first three, then every hundredth.

    A death or exception that no restart follows is left out, because it is raised.
    """

    def __init__(self) -> None:
        self._counts = Counter[str]()

    def note(self, entry: str, message: str, traceback: str = "") -> None:
        """Log a restart of an env or worker of `entry`, or only count it."""
        self._counts[entry] += 1
        count = self._counts[entry]
        if count > _LINES and count % _EVERY:
            return
        then = ""
        if count >= _LINES:
            then = f"; restart {count} of entry {entry!r}, of which every {_EVERY}th is logged"
        _log.warning("%s%s%s", message, then, f"\n{traceback.rstrip()}" if traceback else "")
