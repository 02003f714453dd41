"""Stable-Baselines3's vector interface: a group of envs, or any vector env, as its `VecEnv`.

It replaces `stable_baselines3.common.vec_env.SubprocVecEnv`, with bit-identical results.
docs/stable_baselines3.md lists the differences.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from rlightning_aio.batch.contents import reported_info_list, reported_infos
from rlightning_aio.batch.infos import infos_of_each, listed
from rlightning_aio.envs.adapted.makers import RESTARTS
from rlightning_aio.envs.simulators.gymnasium import spec_of
from rlightning_aio.envs.wrappers import autoreset_mode_of, has_wrapper, name_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.vector.env import VectorEnv
from rlightning_aio.vector.lazy_infos import LazyColumns, LazyInfos
from rlightning_aio.vector.making import batch_of, is_brief, steps_together

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.sync import EnvGroup

__all__ = ["VecEnv", "make_vec_env"]

# An optional dependency with incomplete annotations, so imported by name.
_Base: Any = import_module("stable_baselines3.common.vec_env.base_vec_env").VecEnv
_OF_SINGLE_ENVS: Final = ("wrapper_class", "wrapper_kwargs", "monitor_dir", "monitor_kwargs")
"""Arguments of Stable-Baselines3's `make_vec_env` that keep envs from being stepped together."""
_IGNORED: Final = {"start_method"}
"""Arguments of `VecEnv` without a meaning."""
_FEWEST_TOGETHER: Final = 4
"""From this number of MuJoCo envs on, a batch is faster than a loop, with what is around it."""


def make_vec_env(
    env_id: str | Callable[..., gym.Env[Any, Any]],
    n_envs: int = 1,
    seed: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: type[Any] | None = None,
    **more: Any,
) -> Any:
    """Make monitored envs of one task; see `stable_baselines3.common.env_util.make_vec_env`.

    Four envs or more of a MuJoCo task that `rlightning_aio.envs.mujoco.batch` supports are stepped
    together, in threads of this process, inside a `VecMonitor`, unless they need a wrapper or a
    file each. Fewer of them, classic control, toy text and a single env are what Stable-Baselines3
    makes, a `DummyVecEnv`.
    All else is a `VecEnv` of separate envs in workers, each in a `Monitor` that restarts continue.

    Args:
        env_id: a registered name, or a callable that makes an env.
        n_envs: the number of envs.
        seed: env k gets ``seed + k`` at the next reset.
        env_kwargs: of `gymnasium.make`; for envs that are stepped together also ``num_threads``.
        vec_env_kwargs: of `VecEnv`: fields of a config entry. Envs with one are in a `VecEnv`.
        vec_env_cls: None makes what is fastest. `VecEnv` or `SubprocVecEnv`: always workers.
            `DummyVecEnv`: always that.
        more: further arguments of Stable-Baselines3's function.

    Raises:
        ValueError: `vec_env_cls` is another class, or there is no env.
        TypeError: an argument is unknown.
        ConfigError: ``num_threads`` is wrong, another argument keeps the envs of the task
            separate, or there are fields for a `DummyVecEnv`.
    """
    if n_envs < 1:
        raise ValueError(f"n_envs must be at least 1, not {n_envs!r}")
    vec_envs = import_module("stable_baselines3.common.vec_env")
    dummy = vec_envs.DummyVecEnv
    if vec_env_cls not in (None, VecEnv, vec_envs.SubprocVecEnv, dummy):
        where = f"vec_env_cls is {vec_env_cls.__name__}, and these envs are in a VecEnv"
        raise ValueError(f"{where}: leave it out, or call Stable-Baselines3's make_vec_env")
    make: Any = import_module("stable_baselines3.common.env_util").make_vec_env
    given = {**more, "env_kwargs": env_kwargs, "monitor_kwargs": _Continued(more)}
    inspect.signature(make).bind(env_id, n_envs, seed, vec_env_kwargs=vec_env_kwargs, **given)
    fields = {k: v for k, v in (vec_env_kwargs or {}).items() if k not in _IGNORED}
    if vec_env_cls is dummy and fields:
        raise ConfigError(f"{', '.join(fields)}: leave out vec_env_cls to have workers")
    decides = vec_env_cls is None and not fields
    spec = spec_of(env_id) if isinstance(env_id, str) else None
    kwargs = {"render_mode": "rgb_array", **(env_kwargs or {})}
    separate = not decides or any(map(more.get, _OF_SINGLE_ENVS))
    together = spec is not None and steps_together(spec, kwargs, separate=separate)
    enough = n_envs >= _FEWEST_TOGETHER or "num_threads" in kwargs
    if spec is not None and together and enough:
        kwargs = {"disable_env_checker": True, **kwargs}
        made = VecEnv(batch_of(spec, kwargs, n_envs, AutoresetMode.SAME_STEP))
        made.seed(seed)
        return vec_envs.VecMonitor(made)
    is_short = n_envs == 1 or together or (spec is not None and is_brief(spec))
    kind = dummy if vec_env_cls is dummy or (decides and is_short) else VecEnv
    return make(env_id, n_envs, seed, vec_env_cls=kind, vec_env_kwargs=fields, **given)


