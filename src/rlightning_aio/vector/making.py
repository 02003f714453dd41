"""`VectorEnv`s of registered tasks, and the choice of tasks whose envs are stepped together."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from gymnasium.vector import AutoresetMode

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.mujoco.of_spec import BatchOf, OneOf, VectorOf
from rlightning_aio.envs.mujoco.tasks import is_batched
from rlightning_aio.envs.simulators.gymnasium import outdated_assets_accepted, spec_of
from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import PLACEMENTS, is_mujocos
from rlightning_aio.sharing import check_threads, num_batches, num_cores
from rlightning_aio.vector.env import VectorEnv, per_worker
from rlightning_aio.vector.reset_arguments import checked_mode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import gymnasium as gym
    from gymnasium import VectorizeMode
    from gymnasium.envs.registration import EnvSpec

    from rlightning_aio.vector.mujoco import MujocoVectorEnv

__all__ = ["alone", "imports_of", "make_vec", "steps_together", "together", "vector_entry_point"]

Made = TypeVar("Made", bound="gym.vector.VectorEnv[Any, Any, Any]")
Mode = Literal["async", "vector_entry_point"]
BATCH_OPTIONS: Final = ("num_threads", "randomize")
"""Options of envs that are stepped together, in addition to those of the task."""
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
    vectorization_mode: VectorizeMode | Mode | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv | MujocoVectorEnv:
    """Make a vector env of `num_envs` envs of one task; see `gymnasium.make_vec`.

    Args:
        id: a registered name, ``module:name``, or a spec.
        num_envs: the number of envs.
        vectorization_mode: None steps the envs of a task that `envs.mujoco` supports together,
            with the same results, in threads of this process, and makes a group only if a field of
            a config entry is given; envs of any other task are separate. ``async``: always separate
            envs. ``vector_entry_point``: each worker has the task's own vector environment, whose
            seeds and infos may differ from those of separate envs.
        vector_kwargs: further arguments of `VectorEnv`. Fields of a config entry that say how envs
            run (``step_timeout``, ``envs_per_process``, …) and ``autoreset_mode`` may also be given
            without it.
        wrappers: applied to each env, the first innermost; envs with wrappers are separate.
        kwargs: of `gymnasium.make`, or of the task's vector environment; for envs that are stepped
            together also `BATCH_OPTIONS`. ``disable_env_checker`` is True by default, because
            Gymnasium's checker slows every step; envs with the checker are separate.

    Raises:
        ConfigError: `BATCH_OPTIONS` are wrong, or given for a task that `mujoco_batch` supports
            with an argument that keeps its envs separate.
        ValueError: the task has no vector environment, or the mode allows no wrappers or is
            unknown.
    """
    mode = getattr(vectorization_mode, "value", vectorization_mode)
    spec = copy.deepcopy(spec_of(id) if isinstance(id, str) else id)
    own = {name: kwargs.pop(name) for name in RUNTIME_FIELDS & kwargs.keys()}
    asked = {**(vector_kwargs or {}), **own}
    given = {**imports_of(spec), **asked}
    of_one = {"disable_env_checker": True, **kwargs}
    makers: list[Callable[[], Any]] = [OneOf(spec, of_one, tuple(wrappers))] * num_envs
    if mode == "vector_entry_point":
        if spec.vector_entry_point is None or wrappers:
            reason = "takes no wrappers of single envs" if wrappers else "has no such entry point"
            raise ValueError(f"{spec.id} {reason}; leave vectorization_mode out")
        count, given = _laid_out(num_envs, given)
        makers = [VectorOf(spec, num_envs // count, kwargs)] * count
    elif mode not in (None, "async"):
        raise ValueError(
            "vectorization_mode must be None, 'async' or 'vector_entry_point', not "
            f"{mode!r}; placement='inline' keeps envs in this process"
        )
    elif steps_together(spec, kwargs, separate=mode == "async" or bool(wrappers)):
        autoreset = checked_mode(given.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if asked.keys() <= _OF_EVERY_VECTOR_ENV:
            return _with_spec(alone(spec, of_one, num_envs, autoreset), spec, kwargs)
        makers, given = together(spec, of_one, num_envs, autoreset, given)
    return _with_spec(VectorEnv(makers, **given), spec, kwargs)


def _with_spec(env: Made, spec: EnvSpec, kwargs: Mapping[str, Any]) -> Made:
    env.spec = copy.deepcopy(spec)
    env.spec.kwargs.update(kwargs)
    return env


def alone(
    spec: EnvSpec, kwargs: Mapping[str, Any], num_envs: int, mode: AutoresetMode
) -> MujocoVectorEnv:
    """Make envs that are stepped together in this process; arguments as of `together`."""
    # It imports MuJoCo.
    from rlightning_aio.vector.mujoco import MujocoVectorEnv  # noqa: PLC0415

    options = {name: kwargs[name] for name in BATCH_OPTIONS if name in kwargs}
    one = OneOf(spec, {name: kwargs[name] for name in kwargs if name not in options})
    with outdated_assets_accepted():
        return MujocoVectorEnv(one(), num_envs, mode, **options)


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
        ConfigError: `BATCH_OPTIONS` of a task that allows it are wrong, or its envs are separate.
    """
    if not is_batched(spec):
        return False
    check_threads("num_threads", kwargs.get("num_threads"))
    window = kwargs.get("render_mode", spec.kwargs.get("render_mode")) == "human"
    if not (separate or window or not kwargs.get("disable_env_checker", True)):
        return True
    for name in BATCH_OPTIONS:
        if kwargs.get(name) is not None:
            raise ConfigError(
                f"{name} needs envs that are stepped together: leave out what separates them "
                "(wrappers, monitors of single envs, Gymnasium's checker, a window, "
                "vectorization_mode='async')"
            )
    return False


