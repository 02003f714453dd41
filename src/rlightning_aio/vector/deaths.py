"""Worker deaths as seen through the vector interface: truncated episodes.

Rule: the step that loses an env's worker ends the episode: truncated, reward 0, and the observation
that was returned last. The next episode's first observation appears where the autoreset mode has a
reset: in the next step, for which the vector env resets that env again; in the same step; or in the
reset that the program requests. An env that was about to be reset lost no episode, so it returns
that observation immediately.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode

from rlightning_aio.batch.contents import reported_info_list
from rlightning_aio.batch.infos import vector_infos
from rlightning_aio.trees import index, mapped
from rlightning_aio.vector.spaces import merged

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData

_CAUSE: Final = ("worker_restarted", "env_at_fault", "outcome")
"""Keys of an info that say why its env was restarted, and who was at fault."""


def without_cause(info: dict[str, Any]) -> dict[str, Any]:
    """Return the info of a reset, without what was lost since the episode before had ended."""
    if "worker_restarted" not in info:
        return info
    return {key: value for key, value in info.items() if key not in _CAUSE}


class Stepped(NamedTuple):
    """Results of one step of all envs; observations as columns."""

    observations: Any
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    infos: dict[str, Any]


def with_deaths(
    batch: BatchedData, last: Any, due: NDArray[np.bool_], mode: AutoresetMode
) -> tuple[Stepped, NDArray[np.bool_]]:
    """Convert the results of restarted envs to ends of the episodes that they lost.

    Args:
        batch: the results of a step of all envs, in order.
        last: the observations that were returned last, as columns.
        due: ``[num_envs]``, which envs were about to be reset.
        mode: when an env is reset after the end of its episode.

    Returns what the program sees, and which envs have lost an episode.
    """
    observations, each, restarted = batch.observation, reported_info_list(batch), batch.restarted
    lost = restarted & ~due
    (chosen,) = np.nonzero(lost)
    for k in chosen.tolist():
        cause = {key: each[k][key] for key in _CAUSE if key in each[k]}
        if mode == AutoresetMode.SAME_STEP:
            each[k] |= {"final_info": cause, "final_obs": copy.deepcopy(index(last, k))}
        else:
            each[k] = cause
    if mode != AutoresetMode.SAME_STEP:
        kept = mapped(lambda column: [column[k] for k in chosen.tolist()], last)
        observations = merged(observations, kept, chosen, len(batch))
    truncated = batch.truncated & (lost | ~restarted)
    infos = vector_infos(each)
    return Stepped(observations, batch.reward, batch.terminated, truncated, infos), lost
