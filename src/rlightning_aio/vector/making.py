"""Vector envs of registered tasks: which task comes as what.

Rule: nothing is slower than what the peer makes by default. docs/gymnasium.md has the table.
"""

from __future__ import annotations

import copy
import inspect
from typing import TYPE_CHECKING, Any, Final, TypeVar

import gymnasium as gym
from gymnasium import VectorizeMode
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.mujoco.tasks import is_batched
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted, spec_of
from rlightning_aio.envs.wrappers import OneOf
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import is_mujocos, name_of
from rlightning_aio.sharing import check_threads
from rlightning_aio.vector.env import VectorEnv
from rlightning_aio.vector.interface import checked_mode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from gymnasium.envs.registration import EnvSpec

    from rlightning_aio.vector.mujoco import MujocoVectorEnv

Made = TypeVar("Made", bound="gym.vector.VectorEnv[Any, Any, Any]")
_OF_EVERY_VECTOR_ENV: Final = {"autoreset_mode", "shared_memory", "copy", "context", "daemon"}
"""Arguments of `VectorEnv` without a meaning for a group."""
_WORKERS_OWN: Final = {"shared_memory", "context", "daemon"}
"""Arguments of `AsyncVectorEnv` that a `SyncVectorEnv` doesn't take."""
_BRIEF: Final = ("classic_control", "toy_text", "phys2d", "tabular")
"""Packages of Gymnasium's tasks whose step takes microseconds; the last two are those in JAX."""
_WHICH_ENVS: Final = {
    "name", "backend", "task", "num_workers", "num_envs", "max_episode_steps",
    "env_kwargs",
}  # fmt: skip
RUNTIME_FIELDS: Final = EnvConfig.model_fields.keys() - _WHICH_ENVS | {"autoreset_mode"}
"""Arguments that say how envs run, not which: they go to `VectorEnv`, not to the task."""


