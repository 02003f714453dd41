"""The rule of `auto_reset`: which envs are reset in place of their next step.

An env's counter is 0 after a reset and one more after each completed step. Inside the
context the step that reaches the limit is flagged, and the next step of that env is
replaced by a reset; so a limit of L gives a period of L + 1 calls.
"""

from __future__ import annotations

import operator
import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.protocol.rings import STEP

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.group.slots import Slots

__all__ = ["NO_RESETS", "AutoReset", "whole"]

NO_RESETS: Final[NDArray[np.bool_]] = np.zeros(1, np.bool_)
"""No env is due; broadcasts to any number of slots."""

# 0-d arrays: NumPy takes twice as long over a Python int.
_ONE: Final = np.array(1)
_STEP: Final = np.array(STEP, np.int8)


def whole(value: Any) -> int | None:
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
        self._counts = np.zeros(len(slots), np.int64)
        self._due = np.zeros(len(slots), np.bool_)
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
        limit = whole(given)
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

    def due(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of `slots` are to be reset in place of their step."""
        return NO_RESETS if self._limits is None else self._due[slots]

    def account(self, slots: NDArray[np.intp], batch: BatchedData) -> list[bool]:
        """Count results as they are handed out; the flags that go with them."""
        stepped = self._slots.op[slots] == _STEP
        counts = (self._counts[slots] + _ONE) * stepped
        self._counts[slots] = counts
        if self._limits is None:
            return [False] * len(slots)
        reached = counts >= self._limits[slots]
        due = reached
        if self._on_done and batch.any_ended:
            due = reached | (batch.ended & stepped & ~self._slots.resets_itself[slots])
        self._due[slots] = due
        return reached.tolist()
