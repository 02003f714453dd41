"""`EpisodeSums`: return and length of the episodes that are under way in one env.

Rule: one sum for each agent and sub-environment, over the steps between a reset and an
end. The step in which a sub-environment resets itself belongs to no episode, nor does
what comes after an end that nobody has reset yet.
"""

from __future__ import annotations

from types import EllipsisType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rlightning_aio.types import Autoreset

__all__ = ["EpisodeSum", "EpisodeSums"]

Which = EllipsisType | NDArray[np.integer[Any]]


class EpisodeSums:
    """See the module.

    Args:
        shape: of the sums: agents, then sub-environments, where there are any.
        autoreset: what sub-environments do after an end; see `EnvMeta`.
    """

    def __init__(self, shape: tuple[int, ...], autoreset: Autoreset) -> None:
        self._autoreset = autoreset
        self._returns = np.zeros(shape)
        self._lengths = np.zeros(shape, np.int64)
        # Lengths lack so many steps as all sub-environments have made together since.
        self._steps_together = 0
        self._over = np.zeros(shape, np.bool_)
        self._any_over = False

    def forget(self, begun: Which = ...) -> None:
        """All episodes begin anew; those that `begun` leaves out, when next heard of."""
        self._returns[...] = 0.0
        self._lengths[...] = 0
        self._steps_together = 0
        self._over[...] = True
        self._over[begun] = False
        self._any_over = bool(self._over.any())

    def add(
        self, reward: NDArray[np.float64], ends: NDArray[np.bool_], which: Which = ...
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
        """Count one step of all sub-environments, or of those that `which` names.

        Args:
            reward: of each.
            ends: whether each has terminated and whether it was truncated, on the last axis.
            which: unlike one another.

        Returns:
            Returns and lengths of the episodes that ended in this step, in the shape of
            `reward`, with length 0 elsewhere; None if none has ended.
        """
        any_ended = np.count_nonzero(ends) > 0
        if not any_ended and not self._any_over:
            if which is ...:
                self._returns += reward
                self._steps_together += 1
            else:
                self._returns[which] += reward
                self._lengths[which] += 1
            return None
        ended = ends[..., 0] | ends[..., 1]
        self._lengths += self._steps_together
        self._steps_together = 0
        over = self._over[which]
        self._returns[which] += np.where(over, 0.0, reward)
        self._lengths[which] += ~over
        ended_now = ended & ~over
        returns = self._returns[which].copy()
        lengths = np.where(ended_now, self._lengths[which], 0)
        self._returns[which] = np.where(ended_now, 0.0, returns)
        self._lengths[which] *= ~ended_now
        if self._autoreset == "next_step":
            self._over[which] = ended_now
        elif self._autoreset == "disabled":
            self._over[which] = over | ended
        self._any_over = bool(self._over.any())
        return (returns, lengths) if any_ended else None


class EpisodeSum:
    """The same for one env without agents or sub-environments, which doesn't reset itself."""

    def __init__(self) -> None:
        self._return = 0.0
        self._length = 0
        self._over = False

    def forget(self) -> None:
        """A new episode begins."""
        self._return, self._length, self._over = 0.0, 0, False

    def add(self, reward: float, ended: bool) -> tuple[float, int] | None:
        """See `EpisodeSums.add`."""
        if self._over:
            return (0.0, 0) if ended else None
        self._return += reward
        self._length += 1
        if not ended:
            return None
        sums = self._return, self._length
        self._return, self._length, self._over = 0.0, 0, True
        return sums