def make_vec(
    id: str | EnvSpec,  # noqa: A002  # As Gymnasium calls it.
    num_envs: int = 1,
    vectorization_mode: VectorizeMode | str | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv | MujocoVectorEnv | gym.vector.VectorEnv[Any, Any, Any]:
    """Make a vector env of `num_envs` envs of one task; see `gymnasium.make_vec`.

    Args:
        id: a registered name, ``module:name``, or a spec.
        num_envs: the number of envs.
        vectorization_mode: None makes what is fastest. A task that `envs.mujoco` supports is one
            batch in threads of this process. Classic control, toy text and a single env are what
            Gymnasium makes by default: the task's own vector env, or a `SyncVectorEnv` where that
            can't do what was asked. All else is a `VectorEnv`, in workers. Wrappers and
            Gymnasium's checker need separate envs, and a field of a config entry a `VectorEnv`.
            ``async``: always a `VectorEnv`. ``sync`` and ``vector_entry_point``: what
            `gymnasium.make_vec` makes of these arguments.
        vector_kwargs: further arguments of `VectorEnv`. Fields of a config entry that say how envs
            run (``step_timeout``, ``envs_per_process``, …) and ``autoreset_mode`` may also be given
            without it.
        wrappers: applied to each env, the first innermost.
        kwargs: of `gymnasium.make`; for envs that are stepped together also ``num_threads``.
            ``disable_env_checker`` is True by default, because Gymnasium's checker slows every
            step.

    Raises:
        ConfigError: ``num_threads`` is wrong, or given for a task that `envs.mujoco` supports with
            an argument that keeps its envs separate; or a field of a config entry is given with
            one of Gymnasium's modes.
        ValueError: the mode is unknown, or there is no env.
        TypeError: `id` is a class or a function.
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, not {num_envs!r}")
    if callable(id):
        raise TypeError(f"this is no registered task: use VectorEnv([{name_of(id)}] * n)")
    mode = None if vectorization_mode is None else VectorizeMode(vectorization_mode)
    spec = copy.deepcopy(spec_of(id) if isinstance(id, str) else id)
    around: list[Any] = [*wrappers]
    if mode == VectorizeMode.VECTOR_ENTRY_POINT:
        return gym.make_vec(spec, num_envs, mode, {**(vector_kwargs or {})}, around, **kwargs)
    own = {name: kwargs.pop(name) for name in RUNTIME_FIELDS & kwargs.keys()}
    given = {**(vector_kwargs or {}), **own}
    if mode == VectorizeMode.SYNC:
        if fields := sorted(given.keys() & RUNTIME_FIELDS - {"autoreset_mode"}):
            raise ConfigError(f"{', '.join(fields)}: leave out vectorization_mode to have workers")
        return gym.make_vec(spec, num_envs, mode, given, around, **kwargs)
    in_workers = mode is not None or not given.keys() <= {*_OF_EVERY_VECTOR_ENV, "observation_mode"}
    of_one = {"disable_env_checker": True, **kwargs}
    separate = in_workers or bool(around) or "observation_mode" in given
    if steps_together(spec, kwargs, separate=separate):
        autoreset = checked_mode(given.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        return _with_spec(batch_of(spec, of_one, num_envs, autoreset), spec, kwargs)
    if not in_workers and (num_envs == 1 or is_brief(spec)):
        return _of_gymnasium(spec, num_envs, given, around, of_one)
    makers = [OneOf(spec, of_one, tuple(around))] * num_envs
    return _with_spec(VectorEnv(makers, **{**imports_of(spec), **given}), spec, kwargs)


def is_brief(spec: EnvSpec) -> bool:
    """Return True for one of Gymnasium's tasks whose step costs less than the way to a worker."""
    package, _, rest = str(spec.entry_point).partition(".envs.")
    return package == "gymnasium" and rest.partition(".")[0] in _BRIEF


def _of_gymnasium(
    spec: EnvSpec,
    num_envs: int,
    given: Mapping[str, Any],
    wrappers: Sequence[Any],
    kwargs: dict[str, Any],
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make the task's own vector env if it can do all that was asked, else a `SyncVectorEnv`."""
    autoreset = checked_mode(given.get("autoreset_mode", AutoresetMode.NEXT_STEP))
    entry_point, plain = spec.vector_entry_point, dict(kwargs)
    unchecked = plain.pop("disable_env_checker")
    as_asked = (
        unchecked
        and autoreset == AutoresetMode.NEXT_STEP
        and given.get("observation_mode", "same") == "same"
        and not (wrappers or spec.additional_wrappers)
    )
    if is_brief(spec) and entry_point is not None and as_asked:
        make = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
        if _takes(make, {**spec.kwargs, **plain}):
            return gym.make_vec(spec, num_envs, VectorizeMode.VECTOR_ENTRY_POINT, **plain)
    of_loop = {name: value for name, value in given.items() if name not in _WORKERS_OWN}
    of_loop["autoreset_mode"] = autoreset
    return gym.make_vec(spec, num_envs, VectorizeMode.SYNC, of_loop, wrappers, **kwargs)


def _takes(make: Callable[..., Any], kwargs: dict[str, Any]) -> bool:
    """Return True if a task's own vector env has these arguments; none of them draws windows."""
    try:
        inspect.signature(make).bind(num_envs=1, **kwargs)
    except TypeError:
        return False
    return kwargs.get("render_mode") != "human"


def _with_spec(env: Made, spec: EnvSpec, kwargs: Mapping[str, Any]) -> Made:
    env.spec = copy.deepcopy(spec)
    env.spec.kwargs.update(kwargs)
    return env


def batch_of(
    spec: EnvSpec, kwargs: Mapping[str, Any], num_envs: int, mode: AutoresetMode
) -> MujocoVectorEnv:
    """Make envs that are stepped together.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`, and ``num_threads``.
        num_envs: the number of envs.
        mode: when an env is reset after the end of its episode.
    """
    # It imports MuJoCo.
    from rlightning_aio.vector.mujoco import MujocoVectorEnv  # noqa: PLC0415

    of_one = dict(kwargs)
    num_threads = of_one.pop("num_threads", None)
    with outdated_assets_accepted():
        return MujocoVectorEnv(OneOf(spec, of_one)(), num_envs, mode, num_threads=num_threads)


def vector_entry_point(
    id: str | EnvSpec,  # noqa: A002
    **vector_kwargs: Any,
) -> Callable[..., gym.vector.VectorEnv[Any, Any, Any]]:
    """Make a ``vector_entry_point`` for `gymnasium.register`: it makes a vector env of task `id`.

    `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")` then returns what `make_vec`
    does with `vector_kwargs`, also to libraries that call it, such as RLlib.
    """

    def make(num_envs: int, **kwargs: Any) -> gym.vector.VectorEnv[Any, Any, Any]:
        return make_vec(id, num_envs, vector_kwargs=vector_kwargs, **kwargs)

    return make


def steps_together(spec: EnvSpec, kwargs: Mapping[str, Any], *, separate: bool = False) -> bool:
    """Return True if stepping the envs of a task together changes nothing but the speed.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`. Gymnasium's checker and windows need separate envs.
        separate: other arguments need separate envs.

    Raises:
        ConfigError: ``num_threads`` of a task that allows it is wrong, or its envs are separate.
    """
    if not is_batched(spec):
        return False
    check_threads("num_threads", kwargs.get("num_threads"))
    window = kwargs.get("render_mode", spec.kwargs.get("render_mode")) == "human"
    if not (separate or window or not kwargs.get("disable_env_checker", True)):
        return True
    if kwargs.get("num_threads") is not None:
        raise ConfigError(
            "num_threads needs envs that are stepped together: leave out what separates them "
            "(wrappers, monitors of single envs, Gymnasium's checker, a window, fields of a "
            "config entry, vectorization_mode='async'), or make an EnvGroup with "
            "EnvConfig(num_envs=...)"
        )
    return False


def imports_of(spec: EnvSpec) -> dict[str, Any]:
    """Fields that an entry of the task needs."""
    # Imported before the first env is made, mujoco doesn't warn each time that assets are old.
    return {"imports": ("mujoco",)} if is_mujocos(spec) else {}
