"""`Kind`: envs whose transitions share columns, with the policy that acts in them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.batch import joined
from rlightning_aio.collecting.results import Results, results_of
from rlightning_aio.collecting.rollout import Lag, Rollout, Seconds
from rlightning_aio.collecting.staging import Staging
from rlightning_aio.collecting.trees import allocated, rows_of
from rlightning_aio.protocol.columns import gather, mapped

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.protocol.columns import Tree
    from rlightning_aio.types import EnvMeta

__all__ = ["Kind", "Part"]


@dataclass(slots=True)
class Part:
    """Results of one kind that are there together.

    Attributes:
        unstored: rows of `results` whose transitions are in no rollout yet.
    """

    kind: Kind
    batch: BatchedData
    results: Results
    unstored: NDArray[np.intp]

    def store(self, room: int) -> None:
        """Complete the transitions that end here, `room` at most."""
        self.unstored = self.kind.staging.store(self.results, self.unstored, room)

    def waiting_for_reset(self) -> list[str]:
        """The envs whose episode is over."""
        over = self.kind.staging.over(self.results.index)
        if not np.count_nonzero(over):
            return []
        env_ids = self.batch.env_ids()
        return [env_ids[row] for row in np.flatnonzero(over).tolist()]

    def steps(self) -> NDArray[np.int64]:
        """How many transitions of the rollout each env has made."""
        return self.kind.staging.made[self.results.index]

    def behind(self, steps: int) -> Part | None:
        """The envs that have made fewer than `steps`; None if there are none."""
        envs = len(self.batch)
        fewer = (self.steps() < steps).reshape(envs, -1).any(axis=1)
        if not np.count_nonzero(fewer):
            return None
        return (
            self if fewer.all() else self.kind.part(self.batch.take(np.flatnonzero(fewer).tolist()))
        )


class Kind:
    """One set of columns.

    Args:
        policy: what answers these envs.
        quota: transitions of a rollout, at most.
        meta_of: what the env of an id is like; None of one that has left unseen.

    Attributes:
        num_steps: transitions of each env in a block; 0 where chains have any length.
        held: the newest results of all envs; in blocks only.
    """

    def __init__(
        self,
        policy: Callable[[BatchedData], Any],
        quota: int,
        meta_of: Callable[[str], EnvMeta | None],
    ) -> None:
        self.policy = policy
        self._meta_of = meta_of
        self.quota = quota
        self.num_steps = 0
        self.held: Part | None = None
        self.staging = Staging(quota, 0)
        # Two sets, so that one rollout can be read while the next one is collected.
        self._sets: list[dict[str, Tree]] = [{}, {}]

    def part(self, batch: BatchedData) -> Part:
        """Take in a batch."""
        results = results_of(batch)
        new = self.staging.newcomers(results.index)
        if len(new):
            self._meet(batch, results, new)
        return Part(self, batch, results, np.arange(len(results.index)))

    def _meet(self, batch: BatchedData, results: Results, rows: NDArray[np.intp]) -> None:
        """Learn what those envs are like which are in `rows` for the first time."""
        env_ids = batch.env_ids()
        newcomers: list[int] = rows.tolist()
        for row in newcomers:
            meta = self._meta_of(env_ids[row // results.num_sub_envs])
            if meta is not None and meta.autoreset == "same_step":
                self.staging.note_same_step(results.index[row])

    def hold(self, part: Part) -> None:
        """Keep results as the newest of their envs."""
        if self.held is None or len(part.batch) == len(self.held.batch):
            self.held = part
            return
        count = len(self.held.batch)
        first = self.held.results.index.reshape(count, -1)[:, 0]
        newer = part.results.index.reshape(len(part.batch), -1)[:, 0]
        rows = np.arange(count)
        rows[np.searchsorted(first, newer)] = count + np.arange(len(newer))
        self.held = self.part(joined([self.held.batch, part.batch]).take(rows.tolist()))

    def columns_of(self, part: Part, answer: Any) -> tuple[BatchedData, dict[str, Tree]]:
        """What the policy answered for `part`, as a batch of responses, and as columns.

        Raises:
            ValueError, TypeError: it doesn't fit.
        """
        try:
            given = dict(answer)
        except (TypeError, ValueError):
            raise TypeError(
                "a policy returns columns by name, as {'action': actions, 'value': values}, not a "
                f"{type(answer).__name__}"
            ) from None
        if "action" not in given:
            names = ", ".join(map(repr, given)) or "nothing"
            raise ValueError(f"a policy returns columns by name, including 'action', not {names}")
        for name in _OWN & given.keys():
            raise ValueError(f"a rollout has a column {name!r} of its own; rename the policy's")
        head = part.results.head
        columns = {name: rows_of(name, column, head) for name, column in given.items()}
        columns["observation"] = part.results.observation
        self.staging.check(columns)
        return part.batch.respond(**given), columns

    def rollout(self, held: Results | None, version: int, seconds: Seconds) -> Rollout:
        """What has been completed, as columns.

        `held` are results that are still to be answered, `version` is the newest policy's.
        """
        staging = self.staging
        full = staging.full(held)
        order, ends, shape = full.order, full.ends, (len(full.order),)
        if self.num_steps:
            steps, envs = self.num_steps, len(order) // self.num_steps
            order = order.reshape(envs, steps).T.reshape(-1)
            ends = ends % steps * envs + ends // steps
            shape = (steps, envs)
        columns = self._columns(order, shape)
        end_observation = mapped(lambda leaf: leaf[:0], columns["observation"])
        if len(ends):
            end_observation = gather(staging.end_observation, full.end_rows)
        lag = _lag(version - columns["policy_version"])
        staging.carry_over()
        return Rollout(columns, shape, ends, end_observation, full.num_chains, lag, seconds)

    def _columns(self, order: NDArray[np.intp], shape: tuple[int, ...]) -> dict[str, Tree]:
        outs = self._sets.pop(0)
        self._sets.append(outs)
        staging = self.staging
        count = len(order)

        def shaped(leaf: NDArray[Any]) -> NDArray[Any]:
            return leaf[:count].reshape(*shape, *leaf.shape[1:])

        columns: dict[str, Tree] = {}
        for name, column in staging.columns.items():
            if name not in outs:
                outs[name] = allocated(column, self.quota)
            staging.read(name, order, outs[name])
            columns[name] = mapped(shaped, outs[name])
        columns["done"] = _either(columns["terminated"], columns["truncated"])
        for name, column in staging.of_places(order).items():
            columns[name] = column.reshape(shape)
        return columns


_OWN = frozenset(
    {"done", "end_observation", "ends", "first", "index", "lag", "num_chains", "observation"}
    | {"policy_version", "reward", "seconds", "segments", "shape", "terminated", "truncated"}
    | {"advantages", "at_ends", "keys", "next_observation", "vtrace"}
)


def _lag(ages: NDArray[np.int64]) -> Lag:
    if not ages.size:
        return Lag(0, 0.0, 0)
    return Lag(int(ages.min()), float(ages.mean()), int(ages.max()))


def _either(one: Any, other: Any) -> Any:
    if isinstance(one, dict):
        ends = cast("dict[str, Any]", one)
        return {agent: end | other[agent] for agent, end in ends.items()}
    return one | other
