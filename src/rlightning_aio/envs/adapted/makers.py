"""What a worker does with the envs that callables of `vector.VectorEnv` and `sb3.VecEnv` make."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from rlightning_aio.envs.wrappers import metadata_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import name_of
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

RESTARTS: Final = "RLIGHTNING_AIO_RESTARTS"
"""Environment variable that is there while an env is made again, in place of one that is gone."""


def adapted(
    makers: Sequence[Callable[[], Any]], mode: AutoresetMode, entry: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a config entry of callables that make envs; the workers adapt the envs.

    Args:
        makers: the user's callables.
        mode: when an env is reset after the end of its episode.
        entry: further fields. The step limit is applied by the envs themselves, as one with
            same-step autoreset must.

    Raises:
        ConfigError: `entry` has a task.
        TypeError: they are no callables, or there is one in place of one for each env.
    """
    if "task" in entry:
        raise ConfigError(
            "task: the envs are those of the callables; leave it out (make_vec takes the name of "
            "a task)"
        )
    if callable(makers):
        raise TypeError(
            f"env_fns must be a list with a callable for each env: [{name_of(makers)}] * 4, say"
        )
    for k, make in enumerate(makers):
        if not callable(make):
            raise TypeError(f"env_fns[{k}] is a {type(make).__name__}, which is not callable")
    own = {id(make): _Adapted(make, mode, entry.get("max_episode_steps")) for make in makers}
    fields = {name: value for name, value in entry.items() if name != "max_episode_steps"}
    return {"name": "env", "task": [own[id(make)] for make in makers], **fields}


class _Adapted:
    """Calls a callable that makes an env, and adapts the env."""

    def __init__(
        self, make_env: Callable[[], Any], mode: AutoresetMode, max_episode_steps: int | None
    ) -> None:
        functools.update_wrapper(self, make_env)
        self.__qualname__ = name_of(make_env)
        self._make_env, self._mode, self._limit = make_env, mode, max_episode_steps

    def __call__(self) -> Any:
        made: Any = self._make_env()
        if isinstance(made, gym.vector.VectorEnv):
            kind = type(cast("object", made)).__name__
            raise TypeError(
                f"the callable must return one env, not a {kind}: use that vector environment by "
                "itself (sb3.VecEnv takes it, too), or make an EnvGroup whose task is the callable"
            )
        limited = made if self._limit is None else gym.wrappers.TimeLimit(made, self._limit)
        return SameStep(limited) if self._mode == AutoresetMode.SAME_STEP else limited


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
