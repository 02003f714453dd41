"""`PredictPolicy`: models with a `predict`, such as Stable-Baselines3's, recurrent ones too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from rlightning_aio.policies.episodes import begins
from rlightning_aio.trees import mapped

if TYPE_CHECKING:
    from rlightning_aio.batch import BatchedData


class Model(Protocol):
    """A model that predicts actions, as `PredictPolicy` asks it to."""

    predict: Any


class PredictPolicy:
    """Returns the most probable actions of a model, by its `predict`.

    Args:
        model: a model of Stable-Baselines3, or any object whose ``predict(observation, state,
            episode_start, deterministic)`` returns actions and the state of a recurrent network, a
            tuple of arrays ``[layers, n, …]``, or None.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._states: dict[int, tuple[Any, ...]] = {}
        """State of the network by position in the group, sub-environments counted."""

    def __call__(self, batch: BatchedData) -> Any:
        """Return the actions for a batch, ``[n, *action]``."""
        head = batch.is_reset.shape
        observation = mapped(
            lambda leaf: leaf.reshape(-1, *leaf.shape[len(head) :]), batch.observation
        )
        places: list[int] = batch.index.reshape(-1).tolist()
        actions, state = self._model.predict(
            observation,
            state=self._gathered(places),
            episode_start=begins(batch).reshape(-1),
            deterministic=True,
        )
        if state is not None:
            for row, place in enumerate(places):
                self._states[place] = tuple(part[:, row].copy() for part in state)
        return np.reshape(actions, (*head, *actions.shape[1:]))

    def _gathered(self, places: list[int]) -> tuple[Any, ...] | None:
        """Stack the states; an env without one begins an episode, for which any state will do."""
        if not self._states:
            return None
        other = next(iter(self._states.values()))
        states = [self._states.get(place, other) for place in places]
        return tuple(np.stack(parts, axis=1) for parts in zip(*states, strict=True))
