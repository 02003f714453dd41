"""Backends and placements by name.

Rule: naming a backend imports nothing; its class is imported where the env is built, which is in a
worker. A name is looked up among the classes registered in this process, then among built-in
backends, then among plug-ins: entry points of the group ``rlightning_aio.backends``, which name
`Backend` rows that the trainer can read.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
from dataclasses import dataclass, field
from functools import cache, partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar, cast

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from importlib.metadata import EntryPoints

    from gymnasium.envs.registration import EnvSpec

CALLABLE: Final = "callable"
"""Backend of envs that come from a callable."""

EnvClass = TypeVar("EnvClass", bound="type[Any]")


@dataclass(frozen=True, slots=True)
class Backend:
    """The description of a backend.

    Attributes:
        name: the value of ``backend`` in a config entry.
        target: ``module:Class`` of the env class.
        module: the simulator's top module; it is looked for, never imported.
        cpu_bound: a step is plain computation on one core, so several envs may share a worker
            (``envs_per_process: auto``).
        awaitable: its envs are awaitable and do nothing but wait, so one worker runs all of an
            entry's (``envs_per_process: auto``).
        vectorized: ``num_envs`` above 1 is supported.
        hardware: it moves something real. After a worker's death only an explicit reset may set
            that in motion: ``on_worker_death`` is ``raise`` by default, a replacement is not reset
            by itself, and its envs refuse steps until then.
        install: the command that installs the simulator.
        preload: modules that are slow to import and safe to import before workers are forked:
            they start no thread and open no device.
    """

    name: str
    target: str
    module: str
    cpu_bound: bool = False
    awaitable: bool = False
    vectorized: bool = False
    hardware: bool = False
    install: str = "pip install rlightning-aio"
    preload: tuple[str, ...] = ()

    def is_installed(self) -> bool:
        """Return True if this interpreter has the simulator; import nothing."""
        return importlib.util.find_spec(self.module) is not None

    def installed_version(self) -> str | None:
        """Return the simulator's version in this interpreter, or None if it isn't installed."""
        # Imported here, because it takes as long as a tenth of a worker's other imports.
        from importlib.metadata import (  # noqa: PLC0415
            PackageNotFoundError,
            packages_distributions,
            version,
        )

        if not self.is_installed():
            return None
        try:
            return version(self.module)
        except PackageNotFoundError:
            # pyzmq has the module zmq. To find that out reads the lists of all installed files.
            names = packages_distributions().get(self.module)
            return version(names[0]) if names else "unknown"


def _of_extra(name: str) -> str:
    return f"pip install 'rlightning-aio[{name}]'"


# For an environment of its own; docs/isaac.md says why it takes two steps.
ISAAC_LAB = (
    "pip install 'rlightning-aio[isaac]' && "
    "pip install --ignore-requires-python --no-deps isaaclab==3.0.0"
)

_SIMULATORS: Final = "rlightning_aio.envs.simulators"

# fmt: off
BACKENDS: dict[str, Backend] = {
    backend.name: backend
    for backend in (
        Backend("mujoco", f"{_SIMULATORS}.gymnasium:MujocoEnv", "mujoco",
                cpu_bound=True, vectorized=True,
                preload=(f"{_SIMULATORS}.gymnasium", "gymnasium.envs.mujoco")),
        Backend("gymnasium", f"{_SIMULATORS}.gymnasium:GymnasiumEnv", "gymnasium",
                cpu_bound=True, vectorized=True, preload=(f"{_SIMULATORS}.gymnasium",)),
        Backend("callable", f"{_SIMULATORS}.callable:env_of_callable", "gymnasium",
                cpu_bound=True, vectorized=True, preload=(f"{_SIMULATORS}.callable",)),
        Backend("env_server", "rlightning_aio._core.hosts.env_server.host:EnvServerHost", "zmq",
                vectorized=True),
        Backend("ale", f"{_SIMULATORS}.ale:ALEEnv", "ale_py", install=_of_extra("ale"),
                cpu_bound=True, vectorized=True, preload=(f"{_SIMULATORS}.ale",)),
        Backend("pettingzoo", f"{_SIMULATORS}.pettingzoo:PettingZooEnv", "pettingzoo",
                install=_of_extra("pettingzoo"), cpu_bound=True,
                preload=(f"{_SIMULATORS}.pettingzoo",)),
        Backend("maniskill", f"{_SIMULATORS}.maniskill:ManiskillEnv", "mani_skill",
                install=_of_extra("maniskill"), vectorized=True,
                preload=(f"{_SIMULATORS}.maniskill",)),
        Backend("isaac_manager_based", f"{_SIMULATORS}.isaac:IsaacManagerBasedEnv",
                "isaaclab", vectorized=True, install=ISAAC_LAB),
        Backend("isaac_marl", f"{_SIMULATORS}.isaac:IsaacMarlEnv",
                "isaaclab", vectorized=True, install=ISAAC_LAB),
    )
}
# fmt: on


_SIMULATORS_CODE: Final = frozenset(
    ["gymnasium", *(backend.module for backend in BACKENDS.values() if backend.cpu_bound)]
)


def is_of_simulator(spec: EnvSpec) -> bool:
    """Return True if the code of a task of Gymnasium's registry is a simulator's that computes."""
    made_by = spec.entry_point if spec.entry_point is not None else spec.vector_entry_point
    module = made_by if isinstance(made_by, str) else getattr(made_by, "__module__", "")
    return module.partition(":")[0].partition(".")[0] in _SIMULATORS_CODE


def is_mujocos(spec: EnvSpec) -> bool:
    """Return True for one of Gymnasium's MuJoCo tasks."""
    return str(spec.entry_point).startswith("gymnasium.envs.mujoco")


