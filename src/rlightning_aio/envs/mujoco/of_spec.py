"""Functions that make envs of a task in a worker that does not have the task registered.

In messages they have the name of the task.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.registry import is_of_simulator

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.envs.registration import EnvSpec

__all__ = ["BatchOf", "OneOf", "VectorOf"]


class OneOf:
    """One env, in wrappers.

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


class BatchOf:
    """Simulations of a MuJoCo task that are stepped together.

    Args:
        make_one: makes one of them.
        arguments: further ones of `mujoco_batch.MujocoBatch`.
    """

    def __init__(self, make_one: OneOf, *arguments: Any, **options: Any) -> None:
        self._make_one, self._arguments, self._options = make_one, arguments, options
        self.__qualname__, self.computes = make_one.__qualname__, True

    def __call__(self) -> gym.vector.VectorEnv[Any, Any, Any]:
        # Imported here because few workers need it.
        from rlightning_aio.envs.mujoco.batch import MujocoBatch

        return MujocoBatch(self._make_one(), *self._arguments, **self._options)


class VectorOf:
    """The task's own vector environment."""

    def __init__(self, spec: EnvSpec, num_envs: int, kwargs: dict[str, Any]) -> None:
        self._spec, self._num_envs, self._kwargs = spec, num_envs, kwargs
        self.__qualname__, self.computes = spec.id, is_of_simulator(spec)

    def __call__(self) -> gym.vector.VectorEnv[Any, Any, Any]:
        return gym.make_vec(
            self._spec, self._num_envs, vectorization_mode="vector_entry_point", **self._kwargs
        )
