"""Suggest a faster setting from measured times.

Rule: a hint is a guess from a few numbers, and each is logged once; ``rlightning-aio bench``
measures. An ordinary step pays for hints with one comparison.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.state.stats import Stats
    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio.config import EnvConfig

__all__ = ["HINT_AFTER_BATCHES", "Hints", "Spent", "hint", "waits"]

HINT_AFTER_BATCHES: Final = 1000
_FIRST_LOOK: Final = 8
"""Number of batches after which envs are past their first steps, which may compile and load."""
_SHORT_US: Final = 1000.0
"""Limit of steps that compute, as in simulators; robots wait longer."""
_BRIEF_US: Final = 200.0
"""Limit of steps that are no longer than what it costs to wake the process of each."""
_TINY_US: Final = 30.0
"""Limit of steps that take less time than the way to a worker and back."""
_ENOUGH_NS: Final = 20_000_000
_ENOUGH_RESULTS: Final = 16

_log = logging.getLogger("rlightning_aio")


class Spent(NamedTuple):
    """What the envs of workers have done for a while.

    Attributes:
        results: number of steps and resets.
        elapsed_ns: the time that has passed, summed over the workers.
        busy_ns: of the steps and resets.
        ran_ns: for which the workers' threads ran on a core; queued_ns: for which they waited for
            one.
        at_once: several envs of a worker were busy at the same time.
    """

    results: int
    elapsed_ns: int
    busy_ns: int
    ran_ns: int
    queued_ns: int
    at_once: bool

    @property
    def step_seconds(self) -> float:
        """The mean time of a step or reset."""
        return self.busy_ns / self.results / 1e9

    @property
    def is_enough(self) -> bool:
        """True if it says anything, and other settings would change anything."""
        least = max(_ENOUGH_NS, self.elapsed_ns / 4)
        return self.results >= _ENOUGH_RESULTS and self.busy_ns >= least


def waits(spent: Spent) -> bool:
    """Return True if envs that take turns spend most of their time neither on a core nor in line.

    The time in line for a core is that of other programs, which make no env wait for long.
    """
    return not spent.at_once and spent.ran_ns < (spent.busy_ns - spent.queued_ns) / 2


@dataclass(frozen=True)
class _Since:
    """The state of the workers of an entry at a time in monotonic ns."""

    at_ns: int
    restarts: list[int]
    ran_ns: int
    queued_ns: int


class Hints:
    """Looks from time to time whether other settings would be faster, and logs it.

    Args:
        tables: of the group.

    Attributes:
        due: the number of returned batches at which to `look` next.
    """

    def __init__(self, tables: Tables) -> None:
        self.due: float = _FIRST_LOOK
        self._records, self._stats = tables.records, tables.stats
        self._num_cores = tables.num_cores
        # By entry; one that was given a hint has none any more.
        self._since: dict[str, _Since | None] = {}

    def look(self) -> None:
        """Log what the measured times suggest."""
        is_last = self.due >= HINT_AFTER_BATCHES
        self.due = float("inf") if is_last else min(2 * self.due, HINT_AFTER_BATCHES)
        measured: dict[str, list[HostRecord]] = {}
        for record in self._records:
            if record.is_worker_here:
                measured.setdefault(record.config.name, []).append(record)
        for name, records in measured.items():
            sharing = [record for record in records if len(record.slots) > 1]
            if sharing:
                self._look_at(name, sharing)
            elif records[0].config.envs_per_process == "auto" and len(records) > self._num_cores:
                self._look_at_separate(name, records)
        if is_last:
            self._look_at_latencies()

    def _last_look(self, name: str, now: _Since) -> _Since | None:
        """Return when an entry was looked at last; None if it was warned of or begins anew."""
        since = self._since.get(name)
        if since is not None and since.restarts == now.restarts:
            return since
        if since is not None or name not in self._since:
            self._since[name] = now
        return None

    def _look_at(self, name: str, records: Sequence[HostRecord]) -> None:
        """Warn if envs that share workers wait."""
        now = _now(records)
        if now is None or (since := self._last_look(name, now)) is None:
            return
        spent = _spent(records, self._stats, since, now)
        if not spent.is_enough:
            return
        self._since[name] = now
        together = max(len(record.slots) for record in records)
        if waits(spent):
            self._since[name] = None
            _log.warning("%s", _advice(name, together, spent))

    def _look_at_separate(self, name: str, records: Sequence[HostRecord]) -> None:
        """Warn if envs that have a worker each make steps so short that sharing is faster."""
        restarts = [record.restarts for record in records]
        since = self._last_look(name, _Since(time.monotonic_ns(), restarts, 0, 0))
        if since is None:
            return
        slots, begun, done = self._stats.executed(since.at_ns)
        own = np.isin(slots, [record.slots.start for record in records])
        if np.count_nonzero(own) < _ENOUGH_RESULTS:
            return
        step_us = float(np.median((done - begun)[own])) / 1e3
        if step_us < _BRIEF_US:
            self._since[name] = None
            _log.warning("%s", _advice_to_share(name, len(records), self._num_cores, step_us))

    def _look_at_latencies(self) -> None:
        if len({record.config.name for record in self._records}) > 1:
            return  # The latencies are those of all entries.
        workers = Counter(record.config.name for record in self._records if record.is_worker_here)
        warned = {name for name, since in self._since.items() if since is None}
        configs = [r.config for r in self._records if r.config.name not in warned]
        text = hint(
            configs,
            workers,
            self._num_cores,
            self._stats.summary(time.monotonic_ns())["latency_us"],
        )
        if text is not None:
            _log.info("%s; `rlightning-aio bench` measures what is best", text)


def _now(records: Sequence[HostRecord]) -> _Since | None:
    ran = queued = 0
    for record in records:
        times = record.host.processor_times()
        if times is None:
            return None
        ran += times[0]
        queued += times[1]
    return _Since(time.monotonic_ns(), [record.restarts for record in records], ran, queued)


def _spent(records: Sequence[HostRecord], stats: Stats, since: _Since, now: _Since) -> Spent:
    slots, begun, done = stats.executed(since.at_ns)
    results = busy = 0
    at_once = False
    for record in records:
        own = (slots >= record.slots.start) & (slots < record.slots.stop)
        results += int(np.count_nonzero(own))
        busy += int((done[own] - begun[own]).sum())
        at_once = at_once or _overlap(begun[own], done[own])
    elapsed = (now.at_ns - since.at_ns) * len(records)
    ran, queued = now.ran_ns - since.ran_ns, now.queued_ns - since.queued_ns
    return Spent(results, elapsed, busy, ran, queued, at_once)


def _overlap(begun: NDArray[np.int64], done: NDArray[np.int64]) -> bool:
    order = begun.argsort()
    return bool((begun[order][1:] < done[order][:-1]).any())


def _advice(name: str, together: int, spent: Spent) -> str:
    share = spent.ran_ns / max(spent.busy_ns - spent.queued_ns, 1)
    factor = min(together, 1 / max(share, 1e-9))
    return (
        f"entry {name!r}: {together} envs share each worker, where only one is stepped at a time, "
        f"and their steps wait (one takes {1e3 * spent.step_seconds:.3g} ms, and keeps a "
        f"core busy for {100 * share:.0f} % of that); to have them wait at the same time, up to "
        f"{factor:.1f} times as fast, set envs_per_process: 1 (in VectorEnv, envs_per_process=1)"
    )


def _advice_to_share(name: str, num_workers: int, num_cores: int, step_us: float) -> str:
    together = -(-num_workers // num_cores)
    return (
        f"entry {name!r}: each of {num_workers} envs has a worker, {num_workers / num_cores:.1f} "
        f"times as many as cores, and a step takes {step_us:.0f} µs, no longer than the switch "
        f"between two processes; to have envs share workers, set envs_per_process: {together} (in "
        f"VectorEnv, max_concurrency={num_cores})"
    )


def hint(
    configs: Sequence[EnvConfig],
    num_workers: Mapping[str, int],
    num_cores: int,
    latency_us: Mapping[str, Mapping[str, Any]],
) -> str | None:
    """A message that suggests a faster setting, or None.

    Args:
        configs: the entries.
        num_workers: workers of each entry, by its name.
        num_cores: cores that this process and its workers may use.
        latency_us: from `EnvGroup.get_stats`; empty before anything was measured.
    """
    if not latency_us:
        return None
    step, transfer = (float(latency_us[kind]["p50"]) for kind in ("step", "transfer"))
    measured = f"a step takes {step:.0f} µs and its transfer {transfer:.0f} µs"
    for config in configs:
        workers = num_workers.get(config.name, 0)
        if workers > num_cores and workers > 1 and step < min(_SHORT_US, 10 * transfer):
            return (
                f"{measured}, and entry {config.name!r} has {workers} workers for {num_cores} "
                f"cores: several envs in each (envs_per_process: "
                f"{-(-config.num_workers // num_cores)}) would be faster"
            )
        if config.num_workers == 1 and workers == 1 and step < _TINY_US and transfer > 2 * step:
            return (
                f"{measured}: entry {config.name!r} would be faster in this process "
                "(placement: inline)"
            )
    return None
