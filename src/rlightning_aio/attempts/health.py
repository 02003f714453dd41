"""`Health`: which envs rest after failures, and how fast attempts begin while most fail.

Rule: a broken env fails in milliseconds, so without a rest it would be free for every attempt. And
a service that is away fails attempts at many times the normal pace, so they begin one at a time,
after growing pauses, until one succeeds. A worker's death is no sign of that, but of the task that
was executed in it. It reads no clock.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from rlightning_aio.attempts.rules import is_final, is_of_env, is_retried

if TYPE_CHECKING:
    from rlightning_aio.outcomes import Outcome

_BORNE: Final = 2
"""Failures in a row that an env may have before it rests."""
_REST, _LONGEST_REST = 1.0, 60.0
"""Seconds of the first rest, twice as long after each further failure."""
_PAUSE, _LONGEST_PAUSE = 0.5, 30.0
"""Seconds of the first pause while most attempts fail, and of the longest."""
_FEWEST: Final = 4
"""Tries among which most must have failed."""
_log = logging.getLogger("rlightning_aio")


class Health:
    """See the module; times are monotonic seconds.

    Attributes:
        is_slow: most of the last tries have failed.
    """

    def __init__(self) -> None:
        self.is_slow = False
        self._has_succeeded = False  # An attempt, since most failed.
        self._in_a_row = Counter[str]()
        self._rests: dict[str, float] = {}
        self._recent = deque[str]()  # The kinds of failures, and an empty text for a success.
        self._pause = self._since = self._next = 0.0

    def note(self, outcome: Outcome, num_playing: int, now: float) -> bool:
        """Note the end of a try; `num_playing` may play at once.

        Returns True if an outage begins: most fail from now on, and at least one has succeeded
        since that was so before.
        """
        self.note_env(outcome, now)
        if is_final(outcome):
            self._has_succeeded = True
            return self._note_recent("", num_playing, now)
        if not is_retried(outcome) or outcome.kind == "env_died":
            return False
        return self._note_recent(outcome.kind, num_playing, now)

    def note_env(self, outcome: Outcome, now: float) -> None:
        """Note the end of a try for its env alone, which rests if it has failed too often."""
        if is_final(outcome):
            self._in_a_row.pop(outcome.env_id, None)
            self._rests.pop(outcome.env_id, None)
        elif is_of_env(outcome):
            self._in_a_row[outcome.env_id] += 1
            if (more := self._in_a_row[outcome.env_id] - _BORNE) > 0:
                rest = min(_REST * 2.0 ** min(more - 1, 10), _LONGEST_REST)
                self._rests[outcome.env_id] = now + rest

    def _note_recent(self, kind: str, num_playing: int, now: float) -> bool:
        if self.is_slow:
            if not kind:
                self.recover(now)
            return False
        self._recent.append(kind)
        most = max(num_playing, _FEWEST)
        while len(self._recent) > most:
            self._recent.popleft()
        failed = Counter(filter(None, self._recent))
        if 2 * failed.total() <= most:
            return False
        self.is_slow, self._since, self._pause = True, now, _PAUSE
        self._next = now + _PAUSE
        self._recent.clear()
        env_id = next(iter(self._in_a_row), "")
        _log.warning(
            "most attempts fail (%s%s): others begin one at a time, after "
            "pauses of up to %g s, until one succeeds",
            ", ".join(f"{count} {kind}" for kind, count in failed.items()),
            f", such as on env {env_id!r}" if env_id else "",
            _LONGEST_PAUSE,
        )
        had_succeeded, self._has_succeeded = self._has_succeeded, False
        return had_succeeded

    def recover(self, now: float) -> None:
        """An attempt goes well: have others begin as fast as envs are free."""
        self.is_slow = False
        self._recent.clear()
        _log.warning("attempts succeed again, after %.1f s", now - self._since)

    def rests(self, env_id: str, now: float) -> bool:
        """Return True if an env begins nothing yet."""
        return bool(self._rests) and self._rests.get(env_id, 0.0) > now

    def may_begin(self, now: float) -> bool:
        """Return True if an attempt may begin."""
        return not self.is_slow or now >= self._next

    def note_begin(self, now: float) -> None:
        """Note that an attempt begins; if most fail, the next one waits for twice as long."""
        if self.is_slow:
            self._pause = min(2 * self._pause, _LONGEST_PAUSE)
            self._next = now + self._pause

    def seconds_left(self, now: float) -> float | None:
        """Seconds until more may begin than now; None if nothing waits for that."""
        times = [time for time in self._rests.values() if time > now]
        if self.is_slow and self._next > now:
            times.append(self._next)
        return min(times) - now if times else None
