"""What makes envs of a task in a worker, which need not know its name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from gymnasium.envs.registration import EnvSpec
    from gymnasium.vector import AutoresetMode

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

    def __call__(self) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = gym.make(self._spec, **self._kwargs)
        for wrap in self._wrappers:
            env = wrap(env)
        return env


class BatchOf:
    """Simulations of a MuJoCo task that are stepped together; see `mujoco_batch`."""

    def __init__(self, make_one: OneOf, num_envs: int, mode: AutoresetMode) -> None:
        self._make_one, self._num_envs, self._mode = make_one, num_envs, mode

    def __call__(self) -> gym.vector.VectorEnv[Any, Any, Any]:
        # Not at the top: few workers need it.
        from rlightning_aio.envs.mujoco_batch import MujocoBatch

        return MujocoBatch(self._make_one(), self._num_envs, self._mode)


class VectorOf:
    """The task's own vector environment."""

    def __init__(self, spec: EnvSpec, num_envs: int, kwargs: dict[str, Any]) -> None:
        self._spec, self._num_envs, self._kwargs = spec, num_envs, kwargs

    def __call__(self) -> gym.vector.VectorEnv[Any, Any, Any]:
        return gym.make_vec(
            self._spec, self._num_envs, vectorization_mode="vector_entry_point", **self._kwargs
        )