class _Continued(Mapping[str, Any]):
    """``monitor_kwargs``, read in the worker as it makes a `Monitor`: the file of an env that was
    made before goes on.
    """

    def __init__(self, more: Mapping[str, Any]) -> None:
        self._given: dict[str, Any] = {
            "override_existing": True,
            **(more.get("monitor_kwargs") or {}),
        }

    def __getitem__(self, key: str) -> Any:
        if key == "override_existing" and RESTARTS in os.environ:
            return False
        return self._given[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._given)

    def __len__(self) -> int:
        return len(self._given)


class VecEnv(_Base):
    """A vector env, or envs in worker processes, behind Stable-Baselines3's vector interface.

    Args:
        env_fns: one callable for each env, of which a `vector.VectorEnv` is made. They are called
            only in the workers; lambdas and functions of ``__main__`` are allowed. Or a
            `gymnasium.vector.VectorEnv` with same-step autoreset, Gymnasium's own included.
        start_method: accepted and ignored.
        entry: further fields of `EnvConfig` (``envs_per_process``, ``step_timeout``, …).

    Attributes:
        envs: the vector env.

    Raises:
        ConfigError: a callable can't be sent to a worker, `entry` is wrong, or the vector env has
            another autoreset mode.
        StartFailed: a callable raised, or didn't return an env.
        RuntimeError: the spaces of envs differ.
        TypeError: `env_fns` is no list of callables.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]] | gym.vector.VectorEnv[Any, Any, Any],
        start_method: str | None = None,
        **entry: Any,
    ) -> None:
        del start_method
        if isinstance(env_fns, gym.vector.VectorEnv):
            _check_given(env_fns, entry)
            self.envs: Any = env_fns
        else:
            self.envs = _LazyVectorEnv(env_fns, autoreset_mode=AutoresetMode.SAME_STEP, **entry)
        self._inner: Any = self.envs.unwrapped
        # Each env of these two can be reached by itself.
        self._ours: VectorEnv | None = None
        self._separate: list[Any] | None = None
        if isinstance(self._inner, VectorEnv):
            self._ours = self._inner
        elif issubclass(type(self._inner), gym.vector.SyncVectorEnv):
            self._separate = self._inner.envs
        self._sent: Any = None
        try:
            spaces = self.envs.single_observation_space, self.envs.single_action_space
            _Base.__init__(self, self.envs.num_envs, *spaces)
            self.metadata: dict[str, Any] = {**self.envs.metadata, **self.metadata}
        except BaseException:
            if self.envs is not env_fns:
                self.envs.close()
            raise

    @property
    def group(self) -> EnvGroup:
        """The group of a `vector.VectorEnv`, of the envs ``env-0``, ``env-1``, …."""
        return self._inner.group

    def reset(self) -> Any:
        """Reset all envs with the seeds and options that were set since the last reset.

        Returns observations ``[num_envs, ...]``, or dicts or tuples of them. The infos are in
        `reset_infos`.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; the results of the others are dropped.
            ValueError: the options of envs differ, and the vector env resets them together.
        """
        seed = self._seeds[0]  # The others count up from it.
        options: Any = [own or None for own in self._options]  # As Stable-Baselines3 does.
        if self._ours is None:
            options, *others = options
            if any(own != options for own in others):
                raise ValueError(
                    f"the reset options of envs differ, and a {type(self._inner).__name__} resets "
                    "all with the same: give VecEnv a list of callables, one for each env"
                )
        elif not any(options):
            options = None
        observations, infos = self.envs.reset(seed=seed, options=options)
        self.reset_infos = _each(infos, np.array([False] * self.num_envs))
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Any) -> None:
        """Note one action for each env: an array or a sequence, cast to the dtype of the space.

        Raises:
            ValueError: there is not one for each env.
        """
        space = self.action_space
        if not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
            # Ours checks what it casts.
            self._sent = np.array(actions, None if self._ours is not None else space.dtype)
            return
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions for num_envs={self.num_envs}")
        empty: Any = gym.vector.utils.create_empty_array(space, self.num_envs)
        self._sent = gym.vector.utils.concatenate(space, actions, empty)

    def step_wait(self) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step the envs with the actions of `step_async`.

        Returns observations, rewards, done flags and infos. If an episode is done, the observation
        is the first of the next episode, and the info has the last one of this episode as
        ``terminal_observation``. Each info has ``TimeLimit.truncated``. The list of infos is made
        when it is first read.

        Raises:
            BadAction: the actions don't fit; nothing was sent.
            ResetNeeded: the results of the last call were lost: an env failed, or Ctrl-C
                interrupted it.
            EnvRaised, WorkerDied, EnvHung: an env failed; the results of the others are dropped.
        """
        try:
            observations, rewards, terminated, truncated, found = self.envs.step(self._sent)
        except ResetNeeded as error:
            error.add_note("with a model, model.set_env(env): learn() then begins with a reset")
            raise
        done = terminated | truncated
        infos = LazyInfos(partial(_infos_of_step, found, done))
        for k in np.flatnonzero(done).tolist():
            infos[k], self.reset_infos[k] = self._last_and_first(infos[k])
            infos[k]["TimeLimit.truncated"] = not terminated[k]
        return observations, rewards, done, infos

    def _last_and_first(self, info: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Split an info into the last of an episode and the first of the next; see `SameStep`."""
        if "final_obs" not in info:
            raise ValueError(
                f"{type(self._inner).__name__} has ended an episode without final_obs in its "
                "infos, so the last observation is unknown: a vector env with same-step "
                "autoreset must report it"
            )
        last_observation = info.pop("final_obs")
        return {**info.pop("final_info", {}), "terminal_observation": last_observation}, info

    def close(self) -> None:
        """Close the envs and end their workers; idempotent."""
        self.envs.close()

    # -- methods and attributes -------------------------------------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Get an attribute of envs, found through their wrappers.

        Where a vector env can't ask its envs, it is the vector env's own.

        Raises:
            AttributeError: an env has no such attribute.
        """
        if self._ours is not None or self._separate is not None:
            return self.env_method("get_wrapper_attr", attr_name, indices=indices)
        if hasattr(self._inner, "call"):
            values = self._inner.call("get_wrapper_attr", attr_name)
        else:
            values = [getattr(self._inner, attr_name)] * self.num_envs
        return [values[k] for k in self._places(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Return True if all envs have an attribute. Its value is not transferred."""
        if self._separate is None and not hasattr(self._inner, "call"):
            return hasattr(self._inner, attr_name)
        return all(self.env_method("has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the outermost wrapper of envs."""
        chosen = list(dict.fromkeys(self._places(indices)))
        if self._ours is not None or self._separate is not None:
            self.env_method("__setattr__", attr_name, value, indices=chosen)
        else:
            self._check_all(chosen, f"set {attr_name} of")
            self._inner.set_attr(attr_name, [value] * self.num_envs)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of envs, found through their wrappers; in workers, in parallel.

        Raises:
            ValueError: the vector env can't call only some of its envs.
        """
        places = self._places(indices)
        if self._ours is not None:
            # An env that is named several times is called as often.
            turns = [places] if len(set(places)) == len(places) else [[k] for k in places]
            asked = (
                self._ours.ask(turn, "call_wrapped", method_name, *method_args, **method_kwargs)
                for turn in turns
            )
            return [value for values in asked for value in values]
        if self._separate is not None:
            each = [self._separate[k].get_wrapper_attr(method_name) for k in places]
            return [one(*method_args, **method_kwargs) if callable(one) else one for one in each]
        self._check_all(places, f"call {method_name}() of")
        if not hasattr(self._inner, "call"):
            raise NotImplementedError(
                f"a {type(self._inner).__name__} can't call {method_name}() of its envs"
            )
        return list(self._inner.call(method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return for each env whether `wrapper_class` is among its wrappers."""
        places, name = self._places(indices), name_of(wrapper_class)
        if self._ours is not None:
            found = self._ours.ask(None, "is_wrapped", name)
            return [found[k] for k in places]
        if self._separate is not None:
            return [has_wrapper(self._separate[k], name) for k in places]
        # An AsyncVectorEnv can't be asked. After True, evaluations would take rewards from infos
        # alone; after False, they warn, and take those of the steps.
        ask: Any = getattr(self._inner, "env_is_wrapped", None)
        return [ask is not None and ask(wrapper_class)] * len(places)

    def get_images(self) -> list[Any]:
        """Return one rendered frame of each env."""
        return list(self.envs.render())

    def _places(self, indices: Any) -> list[int]:
        return [range(self.num_envs)[k] for k in self._get_indices(indices)]

    def _check_all(self, places: list[int], what: str) -> None:
        if places != list(range(self.num_envs)):
            raise ValueError(
                f"a {type(self._inner).__name__} can't {what} only some of its envs: give VecEnv a "
                "list of callables, one for each env"
            )


class _LazyVectorEnv(VectorEnv):
    """Makes infos when they are read: most programs read one only at the end of an episode."""

    def _infos(self, batch: BatchedData) -> dict[str, Any]:
        return LazyColumns(partial(reported_infos, batch), partial(reported_info_list, batch))


def _check_given(envs: gym.vector.VectorEnv[Any, Any, Any], entry: dict[str, Any]) -> None:
    """Check that a vector env resets its envs as Stable-Baselines3 wants it."""
    mode = autoreset_mode_of(envs)
    if entry:
        raise ConfigError(f"{', '.join(entry)}: a vector env has no workers to configure")
    if mode != AutoresetMode.SAME_STEP:
        raise ConfigError(
            f"{type(envs.unwrapped).__name__} has autoreset_mode {mode}; Stable-Baselines3 "
            "needs AutoresetMode.SAME_STEP"
        )


def _each(infos: dict[str, Any], done: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """List the infos of the envs; a vector env may leave out masks."""
    each = infos.each() if isinstance(infos, LazyColumns) else None
    if each is not None:
        return each
    # What an env has left to its next episode is of that env alone.
    masks = {f"_{key}": done for key in ("final_obs", "final_info") if key in infos}
    return listed(infos_of_each({**masks, **infos}, len(done)), len(done))


def _infos_of_step(found: dict[str, Any], done: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """List the infos of a step; of envs whose episode goes on, with ``TimeLimit.truncated``."""
    each = _each(found, done)
    for k in np.flatnonzero(~done).tolist():
        each[k]["TimeLimit.truncated"] = False
    return each
