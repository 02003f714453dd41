"""`gymnasium` and `mujoco`: any environment that `gymnasium.make` or `make_vec` can make."""

from __future__ import annotations

import contextlib
import importlib
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.vector import SyncVectorEnv

from rlightning_aio.envs.base import BaseEnv, result_of
from rlightning_aio.envs.fast_path import BareReset, BareStep, FastPath
from rlightning_aio.envs.wrappers import autoreset_mode_of, has_wrapper
from rlightning_aio.sharing import check_threads, num_cores
from rlightning_aio.trees import as_numpy
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Generator

    import numpy as np
    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.wrappers import ClassName


class GymnasiumEnv(FastPath, BaseEnv):
    """A Gymnasium environment, or ``num_envs`` of them; ``env_kwargs`` go to `gymnasium.make`.

    The step limit is the config's ``max_episode_steps``, or the registered one. If ``num_envs`` is
    above 1, it is the task's own vector environment (its ``vector_entry_point``, which then takes
    ``env_kwargs``), or a loop over that number of envs if the task has none.
    """

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.env = self._make()
        self._is_vector = isinstance(self.env, gym.vector.VectorEnv)
        if self._is_vector:
            self.num_envs = int(self.env.num_envs)
            self.fresh_results = getattr(self.env.unwrapped, "fresh_results", False)
        self.autoreset = autoreset_mode_of(self.env).name.lower()  # pyright: ignore[reportAttributeAccessIssue]
        refuses = isinstance(self.env.unwrapped, SyncVectorEnv)
        self._waits = refuses and self.autoreset == "disabled"
        self.switches_task = bool(getattr(self.env.unwrapped, "switches_task", False))
        if self.max_episode_steps is None and self.env.spec is not None:
            self.max_episode_steps = self.env.spec.max_episode_steps

    def _make(self) -> Any:
        """Make the simulator of the config; subclasses wrap or replace it."""
        config = self.config
        if config.num_envs == 1:
            return self._make_one()
        make_kwargs: dict[str, Any] = {"disable_env_checker": True, **config.env_kwargs}
        if config.max_episode_steps is not None:
            make_kwargs["max_episode_steps"] = config.max_episode_steps
        if spec_of(config.task_name).vector_entry_point is None:
            # The runtime copies results into their rows.
            make_kwargs["vector_kwargs"] = {"copy": False}
        else:
            del make_kwargs["disable_env_checker"]
        return gym.make_vec(config.task_name, config.num_envs, **make_kwargs)

    def _make_one(self) -> gym.Env[Any, Any]:
        # The runtime checks observations itself when it copies them; Gymnasium's checker would
        # cost time in every step.
        make_kwargs: dict[str, Any] = {"disable_env_checker": True, **self.config.env_kwargs}
        limit = self.config.max_episode_steps
        return gym.make(self.config.task_name, max_episode_steps=limit, **make_kwargs)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        observation, info = self.env.reset(seed=seed, options=options)
        return EnvRet(env_id=self.env_id, observation=observation, info=info)

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        action = as_numpy(self._preprocess_fn(policy_resp))
        return result_of(self.env_id, self._stepped()(action))

    def _step_waiting(self, actions: Any) -> Any:
        """Step all, though some wait for the others to end: those play an episode of no one.

        A `SyncVectorEnv` steps none whose episode is over.
        """
        over: NDArray[np.bool_] = self.env.unwrapped._autoreset_envs  # noqa: SLF001
        if over.any():
            self.env.reset(options={"reset_mask": over.copy()})
        return self.env.step(actions)

    def bare_step(self) -> BareStep | None:
        return self._stepped() if type(self).step is GymnasiumEnv.step else None

    def _stepped(self) -> BareStep:
        return self._step_waiting if self._waits else self.env.step

    def bare_reset(self) -> BareReset | None:
        return self.env.reset if type(self).reset is GymnasiumEnv.reset else None

    def call_wrapped(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the outermost wrapper that has it, or return that attribute."""
        found = self.env.get_wrapper_attr(name)
        return found(*args, **kwargs) if callable(found) else found

    def is_wrapped(self, name: ClassName) -> bool:
        """Return True if the class of that name is among the env's wrappers."""
        return has_wrapper(self.env, name)

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
    """Return Gymnasium's spec of `task`; import its module first if the task names one."""
    module, _, name = task.rpartition(":")
    if module:
        importlib.import_module(module)
    return gym.spec(name)


class MujocoEnv(GymnasiumEnv):
    """Gymnasium's MuJoCo tasks (HalfCheetah-v5, Ant-v5, …).

    With ``num_envs`` a task of version 5 is stepped by MuJoCo's threads, as many as
    ``env_kwargs.num_threads`` says; see `MujocoBatch`.
    """

    def _make(self) -> Any:
        num_threads = self.config.env_kwargs.pop("num_threads", None)
        check_threads(f"env {self.env_id!r}: env_kwargs.num_threads", num_threads)
        with outdated_assets_accepted():
            if self.config.num_envs == 1:
                return super()._make()
            # Not at the top: few workers need it.
            from rlightning_aio.envs.mujoco.batch import MujocoBatch

            one = self._make_one()
            if num_threads is None:
                num_threads = num_cores()
                if self.config.placement != "inline":  # Workers compute at the same time.
                    num_threads = max(1, num_threads // self.config.num_workers)
            try:
                return MujocoBatch(one, self.config.num_envs, num_threads=num_threads)
            except NotImplementedError as error:
                one.close()
                warnings.warn(
                    f"{self.env_id}: {self.config.num_envs} envs of {self.config.task_name} are "
                    f"stepped one after the other: {error}",
                    RuntimeWarning,
                    stacklevel=2,
                )
                return super()._make()


@contextlib.contextmanager
def outdated_assets_accepted() -> Generator[None]:
    """Silence MuJoCo about deprecated attributes in a task's XML; nothing else.

    Gymnasium's own assets use them, so each env of each worker would warn, and users can't fix
    it. Other warnings of MuJoCo are passed on.
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
