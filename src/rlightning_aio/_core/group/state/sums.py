"""`Sums`: the numbers of a group, as sums over the results of each env.

Rule: the hot path only keeps arrays that it already has; many results are added up at once, when
somebody asks or enough were kept. There are no other statistics.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, get_args

import numpy as np

from rlightning_aio._core.group.state.request_states import State
from rlightning_aio.outcomes import Outcome, OutcomeKind
from rlightning_aio.protocol.slab import IS_RESET, TERMINATED, TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.outcomes import Loss

_MOST_ROWS: Final = 1 << 12
"""The number of results that are added at once: their columns still fit into a core's cache."""
_LEAST_ROWS: Final = 16
"""For how many results each batch counts: to add them one by one would take longer than a step."""
_OUTCOMES: Final[tuple[OutcomeKind, ...]] = get_args(OutcomeKind)
_CODE_OF: Final = {kind: code for code, kind in enumerate(_OUTCOMES)}
_NAMES: Final = (
    *("steps", "results", "episodes", "episode_returns", "episode_lengths"),
    *(f"outcomes_{kind}" for kind in _OUTCOMES),
    *("seconds_in_envs", "seconds_queued", "seconds_uncollected", "seconds_idle"),
)
_STEPS, _RESULTS, _EPISODES, _RETURNS, _LENGTHS, _FIRST_OUTCOME = range(6)
_IN_ENVS, _QUEUED, _UNCOLLECTED, _IDLE = range(len(_NAMES) - 4, len(_NAMES))


