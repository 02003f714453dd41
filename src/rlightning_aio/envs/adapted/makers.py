"""What a worker does with the envs that callables of `vector.VectorEnv` and `sb3.VecEnv` make."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
from gymnasium.vector import AutoresetMode

from rlightning_aio.envs.adapted.same_step import SameStep
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import name_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

__all__ = ["RESTARTS", "adapted"]

RESTARTS: Final = "RLIGHTNING_AIO_RESTARTS"
"""Environment variable that tells the code of an env, while it is made, how often it was before."""


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
