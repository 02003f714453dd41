"""`Metrics`: the numbers of a running group, as one flat dict.

Rule: it reads tables and changes none of them, so any thread may call it, during any other call.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rlightning_aio._core.group.state.request_states import State
from rlightning_aio._core.group.state.samples import percentiles
from rlightning_aio._core.hosts.base import Executing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.tables import Tables

__all__ = ["Metrics"]

_PREFIX: Final = "envs/"


class Metrics:
    """See the module.

    Args:
        tables: of the group.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables

    def read(
        self, now_ns: int, call_seconds: tuple[float, float], *, by_entry: bool
    ) -> dict[str, float]:
        """Return what `EnvGroup.metrics` documents.

        Args:
            now_ns: on the monotonic clock.
            call_seconds: from `CallTime.so_far`.
            by_entry: add the numbers of each entry.
        """
        reading = _Reading(self._tables, now_ns)
        names = self._tables.envs.names.entry_names
        numbers = reading.of(np.arange(len(names)))
        sizes = reading.window.batch_sizes()
        if len(sizes):
            numbers["batch_size"] = float(sizes.mean())
        numbers["seconds_waiting_for_envs"], numbers["seconds_in_trainer"] = call_seconds
        if self._tables.shares_thread and len(lags := reading.window.lags()):
            numbers["loop_lag_seconds_p99"] = percentiles(lags)[1]
            numbers["loop_lag_seconds_max"] = float(lags.max())
        found = {_PREFIX + name: value for name, value in numbers.items()}
        for k, entry in enumerate(names if by_entry else ()):
            own = reading.of(np.array([k]))
            found |= {f"{_PREFIX}{entry}/{name}": value for name, value in own.items()}
        return found


class _Reading:
    """The state of a group at a time, in ns of the monotonic clock."""

    def __init__(self, tables: Tables, now_ns: int) -> None:
        envs, requests = tables.envs, tables.requests
        self._stats = stats = tables.stats
        self.window = stats.window(now_ns)
        self._tables = tables
        self._now_ns = now_ns
        self._entries = envs.names.entries
        self._sums = stats.times_so_far(now_ns)  # Settles them.
        self._is_there = np.array([bool(env_id) for env_id in envs.env_ids], np.bool_)
        state, self._sent_ns = requests.state.copy(), requests.sent_ns.copy()
        self._idle = self._is_there & (state == int(State.IDLE))
        done_ns = self._done_ns()
        self._in_flight = (state == int(State.BUSY)) & (done_ns < self._sent_ns)

    def _done_ns(self) -> NDArray[np.int64]:
        """Return when the result in each row was ready; the trainer may not have looked at it."""
        layout = self._tables.layout
        found = np.zeros(len(self._entries), np.int64)
        for number, slab in enumerate([*layout.slabs]):  # A close lets go of them.
            slots = np.flatnonzero(layout.slab == number)
            rows = layout.row[slots]
            fits = rows < slab.rows
            found[slots[fits]] = slab.done_ns[rows[fits]]
        return found

    def of(self, entries: NDArray[np.intp]) -> dict[str, float]:
        """Return the numbers of some entries together."""
        own = np.isin(self._entries, entries)
        steps, in_envs, queued, uncollected, unanswered = self._sums[entries].sum(axis=0).tolist()
        in_flight = own & self._in_flight
        sent = self._sent_ns[in_flight]
        numbers: dict[str, float] = {
            "steps": int(steps),
            "steps_per_second": self.window.rate(own[self.window.rows.slots]),
            "seconds_in_envs": in_envs,
            "seconds_queued": queued,
            "seconds_waiting_to_be_collected": uncollected,
            "seconds_waiting_for_actions": unanswered,
            "envs": int(np.count_nonzero(own & self._is_there)),
            "idle": int(np.count_nonzero(own & self._idle)),
            "in_flight": int(np.count_nonzero(in_flight)),
            "queued": self._queued(in_flight),
            "oldest_request_seconds": (self._now_ns - int(sent.min())) / 1e9 if len(sent) else 0.0,
        }
        numbers["uncollected"] = numbers["envs"] - numbers["idle"] - numbers["in_flight"]
        restarts = [r.restarts for r in self._tables.records if own[r.slots.start]]
        return {
            **numbers,
            **self._step_times(own),
            "restarts": sum(restarts),
            **{f"outcomes_{kind}": n for kind, n in self._stats.episodes.outcomes(entries).items()},
            **self._stats.mean_episode(entries),
        }

    def _queued(self, in_flight: NDArray[np.bool_]) -> int:
        """Return how many requests in flight no env executes yet."""
        queued = 0
        for record in self._tables.records:
            count = int(np.count_nonzero(in_flight[record.slots.start : record.slots.stop]))
            queued += count - min(count, _most_at_once(record))
        return queued

    def _step_times(self, own: NDArray[np.bool_]) -> dict[str, float]:
        """Return how long the newest steps took, and the env whose steps take the longest."""
        rows = self.window.rows
        chosen = own[rows.slots] & (rows.steps > 0)
        if not chosen.any():
            return {}
        slots, seconds = rows.slots[chosen], rows.busy[chosen] / 1e9
        p50, p99 = percentiles(seconds)
        steps = np.bincount(slots, minlength=len(own))
        means = np.bincount(slots, seconds, len(own)) / np.maximum(steps, 1)
        slowest = int(means.argmax())
        return {
            "step_seconds_p50": p50,
            "step_seconds_p99": p99,
            "slowest_env": self._tables.envs.position(slowest),
            "slowest_env_seconds": means.item(slowest),
        }


def _most_at_once(record: HostRecord) -> int:
    """Return how many envs of a host can execute a request at the same time, now."""
    if record.is_starting or record.is_down or isinstance(record.host, Executing):
        return 0
    if record.membership is not None:
        return len(record.slots)
    if record.awaits_several or record.host.needs_loop:
        return record.config.max_concurrency or len(record.slots)
    return 1
