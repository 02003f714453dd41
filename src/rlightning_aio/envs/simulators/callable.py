"""`callable`: envs that come from a callable of the user's, wrapped as its author likes."""

from __future__ import annotations

import contextlib
import sys
from inspect import isawaitable, iscoroutinefunction
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.envs.base import BaseEnv, PreprocessFn, result_of
from rlightning_aio.envs.fast_path import FastPath
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv, outdated_assets_accepted
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import load
from rlightning_aio.spaces import Anything

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.types import EnvRet, PolicyResponse


def env_of_callable(
    config: EnvConfig, worker_index: int = 0, preprocess_fn: PreprocessFn | None = None
) -> BaseEnv:
    """Call what the entry names with its ``env_kwargs``, and make an env of what it returns.

    Args:
        config: its ``task`` is one callable, or reads ``module:function``.
        worker_index: of the env within its entry.
        preprocess_fn: turns a `PolicyResponse` into what the env steps with.

    Raises:
        TypeError: what it returns is no env.
        ConfigError: the entry asks for what the env can't be given from outside.
    """
    make: Any = load(config.task) if isinstance(config.task, str) else config.task
    # The env needs no copy of what made it.
    config = config.model_copy(update={"task": config.task_name})
    with outdated_assets_accepted() if "mujoco" in sys.modules else contextlib.nullcontext():
        made = make(**config.env_kwargs)
    if isinstance(made, BaseEnv):
        return _adopted(made, config, worker_index, preprocess_fn)
    step: Any = getattr(made, "step", None)
    is_async = iscoroutinefunction(step)
    if isinstance(made, gym.Env | gym.vector.VectorEnv) and not is_async:
        return _GivenEnv(made, config, worker_index, preprocess_fn)
    # A decorator may hide that it is a coroutine function: its first result says it.
    if is_async or (callable(step) and config.placement != "inline"):
        return _AwaitableEnv(made, config, worker_index, preprocess_fn)
    raise _no_env(config.name, made)


def _no_env(entry: str, made: Any) -> TypeError:
    return TypeError(
        f"the callable of entry {entry!r} must return a gymnasium.Env, a "
        "gymnasium.vector.VectorEnv, a BaseEnv, or an object with their reset and step as "
        f"`async def`, not {type(made).__name__}; an env of Gym, Gymnasium's predecessor, needs "
        "shimmy.GymV21CompatibilityV0(env=env) around it"
    )


def _adopted(
    env: BaseEnv, config: EnvConfig, worker_index: int, preprocess_fn: PreprocessFn | None
) -> BaseEnv:
    """An env that was made without knowing its entry, as one of the entry's."""
    if preprocess_fn is not None:
        env._preprocess_fn = preprocess_fn  # pyright: ignore[reportPrivateUsage]
    env.config = config.model_copy(update={"num_envs": env.config.num_envs})
    env.worker_index = worker_index
    env.env_id = f"{config.name}-{worker_index}"
    env.max_episode_steps = config.max_episode_steps or env.max_episode_steps
    return env


def _stop(made: Any) -> None:
    """Call the method `stop` of the outermost wrapper or env that has one."""
    bare = getattr(made, "unwrapped", made)
    while made is not bare and not callable(getattr(made, "stop", None)):
        made = made.env
    stop: Any = getattr(made, "stop", None)
    if callable(stop):
        stop()


class _GivenEnv(GymnasiumEnv):
    def __init__(self, made: Any, *args: Any) -> None:
        self._made = made
        super().__init__(*args)

    def stop(self) -> None:
        _stop(self._made)

    def _make(self) -> Any:
        made, config = self._made, self.config
        is_vector = isinstance(self._made, gym.vector.VectorEnv)
        if config.num_envs not in (1, made.num_envs if is_vector else 1):
            raise ConfigError(
                f"entry {config.name!r}, num_envs: {config.num_envs}, but its callable returned "
                f"{f'{made.num_envs} of them' if is_vector else 'a single env'}; leave "
                "num_envs out"
            )
        if is_vector and made.num_envs == 1:
            kind = type(made.unwrapped).__name__
            raise ConfigError(
                f"entry {config.name!r}: its callable returned a {kind} of one env; return that "
                "env itself"
            )
        if config.max_episode_steps is None:
            return made
        if is_vector:
            raise ConfigError(
                f"entry {config.name!r}, max_episode_steps: a vector env keeps its own limits; set "
                "it where the envs are made"
            )
        return gym.wrappers.TimeLimit(made, config.max_episode_steps)


class _AwaitableEnv(FastPath, BaseEnv):
    """An object with Gymnasium's methods; its `reset` and `step` return awaitables.

    A space that it doesn't have is `Anything`.
    """

    def __init__(self, made: Any, *args: Any) -> None:
        super().__init__(*args)
        self.env = made
        self.switches_task = bool(getattr(made, "switches_task", False))

    def get_observation_space(self) -> gym.Space[Any]:
        return getattr(self.env, "observation_space", Anything())

    def get_action_space(self) -> gym.Space[Any]:
        return getattr(self.env, "action_space", Anything())

    async def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        first = self.env.reset(seed=seed, options=options)
        if not isawaitable(first):
            raise _no_env(self.config.name, self.env)
        observation, info = await first
        return result_of(self.env_id, (observation, 0.0, False, False, info))

    async def step(self, policy_resp: PolicyResponse) -> EnvRet:
        return result_of(self.env_id, await self.env.step(self._preprocess_fn(policy_resp)))

    def bare_step(self) -> Any:
        return self._step_made

    def _step_made(self, action: Any) -> Any:
        # Looked up again: a restore replaces an object that has slots only.
        return self.env.step(action)

    def call_wrapped(self, name: str, /, *args: object, **kwargs: object) -> Any:
        """Say why the vector interfaces, which ask for attributes, can't have this env."""
        del name, args, kwargs
        raise TypeError(
            f"env {self.env_id!r} is awaitable (its step is `async def`), and the vector "
            "interfaces take gymnasium.Env only; step it through build_env_group"
        )

    def stop(self) -> None:
        _stop(self.env)

    def close(self) -> Awaitable[None] | None:
        close = getattr(self.env, "close", None)
        return None if close is None else close()
