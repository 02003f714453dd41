"""Running normalisation of observations and rewards, in the trainer.

Each env has its own statistics, by the formulas of Gymnasium's `NormalizeObservation` and
`NormalizeReward` around each env. Unlike theirs, the discounted return starts again with each
episode: Gymnasium's drops what was before a termination one step early, and never starts again
after a truncation. A batch takes a few operations on whole arrays; workers do nothing. Left out:
torch, whose CPU tensors share the arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

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


class _Statistics:
    """Mean and variance of the values of each env: ``[num_envs, *shape]``."""

    def __init__(self, shape: tuple[int, ...], first_variance: float) -> None:
        self._first_variance = first_variance
        self.mean = np.zeros((0, *shape))
        self.variance = np.zeros((0, *shape))
        self.count = np.zeros((0, *(1 for _ in shape)))

    def make_room(self, num_envs: int) -> None:
        """Add envs without values, so that there are `num_envs` or more."""
        more = num_envs - len(self.mean)
        if more > 0:
            for name, first in (
                ("mean", 0.0), ("variance", self._first_variance), ("count", _FIRST_COUNT),
            ):  # fmt: skip
                known = getattr(self, name)
                new = np.full((more, *known.shape[1:]), first)
                setattr(self, name, np.concatenate([known, new]))

    def update(self, index: NDArray[np.int64], values: NDArray[Any]) -> None:
        """Add one value of each env in `index`, where each occurs once."""
        mean, count = self.mean[index], self.count[index]
        total = count + 1.0
        delta = values - mean
        squares = self.variance[index] * count + np.square(delta) * count / total
        self.mean[index] = mean + delta / total
        self.variance[index] = squares / total
        self.count[index] = total

    def of(self, index: NDArray[np.int64] | None) -> tuple[NDArray[Any], NDArray[Any]]:
        """Mean and variance of each env in `index`; of all values of all envs, if it is None."""
        if index is not None:
            self.make_room(int(index.max(initial=-1)) + 1)
            return self.mean[index], self.variance[index]
        weight = self.count / self.count.sum(axis=0)
        mean = (self.mean * weight).sum(axis=0)
        return mean, ((self.variance + np.square(self.mean - mean)) * weight).sum(axis=0)


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
        rewards = normalizer.scaled(rollout.reward, rollout.index)
        after = normalizer.normalized(rollout.end_observation, rollout.at_ends("index"))

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
        # By the keys that lead to an array; and that of the discounted returns.
        self._statistics: dict[str, _Statistics] = {}
        # By env: the discounted return so far, and whether the next reward starts an episode.
        self._sums = np.zeros(0)
        self._starts = np.zeros(0, np.bool_)

    # -- with an update -----------------------------------------------------------

    def observe(self, batch: BatchedData) -> Any:
        """Add the results of `batch` to the statistics, and return its observations normalised.

        Rows that are resets add no reward, and the discounted return starts again after the end
        of an episode, and where one was lost with its worker.

        Raises:
            TypeError: the batch has rewards of several agents.
        """
        index = batch.index
        if self._rewards:
            self._observe_rewards(batch, index.reshape(-1))
        return self.update_observations(index, batch.observation)

    def _observe_rewards(self, batch: BatchedData, index: NDArray[np.int64]) -> None:
        reward: Any = batch.reward
        if isinstance(reward, dict):
            raise TypeError("rewards of several agents can't be normalised; give rewards=False")
        self._make_room(index)
        is_reset = batch.is_reset.reshape(-1)
        self._starts[index[is_reset]] = True
        stepped = ~is_reset
        index = index[stepped]
        self.update_rewards(index, reward.reshape(-1)[stepped], self._starts[index])
        self._starts[index] = batch.done.reshape(-1)[stepped]

    def update_observations(self, index: NDArray[np.int64], observation: Any) -> Any:
        """Add one observation of each env in `index`, and return them normalised.

        Args:
            index: which envs, each once; see `BatchedData.index`.
            observation: an array, or dicts and tuples of arrays: ``[*index.shape, *obs]``.
        """

        def updated(path: str, leaf: NDArray[Any]) -> NDArray[np.float32]:
            statistics = self._of(path, leaf.shape[index.ndim :], _FIRST_VARIANCE)
            statistics.make_room(int(index.max(initial=-1)) + 1)
            statistics.update(
                index.reshape(-1), leaf.reshape(index.size, *leaf.shape[index.ndim :])
            )
            return _normal(leaf, *statistics.of(index))

        return self._normalised(updated, observation)

    def update_rewards(
        self, index: NDArray[np.int64], reward: NDArray[Any], starts: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """Add one reward of each env in `index`, and return them scaled.

        Args:
            index: ``[n]``, which envs, each once.
            reward: ``[n]``.
            starts: ``[n]``, whether the discounted return starts again with this reward.
        """
        if not self._rewards:
            return reward
        self._make_room(index)
        self._sums[index] = sums = self._sums[index] * self.gamma * (1 - starts) + reward
        statistics = self._of(_RETURN, (), 1.0)
        statistics.make_room(len(self._sums))
        statistics.update(index, sums)
        return self.scaled(reward, index)

    # -- without ------------------------------------------------------------------

    def normalized(self, observation: Any, index: NDArray[np.int64] | None = None) -> Any:
        """Observations normalised by the present statistics, which don't change.

        Args:
            observation: an array, or dicts and tuples of arrays: ``[*index.shape, *obs]``.
            index: which env each is of; one may occur more than once. None uses the statistics
                of all envs together, for envs that took no part: an evaluation's.
        """

        def found(path: str, leaf: NDArray[Any]) -> NDArray[np.float32]:
            known = self._statistics.get(path)
            return leaf.astype(np.float32) if known is None else _normal(leaf, *known.of(index))

        return self._normalised(found, observation)

    def scaled(self, reward: NDArray[Any], index: NDArray[np.int64] | None = None) -> NDArray[Any]:
        """Rewards scaled by the present statistics; arguments as of `normalized`."""
        known = self._statistics.get(_RETURN)
        if not self._rewards or known is None:
            return reward
        _, variance = known.of(index)
        return np.clip(reward / np.sqrt(variance + _EPSILON), -_LIMIT, _LIMIT)

    # -- saving -------------------------------------------------------------------

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Copies of the statistics, as arrays by name."""
        state = {"sums": self._sums, "starts": self._starts}
        for path, statistics in self._statistics.items():
            for name in _SAVED:
                state[f"{path}.{name}"] = getattr(statistics, name)
        return {name: array.copy() for name, array in state.items()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from what `state_dict` returned: arrays, or CPU tensors.

        Raises:
            KeyError: `state` lacks a part; nothing was changed.
        """
        sums, starts = _copied(state["sums"]), _copied(state["starts"])
        found: dict[str, _Statistics] = {}
        for path in (name.removesuffix(".mean") for name in state if name.endswith(".mean")):
            first = 1.0 if path == _RETURN else _FIRST_VARIANCE
            mean = np.asarray(state[f"{path}.mean"])
            found[path] = _Statistics(mean.shape[1:], first)
            for name in _SAVED:
                setattr(found[path], name, _copied(state[f"{path}.{name}"]))
        self._sums, self._starts, self._statistics = sums, starts, found

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

    def _of(self, path: str, shape: tuple[int, ...], first_variance: float) -> _Statistics:
        if path not in self._statistics:
            self._statistics[path] = _Statistics(shape, first_variance)
        return self._statistics[path]

    def _make_room(self, index: NDArray[np.int64]) -> None:
        more = int(index.max(initial=-1)) + 1 - len(self._sums)
        if more > 0:
            self._sums = np.concatenate([self._sums, np.zeros(more)])
            self._starts = np.concatenate([self._starts, np.ones(more, np.bool_)])


_SAVED: Final = ("mean", "variance", "count")


def _normal(
    values: NDArray[Any], mean: NDArray[Any], variance: NDArray[Any]
) -> NDArray[np.float32]:
    found = (values - mean) / np.sqrt(variance + _EPSILON)
    return np.clip(found.astype(np.float32), -_LIMIT, _LIMIT)


def _copied(array: Any) -> NDArray[Any]:
    return np.asarray(array).copy()  # Not `np.array`, which PyTorch's tensors warn about.
