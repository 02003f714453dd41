"""`EpisodeSums`: return and length of the episodes that are under way in one env.

Rule: there is one sum for each agent and sub-environment, over the steps between a reset and an
end. The sums are kept in the row that carries them to the trainer, where a step limit, which ends
an episode elsewhere, finds them. A step in which a sub-environment resets itself belongs to no
episode, and neither does what comes between an end and the next reset.
"""

from __future__ import annotations

from types import EllipsisType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rlightning_aio.types import Autoreset

__all__ = ["EpisodeSums"]

Which = EllipsisType | NDArray[np.integer[Any]]


class EpisodeSums:
    """See the module.

    Args:
        returns: float64, lengths: int64, over: bool; of one shape: agents, then
            sub-environments, where there are any. They are written in place.
        autoreset: what sub-environments do after an end; see `EnvMeta`.

    Attributes:
        returns, lengths: of each episode, the last step included; length 0 where that belongs
            to no episode.
        over: whether each has ended and was not reset since.
    """

    def __init__(
        self,
        returns: NDArray[np.float64],
        lengths: NDArray[np.int64],
        over: NDArray[np.bool_],
        autoreset: Autoreset,
    ) -> None:
        self.returns, self.lengths, self.over = returns, lengths, over
        self._autoreset = autoreset
        self._any_over = False

    def begin(self, begun: Which = ...) -> None:
        """All episodes begin anew; those that `begun` leaves out, when next heard of."""
        self.returns[...] = 0.0
        self.lengths[...] = 0
        self.over[...] = True
        self.over[begun] = False
        self._any_over = bool(self.over.any())

    def look(self) -> None:
        """Take note of what others have written to the row."""
        self._any_over = bool(self.over.any())

    def step(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None, which: Which = ...
    ) -> NDArray[np.bool_] | None:
        """Count one step of all sub-environments, or of those that `which` names.

        Args:
            reward: of each.
            ended: whether each was terminated or truncated in it; None if none was.
            which: unlike one another.

        Returns:
            Which of them have reset themselves in this step; None if none has.
        """
        if ended is None and not self._any_over:
            if which is ...:
                np.add(self.returns, reward, out=self.returns)
                np.add(self.lengths, 1, out=self.lengths)
            else:
                self.returns[which] += reward
                self.lengths[which] += 1
            return None
        return self._step_around_ends(reward, ended, which)

    def _step_around_ends(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None, which: Which
    ) -> NDArray[np.bool_] | None:
        over = self.over[which].copy()
        # A few of many, as a rule, or none.
        chosen = over if which is ... else which[over]
        same_step, next_step = self._autoreset == "same_step", self._autoreset == "next_step"
        some = self._any_over and np.count_nonzero(over) > 0
        if same_step and some:
            # What is over has begun anew already.
            self.returns[chosen] = self.lengths[chosen] = 0
        self.returns[which] += reward
        self.lengths[which] += 1
        if some and not same_step:
            self.returns[chosen] = self.lengths[chosen] = 0
        if ended is None:
            now = np.zeros_like(over) if same_step or next_step else over
        elif same_step:
            now = ended
        else:
            now = ended & ~over if next_step else over | ended
        self.over[which] = now
        self._any_over = np.count_nonzero(self.over) > 0
        return over if next_step and some else None
