"""`ResultRows`: a batch of results as columns with one row for each sub-environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio.batch.contents import ended_episodes
from rlightning_aio.batch.data import plain_columns
from rlightning_aio.batch.infos import infos_of_each, listed
from rlightning_aio.batch.parts import all_agents
from rlightning_aio.collecting.trees import rows_of, scattered
from rlightning_aio.trees import Tree, mapped

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData

Ended: TypeAlias = "tuple[int, float, int, dict[str, Any]]"
"""An episode that has ended: a row of `Rollout.episodes`."""


@dataclass(slots=True)
class ResultRows:
    """Rows of a batch of results.

    Attributes:
        head: the shape of the batch: ``(n,)``, or ``(m, num_envs)``.
        index: ``[n]``, index of each env in the group; see `BatchedData.index`.
        observation: tree of ``[n, *obs]``.
        outcome: reward, terminated and truncated by name: ``[n]``, or dicts of such by agent.
        done: ``[n]``, True if the episode is over for all of its agents.
        is_reset: ``[n]``.
        batch: the batch itself.
    """

    head: tuple[int, ...]
    index: NDArray[np.int64]
    observation: Tree
    outcome: dict[str, Any]
    done: NDArray[np.bool_]
    is_reset: NDArray[np.bool_]
    batch: BatchedData

    @property
    def num_sub_envs(self) -> int:
        """Number of rows of each result."""
        return self.head[1] if len(self.head) > 1 else 1

    def final_observation(self, rows: NDArray[np.intp], otherwise: Tree) -> Tree:
        """Return the final observations of `rows` whose env resets itself in the same step.

        They are in ``info["final_obs"]``, as with Gymnasium's vector envs. Where an env doesn't
        report any, the row of `otherwise` remains; the others are overwritten in place.
        """
        infos: list[dict[str, Any]] = self.batch.info()
        chosen: list[int] = rows.tolist()
        for k, row in enumerate(chosen):
            env, sub_env = divmod(row, self.num_sub_envs)
            found = infos[env].get("final_obs")
            if found is not None and len(self.head) > 1:
                found = _one_of(found, sub_env)
            if found is not None:
                scattered(otherwise, k, found)
        return otherwise

    def info(self, name: str) -> NDArray[np.float64]:
        """``[n]``, the number `name` of the info of each row, NaN where the info has none.

        If the env has reset itself in the same step, it is that of the ended episode.

        Raises:
            ValueError: a value isn't one number.
        """
        columns = self.batch.infos
        found = _numbers(name, columns, self.head)
        final = columns.get("final_info")
        if isinstance(final, dict):
            over = _spread(columns["_final_info"], self.head)
            found[over] = _numbers(name, cast("dict[str, Any]", final), self.head)[over]
        return found.reshape(-1)

    def episodes(self, rows: NDArray[np.intp]) -> list[Ended]:
        """Episodes that ended in `rows`."""
        count = self.num_sub_envs
        chosen: list[int] = rows.tolist()
        several = len(self.head) > 1
        found: list[Ended] = []
        reported = ended_episodes(self.batch, [row // count for row in chosen])
        for row, (sums, info) in zip(chosen, reported, strict=True):
            if not sums:
                continue
            total, length, own = sums["r"], sums["l"], info
            if several:
                sub_env = row % count
                total, length = total[sub_env], length[sub_env]
                own = listed(infos_of_each(info, count), count)[sub_env]
            own = own.get("final_info", own)
            found.append((int(self.index[row]), float(total), int(length), own))
        return found


def columns_of_episodes(ended: list[Ended]) -> dict[str, Any]:
    """Return the columns of `Rollout.episodes`."""
    return {
        "index": np.array([index for index, *_ in ended], np.int64),
        "total_reward": np.array([total for _, total, *_ in ended], np.float64),
        "length": np.array([length for *_, length, _ in ended], np.int64),
        "info": [info for *_, info in ended],
    }


def _numbers(name: str, columns: dict[str, Any], head: tuple[int, ...]) -> NDArray[np.float64]:
    found = np.full(head, np.nan)
    if name in columns:
        try:
            has_it = _spread(columns[f"_{name}"], head)
            found[has_it] = _spread(columns[name], head)[has_it].astype(np.float64)
        except (TypeError, ValueError):
            raise ValueError(
                f"info {name!r} can't be a column of a rollout: a column needs one number for each "
                f"transition; an info was {_example(columns[name])!r}"
            ) from None
    return found


def _example(column: Any) -> Any:
    """An example from a column of infos, for a message."""
    if isinstance(column, dict):
        return cast("dict[str, Any]", column)
    return next((value for value in column if value is not None), None)


def _spread(column: Any, head: tuple[int, ...]) -> NDArray[Any]:
    """Broadcast a column of infos to `head`; a vector env may report one value for all.

    Raises:
        ValueError: the values are arrays.
    """
    array = np.asarray(column)
    if array.shape == head[:1]:
        array = array.reshape(-1, *(1 for _ in head[1:]))
    return np.broadcast_to(array, head)


def _one_of(observations: Any, sub_env: int) -> Any:
    """Take one sub-environment's observation from a tree, or from an array of objects or None."""
    if isinstance(observations, np.ndarray):
        return cast("NDArray[Any]", observations)[sub_env]
    return mapped(lambda leaf: leaf[sub_env], observations)


def result_rows(batch: BatchedData) -> ResultRows:
    """Return the rows of `batch`, as views of its columns where possible."""
    source = plain_columns(batch)
    if source is None:
        source = batch
    is_reset = source.is_reset
    head = is_reset.shape
    done = terminated = truncated = source.done
    if isinstance(done, dict) or len(done.nonzero()[0]):  # Otherwise all flags are False.
        terminated, truncated = source.terminated, source.truncated
    columns = {"reward": source.reward, "terminated": terminated, "truncated": truncated}
    outcome = rows_of({"observation": source.observation, **columns}, head, ("observation",))
    observation = outcome.pop("observation")
    index, done, is_reset = source.index, all_agents(done), is_reset.reshape(-1)
    return ResultRows(
        head, index.reshape(-1), observation, outcome, done.reshape(-1), is_reset, batch
    )
