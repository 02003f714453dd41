"""Stable-Baselines3's vector interface: a group of envs as one of its `VecEnv`s.

It takes the place of `stable_baselines3.common.vec_env.SubprocVecEnv`, with the same results to the
bit. docs/stable_baselines3.md tells what differs.
"""

from __future__ import annotations

import contextlib
import inspect
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode

from rlightning_aio.batch import BatchedData
from rlightning_aio.envs.gymnasium import spec_of
from rlightning_aio.envs.of_spec import OneOf
from rlightning_aio.envs.sub_envs import adapted
from rlightning_aio.errors import ConfigError, EnvRaised
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.leftovers import drop_outstanding
from rlightning_aio.vector.making import imports_of, steps_together, together
from rlightning_aio.vector.rows import rows_of

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from numpy.typing import NDArray

__all__ = ["VecEnv", "make_vec_env"]

# Optional and typed in part, so imported by name.
_Base: Any = import_module("stable_baselines3.common.vec_env.base_vec_env").VecEnv
_OF_SINGLE_ENVS: Final = ("wrapper_class", "wrapper_kwargs", "monitor_dir", "monitor_kwargs")
"""Arguments of Stable-Baselines3's `make_vec_env` that keep envs from being stepped together."""


def make_vec_env(
    env_id: str | Callable[..., gym.Env[Any, Any]],
    n_envs: int = 1,
    seed: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    vec_env_kwargs: dict[str, Any] | None = None,
    vec_env_cls: type[Any] | None = None,
    **more: Any,
) -> Any:
    """Monitored envs of one task; see `stable_baselines3.common.env_util.make_vec_env`.

    Envs of a MuJoCo task that `rlightning_aio.envs.mujoco_batch` knows are stepped together, as
    many in each worker and in this process (``placement: split``), inside a `VecMonitor`. Those
    of any other are separate, each in a `Monitor`, as are those that are to have a wrapper, or a
    file, each.

    Args:
        env_id: a registered name, or what makes an env.
        n_envs: how many.
        seed: env k gets ``seed + k`` at the next reset.
        env_kwargs: of `gymnasium.make`.
        vec_env_kwargs: of `VecEnv`: fields of a config entry.
        vec_env_cls: accepted where it is a class that `VecEnv` takes the place of, and without
            meaning here.
        more: of Stable-Baselines3's function.

    Raises:
        ValueError: `vec_env_cls` is another class.
        TypeError: an argument is unknown.
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
    single = any(more.get(name) for name in _OF_SINGLE_ENVS)
    if isinstance(env_id, str) and not single and steps_together(spec := spec_of(env_id), kwargs):
        one = OneOf(spec, {"disable_env_checker": True, **kwargs})
        fields = {**imports_of(spec), **fields}
        makers, fields = together(one, n_envs, AutoresetMode.SAME_STEP, fields)
        made = VecEnv(makers, **fields)
        made.seed(seed)
        return vec_envs.VecMonitor(made)
    return make(env_id, n_envs, seed, vec_env_cls=VecEnv, **given)


class VecEnv(_Base):
    """Envs in worker processes behind Stable-Baselines3's vector interface.

    Args:
        env_fns: one callable for each env, or for as many vector environments, each of as many
            sub-environments that reset themselves in the same step. They run in the workers, and
            only there; lambdas and functions of ``__main__`` will do.
        start_method: accepted, and without meaning here.
        entry: further fields of `EnvConfig` (``envs_per_process``, ``step_timeout``, …).

    Attributes:
        group: the `EnvGroup` that does the work; its envs, one for each callable, are called
            ``env-0``, ``env-1``, …

    Raises:
        ConfigError: a callable can't be sent to a worker, `entry` is wrong, or the envs'
            spaces differ.
        StartFailed: a callable raised, or didn't return an env.
        RuntimeError: vector environments are not of as many.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]]],
        start_method: str | None = None,
        **entry: Any,
    ) -> None:
        del start_method
        self.group: EnvGroup = build_env_group(
            {
                "name": "env",
                "num_workers": len(env_fns),
                "make_env": adapted(
                    env_fns, AutoresetMode.SAME_STEP, entry.pop("max_episode_steps", None)
                ),
                **entry,
            }
        )
        metas = self.group.init()
        try:
            self._rows = rows_of(self.group, metas)
            first = self._rows.spaces[0]
            for k, spaces in enumerate(self._rows.spaces):
                if spaces is not first and spaces != first:
                    raise ConfigError(
                        f"the spaces of env {k} are not those of env 0; Stable-Baselines3 needs "
                        "equal spaces"
                    )
            # Results of all envs, in order, which actions can answer.
            self._answerable = BatchedData(self.group.env_ids, [None] * len(metas))
            self._unfinished = False
            _Base.__init__(self, self._rows.num_envs, *first)
            with contextlib.suppress(AttributeError):  # Of some that are stepped together.
                self.metadata: dict[str, Any] = {**self.get_attr("metadata", 0)[0], **self.metadata}
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
        with self._exchange(), self._dropping_the_rest():
            self._rows.send_resets(self._seeds, self._options, range(self.num_envs))
            batch, _ = self.group.collect_async(wait_all=True, ordered=True)
        self.reset_infos = self._rows.info_list(batch)
        self._reset_seeds()
        self._reset_options()
        return self._rows.observation(batch)

    def step_async(self, actions: Any) -> None:
        """Send one action to each env, from an array or a sequence; cast to the space's dtype."""
        self._begin()
        if isinstance(self.action_space, gym.spaces.Dict | gym.spaces.Tuple):
            pairs = zip(self.group.env_ids, actions, strict=True)
            responses = [PolicyResponse(env_id, action) for env_id, action in pairs]
            self.group.step_async(BatchedData(self.group.env_ids, responses))
        else:
            columns = self._rows.actions(np.asarray(actions))
            self.group.step_async(self._answerable.respond(action=columns))

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
        self._answerable, self._unfinished = batch, False
        rows = self._rows
        infos = rows.info_list(batch)
        truncated = rows.flat(batch.truncated & ~batch.terminated).tolist()
        done = rows.flat(batch.done)
        for k in np.flatnonzero(done).tolist():
            infos[k], self.reset_infos[k] = _last_and_first(infos[k])
        for info, cut in zip(infos, truncated, strict=True):
            info["TimeLimit.truncated"] = cut
        return rows.observation(batch), rows.flat(batch.reward), done, infos

    def _begin(self) -> None:
        """Before anything is sent. What was left in the middle (by Ctrl-C, say) is waited for, and
        dropped.
        """
        if self._unfinished:
            drop_outstanding(self.group)
        self._unfinished = True

    @contextlib.contextmanager
    def _exchange(self) -> Generator[None]:
        """What is sent within is answered within."""
        self._begin()
        yield
        self._unfinished = False

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

    def has_attr(self, attr_name: str) -> bool:
        """Whether all envs have an attribute. Its value, a method perhaps, stays with them."""
        return all(self._call(None, "has_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the outermost wrapper of envs.

        Raises:
            ValueError: of some envs that are stepped together with others.
        """
        with self._exchange():
            self._rows.set_outermost(attr_name, value, list(self._get_indices(indices)))

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of envs, found through their wrappers, all at once."""
        return self._call(indices, method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether `wrapper_class` is among the wrappers of envs."""
        with self._exchange():
            return self._rows.are_wrapped(wrapper_class, list(self._get_indices(indices)))

    def get_images(self) -> list[Any]:
        """One frame of each env, as it renders it."""
        return self._call(None, "render")

    def _call(self, indices: Any, name: str, /, *args: Any, **kwargs: Any) -> list[Any]:
        chosen: list[int] = list(self._get_indices(indices))
        with self._exchange():
            self._rows.call(name, args, kwargs, chosen)
            return self._rows.values(self.group.collect_calls(), chosen)


def _last_and_first(info: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The last info of an episode and the first of the next; see `SameStep`."""
    if "final_info" not in info:  # Lost with its worker, which says so.
        return info, {}
    first = {key: value for key, value in info.items() if key not in ("final_info", "final_obs")}
    return {**info["final_info"], "terminal_observation": info["final_obs"]}, first
