"""`EnvLosses`: losses of single envs, whose hosts go on: one has raised, or is gone.

They count as restarts in a row together with the deaths that an env is blamed for.
Left out: what becomes of the request (see `Intake`), and the making of the env (see `EnvRunner`
and `AwaitedEnvs`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rlightning_aio.errors import EnvAway, EnvFault, EnvHung, WorkerDied
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.group.supervision.fault_messages import CrashLog
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.errors import EnvRaised
    from rlightning_aio.outcomes import Loss
    from rlightning_aio.protocol.error_text import ErrorText

_ERRORS: Final[dict[str, type[EnvFault]]] = {"env_hung": EnvHung, "env_away": EnvAway}
"""By the kind of an outcome; others are `WorkerDied`."""


class EnvLosses:
    """See the module.

    Args:
        tables: of the group.
        crash_log: of the group.
        on_count: called when a loss was counted.

    Attributes:
        any_gone: some env is not replaced, as its entry has deaths raised.
    """

    def __init__(self, tables: Tables, crash_log: CrashLog, on_count: Callable[[], object]) -> None:
        self._tables = tables
        self._crash_log = crash_log
        self._on_count = on_count
        self.any_gone = False

    def ends_env(self, slot: int, error: ErrorText) -> bool:
        """Return True if an env that has raised this is rebuilt before its next request."""
        op = self._tables.requests.numbering.op(slot)
        return not self._tables.record_of(slot).error_policy.raises and error.ends_env(op)

    def count_restart(self, slot: int, error: ErrorText, fault: EnvRaised) -> bool:
        """Count an exception that has ended an env; True if an episode begins at once for it.

        Args:
            slot: of the env.
            error: what it has raised.
            fault: what the caller gets otherwise.
        """
        tables, record = self._tables, self._tables.record_of(slot)
        is_borne, then = record.error_policy.count(self._counted(slot), pauses=False)
        if not is_borne:
            fault.add_note(then)
            return False
        doing = Operation(tables.requests.numbering.op(slot)).name.lower()
        message = f"{tables.envs.describe(slot)} raised in {doing}: {error.summary}; {then}"
        self._note_restart(slot, message, error.traceback)
        return True

    def count_env(self, slot: int, why: Loss, message: str) -> tuple[bool, EnvFault]:
        """Count an env that is gone; True if an episode begins at once, and the error otherwise.

        Args:
            slot: of the env.
            why: it is gone.
            message: the same for an error.
        """
        record = self._tables.record_of(slot)
        is_borne, then = record.restart_policy.count(self._counted(slot), pauses=False)
        if is_borne and record.is_hardware:
            then += "; it moves nothing until you reset it"
        if is_borne:
            self._note_restart(slot, f"{message}; {then}")
        elif not record.restart_policy.raises:
            then += ", so this request ends here; the next one tries again"
        env_id = self._tables.envs.env_ids[slot]
        fault = _ERRORS.get(why.kind, WorkerDied)(f"{message}; {then}", env_id=env_id)
        fault.outcome = why.outcome(env_id)
        if isinstance(fault, WorkerDied):
            fault.env_ids = (env_id,)
        if record.restart_policy.raises:
            record.gone[slot] = fault
            self.any_gone = True
        return is_borne, fault

    def _counted(self, slot: int) -> int:
        """Return the number of losses of an env in a row, this one included."""
        deaths = self._tables.record_of(slot).deaths
        deaths[slot] = deaths.get(slot, 0) + 1
        self._on_count()
        return deaths[slot]

    def _note_restart(self, slot: int, message: str, traceback: str = "") -> None:
        record = self._tables.record_of(slot)
        record.restarts += 1
        self._crash_log.note(record.config.name, message, traceback)