def _is_simulators(task: Any) -> bool:
    """Return True for the name of such a task, registered in this process."""
    import gymnasium  # noqa: PLC0415  # Workers don't ask.

    spec = gymnasium.registry.get(task) if isinstance(task, str) else None
    return spec is not None and is_of_simulator(spec)


def _said_by_makers(task: Any, what: str) -> list[bool]:
    """Return what each of the callables of a task says of its envs, by an attribute `what`."""
    if isinstance(task, str):
        return []
    makers = cast("tuple[Any, ...]", task) if isinstance(task, tuple) else (task,)
    return [_says(maker, what) for maker in {id(maker): maker for maker in makers}.values()]


def _says(maker: Any, what: str) -> bool:
    maker = getattr(maker, "__wrapped__", maker)  # Of `VectorEnv`.
    if getattr(maker, what, False) is True:
        return True
    return isinstance(maker, partial) and _says(cast("partial[Any]", maker).func, what)


@dataclass(frozen=True, slots=True)
class Placement:
    """A place where the envs of an entry may live.

    Attributes:
        target: ``module:Class`` of the host.
        spreads: an entry's envs may be spread over several hosts; functions then travel by pickle.
        refuses: fields of an entry that have no effect there, with the reason. (`num_cpus` and
            `num_gpus` are refused nowhere, because configs for any place contain them.)
        local: its workers use this machine's cores and see this process's modules.
        awaits: if awaitable envs (`async def` reset and step) can live there, or only such.
        extra: the extra of this package that it needs; empty for none.
        places: ``module:function`` that returns the names of an entry's places, where workers
            start themselves; empty where the trainer starts them.
        check: ``module:function`` that raises `ConfigError` for an entry that can't be there.
    """

    target: str
    spreads: bool
    refuses: Mapping[str, str] = field(default_factory=dict[str, str])
    local: bool = True
    awaits: Literal["never", "also", "only"] = "never"
    extra: str = ""
    places: str = ""
    check: str = ""


_THIS_PROCESS = "the envs live in this process, which is already running"
_NO_WORKER = "there is no worker that could die or be replaced"
_NO_LIMIT = "nothing can end what an env does in this process"
_CLIENTS_OWN = "its clients start the envs, on machines of their own"
_NOT_RAYS = "it applies to Ray actors (placement: ray)"
_NOT_ON_LOOP = "it limits the envs on the trainer's event loop (placement: loop)"

