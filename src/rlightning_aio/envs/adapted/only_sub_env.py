"""A vector environment with one sub-environment, as a single env.

Results have an axis for sub-environments only where an env has several.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import utils

from rlightning_aio.batch.infos import infos_of_each, listed

__all__ = ["OnlySubEnv"]


class OnlySubEnv(gym.Env[Any, Any]):
    """The only sub-environment of a vector environment, which resets it in its own mode."""

    def __init__(self, vector: Any) -> None:
        self.vector = vector
        self.observation_space = vector.single_observation_space
        self.action_space = vector.single_action_space
        self.metadata = vector.metadata
        self.render_mode = vector.render_mode
        self.spec = vector.spec
        # A `SyncVectorEnv` has `envs`.
        self._own: Any = getattr(vector.unwrapped, "envs", [None])[0]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        observations, infos = self.vector.reset(seed=seed, options=options)
        return self._only(observations), _only_info(infos)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        actions: Any = utils.create_empty_array(self.action_space, 1)
        actions = utils.concatenate(self.action_space, [action], actions)
        observations, *ends, infos = self.vector.step(actions)
        reward, terminated, truncated = (column[0] for column in ends)
        return self._only(observations), reward, terminated, truncated, _only_info(infos)

    def _only(self, observations: Any) -> Any:
        (found,) = utils.iterate(self.vector.observation_space, observations)
        return found

    def render(self) -> Any:
        frames = self.vector.render()
        return None if frames is None else frames[0]

    # Lookups go to the sub-environment where it can be reached, else to the vector environment.

    def get_wrapper_attr(self, name: str) -> Any:
        if self._own is not None:
            return self._own.get_wrapper_attr(name)
        return getattr(self if hasattr(self, name) else self.vector, name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        if self._own is not None:
            return self._own.set_wrapper_attr(name, value, force=force)
        setattr(self.vector.unwrapped, name, value)
        return True

    def close(self) -> None:
        self.vector.close()


def _only_info(infos: dict[str, Any]) -> dict[str, Any]:
    (info,) = listed(infos_of_each(infos, 1), 1)
    return info
