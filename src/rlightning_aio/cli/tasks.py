"""The tasks of the simulators that have a list of them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym

from rlightning_aio.errors import ConfigError
from rlightning_aio.registry import BACKENDS, ENVS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["names_of_tasks"]


def _entry_point(spec: Any) -> str:
    return str(spec.entry_point or spec.vector_entry_point)


def _of_gymnasium() -> Iterable[str]:
    return [name for name, spec in gym.registry.items() if "envs.mujoco" not in _entry_point(spec)]


def _of_mujoco() -> Iterable[str]:
    return [name for name, spec in gym.registry.items() if "envs.mujoco" in _entry_point(spec)]


def _of_ale() -> Iterable[str]:
    importlib.import_module("ale_py")
    return [name for name in gym.registry if name.startswith("ALE/")]


def _of_pettingzoo() -> Iterable[str]:
    return importlib.import_module("pettingzoo").parallel_registry


def _of_maniskill() -> Iterable[str]:
    importlib.import_module("mani_skill.envs")
    return importlib.import_module("mani_skill.utils.registration").REGISTERED_ENVS


_LISTS: Final[dict[str, Callable[[], Iterable[str]]]] = {
    "gymnasium": _of_gymnasium,
    "mujoco": _of_mujoco,
    "ale": _of_ale,
    "pettingzoo": _of_pettingzoo,
    "maniskill": _of_maniskill,
}


def names_of_tasks(backend: str) -> list[str]:
    """Return the names of the tasks of a backend's simulator, as installed here.

    Raises:
        ConfigError: there is no such backend, it has no list of tasks, or it is not installed.
    """
    if backend not in _LISTS:
        known = ", ".join(_LISTS)
        if not ENVS.knows(backend):
            raise ConfigError(ENVS.unknown(backend))
        raise ConfigError(
            f"backend {backend!r} has no list of tasks; docs/backends.md describes its `task`, and "
            f"there are lists for {known}"
        )
    known_backend = BACKENDS[backend]
    if not known_backend.is_installed():
        raise ConfigError(f"backend {backend!r} is not installed: {known_backend.install}")
    return sorted(_LISTS[backend]())