PLACEMENTS: dict[str, Placement] = {
    "process": Placement(
        "rlightning_aio._core.hosts.process.host:ProcessHost",
        spreads=True,
        refuses={"ray_options": _NOT_RAYS, "max_concurrency": _NOT_ON_LOOP},
        awaits="also",
        check="rlightning_aio._core.hosts.process.host:check_system",
    ),
    "loop": Placement(
        "rlightning_aio._core.hosts.loop:LoopHost",
        spreads=False,
        refuses={
            "envs_per_process": "all of the entry's envs live in this process",
            "interpreter": _THIS_PROCESS,
            "env_vars": _THIS_PROCESS,
            "ray_options": _NOT_RAYS,
            "recycle": _NO_WORKER,
        },
        awaits="only",
    ),
    "inline": Placement(
        "rlightning_aio._core.hosts.inline:InlineHost",
        spreads=False,
        refuses={
            "step_timeout": _NO_LIMIT,
            "reset_timeout": _NO_LIMIT,
            "start_timeout": _NO_LIMIT,
            "close_timeout": _NO_LIMIT,
            "on_worker_death": _NO_WORKER,
            "max_restarts": _NO_WORKER,
            "recycle": _NO_WORKER,
            "envs_per_process": "all of the entry's envs live in this process",
            "interpreter": _THIS_PROCESS,
            "env_vars": _THIS_PROCESS,
            "ray_options": _NOT_RAYS,
            "max_concurrency": _NOT_ON_LOOP,
        },
    ),
    "ray": Placement(
        "rlightning_aio._core.hosts.ray.host:RayHost",
        spreads=True,
        refuses={
            "interpreter": "Ray starts the actors; ray_options.runtime_env may name another "
            "Python or other packages",
            "max_concurrency": _NOT_ON_LOOP,
        },
        local=False,
        extra="ray",
    ),
}

_PLACED_BY_BACKEND: dict[str, Placement] = {
    "env_server": Placement(
        BACKENDS["env_server"].target,
        spreads=False,
        places="rlightning_aio._core.hosts.env_server.settings:place_names",
        local=False,
        check="rlightning_aio._core.hosts.env_server.settings:server_settings",
        refuses={
            "num_workers": "env_kwargs.clients is the number of places for clients",
            "placement": _CLIENTS_OWN,
            "envs_per_process": _CLIENTS_OWN,
            "interpreter": _CLIENTS_OWN,
            "env_vars": _CLIENTS_OWN,
            "ray_options": _CLIENTS_OWN,
            "max_concurrency": _CLIENTS_OWN,
            "start_timeout": "clients connect at any time; env_kwargs.connect_timeout limits how "
            "long a call waits for them",
            "close_timeout": _CLIENTS_OWN,
            "recycle": _CLIENTS_OWN,
        },
    ),
}


def placement_of(backend: str, placement: str) -> Placement:
    """Return the place that the backend demands, or else the one that the entry names."""
    return _PLACED_BY_BACKEND.get(backend) or PLACEMENTS[placement]


def load(target: str) -> Any:
    """Import and return the object that ``module:name`` names."""
    module_name, _, name = target.partition(":")
    return attrgetter(name)(importlib.import_module(module_name))


def plugins() -> EntryPoints:
    """Return the entry points of plug-ins; each names a `Backend`."""
    from importlib.metadata import entry_points  # noqa: PLC0415  # See `Backend`.

    return entry_points(group="rlightning_aio.backends")


@cache
def _plugged_in(name: str) -> Backend | None:
    """Return the row of a plug-in, or None. Its module imports no simulator."""
    for point in plugins():
        if point.name == name:
            return point.load()
    return None


