"""One entry of a configuration: its fields, their types and defaults."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from rlightning_aio.config.problems import Problems, as_text, explained
from rlightning_aio.registry import CALLABLE, ENVS, PLACEMENTS, is_mujocos, name_of, placement_of

MADE_BY_GYMNASIUM = ("gymnasium", "mujoco", "ale")
"""Backends whose `env_kwargs` go to `gymnasium.make`."""


class _Fields(BaseModel):
    """Fields whose mistakes raise one `ConfigError`, as those of a mapping do."""

    if not TYPE_CHECKING:  # A type checker would then know none of the fields.

        def __init__(self, **fields):
            problems = Problems(type(self).__name__)
            try:
                super().__init__(**fields)
            except ValidationError as error:
                known = type(self).model_fields
                for path, text in explained(error.errors(include_url=False), fields, known):
                    problems.add(path, text)
            problems.raise_any()

        # As that of pydantic's classes, so that validation doesn't call it.
        __init__.__pydantic_base_init__ = True


class EnvConfig(_Fields):
    """One entry of ``envs:``, which makes ``num_workers`` envs of one kind."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)

    name: str = Field(default="", min_length=1)
    """Name of the entry; its envs have the ids ``<name>-0``, ``<name>-1``, … By default that of the
    task or of the callable."""
    backend: str = Field(default="", validate_default=True)
    """Simulator backend (``rlightning-aio backends`` lists them). By default ``callable`` where
    envs come from a callable, ``mujoco`` for Gymnasium's MuJoCo tasks, and ``gymnasium``."""
    task: str | Callable[..., Any] | tuple[Callable[..., Any], ...] = ""
    """Task name within the backend; required by every backend but ``env_server``. For the
    backend ``callable``: ``module:function``, a callable, or one for each env. The worker calls
    it with ``env_kwargs``, and it returns a `gymnasium.Env`, a `gymnasium.vector.VectorEnv`, a
    `BaseEnv` or an object whose ``reset`` and ``step`` are ``async def``."""
    num_workers: int = Field(default=1, ge=1)
    """Number of envs; by default that of the callables."""
    num_envs: int = Field(default=1, ge=1)
    """Number of vectorised sub-environments in each env, where the backend supports them."""
    max_episode_steps: int | None = Field(default=None, ge=1)
    """Step limit of an episode; None leaves it to the simulator."""
    num_cpus: float = Field(default=1, ge=0)
    """CPUs of each worker; 0 reserves none (``placement: ray`` only)."""
    num_gpus: float = Field(default=0.0, ge=0)
    """GPUs of each actor, whole ones or a fraction of one (``placement: ray`` only)."""
    env_kwargs: dict[str, Any] = Field(default_factory=dict)
    """Passed to the backend."""
    placement: str = "process"
    """Place where the envs live: worker processes, this process (``inline``), its event loop
    (``loop``, for awaitable envs), or Ray actors."""
    max_concurrency: int | None = Field(default=None, ge=1)
    """Number of this entry's envs that may execute a request at once; the others queue. None sets
    no limit (``placement: loop`` only)."""
    envs_per_process: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Envs that share a worker."""
    step_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one step may take before the env counts as hung. Its worker is ended at most a
    quarter of the shortest limit (or 20 ms) after that; a step is as fast as without a limit."""
    reset_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one reset may take."""
    start_timeout: float = Field(default=120.0, gt=0)
    """Seconds from the start of a worker until its envs are built."""
    close_timeout: float | None = Field(default=None, gt=0, le=86400)
    """Seconds that all envs of the entry may take to close; None gives awaitable envs 10 seconds,
    filmed ones 60 (``record_video``), and others 1.5."""
    on_worker_death: Literal["restart", "raise"] = "restart"
    """Reaction to a worker that dies or hangs; ``raise`` by default for hardware."""
    on_env_error: Literal["raise", "restart"] = "raise"
    """Reaction to an exception of an env's `reset` or `step`: raise it, or close and rebuild the
    env and begin another episode, whose first result is marked like that of a replaced worker."""
    max_restarts: int = Field(default=3, ge=0)
    """Number of restarts in a row, without a completed step in between, before giving up."""
    recycle: dict[Literal["episodes", "memory_mb"], Annotated[int, Field(ge=1)]] = {}
    """When a worker is replaced between two episodes, before a leak ends it: once it has played so
    many (``{episodes: 500}``, of all its envs together), or before its resident memory, with that
    of its descendants, exceeds a limit in MB (``{memory_mb: 4000}``). Nothing is lost or marked."""
    imports: tuple[str, ...] = Field(default=(), strict=False)
    """Modules imported in the worker before the env is built."""
    interpreter: str | None = None
    """Python of another virtual environment for this entry's workers."""
    env_vars: dict[str, str] = Field(default_factory=dict)
    """Environment variables of the worker, set before anything is imported; ``{process_index}`` in
    a value stands for the number of the worker among the entry's."""
    ray_options: dict[str, Any] = Field(default_factory=dict)
    """Arguments for ``.options()`` of a Ray actor, except `num_cpus` and `num_gpus`, and
    ``address``, the cluster's (``placement: ray`` only)."""

    @property
    def task_name(self) -> str:
        """Return the task, or an empty string if callables make the envs."""
        return self.task if isinstance(self.task, str) else ""

    @property
    def is_hardware(self) -> bool:
        """Return True if the envs are known to move something real."""
        return ENVS.is_hardware(self.backend, self.task)

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, fields: Any) -> Any:
        is_mapping = isinstance(fields, Mapping)
        return completed(cast("Mapping[str, Any]", fields)) if is_mapping else fields

    @field_validator("backend")
    @classmethod
    def _require_backend(cls, backend: str) -> str:
        if not backend:
            raise ValueError("is required where no task is given")
        return backend

    @field_validator("task", mode="before")
    @classmethod
    def _know_tasks(cls, task: Any) -> Any:
        if isinstance(task, str) or callable(task):
            return task
        makers = cast("Sequence[Any]", task if isinstance(task, list | tuple) else ())
        if makers and all(map(callable, makers)):
            return tuple(makers)
        text = as_text(cast("object", task))
        raise ValueError(f"should be a name, a callable or a list of callables, got {text}")

    @field_validator("env_vars", mode="before")
    @classmethod
    def _write_numbers_out(cls, env_vars: Any) -> Any:
        # YAML reads `OMP_NUM_THREADS: 1` as a number. A boolean stays refused: programs
        # disagree on whether it is spelt 1, true or True.
        if not isinstance(env_vars, Mapping):
            return env_vars
        items = cast("Mapping[Any, Any]", env_vars).items()
        return {k: str(v) if type(v) in (int, float) else v for k, v in items}

    @field_validator("env_vars")
    @classmethod
    def _accept_usable_names(cls, env_vars: dict[str, str]) -> dict[str, str]:
        for name, value in env_vars.items():
            if not name or "=" in name or "\0" in name + value:
                raise ValueError(f"{name!r} can't be set in an environment")
        return env_vars

    @field_validator("placement")
    @classmethod
    def _know_placement(cls, placement: str) -> str:
        if placement not in PLACEMENTS:
            *others, last = map(repr, PLACEMENTS)
            raise ValueError(f"should be {', '.join(others)} or {last}, got {placement!r}")
        return placement

    @field_validator("interpreter")
    @classmethod
    def _expand_home(cls, interpreter: str | None) -> str | None:
        # pathlib would make `python` of `./python`, which is looked for elsewhere.
        return interpreter and os.path.expanduser(interpreter)  # noqa: PTH111

    @model_validator(mode="after")
    def _leave_hardware_stopped(self) -> EnvConfig:
        # A robot's worker is replaced only if the user asks for it. Assigned past pydantic, which
        # would count the field as set by the user.
        if "on_worker_death" not in self.model_fields_set and self.is_hardware:
            object.__setattr__(self, "on_worker_death", "raise")
        return self


