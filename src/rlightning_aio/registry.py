"""Which backends exist, and how a name becomes an env class.

Rule: naming a backend imports nothing; the class is imported where it is built,
which is in a worker. Three sources, the first that knows the name wins: classes
registered in this process, built-in backends, entry points of the group
``rlightning_aio.envs``.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import importlib.util
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable


__all__ = ["BACKENDS", "ENVS", "PLACEMENTS", "Backend", "Placement", "Registry", "load"]

ENTRY_POINT_GROUP = "rlightning_aio.envs"

EnvClass = TypeVar("EnvClass", bound="type[Any]")


@dataclass(frozen=True, slots=True)
class Backend:
    """A built-in backend.

    Attributes:
        name: what a config entry's ``backend`` says.
        target: ``module:Class`` of the env class.
        module: the simulator's top module; it is looked for, never imported.
        distribution: the package whose version is shown.
        extra: the extra of this package that brings it; empty for core dependencies.
        cpu_bound: one core's worth of plain computing for each step, so that several
            envs may share a worker (``envs_per_process: auto``).
        vectorized: whether ``num_envs`` above 1 is supported.
        own_command: installs the simulator, where no extra of this package does.
        preload: modules that are safe to import before workers are forked and slow to
            import after: no threads, no devices.
    """

    name: str
    target: str
    module: str
    distribution: str
    extra: str = ""
    cpu_bound: bool = False
    vectorized: bool = False
    own_command: str = ""
    preload: tuple[str, ...] = ()

    @property
    def install_command(self) -> str:
        """The one command that installs the simulator."""
        package = f"'rlightning-aio[{self.extra}]'" if self.extra else "rlightning-aio"
        return self.own_command or f"pip install {package}"

    def installed_version(self) -> str | None:
        """Version of the simulator in this interpreter, or None if it isn't installed."""
        if importlib.util.find_spec(self.module) is None:
            return None
        try:
            return importlib.metadata.version(self.distribution)
        except importlib.metadata.PackageNotFoundError:
            return "unknown"


# Python 3.12 alone, and best in an environment of its own; docs/backends.md has the rest.
ISAAC_LAB = "pip install isaaclab==3.0.0 rlightning-aio"

# One row for one backend.
# fmt: off
BACKENDS: dict[str, Backend] = {
    backend.name: backend
    for backend in (
        Backend("mujoco", "rlightning_aio.envs.gymnasium:MujocoEnv", "mujoco", "mujoco",
                cpu_bound=True,
                preload=("rlightning_aio.envs.gymnasium", "gymnasium.envs.mujoco")),
        Backend("gymnasium", "rlightning_aio.envs.gymnasium:GymnasiumEnv", "gymnasium",
                "gymnasium", cpu_bound=True, preload=("rlightning_aio.envs.gymnasium",)),
        Backend("env_server", "rlightning_aio.hosts.env_server:EnvServerHost", "zmq", "pyzmq"),
        Backend("ale", "rlightning_aio.envs.ale:ALEEnv", "ale_py", "ale-py", extra="ale",
                cpu_bound=True, vectorized=True, preload=("rlightning_aio.envs.ale",)),
        Backend("pettingzoo", "rlightning_aio.envs.pettingzoo:PettingZooEnv", "pettingzoo",
                "pettingzoo", extra="pettingzoo", cpu_bound=True,
                preload=("rlightning_aio.envs.pettingzoo",)),
        Backend("envpool", "rlightning_aio.envs.envpool:EnvPoolEnv", "envpool", "envpool",
                extra="envpool", vectorized=True, preload=("rlightning_aio.envs.envpool",)),
        Backend("maniskill", "rlightning_aio.envs.maniskill:ManiskillEnv", "mani_skill",
                "mani-skill", extra="maniskill", vectorized=True,
                preload=("rlightning_aio.envs.maniskill",)),
        Backend("isaac_manager_based", "rlightning_aio.envs.isaac:IsaacManagerBasedEnv",
                "isaaclab", "isaaclab", extra="isaac", vectorized=True, own_command=ISAAC_LAB),
        Backend("isaac_marl", "rlightning_aio.envs.isaac:IsaacMarlEnv",
                "isaaclab", "isaaclab", extra="isaac", vectorized=True, own_command=ISAAC_LAB),
        Backend("piper", "rlightning_aio.envs.piper:PiperEnv", "piper_sdk", "piper-sdk",
                extra="piper"),
    )
}
# fmt: on


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the envs of an entry may live.

    Attributes:
        target: ``module:Class`` of the host; None if there is none yet.
        spreads: an entry's envs may be spread over several hosts, to which functions travel
            by pickle.
    """

    target: str | None
    spreads: bool


PLACEMENTS: dict[str, Placement] = {
    "process": Placement("rlightning_aio.hosts.process:ProcessHost", spreads=True),
    "inline": Placement("rlightning_aio.hosts.inline:InlineHost", spreads=False),
    "ray": Placement(None, spreads=True),
}


def load(target: str) -> Any:
    """The object that ``module:name`` names."""
    module_name, _, name = target.partition(":")
    return getattr(importlib.import_module(module_name), name)


class Registry:
    """Env classes by backend name."""

    def __init__(self) -> None:
        self._classes: dict[str, type[Any]] = {}

    def register(self, name: str) -> Callable[[EnvClass], EnvClass]:
        """Class decorator: makes the class known as backend `name`.

        Registering another class under a taken name replaces it: a module that is
        reloaded, or imported under two names, is not an error.

        Raises:
            TypeError: no name was given, as in a bare ``@ENVS.register``.
        """
        if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError("name the backend: @ENVS.register('my_backend')")

        def remember(env_class: EnvClass) -> EnvClass:
            self._classes[name] = env_class
            return env_class

        return remember

    def registered(self, name: str) -> type[Any] | None:
        """The class registered in this process under `name`, if any."""
        return self._classes.get(name)

    def knows(self, name: str) -> bool:
        """Whether `name` can be resolved, without importing anything."""
        return name in self.names()

    def names(self) -> list[str]:
        """Every resolvable backend name, sorted."""
        entry_points = importlib.metadata.entry_points(group=ENTRY_POINT_GROUP)
        return sorted({*self._classes, *BACKENDS, *(ep.name for ep in entry_points)})

    def resolve(self, name: str) -> type[Any]:
        """Import and return the class of backend `name`.

        Raises:
            ConfigError: no such backend; the nearest known names are suggested.
            ImportError: the class's module, or its simulator, is not installed.
        """
        if (env_class := self._classes.get(name)) is not None:
            return env_class
        if (backend := BACKENDS.get(name)) is not None:
            return load(backend.target)
        for entry_point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP, name=name):
            return entry_point.load()
        raise ConfigError(self.unknown(name))

    def unknown(self, name: str) -> str:
        """The message for a backend that nobody knows."""
        near = difflib.get_close_matches(name, self.names(), n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        return f"unknown backend {name!r}; {hint}known: {', '.join(self.names())}"


ENVS = Registry()
