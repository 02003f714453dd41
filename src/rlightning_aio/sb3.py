"""Stable-Baselines3's vector interface: a group of envs, or any vector env, as its `VecEnv`.

It replaces `stable_baselines3.common.vec_env.SubprocVecEnv`, with bit-identical results.
docs/stable_baselines3.md lists the differences.
"""

from __future__ import annotations

import contextlib
import copy
import inspect
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.contents import reported_info_list
from rlightning_aio.batch.infos import listed
from rlightning_aio.calling import collect_calls
from rlightning_aio.envs.adapted.makers import adapted
from rlightning_aio.envs.simulators.gymnasium import spec_of
from rlightning_aio.envs.wrappers import autoreset_mode_of, has_wrapper, name_of
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.trees import index
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.deaths import cause_and_rest
from rlightning_aio.vector.lazy_infos import LazyInfos
from rlightning_aio.vector.leftovers import drop_outstanding
from rlightning_aio.vector.making import batch_of, steps_together
from rlightning_aio.vector.requests import send_call, send_resets, send_wrapper_question

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from numpy.typing import NDArray

__all__ = ["VecEnv", "make_vec_env"]

# An optional dependency with incomplete annotations, so imported by name.
_Base: Any = import_module("stable_baselines3.common.vec_env.base_vec_env").VecEnv
_OF_SINGLE_ENVS: Final = ("wrapper_class", "wrapper_kwargs", "monitor_dir", "monitor_kwargs")
"""Arguments of Stable-Baselines3's `make_vec_env` that keep envs from being stepped together."""
_IGNORED: Final = {"start_method"}
"""Arguments of `VecEnv` without a meaning."""


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

    Envs of a MuJoCo task that `rlightning_aio.envs.mujoco.batch` supports are stepped together, in
    threads of this process, inside a `VecMonitor`. Envs of any other task, and envs that need a
    wrapper, a file or a worker each, are separate, each in a `Monitor`.

    Args:
        env_id: a registered name, or a callable that makes an env.
        n_envs: the number of envs.
        seed: env k gets ``seed + k`` at the next reset.
        env_kwargs: of `gymnasium.make`; for envs that are stepped together also ``num_threads``.
        vec_env_kwargs: of `VecEnv`: fields of a config entry. Envs with one are separate.
        vec_env_cls: ignored if it is `SubprocVecEnv` or `DummyVecEnv`.
        more: further arguments of Stable-Baselines3's function.

    Raises:
        ValueError: `vec_env_cls` is another class.
        TypeError: an argument is unknown.
        ConfigError: ``num_threads`` is wrong, or another argument keeps the envs of the task
            separate.
    """
    vec_envs = import_module("stable_baselines3.common.vec_env")
    if vec_env_cls not in (None, VecEnv, vec_envs.SubprocVecEnv, vec_envs.DummyVecEnv):
        raise ValueError(
            f"vec_env_cls is {vec_env_cls.__name__}, and these envs are in a {VecEnv.__name__}: "
            "leave it out, or call Stable-Baselines3's make_vec_env"
        )
    make: Any = import_module("stable_baselines3.common.env_util").make_vec_env
    given = {"env_kwargs": env_kwargs, "vec_env_kwargs": vec_env_kwargs, **more}
    inspect.signature(make).bind(env_id, n_envs, seed, **given)
    fields, kwargs = vec_env_kwargs or {}, {"render_mode": "rgb_array", **(env_kwargs or {})}
    separate = any(more.get(name) for name in _OF_SINGLE_ENVS) or not fields.keys() <= _IGNORED
    if isinstance(env_id, str) and steps_together(
        spec := spec_of(env_id), kwargs, separate=separate
    ):
        kwargs = {"disable_env_checker": True, **kwargs}
        made = VecEnv(batch_of(spec, kwargs, n_envs, AutoresetMode.SAME_STEP))
        made.seed(seed)
        return vec_envs.VecMonitor(made)
    return make(env_id, n_envs, seed, vec_env_cls=VecEnv, **given)


class VecEnv(_Base):
    """Envs in worker processes, or a vector env, behind Stable-Baselines3's vector interface.

    Args:
        env_fns: one callable for each env. They are called only in the workers; lambdas and
            functions of ``__main__`` are allowed. Or a `gymnasium.vector.VectorEnv` with same-step
            autoreset, Gymnasium's own included: it stays in this process, without a group.
        start_method: accepted and ignored.
        entry: further fields of `EnvConfig` (``envs_per_process``, ``step_timeout``, …).

    Attributes:
        group: the `EnvGroup` that runs the envs ``env-0``, ``env-1``, …, one for each callable.

    Raises:
        ConfigError: a callable can't be sent to a worker, `entry` is wrong, or spaces differ.
        StartFailed: a callable raised, or didn't return an env.
        TypeError: `env_fns` is no list of callables.
    """

    def __new__(cls, env_fns: Any, *arguments: Any, **entry: Any) -> Any:
        """Make one for a vector env, if that is given in place of callables."""
        del arguments, entry
        is_vector = isinstance(env_fns, gym.vector.VectorEnv)
        chosen: Any = _OfVector if is_vector else cls
        return object.__new__(chosen)

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]] | gym.vector.VectorEnv[Any, Any, Any],
        start_method: str | None = None,
        **entry: Any,
    ) -> None:
        del start_method
        assert not isinstance(env_fns, gym.vector.VectorEnv)  # See `__new__`.
        self.group: EnvGroup = build_env_group(adapted(env_fns, AutoresetMode.SAME_STEP, entry))
        metas = self.group.init()
        try:
            first, *others = [(meta.observation_space, meta.action_space) for meta in metas]
            for k, spaces in enumerate(others, 1):
                if spaces is not first and spaces != first:
                    raise ConfigError(
                        f"the spaces of env {k} are not those of env 0; Stable-Baselines3 needs "
                        "equal spaces"
                    )
            # The last results of all envs, in order; actions respond to them.
            self._answerable = BatchedData(self.group.env_ids, [None] * len(metas))
            self._unfinished = False
            # Results of a step or reset were not returned, so no episode can go on.
            self._has_lost = False
            _Base.__init__(self, len(metas), *first)
            self.metadata: dict[str, Any] = {**self.get_attr("metadata", 0)[0], **self.metadata}
        except BaseException:
            self.group.close()
            raise

    def reset(self) -> Any:
        """Reset all envs with the seeds and options that were set since the last reset.

        Returns observations ``[num_envs, ...]``, or dicts or tuples of them. The infos are in
        `reset_infos`.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; the results of the others are dropped.
        """
        with self._exchange(), self._dropping_the_rest():
            self._has_lost = True
            options = [own or None for own in self._options]  # As Stable-Baselines3 does.
            send_resets(self.group, self._seeds, options, range(self.num_envs))
            batch, _ = self.group.collect_async(wait_all=True)
        self.reset_infos = reported_info_list(batch)
        self._reset_seeds()
        self._reset_options()
        found = self._copied_observations(batch)
        self._has_lost = False
        return found

    def step_async(self, actions: Any) -> None:
        """Send one action to each env: an array or a sequence, cast to the dtype of the space.

        Raises:
            BadAction: the actions don't fit; nothing was sent.
            ResetNeeded: the results of the last step or reset were lost: an env failed, or Ctrl-C
                interrupted it.
        """
        self._begin()
        if self._has_lost:
            raise ResetNeeded(
                "the results of the last step or reset were lost, as it failed or was interrupted; "
                "call reset(), or model.set_env(env), after which learn() begins with a reset"
            )
        if isinstance(self.action_space, gym.spaces.Dict | gym.spaces.Tuple):
            if len(actions) != self.num_envs:
                raise ValueError(f"{len(actions)} actions for num_envs={self.num_envs}")
            pairs = zip(self.group.env_ids, actions, strict=True)
            each = [PolicyResponse(env_id, action) for env_id, action in pairs]
            responses = BatchedData(self.group.env_ids, each)
        else:
            responses = self._answerable.respond(action=np.asarray(actions))
        self._has_lost = True  # Until they are returned.
        try:
            self.group.step_async(responses)
        except BadAction:
            self._has_lost = False
            raise

    def step_wait(self) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], list[dict[str, Any]]]:
        """Wait for the steps.

        Returns observations, rewards, done flags and infos. If an episode is done, the observation
        is the first of the next episode, and the info has the last one of this episode as
        ``terminal_observation``. Each info has ``TimeLimit.truncated``. The list of infos is made
        when it is first read.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; the results of the others are dropped.
        """
        with self._dropping_the_rest():
            batch, _ = self.group.collect_async(wait_all=True)
        self._answerable, self._unfinished = batch, False
        done = batch.done
        infos = LazyInfos(lambda: _infos_of_step(batch))
        ended = np.flatnonzero(done).tolist()
        lost = batch.restarted if ended else done
        for k in ended:
            cut = infos[k].pop("TimeLimit.truncated")
            returned = index(self._observations, k) if lost[k] else None
            infos[k], self.reset_infos[k] = _last_and_first(infos[k], returned)
            infos[k]["TimeLimit.truncated"] = cut
        found = self._copied_observations(batch), batch.reward, done, infos
        self._has_lost = False
        return found

    def _copied_observations(self, batch: BatchedData) -> Any:
        """Copy the observations, and keep them: a death makes them an episode's last ones."""
        self._observations = batch.observation
        return copy.deepcopy(self._observations)

    def _begin(self) -> None:
        """Before sending, drop what an interrupted call (by Ctrl-C, for example) has left."""
        if self._unfinished:
            drop_outstanding(self.group)
        self._unfinished = True

    @contextlib.contextmanager
    def _exchange(self) -> Generator[None]:
        """Context whose requests are answered before it ends."""
        self._begin()
        yield
        self._unfinished = False

    @contextlib.contextmanager
    def _dropping_the_rest(self) -> Generator[None]:
        """Context that drops the results of the other envs if one fails, so all can be reset."""
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
        """Get an attribute of envs, found through their wrappers.

        Raises:
            AttributeError: an env has no such attribute.
        """
        return self._call(indices, "get_wrapper_attr", attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Return True if all envs have an attribute. Its value is not transferred."""
        return all(self._call(None, "has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the outermost wrapper of envs."""
        with self._exchange():
            send_call(self.group, "__setattr__", (attr_name, value), {}, self._chosen(indices))
            collect_calls(self.group)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of envs, found through their wrappers, in parallel."""
        return self._call(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return for each env whether `wrapper_class` is among its wrappers."""
        chosen = self._chosen(indices)
        with self._exchange():
            send_wrapper_question(self.group, wrapper_class, chosen)
            each = dict(zip(chosen, collect_calls(self.group), strict=True))
        return [each[k] for k in self._places(indices)]

    def get_images(self) -> list[Any]:
        """Return one rendered frame of each env."""
        return self._call(None, "render")

    def _call(self, indices: Any, name: str, /, *args: Any, **kwargs: Any) -> list[Any]:
        places = self._places(indices)
        values: dict[int, Any] = {}
        while left := [k for k in range(len(places)) if k not in values]:
            # An env that is named several times is called several times, once in each turn.
            turn = {places[k]: k for k in reversed(left)}
            found = self._call_each(list(turn), name, args, kwargs)
            values.update(zip(turn.values(), found, strict=True))
        return [values[k] for k in range(len(places))]

    def _call_each(self, places: list[int], name: str, args: Any, kwargs: Any) -> Sequence[Any]:
        with self._exchange():
            send_call(self.group, name, args, kwargs, places)
            return collect_calls(self.group)

    def _places(self, indices: Any) -> list[int]:
        return [range(self.num_envs)[k] for k in self._get_indices(indices)]

    def _chosen(self, indices: Any) -> list[int]:
        """The places of envs, without duplicates."""
        return list(dict.fromkeys(self._places(indices)))


class _OfVector(VecEnv):
    """A vector env with same-step autoreset behind Stable-Baselines3's vector interface.

    Args:
        env_fns: the vector env.
        start_method: accepted and ignored.
        entry: must be empty.

    Raises:
        ConfigError: it has another autoreset mode, or fields of an entry are given.
    """

    def __init__(self, env_fns: Any, start_method: str | None = None, **entry: Any) -> None:
        del start_method
        envs, mode = env_fns, autoreset_mode_of(env_fns)
        if entry:
            raise ConfigError(f"{', '.join(entry)}: a vector env has no workers to configure")
        if mode != AutoresetMode.SAME_STEP:
            raise ConfigError(
                f"{type(envs.unwrapped).__name__} has autoreset_mode {mode}; Stable-Baselines3 "
                "needs AutoresetMode.SAME_STEP"
            )
        self.envs: Any = envs
        self._inner: Any = envs.unwrapped
        is_sync = isinstance(envs.unwrapped, gym.vector.SyncVectorEnv)
        self._separate: list[Any] | None = envs.unwrapped.envs if is_sync else None
        self._sent: Any = None
        self.render_mode = envs.render_mode
        spaces = envs.single_observation_space, envs.single_action_space
        _Base.__init__(self, envs.num_envs, *spaces)
        self.metadata = {**envs.metadata, **self.metadata}

    def __getattr__(self, name: str) -> Any:
        if name == "group":  # That of a `VectorEnv`; others say what they lack.
            return self._inner.group
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def reset(self) -> Any:
        seeds = None if all(seed is None for seed in self._seeds) else list(self._seeds)
        options = self._options[0] or None
        if any((own or None) != options for own in self._options):
            raise ValueError("reset options differ between envs that a vector env resets together")
        observations, infos = self.envs.reset(seed=seeds, options=options)
        self.reset_infos = listed(infos, self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: Any) -> None:
        space = self.action_space
        if not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
            self._sent = np.array(actions, space.dtype)
            return
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions for num_envs={self.num_envs}")
        empty: Any = gym.vector.utils.create_empty_array(space, self.num_envs)
        self._sent = gym.vector.utils.concatenate(space, actions, empty)

    def step_wait(self) -> tuple[Any, NDArray[np.float64], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, found = self.envs.step(self._sent)
        done = terminated | truncated
        infos = LazyInfos(lambda: _with_cuts(listed(found, self.num_envs), truncated & ~terminated))
        for k in np.flatnonzero(done).tolist():
            cut = infos[k].pop("TimeLimit.truncated")
            infos[k], self.reset_infos[k] = _last_and_first(infos[k], None)
            infos[k]["TimeLimit.truncated"] = cut
        return observations, rewards, done, infos

    def close(self) -> None:
        self.envs.close()

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        chosen = self._chosen(indices)
        if self._separate is not None:
            for k in chosen:
                setattr(self._separate[k], attr_name, value)
            return
        if len(chosen) < self.num_envs:
            raise ValueError(
                f"{attr_name} can't be set for only some envs of a {type(self._inner).__name__}: "
                "give VecEnv a list of callables, one for each env"
            )
        self._inner.set_attr(attr_name, [value] * self.num_envs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        places = self._places(indices)
        if self._separate is not None:
            name = name_of(wrapper_class)
            return [has_wrapper(self._separate[k], name) for k in places]
        # An AsyncVectorEnv can't be asked. After True, evaluations would take rewards from infos
        # alone; after False, they warn, and take those of the steps.
        ask: Any = getattr(self._inner, "env_is_wrapped", None)
        return [ask is not None and ask(wrapper_class)] * len(places)

    def _call_each(self, places: list[int], name: str, args: Any, kwargs: Any) -> Sequence[Any]:
        if self._separate is not None:
            each = [self._separate[k].get_wrapper_attr(name) for k in places]
            return [one(*args, **kwargs) if callable(one) else one for one in each]
        if len(places) == self.num_envs:
            values = self._inner.call(name, *args, **kwargs)
            return [values[k] for k in places]
        if not hasattr(self._inner, "envs"):
            raise ValueError(
                f"{type(self._inner).__name__} can't call {name}() of only some of its envs"
            )
        envs: Any = self._inner.envs
        found = [getattr(envs[k], name) for k in places]
        return [one(*args, **kwargs) if callable(one) else one for one in found]


def _with_cuts(each: list[dict[str, Any]], cuts: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Add ``TimeLimit.truncated`` to each info, and return them."""
    for info, cut in zip(each, cuts.tolist(), strict=True):
        info["TimeLimit.truncated"] = cut
    return each


def _infos_of_step(batch: BatchedData) -> list[dict[str, Any]]:
    """List the infos of a step, with ``TimeLimit.truncated``."""
    return _with_cuts(reported_info_list(batch), batch.truncated & ~batch.terminated)


def _last_and_first(
    info: dict[str, Any], returned: Any | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split an info into the last of an episode and the first of the next; see `SameStep`.

    An episode that was lost with its worker ends with the observation `returned` last.
    """
    cause, first = cause_and_rest(info)
    if returned is None:
        return {**info["final_info"], "terminal_observation": info["final_obs"]}, first
    return {**cause, "terminal_observation": copy.deepcopy(returned)}, first
