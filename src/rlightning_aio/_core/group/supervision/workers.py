"""`Workers`: describes the current state of a group's hosts, for monitoring; `Overdue`: says once
which env has owed a result for a minute, which no time limit ends.

Rule: an ordinary step pays for that with one comparison. Waits end at `due`, so that a call which
would wait for ever says for whom. Of envs with a time limit, `HangDetector` takes care.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.state.host_record import Stage
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables

OWED_SECONDS = 60.0

_log = logging.getLogger("rlightning_aio")
_SETTINGS: Final = {int(Operation.STEP): "step_timeout", int(Operation.RESET): "reset_timeout"}
_MOST_LISTED: Final = 8
_STATES: Final = {
    Stage.NEW: "new",
    Stage.UP: "up",
    Stage.DOWN: "down",
    Stage.CLOSED: "closed",
}


class Workers:
    """See the module."""

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._envs = tables.envs

    def describe(self, now_ns: int) -> list[dict[str, Any]]:
        """Describe each host and its outstanding requests, as `EnvGroup.get_workers`.

        `now_ns` is from the monotonic clock.
        """
        return [self._described(record, now_ns) for record in self._with_envs()]

    def _with_envs(self) -> list[HostRecord]:
        """Return the hosts, of two peers those that have any env now."""
        slots_of = self._tables.slots_of
        return [r for r in self._tables.records if r.peer is None or len(slots_of(r))]

    def _described(self, record: HostRecord, now_ns: int) -> dict[str, Any]:
        env_ids, requests = self._envs.env_ids, self._tables.requests
        slots = self._tables.slots_of(record)
        busy = requests.owed(slots)
        is_empty = record.place is not None and record.stage is Stage.DOWN
        return {
            "entry": record.config.name,
            "env_ids": [env_ids[slot] for slot in slots],
            "pid": getattr(record.host, "pid", None),
            "client": None if record.place is None else record.place.client or None,
            "state": "empty" if is_empty else _STATES.get(record.stage, "starting"),
            "owed": [env_ids[slot] for slot in busy],
            "owed_seconds": (now_ns - int(requests.sent_ns[busy[0]])) / 1e9 if len(busy) else 0.0,
            "restarts": record.restarts,
        }

    def awaited(self, now_ns: int) -> str:
        """Name the envs that have not started, or else those that owe a reply, the oldest first.

        `now_ns` is from the monotonic clock.
        """
        slots: list[int] = []
        for record in self._tables.records:
            if record.is_starting:
                slots += self._tables.slots_of(record).tolist()
        if slots:
            names = [self._envs.env_ids[slot] for slot in slots]
            return f"not started yet: {_listed(names)}"
        env_ids, requests = self._envs.env_ids, self._tables.requests
        busy: list[int] = requests.owed(np.arange(len(self._envs))).tolist()
        names = [
            f"{env_ids[k]} (for {(now_ns - requests.sent_ns.item(k)) / 1e9:.1f} s)" for k in busy
        ]
        return f"no reply yet from {_listed(names)}" if names else "no env owes a reply"

    def summary(self) -> str:
        """Summarise entries, envs, placement and worker processes in one line."""
        entries: dict[str, list[HostRecord]] = {}
        for record in self._with_envs():
            entries.setdefault(record.config.name, []).append(record)
        return "; ".join(f"{name}: {self._entry(own)}" for name, own in entries.items())

    def _entry(self, records: Sequence[HostRecord]) -> str:
        config, count = records[0].config, len(records)
        if records[0].place is not None:
            return f"{count} place{'' if count == 1 else 's'} for clients"
        slots = np.concatenate([self._tables.slots_of(record) for record in records])
        # Only its spaces say so of an env that a callable has made.
        each: list[int] = self._envs.num_sub_envs[slots].tolist()
        sizes = f" of {each[0]} sub-environments" if each[0] > 1 else ""
        if len({*each}) > 1:
            sizes = f" with {sum(each)} sub-environments"
        workers = sum(record.killable is not None for record in records)
        return (
            f"{len(each)} env{'' if len(each) == 1 else 's'}{sizes}, placement {config.placement}, "
            f"{workers} worker process{'' if workers == 1 else 'es'}"
        )


class Overdue:
    """See the module.

    Attributes:
        due: the time to `look` next, in monotonic seconds; infinite if that is never.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.due = math.inf

    def begin(self, now: float) -> None:
        """Watch the envs, which have started."""
        self.due = now + OWED_SECONDS

    def look(self, now: float) -> None:
        """Log which env owes a result for too long, if there is one."""
        requests, envs = self._tables.requests, self._tables.envs
        due = now + OWED_SECONDS
        owed: list[int] = requests.owed(np.arange(len(envs))).tolist()
        for slot in owed:
            record, op = self._tables.record_of(slot), requests.numbering.op(slot)
            if record.is_down or op in record.limits:  # Something else ends the wait.
                continue
            seconds = now - requests.sent_ns.item(slot) / 1e9
            if seconds < OWED_SECONDS:
                due = min(due, now - seconds + OWED_SECONDS)
                continue
            _log.warning(
                "%s has owed a result for %.0f s, and nothing ends what it does%s; "
                "group.get_workers() tells who owes what",
                envs.describe(slot),
                seconds,
                f": set {_SETTINGS[op]} of its entry, in seconds, to have it replaced"
                if op in _SETTINGS
                else " but abort(), as no time limit holds for it",
            )
            due = math.inf
            break
        self.due = due


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MOST_LISTED} more" if len(names) > _MOST_LISTED else ""
    return ", ".join(names[:_MOST_LISTED]) + more
