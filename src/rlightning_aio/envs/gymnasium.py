"""`gymnasium` and `mujoco`: any environment that `gymnasium.make` or `make_vec` can make."""

from __future__ import annotations

import contextlib
import importlib
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from rlightning_aio.envs.base import (
    BareReset,
    BareStep,
    BaseEnv,
    PreprocessFn,
    result_of,
)
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.envs.wrappers import wrappers_of
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Generator

    from gymnasium.envs.registration import EnvSpec

    from rlightning_aio.config import EnvConfig

__all__ = ["GymnasiumEnv", "MujocoEnv", "outdated_assets_accepted", "spec_of"]


class GymnasiumEnv(BaseEnv):
    """A Gymnasium environment, or ``num_envs`` of them; ``env_kwargs`` go to `gymnasium.make`.

    The step limit is the config's ``max_episode_steps``, or the registered one. Several are the
    task's own vector environment, where it has one (its ``vector_entry_point``, to which
    ``env_kwargs`` go then), and a loop over as many envs otherwise.
    """

    def __init__(
        self,
        config: EnvConfig,
        worker_index: int = 0,
        preprocess_fn: PreprocessFn | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config, worker_index, preprocess_fn, **kwargs)
        self.env = self._make()
        self._is_vector = isinstance(self.env, gym.vector.VectorEnv)
        if self._is_vector:
            self.num_envs = int(self.env.num_envs)
        mode = self.env.metadata.get("autoreset_mode", AutoresetMode.DISABLED)
        self.autoreset = AutoresetMode(mode).name.lower()  # pyright: ignore[reportAttributeAccessIssue]
        if self.max_episode_steps is None and self.env.spec is not None:
            self.max_episode_steps = self.env.spec.max_episode_steps

    def _make(self) -> Any:
        """Make the simulator that the config names; subclasses wrap or replace it."""
        config = self.config
        if config.num_envs == 1:
            return self._make_one()
        make_kwargs: dict[str, Any] = {"disable_env_checker": True, **config.env_kwargs}
        if config.max_episode_steps is not None:
            make_kwargs["max_episode_steps"] = config.max_episode_steps
        if spec_of(config.task).vector_entry_point is None:
            # Results are copied where the runtime takes them.
            make_kwargs["vector_kwargs"] = {"copy": False}
        else:
            del make_kwargs["disable_env_checker"]
        return gym.make_vec(config.task, config.num_envs, **make_kwargs)

    def _make_one(self) -> gym.Env[Any, Any]:
        # The runtime checks observations against the space itself, once, where it
        # copies them; Gymnasium's checker would stay in the path of every step.
        make_kwargs: dict[str, Any] = {"disable_env_checker": True, **self.config.env_kwargs}
        limit = self.config.max_episode_steps
        return gym.make(self.config.task, max_episode_steps=limit, **make_kwargs)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        observation, info = self.env.reset(seed=seed, options=options)
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = as_numpy(self._preprocess_fn(policy_resp))
        return result_of(self.env_id, self.env.step(action))

    def bare_step(self) -> BareStep | None:
        # The one sub-environment of a vector env has an axis that its row lacks.
        plain = type(self).step is GymnasiumEnv.step and self._is_vector == (self.num_envs > 1)
        return self.env.step if plain else None

    def bare_reset(self) -> BareReset | None:
        return self.env.reset if type(self).reset is GymnasiumEnv.reset else None

    def call_wrapped(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the outermost wrapper that has it; an attribute's value is
        returned as it is.
        """
        found = self.env.get_wrapper_attr(name)
        return found(*args, **kwargs) if callable(found) else found

    def is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Whether `wrapper_class` is among the env's wrappers."""
        return any(isinstance(wrapper, wrapper_class) for wrapper in wrappers_of(self.env))

    def render_one(self, sub_env: int) -> Any:
        if not self._is_vector:
            return self.env.render()
        inner: Any = self.env.unwrapped
        if isinstance(inner, SyncVectorEnv):
            return inner.envs[sub_env].render()
        own = getattr(inner, "render_one", None)  # A `MujocoBatch`'s.
        return self.env.render()[sub_env] if own is None else own(sub_env)

    def close(self) -> None:
        self.env.close()


def spec_of(task: str) -> EnvSpec:
    """What Gymnasium knows of `task`, whose module is imported first if it names one."""
    module, _, name = task.rpartition(":")
    if module:
        importlib.import_module(module)
    return gym.spec(name)


class MujocoEnv(GymnasiumEnv):
    """Gymnasium's MuJoCo tasks (HalfCheetah-v5, Ant-v5, …).

    With ``num_envs`` a task of version 5 is stepped with one call for all; see `mujoco_batch`.
    """

    def _make(self) -> Any:
        with outdated_assets_accepted():
            if self.config.num_envs == 1:
                return super()._make()
            # Not at the top: few workers need it.
            from rlightning_aio.envs.mujoco_batch import MujocoBatch

            one = self._make_one()
            try:
                return MujocoBatch(one, self.config.num_envs)
            except NotImplementedError as error:
                one.close()
                warnings.warn(
                    f"{self.env_id}: {self.config.num_envs} envs of {self.config.task} are stepped "
                    f"one after the other: {error}",
                    RuntimeWarning,
                    stacklevel=2,
                )
                return super()._make()


@contextlib.contextmanager
def outdated_assets_accepted() -> Generator[None]:
    """Silence MuJoCo about deprecated attributes in a task's XML; nothing else.

    Gymnasium's own assets use them, so each env of each worker would tell a user who can't
    do anything about it. Whatever else MuJoCo warns of meanwhile is passed on.
    """
    # Its stubs leave out half of it.
    mujoco: Any = importlib.import_module("mujoco")
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
        for text in said:
            if not (text.startswith("compiler attribute") and "deprecated" in text):
                before(text) if before else warnings.warn(text, RuntimeWarning, stacklevel=2)
