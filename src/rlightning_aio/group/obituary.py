"""What is said of a worker that is gone: which env it fell to, why, and what it owed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.errors import EnvHung, StartFailed, WorkerDied
from rlightning_aio.group.member import NOBODY
from rlightning_aio.protocol.rings import RESET, STEP, number_of, slot_of

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.group.member import Member
    from rlightning_aio.group.slots import Slots
    from rlightning_aio.hosts.base import Death

__all__ = ["cause_of", "culprit_of", "death_error", "late_fault", "start_fault"]


def start_fault(table: Slots, member: Member, death: Death) -> StartFailed:
    """The error for a worker that ended while it started."""
    if member.late:
        return late_fault(table, member, death)
    slot = _starting(member, death)
    return StartFailed(
        f"the worker of {table.describe(slot)} {death.cause} while it started"
        + _said(death.stderr_tail),
        env_id=table.env_ids[slot],
    )


def late_fault(table: Slots, member: Member, death: Death) -> StartFailed:
    """The error for a worker that was too late to start."""
    slot = _starting(member, death)
    # How it was killed says nothing; what it went down with may say all.
    why = f" (it {death.cause})" if death.cause and death.exit_code is None else ""
    return StartFailed(
        f"{table.describe(slot)} did not start within {member.config.start_timeout} s"
        f"{why}; raise start_timeout if it needs longer" + _said(death.stderr_tail),
        env_id=table.env_ids[slot],
    )


def _starting(member: Member, death: Death) -> int:
    """The env that a worker was building when it died."""
    slot = slot_of(death.requests[0]) if death.requests else 0
    return max(slot, member.host.first_slot)


def culprit_of(table: Slots, member: Member, death: Death, owed: NDArray[np.intp]) -> int:
    """The env that a worker was executing when it died, as far as can be known."""
    if member.hung_slot is not None:
        return member.hung_slot
    for entry in death.requests:
        slot = slot_of(entry)
        if slot in owed and table.number(slot) == number_of(entry):
            return slot
    return int(owed[0]) if len(owed) else NOBODY


def cause_of(table: Slots, member: Member, death: Death) -> str:
    """Why a worker is gone, as far as the fleet knows it better than the kernel."""
    if member.hung_slot is not None:
        return f"hung in {_doing(table, member.hung_slot)} and was killed"
    if member.rebuild_error is not None:
        error = member.rebuild_error
        return f"could not be rebuilt: {error.type_name}: {error.text}"
    if member.late:
        return f"did not start again within {member.config.start_timeout} s and was killed"
    return death.cause


def _doing(table: Slots, slot: int) -> str:
    return {STEP: "a step", RESET: "a reset"}.get(table.op(slot), "a call")


def death_error(
    table: Slots, member: Member, death: Death, outcome: str
) -> Callable[[NDArray[np.intp]], WorkerDied]:
    """Makes the error for those of the slots that owed a reply, as things are now."""
    slot = member.host.first_slot if member.culprit == NOBODY else member.culprit
    doing = _doing(table, slot)
    number = table.number(slot)
    last = f"request {number}, {doing}" if number else "none"
    if member.hung_slot is not None:
        config = member.config
        limit = config.step_timeout if table.op(slot) == STEP else config.reset_timeout
        what = f"{table.describe(slot)} took longer than {limit} s for {doing} and was killed"
    else:
        what = f"the worker of {table.describe(slot)} {death.cause}"
    kind = WorkerDied if member.hung_slot is None else EnvHung

    def error_for(owed: NDArray[np.intp]) -> WorkerDied:
        names = ", ".join(table.ids(owed)) or "none"
        error = kind(
            f"{what} (last request: {last}; envs that owed a reply: {names}); {outcome}"
            + _said(death.stderr_tail),
            env_id=table.env_ids[slot],
            exit_code=death.exit_code,
            stderr_tail=death.stderr_tail,
        )
        error.env_ids = tuple(table.ids(owed))
        return error

    return error_for


def _said(stderr_tail: str) -> str:
    lines = stderr_tail.strip().splitlines()[-20:]
    return ("\nThe last lines it wrote:\n  " + "\n  ".join(lines)) if lines else ""
