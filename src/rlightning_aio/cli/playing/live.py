"""The live display of `rollout`: progress, speed, and the envs it is waiting for.

Rule: a rate is that of the last seconds. If no result arrives, the display names the envs it waits
for, and since when. If stderr is no terminal, there are plain lines at the start, and when clients
join or leave. Drawing takes time from the envs, so all of it is one plain text, which Rich shows
unchanged: laying out its tables takes ten times as long.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Self

from rich.live import Live
from rich.text import Text

from rlightning_aio.cli.processes import memory_bytes
from rlightning_aio.cli.terminal import (
    connections_logged,
    count,
    counted,
    duration,
    err,
    number,
)

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Sequence

    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio.cli.rollout_statistics import RolloutStatistics

__all__ = ["Display"]

_REFRESH_SECONDS: Final = 0.25
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
_SPINNER: Final = "⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏"
_BAR: Final = 16
_NAMED: Final = 3
_FEWEST_ROWS: Final = 4
_COLUMNS: Final = ("worker", "entry", "envs", "steps/s", "step", "memory", "restarts", "state")
_TEXTS: Final = ("worker", "entry", "state")
"""Columns that are aligned on the left."""
_EXPENDABLE: Final = ("entry", "envs", "memory", "step", "restarts")
"""Columns that a narrow terminal leaves out, in this order."""


class Display:
    """The live line on stderr, with a line for each worker below it if `workers` is True.

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
        *,
        workers: bool,
    ) -> None:
        self._group = group
        self._statistics = statistics
        self._steps = steps
        self._seconds = seconds
        self._console = err()
        self._workers = _WorkerTable(group, statistics) if workers else None
        self._lines = contextlib.ExitStack()
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._doing = f"starting {counted(len(group), 'env')}"
        self._since = time.monotonic()
        self._next_at = 0.0
        self._recent: deque[tuple[float, dict[str, float]]] = deque()

    def __enter__(self) -> Self:
        if self._console.is_terminal:
            self._live.start()
        else:
            self._console.print(self._doing)
            self._lines.enter_context(connections_logged())
        return self

    def __exit__(self, *exception: object) -> None:
        self._lines.close()
        if self._console.is_terminal:
            self._live.stop()

    @contextlib.asynccontextmanager
    async def ticking(self) -> AsyncGenerator[None]:
        """Keep drawing in the background while this context is open."""
        if not self._console.is_terminal:
            yield
            return
        ticker = asyncio.create_task(self._tick())
        try:
            yield
        finally:
            ticker.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await ticker

    async def _tick(self) -> None:
        while True:
            if self.due():
                self.show()
            await asyncio.sleep(_REFRESH_SECONDS)

    def resetting(self) -> None:
        """Show that all envs have started and are being reset."""
        self._doing, self._since = "first reset", time.monotonic()

    def ready(self) -> None:
        """Show that the first reset is complete."""
        self._doing = ""
        if not self._console.is_terminal:
            words = [] if self._steps is None else [counted(self._steps, "step")]
            words += [] if self._seconds is None else [f"for {self._seconds:g} s"]
            self._console.print(f"collecting {' '.join(words)}")

    def say(self, words: str) -> None:
        """Print a line that stays."""
        self._console.print(words, soft_wrap=True)

    def due(self) -> bool:
        """Return True if the display is old enough to be drawn again."""
        return time.monotonic() >= self._next_at

    def show(self) -> None:
        """Draw everything."""
        now = time.monotonic()
        self._next_at = now + _REFRESH_SECONDS
        if not self._console.is_terminal:
            return
        self._recent.append((now, self._group.metrics()))
        while self._recent[0][0] < now - _RATE_SECONDS:
            self._recent.popleft()
        self._live.update(self._drawn(now), refresh=True)

    def _drawn(self, now: float) -> Text:
        width, height = self._console.size
        head = _SPINNER[int(now / _REFRESH_SECONDS) % len(_SPINNER)] + " "
        if not self._doing:
            done = round(self._share_done(now) * _BAR)
            head += "━" * done + "─" * (_BAR - done) + " "
        lines = [head + _fitting(self._parts(now), width - len(head))]
        if self._workers is not None:
            lines += self._workers.drawn(now, max(_FEWEST_ROWS, height - 6), width)
        return Text("\n".join(lines), no_wrap=True, overflow="crop")

    def _share_done(self, now: float) -> float:
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
        (then, before), (latest, numbers) = self._recent[0], self._recent[-1]
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

    def _time_left(self, now: float, rate: float) -> list[str]:
        left: list[float] = []
        if self._steps is not None and rate:
            left.append((self._steps - self._statistics.steps) / rate)
        if self._seconds is not None:
            left.append(self._seconds - self._statistics.elapsed(now))
        if not left:
            return []
        seconds = max(0, round(min(left)))
        hours, minutes = divmod(seconds // 60, 60)
        return [f"{hours}:{minutes:02}:{seconds % 60:02} left" if hours else
                f"{minutes}:{seconds % 60:02} left"]  # fmt: skip

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


class _WorkerTable:
    """A line for each worker with its envs, state and speed."""

    def __init__(self, group: EnvGroup, statistics: RolloutStatistics) -> None:
        self._group = group
        self._statistics = statistics
        self._before: dict[int, tuple[float, int]] = {}
        self._rates: dict[int, float] = {}
        self._memory: dict[int, int] = {}
        """By process id; that of one worker is read anew in each turn."""

    def drawn(self, now: float, rows: int, width: int) -> list[str]:
        """Return the lines of the table, for at most `rows` workers."""
        workers = self._group.get_workers()
        times, steps = self._statistics.recent_step_us(), self._statistics.steps_by_env()
        visible = workers[:rows]
        self._read_memory([worker["pid"] for worker in visible if worker["pid"] is not None])
        table = [
            self._row(worker, times, self._rate(number_, worker, steps, now))
            for number_, worker in enumerate(visible)
        ]
        more = [f"and {len(workers) - rows} more"] if len(workers) > rows else []
        return [*_aligned([_COLUMNS, *table], width), *more]

    def _read_memory(self, pids: Sequence[int]) -> None:
        """Read the memory of the worker that was read longest ago; each takes a millisecond."""
        known = {pid: used for pid, used in self._memory.items() if pid in pids}
        unread = [pid for pid in pids if pid not in known]
        for pid in [*unread, *known][:1]:
            known.pop(pid, None)
            known[pid] = memory_bytes([pid])
        self._memory = known

    def _row(self, worker: dict[str, Any], times: dict[str, float], rate: float) -> tuple[str, ...]:
        ids, pid = worker["env_ids"], worker["pid"]
        own = [times[env_id] for env_id in ids if env_id in times]
        return (
            "here" if pid is None else str(pid),
            worker["entry"],
            count(len(ids)),
            count(rate),
            duration(sum(own) / len(own) if own else None),
            f"{self._memory[pid] / 2**20:,.0f} MiB" if pid in self._memory else "-",
            count(worker["restarts"]),
            _state(worker),
        )

    def _rate(
        self, number_: int, worker: dict[str, Any], steps: dict[str, int], now: float
    ) -> float:
        done = sum(steps.get(env_id, 0) for env_id in worker["env_ids"])
        then, before = self._before.setdefault(number_, (now, done))
        if now - then >= 1.0:
            self._rates[number_] = (done - before) / (now - then)
            self._before[number_] = (now, done)
        return self._rates.get(number_, 0.0)


def _aligned(rows: Sequence[tuple[str, ...]], width: int) -> list[str]:
    """Return lines with aligned columns, of which some are left out if `width` is too small."""
    columns = {name: [row[k] for row in rows] for k, name in enumerate(_COLUMNS)}
    widths = {name: max(map(len, column)) for name, column in columns.items()}
    for name in _EXPENDABLE:
        if sum(widths.values()) + 2 * (len(widths) - 1) <= width:
            break
        del columns[name], widths[name]
    for name, column in columns.items():
        aligned = str.ljust if name in _TEXTS else str.rjust
        columns[name] = [aligned(text, widths[name]) for text in column]
    return ["  ".join(cells) for cells in zip(*columns.values(), strict=True)]


def _state(worker: dict[str, Any]) -> str:
    if worker["state"] != "up":
        return worker["state"]
    if not worker["owed"]:
        return "waits for actions"
    if worker["owed_seconds"] < _PATIENCE_SECONDS:
        return "steps"
    return f"{worker['owed'][0]} for {worker['owed_seconds']:.0f} s"


def _listed(names: Sequence[str]) -> str:
    named = [name for name in names if name][:_NAMED]
    more = len(names) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 and named else "")


def _fitting(parts: Sequence[str], room: int) -> str:
    """Return the first of `parts`, as many as fit."""
    text = parts[0]
    for part in parts[1:]:
        if len(text) + 2 + len(part) > room:
            break
        text += "  " + part
    return text
