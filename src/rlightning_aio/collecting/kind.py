"""`EnvKind`: envs whose transitions share columns, and their policy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.batch import BatchedData, joined
from rlightning_aio.batch.data import columns_of_responses
from rlightning_aio.collecting.results import ResultRows, columns_of_episodes, result_rows
from rlightning_aio.collecting.rollout import Rollout
from rlightning_aio.collecting.staging import Staging
from rlightning_aio.collecting.trees import allocated, gathered, rows_of
from rlightning_aio.errors import BadAction
from rlightning_aio.policies.answers import answers_of
from rlightning_aio.protocol.columns import gather, is_array
from rlightning_aio.trees import is_dict, is_tuple, mapped, zipped

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.trees import Tree
    from rlightning_aio.types import EnvMeta


@dataclass(slots=True, eq=False)
class Part:
    """The results of one batch from envs of one kind.

    Attributes:
        unstored: rows of `results` whose transitions are not stored yet.
    """

    kind: EnvKind
    batch: BatchedData
    results: ResultRows
    unstored: NDArray[np.intp]

    def store(self, room: int) -> int:
        """Complete at most `room` of the transitions that end here; return their number."""
        staging = self.kind.staging
        before = staging.complete
        self.unstored = staging.store(self.results, self.unstored, room)
        return staging.complete - before

    def waiting_for_reset(self) -> list[str]:
        """Ids of envs whose episode is over."""
        over = self.kind.staging.over(self.results.index)
        if not np.count_nonzero(over):
            return []
        env_ids = self.batch.env_ids()
        return [env_ids[row] for row in np.flatnonzero(over).tolist()]

    def steps(self) -> NDArray[np.int64]:
        """Number of transitions that each env has made for the rollout."""
        return self.kind.staging.made[self.results.index]

    def behind(self, steps: int) -> Part | None:
        """The part whose envs have made fewer than `steps` transitions; None without any."""
        fewer = (self.steps() < steps).reshape(len(self.batch), -1)
        return self.only(np.logical_or.reduce(fewer, axis=1))

    def only(self, chosen: NDArray[np.bool_]) -> Part | None:
        """The part of the envs in the mask `chosen`; None without any."""
        (rows,) = chosen.nonzero()
        if len(rows) == len(chosen):
            return self
        if not len(rows):
            return None
        return self.kind.part(self.batch.take(rows.tolist()))


class EnvKind:
    """Envs that share a policy and a set of columns.

    Args:
        policy: acts in these envs.
        quota: maximum number of transitions of a rollout.
        meta_of: returns the meta of an env.
        infos: names of numbers in infos that become columns.

    Attributes:
        num_steps: transitions of each env in a block; 0 for chains of any length.
        held: for blocks, the newest results of all envs.
    """

    def __init__(
        self,
        policy: Callable[[BatchedData], Any],
        quota: int,
        meta_of: Callable[[str], EnvMeta],
        infos: Sequence[str],
    ) -> None:
        self.policy = policy
        self._meta_of = meta_of
        self._env_ids: dict[int, str] = {}
        self.quota = quota
        self.num_steps = 0
        self.held: Part | None = None
        self._action_space: gym.Space[Any] | None = None
        self.staging = Staging(quota, infos)
        self._taken = OWN_NAMES.union(infos)
        # Two sets, so that one rollout can be read while the next one is collected.
        self._sets: list[dict[str, Tree]] = [{}, {}]

    def part(self, batch: BatchedData) -> Part:
        """Convert a batch to rows, and make room for envs that are new."""
        results = result_rows(batch)
        new = self.staging.newcomers(results.index)
        if len(new):
            self._meet(batch, results, new)
        return Part(self, batch, results, np.arange(len(results.index)))

    def _meet(self, batch: BatchedData, results: ResultRows, rows: NDArray[np.intp]) -> None:
        """Record the autoreset mode of envs that are in `rows` for the first time."""
        env_ids = batch.env_ids()
        newcomers: list[int] = rows.tolist()
        for row in newcomers:
            self._env_ids[int(results.index[row])] = env_ids[row // results.num_sub_envs]
            meta = self._meta_of(env_ids[row // results.num_sub_envs])
            self._action_space = meta.action_space
            if meta.autoreset == "same_step":
                self.staging.note_same_step(results.index[row])

    def hold(self, part: Part) -> None:
        """Keep `part` as the newest results of its envs."""
        if self.held is None or np.array_equal(self.held.results.index, part.results.index):
            self.held = part
            return
        both = [one.results.index.reshape(len(one.batch), -1)[:, 0] for one in (part, self.held)]
        _, rows = np.unique(np.concatenate(both), return_index=True)  # The first, so the newer one.
        self.held = self.part(joined([part.batch, self.held.batch]).take(rows.tolist()))

    def columns_of(self, part: Part, answer: Any) -> tuple[BatchedData, dict[str, Tree]]:
        """Convert the policy's answer for `part` to a batch of responses, and to columns.

        Raises:
            ValueError, TypeError: the answer doesn't fit (`BadAction` is a ValueError).
        """
        answers = answers_of(part.batch, answer, self._action_space)
        given = columns_of_responses(answers[0])
        if given is None or (
            isinstance(answer, BatchedData | list) and _answered(answers) != part.batch.env_ids()
        ):
            raise BadAction(
                "a Collector's policy answers all results of its batch in their order; return "
                "batch.respond(action=…, …) of that very batch"
            )
        for name in self._taken & given.keys():
            raise ValueError(
                f"a rollout already has {name!r}; give the policy's column another name"
            )
        space, plain = self._action_space, tuple[str, ...]()
        stored: dict[str, Any] = {**given}
        if space is not None and not (is_dict(space) or is_tuple(space)):
            if not is_array(space):
                plain = ("action",)
            elif isinstance(given["action"], list):
                stored["action"] = np.asarray(cast("list[Any]", given["action"]))
        columns = rows_of(stored, part.results.head, plain)
        columns["observation"] = part.results.observation
        self.staging.check(columns)
        return answers[0], columns

    def rollout(self, held: ResultRows | None, version: int) -> Rollout:
        """Return the completed transitions as columns.

        `held` has the results without an answer; `version` is that of the newest policy.
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
        if len(ends):
            end_observation = gather(staging.end_observation, full.end_rows)
        else:
            end_observation = mapped(lambda leaf: leaf[:0], columns["observation"])
        columns["lag"] = version - columns["policy_version"]
        episodes = columns_of_episodes(staging.episodes)
        staging.carry_over()
        return Rollout(columns, ends, end_observation, episodes, dict(self._env_ids))

    def _columns(self, order: NDArray[np.intp], shape: tuple[int, ...]) -> dict[str, Tree]:
        outs = self._sets.pop(0)
        self._sets.append(outs)
        staging = self.staging
        count = len(order)

        def shaped(leaf: NDArray[Any]) -> NDArray[Any]:
            return leaf[:count].reshape(*shape, *leaf.shape[1:])

        if not outs:
            outs |= allocated(staging.columns, self.quota)
        gathered(staging.columns, order, outs)
        columns = mapped(shaped, outs)
        columns["done"] = zipped(np.bitwise_or, columns["terminated"], columns["truncated"])
        return columns


OWN_NAMES: Final = frozenset(
    {"done", "end_observation", "ends", "env_ids", "episodes", "first", "index", "lag"}
    | {"num_chains", "observation", "policy_version", "reward", "shape", "terminated"}
    | {"truncated", "advantages", "keys", "next_observation", "vtrace"}
)
"""Names that neither a policy nor an info may give to a column of a rollout."""


def _answered(answers: list[BatchedData]) -> list[str]:
    return answers[0].env_ids() if len(answers) == 1 else []
