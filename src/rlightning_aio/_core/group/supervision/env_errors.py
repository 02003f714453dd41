"""`EnvErrors`: exceptions of envs that are rebuilt after them (``on_env_error: restart``).

They count as restarts in a row together with the deaths that an env is blamed for.
Left out: what becomes of the request (see `Intake`), and the making of the env (see `EnvRunner`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio._core.group.supervision.fault_messages import CrashLog
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.messages import ErrorText
    from rlightning_aio.errors import EnvRaised

__all__ = ["EnvErrors"]


class EnvErrors:
    """See the module.

    Args:
        tables: of the group.
        crash_log: of the group.
        on_count: called when an exception was counted.
    """

    def __init__(self, tables: Tables, crash_log: CrashLog, on_count: Callable[[], object]) -> None:
        self._tables = tables
        self._crash_log = crash_log
        self._on_count = on_count

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
        policy, name = record.error_policy, record.config.name
        count = record.deaths[slot] = record.deaths.get(slot, 0) + 1
        self._on_count()
        is_borne, then = policy.count(count, tables.clock(), pauses=False)
        if not is_borne:
            fault.add_note(then)
            return False
        record.restarts += 1
        doing = Operation(tables.requests.numbering.op(slot)).name.lower()
        message = f"{tables.envs.describe(slot)} raised in {doing}: {error.summary}; {then}"
        self._crash_log.note(name, message, error.traceback)
        tables.observed.note_fate("raised", record.host.host_id, slot, error.summary)
        return True
