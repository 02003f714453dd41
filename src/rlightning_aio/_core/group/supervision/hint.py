"""`Hint`: suggests one faster setting, once in a group's life, from the group's sums.

A setting is suggested where it would make a turn of all envs at least 1.5 times as fast, by what
two looks in a row have found: a machine that is busy for a moment suggests nothing.
Rule: a hint is a guess; ``rlightning-aio bench`` measures. An ordinary step pays for it with one
comparison.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from rlightning_aio.config import EnvConfig
from rlightning_aio.registry import PLACEMENTS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables

_FIRST_LOOK: Final = 8
"""Number of batches after which envs are past their first steps, which may compile and load."""
LAST_LOOK: Final = 1024
_WORTH: Final = 1.5
_BRIEF: Final = 200e-6
"""Limit of steps that are no longer than what it costs to wake the process of each."""
_TINY: Final = 30e-6
_IN_WORKERS: Final = (40e-6, 2e-6)
"""What a batch costs beside the steps, and each env of a worker in it, in seconds."""
_INLINE: Final = (30e-6, 0.5e-6)
_ENOUGH_SECONDS: Final = 0.02
_ENOUGH_RESULTS: Final = 16
_MANY_RESULTS: Final = 250
"""Of short steps, which hardly matter to a program that ends soon."""
_OF_WORKERS: Final = PLACEMENTS["inline"].refuses.keys() - {"env_vars", "ray_options"}
"""Fields that need a worker of this machine. (Every worker has variables.)"""

_log = logging.getLogger("rlightning_aio")


class Advice(NamedTuple):
    """A faster setting.

    Attributes:
        gain: how many times as fast it would be.
        setting: as in a config entry.
        why: what is slow, and what the setting does about it.
        more: what else is worth knowing.
    """

    gain: float
    setting: str
    why: str
    more: str


class Hint:
    """Looks from time to time whether another setting would be faster, until it has found one.

    Attributes:
        due: the number of returned batches at which to `look` next.
    """

    def __init__(self, tables: Tables) -> None:
        self.due: float = _FIRST_LOOK
        self._tables = tables
        self._before: dict[str, dict[str, float]] = {}
        self._found: dict[str, str] = {}

    def look(self) -> None:
        """Log what the sums since the last look suggest, for the first entry that is slow."""
        self.due = 2 * self.due if self.due < LAST_LOOK else float("inf")
        sums = self._tables.sums
        entries: dict[str, list[HostRecord]] = {}
        for record in self._tables.records:
            if record.is_worker_here and len(self._tables.slots_of(record)):
                entries.setdefault(record.config.name, []).append(record)
        for name, records in entries.items():
            now = sums.of(np.concatenate([np.array(r.slots) for r in records]))
            now["batches"] = sums.num_batches
            before = self._before.get(name, now)
            self._before[name] = now
            spent = {key: value - before.get(key, 0) for key, value in now.items()}
            found = advice(records, spent, self._tables.num_cores)
            setting = "" if found is None else found.setting
            if found is not None and self._found.get(name) == setting:
                self.due = float("inf")
                _log.warning(
                    "entry %r: %s, about %.1f times as fast, set %s%s; `rlightning-aio bench` "
                    "measures",
                    name, found.why, found.gain, setting, found.more,
                )  # fmt: skip
                return
            self._found[name] = setting


class _Turn(NamedTuple):
    """A turn of all envs of an entry, as it was; seconds.

    Attributes:
        workers, num_envs, cores: how many there are.
        whole: of a turn.
        step: of an env in it.
        computing: processor time of a worker for it; None if unknown.
        apart: between a result and the next request of an env.
        batches: in a turn.
    """

    workers: int
    num_envs: int
    cores: int
    whole: float
    step: float
    computing: float | None
    apart: float
    batches: float


def advice(
    records: Sequence[HostRecord], spent: Mapping[str, float], num_cores: int
) -> Advice | None:
    """Return the setting of an entry that would be fastest; None if none is worth it.

    Args:
        records: of the entry's workers.
        spent: what the sums of `EnvGroup.metrics` have grown by, and ``batches``.
        num_cores: that this process and its workers may use.
    """
    results, busy = spent["results"], spent["seconds_in_envs"]
    if results < _ENOUGH_RESULTS or busy <= 0 or any(r.awaits_several for r in records):
        return None
    num_envs = sum(len(record.slots) for record in records)
    times = [spent[f"seconds_{name}"] for name in ("queued", "uncollected", "idle")]
    computing = spent.get("seconds_computing")
    turn = _Turn(
        len(records), num_envs, num_cores, (busy + sum(times)) / results, busy / results,
        None if computing is None else computing / results,
        times[-1] / results, num_envs * spent["batches"] / results,
    )  # fmt: skip
    config = records[0].config
    found: list[Advice] = []
    if results >= _MANY_RESULTS and turn.step < _BRIEF:
        if config.envs_per_process == "auto":
            found += _sharing(turn)
        if all(getattr(config, f) == EnvConfig.model_fields[f].default for f in _OF_WORKERS):
            found.append(_inline(turn))
    if busy >= _ENOUGH_SECONDS:
        found += _apart(turn, max(len(record.slots) for record in records))
    best = max(found, default=None)
    return best if best is not None and best.gain >= _WORTH else None


def _sharing(turn: _Turn) -> list[Advice]:
    """Have as many workers as there are cores."""
    if turn.workers <= turn.cores or turn.workers < turn.num_envs:
        return []
    each, (batch, env) = -(-turn.num_envs // turn.cores), _IN_WORKERS
    why = (
        f"each of {turn.workers} envs has a worker, {turn.workers / turn.cores:.1f} times as many "
        f"as cores, and a step takes {1e6 * turn.step:.0f} µs, no longer than the switch between "
        "two processes; to have envs share workers"
    )
    gain = turn.whole / (turn.apart + batch + each * (turn.step + env))
    more = f" (in VectorEnv, max_concurrency={turn.cores})"
    return [Advice(gain, f"envs_per_process: {each}", why, more)]


def _inline(turn: _Turn) -> Advice:
    """Have them in this process, one after the other, while the caller waits."""
    batch, env = _INLINE
    steps = turn.num_envs * turn.step
    why = (
        f"a step takes {1e6 * turn.step:.0f} µs, and those of {turn.num_envs} envs one after the "
        "other less than the way to their workers and back; to have them in this process"
    )
    more = " (in VectorEnv, placement='inline')"
    if turn.step < _TINY:
        more += "; Gymnasium's SyncVectorEnv is faster still"
    gain = turn.whole / (turn.batches * (turn.apart + batch) + steps + turn.num_envs * env)
    return Advice(gain, "placement: inline", why, more)


def _apart(turn: _Turn, together: int) -> list[Advice]:
    """Have envs that wait do so at the same time."""
    if together == 1 or turn.computing is None or turn.computing >= turn.step / 2:
        return []
    why = (
        f"{together} envs share each worker, where only one is stepped at a time, and their steps "
        f"wait (one takes {1e3 * turn.step:.3g} ms, and computes for "
        f"{100 * turn.computing / turn.step:.0f} % of that); to have them wait at the same time"
    )
    longest = max(turn.step, turn.num_envs * turn.computing / turn.cores)
    gain = turn.whole / (turn.apart + _IN_WORKERS[0] + longest)
    return [Advice(gain, "envs_per_process: 1", why, " (in VectorEnv, envs_per_process=1)")]
