"""Make envs of a task in a worker that does not have the task registered."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.registry import is_of_simulator

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.envs.registration import EnvSpec

__all__ = ["OneOf"]


class OneOf:
    """Makes one env, in wrappers. In messages it has the name of the task.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`.
        wrappers: the first innermost.
    """

    def __init__(
        self,
        spec: EnvSpec,
        kwargs: dict[str, Any],
        wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    ) -> None:
        self._spec, self._kwargs, self._wrappers = spec, kwargs, wrappers
        self.__qualname__, self.computes = spec.id, is_of_simulator(spec)

    def __call__(self) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = gym.make(self._spec, **self._kwargs)
        for wrap in self._wrappers:
            env = wrap(env)
        return env
