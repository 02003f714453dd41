"""Running normalisation of observations and rewards in the trainer; not an example itself.

Each environment has its own statistics, as with Gymnasium's `NormalizeObservation` and
`NormalizeReward` around each, and the results equal theirs bit for bit. The results of a batch
are normalised with a few operations on whole arrays, and workers do nothing for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from numpy.typing import NDArray

LIMIT = 10.0
EPSILON = 1e-8
FIRST_COUNT = 1e-4


class Statistics:
    """Mean and variance of what each environment has shown so far.

    Args:
        num_envs: rows of `mean` and `variance`.
        shape: of one value.
        first_variance: before there is any.
    """

    def __init__(self, num_envs: int, shape: tuple[int, ...], first_variance: float = 1.0) -> None:
        self.mean = np.zeros((num_envs, *shape))
        self.variance = np.full((num_envs, *shape), first_variance)
        self.count = np.full((num_envs, *(1 for _ in shape)), FIRST_COUNT)

    def update(self, index: NDArray[np.intp], values: NDArray[Any]) -> NDArray[Any]:
        """Take in a value of each env in `index` (each once); their variances."""
        mean, count = self.mean[index], self.count[index]
        total = count + 1.0
        delta = values - mean
        squares = self.variance[index] * count + np.square(delta) * count / total
        self.mean[index] = mean + delta / total
        self.variance[index] = variance = squares / total
        self.count[index] = total
        return variance


class Normalizer:
    """Observations and rewards of `num_envs` environments.

    Args:
        num_envs: how many; `index` below is from 0 to it.
        shape: of one observation.
        gamma: rewards are divided by the deviation of their sum discounted by it.
        enabled: False hands out everything as it is, as float32.
    """

    def __init__(
        self, num_envs: int, shape: tuple[int, ...], gamma: float, enabled: bool = True
    ) -> None:
        self.enabled, self.gamma = enabled, gamma
        # Gymnasium's wrapper begins with float32, where this product is another.
        variance = float(np.float32(FIRST_COUNT)) / FIRST_COUNT
        self.observations = Statistics(num_envs, shape, variance)
        self.returns = Statistics(num_envs, ())
        self._sums = np.zeros(num_envs)

    def observed(self, index: NDArray[np.intp], observation: NDArray[Any]) -> NDArray[np.float32]:
        """Observations ``[n, ...]`` of the envs `index`, each once: normalised, and taken in."""
        if not self.enabled:
            return observation.astype(np.float32)
        variance = self.observations.update(index, observation)
        normal = (observation - self.observations.mean[index]) / np.sqrt(variance + EPSILON)
        return np.clip(normal.astype(np.float32), -LIMIT, LIMIT)

    def known(self, index: NDArray[np.intp], observation: NDArray[Any]) -> NDArray[np.float32]:
        """Observations normalised by what is known already; an env may come more than once."""
        if not self.enabled:
            return observation.astype(np.float32)
        found = self.observations
        normal = (observation - found.mean[index]) / np.sqrt(found.variance[index] + EPSILON)
        return np.clip(normal.astype(np.float32), -LIMIT, LIMIT)

    def rewarded(
        self, index: NDArray[np.intp], reward: NDArray[Any], terminated: NDArray[np.bool_]
    ) -> NDArray[Any]:
        """Rewards ``[n]`` of the envs `index`, each once: scaled, and taken in."""
        if not self.enabled:
            return reward
        self._sums[index] = sums = self._sums[index] * self.gamma * (1 - terminated) + reward
        variance = self.returns.update(index, sums)
        return np.clip(reward / np.sqrt(variance + EPSILON), -LIMIT, LIMIT)

    def scaled(self, index: NDArray[np.intp], reward: NDArray[Any]) -> NDArray[Any]:
        """Rewards scaled by what is known already; an env may come more than once."""
        if not self.enabled:
            return reward
        return np.clip(reward / np.sqrt(self.returns.variance[index] + EPSILON), -LIMIT, LIMIT)

    def state(self) -> dict[str, Any]:
        """All of it, as tensors; for a checkpoint."""
        both = {"observations": self.observations, "returns": self.returns}
        arrays = {f"{k}.{n}": a for k, found in both.items() for n, a in vars(found).items()}
        return {k: torch.from_numpy(a.copy()) for k, a in {**arrays, "sums": self._sums}.items()}

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was made."""
        self._sums = state["sums"].numpy().copy()
        for key, value in state.items():
            if "." in key:
                part, name = key.split(".")
                setattr(getattr(self, part), name, value.numpy().copy())

    def merged(self) -> Normalizer:
        """One for any environment, by what all of them have shown together."""
        own, shape = self.observations, self.observations.mean.shape[1:]
        found = Normalizer(1, shape, self.gamma, self.enabled)
        mean = own.mean.mean(0)
        found.observations.mean[:] = mean
        found.observations.variance[:] = (own.variance + np.square(own.mean - mean)).mean(0)
        return found
