"""What is said of a worker that is gone: which env it fell to, why, and what it owed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.errors import EnvHung, StartFailed, WorkerDied
from rlightning_aio.protocol.entries import Operation, number_of, slot_of

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.host_record import HostRecord
    from rlightning_aio.group.requests import Requests
    from rlightning_aio.hosts.messages import Death

__all__ = ["cause_of", "culprit_of", "death_error", "late_fault", "start_fault"]


def start_fault(envs: EnvTable, record: HostRecord, death: Death) -> StartFailed:
    """The error for a worker that ended while it started."""
    if record.late:
        return late_fault(envs, record, death)
    slot = _starting(record, death)
    return StartFailed(
        f"{envs.describe(slot)} could not be started: its worker {death.cause}"
        + _said(death.stderr_tail),
        env_id=envs.env_ids[slot],
    )


def late_fault(envs: EnvTable, record: HostRecord, death: Death) -> StartFailed:
    """The error for a worker that was too late to start."""
    slot = _starting(record, death)
    # How it was killed says nothing; what it went down with may say all.
    why = f" (it {death.cause})" if death.cause and death.exit_code is None else ""
    return StartFailed(
        f"{envs.describe(slot)} did not start within {record.config.start_timeout} s"
        f"{why}; raise start_timeout if it needs longer" + _said(death.stderr_tail),
        env_id=envs.env_ids[slot],
    )


def _starting(record: HostRecord, death: Death) -> int:
    """The env that a worker was building when it died."""
    slot = slot_of(death.requests[0]) if death.requests else 0
    return max(slot, record.host.first_slot)


def culprit_of(
    record: HostRecord, death: Death, requests: Requests, owed: NDArray[np.intp]
) -> int | None:
    """The env that a worker was executing when it died, as far as can be known.

    Args:
        record: of its host.
        death: what is known of its end.
        requests: of the group.
        owed: slots of which it owed a reply.
    """
    if record.hung_slot is not None:
        return record.hung_slot
    for entry in death.requests:
        slot = slot_of(entry)
        if slot in owed and requests.number(slot) == number_of(entry):
            return slot
    return int(owed[0]) if len(owed) else None


def cause_of(record: HostRecord, death: Death, requests: Requests) -> str:
    """Why a worker is gone, as far as the supervisor knows it better than the kernel."""
    if record.hung_slot is not None:
        return f"hung in {_doing(requests, record.hung_slot)} and was killed"
    if record.rebuild_error is not None:
        error = record.rebuild_error
        return f"could not be rebuilt: {error.summary}"
    if record.late:
        why = f" (it {death.cause})" if death.exit_code is None else ""
        return f"did not start again within {record.config.start_timeout} s and was killed{why}"
    return death.cause


def _doing(requests: Requests, slot: int) -> str:
    op, method = requests.op(slot), requests.method(slot)
    if op in (Operation.STEP, Operation.RESET, Operation.SNAPSHOT, Operation.RESTORE):
        return f"a {Operation(op).name.lower()}"
    return f"a call of {method}()" if method else "a call"


def death_error(
    envs: EnvTable, record: HostRecord, death: Death, requests: Requests, outcome: str
) -> Callable[[NDArray[np.intp]], WorkerDied]:
    """Makes the error for those of the slots that owed a reply, as things are now."""
    slot = record.host.first_slot if record.culprit is None else record.culprit
    doing, number = _doing(requests, slot), requests.number(slot)
    last = f"request {number}, {doing}" if number else "none"
    if record.hung_slot is not None:
        config = record.config
        stepped = requests.op(slot) == Operation.STEP
        limit = config.step_timeout if stepped else config.reset_timeout
        what = f"{envs.describe(slot)} took longer than {limit} s for {doing} and was killed"
    else:
        what = f"the worker of {envs.describe(slot)} {death.cause}"
    kind = WorkerDied if record.hung_slot is None else EnvHung

    def error_for(owed: NDArray[np.intp]) -> WorkerDied:
        names = ", ".join(envs.names.ids(owed)) or "none"
        error = kind(
            f"{what} (last request: {last}; envs that owed a reply: {names}); {outcome}"
            + _said(death.stderr_tail),
            env_id=envs.env_ids[slot],
            exit_code=death.exit_code,
            stderr_tail=death.stderr_tail,
        )
        error.env_ids = tuple(envs.names.ids(owed))
        return error

    return error_for


def _said(stderr_tail: str) -> str:
    lines = stderr_tail.strip().splitlines()[-20:]
    return ("\nThe last lines it wrote:\n  " + "\n  ".join(lines)) if lines else ""
