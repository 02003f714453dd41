"""`Stats`: throughput, batch sizes, latencies and episodes of a group.

Rule: the hot path only appends arrays that it already has to a window; figures are computed from
them on request.
"""

from __future__ import annotations

import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast, get_args

import numpy as np

from rlightning_aio._core.group.state.samples import LEAST_ROWS, EnvTimes, Sample, Window, rows_of
from rlightning_aio.outcomes import Outcome, OutcomeKind
from rlightning_aio.protocol.slab import IS_RESET, TERMINATED, TRUNCATED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["Stats"]

_WINDOW_SAMPLES: Final = 1024
_VERDICTS: Final = ("success", "fail")
"""Keys of booleans in the info that ends an episode: the env's verdicts on it."""
_HOLDERS: Final = (*_VERDICTS, "final_info")
"""Keys of infos that may have them."""


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


OUTCOMES: Final[tuple[OutcomeKind, ...]] = get_args(OutcomeKind)
_CODE_OF: Final = {kind: code for code, kind in enumerate(OUTCOMES)}


class Stats:
    """A window over returned results, and sums over ended episodes.

    Attributes:
        num_batches: the number of returned batches.
        times: where the time of the envs has gone.
    """

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        self.times = EnvTimes(envs, requests)
        self._samples: deque[Sample] = deque(maxlen=_WINDOW_SAMPLES)
        self.num_batches = 0
        # Sums have one more row per config entry, for former members whose slots were taken by
        # others. Columns: number of episodes, sum of their returns, sum of their lengths.
        size = len(envs) + len(envs.names.entry_names)
        self._sums = np.zeros((size, 3))
        # Return and length of the last episode.
        self._last = np.zeros((len(envs), 2))
        self._requests_before = np.zeros(size, np.int64)
        self._verdicts = {name: _Verdicts.of(size) for name in _VERDICTS}
        # By entry and kind.
        self._outcomes = np.zeros((len(envs.names.entry_names), len(OUTCOMES)), np.int64)

    def move_to_entry(self, slot: int) -> None:
        """Move the sums of `slot` to its entry's former members, before another one takes it."""
        former = self._former(self._envs.names.entries.item(slot))
        for sums in self._all_sums():
            sums[former] += sums[slot]
            sums[slot] = 0
        self._last[slot] = 0
        self.times.forget(slot)
        number = self._requests.numbering.number(slot)
        self._requests_before[former] += self._requests_before[slot] - number
        self._requests_before[slot] = number

    def _former(self, entry: int) -> int:
        """The row of an entry's former members in the sums."""
        return len(self._envs) + entry

    def _all_sums(self) -> list[NDArray[Any]]:
        verdicts = self._verdicts.values()
        return [self._sums, *(v.count for v in verdicts), *(v.true for v in verdicts)]

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
        sent_ns, times = self._requests.sent_ns, self.times
        self.num_batches += 1
        for part in parts:
            slots, shape = part.slots, part.reward.shape
            has_sub_envs = len(shape) > (2 if part.agents else 1)
            resets = None
            if part.episode_return is not None:  # Flags are set.
                resets = part.flags[:, IS_RESET] if part.flags.ndim == 2 else part.is_reset
                resets = resets.copy()
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
            )
            self._samples.append(sample)
            times.kept.append(sample)
            times.room -= max(len(slots), LEAST_ROWS)
            if times.room <= 0:
                times.sum_up()
            if part.episode_return is not None and part.episode_length is not None:
                self._note_episodes(part, part.episode_return, part.episode_length)

    def _note_episodes(
        self, part: ResultColumns, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        terminated = part.flags[..., TERMINATED]
        ended = terminated | part.flags[..., TRUNCATED]
        if part.restarted is None and not np.count_nonzero(ended):
            return  # As in most steps.
        ended &= lengths > 0
        if part.restarted is not None:
            ended[part.restarted] = False
        rows: NDArray[np.intp] = ended.nonzero()[0]
        slots = part.slots[rows]
        # The outcomes that `BatchedData.outcome` has; the first two are terminated, truncated.
        if part.info_marks is not None or part.out_of_band or part.agents:
            where, codes = self._as_reported(part, ended, 1 - terminated)
        else:
            where, codes = slots, 1 - terminated[ended]
        np.add.at(self._outcomes, (self._envs.names.entries[where], codes), 1)
        if not len(rows):
            return
        sums = np.empty((len(rows), 3))
        sums[:, 0], sums[:, 1], sums[:, 2] = 1, returns[ended], lengths[ended]
        with np.errstate(over="ignore", invalid="ignore"):  # The means show them.
            # A result with sub-environments or agents may end several: its slot repeats.
            np.add.at(self._sums, slots, sums)
        self._last[slots] = sums[:, 1:]
        if part.info_marks is not None or part.out_of_band:
            for row in dict.fromkeys(rows.tolist()):
                if part.may_hold(row, _HOLDERS):
                    slot = part.slots.item(row)
                    with suppress(Exception):  # The info may be malformed; its reader gets it.
                        self._note_verdicts(slot, part.reported_info_of(row), ended[row])

    def _as_reported(
        self, part: ResultColumns, over: NDArray[np.bool_], codes: NDArray[np.int64]
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the slots whose episodes are over, of unusual results, and their outcomes.

        Args:
            part: of results that have agents, infos, or were marked as restarted.
            over: as the flags say.
            codes: of outcomes, likewise.
        """
        if part.agents:  # An episode has ended with that of its last agent.
            over = np.logical_or.reduce(over, 1) & part.has_ended
            codes = np.maximum.reduce(codes, 1)
        if part.restarted is not None:
            over = over.copy()
            over[part.restarted] = True
        rows: list[int] = over.nonzero()[0].tolist()
        for row in dict.fromkeys(rows):
            if part.may_hold(row, ("outcome",)):
                with suppress(Exception):  # The info may be malformed; its reader gets it.
                    reported: Any = part.reported_info_of(row).get("outcome")
                    if isinstance(reported, Outcome):
                        codes[row] = _CODE_OF[reported.kind]
        return part.slots[over.nonzero()[0]], codes[over]

    def note_failures(self, slots: NDArray[np.intp], kind: OutcomeKind) -> None:
        """Count steps and resets of `slots` that end without a result; other requests don't."""
        slots = slots[~self._requests.numbering.awaits_value(slots)]
        entries = self._envs.names.entries[slots]
        self._outcomes[:, _CODE_OF[kind]] += np.bincount(entries, minlength=len(self._outcomes))

    def outcomes(self, entries: NDArray[np.intp]) -> dict[str, int]:
        """Return how often episodes of some entries came to an end of each kind."""
        return dict(zip(OUTCOMES, self._outcomes[entries].sum(axis=0).tolist(), strict=True))

    def mean_episode(self, entries: NDArray[np.intp]) -> dict[str, float]:
        """Return the mean return and length of ended episodes of some entries, if there are any."""
        slots: list[int] = np.flatnonzero(np.isin(self._envs.names.entries, entries)).tolist()
        found = self._summed([*slots, *map(self._former, entries.tolist())])
        if not found["episodes"]:
            return {}
        return {f"episode_{what}_mean": found[f"mean_{what}"] for what in ("return", "length")}

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
