"""`EpisodeSums`: return and length of the current episodes of one env.

There is one sum for each agent and sub-environment, over the steps between a reset and an end. The
sums are in the row, because the trainer ends episodes at a step limit and needs them. A step in
which a sub-environment resets itself belongs to no episode, and neither do steps between an end
and the next reset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.types import Autoreset


class EpisodeSums:
    """Adds up rewards and steps in place.

    Args:
        returns: float64, lengths: int64, over: bool; all of shape `[*agents, *sub_envs]`.
        autoreset: when sub-environments reset themselves; see `EnvMeta`.

    Attributes:
        returns, lengths: of each episode, including the last step. If that step belongs to no
            episode, the length is 0, and the return is that of the previous episode, or 0 if the
            step was a reset.
        over: True for each that ended and was not reset since.
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

    def begin(self) -> None:
        """Begin new episodes."""
        self.returns[...] = 0.0
        self.lengths[...] = 0
        self.over[...] = False

    def step(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_] | None:
        """Count one step of all sub-environments.

        Args:
            reward: of each.
            ended: whether each was terminated or truncated in it; None if none was.

        Returns:
            A mask of those that reset themselves in this step; None if none did.
        """
        if ended is None and not np.count_nonzero(self.over):
            np.add(self.returns, reward, out=self.returns)
            np.add(self.lengths, 1, out=self.lengths)
            return None
        return self._step_around_ends(reward, ended)

    def _step_around_ends(
        self, reward: NDArray[np.float64], ended: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_] | None:
        over = self.over.copy()
        same_step, next_step = self._autoreset == "same_step", self._autoreset == "next_step"
        some = np.count_nonzero(over) > 0
        if same_step and some:
            # These already began their next episode.
            self.returns[over] = self.lengths[over] = 0
        # An agent that waits for others keeps its return, so that they can be added up.
        waits = some and self._autoreset == "disabled"
        self.returns[...] += np.where(over, 0.0, reward) if waits else reward
        self.lengths[...] += 1
        if some and not same_step:
            self.lengths[over] = 0
        if some and next_step:
            self.returns[over] = 0.0
        if ended is None:
            now = np.zeros_like(over) if same_step or next_step else over
        elif same_step:
            now = ended
        else:
            now = ended & ~over if next_step else over | ended
        self.over[...] = now
        return over if next_step and some else None
