"""`Recovery`: which envs have lost their episode with their worker, until somebody was told.

If the env owed a reply, the reset that answers in its place tells of the loss. Otherwise its next
step is replaced by a reset that does, unless the env is reset before. A reset that raises begins no
episode, so the loss is still to be told. Nobody mistakes a new episode for the old one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

__all__ = ["Recovery"]


class Recovery:
    """Causes by slot: untold ones, those that the next reply brings along, and those that need
    not be told if a reset which was asked for succeeds.
    """

    def __init__(self) -> None:
        self._untold: dict[int, str] = {}
        self._telling: dict[int, str] = {}
        self._resetting: dict[int, str] = {}

    @property
    def any_untold(self) -> bool:
        """Whether any env has still to tell."""
        return bool(self._untold)

    @property
    def any_telling(self) -> bool:
        """Whether any reply that tells, or makes that needless, is still to come."""
        return bool(self._telling or self._resetting)

    def lose(self, slots: Iterable[int], cause: str) -> None:
        """The envs of `slots` have lost their episodes."""
        for slot in slots:
            self._telling.pop(slot, None)
            self._resetting.pop(slot, None)
            self._untold[slot] = cause

    def tell(self, slots: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Have the next replies of `slots` tell; which of them have something to."""
        telling = np.zeros(len(slots), np.bool_)
        for k, slot in enumerate(slots.tolist()):
            cause = self._untold.pop(slot, None)
            if cause is not None:
                self._telling[slot] = cause
                telling[k] = True
        return telling

    def forget(self, slots: Iterable[int]) -> None:
        """The envs of `slots` are about to be reset: if that succeeds, there is nothing to tell."""
        for slot in slots:
            cause = self._untold.pop(slot, None)
            if cause is not None:
                self._resetting[slot] = cause

    def give_up(self, slots: Iterable[int]) -> None:
        """No reply of `slots` will come."""
        for slot in slots:
            self._untold.pop(slot, None)
            self._telling.pop(slot, None)
            self._resetting.pop(slot, None)

    def told(self, slot: int) -> str | None:
        """A reply has come; what it has to tell."""
        self._resetting.pop(slot, None)
        return self._telling.pop(slot, None)

    def failed(self, slot: int) -> str | None:
        """A request has ended in an error of the env's; what that has to tell."""
        cause = self._telling.pop(slot, None)
        lost = cause or self._resetting.pop(slot, None)
        if lost is not None:
            self._untold[slot] = lost
        return cause