class Registry:
    """Env classes by backend name."""

    def __init__(self) -> None:
        self._classes: dict[str, type[Any]] = {}
        self._cpu_bound: dict[str, bool] = {}
        self._hardware: dict[str, bool] = {}

    def register(
        self, name: str, *, cpu_bound: bool | None = None, hardware: bool | None = None
    ) -> Callable[[EnvClass], EnvClass]:
        """Return a class decorator that registers the class as backend `name`.

        Args:
            name: the value of ``backend`` in config entries.
            cpu_bound: a step keeps one core busy and waits for nothing (no GPU, no network, no
                real time): with ``envs_per_process: auto``, as many workers as there are cores
                share the envs of such entries. None: as in the description of that name, or
                False without one. Register the class in the trainer's process, too: a class that
                only ``imports`` register is known to workers alone, which is too late.
            hardware: it moves something real (see `Backend`); None, and the process, as for
                `cpu_bound`.

        Registering another class under a name replaces it, so that a module can be reloaded, or
        imported under two names.

        Raises:
            TypeError: the name is missing, as in a bare ``@ENVS.register``.
        """
        if not isinstance(name, str):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise TypeError("name the backend: @ENVS.register('my_backend')")

        def remember(env_class: EnvClass) -> EnvClass:
            self._classes[name] = env_class
            self._cpu_bound.pop(name, None)
            self._hardware.pop(name, None)
            if cpu_bound is not None:
                self._cpu_bound[name] = cpu_bound
            if hardware is not None:
                self._hardware[name] = hardware
            return env_class

        return remember

    def is_cpu_bound(self, name: str) -> bool:
        """Return True if envs of backend `name` are known to be CPU-bound."""
        backend = self.described(name)
        return self._cpu_bound.get(name, backend is not None and backend.cpu_bound)

    def computes(self, name: str, task: Any) -> bool:
        """Return True if envs of `task`, of backend `name`, are known to be CPU-bound.

        Own ones aren't known: tasks whose code is neither Gymnasium's nor that of another backend
        here, and callables that have no attribute ``computes`` that says so.
        """
        if not self.is_cpu_bound(name):
            return False
        if name in self._classes or name not in ("gymnasium", CALLABLE):
            return True
        if name == CALLABLE:
            said = _said_by_makers(task, "computes")
            return bool(said) and all(said)
        return _is_simulators(task)

    def is_awaitable(self, name: str) -> bool:
        """Return True if envs of backend `name` are known to do nothing but wait."""
        backend = self.described(name)
        return name not in self._classes and backend is not None and backend.awaitable

    def registered(self, name: str) -> type[Any] | None:
        """Return the class registered in this process under `name`, or None."""
        return self._classes.get(name)

    def described(self, name: str) -> Backend | None:
        """Return the description of a built-in backend or of a plug-in, or None."""
        return BACKENDS.get(name) or _plugged_in(name)

    def is_hardware(self, name: str, task: Any = "") -> bool:
        """Return True if envs of `task`, of backend `name`, are known to move something real.

        The backend says so, or its class or one of the callables, by an attribute ``hardware``.
        """
        backend = self.described(name)
        said = self._hardware.get(name, backend is not None and backend.hardware)
        known = (self._classes.get(name),)
        return said or any(_said_by_makers(known, "hardware") + _said_by_makers(task, "hardware"))

    def knows(self, name: str) -> bool:
        """Return True if `name` can be resolved; imports nothing."""
        # Without the entry points if possible: reading them takes milliseconds.
        return name in self._classes or name in BACKENDS or name in self.names()

    def names(self) -> list[str]:
        """Return the name of every backend that can be resolved, sorted."""
        return sorted({*self._classes, *BACKENDS, *plugins().names})

    def resolve(self, name: str) -> type[Any]:
        """Import and return the class of backend `name`.

        Raises:
            ConfigError: no such backend; the nearest known names are suggested.
            ImportError: the class's module, or its simulator, is not installed.
        """
        if (env_class := self._classes.get(name)) is not None:
            return env_class
        if (backend := self.described(name)) is not None:
            return load(backend.target)
        raise ConfigError(self.unknown(name))

    def unknown(self, name: str) -> str:
        """Return the message for a backend name that can't be resolved."""
        hint = did_you_mean(name, self.names(), end=" ")
        return f"unknown backend {name!r}; {hint}known: {', '.join(self.names())}"


def did_you_mean(name: str, known: Iterable[str], end: str = "") -> str:
    """Ask whether the nearest of `known` names was meant; empty if none is near `name`."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?{end}" if near else ""


def name_of(function: Any) -> str:
    """Return the qualified name of a callable, or of the one that a `partial` calls."""
    while isinstance(function, partial):
        function = cast("partial[Any]", function).func
    return getattr(function, "__qualname__", type(function).__name__)


ENVS = Registry()
