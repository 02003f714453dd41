"""Reset in the worker, within the step that ends an episode, to save a round trip."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from rlightning_aio.envs.wrappers import metadata_of
from rlightning_aio.trees import copied

__all__ = ["SameStep"]


class SameStep(gym.Wrapper[Any, Any, Any, Any]):
    """An env that begins the next episode within the step that ends one.

    The observation and info of that step are the first of the next episode. ``final_obs`` and
    ``final_info`` are the last of the episode that ended, as in Gymnasium's vector environments
    with `AutoresetMode.SAME_STEP`.
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.metadata = {**metadata_of(env), "autoreset_mode": AutoresetMode.SAME_STEP}

    # Lookups go to the wrappers of the env's author.
    hides_itself = True

    def has_wrapper_attr(self, name: str) -> bool:
        return self.env.has_wrapper_attr(name)

    def get_wrapper_attr(self, name: str) -> Any:
        return self.env.get_wrapper_attr(name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        return self.env.set_wrapper_attr(name, value, force=force)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            # Copies: an env may use its arrays again in the reset. Its own keys don't replace ours.
            final = {"final_info": copied(info), "final_obs": copied(observation)}
            observation, info = self.env.reset()
            info = {**info, **final}
        return observation, reward, terminated, truncated, info
