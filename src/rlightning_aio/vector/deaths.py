"""Worker deaths as seen through the vector interface: truncated episodes.

Rule: the step that loses an env's worker ends the episode: truncated, reward 0, and the observation
that was returned last. The replacement's first observation appears where the autoreset mode has a
reset: in the next step, in the same step, or in the reset that the program requests. An env that
was about to be reset lost no episode, so it returns that observation immediately.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from rlightning_aio.batch.data import parts_of
from rlightning_aio.batch.infos import listed, vector_infos
from rlightning_aio.batch.joining import joined
from rlightning_aio.trees import index
from rlightning_aio.vector.batching import replaced

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.sync import EnvGroup

__all__ = ["Deaths", "Stepped", "cause_and_rest"]

_CAUSE: Final = ("worker_restarted", "env_at_fault", "suspects", "outcome")
"""Keys of an info that say why its env was restarted, and who was at fault."""


class Stepped(NamedTuple):
    """Results of one step of all envs; observations as columns."""

    observations: Any
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: dict[str, Any]


class Deaths:
    """Converts the results of restarted envs to truncated episodes (see the module).

    Args:
        group: the group of the envs.
        mode: when an env is reset after the end of its episode.
        collect: returns the results of all outstanding requests, in order, within a deadline.
    """

    def __init__(
        self,
        group: EnvGroup,
        mode: AutoresetMode,
        collect: Callable[[float | None], BatchedData],
    ) -> None:
        self._group, self._mode, self._collect = group, mode, collect
        # Envs whose next step is a reset, and those of them that have lost their workers. The
        # latter have already been reset, with the results `_held`.
        self._due = np.zeros(len(group.env_ids), np.bool_)
        self._lost = np.zeros(len(group.env_ids), np.bool_)
        self._held: BatchedData | None = None

    def concern(self, batch: BatchedData) -> bool:
        """Return True if `settle` has anything to do for the results of a step."""
        for part in parts_of(batch):
            if part.restarted is not None:
                return True
        return self._held is not None

    @property
    def unfinished(self) -> bool:
        """True while resets of lost workers' envs have not been returned yet."""
        return self._held is not None

    def note_reset(self, chosen: Any) -> None:
        """Record that the envs `chosen` have been reset."""
        self._due[chosen] = self._lost[chosen] = False
        if not self._lost.any():
            self._held = None

    def note_step(self, stepped: Stepped) -> None:
        """Record which episodes a step that is about to be returned has ended."""
        if self._mode == AutoresetMode.NEXT_STEP:
            self._due = stepped.terminated | stepped.truncated

    def save_state(self) -> dict[str, Any]:
        """Return masks: of the envs that are due for a reset, and that have had theirs."""
        return {"due": self._due.copy(), "lost": self._lost.copy()}

    def load_state(self, state: dict[str, Any], batch: BatchedData) -> None:
        """Restore the masks; `batch` has the last results of all envs at that time."""
        self._due, self._lost = state["due"].copy(), state["lost"].copy()
        self._held = batch if self._lost.any() else None

    # -- a step that resets envs of lost workers ----------------------------------------

    def send(self, responses: BatchedData) -> None:
        """Step all envs except those whose results are held."""
        (rest,) = np.nonzero(~self._lost)
        if len(rest):
            self._group.step_async(responses.take(rest.tolist()))

    def collect(self, deadline: float | None) -> BatchedData:
        """Wait for the steps, and return the results of all envs in order, held ones included."""
        assert self._held is not None
        (rest,), (held,) = np.nonzero(~self._lost), np.nonzero(self._lost)
        parts = [self._collect(deadline)] if len(rest) else []
        parts.append(self._held.take(held.tolist()))
        return joined(parts).take(np.argsort(np.concatenate([rest, held])).tolist())

    # -- what the program sees ----------------------------------------------------------

    def settle(self, batch: BatchedData, stepped: Stepped, last: Any) -> Stepped:
        """Replace the results of envs whose workers died by truncated episodes.

        Args:
            batch: the collected results.
            stepped: their contents.
            last: the observations that were returned last.
        """
        observations, each = stepped.observations, listed(stepped.infos, len(self._lost))
        for k in np.flatnonzero(self._lost).tolist():
            _, each[k] = cause_and_rest(each[k])
        restarted = batch.restarted
        lost = restarted & ~self._due
        (chosen,) = np.nonzero(lost)
        for k in chosen.tolist():
            cause, first = cause_and_rest(each[k])
            if self._mode == AutoresetMode.SAME_STEP:
                final = copy.deepcopy(index(last, k))
                each[k] = {**first, **cause, "final_info": cause, "final_obs": final}
            else:
                each[k] = cause
        if self._mode != AutoresetMode.SAME_STEP:
            observations = replaced(observations, last, chosen)
        next_step = self._mode == AutoresetMode.NEXT_STEP and len(chosen) > 0
        self._lost = lost if next_step else np.zeros_like(lost)
        self._held = batch if next_step else None
        return Stepped(
            observations,
            np.where(restarted, 0.0, stepped.rewards),
            stepped.terminated & ~restarted,
            (stepped.truncated & ~restarted) | lost,
            vector_infos(each),
        )


def cause_and_rest(info: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split the info of a restarted env into entries about its worker and entries of the reset."""
    cause = {key: info[key] for key in _CAUSE if key in info}
    rest = {key: value for key, value in info.items() if key not in cause}
    return cause, rest