def together(
    spec: EnvSpec,
    kwargs: Mapping[str, Any],
    num_envs: int,
    mode: AutoresetMode,
    arguments: dict[str, Any],
) -> tuple[list[Callable[[], Any]], dict[str, Any]]:
    """Return callables that make batches of envs stepped together, and the fields of their entry.

    MuJoCo steps them in threads of this process and doesn't crash, so there are workers only if
    an argument needs them.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`, and `BATCH_OPTIONS`.
        num_envs: the total number of envs.
        mode: when an env is reset after the end of its episode.
        arguments: see `_laid_out`.
    """
    options = {name: kwargs[name] for name in BATCH_OPTIONS if name in kwargs}
    one = OneOf(spec, {name: kwargs[name] for name in kwargs if name not in options})
    if arguments.keys() & {"placement", "max_concurrency", *PLACEMENTS["inline"].refuses}:
        count, given = _laid_out(num_envs, arguments)
    else:
        count, given = 1, {**arguments, "placement": "inline"}
    if count == num_envs:
        if options.get("randomize"):
            raise ConfigError(
                "randomize needs envs that are stepped together: several in each batch"
            )
        return [one] * count, given
    options.setdefault("num_threads", max(1, num_cores() // count))
    return [BatchOf(one, num_envs // count, mode, **options)] * count, given


def _laid_out(num_envs: int, arguments: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """Return the number of batches, and the fields of an entry that spread them over workers.

    Args:
        num_envs: the total number of envs.
        arguments: of `VectorEnv`, or fields of the entry. ``max_concurrency`` and
            ``envs_per_process`` count envs; the returned ``envs_per_process`` counts batches.
    """
    rest = {
        name: value
        for name, value in arguments.items()
        if name not in ("max_concurrency", "envs_per_process")
    }
    if arguments.get("placement") == "inline":
        return num_batches(num_envs, 1), arguments
    share = arguments.get("envs_per_process", "auto")
    if arguments.get("max_concurrency") is not None:
        share = per_worker(arguments["max_concurrency"], num_envs)
    workers = num_cores() if share == "auto" else -(-num_envs // share)
    count = num_batches(num_envs, workers)
    return count, {**rest, "envs_per_process": -(-count // workers)}


def imports_of(spec: EnvSpec) -> dict[str, Any]:
    """Fields that an entry of the task needs."""
    # Imported before the first env is made, mujoco doesn't warn each time that assets are old.
    return {"imports": ("mujoco",)} if is_mujocos(spec) else {}
