"""Running normalisation of observations and rewards, in the trainer.

All envs of a group share one mean and one variance, by the formulas of Gymnasium's
`NormalizeObservation` and `NormalizeReward` of vector envs. Unlike theirs, the discounted return
starts again with each episode: Gymnasium's drops what was before a termination one step early, and
never starts again after a truncation. A batch takes a few operations on whole arrays; workers do
nothing. Left out: torch, whose CPU tensors share the arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from gymnasium.wrappers.utils import RunningMeanStd

from rlightning_aio.trees import Path, mapped, walked

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData

__all__ = ["Normalizer"]

_LIMIT: Final = 10.0
_EPSILON: Final = 1e-8
_FIRST_COUNT: Final = 1e-4
# Gymnasium's wrapper of observations starts its sum of squares as this float32.
_FIRST_VARIANCE: Final = float(np.float32(_FIRST_COUNT)) / _FIRST_COUNT
_RETURN: Final = "return"
_SAVED: Final = ("mean", "var", "count")


class Normalizer:
    """Running normalisation of the observations and rewards of many envs.

    Observations become ``(observation - mean) / deviation``, rewards are divided by the deviation
    of the discounted return; both are clipped to ±10. In Dict and Tuple observations each array
    has its own statistics. Arrays of floats are normalised and become float32. Integers (images,
    discrete values), texts and other objects are returned unchanged.

    Call `observe` in the policy, with each batch. The statistics change with each batch, so let
    the rollout keep what the policy saw, and let the learner learn from that:

        normalizer = Normalizer(gamma=0.99)

        def policy(batch):
            seen = normalizer.observe(batch)
            return {"action": act(seen), "seen": seen}

        rollout = collector.collect()
        rewards = normalizer.scaled(rollout.reward)
        after = normalizer.normalized(rollout.end_observation)

    To save it, pass ``normalizer.state_dict()`` to `numpy.savez`; to continue, pass what
    `numpy.load` returns to `load_state_dict`.

    Args:
        gamma: the discount of the returns.
        observations: False only converts arrays of floats to float32.
        rewards: False leaves rewards unchanged.
    """

    def __init__(
        self, gamma: float = 0.99, *, observations: bool = True, rewards: bool = True
    ) -> None:
        self.gamma = gamma
        self._observations, self._rewards = observations, rewards
        # By the keys that lead to an array; and that of the discounted returns. RunningMeanStd has
        # no annotations.
        self._statistics: dict[str, Any] = {}
        self._sums = np.zeros(0)  # By env: the discounted return so far.

    # -- with an update -----------------------------------------------------------

    def observe(self, batch: BatchedData) -> Any:
        """Add the results of `batch` to the statistics, and return its observations normalised.

        Rows that are resets add no reward, and the discounted return starts again after the end
        of an episode, and where one was lost with its worker.

        Raises:
            TypeError: the batch has rewards of several agents.
        """
        if self._rewards:
            self._observe_rewards(batch)
        return self.update_observations(batch.observation, batch.index.ndim)

    def _observe_rewards(self, batch: BatchedData) -> None:
        reward: Any = batch.reward
        if isinstance(reward, dict):
            raise TypeError("rewards of several agents can't be normalised; give rewards=False")
        index, is_reset = batch.index.reshape(-1), batch.is_reset.reshape(-1)
        self._make_room(index)
        self._sums[index[is_reset]] = 0
        self.update_rewards(index[~is_reset], reward.reshape(-1)[~is_reset])
        self._sums[index[batch.done.reshape(-1)]] = 0

    def update_observations(self, observation: Any, axes: int = 1) -> Any:
        """Add observations to the statistics, and return them normalised.

        Args:
            observation: an array, or dicts and tuples of arrays: ``[n, *obs]``.
            axes: number of leading axes, more than one for ``[m, num_envs, *obs]``.
        """

        def updated(path: str, leaf: NDArray[Any]) -> NDArray[np.float32]:
            shape = leaf.shape[axes:]
            if path not in self._statistics:
                known = self._statistics[path] = RunningMeanStd(_FIRST_COUNT, shape)
                known.var = np.full(shape, _FIRST_VARIANCE)
            if leaf.size:
                self._statistics[path].update(leaf.reshape(-1, *shape))
            return self._normal(path, leaf)

        return self._normalised(updated, observation)

    def update_rewards(
        self,
        index: NDArray[np.int64],
        reward: NDArray[Any],
        starts: NDArray[np.bool_] | bool = False,
    ) -> NDArray[Any]:
        """Add one reward of each env in `index`, and return them scaled.

        Args:
            index: ``[n]``, which envs, each once; see `BatchedData.index`.
            reward: ``[n]``.
            starts: ``[n]``, whether the discounted return starts again with this reward.
        """
        if not self._rewards:
            return reward
        self._make_room(index)
        self._sums[index] = sums = self._sums[index] * self.gamma * (1 - starts) + reward
        known = self._statistics.setdefault(_RETURN, RunningMeanStd(_FIRST_COUNT))
        if len(sums):
            known.update(sums)
        return self.scaled(reward)

    # -- without ------------------------------------------------------------------

    def normalized(self, observation: Any) -> Any:
        """Observations normalised by the present statistics, which don't change.

        Args:
            observation: an array, or dicts and tuples of arrays, with any leading axes:
                ``[…, *obs]``.
        """
        return self._normalised(self._normal, observation)

    def scaled(self, reward: NDArray[Any]) -> NDArray[Any]:
        """Rewards of any shape, scaled by the present statistics, which don't change."""
        known = self._statistics.get(_RETURN)
        if not self._rewards or known is None:
            return reward
        return np.clip(reward / np.sqrt(known.var + _EPSILON), -_LIMIT, _LIMIT)

    # -- saving -------------------------------------------------------------------

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Copies of the statistics, as arrays by name."""
        state = {"sums": self._sums}
        for path, statistics in self._statistics.items():
            for name in _SAVED:
                state[f"{path}.{name}"] = getattr(statistics, name)
        return {name: np.array(array) for name, array in state.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` returned: arrays, or CPU tensors.

        Raises:
            KeyError: `state` lacks a part; nothing was changed.
        """
        sums = _copied(state["sums"])
        found: dict[str, Any] = {}
        for path in (name.removesuffix(".mean") for name in state if name.endswith(".mean")):
            found[path] = RunningMeanStd()
            for name in _SAVED:
                setattr(found[path], name, _copied(state[f"{path}.{name}"]))
        self._sums, self._statistics = sums, found

    # -- parts --------------------------------------------------------------------

    def _normalised(self, function: Callable[[str, NDArray[Any]], Any], observation: Any) -> Any:
        """Apply `function` to the keys that lead to each array of floats, and to the array."""

        def found(path: Path, leaf: Any) -> Any:
            if type(leaf) is not np.ndarray or leaf.dtype.kind != "f":
                return leaf
            if not self._observations:
                return leaf.astype(np.float32, copy=False)
            return function("/".join(map(str, ("observation", *path))), leaf)

        leaves = iter([found(path, leaf) for path, leaf in walked(observation)])
        return mapped(lambda _: next(leaves), observation)

    def _normal(self, path: str, values: NDArray[Any]) -> NDArray[np.float32]:
        known = self._statistics.get(path)
        if known is None:
            return values.astype(np.float32)
        found = (values - known.mean) / np.sqrt(known.var + _EPSILON)
        return np.clip(found.astype(np.float32), -_LIMIT, _LIMIT)

    def _make_room(self, index: NDArray[np.int64]) -> None:
        more = int(index.max(initial=-1)) + 1 - len(self._sums)
        if more > 0:
            self._sums = np.concatenate([self._sums, np.zeros(more)])


def _copied(array: Any) -> NDArray[Any]:
    return np.asarray(array).copy()  # Not `np.array`, which PyTorch's tensors warn about.
