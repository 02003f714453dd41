"""`Results`: what a batch tells of transitions, with one row for each sub-environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.collecting.trees import rows_of
from rlightning_aio.protocol.columns import Tree, mapped

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData

__all__ = ["Results", "results_of"]


@dataclass(slots=True)
class Results:
    """Rows of a batch of results.

    Attributes:
        head: the batch's shape: ``(n,)``, or ``(m, num_envs)``.
        index: ``[n]``, which env of the group each is; see `BatchedData.index`.
        observation: tree of ``[n, *obs]``.
        reward, terminated, truncated: ``[n]``, or dicts of such by agent; truncated where the
            step limit has cut the episode, too.
        done: ``[n]``, whether the episode is over: for all of its agents.
        is_reset: ``[n]``.
        batch: whose rows they are.
    """

    head: tuple[int, ...]
    index: NDArray[np.int64]
    observation: Tree
    reward: Any
    terminated: Any
    truncated: Any
    done: NDArray[np.bool_]
    is_reset: NDArray[np.bool_]
    batch: BatchedData

    @property
    def num_sub_envs(self) -> int:
        """Rows of each result."""
        return self.head[1] if len(self.head) > 1 else 1

    def final_observation(self, rows: NDArray[np.intp], otherwise: Tree) -> Tree:
        """Final observations of rows whose env has begun its next episode in the same step.

        The env tells them in ``info["final_obs"]``, as Gymnasium's vector envs do. Of one that
        doesn't, they are what is given, which is written to.
        """
        infos: list[dict[str, Any]] = self.batch.info()
        chosen: list[int] = rows.tolist()
        for k, row in enumerate(chosen):
            env, sub_env = divmod(row, self.num_sub_envs)
            found = infos[env].get("final_obs")
            if found is not None and len(self.head) > 1:
                found = _one_of(found, sub_env)
            if found is not None:
                _write_row(otherwise, k, found)
        return otherwise


def _one_of(observations: Any, sub_env: int) -> Any:
    """Of sub-environments, whose observations are one tree, or an array of objects or None."""
    if isinstance(observations, np.ndarray):
        return cast("NDArray[Any]", observations)[sub_env]
    return mapped(lambda leaf: leaf[sub_env], observations)


def _write_row(tree: Tree, row: int, value: Any) -> None:
    if isinstance(tree, np.ndarray):
        tree[row] = value
        return
    for key in cast("dict[Any, Tree]", tree) if isinstance(tree, dict) else range(len(tree)):
        _write_row(tree[key], row, value[key])


def results_of(batch: BatchedData) -> Results:
    """The rows of `batch`, whose columns they are where these need no other shape."""
    is_reset = batch.is_reset
    head = is_reset.shape
    done = terminated = truncated = batch.done
    if isinstance(done, dict) or np.count_nonzero(done):  # Else none of them is true anywhere.
        terminated, truncated = batch.terminated, batch.truncated
        limit = batch.limit_reached
        if np.count_nonzero(limit):
            truncated = mapped(lambda leaf: leaf | limit, truncated)
    return Results(
        head,
        batch.index.reshape(-1),
        rows_of("observation", batch.observation, head),
        rows_of("reward", batch.reward, head),
        rows_of("terminated", terminated, head),
        rows_of("truncated", truncated, head),
        _of_all(done).reshape(-1),
        is_reset.reshape(-1),
        batch,
    )


def _of_all(done: Any) -> NDArray[np.bool_]:
    """Whether an episode is over for all of its agents."""
    if isinstance(done, dict):
        return np.logical_and.reduce(list(cast("dict[str, Any]", done).values()))
    return done
