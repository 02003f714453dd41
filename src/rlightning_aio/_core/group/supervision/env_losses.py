"""`EnvLosses`: losses of single envs, whose hosts go on: one has raised, or is gone.

They count as restarts in a row together with the deaths that an env is blamed for. A loss that
ended no request in its error is raised by the next one, unless the env begins anew without it.
Left out: what becomes of the request (see `Intake`), and the making of the env (see `EnvRunner`
and `AwaitedEnvs`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rlightning_aio._core.group.state.host_record import fault_type
from rlightning_aio.errors import EnvAway, EpisodeLost
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.group.supervision.fault_messages import CrashLog
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.errors import EnvRaised, WorkerDied
    from rlightning_aio.outcomes import Loss
    from rlightning_aio.protocol.error_text import ErrorText


class EnvLosses:
    """See the module.

    Args:
        tables: of the group.
        crash_log: of the group.
        on_count: called when a loss was counted.
    """

    def __init__(self, tables: Tables, crash_log: CrashLog, on_count: Callable[[], object]) -> None:
        self._tables = tables
        self._crash_log = crash_log
        self._on_count = on_count
        # By slot, the error of an env that was lost without a request that could end in it.
        self._unraised: dict[int, WorkerDied | EnvAway] = {}

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

    def count_env(self, slot: int, why: Loss, message: str) -> tuple[bool, WorkerDied | EnvAway]:
        """Count an env that is gone.

        Args:
            slot: of the env.
            why: the cause.
            message: the same for an error.

        Returns whether an episode begins at once, and the error for where none does.
        """
        record = self._tables.record_of(slot)
        is_borne, then = record.restart_policy.count(self._counted(slot), pauses=False)
        if record.is_hardware:
            then += "; it moves nothing until you reset it"
        if is_borne:
            self._note_restart(slot, f"{message}; {then}")
        env_id = self._tables.envs.env_ids[slot]
        fault = fault_type(why)(f"{message}; {then}", env_id=env_id)
        fault.outcome = why.outcome(env_id)
        fault.env_ids = (env_id,)
        return is_borne, fault

    def raise_later(self, slots: Iterable[int], fault: WorkerDied | EnvAway) -> None:
        """Keep the error of envs that were lost without a request, for the next one to raise."""
        self._unraised.update(dict.fromkeys(slots, fault))

    def drop_unraised(self) -> None:
        """Forget the errors that no request has raised yet."""
        self._unraised.clear()

    def check(self, slots: NDArray[np.intp]) -> None:
        """Raise the error of those of `slots` that were lost without a request, if there are any.

        It is raised once, though it may be that of other envs, too.
        """
        asked = self._unraised.keys() & {*slots.tolist()} if self._unraised else ()
        if not asked:
            return
        fault, env_ids = self._unraised[min(asked)], self._tables.envs.env_ids
        named = sorted(slot for slot in asked if self._unraised[slot] is fault)
        fault.env_ids = tuple(env_ids[slot] for slot in named)
        self._unraised = {slot: one for slot, one in self._unraised.items() if one is not fault}
        raise fault

    def check_step(self, slots: NDArray[np.intp]) -> None:
        """Raise `EpisodeLost`, of a place `EnvAway`, for one of `slots` that is lost hardware.

        Only a reset that its user asks for sets it in motion again.
        """
        tables = self._tables
        chosen: list[int] = slots.tolist() if tables.episodes.exceptional else []
        for slot in chosen:
            record, why = tables.record_of(slot), tables.episodes.why_lost(slot)
            if why is None or not record.is_hardware:
                continue
            what = (
                f"{tables.envs.describe(slot)} moves something real, and its episode was lost "
                f"({why.cause}); reset it to go on; nothing was sent"
            )
            kind = EpisodeLost if record.place is None else EnvAway
            env_id = tables.envs.env_ids[slot]
            fault = kind(what, env_id=env_id)
            fault.outcome = why.outcome(env_id)
            raise fault

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
