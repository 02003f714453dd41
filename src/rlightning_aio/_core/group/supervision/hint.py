"""`Hint`: suggests one faster setting, once in a group's life, from the group's sums.

Rule: a hint is a guess; ``rlightning-aio bench`` measures. An ordinary step pays for it with one
comparison.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables

__all__ = ["LAST_LOOK", "Hint", "advice"]

_FIRST_LOOK: Final = 8
"""Number of batches after which envs are past their first steps, which may compile and load."""
LAST_LOOK: Final = 1024
_BRIEF_US: Final = 200.0
"""Limit of steps that are no longer than what it costs to wake the process of each."""
_TINY_US: Final = 30.0
"""Limit of steps that take less time than the way to a worker and back."""
_ENOUGH_SECONDS: Final = 0.02
_ENOUGH_RESULTS: Final = 16
_MANY_RESULTS: Final = 1000
"""Of short steps, which hardly matter to a program that ends soon."""

_log = logging.getLogger("rlightning_aio")


class Hint:
    """Looks from time to time whether another setting would be faster, until it has found one.

    Attributes:
        due: the number of returned batches at which to `look` next.
    """

    def __init__(self, tables: Tables) -> None:
        self.due: float = _FIRST_LOOK
        self._tables = tables
        self._first: dict[str, dict[str, float]] = {}

    def look(self) -> None:
        """Log what the sums since the first look suggest, for the first entry that is slow."""
        self.due = 2 * self.due if self.due < LAST_LOOK else float("inf")
        entries: dict[str, list[HostRecord]] = {}
        for record in self._tables.records:
            if record.is_worker_here:
                entries.setdefault(record.config.name, []).append(record)
        for name, records in entries.items():
            now = self._tables.sums.of(np.concatenate([np.array(r.slots) for r in records]))
            first = self._first.setdefault(name, now)
            spent = {key: value - first.get(key, 0) for key, value in now.items()}
            if text := advice(records, spent, self._tables.num_cores):
                self.due = float("inf")
                _log.warning("entry %r: %s; `rlightning-aio bench` measures", name, text)
                return


def advice(records: Sequence[HostRecord], spent: Mapping[str, float], num_cores: int) -> str | None:
    """Return a faster setting for an entry, and why; None if there is none.

    Args:
        records: of the entry's workers.
        spent: what the sums of `EnvGroup.metrics` have grown by.
        num_cores: that this process and its workers may use.
    """
    config, workers = records[0].config, len(records)
    together = max(len(record.slots) for record in records)
    results, busy = spent["results"], spent["seconds_in_envs"]
    if results < _ENOUGH_RESULTS or busy <= 0:
        return None
    step_us = 1e6 * busy / results
    is_brief = results >= _MANY_RESULTS and step_us < _BRIEF_US
    if together == 1 and workers > num_cores and is_brief:
        if config.envs_per_process != "auto":
            return None  # As its user wants it.
        return (
            f"each of {workers} envs has a worker, {workers / num_cores:.1f} times as many as "
            f"cores, and a step takes {step_us:.0f} µs, no longer than the switch between two "
            f"processes; to have envs share workers, set envs_per_process: "
            f"{-(-workers // num_cores)} (in VectorEnv, max_concurrency={num_cores})"
        )
    if workers == 1 and together * step_us < _TINY_US and is_brief and not records[0].limits:
        return (
            f"its steps take {together * step_us:.0f} µs, less than the way to a worker and back; "
            "to have them in this process, set placement: inline"
        )
    computing = spent.get("seconds_computing")
    if together == 1 or computing is None or any(record.awaits_several for record in records):
        return None
    # Of all envs: while one is stepped, the others of its worker are queued.
    elapsed = busy + sum(spent[f"seconds_{name}"] for name in ("queued", "uncollected", "idle"))
    at_work = together * busy
    if busy >= _ENOUGH_SECONDS and at_work >= elapsed / 4 and computing < busy / 2:
        factor = min(together, busy / max(computing, 1e-9))
        return (
            f"{together} envs share each worker, where only one is stepped at a time, and their "
            f"steps wait (one takes {step_us / 1e3:.3g} ms, and computes for "
            f"{100 * computing / busy:.0f} % of that); to have them wait at the same time, up to "
            f"{factor:.1f} times as fast, set envs_per_process: 1 (in VectorEnv, "
            "envs_per_process=1)"
        )
    return None