class Sums:
    """See the module.

    Args:
        envs, requests, records: of the group.

    Attributes:
        num_batches: the number of returned batches.
        of_attempts: the numbers of `play` by their whole names, if it was used.
        ended_ns: when the group was closed, on the monotonic clock; None before.
    """

    def __init__(self, envs: EnvTable, requests: Requests, records: Sequence[HostRecord]) -> None:
        self._envs, self._requests, self._records = envs, requests, records
        self.num_batches = 0
        self.of_attempts: dict[str, float] = {}
        self.ended_ns: int | None = None
        # A row for each of `_NAMES`, with seconds in ns; a column for each slot.
        self._sums = np.zeros((len(_NAMES), len(envs)))
        # When each slot's last result was returned; 0 before the first one.
        self._taken_ns = np.zeros(len(envs), np.int64)
        self._began_ns = 0
        # What is not in the sums yet, and for how many results more there is room: slots, times,
        # times of sending, time of the return, and sub-environments of results; and slots, flags,
        # returns and lengths of those in which episodes may end.
        self._kept: list[tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.int64], int, int]]
        self._ends: list[tuple[NDArray[Any], NDArray[np.bool_], NDArray[Any], NDArray[Any]]]
        self._kept, self._ends, self._room = [], [], _MOST_ROWS
        # By host and number of its replacements, as its worker's accounts end with it.
        self._computing_ns: dict[tuple[int, int], int] = {}

    # -- what comes in ----------------------------------------------------------------

    def add(self, parts: Sequence[ResultColumns]) -> None:
        """Record results that are about to be returned."""
        now = time.monotonic_ns()
        sent_ns = self._requests.sent_ns
        self.num_batches += 1
        for part in parts:
            slots, shape = part.slots, part.reward.shape
            width = shape[-1] if len(shape) > (2 if part.agents else 1) else 1
            self._kept.append((slots, part.times, sent_ns[slots], now, width))
            if part.episode_return is not None and part.episode_length is not None:
                if (
                    part.info_marks is not None
                    or part.out_of_band
                    or part.flags.ndim > 2
                    or part.restarted is not None
                ):
                    self._add_reported(part, part.episode_return, part.episode_length)
                else:  # A user may write to the flags.
                    end = slots, part.flags.copy(), part.episode_return, part.episode_length
                    self._ends.append(end)
            self._room -= max(len(slots), _LEAST_ROWS)
            if self._room <= 0:
                self._settle()

    def note_failures(self, slots: NDArray[np.intp], kind: OutcomeKind) -> NDArray[np.intp]:
        """Count steps and resets that end without a result, of all requests of `slots`.

        Returns the slots of those.
        """
        own = slots[~self._requests.numbering.awaits_value(slots)]
        self._sums[_FIRST_OUTCOME + _CODE_OF[kind]] += self._counted(own)
        return own

    def note_loss(self, slot: int, why: Loss) -> None:
        """Count the lost episodes of an env, which no error has told of."""
        code = _CODE_OF[why.outcome(self._envs.env_ids[slot]).kind]
        self._sums[_FIRST_OUTCOME + code, slot] += self._envs.num_sub_envs[slot]

    def _settle(self) -> None:
        """Add what is kept to the sums."""
        # First, as a signal handler may ask meanwhile.
        kept, self._kept, ends, self._ends = self._kept, [], self._ends, []
        self._room = _MOST_ROWS
        if kept:
            self._add_times(*zip(*kept, strict=True))
        if ends:
            slots, flags, returns, lengths = map(np.concatenate, zip(*ends, strict=True))
            over, codes = _ended(flags, lengths)
            self._add_outcomes(slots[over], codes[over])
            self._add_episodes(slots, over, returns, lengths)
            self._sums[_STEPS] -= self._counted(slots[flags[:, IS_RESET]])

    def _add_times(
        self, slots: Any, times: Any, sent: Any, taken: Sequence[int], widths: Sequence[int]
    ) -> None:
        """Add columns of `_kept`."""
        lengths = [*map(len, slots)]
        own, ready, asked = np.concatenate(slots), np.concatenate(times), np.concatenate(sent)
        returned, (done, busy) = np.repeat(taken, lengths), ready.T
        if not self._began_ns and len(asked):
            self._began_ns = int(asked.min())
        # A slot's times without a request are those at which it was sent one, without the first,
        # minus those at which its results were returned, without the last.
        before = self._taken_ns.copy()
        first = np.flatnonzero(before[own] == 0)[::-1]
        before[own[first]] = asked[first]
        self._taken_ns[own] = returned
        self._sums[_IDLE] += self._taken_ns - before
        self._sums[_RESULTS] += (counted := self._counted(own))
        if {*widths} != {1}:
            counted = self._counted(own, np.repeat(widths, lengths))
        self._sums[_STEPS] += counted
        columns = {
            _IN_ENVS: busy,
            _QUEUED: np.maximum(done - busy - asked, 0),
            _UNCOLLECTED: returned - done,
            _IDLE: asked - returned,
        }
        for k, column in columns.items():
            self._sums[k] += self._counted(own, column)

    def _counted(self, slots: NDArray[np.intp], weights: Any = None) -> NDArray[Any]:
        """Return how often each slot is among `slots`, which may repeat, or the sum of weights."""
        return np.bincount(slots, weights, len(self._taken_ns))

    def _add_outcomes(self, slots: NDArray[np.intp], codes: NDArray[np.int64]) -> None:
        for code in set(codes.tolist()):
            self._sums[_FIRST_OUTCOME + code] += self._counted(slots[codes == code])

    def _add_episodes(
        self,
        slots: NDArray[np.intp],
        over: NDArray[np.bool_],
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
    ) -> None:
        """Add the episodes that are `over`, of the same shape as returns and lengths."""
        own = slots[over.nonzero()[0]]
        self._sums[_EPISODES] += self._counted(own)
        self._sums[_LENGTHS] += self._counted(own, lengths[over])
        with np.errstate(over="ignore", invalid="ignore"):  # The sums show them.
            self._sums[_RETURNS] += self._counted(own, returns[over])

    def _add_reported(
        self, part: ResultColumns, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        """Add the ends of episodes in any results, with the outcomes that `BatchedData` has."""
        resets = part.is_reset.reshape(len(part), -1).sum(axis=1)
        self._sums[_STEPS] -= self._counted(part.slots, resets)
        over, codes = _ended(part.flags, lengths)
        if part.restarted is not None:  # `note_loss` counts them.
            over[part.restarted] = False
        if not np.count_nonzero(over):
            return
        self._add_episodes(part.slots, over, returns, lengths)
        if part.agents:  # An episode has ended with that of its last agent.
            over = np.logical_or.reduce(over, 1) & part.has_ended
            codes = np.maximum.reduce(codes, 1)
        for row in dict.fromkeys(over.nonzero()[0].tolist()):
            if part.may_hold(row, ("outcome",)):
                with suppress(Exception):  # The info may be malformed; its reader gets it.
                    reported: Any = part.reported_info_of(row).get("outcome")
                    if isinstance(reported, Outcome):
                        codes[row] = _CODE_OF[reported.kind]
        self._add_outcomes(part.slots[over.nonzero()[0]], codes[over])

    # -- what is asked ----------------------------------------------------------------

    def metrics(self, *, by_entry: bool) -> dict[str, float]:
        """Return what `EnvGroup.metrics` documents."""
        entries, names = self._envs.names.entries, self._envs.names.entry_names
        found = self._numbers("envs/", np.arange(len(entries)))
        for k, name in enumerate(names if by_entry else ()):
            found |= self._numbers(f"envs/{name}/", np.flatnonzero(entries == k))
        return found | self.of_attempts

    def _numbers(self, prefix: str, slots: NDArray[np.intp]) -> dict[str, float]:
        return {prefix + name: value for name, value in self.of(slots).items()}

    def of(self, slots: NDArray[np.intp]) -> dict[str, float]:
        """Return the sums of some envs together, of their workers, and what they do now."""
        found = self.added(slots)
        states = self._requests.state[slots]
        idle, busy = (int(np.count_nonzero(states == int(s))) for s in (State.IDLE, State.BUSY))
        found |= {"envs": len(slots), "idle": idle, "busy": busy}
        found["uncollected"] = len(slots) - idle - busy
        chosen = set(slots.tolist())
        records = [record for record in self._records if record.slots.start in chosen]
        found["restarts"] = sum(record.restarts for record in records)
        found["recycled"] = sum(record.recycled for record in records)
        found["recycle_waits"] = sum(record.waits for record in records)
        found["largest_resident_mb"] = max((_memory_of(record) for record in records), default=0.0)
        computing = self._computing_of(records)
        return found if computing is None else {**found, "seconds_computing": computing}

    def added(self, slots: NDArray[np.intp]) -> dict[str, float]:
        """Return the sums of some envs together."""
        self._settle()
        with np.errstate(over="ignore", invalid="ignore"):
            sums = self._sums[:, slots].sum(axis=1)
        now, taken = self.ended_ns or time.monotonic_ns(), self._taken_ns[slots]
        is_idle = self._requests.state[slots] == int(State.IDLE)
        until = np.where(is_idle, now, self._requests.sent_ns[slots])
        sums[_IDLE] += np.where(taken > 0, np.maximum(until - taken, 0), 0).sum()
        sums[_IN_ENVS:] /= 1e9
        return {
            name: value if k == _RETURNS or k >= _IN_ENVS else int(value)
            for k, (name, value) in enumerate(zip(_NAMES, sums.tolist(), strict=True))
        }

    def _computing_of(self, records: Sequence[HostRecord]) -> float | None:
        """Return the processor seconds of workers; None if none of them is known.

        A replaced worker counts as it was when it was last asked for.
        """
        for record in records:
            key, now = (record.host.host_id, record.launches), record.host.processor_ns()
            if now is not None:  # Of living threads: one may have ended.
                self._computing_ns[key] = max(now, self._computing_ns.get(key, 0))
        hosts = {record.host.host_id for record in records}
        known = [ns for (host_id, _), ns in self._computing_ns.items() if host_id in hosts]
        return sum(known) / 1e9 if known else None

    def by_env(self) -> dict[str, dict[str, Any]]:
        """Return what `EnvGroup.get_env_stats` documents."""
        found: dict[str, dict[str, Any]] = {}
        for slot, env_id in enumerate(self._envs.env_ids):
            own: dict[str, Any] = self.added(np.array([slot]))
            episodes = own["episodes"]
            for what in ("return", "length"):
                own[f"mean_{what}"] = own[f"episode_{what}s"] / episodes if episodes else None
            found[env_id] = own
        return found

    def summary(self) -> dict[str, Any]:
        """Return what `EnvGroup.get_stats` documents."""
        entries, names = self._envs.names.entries, self._envs.names.entry_names
        found = self.added(np.arange(len(entries)))
        last_ns = int(self._taken_ns.max(initial=0))
        seconds = max((last_ns - self._began_ns) / 1e9, 1e-9)
        results, steps = found["results"], self._sums[_STEPS]
        kinds = {"step": "in_envs", "wait": "queued", "transfer": "uncollected"}
        return {
            "steps_per_second": found["steps"] / seconds,
            "entries": {
                name: float(steps[entries == k].sum()) / seconds for k, name in enumerate(names)
            },
            "batch_size": results / self.num_batches if self.num_batches else 0.0,
            "latency_us": {
                kind: 1e6 * found[f"seconds_{name}"] / max(results, 1)
                for kind, name in kinds.items()
            },
        }


def _memory_of(record: HostRecord) -> float:
    """Return the most resident memory that a worker is known to have had, in MB."""
    record.resident_mb = max(record.resident_mb, record.host.resident_mb())
    return record.resident_mb


def _ended(
    flags: NDArray[np.bool_], lengths: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which episodes have ended by their flags, and codes of their outcomes."""
    terminated = flags[..., TERMINATED]
    ended = (terminated | flags[..., TRUNCATED]) & (lengths > 0)
    return ended, 1 - terminated  # The first two outcomes are terminated, truncated.
