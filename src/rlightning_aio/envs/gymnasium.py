"""`gymnasium` and `mujoco`: any environment that `gymnasium.make` can make."""

from __future__ import annotations

import contextlib
import importlib
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rlightning_aio.envs.base import (
    BareReset,
    BareStep,
    BaseEnv,
    PreprocessFn,
    default_env_preprocess_fn,
    result_of,
)
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Generator

    from rlightning_aio.config import EnvConfig

__all__ = ["GymnasiumEnv", "MujocoEnv"]


class GymnasiumEnv(BaseEnv):
    """A single Gymnasium environment; ``env_kwargs`` go to `gymnasium.make`.

    The step limit is the config's ``max_episode_steps``, or the registered one.
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
        if self.max_episode_steps is None and self.env.spec is not None:
            self.max_episode_steps = self.env.spec.max_episode_steps

    def _make(self) -> Any:
        """Make the simulator that the config names; subclasses wrap or replace it."""
        # The runtime checks observations against the space itself, once, where it
        # copies them; Gymnasium's checker would stay in the path of every step.
        make_kwargs = {"disable_env_checker": True, **self.config.env_kwargs}
        return gym.make(
            self.config.task, max_episode_steps=self.config.max_episode_steps, **make_kwargs
        )

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        observation, info = self.env.reset(seed=seed, options=options)
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = as_numpy(self._preprocess_fn(policy_resp))
        return result_of(self.env_id, self.env.step(action))

    def bare_step(self) -> BareStep | None:
        plain = type(self).step is GymnasiumEnv.step
        return self.env.step if plain and self._preprocess_fn is default_env_preprocess_fn else None

    def bare_reset(self) -> BareReset | None:
        return self.env.reset if type(self).reset is GymnasiumEnv.reset else None

    def close(self) -> None:
        self.env.close()


class MujocoEnv(GymnasiumEnv):
    """Gymnasium's MuJoCo tasks (HalfCheetah-v5, Ant-v5, …)."""

    def _make(self) -> Any:
        with _outdated_assets_accepted():
            return super()._make()


@contextlib.contextmanager
def _outdated_assets_accepted() -> Generator[None]:
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
