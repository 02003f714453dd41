"""The live line of `rollout`: progress, speed, and the envs it is waiting for.

Rule: a rate is that of the last seconds. If no result arrives, the line names the envs it waits
for, and since when. If stderr is no terminal, there are plain lines at the start, and when clients
join or leave.
"""

from __future__ import annotations

import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Final, Self

from rlightning_aio.cli.live_line import LiveLine, time_left
from rlightning_aio.cli.terminal import (
    connections_logged,
    count,
    counted,
    number,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.cli.rollout_statistics import RolloutStatistics

__all__ = ["Display"]

_PATIENCE_SECONDS: Final = 1.0
"""Seconds without a result after which the display says that it is waiting."""
_RATE_SECONDS: Final = 3.0
_STATES: Final = {
    "envs/seconds_in_envs": "in steps",
    "envs/seconds_queued": "queued",
    "envs/seconds_waiting_to_be_collected": "to be collected",
    "envs/seconds_waiting_for_actions": "wait for actions",
}
"""The numbers that say what envs spend their time on."""
_NAMED: Final = 3


class Display:
    """The line of a rollout.

    Args:
        group: a group before its `init`.
        statistics: the statistics of the rollout.
        steps, seconds: the end of the rollout; None where there is none.
    """

    def __init__(
        self,
        group: EnvGroup,
        statistics: RolloutStatistics,
        steps: int | None,
        seconds: float | None,
    ) -> None:
        self._group = group
        self._statistics = statistics
        self._steps = steps
        self._seconds = seconds
        self.line = LiveLine(self._parts, self._share_done)
        self._lines = contextlib.ExitStack()
        self._doing = f"starting {counted(len(group), 'env')}"
        self._since = time.monotonic()
        self._recent: deque[tuple[float, dict[str, float]]] = deque()

    def __enter__(self) -> Self:
        self._lines.enter_context(self.line)
        self.line.announce(self._doing)
        if not self.line.is_live:
            self._lines.enter_context(connections_logged())
        return self

    def __exit__(self, *exception: object) -> None:
        self._lines.close()

    def resetting(self) -> None:
        """Show that all envs have started and are being reset."""
        self._doing, self._since = "first reset", time.monotonic()

    def ready(self) -> None:
        """Show that the first reset is complete."""
        self._doing = ""
        words = [] if self._steps is None else [counted(self._steps, "step")]
        words += [] if self._seconds is None else [f"for {self._seconds:g} s"]
        self.line.announce(f"collecting {' '.join(words)}")

    def _share_done(self, now: float) -> float | None:
        if self._doing:
            return None
        shares = [0.0]
        if self._steps is not None:
            shares.append(self._statistics.steps / self._steps)
        if self._seconds is not None:
            shares.append(self._statistics.elapsed(now) / self._seconds)
        return min(1.0, max(shares))

    def _parts(self, now: float) -> list[str]:
        """Return the parts of the line, the most important first."""
        if self._doing:
            waited = now - self._since
            return [self._doing, *self._awaited(waited)]
        idle = self._statistics.idle(now)
        steps = f"{count(self._statistics.steps)} steps"
        if idle > _PATIENCE_SECONDS:
            return [*(self._awaited(idle) or [f"waiting {idle:.0f} s"]), steps]
        (then, before), (latest, numbers) = self._numbers(now)
        grown = {name: numbers[name] - before[name] for name in ("envs/steps", *_STATES)}
        rate = grown["envs/steps"] / (latest - then) if latest > then else 0.0
        total = sum(grown[state] for state in _STATES)
        shares = [f"{grown[state] / total:.0%} {what}" for state, what in _STATES.items() if total]
        episodes = numbers["envs/outcomes_terminated"] + numbers["envs/outcomes_truncated"]
        return [
            f"{count(rate)} steps/s",
            *self._time_left(now, rate),
            steps,
            f"{count(episodes)} episodes ended",
            f"return of these {number(numbers.get('envs/episode_return_mean'))}",
            *([f"envs: {', '.join(shares)}"] if shares else []),
        ]

    def _numbers(self, now: float) -> tuple[tuple[float, dict[str, float]], ...]:
        """Return those of some seconds ago and those of now."""
        self._recent.append((now, self._group.metrics()))
        while self._recent[0][0] < now - _RATE_SECONDS:
            self._recent.popleft()
        return self._recent[0], self._recent[-1]

    def _time_left(self, now: float, rate: float) -> list[str]:
        left: list[float] = []
        if self._steps is not None and rate:
            left.append((self._steps - self._statistics.steps) / rate)
        if self._seconds is not None:
            left.append(self._seconds - self._statistics.elapsed(now))
        return [time_left(min(left))] if left else []

    def _awaited(self, waited: float) -> list[str]:
        """Return a text on the envs that it waits for, and since when; empty if there are none."""
        if waited <= _PATIENCE_SECONDS:
            return []
        workers = self._group.get_workers()
        names = [
            name
            for worker in sorted(workers, key=lambda worker: -worker["owed_seconds"])
            for name in (worker["owed"] if worker["state"] == "up" else worker["env_ids"])
        ]
        empty = [worker["entry"] for worker in workers if not worker["env_ids"]]
        who = _listed(names) or (f"clients of {_listed(empty)}" if empty else "")
        return [f"waiting {waited:.0f} s{' for ' if who else ''}{who}"]


def _listed(names: Sequence[str]) -> str:
    named = [name for name in names if name][:_NAMED]
    more = len(names) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 and named else "")
