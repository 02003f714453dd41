"""`Stats`: throughput, batch sizes, latencies and episodes of a group.

Rule: the hot path only appends arrays that it already has to a window; figures are computed from
them on request.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from rlightning_aio.protocol.slab import IS_RESET, TERMINATED, TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["Stats"]

_WINDOW_SAMPLES: Final = 1024
_WINDOW_SECONDS: Final = 10.0
_VERDICTS: Final = ("success", "fail")
"""Keys of booleans in the info that ends an episode: the env's verdicts on it."""
_HOLDERS: Final = (*_VERDICTS, "final_info")
"""Keys of infos that may have them."""


class _Sample(msgspec.Struct):
    """The results with one layout of a returned batch. Times in ns of the monotonic clock.

    Attributes:
        batch: number of the batch.
        num_envs: sub-environments per result.
        resets: mask of the sub-environments that were reset; None if none was.
    """

    batch: int
    at_ns: int
    slots: NDArray[np.intp]
    sent_ns: NDArray[np.int64]
    times: NDArray[np.int64]
    num_envs: int
    resets: NDArray[np.bool_] | None
    synchronous: bool

    def steps(self) -> NDArray[np.int64]:
        """The number of env steps in each result, ``[n]``."""
        if self.resets is None:
            return np.full(len(self.slots), self.num_envs)
        return self.num_envs - self.resets.reshape(len(self.slots), -1).sum(axis=1)


@dataclass(slots=True)
class _Verdicts:
    """The number of episodes of each slot with a verdict, and of those where it was true."""

    count: NDArray[np.int64]
    true: NDArray[np.int64]

    @classmethod
    def of(cls, size: int) -> _Verdicts:
        return cls(np.zeros(size, np.int64), np.zeros(size, np.int64))

    def rate(self, slots: list[int]) -> float | None:
        count = int(self.count[slots].sum())
        return int(self.true[slots].sum()) / count if count else None


