"""`ActionChunks`: plays chunks of actions, each env its own: open loop, or averaged.

Rule: a chunk belongs to one episode of one env. What is left of it is dropped when the episode is
over, also when it was lost with a worker.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.errors import BadAction
from rlightning_aio.policies.episodes import begins_of_envs
from rlightning_aio.trees import Tree, as_array, index, mapped, stacked, walked, zipped

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData


@dataclass(slots=True)
class _Left:
    """Actions that an env plays, of how many each is the average, and how many were played."""

    actions: Tree
    counts: NDArray[np.int64]
    played: int = 0

    def __len__(self) -> int:
        return len(self.counts) - self.played

    def next(self) -> Tree:
        self.played += 1
        return index(self.actions, self.played - 1)


class ActionChunks:
    """Plays the chunks of actions that a policy returns, one action at each step.

    The policy is called with the envs that have no action left: those that begin an episode, and
    those that have played their chunk.

    Args:
        policy: called with a batch of results; returns chunks of actions, ``[n, horizon, *action]``
            (a dict or tuple of such arrays for Dict and Tuple spaces). It may be a coroutine
            function if the group is asynchronous.
        n_action_steps: number of actions to play of each chunk; None plays all.
        temporal_ensemble: ask for a chunk at each step, and play the average of all that was
            predicted for it since the episode began, with the weights ``exp(-temporal_ensemble *
            k)``, k = 0 for the oldest one (ACT; 0.01 in its paper).

    Raises:
        ValueError: `n_action_steps` is below 1, or not None beside `temporal_ensemble`, or an env
            has sub-environments.
        BadAction: the policy did not return a chunk of enough actions for each result, or those
            that are averaged are not floats.
    """

    def __init__(
        self,
        policy: Callable[[BatchedData], Any],
        n_action_steps: int | None = None,
        *,
        temporal_ensemble: float | None = None,
    ) -> None:
        if n_action_steps is not None and n_action_steps < 1:
            raise ValueError(f"n_action_steps must be at least 1, not {n_action_steps!r}")
        if None not in (n_action_steps, temporal_ensemble):
            raise ValueError(
                "with temporal_ensemble every step asks for a chunk: no n_action_steps"
            )
        self._policy, self._steps, self._decay = policy, n_action_steps, temporal_ensemble
        self._left: dict[str, _Left] = {}

    def __call__(self, batch: BatchedData) -> Any:
        """Return the next action of each env, awaitable if the policy's answer is."""
        env_ids = batch.env_ids()
        for row in np.flatnonzero(begins_of_envs(batch)).tolist():
            self._left.pop(env_ids[row], None)
        rows = [
            row
            for row, env_id in enumerate(env_ids)
            if self._decay is not None or not self._left.get(env_id)
        ]
        if not rows:
            return self._next(env_ids)
        asked = batch if len(rows) == len(env_ids) else batch.take(rows)
        answer = self._policy(asked)
        if hasattr(answer, "__await__"):
            return self._awaited(answer, asked.env_ids(), env_ids)
        self._keep(answer, asked.env_ids())
        return self._next(env_ids)

    async def _awaited(self, answer: Awaitable[Any], asked: list[str], env_ids: list[str]) -> Any:
        self._keep(await answer, asked)
        return self._next(env_ids)

    def _keep(self, chunks: Any, env_ids: list[str]) -> None:
        """Keep a chunk for each env."""
        lengths = set[int]()
        chunks = mapped(lambda leaf: _checked(leaf, len(env_ids), lengths), chunks)
        if self._decay is not None and any(leaf.dtype.kind != "f" for _, leaf in walked(chunks)):
            raise BadAction("temporal_ensemble averages actions, so they must be floats")
        horizon = min(lengths, default=0)
        if len(lengths) > 1 or not horizon:
            raise BadAction(f"the actions of a chunk are as many as {sorted(lengths)}")
        if self._steps is not None and self._steps > horizon:
            raise BadAction(
                f"the policy's chunks have {horizon} actions, fewer than "
                f"n_action_steps={self._steps}"
            )
        count = self._steps or horizon
        for row, env_id in enumerate(env_ids):
            own = _Left(mapped(lambda leaf, k=row: leaf[k], chunks), np.ones(count, np.int64))
            if self._decay is not None and env_id in self._left:
                _average(self._left[env_id], own, self._decay)
            self._left[env_id] = own

    def _next(self, env_ids: list[str]) -> Any:
        return stacked([self._left[env_id].next() for env_id in env_ids])


def _average(before: _Left, now: _Left, decay: float) -> None:
    """Add a new chunk to the averages of those that were predicted before for the same steps."""
    counts = before.counts[before.played :][: len(now)]
    size = len(counts)
    most: int = counts.max(initial=0)
    weights = np.exp(-decay * np.arange(most + 1))
    shares = (weights / weights.cumsum())[counts]

    def moved(old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
        old = old[before.played :][:size]
        new[:size] = old + (shares * (new[:size] - old).T).T
        return new

    zipped(moved, before.actions, now.actions)
    now.counts[:size] += counts


def _checked(leaf: Any, count: int, lengths: set[int]) -> NDArray[Any]:
    """Copy a leaf of chunks, which a policy may overwrite, and add the number of their actions."""
    array = np.array(as_array(leaf))
    if array.ndim < 2 or len(array) != count:
        raise BadAction(
            f"the policy returned {array.shape}; chunks of actions for {count} envs should be "
            f"({count}, horizon, *action)"
        )
    lengths.add(array.shape[1])
    return array
