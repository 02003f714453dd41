"""`Sample`: the results of one returned batch, as the hot path keeps them; and their figures.

`rows_of` puts samples together, `Window` computes the figures of the newest ones, and `EnvTimes`
adds up all of them: where the time of the envs has gone.
Rule: the hot path only appends. Whatever is computed is computed from many samples at once.
"""

from __future__ import annotations

import math
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from rlightning_aio._core.group.state.request_states import State

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.requests import Requests

__all__ = ["EnvTimes", "Rows", "Sample", "Window", "percentiles", "rows_of"]

WINDOW_SECONDS: Final = 10.0


class Sample(msgspec.Struct):
    """The results with one layout of a returned batch. Times in ns of the monotonic clock.

    Attributes:
        batch: number of the batch.
        num_envs: sub-environments per result.
        resets: mask of the sub-environments that were reset; None if none was.
        since_ns: when the call began that has returned the batch.
        needed: the number of results of the whole batch that it waited for; 0 if others may have
            been waited for, too.
        episodes: flags, returns and lengths of ordinary results; None if no episode ends in any.
    """

    batch: int
    at_ns: int
    slots: NDArray[np.intp]
    sent_ns: NDArray[np.int64]
    times: NDArray[np.int64]
    num_envs: int
    resets: NDArray[np.bool_] | None
    synchronous: bool
    since_ns: int
    needed: int
    episodes: tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.int64]] | None = None


# Getters, so that no loop of Python's puts samples together.
_SLOTS, _TIMES, _RESETS, _NUM_ENVS, _SENT, _AT = map(
    attrgetter, ("slots", "times", "resets", "num_envs", "sent_ns", "at_ns")
)


class Rows(NamedTuple):
    """Results as columns. `steps` is the number of env steps in each, other columns are in ns."""

    slots: NDArray[np.intp]
    sent: NDArray[np.int64]
    done: NDArray[np.int64]
    busy: NDArray[np.int64]
    taken: NDArray[np.int64]
    steps: NDArray[np.int64]


def rows_of(samples: Sequence[Sample]) -> Rows:
    """The results of samples, in their order."""
    if not samples:
        nothing = np.zeros(0, np.int64)
        return Rows(np.zeros(0, np.intp), *[nothing] * 5)
    slots, times, resets = ([*map(of, samples)] for of in (_SLOTS, _TIMES, _RESETS))
    lengths = np.array([*map(len, slots)])
    steps = np.array([*map(_NUM_ENVS, samples)]).repeat(lengths)
    if found := [one for one in resets if one is not None]:
        has_resets = np.array([one is not None for one in resets]).repeat(lengths)
        steps[has_resets] -= np.concatenate([*map(_by_env, found)])
    together = np.concatenate(times)
    return Rows(
        slots=np.concatenate(slots),
        sent=np.concatenate([*map(_SENT, samples)]),
        done=together[:, 0],
        busy=together[:, 1],
        taken=np.array([*map(_AT, samples)]).repeat(lengths),
        steps=steps,
    )


def _by_env(resets: NDArray[np.bool_]) -> NDArray[Any]:
    """The number of resets of each env."""
    return resets if resets.ndim == 1 else resets.reshape(len(resets), -1).sum(axis=1)


