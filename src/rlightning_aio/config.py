"""`EnvConfig` and `load_config`: the only door for what users configure.

Rule: whatever is wrong is said here, before any process starts, in one message that
names file, entry and field of every problem. OmegaConf reads, pydantic checks one
entry, and what remains (names that must exist) is checked without importing any of it.
Absent on purpose: defaults that depend on the machine; those are the group's business.
"""

from __future__ import annotations

import difflib
import importlib.util
import itertools
import os
import reprlib
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, ENVS, PLACEMENTS, placement_of
from rlightning_aio.sharing import num_batches, num_cores

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

__all__ = [
    "MADE_BY_GYMNASIUM",
    "EnvConfig",
    "VideoConfig",
    "check_installed",
    "load_config",
    "moved",
    "parse_configs",
]

_TOP_LEVEL = ("envs", "env", "imports")
_CALLABLE = "callable"
"""Name of the backend whose envs come from a callable."""
MADE_BY_GYMNASIUM = ("gymnasium", "mujoco", "ale")
"""Backends whose `env_kwargs` go to `gymnasium.make`."""
_TYPO = 0.8
"""So much does a misspelt name resemble the right one; other sections of a file do less."""


class VideoConfig(BaseModel):
    """Which episodes of an entry's envs are filmed, and where the files go."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    folder: str = Field(min_length=1)
    """Gets ``<env id>-episode-<n>.mp4``; n counts the episodes of the env from 0, or from the
    last film that is there. It is created if missing."""
    envs: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(0,), strict=False)
    """Which envs of the entry, from 0. Each has a worker of its own, so that the others never
    wait for a frame, unless `EnvConfig.envs_per_process` says how many share one."""
    sub_env: int = Field(default=0, ge=0)
    """Which of an env's sub-environments."""
    every: int = Field(default=1, ge=1)
    """Film episodes 0, every, 2 * every, …"""
    episodes: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(default=None, strict=False)
    """Film only these."""

    @field_validator("folder")
    @classmethod
    def _find_from_anywhere(cls, folder: str) -> str:
        # Where "~" is nobody's, it is a name as any other.
        return os.path.abspath(os.path.expanduser(folder))  # noqa: PTH100, PTH111

    def wants(self, episode: int) -> bool:
        """Whether the episode of that number is to be filmed."""
        if self.episodes is not None:
            return episode in self.episodes
        return episode % self.every == 0


