"""`Overdue`: says once which env has owed a result for a minute, which no time limit ends.

Rule: an ordinary step pays for it with one comparison. Waits end at `due`, so that a call which
would wait for ever says for whom. Of envs with a time limit, `HangDetector` takes care.
"""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio.protocol.entries import Operation

if TYPE_CHECKING:
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.config import EnvConfig

OWED_SECONDS = 60.0

_log = logging.getLogger("rlightning_aio")
_RESETS: Final = (Operation.RESET, Operation.RESTORE)


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
            config: EnvConfig = envs.configs[slot]
            is_reset = requests.numbering.op(slot) in _RESETS
            setting = "reset_timeout" if is_reset else "step_timeout"
            seconds = now - requests.sent_ns.item(slot) / 1e9
            if getattr(config, setting) is not None:
                continue
            if seconds < OWED_SECONDS:
                due = min(due, now - seconds + OWED_SECONDS)
                continue
            _log.warning(
                "%s has owed a result for %.0f s, and nothing ends what it does: set %s of its "
                "entry, in seconds, to have it replaced; group.get_workers() tells who owes what",
                envs.describe(slot),
                seconds,
                setting,
            )
            due = math.inf
            break
        self.due = due
