"""Stable-Baselines3's vector interface: a group of envs as one of its `VecEnv`s.

It takes the place of `stable_baselines3.common.vec_env.SubprocVecEnv`, with the same results to the
bit. docs/stable_baselines3.md tells what differs.
"""

from __future__ import annotations

import contextlib
from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import reported_info_list
from rlightning_aio.envs.same_step import SameStepOf
from rlightning_aio.errors import ConfigError, EnvRaised
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.leftovers import drop_outstanding

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Sequence

    from numpy.typing import NDArray

__all__ = ["VecEnv"]

# Optional and typed in part, so imported by name.
_Base: Any = import_module("stable_baselines3.common.vec_env.base_vec_env").VecEnv


class VecEnv(_Base):
    """Envs in worker processes behind Stable-Baselines3's vector interface.

    Args:
        env_fns: one callable for each env. They run in the workers, and only there; lambdas
            and functions of ``__main__`` will do.
        start_method: accepted, and without meaning here.
        entry: further fields of `EnvConfig` (``envs_per_process``, ``step_timeout``, …).

    Attributes:
        group: the `EnvGroup` that does the work; its envs are called ``env-0``, ``env-1``, …

    Raises:
        ConfigError: a callable can't be sent to a worker, `entry` is wrong, or the envs'
            spaces differ.
        StartFailed: a callable raised, or returned no env.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]],
        start_method: str | None = None,
        **entry: Any,
    ) -> None:
        del start_method
        self.group: EnvGroup = build_env_group(
            {
                "name": "env",
                "num_workers": len(env_fns),
                "make_env": [SameStepOf(make) for make in env_fns],
                **entry,
            }
        )
        metas = self.group.init()
        try:
            first = metas[0]
            for meta in metas:
                spaces = (meta.observation_space, meta.action_space)
                if spaces != (first.observation_space, first.action_space):
                    raise ConfigError(
                        f"the spaces of env {meta.env_id!r} are not those of {first.env_id!r}; "
                        "Stable-Baselines3 batches what is alike"
                    )
            # Results of all envs, in order, which actions can answer.
            self._answerable = BatchedData(self.group.env_ids, [None] * len(metas))
            _Base.__init__(self, len(metas), first.observation_space, first.action_space)
        except BaseException:
            self.group.close()
            raise

    def reset(self) -> Any:
        """Reset all envs with the seeds and options that were set since the last time.

        Returns observations ``[num_envs, ...]``, or dicts or tuples of such; `reset_infos` has
        the infos.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; the others' results are dropped.
        """
        with self._dropping_the_rest():
            for env_id, seed, options in zip(
                self.group.env_ids, self._seeds, self._options, strict=True
            ):
                seeds = {} if seed is None else {env_id: int(seed)}
                self.group.reset_async(seeds, options or None, [env_id])
            batch, _ = self.group.collect_async(wait_all=True, ordered=True)
        self.reset_infos = reported_info_list(batch)
        self._reset_seeds()
        self._reset_options()
        return batch.observation

    def step_async(self, actions: Any) -> None:
        """Send one action to each env, from an array or a sequence; cast to the space's dtype."""
        if isinstance(self.action_space, gym.spaces.Dict | gym.spaces.Tuple):
            pairs = zip(self.group.env_ids, actions, strict=True)
            responses = [PolicyResponse(env_id, action) for env_id, action in pairs]
            self.group.step_async(BatchedData(self.group.env_ids, responses))
        else:
            self.group.step_async(self._answerable.respond(action=np.asarray(actions)))

    def step_wait(self) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], list[dict[str, Any]]]:
        """Wait for the steps.

        Returns observations, rewards, whether each episode is done, and infos. Where it is,
        the observation is the next episode's first, and the info has the last one's as
        ``terminal_observation``. ``TimeLimit.truncated`` is in every info.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; the others' results are dropped.
        """
        with self._dropping_the_rest():
            batch, _ = self.group.collect_async(wait_all=True, ordered=True)
        self._answerable = batch
        infos = reported_info_list(batch)
        truncated = (batch.truncated & ~batch.terminated).tolist()
        done = batch.done
        for k in np.flatnonzero(done).tolist():
            infos[k], self.reset_infos[k] = _last_and_first(infos[k])
        for info, cut in zip(infos, truncated, strict=True):
            info["TimeLimit.truncated"] = cut
        return batch.observation, batch.reward, done, infos

    @contextlib.contextmanager
    def _dropping_the_rest(self) -> Generator[None]:
        """Where an env fails, let the others end what they do, so that all can be reset."""
        try:
            yield
        except Exception:
            drop_outstanding(self.group)
            raise

    def close(self) -> None:
        """Close the envs and end their workers; idempotent."""
        self.group.close()

    # -- methods and attributes -------------------------------------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Attribute of envs, found through their wrappers.

        Raises:
            AttributeError: an env has none of that name.
        """
        try:
            return self._call(indices, "get_wrapper_attr", attr_name)
        except EnvRaised as error:
            if error.exception_type.endswith("AttributeError"):
                raise AttributeError(error.exception_text) from error
            raise

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the outermost wrapper of envs."""
        self._call(indices, "__setattr__", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of envs, found through their wrappers, all at once."""
        return self._call(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether `wrapper_class` is among the wrappers of envs."""
        return self._values(indices, "is_wrapped", wrapper_class)

    def get_images(self) -> list[Any]:
        """One frame of each env, as it renders it."""
        return self._call(None, "render")

    def _call(self, indices: Any, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        return self._values(indices, "call_wrapped", name, *args, **kwargs)

    def _values(self, indices: Any, name: str, *args: Any, **kwargs: Any) -> list[Any]:
        chosen: Iterable[int] = self._get_indices(indices)
        env_ids = [self.group.env_ids[k] for k in chosen]
        self.group.call_async(name, *args, env_ids=env_ids, **kwargs)
        return self.group.collect_calls()


def _last_and_first(info: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The last info of an episode and the first of the next; see `SameStep`."""
    if "final_info" not in info:  # Lost with its worker, which says so.
        return info, {}
    first = {key: value for key, value in info.items() if key not in ("final_info", "final_obs")}
    return {**info["final_info"], "terminal_observation": info["final_obs"]}, first
