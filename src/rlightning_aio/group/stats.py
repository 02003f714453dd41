"""What the group has measured: throughput, batch sizes, latencies, episodes.

Rule: the hot path appends arrays it has anyway to a window; everything that is computed
from them is computed when somebody asks.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.requests import Requests

__all__ = ["Stats"]

_WINDOW_BATCHES: Final = 1024
_WINDOW_SECONDS: Final = 10.0
_VERDICTS: Final = ("success", "fail")
"""Booleans in an info by which an env judges its episodes."""


@dataclass(slots=True)
class _Sample:
    """One batch that was handed out. Times in ns of the monotonic clock."""

    at_ns: int
    slots: NDArray[np.intp]
    sent_ns: NDArray[np.int64]
    times: NDArray[np.int64]
    synchronous: bool


@dataclass(slots=True)
class _Verdicts:
    """How many episodes of each slot an env has judged, and how many of these were true."""

    count: NDArray[np.int64]
    true: NDArray[np.int64]

    @classmethod
    def of(cls, size: int) -> _Verdicts:
        return cls(np.zeros(size, np.int64), np.zeros(size, np.int64))

    def rate(self, slots: list[int]) -> float | None:
        count = int(self.count[slots].sum())
        return int(self.true[slots].sum()) / count if count else None


class Stats:
    """Windows over what was handed out, and sums over the episodes that have ended."""

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        self._samples: deque[_Sample] = deque(maxlen=_WINDOW_BATCHES)
        # By slot: episodes, the sum of their returns, that of their lengths.
        self._sums = np.zeros((len(envs), 3))
        # Return and length of the last episode.
        self._last = np.zeros((len(envs), 2))
        self._requests_before = np.zeros(len(envs), np.int64)
        self._verdicts = {name: _Verdicts.of(len(envs)) for name in _VERDICTS}

    def account(self, parts: Sequence[ResultColumns], *, synchronous: bool) -> None:
        """Take note of results that are handed out."""
        now = time.monotonic_ns()
        sent_ns = self._requests.sent_ns
        for part in parts:
            slots = part.slots
            self._samples.append(_Sample(now, slots, sent_ns[slots], part.times, synchronous))
            if part.episode_return is not None and part.episode_length is not None:
                self._note_episodes(part, part.episode_return, part.episode_length)

    def _note_episodes(
        self, part: ResultColumns, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        ended = part.done & (lengths > 0)
        rows = np.flatnonzero(ended if ended.ndim == 1 else ended.reshape(len(part), -1).any(1))
        if not len(rows):
            return
        slots = part.slots[rows]
        if ended.ndim == 1:
            outcomes = np.ones((len(rows), 3))
            outcomes[:, 1], outcomes[:, 2] = returns[rows], lengths[rows]
            self._sums[slots] += outcomes
            self._last[slots] = outcomes[:, 1:]
        else:
            for slot, row in zip(slots.tolist(), rows.tolist(), strict=True):
                # Several sub-environments or agents may end in one result.
                mask = ended[row]
                own_returns, own_lengths = returns[row][mask], lengths[row][mask]
                self._sums[slot] += (len(own_returns), own_returns.sum(), own_lengths.sum())
                self._last[slot] = own_returns[-1], own_lengths[-1]
        if part.info_marks is not None or part.out_of_band:
            for slot, row in zip(slots.tolist(), rows.tolist(), strict=True):
                if part.may_hold(row, _VERDICTS):
                    self._note_verdicts(slot, part.info_of(row), ended[row])

    def _note_verdicts(self, slot: int, info: dict[str, Any], ended: NDArray[np.bool_]) -> None:
        """Count what the env says of the episodes that have `ended`."""
        for name, verdicts in self._verdicts.items():
            given: Any = info.get(name)
            # A tensor may lie on another device.
            array = np.asarray(given.tolist() if hasattr(given, "tolist") else given)
            if array.dtype.kind == "b" and array.shape == ended.shape:
                verdicts.count[slot] += np.count_nonzero(ended)
                verdicts.true[slot] += np.count_nonzero(array & ended)

    def summary(self) -> dict[str, Any]:
        """See `EnvGroup.get_stats`."""
        samples = self._window()
        if not samples:
            return {"steps_per_second": 0.0, "entries": {}, "batch_size": {}, "latency_us": {}}
        seconds = max((samples[-1].at_ns - samples[0].at_ns) / 1e9, 1e-9)
        sizes = np.array([len(sample.slots) for sample in samples])
        # The first batch opens the window: what it holds was made before.
        counted = samples[1:]
        return {
            "steps_per_second": sum(len(s.slots) for s in counted) / seconds,
            "entries": self._rates_by_entry(counted, seconds),
            "batch_size": {
                "mean": float(sizes.mean()),
                "min": int(sizes.min()),
                "max": int(sizes.max()),
            },
            "latency_us": self._latencies(samples),
        }

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
            for name in self._envs.names(sample.slots):
                entry = rates.setdefault(name, {"sync": 0.0, "async": 0.0})
                entry[kind] += 1.0 / seconds
        return rates

    @staticmethod
    def _latencies(samples: list[_Sample]) -> dict[str, dict[str, float]]:
        done, busy = np.concatenate([s.times for s in samples]).T
        sent = np.concatenate([s.sent_ns for s in samples])
        taken = np.concatenate([np.full(len(s.slots), s.at_ns) for s in samples])
        kinds = {"step": busy, "wait": done - busy - sent, "transfer": taken - done}
        return {
            kind: {
                "p50": float(np.percentile(values, 50)) / 1e3,
                "p99": float(np.percentile(values, 99)) / 1e3,
            }
            for kind, values in kinds.items()
        }

    def by_env(self) -> dict[str, dict[str, Any]]:
        """See `EnvGroup.get_env_stats`."""
        return {
            env_id: self._summed([slot]) for slot, env_id in enumerate(self._envs.env_ids) if env_id
        }

    def by_entry(self) -> dict[str, dict[str, Any]]:
        """The same for each config entry, over all of its envs."""
        found: dict[str, list[int]] = {name: [] for name in self._envs.entry_names}
        for slot, name in enumerate(self._envs.names(np.arange(len(self._envs)))):
            found[name].append(slot)
        return {name: self._summed(slots) for name, slots in found.items()}

    def _summed(self, slots: list[int]) -> dict[str, Any]:
        episodes, total_return, total_length = self._sums[slots].sum(axis=0).tolist()
        found = {
            "requests": int((self._requests.numbers(slots) - self._requests_before[slots]).sum()),
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
        """Start the sums over episodes anew."""
        for sums in (
            self._sums,
            self._last,
            *(v.count for v in self._verdicts.values()),
            *(v.true for v in self._verdicts.values()),
        ):
            sums[:] = 0
        self._requests_before[:] = self._requests.numbers()