class Window:
    """The figures of the newest results. Percentiles are pairs, the median and the 99th.

    Args:
        samples: the newest ones.
        now_ns: a rate is that until now, so it sinks while nothing is returned.

    Attributes:
        rows: the results.
        kept: which of them count in a rate: not those of the first batch, which opens the window.
    """

    def __init__(self, samples: Sequence[Sample], now_ns: int) -> None:
        since = samples[-1].at_ns - int(WINDOW_SECONDS * 1e9) if samples else 0
        self._samples = samples = [sample for sample in samples if sample.at_ns >= since]
        self.rows = rows_of(samples)
        # Of each batch, the first sample (there is one for each layout) and the first row.
        self._firsts: list[Sample] = []
        begins: list[int] = []
        row = 0
        for sample in samples:
            if not begins or sample.batch != self._firsts[-1].batch:
                self._firsts.append(sample)
                begins.append(row)
            row += len(sample.slots)
        self._begins = np.array(begins, np.intp)
        self.kept = np.arange(row) >= (begins[1] if len(begins) > 1 else row)
        self._seconds = max(now_ns - samples[0].at_ns, 1) / 1e9 if samples else 1.0

    def rate(self, chosen: NDArray[np.bool_]) -> float:
        """Env steps per second, of the results that are `chosen`."""
        return int(self.rows.steps[chosen & self.kept].sum()) / self._seconds

    def batch_sizes(self) -> NDArray[np.int64]:
        """The number of results in each batch."""
        return np.diff(self._begins, append=len(self.kept))

    def synchronous(self) -> NDArray[np.bool_]:
        """``[n]``, whether each result was returned by the call that had asked for it."""
        lengths = [len(sample.slots) for sample in self._samples]
        return np.repeat(np.array([s.synchronous for s in self._samples], np.bool_), lengths)

    def latencies(self) -> dict[str, tuple[float, float]]:
        """Percentiles of the times of steps in µs, by kind; empty before the first step."""
        rows = self.rows
        stepped = rows.steps > 0
        if not stepped.any():
            return {}
        kinds = {
            "step": rows.busy,
            "wait": rows.done - rows.busy - rows.sent,
            "transfer": rows.taken - rows.done,
        }
        return {kind: percentiles(values[stepped] / 1e3) for kind, values in kinds.items()}

    def lags(self) -> NDArray[np.float64]:
        """Return how late calls returned that had to wait, in seconds.

        A call is due when the last result that it needs is ready, which its env has noted. So
        nothing is measured for this: the envs' clocks are the probes.
        """
        if not self._firsts:
            return np.zeros(0)
        done, begins, sizes = self.rows.done, self._begins, self.batch_sizes()
        due = np.maximum.reduceat(done, begins)
        needed = np.array([first.needed for first in self._firsts])
        for k in np.flatnonzero((needed > 0) & (needed < sizes)).tolist():
            own = done[begins[k] : begins[k] + sizes[k]]
            due[k] = np.partition(own, needed[k] - 1)[needed[k] - 1]
        since = np.array([first.since_ns for first in self._firsts])
        waited = (needed > 0) & (due > since)
        return (self.rows.taken[begins] - due)[waited] / 1e9


class EnvTimes:
    """Where the time of envs has gone: sums by config entry.

    From one result to the next, an env waits for an action; then its request waits until the env
    begins, the env executes it, and its result waits to be collected.
    """

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        # Columns as in `so_far`; times in ns.
        self._sums = np.zeros((len(envs.names.entry_names), 5))
        # When each slot's last result was returned; 0 before the first one.
        self._taken_ns = np.zeros(len(envs), np.int64)

    def forget(self, slot: int) -> None:
        """Another env takes `slot`: the time before its first result is nobody's."""
        self._taken_ns[slot] = 0

    def add(self, samples: Sequence[Sample]) -> None:
        """Add the results of samples to the sums."""
        rows = rows_of(samples)
        # The waits of a slot for actions are the times that it was sent requests, without the
        # first one, minus the times that results of it were taken, without the last one.
        before = self._taken_ns.copy()
        first = np.flatnonzero(before[rows.slots] == 0)[::-1]
        before[rows.slots[first]] = rows.sent[first]
        self._taken_ns[rows.slots] = rows.taken
        columns = (
            rows.steps,
            rows.busy,
            np.maximum(rows.done - rows.busy - rows.sent, 0),
            rows.taken - rows.done,
            rows.sent - rows.taken,
        )
        entries, size = self._envs.names.entries, len(self._sums)
        own = entries[rows.slots] if size > 1 else None
        for k, column in enumerate(columns):
            summed = column.sum() if own is None else np.bincount(own, column, size)
            self._sums[:, k] += summed
        self._sums[:, 4] += np.bincount(entries, self._taken_ns - before, size)

    def waiting_until(self, now_ns: int) -> NDArray[np.int64]:
        """Return until when each local env has waited for its next action."""
        local = slice(0, len(self._envs.local_ids))
        idle = self._requests.state[local] == int(State.IDLE)
        return np.where(idle, now_ns, self._requests.sent_ns[local])

    def so_far(self, until: NDArray[np.int64]) -> NDArray[np.float64]:
        """By entry: env steps, and seconds in envs, before envs, until collected, for actions.

        The first three of these are of requests whose results were returned, the last one is until
        now.

        Args:
            until: from `waiting_until`.
        """
        found, taken = self._sums.copy(), self._taken_ns[: len(until)]
        waits = np.where(taken > 0, np.maximum(until - taken, 0), 0)
        found[:, 4] += np.bincount(self._envs.names.entries[: len(until)], waits, len(found))
        found[:, 1:] /= 1e9
        return found


def percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the median and the 99th percentile of at least one value.

    `numpy.percentile` gives the same, but imports a module at its first call. That fails in a
    process that is out of descriptors, which must still be able to collect.
    """
    ranks = np.array([0.5, 0.99]) * (len(values) - 1)
    near = [k for rank in ranks.tolist() for k in (math.floor(rank), math.ceil(rank))]
    p50, p99 = np.interp(ranks, near, np.partition(values, near)[near]).tolist()
    return p50, p99
