"""`Stats`: throughput, batch sizes, latencies and episodes of a group.

Rule: the hot path only appends arrays that it already has; figures are computed from them on
request, and sums from many at once.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.state.episode_counts import EpisodeCounts
from rlightning_aio._core.group.state.samples import EnvTimes, Sample, Window, rows_of
from rlightning_aio.protocol.slab import IS_RESET

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.outcomes import OutcomeKind

__all__ = ["Stats"]

_WINDOW_SAMPLES: Final = 1024
_MOST_ROWS: Final = 1 << 12
"""The number of results that are summed at once: their columns still fit into a core's cache."""
_LEAST_ROWS: Final = 16
"""For how many results each sample counts: to sum them one by one would take longer than a step."""


class Stats:
    """A window over returned results, and sums over all of them.

    The hot path keeps samples, and sums many of them at once. Any thread may ask for figures.

    Attributes:
        num_batches: the number of returned batches.
        episodes: sums over ended episodes; `settle` first.
    """

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        self._times = EnvTimes(envs, requests)
        self.episodes = EpisodeCounts(envs)
        self._samples: deque[Sample] = deque(maxlen=_WINDOW_SAMPLES)
        self.num_batches = 0
        # Of the trainer, as an entry's former members have rows in the sums, too.
        self._requests_before = np.zeros(len(envs) + len(envs.names.entry_names), np.int64)
        # What is not in the sums yet, and for how many results more there is room.
        self._kept: deque[Sample] = deque()
        self._room = _MOST_ROWS
        # Episodes end in any of that.
        self._keeps_ends = False
        # A signal handler may ask for figures while they are summed.
        self._lock = threading.RLock()

    def move_to_entry(self, slot: int) -> None:
        """Move the sums of `slot` to its entry's former members, before another one takes it."""
        with self._lock:
            self.settle()
            self.episodes.move_to_entry(slot)
            self._times.forget(slot)
        former = self.episodes.former(self._envs.names.entries.item(slot))
        number = self._requests.numbering.number(slot)
        self._requests_before[former] += self._requests_before[slot] - number
        self._requests_before[slot] = number

    def account(
        self,
        parts: Sequence[ResultColumns],
        *,
        synchronous: bool,
        since: float = 0.0,
        needed: int = 0,
    ) -> None:
        """Record results that are about to be returned; for `since` and `needed` see `Sample`."""
        now = time.monotonic_ns()
        sent_ns = self._requests.sent_ns
        self.num_batches += 1
        for part in parts:
            slots, shape = part.slots, part.reward.shape
            has_sub_envs = len(shape) > (2 if part.agents else 1)
            resets = episodes = None
            if part.episode_return is not None and part.episode_length is not None:
                flags = part.flags.copy()  # A user may write to them.
                resets = flags[:, IS_RESET] if flags.ndim == 2 else part.is_reset.copy()
                if (
                    part.info_marks is not None
                    or part.out_of_band
                    or flags.ndim > 2
                    or part.restarted is not None
                ):
                    with self._lock:
                        if self._keeps_ends:  # They are older.
                            self.settle()
                        self.episodes.add_reported(part, part.episode_return, part.episode_length)
                else:
                    episodes = flags, part.episode_return, part.episode_length
            sample = Sample(
                self.num_batches,
                now,
                slots,
                sent_ns[slots],
                part.times,
                shape[-1] if has_sub_envs else 1,
                resets,
                synchronous,
                int(since * 1e9),
                needed,
                episodes,
            )
            self._samples.append(sample)
            self._kept.append(sample)
            if episodes:
                self._keeps_ends = True
            self._room -= max(len(slots), _LEAST_ROWS)
            if self._room <= 0:
                self.settle()

    def settle(self) -> None:
        """Add what is kept to the sums."""
        with self._lock:
            self._room, self._keeps_ends = _MOST_ROWS, False
            kept: list[Sample] = []
            while self._kept:  # The trainer may append meanwhile.
                kept.append(self._kept.popleft())
            if kept:
                self._times.add(kept)
            with_ends = [sample for sample in kept if sample.episodes]
            if with_ends:
                slots = np.concatenate([sample.slots for sample in with_ends])
                columns = zip(*[sample.episodes for sample in with_ends], strict=True)
                self.episodes.add(slots, *map(np.concatenate, columns))
                for sample in with_ends:  # The window keeps them.
                    sample.episodes = None

    def note_failures(self, slots: NDArray[np.intp], kind: OutcomeKind) -> None:
        """Count steps and resets of `slots` that end without a result; other requests don't."""
        slots = slots[~self._requests.numbering.awaits_value(slots)]
        with self._lock:
            self.episodes.note_failures(slots, kind)

    def note_cancelled(self, slots: NDArray[np.intp]) -> None:
        """Count episodes of `slots` that their caller has ended; no result of them counts."""
        with self._lock:
            self.episodes.note_failures(slots, "cancelled")

    def times_so_far(self, now_ns: int) -> NDArray[np.float64]:
        """Return where the time of the envs has gone; see `EnvTimes.so_far`."""
        # Read first: a request that ends meanwhile is in the sums, and its env was taken from then.
        until = self._times.waiting_until(now_ns)
        with self._lock:
            self.settle()
            return self._times.so_far(until)

    def mean_episode(self, entries: NDArray[np.intp]) -> dict[str, float]:
        """Return the mean return and length of ended episodes of some entries, if there are any."""
        slots: list[int] = np.flatnonzero(np.isin(self._envs.names.entries, entries)).tolist()
        found = self.episodes.summed([*slots, *map(self.episodes.former, entries.tolist())])
        if not found["episodes"]:
            return {}
        return {f"episode_{what}_mean": found[f"mean_{what}"] for what in ("return", "length")}

    def window(self, now_ns: int) -> Window:
        """The newest results; any thread may ask for them."""
        return Window(list(self._samples), now_ns)

    def summary(self, now_ns: int) -> dict[str, Any]:
        """The figures that `EnvGroup.get_stats` documents, over the window."""
        window = self.window(now_ns)
        sizes = window.batch_sizes()
        if not len(sizes):
            return {"steps_per_second": 0.0, "entries": {}, "batch_size": {}, "latency_us": {}}
        rows, synchronous = window.rows, window.synchronous()
        entries = self._envs.names.entries[rows.slots]
        rates: dict[str, dict[str, float]] = {}
        for entry, name in enumerate(self._envs.names.entry_names):
            own = entries == entry
            if (own & window.kept).any():
                kinds = {"sync": own & synchronous, "async": own & ~synchronous}
                rates[name] = {kind: window.rate(chosen) for kind, chosen in kinds.items()}
        return {
            "steps_per_second": window.rate(window.kept),
            "entries": rates,
            "batch_size": {
                "mean": float(sizes.mean()),
                "min": int(sizes.min()),
                "max": int(sizes.max()),
            },
            "latency_us": {
                kind: {"p50": p50, "p99": p99} for kind, (p50, p99) in window.latencies().items()
            },
        }

    def executed(
        self, since_ns: int
    ) -> tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64]]:
        """Return when envs executed what they began after `since_ns`, at most a window of it.

        Slots, beginnings and ends (ns of the monotonic clock), in the order of the results.
        """
        rows = rows_of([sample for sample in self._samples if sample.at_ns >= since_ns])
        begun = rows.done - rows.busy
        later = begun >= since_ns
        return rows.slots[later], begun[later], rows.done[later]

    def by_env(self) -> dict[str, dict[str, Any]]:
        """The figures of each env that `EnvGroup.get_env_stats` documents."""
        self.settle()
        return {
            env_id: self._summed([slot]) for slot, env_id in enumerate(self._envs.env_ids) if env_id
        }

    def by_entry(self) -> dict[str, dict[str, Any]]:
        """The figures of each config entry, over all of its envs and former members."""
        self.settle()
        names = self._envs.names
        found: dict[str, dict[str, Any]] = {}
        for entry, name in enumerate(names.entry_names):
            slots: list[int] = np.flatnonzero(names.entries == entry).tolist()
            found[name] = self._summed([*slots, self.episodes.former(entry)])
        return found

    def _summed(self, slots: list[int]) -> dict[str, Any]:
        present = [slot for slot in slots if slot < len(self._envs)]
        numbers = self._requests.numbering.numbers(present)
        requests = int(numbers.sum() - self._requests_before[slots].sum())
        return {"requests": requests, **self.episodes.summed(slots)}

    def reset_envs(self) -> None:
        """Set the sums over episodes and requests to zero."""
        with self._lock:
            self.settle()
            self.episodes.reset()
        self._requests_before[:] = 0
        self._requests_before[: len(self._envs)] = self._requests.numbering.numbers()
