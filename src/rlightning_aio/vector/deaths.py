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

from rlightning_aio.batch.contents import parts_of
from rlightning_aio.batch.infos import listed, vector_infos
from rlightning_aio.batch.joining import joined
from rlightning_aio.trees import index, mapped
from rlightning_aio.vector.batching import merged, replaced

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.sync import EnvGroup
    from rlightning_aio.vector.rows import Singles

__all__ = ["Deaths", "Stepped", "cause_and_rest"]

_CAUSE: Final = ("worker_restarted", "env_at_fault", "suspects", "worker_resumed", "outcome")
"""Keys of an info that say why its env was restarted, who was at fault, and how much was lost."""
_OF_AN_END: Final = ("final_info", "final_obs")
"""Keys of an info that a step with same-step autoreset adds where it ends an episode."""


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
        rows: the layout of envs in the group's results.
        mode: when an env is reset after the end of its episode.
        collect: returns the results of all outstanding requests, in order, within a deadline.
    """

    def __init__(
        self,
        group: EnvGroup,
        rows: Singles,
        mode: AutoresetMode,
        collect: Callable[[float | None], BatchedData],
    ) -> None:
        self._group, self._rows, self._mode, self._collect = group, rows, mode, collect
        # Envs whose next step is a reset, and those of them that have lost their workers. The
        # latter have already been reset, with the results `_held`.
        self._due = np.zeros(rows.num_envs, np.bool_)
        self._lost = np.zeros(rows.num_envs, np.bool_)
        self._held: BatchedData | None = None
        self._resets: BatchedData | None = None

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

    # -- a step that resets envs of lost workers ----------------------------------------

    def with_valid(self, actions: Any) -> Any:
        """Replace ignored actions by valid ones of the same batch."""
        return self._rows.with_valid(actions, self._lost)

    def send(self, responses: BatchedData) -> None:
        """Step all envs except those whose results are held."""
        (rest,) = np.nonzero(~self._rows.whole(self._lost))
        if len(rest):
            self._group.step_async(responses.take(rest.tolist()))

    def collect(self, deadline: float | None) -> BatchedData:
        """Wait for the steps, and return the results of all envs in order, held ones included.

        If only some envs of a batch have lost their worker, all were stepped: reset the former.
        """
        assert self._held is not None
        whole = self._rows.whole(self._lost)
        (rest,), (held,) = np.nonzero(~whole), np.nonzero(whole)
        parts = [self._collect(deadline)] if len(rest) else []
        if len(held):
            parts.append(self._held.take(held.tolist()))
        batch = joined(parts).take(np.argsort(np.concatenate([rest, held])).tolist())
        partly = self._lost & ~self._rows.places(whole)
        self._resets = None
        if partly.any():
            nothing = [None] * self._rows.num_envs
            self._rows.send_resets(nothing, nothing, np.flatnonzero(partly).tolist())
            self._resets = self._collect(deadline)
        return batch

    # -- what the program sees ----------------------------------------------------------

    def settle(self, batch: BatchedData, stepped: Stepped, last: Any) -> Stepped:
        """Replace the results of envs whose workers died by truncated episodes.

        Args:
            batch: the collected results.
            stepped: their contents.
            last: the observations that were returned last.
        """
        rows, count = self._rows, self._rows.num_envs
        each = listed(stepped.infos, count)
        for k in np.flatnonzero(rows.places(rows.whole(self._lost))).tolist():
            _, each[k] = cause_and_rest(each[k])
        restarted = rows.flat(batch.restarted).copy()
        observations, reset = self._with_resets(stepped.observations, each, restarted)
        reset |= restarted
        lost = rows.lost(restarted, self._due)
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
        self._held, self._resets = batch if next_step else None, None
        return Stepped(
            observations,
            np.where(reset, 0.0, stepped.rewards),
            stepped.terminated & ~reset,
            (stepped.truncated & ~reset) | lost,
            vector_infos(each),
        )

    def _with_resets(
        self, observations: Any, each: list[dict[str, Any]], restarted: NDArray[np.bool_]
    ) -> tuple[Any, NDArray[np.bool_]]:
        """Put the resets of `collect` into `observations` and, in place, into the infos.

        Returns the observations and a mask of the envs that were reset. A worker that died during
        these resets has also lost the other envs of its batch.
        """
        reset = np.zeros(len(each), np.bool_)
        if self._resets is None:
            return observations, reset
        rows, places = self._rows, self._rows.flat(self._resets.index)
        died = rows.flat(self._resets.restarted)
        taken = self._lost[places] | died
        restarted[places[died]] = True
        reset[places[taken]] = True
        infos = listed(rows.infos(self._resets), len(places))
        for k in np.flatnonzero(taken).tolist():
            place = int(places[k])
            if restarted[place]:
                cause, _ = cause_and_rest(each[place])
                infos[k] = {**cause, **infos[k]}
            each[place] = infos[k]
        first = mapped(lambda column: column[taken], rows.observation(self._resets))
        return merged(observations, first, places[taken], len(each)), reset


def cause_and_rest(info: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split the info of a restarted env into entries about its worker and entries of the reset.

    An env that resumes shows its last saved result again. If that ended an episode, its info is
    also about that end, which was returned long ago; those entries are left out.
    """
    cause = {key: info[key] for key in _CAUSE if key in info}
    rest = {key: value for key, value in info.items() if key not in (*cause, *_OF_AN_END)}
    return cause, rest
