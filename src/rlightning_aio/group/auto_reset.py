"""The rule of `auto_reset`: which envs are reset in place of their next step.

An env's counter is 0 after a reset and one more after each completed step. Inside the
context the step that reaches the limit is flagged, and the next step of that env is
replaced by a reset; so a limit of L gives a period of L + 1 calls.

Nothing is counted step by step: a counter is the number of the env's request less that of
its last reset, and limits are looked at only when one can have been reached.
"""

from __future__ import annotations

import operator
import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.rings import NUMBER_SHIFT, STEP

if TYPE_CHECKING:
    from types import EllipsisType

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.slots import Slots

__all__ = ["NO_RESETS", "AutoReset", "as_int"]

NO_RESETS: Final[NDArray[np.bool_]] = np.zeros(1, np.bool_)
"""No env is due; broadcasts to any number of slots."""

# A 0-d array: NumPy takes twice as long over a Python int.
_STEP: Final = np.array(STEP)


def as_int(value: Any) -> int | None:
    """`value` as an int, NumPy's included; None for what is no whole number, as a bool."""
    if isinstance(value, bool):
        return None
    try:
        return operator.index(value)
    except TypeError:
        return None


class AutoReset:
    """Counters of completed steps, and what follows from them while it is active."""

    def __init__(self, slots: Slots) -> None:
        self._slots = slots
        # Numbers of the last resets, and one more for each later request that was no step.
        self._base = np.zeros(len(slots), np.int64)
        self._due = np.zeros(len(slots), np.bool_)
        self._any_due = False
        # Invariant: true of every env whose current request is a reset.
        self._resetting = np.zeros(len(slots), np.bool_)
        self._any_resetting = False
        # For so many batches no env can reach its limit.
        self._margin = 0
        self._limits: NDArray[np.int64] | None = None
        self._on_done = True

    @property
    def active(self) -> bool:
        """Whether the context is open."""
        return self._limits is not None

    def begin(self, max_episode_steps: int | None, *, on_done: bool) -> None:
        """Open the context.

        Raises:
            ValueError: the limit is no positive int, or is None and an env has none.
            RuntimeError: the context is open already.
        """
        if self.active:
            raise RuntimeError("auto_reset contexts don't nest; leave the open one first")
        self._limits = self._chosen_limits(max_episode_steps)
        self._margin = 0
        self._on_done = on_done

    def _chosen_limits(self, given: int | None) -> NDArray[np.int64]:
        table = self._slots
        configured = [config.max_episode_steps for config in table.configs]
        if given is None:
            if None in configured:
                slot = configured.index(None)
                raise ValueError(
                    f"{table.describe(slot)} has no max_episode_steps; configure one or pass "
                    "auto_reset(max_episode_steps=…)"
                )
            return np.array(configured, np.int64)
        limit = as_int(given)
        if limit is None or limit < 1:
            raise ValueError(f"max_episode_steps must be a positive int, not {given!r}")
        if any(own is not None and own != limit for own in configured):
            warnings.warn(
                f"auto_reset(max_episode_steps={limit}) overrides the limits that are configured",
                stacklevel=4,
            )
        return np.full(len(table), limit, np.int64)

    def end(self) -> None:
        """Close the context: steps are plain again."""
        self._limits = None
        self._due[:] = False
        self._any_due = False

    def due(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` are to be reset in place of their step."""
        return self._due[slots] if self._any_due else NO_RESETS

    def resets_sent(self, slots: NDArray[np.intp]) -> None:
        """Take note that `slots` were asked for a reset, or for their first result."""
        self._resetting[slots] = True
        self._any_resetting = True

    def not_completed(self, slots: NDArray[np.intp]) -> None:
        """Leave the counters of `slots` as they are, though their request has a number."""
        self._base[slots] += 1

    def account(self, slots: NDArray[np.intp], batch: BatchedData) -> list[bool]:
        """Count results as they are handed out; the flags that go with them."""
        stepped = self._note_resets(slots) if self._any_resetting else None
        if self._limits is None:
            return [False] * len(slots)
        self._margin -= 1
        due = reached = None
        if self._margin <= 0:
            self._margin = int((self._limits - self._counts(...)).min())
            due = reached = self._counts(slots) >= self._limits[slots]
        if self._on_done and batch.any_ended:
            ended = batch.ended
            if self._slots.any_resets_itself:
                ended &= ~self._slots.resets_itself[slots]
            if stepped is not None:
                ended &= stepped
            due = ended if due is None else due | ended
        if due is not None:
            self._due[slots] |= due
            self._any_due = np.count_nonzero(self._due) > 0
        return [False] * len(slots) if reached is None else reached.tolist()

    def _counts(self, slots: NDArray[np.intp] | EllipsisType) -> NDArray[np.int64]:
        """Counters of `slots`; too high by 1 where a request is in flight."""
        return (self._slots.entry[slots] >> NUMBER_SHIFT) - self._base[slots]

    def _note_resets(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Start the counters of those that were reset anew; which of `slots` were not."""
        stepped = self._slots.ops(slots) == _STEP
        begun = slots[~stepped]
        if len(begun):
            self._base[begun] = self._slots.entry[begun] >> NUMBER_SHIFT
            self._due[begun] = self._resetting[begun] = False
            self._any_due = np.count_nonzero(self._due) > 0
            self._any_resetting = np.count_nonzero(self._resetting) > 0
        return stepped
