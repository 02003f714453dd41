"""`Overdue`: names envs that have owed a result for a minute, which no time limit ends.

Rule: each entry is named once, and an ordinary step pays for it with one comparison. Waits end at
`due`, so that a call which would wait for ever says for whom. Left out: envs with a time limit, of
which `HangDetector` takes care.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio._core.group.drivers.wait import Patient
from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.config import EnvConfig

__all__ = ["Overdue"]

OWED_SECONDS = 60.0

_log = logging.getLogger("rlightning_aio")
_RESETS: Final = (Operation.RESET, Operation.RESTORE)


class Overdue:
    """See the module.

    Attributes:
        due: the time to `look` next, in monotonic seconds; infinite if that is never.
        wait: what a call waits for that has no other time to keep.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self.due = math.inf
        self.wait = Patient()
        # Slots of entries without a limit, which were not named.
        self._watched = np.zeros(0, np.bool_)

    def begin(self, now: float) -> None:
        """Watch the envs, which have started."""
        configs: Sequence[EnvConfig] = self._tables.envs.configs
        limited = [None not in (one.step_timeout, one.reset_timeout) for one in configs]
        self._watched = ~np.array(limited, np.bool_)
        self._look_at(now + OWED_SECONDS)

    def _look_at(self, due: float) -> None:
        """Look at that time, if anything is left to be said."""
        self.due = due if self._watched.any() else math.inf
        self.wait.until = None if self.due == math.inf else self.due

    def look(self, now: float) -> None:
        """Log which entries have envs that owe a result for too long."""
        requests, envs = self._tables.requests, self._tables.envs
        due = now + OWED_SECONDS
        owed: list[int] = requests.owed(np.flatnonzero(self._watched)).tolist()
        for slot in owed:
            config: EnvConfig = envs.configs[slot]
            expires = requests.sent_ns.item(slot) / 1e9 + OWED_SECONDS
            is_reset = requests.numbering.op(slot) in _RESETS
            name = "reset_timeout" if is_reset else "step_timeout"
            if not self._watched[slot] or getattr(config, name) is not None:
                continue
            if now < expires:
                due = min(due, expires)
                continue
            self._watched &= envs.names.entries != envs.names.entries[slot]
            self._name(slot, now - expires + OWED_SECONDS, name)
        self._look_at(due)

    def _name(self, slot: int, seconds: float, setting: str) -> None:
        """Log that an env owes a result."""
        _log.warning(
            "%s has owed a result for %.0f s, and nothing ends what it does: set %s of its entry, "
            "in seconds, to have it replaced; group.get_workers() tells who owes what",
            self._tables.envs.describe(slot),
            seconds,
            setting,
        )
