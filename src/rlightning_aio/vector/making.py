"""Vector envs of registered tasks, and the choice of tasks whose envs are stepped together."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from gymnasium.vector import AutoresetMode

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.mujoco.of_spec import OneOf
from rlightning_aio.envs.mujoco.tasks import is_batched
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted, spec_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import is_mujocos
from rlightning_aio.sharing import check_threads
from rlightning_aio.vector.env import VectorEnv
from rlightning_aio.vector.reset_arguments import checked_mode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import gymnasium as gym
    from gymnasium import VectorizeMode
    from gymnasium.envs.registration import EnvSpec

    from rlightning_aio.vector.mujoco import MujocoVectorEnv

__all__ = ["batch_of", "imports_of", "make_vec", "steps_together", "vector_entry_point"]

Made = TypeVar("Made", bound="gym.vector.VectorEnv[Any, Any, Any]")
_OF_EVERY_VECTOR_ENV: Final = {"autoreset_mode", "shared_memory", "copy", "context", "daemon"}
"""Arguments of `VectorEnv` without a meaning for a group."""
_WHICH_ENVS: Final = {
    "name", "backend", "task", "num_workers", "num_envs", "max_episode_steps",
    "env_kwargs",
}  # fmt: skip
RUNTIME_FIELDS: Final = EnvConfig.model_fields.keys() - _WHICH_ENVS | {"autoreset_mode"}
"""Arguments that say how envs run, not which: they go to `VectorEnv`, not to the task."""


def make_vec(
    id: str | EnvSpec,  # noqa: A002  # As Gymnasium calls it.
    num_envs: int = 1,
    vectorization_mode: VectorizeMode | Literal["async"] | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv | MujocoVectorEnv:
    """Make a vector env of `num_envs` envs of one task; see `gymnasium.make_vec`.

    Args:
        id: a registered name, ``module:name``, or a spec.
        num_envs: the number of envs.
        vectorization_mode: None steps the envs of a task that `envs.mujoco` supports together,
            with the same results, in threads of this process, unless a wrapper or a field of a
            config entry needs a group; envs of any other task are separate. ``async``: always
            separate envs.
        vector_kwargs: further arguments of `VectorEnv`. Fields of a config entry that say how envs
            run (``step_timeout``, ``envs_per_process``, …) and ``autoreset_mode`` may also be given
            without it.
        wrappers: applied to each env, the first innermost; envs with wrappers are separate.
        kwargs: of `gymnasium.make`; for envs that are stepped together also ``num_threads``.
            ``disable_env_checker`` is True by default, because Gymnasium's checker slows every
            step; envs with the checker are separate.

    Raises:
        ConfigError: ``num_threads`` is wrong, or given for a task that `envs.mujoco` supports with
            an argument that keeps its envs separate.
        ValueError: the mode is unknown.
    """
    mode = getattr(vectorization_mode, "value", vectorization_mode)
    if mode not in (None, "async"):
        raise ValueError(
            f"vectorization_mode must be None or 'async', not {mode!r}: placement='inline' keeps "
            "envs in this process, and gymnasium.make_vec makes a task's own vector environment"
        )
    spec = copy.deepcopy(spec_of(id) if isinstance(id, str) else id)
    own = {name: kwargs.pop(name) for name in RUNTIME_FIELDS & kwargs.keys()}
    given = {**(vector_kwargs or {}), **own}
    of_one = {"disable_env_checker": True, **kwargs}
    separate = mode == "async" or bool(wrappers) or not given.keys() <= _OF_EVERY_VECTOR_ENV
    if steps_together(spec, kwargs, separate=separate):
        autoreset = checked_mode(given.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        return _with_spec(batch_of(spec, of_one, num_envs, autoreset), spec, kwargs)
    makers = [OneOf(spec, of_one, tuple(wrappers))] * num_envs
    return _with_spec(VectorEnv(makers, **{**imports_of(spec), **given}), spec, kwargs)


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
) -> Callable[..., VectorEnv | MujocoVectorEnv]:
    """Make a ``vector_entry_point`` for `gymnasium.register`: it makes a vector env of task `id`.

    `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")` then returns what `make_vec`
    does with `vector_kwargs`, also to libraries that call it, such as RLlib.
    """

    def make(num_envs: int, **kwargs: Any) -> VectorEnv | MujocoVectorEnv:
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