class Stats:
    """A window over returned results, and sums over ended episodes.

    Attributes:
        num_batches: the number of returned batches.
    """

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        self._samples: deque[_Sample] = deque(maxlen=_WINDOW_SAMPLES)
        self.num_batches = 0
        # Sums have one more row per config entry, for former members whose slots were taken by
        # others. Columns: number of episodes, sum of their returns, sum of their lengths.
        size = len(envs) + len(envs.names.entry_names)
        self._sums = np.zeros((size, 3))
        # Return and length of the last episode.
        self._last = np.zeros((len(envs), 2))
        self._requests_before = np.zeros(size, np.int64)
        self._verdicts = {name: _Verdicts.of(size) for name in _VERDICTS}

    def move_to_entry(self, slot: int) -> None:
        """Move the sums of `slot` to its entry's former members, before another one takes it."""
        former = self._former(self._envs.names.entries.item(slot))
        for sums in self._all_sums():
            sums[former] += sums[slot]
            sums[slot] = 0
        self._last[slot] = 0
        number = self._requests.numbering.number(slot)
        self._requests_before[former] += self._requests_before[slot] - number
        self._requests_before[slot] = number

    def _former(self, entry: int) -> int:
        """The row of an entry's former members in the sums."""
        return len(self._envs) + entry

    def _all_sums(self) -> list[NDArray[Any]]:
        verdicts = self._verdicts.values()
        return [self._sums, *(v.count for v in verdicts), *(v.true for v in verdicts)]

    def account(self, parts: Sequence[ResultColumns], *, synchronous: bool) -> None:
        """Record results that are about to be returned."""
        now = time.monotonic_ns()
        sent_ns = self._requests.sent_ns
        self.num_batches += 1
        for part in parts:
            slots, shape = part.slots, part.reward.shape
            has_sub_envs = len(shape) > (2 if part.agents else 1)
            resets = None
            if part.episode_return is not None:  # Flags are set.
                resets = part.flags[:, IS_RESET] if part.flags.ndim == 2 else part.is_reset
                resets = resets.copy()
            self._samples.append(
                _Sample(
                    self.num_batches,
                    now,
                    slots,
                    sent_ns[slots],
                    part.times,
                    shape[-1] if has_sub_envs else 1,
                    resets,
                    synchronous,
                )
            )
            if part.episode_return is not None and part.episode_length is not None:
                self._note_episodes(part, part.episode_return, part.episode_length)

    def _note_episodes(
        self, part: ResultColumns, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        flags = part.flags
        ended = flags[..., TERMINATED] | flags[..., TRUNCATED]
        ended &= lengths > 0
        if part.restarted is not None:
            ended[part.restarted] = False
        rows: NDArray[np.intp] = ended.nonzero()[0]
        if not len(rows):
            return
        slots = part.slots[rows]
        outcomes = np.empty((len(rows), 3))
        outcomes[:, 0], outcomes[:, 1], outcomes[:, 2] = 1, returns[ended], lengths[ended]
        with np.errstate(over="ignore", invalid="ignore"):  # The means show them.
            # A result with sub-environments or agents may end several: its slot repeats.
            np.add.at(self._sums, slots, outcomes)
        self._last[slots] = outcomes[:, 1:]
        if part.info_marks is not None or part.out_of_band:
            for row in dict.fromkeys(rows.tolist()):
                if part.may_hold(row, _HOLDERS):
                    slot = part.slots.item(row)
                    with suppress(Exception):  # The info may be malformed; its reader gets it.
                        self._note_verdicts(slot, part.reported_info_of(row), ended[row])

    def _note_verdicts(self, slot: int, info: dict[str, Any], ended: NDArray[np.bool_]) -> None:
        """Count the verdicts in `info` on the episodes that have `ended`."""
        final: Any = info.get("final_info")
        if isinstance(final, dict):
            info = cast("dict[str, Any]", final)  # The rest is about the next episode.
        for name, verdicts in self._verdicts.items():
            given: Any = info.get(name)
            if given is None:
                continue
            # A tensor may be on another device, where NumPy can't read it.
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given)
            if array.dtype.kind == "b" and array.shape == ended.shape:
                known = ended & info.get(f"_{name}", True)
                verdicts.count[slot] += np.count_nonzero(known)
                verdicts.true[slot] += np.count_nonzero(array & known)

    def summary(self) -> dict[str, Any]:
        """The figures that `EnvGroup.get_stats` documents, over the window."""
        samples = self._window()
        if not samples:
            return {"steps_per_second": 0.0, "entries": {}, "batch_size": {}, "latency_us": {}}
        seconds = max((samples[-1].at_ns - samples[0].at_ns) / 1e9, 1e-9)
        sizes = Counter[int]()
        for sample in samples:
            sizes[sample.batch] += len(sample.slots)
        # The first batch opens the window, so its steps were made before the window.
        counted = [sample for sample in samples if sample.batch != samples[0].batch]
        return {
            "steps_per_second": sum(int(s.steps().sum()) for s in counted) / seconds,
            "entries": self._rates_by_entry(counted, seconds),
            "batch_size": {
                "mean": sizes.total() / len(sizes),
                "min": min(sizes.values()),
                "max": max(sizes.values()),
            },
            "latency_us": self._latencies(samples),
        }

    def executed(
        self, since_ns: int
    ) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
        """Return when envs executed what they began after `since_ns`, at most a window of it.

        Slots, beginnings and ends (ns of the monotonic clock), in the order of the results.
        """
        samples = [sample for sample in self._samples if sample.at_ns >= since_ns]
        if not samples:
            nothing = np.zeros(0, np.int64)
            return nothing, nothing, nothing
        slots = np.concatenate([sample.slots for sample in samples])
        done, busy = np.concatenate([sample.times for sample in samples]).T
        later = done - busy >= since_ns
        return slots[later], (done - busy)[later], done[later]

    def _window(self) -> list[_Sample]:
        if not self._samples:
            return []
        since = self._samples[-1].at_ns - int(_WINDOW_SECONDS * 1e9)
        return [sample for sample in self._samples if sample.at_ns >= since]

    def _rates_by_entry(
        self, samples: list[_Sample], seconds: float
    ) -> dict[str, dict[str, float]]:
        rates: dict[str, dict[str, float]] = {}
        for sample in samples:
            kind = "sync" if sample.synchronous else "async"
            names = self._envs.names.names(sample.slots)
            for name, steps in zip(names, sample.steps().tolist(), strict=True):
                entry = rates.setdefault(name, {"sync": 0.0, "async": 0.0})
                entry[kind] += steps / seconds
        return rates

    @staticmethod
    def _latencies(samples: list[_Sample]) -> dict[str, dict[str, float]]:
        done, busy = np.concatenate([s.times for s in samples]).T
        sent = np.concatenate([s.sent_ns for s in samples])
        taken = np.concatenate([np.full(len(s.slots), s.at_ns) for s in samples])
        stepped = np.concatenate([s.steps() for s in samples]) > 0
        if not stepped.any():
            return {}
        kinds = {"step": busy, "wait": done - busy - sent, "transfer": taken - done}
        return {kind: _percentiles(values[stepped] / 1e3) for kind, values in kinds.items()}

    def by_env(self) -> dict[str, dict[str, Any]]:
        """The figures of each env that `EnvGroup.get_env_stats` documents."""
        return {
            env_id: self._summed([slot]) for slot, env_id in enumerate(self._envs.env_ids) if env_id
        }

    def by_entry(self) -> dict[str, dict[str, Any]]:
        """The figures of each config entry, over all of its envs and former members."""
        names = self._envs.names
        found: dict[str, dict[str, Any]] = {}
        for entry, name in enumerate(names.entry_names):
            slots: list[int] = np.flatnonzero(names.entries == entry).tolist()
            found[name] = self._summed([*slots, self._former(entry)])
        return found

    def _summed(self, slots: list[int]) -> dict[str, Any]:
        present = [slot for slot in slots if slot < len(self._envs)]
        numbers = self._requests.numbering.numbers(present)
        with np.errstate(over="ignore", invalid="ignore"):
            episodes, total_return, total_length = self._sums[slots].sum(axis=0).tolist()
        found = {
            "requests": int(numbers.sum() - self._requests_before[slots].sum()),
            "episodes": int(episodes),
            "mean_return": total_return / episodes if episodes else None,
            "mean_length": total_length / episodes if episodes else None,
        }
        if len(slots) == 1:
            last_return, last_length = self._last[slots[0]].tolist()
            found["last_return"] = last_return if episodes else None
            found["last_length"] = int(last_length) if episodes else None
        return found | {f"{name}_rate": v.rate(slots) for name, v in self._verdicts.items()}

    def reset_envs(self) -> None:
        """Set the sums over episodes and requests to zero."""
        for sums in (*self._all_sums(), self._last, self._requests_before):
            sums[:] = 0
        self._requests_before[: len(self._envs)] = self._requests.numbering.numbers()


def _percentiles(values: NDArray[np.float64]) -> dict[str, float]:
    """Return the median and the 99th percentile of at least one value.

    `numpy.percentile` gives the same, but imports a module at its first call. That fails in a
    process that is out of descriptors, which must still be able to collect.
    """
    ranks = np.array([0.5, 0.99]) * (len(values) - 1)
    p50, p99 = np.interp(ranks, np.arange(len(values)), np.sort(values)).tolist()
    return {"p50": p50, "p99": p99}
