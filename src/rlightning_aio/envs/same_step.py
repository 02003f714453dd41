"""Resets in the step that ends an episode, in the worker: no further round trip."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode

__all__ = ["SameStep"]


class SameStep(gym.Wrapper[Any, Any, Any, Any]):
    """An env that begins its next episode in the step that ends the one before.

    That step's observation and info are the next episode's first; ``final_obs`` and
    ``final_info`` are the last ones of the episode that has ended, as Gymnasium's vector
    environments have them in `AutoresetMode.SAME_STEP`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}

    # Nobody is to find this wrapper among those of the env's author.

    def has_wrapper_attr(self, name: str) -> bool:
        return self.env.has_wrapper_attr(name)

    def get_wrapper_attr(self, name: str) -> Any:
        return self.env.get_wrapper_attr(name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        return self.env.set_wrapper_attr(name, value, force=force)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            final = {"final_info": info, "final_obs": observation}
            observation, info = self.env.reset()
            info = {**final, **info}
        return observation, reward, terminated, truncated, info
