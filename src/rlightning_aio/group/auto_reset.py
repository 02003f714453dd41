"""The rule of `auto_reset`: which envs are reset in place of their next step.

An env's counter is 0 after a reset and one more after each completed step. Inside the
context, the step that reaches the limit is flagged, and the next step of that env is
replaced by a reset, so a limit of L gives a period of L + 1 calls. A reset that is due when a
context ends is due in the next one, unless the env was reset or called in between.

Nothing is counted step by step: a counter is the number of the env's request less that of
its last reset, and limits are checked only when one can have been reached.
"""

from __future__ import annotations

import operator
import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import EllipsisType

    from numpy.typing import NDArray

    from rlightning_aio.batch.columns import ResultColumns
    from rlightning_aio.group.env_table import EnvTable
    from rlightning_aio.group.requests import Requests

__all__ = ["NO_RESETS", "AutoReset", "as_int"]

NO_RESETS: Final[NDArray[np.bool_]] = np.zeros(1, np.bool_)
"""No env is due; broadcasts to any number of slots."""
_ENDLESS: Final = 1 << 62


def as_int(value: Any) -> int | None:
    """`value` as an int, NumPy's included; None for what is no whole number, as a bool."""
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


class AutoReset:
    """Counters of completed steps, and what follows from them while it is active.

    Attributes:
        mark_truncated: a result that reaches the limit is to be marked as truncated.
    """

    def __init__(self, envs: EnvTable, requests: Requests) -> None:
        self._envs = envs
        self._requests = requests
        # Numbers of the last resets, and one more for each later request that was no step.
        self._base = np.zeros(len(envs), np.int64)
        # Whose last result has reached the limit of a context; whose episode has ended by itself.
        self._cut = np.zeros(len(envs), np.bool_)
        self._over = np.zeros(len(envs), np.bool_)
        # Of those that show where they were put back to: by which request, their counter, and
        # whether they were cut.
        self._restored: dict[int, tuple[int, int, bool]] = {}
        self._any_due = False
        # For so many batches no env can reach its limit.
        self._margin = 0
        self._limits: NDArray[np.int64] | None = None
        # Whether each env has its own limit, or all the same.
        self._own_limits = False
        self._on_done = True
        self.mark_truncated = False

    @property
    def active(self) -> bool:
        """Whether the context is open."""
        return self._limits is not None

    def begin(
        self, max_episode_steps: int | None, *, on_done: bool, mark_truncated: bool = False
    ) -> None:
        """Open the context.

        Raises:
            ValueError: the limit is no positive int, or is None and an env has none.
            RuntimeError: the context is open already.
        """
        if self.active:
            raise RuntimeError("auto_reset contexts don't nest; leave the open one first")
        self._limits = self._chosen_limits(max_episode_steps)
        self._own_limits = max_episode_steps is None
        self._margin = 0
        self._on_done = on_done
        self.mark_truncated = mark_truncated
        self._note_due()

    def _chosen_limits(self, given: int | None) -> NDArray[np.int64]:
        envs = self._envs
        if given is None:
            here = np.array([bool(env_id) for env_id in envs.env_ids])
            lacking = np.flatnonzero(here & (envs.step_limits == 0) & ~envs.resets_itself)
            if len(lacking):
                raise ValueError(
                    f"{envs.describe(int(lacking[0]))} has no step limit, neither a configured "
                    "max_episode_steps nor one of the simulator's own; configure one or pass "
                    "auto_reset(max_episode_steps=…)"
                )
            return np.where(self._endless(...), _ENDLESS, envs.step_limits)
        limit = as_int(given)
        if limit is None or limit < 1:
            raise ValueError(f"max_episode_steps must be a positive int, not {given!r}")
        configured = {config.max_episode_steps for config in envs.configs} - {None, limit}
        if configured:
            warnings.warn(
                f"auto_reset(max_episode_steps={limit}) overrides the limits that are configured",
                stacklevel=5,
            )
        return np.full(len(envs), limit, np.int64)

    def note_joined(self, slot: int) -> None:
        """A client has taken `slot`, and has told what limit its simulator has."""
        if self._limits is not None and self._own_limits:
            self._limits[slot] = _ENDLESS if self._endless(slot) else self._envs.step_limits[slot]
            self._margin = 0

    def _endless(self, slots: Any) -> Any:
        """Which envs the group's own count doesn't cut: those that reset themselves keep to their
        limit, each of their sub-environments in its own time.
        """
        return (self._envs.step_limits[slots] == 0) | self._envs.resets_itself[slots]

    def end(self) -> None:
        """Close the context: steps are plain again."""
        self._limits = None
        self.mark_truncated = False

    def due(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` are to be reset in place of the step that is about to be sent."""
        if self._limits is None:
            self._cut[slots] = False  # Their episodes go on, whatever limit they had reached.
            return NO_RESETS
        return self._due(slots) if self._any_due else NO_RESETS

    def _due(self, slots: NDArray[np.intp] | EllipsisType) -> NDArray[np.bool_]:
        """Whose episode is over, as the context has it."""
        cut = self._cut[slots]
        return cut | self._over[slots] if self._on_done else cut

    def _note_due(self) -> None:
        self._any_due = np.count_nonzero(self._due(...)) > 0

    def not_completed(self, slots: NDArray[np.intp]) -> None:
        """Leave the counters of `slots` as they are, though their request has a number."""
        self._base[slots] += 1

    def counters(self, slots: NDArray[np.intp]) -> list[tuple[int, bool]]:
        """Counters of `slots`, all idle, and whether their last results have reached a limit."""
        counts = self._counts(slots)
        return list(zip(counts.tolist(), self._cut[slots].tolist(), strict=True))

    def restore(self, slots: NDArray[np.intp], counters: Sequence[tuple[int, bool]]) -> None:
        """The next requests of `slots` show where the envs were put back to."""
        for slot, (count, cut) in zip(slots.tolist(), counters, strict=True):
            self._restored[slot] = self._requests.number(slot) + 1, count, cut

    def rewind(self, slot: int, num_steps: int, *, owes: bool) -> None:
        """The next request of `slot` shows where the env stood so many steps ago.

        Args:
            slot: of the env.
            num_steps: completed ones that it knows nothing of any more.
            owes: its last request was not answered.
        """
        number = self._requests.number(slot)
        shown_by, count, _ = self._restored.get(slot, (0, 0, False))
        if shown_by != number:
            count = max(number - owes - int(self._base[slot]) - num_steps, 0)
        self._restored[slot] = number + 1, count, False

    def account(
        self, slots: NDArray[np.intp], flagged: Sequence[ResultColumns]
    ) -> NDArray[np.bool_] | None:
        """Count results as they are handed out; which reached the limit (None: no one).

        Args:
            slots: of all results.
            flagged: those parts in which any flag is set.
        """
        shown: list[int] = []
        for part in flagged:
            shown += self._note_flags(part)
        if self._limits is None:
            return None
        self._margin -= 1
        reached = None
        if self._margin <= 0:
            self._margin = int((self._limits - self._counts(...)).min())
            reached = self._counts(slots) >= self._limits[slots]
            if shown:  # What they show was flagged when it was new.
                reached &= ~np.isin(slots, shown)
            self._cut[slots[reached]] = True
        if flagged or reached is not None:
            self._note_due()
        return reached if reached is not None and np.count_nonzero(reached) else None

    def _note_flags(self, part: ResultColumns) -> list[int]:
        """Start the counters of those that were reset anew; note whose episode has ended.

        Returns those that are no new episodes, but show where they were put back to.
        """
        resets = part.is_reset
        if resets.ndim > 1:
            resets = resets.all(axis=1)
        begun = part.slots[resets]
        if len(begun):
            self._base[begun] = self._requests.numbers(begun)
            self._cut[begun] = self._over[begun] = False
        shown = [slot for slot in begun.tolist() if self._is_shown(slot)]
        for slot in shown:
            _, count, cut = self._restored[slot]
            self._base[slot] -= count
            self._cut[slot] = cut
            self._margin = 0
        over = part.over
        if self._envs.any_resets_itself:
            over = over & ~self._envs.resets_itself[part.slots]
        self._over[part.slots[over]] = True
        return shown

    def _is_shown(self, slot: int) -> bool:
        """Whether the last result of `slot` is no new episode, but shows where the env stands."""
        return slot in self._restored and self._restored[slot][0] == self._requests.number(slot)

    def _counts(self, slots: NDArray[np.intp] | EllipsisType) -> NDArray[np.int64]:
        """Counters of `slots`; too high by 1 where a request is in flight."""
        return self._requests.numbers(slots) - self._base[slots]
