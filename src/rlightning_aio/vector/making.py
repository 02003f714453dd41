"""`VectorEnv`s of registered tasks, and which tasks are stepped together."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, Literal

from gymnasium.vector import AutoresetMode

from rlightning_aio.envs.gymnasium import spec_of
from rlightning_aio.envs.mujoco_tasks import is_batched
from rlightning_aio.envs.of_spec import BatchOf, OneOf, VectorOf
from rlightning_aio.registry import PLACEMENTS
from rlightning_aio.sharing import num_batches, num_cores
from rlightning_aio.vector.env import VectorEnv, per_worker

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import gymnasium as gym
    from gymnasium import VectorizeMode
    from gymnasium.envs.registration import EnvSpec

__all__ = ["imports_of", "make_vec", "steps_together", "together", "vector_entry_point"]

Mode = Literal["async", "vector_entry_point"]


def make_vec(
    id: str | EnvSpec,  # noqa: A002  # As Gymnasium calls it.
    num_envs: int = 1,
    vectorization_mode: VectorizeMode | Mode | None = None,
    vector_kwargs: Mapping[str, Any] | None = None,
    wrappers: Sequence[Callable[[gym.Env[Any, Any]], gym.Env[Any, Any]]] = (),
    **kwargs: Any,
) -> VectorEnv:
    """A `VectorEnv` of so many envs of one task; see `gymnasium.make_vec`.

    Args:
        id: a registered name, ``module:name``, or a spec.
        num_envs: how many.
        vectorization_mode: None has the envs of a task that `mujoco_batch` knows stepped
            together, with the same results, as many in each worker and in this process
            (``placement: split``), and those of any other separately. ``async``: separately,
            whatever the task. ``vector_entry_point``: each worker has the task's own vector
            environment, whose seeds and infos may differ from separate envs'.
        vector_kwargs: further arguments of `VectorEnv`.
        wrappers: put around each env, the first innermost; envs with any are separate.
        kwargs: of `gymnasium.make`, or of the task's vector environment. Gymnasium's checker,
            which stays in the path of every step, is left out unless
            ``disable_env_checker=False`` is among them; envs with it are separate.

    Raises:
        ValueError: the task has no vector environment, or it takes no wrappers; or the mode is
            none of these.
    """
    mode = getattr(vectorization_mode, "value", vectorization_mode)
    spec = copy.deepcopy(spec_of(id) if isinstance(id, str) else id)
    given = {**imports_of(spec), **(vector_kwargs or {})}
    one = OneOf(spec, {"disable_env_checker": True, **kwargs}, tuple(wrappers))
    makers: list[Callable[[], Any]] = [one] * num_envs
    if mode == "vector_entry_point":
        if spec.vector_entry_point is None or wrappers:
            reason = "takes no wrappers of single envs" if wrappers else "has no such entry point"
            raise ValueError(f"{spec.id} {reason}; leave vectorization_mode out")
        count, given = _laid_out(num_envs, given)
        makers = [VectorOf(spec, num_envs // count, kwargs)] * count
    elif mode not in (None, "async"):
        raise ValueError(
            "vectorization_mode must be None, 'async' or 'vector_entry_point', not "
            f"{mode!r}; vector_kwargs={{'placement': 'inline'}} keeps envs in this "
            "process"
        )
    elif mode is None and not wrappers and steps_together(spec, kwargs):
        autoreset = AutoresetMode(given.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        makers, given = together(one, num_envs, autoreset, given)
    env = VectorEnv(makers, **given)
    env.spec = copy.deepcopy(spec)
    env.spec.kwargs.update(kwargs)
    return env


def vector_entry_point(
    id: str | EnvSpec,  # noqa: A002
    **vector_kwargs: Any,
) -> Callable[..., VectorEnv]:
    """What `gymnasium.register` takes as ``vector_entry_point``, to serve task `id` from here.

    `gymnasium.make_vec(..., vectorization_mode="vector_entry_point")`, and whoever calls it
    (RLlib, say), gets a `VectorEnv` with `vector_kwargs` then.
    """

    def make(num_envs: int, **kwargs: Any) -> VectorEnv:
        return make_vec(id, num_envs, vector_kwargs=vector_kwargs, **kwargs)

    return make


def steps_together(spec: EnvSpec, kwargs: Mapping[str, Any]) -> bool:
    """Whether nobody notices, but by the speed, that envs of a task are stepped together.

    Args:
        spec: of the task.
        kwargs: of `gymnasium.make`. Gymnasium's checker and a window for each env are of single
            envs.
    """
    single = kwargs.get("render_mode", spec.kwargs.get("render_mode")) == "human"
    return is_batched(spec) and kwargs.get("disable_env_checker", True) and not single


def together(
    one: OneOf, num_envs: int, mode: AutoresetMode, arguments: dict[str, Any]
) -> tuple[list[Callable[[], Any]], dict[str, Any]]:
    """What makes envs of a task that are stepped together, and where they live.

    Whoever steps them waits for all, and their simulator is one that does not crash: so one
    share lives in this process, unless an argument asks for what only workers can do.

    Args:
        one: makes one of them.
        num_envs: in all.
        mode: what each does after its episode's end.
        arguments: as of `_laid_out`.
    """
    count, given = _laid_out(num_envs, arguments)
    if not given.keys() & {"placement", *PLACEMENTS["split"].refuses}:
        given["placement"] = "split"
    return [one if count == num_envs else BatchOf(one, num_envs // count, mode)] * count, given


def _laid_out(num_envs: int, arguments: dict[str, Any]) -> tuple[int, dict[str, Any]]:
    """In how many batches envs are laid over workers, and how an entry says that.

    Args:
        num_envs: in all.
        arguments: of `VectorEnv`, or fields of the entry. Those that say how many workers there
            are, or how many envs share one, are about the envs; those that are returned are
            about batches.
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
    """What an entry of the task has to say of it."""
    # Known before the first env is made, it need not tell every time that its assets are old.
    is_mujoco = str(spec.entry_point).startswith("gymnasium.envs.mujoco")
    return {"imports": ("mujoco",)} if is_mujoco else {}