def completed(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return `fields` with the backend, name and number of envs that a task implies."""
    task = fields.get("task") or ""
    implied: dict[str, Any] = {"backend": _backend_of(task)} if task else {}
    if isinstance(task, list | tuple):
        implied["num_workers"] = len(cast("Sequence[Any]", task))
    whole = {**implied, **fields}
    return {"name": _name_of(task, whole["backend"]), **whole} if "backend" in whole else whole


def makers_of(config: EnvConfig) -> tuple[Callable[..., Any], ...]:
    """Return the callables of an entry, one for each env, or none if its backend makes them."""
    task: Any = config.task
    if isinstance(task, tuple):
        return cast("tuple[Callable[..., Any], ...]", task)
    return () if isinstance(task, str) else (task,) * config.num_workers


_NAMES_CALLABLE: Final = re.compile(r"[^:]*:[\w.]*|[^:]*:.*:.*|.*://.*")
"""All with a colon, but not ``module:Name-v0``, a registered name whose module is imported."""


def _backend_of(task: Any) -> str:
    if not isinstance(task, str) or _NAMES_CALLABLE.fullmatch(task):
        return CALLABLE
    import gymnasium  # noqa: PLC0415  # Workers are given their backend.

    spec = gymnasium.registry.get(task)
    return "mujoco" if spec is not None and is_mujocos(spec) else "gymnasium"


def _name_of(task: Any, backend: object) -> str:
    """Return the name of an entry that has none, such as ``Pong-v5`` for ``ALE/Pong-v5``."""
    if isinstance(task, str):  # A URL says nothing, and an env_server has no task.
        return str(backend) if not task or "://" in task else re.split("[:/]", task)[-1]
    makers = cast("Sequence[Any]", task if isinstance(task, list | tuple) else [task])
    names = {name_of(maker).rpartition(".")[2] for maker in makers}
    return "env" if len(names) != 1 or "<lambda>" in names else names.pop()


def moved(config: EnvConfig, placement: str) -> EnvConfig:
    """Return the entry with another placement, without the fields that have no meaning there."""
    kept = config.model_fields_set - placement_of(config.backend, placement).refuses.keys()
    fields = {name: getattr(config, name) for name in kept}
    return EnvConfig.model_validate({**fields, "placement": placement})
