"""`EpisodeCounts`: sums over ended episodes by env, and how often each outcome came by entry."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast, get_args

import numpy as np

from rlightning_aio.outcomes import Outcome, OutcomeKind
from rlightning_aio.protocol.slab import TERMINATED, TRUNCATED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio.batch.columns import ResultColumns

__all__ = ["OUTCOMES", "EpisodeCounts"]

_VERDICTS: Final = ("success", "fail")
"""Keys of booleans in the info that ends an episode: the env's verdicts on it."""
_HOLDERS: Final = (*_VERDICTS, "final_info")
"""Keys of infos that may have them."""
OUTCOMES: Final[tuple[OutcomeKind, ...]] = get_args(OutcomeKind)
_CODE_OF: Final = {kind: code for code, kind in enumerate(OUTCOMES)}


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


class EpisodeCounts:
    """See the module. Sums have a row for each slot, then one for each entry's former members."""

    def __init__(self, envs: EnvTable) -> None:
        self._envs = envs
        num_entries = len(envs.names.entry_names)
        size = len(envs) + num_entries
        # Columns: number of episodes, sum of their returns, sum of their lengths.
        self._sums = np.zeros((size, 3))
        # Return and length of the last episode.
        self._last = np.zeros((len(envs), 2))
        self._verdicts = {name: _Verdicts.of(size) for name in _VERDICTS}
        # By entry and kind.
        self._outcomes = np.zeros((num_entries, len(OUTCOMES)), np.int64)

    def add(
        self,
        slots: NDArray[np.intp],
        flags: NDArray[np.bool_],
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
    ) -> None:
        """Count the episodes that end in ordinary results: of one env each, without any info.

        Args:
            slots: of the results, the oldest first.
            flags: ``[n, 4]``, see `protocol.slab`.
            returns: ``[n]``, of the episodes that end.
            lengths: likewise.
        """
        ended, codes = _ended(flags, lengths)
        self._count(slots[ended], codes[ended])
        self._sum(slots, ended, returns, lengths)

    def add_reported(
        self, part: ResultColumns, returns: NDArray[np.float64], lengths: NDArray[np.int64]
    ) -> None:
        """Count the episodes that end in any results; their infos may say more of them."""
        ended, codes = _ended(part.flags, lengths)
        if part.restarted is not None:
            ended[part.restarted] = False
        elif not np.count_nonzero(ended):
            return
        self._count(*self._as_reported(part, ended, codes))
        rows = self._sum(part.slots, ended, returns, lengths)
        for row in dict.fromkeys(rows.tolist()):
            if part.may_hold(row, _HOLDERS):
                slot = part.slots.item(row)
                with suppress(Exception):  # The info may be malformed; its reader gets it.
                    self._note_verdicts(slot, part.reported_info_of(row), ended[row])

    def _count(self, slots: NDArray[np.intp], codes: NDArray[np.int64]) -> None:
        np.add.at(self._outcomes, (self._envs.names.entries[slots], codes), 1)

    def _sum(
        self,
        slots: NDArray[np.intp],
        ended: NDArray[np.bool_],
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
    ) -> NDArray[np.intp]:
        """Add the episodes that have ended to the sums of their slots; return their rows."""
        rows: NDArray[np.intp] = ended.nonzero()[0]
        own = slots[rows]
        sums = np.empty((len(rows), 3))
        sums[:, 0], sums[:, 1], sums[:, 2] = 1, returns[ended], lengths[ended]
        with np.errstate(over="ignore", invalid="ignore"):  # The means show them.
            np.add.at(self._sums, own, sums)  # A slot may repeat.
        self._last[own] = sums[:, 1:]
        return rows

    def _as_reported(
        self, part: ResultColumns, over: NDArray[np.bool_], codes: NDArray[np.int64]
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the slots whose episodes are over, and the outcomes that `BatchedData` has.

        Without those that the caller has ended: `note_failures` has counted them.

        Args:
            part: of any results.
            over: as the flags say.
            codes: of outcomes, likewise.
        """
        if part.agents:  # An episode has ended with that of its last agent.
            over = np.logical_or.reduce(over, 1) & part.has_ended
            codes = np.maximum.reduce(codes, 1)
        if part.restarted is not None:
            over = over.copy()
            over[part.restarted] = True
        for row in dict.fromkeys(over.nonzero()[0].tolist()):
            if part.may_hold(row, ("outcome",)):
                with suppress(Exception):  # The info may be malformed; its reader gets it.
                    reported: Any = part.reported_info_of(row).get("outcome")
                    if isinstance(reported, Outcome):
                        codes[row] = _CODE_OF[reported.kind]
                        is_lost = part.restarted is not None and part.restarted[row]
                        over[row] &= not (is_lost and reported.kind == "cancelled")
        return part.slots[over.nonzero()[0]], codes[over]

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

    def note_failures(self, slots: NDArray[np.intp], kind: OutcomeKind) -> None:
        """Count requests of `slots` that end without a result, and their episodes with them."""
        entries = self._envs.names.entries[slots]
        self._outcomes[:, _CODE_OF[kind]] += np.bincount(entries, minlength=len(self._outcomes))

    # -- figures ----------------------------------------------------------------------

    def former(self, entry: int) -> int:
        """Return the row of an entry's former members in the sums."""
        return len(self._envs) + entry

    def outcomes(self, entries: NDArray[np.intp]) -> dict[str, int]:
        """Return how often episodes of some entries came to an end of each kind."""
        return dict(zip(OUTCOMES, self._outcomes[entries].sum(axis=0).tolist(), strict=True))

    def summed(self, slots: list[int]) -> dict[str, Any]:
        """Return the number, the mean return and length of episodes, and rates of verdicts."""
        with np.errstate(over="ignore", invalid="ignore"):
            episodes, total_return, total_length = self._sums[slots].sum(axis=0).tolist()
        found = {
            "episodes": int(episodes),
            "mean_return": total_return / episodes if episodes else None,
            "mean_length": total_length / episodes if episodes else None,
        }
        if len(slots) == 1:
            last_return, last_length = self._last[slots[0]].tolist()
            found["last_return"] = last_return if episodes else None
            found["last_length"] = int(last_length) if episodes else None
        return found | {f"{name}_rate": v.rate(slots) for name, v in self._verdicts.items()}

    def move_to_entry(self, slot: int) -> None:
        """Move the sums of `slot` to its entry's former members, before another one takes it."""
        former = self.former(self._envs.names.entries.item(slot))
        for sums in self._all_sums():
            sums[former] += sums[slot]
            sums[slot] = 0
        self._last[slot] = 0

    def reset(self) -> None:
        """Set all sums to zero, but not the outcomes."""
        for sums in (*self._all_sums(), self._last):
            sums[:] = 0

    def _all_sums(self) -> list[NDArray[Any]]:
        verdicts = self._verdicts.values()
        return [self._sums, *(v.count for v in verdicts), *(v.true for v in verdicts)]


def _ended(
    flags: NDArray[np.bool_], lengths: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Return which episodes have ended by their flags, and codes of their outcomes."""
    terminated = flags[..., TERMINATED]
    ended = (terminated | flags[..., TRUNCATED]) & (lengths > 0)
    return ended, 1 - terminated  # The first two outcomes are terminated, truncated.