class EnvConfig(BaseModel):
    """One entry of ``envs:``, which makes ``num_workers`` envs of one kind."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    name: str = Field(min_length=1)
    """Name of the entry; its envs are called ``<name>-0``, ``<name>-1``, …"""
    backend: str = Field(default="", validate_default=True)
    """Simulator backend; see ``rlightning-aio backends``. Leave it out where envs come from a
    callable; it is ``callable`` then."""
    task: str = ""
    """Task name within the backend; required by every backend but ``env_server``. For the
    backend ``callable``: ``module:function``, which makes an env of ``env_kwargs``."""
    make_env: Callable[..., Any] | tuple[Callable[..., Any], ...] | None = Field(
        default=None, repr=False
    )
    """What makes an env, called in the worker with ``env_kwargs``: one callable, or one for each
    env. It returns a `gymnasium.Env`, a `gymnasium.vector.VectorEnv` or a `BaseEnv`."""
    num_workers: int = Field(default=1, ge=1)
    """Envs of this entry. With ``auto``, `num_envs` is the total number of sub-environments,
    which is spread over the cores; both fields then hold the outcome."""
    num_envs: int = Field(default=1, ge=1)
    """Vectorised sub-environments in each env, where the backend supports them."""
    max_episode_steps: int | None = Field(default=None, ge=1)
    """Step limit of an episode; None leaves it to the simulator."""
    num_cpus: float = Field(default=1, ge=0)
    """CPUs of each worker, 0 for a share of what others leave (``placement: ray`` only)."""
    num_gpus: float = Field(default=0.0, ge=0)
    """GPUs of each worker, from those that Ray has or that this process sees; whole ones, or a
    fraction of one."""
    env_kwargs: dict[str, Any] = Field(default_factory=dict)
    """Passed to the backend."""
    placement: str = "process"
    """Where the envs live: worker processes, this process (``inline``), or Ray actors."""
    envs_per_process: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Envs that share a worker."""
    min_results: int | None = Field(default=None, ge=1)
    """Results of this entry that `collect_async` waits for by default; the values of all entries
    are added up."""
    step_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one step may take before the env counts as hung."""
    reset_timeout: float | None = Field(default=None, gt=0)
    """Seconds that one reset may take."""
    start_timeout: float = Field(default=120.0, gt=0)
    """Seconds from the start of a worker until its envs are built."""
    on_worker_death: Literal["restart", "raise", "resume"] = "restart"
    """What to do when a worker dies or hangs; ``raise`` by default for hardware."""
    snapshot_every: int | None = Field(default=None, ge=1)
    """Number of steps after which an env's state is saved, for ``on_worker_death: resume``."""
    max_restarts: int = Field(default=3, ge=0)
    """Restarts in a row, without a step in between, before giving up."""
    imports: tuple[str, ...] = Field(default=(), strict=False)
    """Modules imported in the worker before the env is built."""
    interpreter: str | None = None
    """Python of another virtual environment for this entry's workers."""
    env_vars: dict[str, str] = Field(default_factory=dict)
    """Environment variables of the worker, set before anything is imported; ``{worker_index}`` in a
    value is the number of the worker among the entry's."""
    cpu_affinity: bool = False
    """Pin worker k to the k-th core this process may use."""
    ray_options: dict[str, Any] = Field(default_factory=dict)
    """Options of a Ray actor other than `num_cpus` and `num_gpus`, as its ``.options()`` takes
    them, and ``address``, that of the cluster (``placement: ray`` only)."""
    video: VideoConfig | None = None
    """Episodes that are filmed where the envs live; of a running group, see `record_video`."""

    @model_validator(mode="before")
    @classmethod
    def _suggest_known_names(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        given = cast("Mapping[str, Any]", fields)
        for name in given:
            if name not in cls.model_fields:
                raise ValueError(f"{name}: {_unknown_field(name, cls.model_fields)}")
        return _laid_out(_with_backend(given))

    @field_validator("backend")
    @classmethod
    def _require_backend(cls, backend: str) -> str:
        if not backend:
            raise ValueError("is required")
        return backend

    @field_validator("num_workers", mode="before")
    @classmethod
    def _know_how_many(cls, num_workers: Any) -> Any:
        if num_workers == "auto":
            raise ValueError(
                "'auto' spreads the sub-environments of num_envs over the cores, and these envs "
                "have none; give a number"
            )
        return num_workers

    @field_validator("make_env", mode="before")
    @classmethod
    def _accept_lists(cls, makers: Any) -> Any:
        return tuple(cast("list[Any]", makers)) if isinstance(makers, list) else makers

    @field_validator("env_vars", mode="before")
    @classmethod
    def _write_numbers_out(cls, env_vars: Any) -> Any:
        # YAML makes numbers of `OMP_NUM_THREADS: 1`. A boolean stays refused: programs
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
    def _leave_robots_alone(self) -> EnvConfig:
        # Nobody but the user has a robot's worker replaced. Past the frozen fields' guard, which
        # would count this as given.
        if "on_worker_death" not in self.model_fields_set and ENVS.is_hardware(self.backend):
            object.__setattr__(self, "on_worker_death", "raise")
        return self


def _with_backend(fields: Mapping[str, Any]) -> Mapping[str, Any]:
    """`fields`, with the backend that goes without saying."""
    if "backend" in fields or ("make_env" not in fields and ":" not in str(fields.get("task"))):
        return fields
    return {**fields, "backend": _CALLABLE}


def _laid_out(fields: Mapping[str, Any]) -> Mapping[str, Any]:
    """`fields`, with as many envs as suit the cores where that is asked for, and can be."""
    total, name = fields.get("num_envs", 1), str(fields.get("backend"))
    backend = BACKENDS.get(name)
    several = name != _CALLABLE and (backend is None or backend.vectorized)
    if fields.get("num_workers") != "auto" or not several or type(total) is not int or total < 1:
        return fields
    # Others compute many at once by themselves.
    spread = fields.get("placement") != "inline" and ENVS.is_cpu_bound(name)
    count = num_batches(total, num_cores()) if spread else 1
    return {**fields, "num_workers": count, "num_envs": total // count}


def moved(config: EnvConfig, placement: str) -> EnvConfig:
    """An entry whose envs live elsewhere, without the fields that have no meaning there."""
    kept = config.model_fields_set - placement_of(config.backend, placement).refuses.keys()
    fields = {name: getattr(config, name) for name in kept}
    return EnvConfig.model_validate({**fields, "placement": placement})


def load_config(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> list[EnvConfig]:
    """Read a YAML file with ``envs:`` (or ``env:``) and, optionally, ``imports:``.

    Args:
        path: the file. Other sections, such as those of a whole experiment, are ignored; entries
            may refer to them (``${train.seed}``).
        overrides: ``key=value`` each, applied in order; keys are dotted from the top of the
            file (``envs.0.num_workers=8``), values are YAML. They reach other sections as well.

    Returns:
        The entries in order. The file's ``imports`` come first in each entry's own.

    Raises:
        ConfigError: the file can't be read, an override fits nothing, or the content is
            wrong; every problem found is in the message.
    """
    source = os.fspath(path)
    return _parse(_read_yaml(source, overrides), source)


def parse_configs(env_cfgs: object) -> list[EnvConfig]:
    """Check what a user configured in Python.

    Args:
        env_cfgs: an `EnvConfig`, a plain mapping of its fields, or an OmegaConf node of them; a
            list of these; or a mapping with ``envs:`` (or ``env:``) and ``imports:`` as in
            a file. A node that is a part of a document has that document's ``imports``.

    Raises:
        ConfigError: something is wrong; every problem found is in the message.
    """
    return _parse(env_cfgs, "environment configuration")


def check_installed(configs: Iterable[EnvConfig]) -> None:
    """Look for the simulators of built-in backends, importing none of them.

    Entries that run elsewhere (under another ``interpreter``, on a Ray cluster) are left
    alone: what is installed here says nothing about there.

    Raises:
        ConfigError: one is missing; the message has the command that installs it.
    """
    problems = _Problems("simulator not installed")
    for index, config in enumerate(configs):
        backend = BACKENDS.get(config.backend)
        if backend is None or not _runs_here(config) or ENVS.registered(config.backend):
            continue
        if backend.installed_version() is None:
            problems.add(
                f"envs.{index} ({config.name!r}), backend",
                f"{backend.name!r} needs {backend.distribution}: {backend.install_command}",
            )
    problems.raise_any()


@dataclass(slots=True)
class _Problems:
    """What was found wrong with one source, in the order of the source."""

    source: str
    lines: list[str] = field(default_factory=list[str])

    def add(self, where: str, what: str) -> None:
        self.lines.append(f"{where}: {what}" if where else what)

    def raise_any(self) -> None:
        if len(self.lines) == 1:
            raise ConfigError(f"{self.source}: {self.lines[0]}")
        if self.lines:
            listed = "".join(f"\n  {line}" for line in self.lines)
            raise ConfigError(f"{self.source}: {len(self.lines)} problems{listed}")


# ---- a document: entries and what they share


@dataclass(slots=True)
class _Entry:
    """One entry while it is checked.

    Attributes:
        place: how messages call it.
        config: its fields; those at fault stand at their defaults, so that the checks
            still to come see all the others.
        faulty: the fields at fault.
    """

    place: str
    config: EnvConfig
    faulty: set[str]


def _parse(env_cfgs: object, source: str) -> list[EnvConfig]:
    problems = _Problems(source)
    listed, imports = _split(env_cfgs, source, problems)
    imports = _shared_imports(imports, problems)
    entries: list[_Entry] = []
    for place, given in listed:
        shared = (*imports, *_shared_imports(_imports_above(given, source), problems))
        entry = _read_entry(_plain(given, source), place, problems)
        if entry is not None:
            entry.config = _with_imports(entry.config, shared)
            entries.append(entry)
            _check_entry(entry, problems)
    _check_names(entries, problems)
    _check_imports(entries, imports, problems)
    problems.raise_any()
    return [entry.config for entry in entries]


def _split(env_cfgs: object, source: str, problems: _Problems) -> tuple[list[tuple[str, Any]], Any]:
    """The entries, each with its place, and the imports they share."""
    if isinstance(env_cfgs, EnvConfig):
        return [("envs.0", env_cfgs)], ()
    if callable(env_cfgs):
        return [("envs.0", _entry_of([env_cfgs]))], ()
    document = _sections(env_cfgs, source)
    if not isinstance(document, Mapping):
        if isinstance(document, list | tuple):
            document = _entries_of_callables(cast("Sequence[Any]", document))
        return _listed(document, "envs", problems), _imports_above(env_cfgs, source)
    fields = cast("Mapping[Any, Any]", document)
    if not {"env", "envs"} & fields.keys():
        if {"name", "backend"} & fields.keys():
            return [("envs.0", env_cfgs)], ()
        closeness = 0.0  # Nothing here is ours: whatever it is, it is not what was meant.
    else:
        closeness = _TYPO
    for name in fields:
        if name not in _TOP_LEVEL and difflib.get_close_matches(
            str(name), _TOP_LEVEL, cutoff=closeness
        ):
            problems.add(str(name), _unknown_field(name, _TOP_LEVEL))
    key = "envs" if "envs" in fields or "env" not in fields else "env"
    if {"env", "envs"} <= fields.keys():
        problems.add("env", "means the same as envs, which is there too; keep one of them")
    listed = _listed(_plain(fields.get(key, ()), source), key, problems)
    return listed, _plain(fields.get("imports", ()), source)


def _listed(entries: object, key: str, problems: _Problems) -> list[tuple[str, Any]]:
    shown = _show(entries)
    if isinstance(entries, Mapping):
        entry = cast("Mapping[Any, Any]", entries)
        if {"name", "backend"} & entry.keys():
            return [(key, entry)]
    if not isinstance(entries, list | tuple):
        hint = "; load_config reads files" if isinstance(entries, str | Path) else ""
        problems.add(key, f"should be a list of entries, got {shown}{hint}")
        return []
    if not entries:
        problems.add(key, "no entries; give at least one, with name, backend and task")
    found = cast("Sequence[Any]", entries)
    return [(f"{key}.{index}", entry) for index, entry in enumerate(found)]


def _entries_of_callables(listed: Sequence[Any]) -> list[Any]:
    """`listed`, with one entry for callables that follow one another."""
    entries: list[Any] = []
    for are_callable, group in itertools.groupby(listed, callable):
        values = list(group)
        entries += [_entry_of(values)] if are_callable else values
    return entries


def _entry_of(makers: list[Any]) -> dict[str, Any]:
    same = all(maker is makers[0] for maker in makers)
    return {
        "name": "env",
        "make_env": makers[0] if same else tuple(makers),
        "num_workers": len(makers),
    }


def _shared_imports(imports: object, problems: _Problems) -> tuple[str, ...]:
    shown = _show(imports)
    modules = cast("Sequence[Any]", imports) if isinstance(imports, list | tuple) else (None,)
    if all(isinstance(module, str) for module in modules):
        return tuple(modules)
    problems.add("imports", f"should be a list of module names, got {shown}")
    return ()


def _with_imports(config: EnvConfig, shared: tuple[str, ...]) -> EnvConfig:
    if not shared:
        return config
    return config.model_copy(update={"imports": tuple(dict.fromkeys((*shared, *config.imports)))})


# ---- an entry: its fields


def _read_entry(entry: object, place: str, problems: _Problems) -> _Entry | None:
    if isinstance(entry, EnvConfig):
        return _Entry(f"{place} ({entry.name!r})", entry, set())
    if not isinstance(entry, Mapping):
        problems.add(place, f"should be a mapping of fields, got {_show(entry)}")
        return None
    given = cast("Mapping[Any, Any]", entry)
    if isinstance(name := given.get("name"), str) and name:
        place = f"{place} ({name!r})"
    known = EnvConfig.model_fields
    for unknown in (k for k in given if k not in known):
        problems.add(f"{place}, {unknown}", _unknown_field(unknown, known))
    fields = _with_backend({k: _plain(v, place) for k, v in given.items() if k in known})
    try:
        return _Entry(place, EnvConfig.model_validate(fields), set())
    except ValidationError as error:
        faults = error.errors(include_url=False)
    for path, text in _explain(faults, fields):
        problems.add(f"{place}, {path}", text)
    faulty = {str(fault["loc"][0]) for fault in faults}
    right = {k: v for k, v in fields.items() if k not in faulty}
    return _Entry(place, EnvConfig.model_validate({"name": "?", "backend": "?"} | right), faulty)


def _explain(
    faults: Sequence[ErrorDetails], fields: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    """Path and text of each fault; the branches of a union share a path, so one text."""
    texts: dict[str, list[str]] = {}
    inputs: dict[str, str] = {}
    for fault in faults:
        path = _path(fault["loc"], fields)
        text = fault["msg"].removeprefix("Value error, ").removeprefix("Input ")
        text = text.replace("valid tuple", "list")
        texts.setdefault(path, []).append("is required" if fault["type"] == "missing" else text)
        if fault["type"] not in ("missing", "value_error"):
            inputs[path] = f", got {_show(fault['input'])}"
    for path, (first, *others) in texts.items():
        alternatives = [first, *(other.removeprefix("should be ") for other in others)]
        yield path, " or ".join(alternatives) + inputs.get(path, "")


def _path(location: Sequence[int | str], fields: Mapping[str, Any]) -> str:
    """The dotted path of a fault, without the marks pydantic adds for unions and keys."""
    value: Any = fields
    parts: list[str] = []
    for part in location:
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            break
        parts.append(str(part))
    return ".".join(parts or map(str, location[:1]))


# ---- what entries name: backends, modules, programs


def _runs_here(config: EnvConfig) -> bool:
    """Whether the entry's workers see the modules that this process sees."""
    return config.interpreter is None and placement_of(config.backend, config.placement).local


def _check_entry(entry: _Entry, problems: _Problems) -> None:
    for name, check in _CHECKS.items():
        if {name, *_COMPARED_WITH.get(name, ())} & entry.faulty:
            continue
        if (text := check(entry.config)) is not None:
            problems.add(f"{entry.place}, {name}", text)
    for name, why in _refused(entry.config).items():
        if name not in entry.faulty:
            problems.add(f"{entry.place}, {name}", why)


def _refused(config: EnvConfig) -> dict[str, str]:
    """What the entry asks for and would not get where its envs live, by field."""
    refuses = placement_of(config.backend, config.placement).refuses
    placed = f"placement {config.placement!r}"
    where = f"backend {config.backend!r}" if "placement" in refuses else placed
    return {
        name: f"has no meaning with {where}: {why}"
        for name, why in refuses.items()
        if name in config.model_fields_set and not _asks_for_nothing(config, name)
    }


def _asks_for_nothing(config: EnvConfig, name: str) -> bool:
    """Whether a field was set to what it says anyway: no limit, nothing, not, or one."""
    default = EnvConfig.model_fields[name].get_default(call_default_factory=True, validated_data={})
    return (not default or default == 1) and getattr(config, name) == default


def _check_backend(config: EnvConfig) -> str | None:
    # Imported modules register backends, and another environment has its own.
    if config.imports or not _runs_here(config) or ENVS.knows(config.backend):
        return None
    return ENVS.unknown(config.backend)


def _check_task(config: EnvConfig) -> str | None:
    if config.make_env is not None and config.backend == _CALLABLE:
        return f"make_env makes the envs; leave out {config.task!r}" if config.task else None
    if config.backend == _CALLABLE and not all(config.task.partition(":")):
        return f"should look like module:function (or give make_env), got {config.task!r}"
    return None if config.task or config.backend == "env_server" else "is required"


def _check_make_env(config: EnvConfig) -> str | None:
    makers = config.make_env
    if makers is None:
        return None
    if config.backend != _CALLABLE:
        return f"takes the place of backend {config.backend!r}; leave one of them out"
    count = len(cast("tuple[Any, ...]", makers)) if isinstance(makers, tuple) else None
    if count not in (None, config.num_workers):
        return f"has {count} callables for num_workers: {config.num_workers}"
    return None


def _check_num_envs(config: EnvConfig) -> str | None:
    backend = None if ENVS.registered(config.backend) else BACKENDS.get(config.backend)
    if config.num_envs == 1 or backend is None or backend.vectorized:
        return None
    return f"backend {backend.name!r} makes single envs; use num_workers: {config.num_envs}"


def _check_interpreter(config: EnvConfig) -> str | None:
    path = config.interpreter
    if path is None or shutil.which(path) is not None:
        return None
    if Path(path).is_dir():
        return f"{path!r} is a directory; name the program in it, such as {path}/bin/python"
    reason = "is not executable" if Path(path).exists() else "doesn't exist"
    return f"{path!r} {reason}"


def _check_min_results(config: EnvConfig) -> str | None:
    if config.min_results is None or config.backend == "env_server":
        return None
    if config.min_results <= config.num_workers:
        return None
    return f"is {config.min_results}, and num_workers: {config.num_workers} makes as many results"


def _check_snapshot_every(config: EnvConfig) -> str | None:
    if "snapshot_every" in placement_of(config.backend, config.placement).refuses:
        return None
    resumes = config.on_worker_death == "resume"
    if resumes and ENVS.is_hardware(config.backend):
        return f"on_worker_death: resume can't put back what backend {config.backend!r} moves"
    if resumes and config.snapshot_every is None:
        return "is required with on_worker_death: resume; it is the most steps that can be lost"
    if config.snapshot_every is not None and not resumes:
        return "has no meaning without on_worker_death: resume"
    return None


def _check_video(config: EnvConfig) -> str | None:
    video = config.video
    if video is None:
        return None
    if above := [k for k in video.envs if k >= config.num_workers]:
        return f"there is no env {above[0]} among num_workers: {config.num_workers}, from 0"
    if 1 < config.num_envs <= video.sub_env:
        return f"there is no sub-environment {video.sub_env} of num_envs: {config.num_envs}, from 0"
    mode = config.env_kwargs.get("render_mode")
    if config.backend in MADE_BY_GYMNASIUM and mode != "rgb_array":
        return f"needs env_kwargs: {{render_mode: rgb_array}}, got {mode!r}"
    return None


_COMPARED_WITH = {
    "task": ("make_env",),
    "make_env": ("num_workers",),
    "min_results": ("num_workers",),
    "snapshot_every": ("on_worker_death",),
    "video": ("num_workers", "num_envs", "env_kwargs"),
}
"""Fields without which nothing can be said of others."""
_CHECKS: dict[str, Callable[[EnvConfig], str | None]] = {
    "backend": _check_backend,
    "task": _check_task,
    "make_env": _check_make_env,
    "num_envs": _check_num_envs,
    "interpreter": _check_interpreter,
    "min_results": _check_min_results,
    "snapshot_every": _check_snapshot_every,
    "video": _check_video,
}


def _check_names(entries: Sequence[_Entry], problems: _Problems) -> None:
    first: dict[str, _Entry] = {}
    for entry in entries:
        if "name" in entry.faulty:
            continue
        owner = first.setdefault(entry.config.name, entry)
        if owner is not entry:
            taken_by = owner.place.partition(" ")[0]
            problems.add(
                f"{entry.place}, name",
                f"is the name of {taken_by} too; envs are told apart by their entry's name",
            )


def _check_imports(entries: Sequence[_Entry], shared: tuple[str, ...], problems: _Problems) -> None:
    here = [entry for entry in entries if _runs_here(entry.config)]
    for module in shared if here else ():
        if not _is_importable(module):
            problems.add("imports", _not_importable(module))
    for entry in here:
        for module in entry.config.imports:
            if module not in shared and not _is_importable(module):
                problems.add(f"{entry.place}, imports", _not_importable(module))


def _not_importable(module: str) -> str:
    return f"no module {module!r} on this Python's path"


def _is_importable(module: str) -> bool:
    """Whether a module can be found, without running any part of it.

    `importlib.util.find_spec` would import the packages above a submodule.
    """
    if module in sys.modules:
        return True
    top, *below = module.split(".")
    if not all(part.isidentifier() for part in (top, *below)):
        return False
    spec = sys.modules[top].__spec__ if top in sys.modules else importlib.util.find_spec(top)
    path = top
    for part in below:
        if spec is None or spec.submodule_search_locations is None:
            return False
        path = f"{path}.{part}"
        spec = PathFinder.find_spec(path, list(spec.submodule_search_locations))
    return spec is not None


# ---- words for people


def _unknown_field(name: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name), list(known), n=1)
    return (
        f"unknown field; did you mean {near[0]!r}?"
        if near
        else (f"unknown field; known: {', '.join(known)}")
    )


def _show(value: object) -> str:
    return reprlib.repr(value)


# ---- OmegaConf, imported only where its nodes or files are met: it takes a tenth of a
# second, and workers import this module too


def _plain(value: object, source: str) -> Any:
    """`value`, with an OmegaConf node turned into plain containers."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return value
    try:
        return omegaconf.OmegaConf.to_container(value, resolve=True, throw_on_missing=True)
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def _sections(value: object, source: str) -> Any:
    """`value` as plain containers; of an OmegaConf document only what is ours is looked at.

    What other sections refer to may be missing here.
    """
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.DictConfig):
        return _plain(value, source)
    document: Any = value
    if not {"env", "envs"} & document.keys():
        return _plain(value, source)
    try:
        return {k: _plain(document[k], source) if k in _TOP_LEVEL else None for k in document}
    except omegaconf.errors.OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None


def _imports_above(value: object, source: str) -> Any:
    """``imports:`` of the document that an OmegaConf node is a part of."""
    omegaconf = sys.modules.get("omegaconf")
    if omegaconf is None or not isinstance(value, omegaconf.Container):
        return ()
    node: Any = value
    while (node := node._get_parent()) is not None:  # noqa: SLF001  # There is no other way up.
        if isinstance(node, omegaconf.DictConfig) and "imports" in node:
            return _plain(node["imports"], source)
    return ()


def _first_line(error: Exception) -> str:
    where = getattr(error, "full_key", None)
    text = str(error).partition("\n")[0]
    return f"{where}: {text}" if where else text


def _read_yaml(source: str, overrides: Sequence[str]) -> Any:
    import yaml  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    try:
        document = OmegaConf.load(source)
    except yaml.YAMLError as error:
        raise ConfigError(f"{source}: {_not_yaml(error)}") from None
    except OmegaConfBaseException as error:
        raise ConfigError(f"{source}: {_first_line(error)}") from None
    except OSError as error:
        # OmegaConf itself raises one, without errno, for a file that holds a bare value.
        reason = error.strerror or "should hold envs: and a list of entries"
        raise ConfigError(f"{source}: {reason}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source}: not a UTF-8 text file ({error.reason})") from None
    _override(document, source, overrides)
    return document


def _not_yaml(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error)
    where = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{where}not valid YAML: {problem}"


def _override(document: Any, source: str, overrides: Sequence[str]) -> None:
    problems = _Problems(source)
    for override in overrides:
        if (problem := _apply(document, override)) is not None:
            problems.add(f"override {override!r}", problem)
    problems.raise_any()


def _apply(document: Any, override: str) -> str | None:
    """Apply one override in place; what is wrong with it, if anything is."""
    import yaml  # noqa: PLC0415
    from omegaconf import OmegaConf  # noqa: PLC0415
    from omegaconf.errors import OmegaConfBaseException  # noqa: PLC0415

    key, equals, text = override.partition("=")
    top, dot, below = key.partition(".")
    if not equals or not (top in _TOP_LEVEL or (OmegaConf.is_dict(document) and top in document)):
        return "should look like envs.0.num_workers=8"
    if top in ("env", "envs"):
        # Either word reaches the entries, whichever the file uses.
        top = "env" if "env" in document and "envs" not in document else "envs"
    try:
        value = OmegaConf.to_container(OmegaConf.from_dotlist([f"value={text}"]), resolve=False)
        OmegaConf.update(document, top + dot + below, cast("dict[str, Any]", value)["value"])
    except yaml.YAMLError as error:
        return f"the value is {_not_yaml(error)}"
    except (OmegaConfBaseException, TypeError, ValueError) as error:
        return f"nothing is there ({_first_line(error)})"
    return None
