"""`VectorEnv`s of registered tasks."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.envs.gymnasium import spec_of
from rlightning_aio.vector.env import VectorEnv

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from gymnasium.envs.registration import EnvSpec

__all__ = ["make_vec", "vector_entry_point"]


def make_vec(
    id: str | EnvSpec,  # noqa: A002  # As Gymnasium calls it.
    num_envs: int = 1,
    vector_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv:
    """A `VectorEnv` of so many envs of one task; see `gymnasium.make_vec`.

    Args:
        id: a registered name, ``module:name``, or a spec.
        num_envs: how many.
        vector_kwargs: further arguments of `VectorEnv`.
        wrappers: put around each env, the first innermost.
        kwargs: of `gymnasium.make`. Gymnasium's checker, which stays in the path of every step,
            is left out unless ``disable_env_checker=False`` is among them.
    """
    spec = copy.deepcopy(spec_of(id) if isinstance(id, str) else id)
    make_env = _Maker(spec, tuple(wrappers), {"disable_env_checker": True, **kwargs})
    # Known before the first env is made, it need not tell every time that its assets are old.
    is_mujoco = str(spec.entry_point).startswith("gymnasium.envs.mujoco")
    arguments: dict[str, Any] = {"imports": ("mujoco",)} if is_mujoco else {}
    env = VectorEnv([make_env] * num_envs, **{**arguments, **(vector_kwargs or {})})
    env.spec = copy.deepcopy(spec)
    env.spec.kwargs.update(kwargs)
    return env


def vector_entry_point(
    id: str | EnvSpec,  # noqa: A002
    **vector_kwargs: Any,
) -> Callable[..., VectorEnv]:
    """What `gymnasium.register` takes as ``vector_entry_point``, to serve task `id` from here.

    `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")`, and whoever calls it
    (RLlib, say), gets a `VectorEnv` with `vector_kwargs` then.
    """

    def make(num_envs: int, **kwargs: Any) -> VectorEnv:
        return make_vec(id, num_envs, vector_kwargs, **kwargs)

    return make


class _Maker:
    """Makes one env in a worker, which need not know the task's name."""

    def __init__(self, spec: EnvSpec, wrappers: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        self._spec, self._wrappers, self._kwargs = spec, wrappers, kwargs

    def __call__(self) -> gym.Env[Any, Any]:
        env: gym.Env[Any, Any] = gym.make(self._spec, **self._kwargs)
        for wrap in self._wrappers:
            env = wrap(env)
        return env
