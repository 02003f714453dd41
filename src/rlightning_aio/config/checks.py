"""Checks that compare fields of entries, or look for what they name (modules, programs)."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rlightning_aio.config.entry import MADE_BY_GYMNASIUM, EnvConfig, makers_of
from rlightning_aio.config.problems import Problems
from rlightning_aio.registry import CALLABLE, ENVS, placement_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence


@dataclass(slots=True)
class Entry:
    """One entry while it is checked.

    Attributes:
        place: its name in messages.
        config: its fields. Those that are wrong have their defaults, so that later checks can
            read the others.
        faulty: the fields that are wrong.
    """

    place: str
    config: EnvConfig
    faulty: set[str]


def check_installed(configs: Iterable[EnvConfig]) -> None:
    """Look for the simulators of entries that run on this Python, importing none of them.

    Raises:
        ConfigError: one is missing; the message has the command that installs it.
    """
    problems = Problems("simulator not installed")
    for index, config in enumerate(configs):
        backend = ENVS.described(config.backend)
        if backend is None or not runs_here(config) or ENVS.registered(config.backend):
            continue
        if not backend.is_installed():
            problems.add(
                f"envs.{index} ({config.name!r}), backend",
                f"{backend.name!r} needs {backend.module}: {backend.install}",
            )
    problems.raise_any()


def runs_here(config: EnvConfig) -> bool:
    """Return True if the entry's workers see the modules that this process sees."""
    return config.interpreter is None and placement_of(config.backend, config.placement).local


def check_entry(entry: Entry, problems: Problems) -> None:
    """Compare the fields of one entry with each other and with what its placement supports."""
    for name, check in _CHECKS.items():
        if name in entry.faulty or (name == "task" and "num_workers" in entry.faulty):
            continue  # A task of several callables is compared with their number.
        if (text := check(entry.config)) is not None:
            problems.add(f"{entry.place}, {name}", text)
    for name, why in _refused(entry.config).items():
        if name not in entry.faulty:
            problems.add(f"{entry.place}, {name}", why)


def _refused(config: EnvConfig) -> dict[str, str]:
    """Return the reason for each field that has no meaning where the entry's envs live."""
    refuses = placement_of(config.backend, config.placement).refuses
    placed = f"placement {config.placement!r}"
    where = f"backend {config.backend!r}" if "placement" in refuses else placed
    return {
        name: f"has no meaning with {where}: {why}"
        for name, why in refuses.items()
        if name in config.model_fields_set and not _is_neutral(config, name)
    }


def _is_neutral(config: EnvConfig, name: str) -> bool:
    """Return True if a field is set to a default that asks for nothing: none, empty, off, or 1.

    Restarts after exceptions of an env need no worker.
    """
    if name == "max_restarts" and config.on_env_error == "restart":
        return True
    default = EnvConfig.model_fields[name].get_default(call_default_factory=True, validated_data={})
    return (not default or default == 1) and getattr(config, name) == default


def _check_backend(config: EnvConfig) -> str | None:
    # Imported modules register backends, and another Python has backends of its own.
    if config.imports or not runs_here(config) or ENVS.knows(config.backend):
        return None
    return ENVS.unknown(config.backend)


def _check_env_kwargs(config: EnvConfig) -> str | None:
    if config.backend not in MADE_BY_GYMNASIUM:
        return None
    said = [
        f"{name}: is the field {field!r} of the entry; give it there"
        for name, field in _GIVEN_BY_FIELDS.items()
        if name in config.env_kwargs
    ]
    return "; ".join(said) or None


_GIVEN_BY_FIELDS: Final = {
    "max_episode_steps": "max_episode_steps", "id": "task", "num_envs": "num_envs",
}  # fmt: skip
"""Arguments of `gymnasium.make` and `make_vec`, by the fields that they are made of."""


def _check_task(config: EnvConfig) -> str | None:
    task = config.task
    if isinstance(task, str):
        if config.backend in MADE_BY_GYMNASIUM and task.endswith((".yaml", ".yml")):
            return f"should be a name, got {task!r}; load_config reads files"
        if config.backend == CALLABLE and not all(task.partition(":")):
            return f"should be a callable or look like module:function, got {task!r}"
        return None if task or config.backend == "env_server" else "is required"
    if config.backend != CALLABLE:
        return f"backend {config.backend!r} takes a name, not a callable; leave the backend out"
    if (count := len(makers_of(config))) != config.num_workers:
        return f"has {count} callables for num_workers: {config.num_workers}"
    return None


def _check_placement(config: EnvConfig) -> str | None:
    if config.placement == "ray" and config.is_hardware:
        return (
            f"an actor of Ray can't be told to stop what {config.name!r} moves while it "
            "is at work; use placement: process, or a client of an env_server on another machine"
        )
    return None


def _check_num_envs(config: EnvConfig) -> str | None:
    backend = None if ENVS.registered(config.backend) else ENVS.described(config.backend)
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


def _check_on_env_error(config: EnvConfig) -> str | None:
    if config.on_env_error == "restart" and config.is_hardware:
        return f"restart would move what {config.name!r} moves; only your resets may"
    return None


def _check_recycle(config: EnvConfig) -> str | None:
    if config.recycle and config.is_hardware:
        return f"what {config.name!r} moves can't belong to two workers at a time"
    return None


_CHECKS: dict[str, Callable[[EnvConfig], str | None]] = {
    "backend": _check_backend,
    "task": _check_task,
    "env_kwargs": _check_env_kwargs,
    "placement": _check_placement,
    "num_envs": _check_num_envs,
    "interpreter": _check_interpreter,
    "on_env_error": _check_on_env_error,
    "recycle": _check_recycle,
}


def check_names(entries: Sequence[Entry], problems: Problems) -> None:
    """Refuse entries that share a name."""
    first: dict[str, Entry] = {}
    for entry in entries:
        if "name" in entry.faulty:
            continue
        owner = first.setdefault(entry.config.name, entry)
        if owner is not entry:
            first_place = owner.place.partition(" ")[0]
            problems.add(
                f"{entry.place}, name",
                f"is also the name of {first_place}; env ids begin with it, so names must differ",
            )


def check_imports(entries: Sequence[Entry], shared: tuple[str, ...], problems: Problems) -> None:
    """Look for the modules of ``imports``: `shared` by the file, and the entries' own."""
    here = [entry for entry in entries if runs_here(entry.config)]
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
    """Return True if a module can be found, without running any part of it.

    `importlib.util.find_spec` would import the packages that contain a submodule.
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
