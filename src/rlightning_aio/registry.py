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
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


__all__ = [
    "BACKENDS",
    "ENVS",
    "PLACEMENTS",
    "Backend",
    "Placement",
    "Registry",
    "load",
    "placement_of",
]

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
        hardware: it moves something real, and nothing but an explicit reset may set that in
            motion after a worker's death: ``on_worker_death`` is ``raise`` by default, and a
            replacement is not reset by itself. Its envs refuse steps until then.
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
    hardware: bool = False
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


# In an environment of its own; docs/backends.md says why it is two steps.
ISAAC_LAB = (
    "pip install 'rlightning-aio[isaac]' && "
    "pip install --ignore-requires-python --no-deps isaaclab==3.0.0"
)

# One row for one backend.
# fmt: off
BACKENDS: dict[str, Backend] = {
    backend.name: backend
    for backend in (
        Backend("mujoco", "rlightning_aio.envs.gymnasium:MujocoEnv", "mujoco", "mujoco",
                cpu_bound=True, vectorized=True,
                preload=("rlightning_aio.envs.gymnasium", "gymnasium.envs.mujoco")),
        Backend("gymnasium", "rlightning_aio.envs.gymnasium:GymnasiumEnv", "gymnasium",
                "gymnasium", cpu_bound=True, vectorized=True,
                preload=("rlightning_aio.envs.gymnasium",)),
        Backend("callable", "rlightning_aio.envs.callable:env_of_callable", "gymnasium",
                "gymnasium", cpu_bound=True, vectorized=True,
                preload=("rlightning_aio.envs.callable",)),
        Backend("env_server", "rlightning_aio.hosts.env_server:EnvServerHost", "zmq", "pyzmq",
                vectorized=True),
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
                extra="piper", hardware=True),
    )
}
# fmt: on


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the envs of an entry may live.

    Attributes:
        target: ``module:Class`` of the host.
        spreads: an entry's envs may be spread over several hosts, to which functions travel
            by pickle.
        refuses: fields of an entry that mean nothing there, and why: whoever sets one counts on
            something that would not happen. (`num_cpus` is no promise of ours anywhere but
            with Ray, nor `num_gpus` in this process, and both are found in configs for any place.)
        local: its workers use this machine's cores and see this process's modules.
        own_share: this process takes the last share of the envs, as if it were a worker.
        extra: the extra of this package that it needs; empty for none.
    """

    target: str
    spreads: bool
    refuses: Mapping[str, str] = field(default_factory=dict[str, str])
    local: bool = True
    own_share: bool = False
    extra: str = ""


_THIS_PROCESS = "the envs live in this process, which is already running"
_NO_WORKER = "there is no worker that could die or be replaced"
_NO_LIMIT = "nothing can end what an env does in this process"
_OWN_SHARE = "this process, which is already running, has a share of the envs"
_CLIENTS_OWN = "its envs live with its clients, which start them as they like"
_NOT_RAYS = "it is for Ray actors (placement: ray)"

PLACEMENTS: dict[str, Placement] = {
    "process": Placement(
        "rlightning_aio.hosts.process:ProcessHost",
        spreads=True,
        refuses={"ray_options": _NOT_RAYS},
    ),
    "inline": Placement(
        "rlightning_aio.hosts.inline:InlineHost",
        spreads=False,
        refuses={
            "step_timeout": _NO_LIMIT,
            "reset_timeout": _NO_LIMIT,
            "start_timeout": _NO_LIMIT,
            "on_worker_death": _NO_WORKER,
            "snapshot_every": _NO_WORKER,
            "max_restarts": _NO_WORKER,
            "envs_per_process": "all of the entry's envs live in this process",
            "interpreter": _THIS_PROCESS,
            "env_vars": _THIS_PROCESS,
            "cpu_affinity": _THIS_PROCESS,
            "ray_options": _NOT_RAYS,
        },
    ),
    "split": Placement(
        "rlightning_aio.hosts.process:ProcessHost",
        spreads=True,
        refuses={
            "step_timeout": _NO_LIMIT,
            "reset_timeout": _NO_LIMIT,
            "start_timeout": _NO_LIMIT,
            "interpreter": _OWN_SHARE,
            "env_vars": _OWN_SHARE,
            "ray_options": _NOT_RAYS,
        },
        own_share=True,
    ),
    "ray": Placement(
        "rlightning_aio.hosts.ray_host:RayHost",
        spreads=True,
        refuses={
            "interpreter": "Ray starts the actors; ray_options.runtime_env may name another "
            "Python or other packages",
            "cpu_affinity": "Ray assigns the cores of its nodes",
        },
        local=False,
        extra="ray",
    ),
}

_PLACED_BY_BACKEND: dict[str, Placement] = {
    "env_server": Placement(
        BACKENDS["env_server"].target,
        spreads=False,
        refuses={
            "num_workers": "an env_server is one, and its clients are as many as connect; "
            "env_kwargs.min_clients says for how many a reset waits",
            "num_envs": "each client says itself how many its env has; "
            "env_kwargs.min_clients says for how many clients a reset waits",
            "placement": _CLIENTS_OWN,
            "envs_per_process": _CLIENTS_OWN,
            "interpreter": _CLIENTS_OWN,
            "env_vars": _CLIENTS_OWN,
            "cpu_affinity": _CLIENTS_OWN,
            "ray_options": _CLIENTS_OWN,
            "start_timeout": "its envs come when they like; env_kwargs.connect_timeout says how "
            "long a reset waits for them",
            "on_worker_death": "it has no workers; what a client owes that is gone is answered by "
            "a truncated result, and it may come back",
            "max_restarts": "it has no workers; a client that is gone may come back",
            "snapshot_every": "it has no workers; a client that is gone begins anew",
            "video": _CLIENTS_OWN,
        },
    ),
}


def placement_of(backend: str, placement: str) -> Placement:
    """Where an entry's envs live: as its backend says, or else as the entry does."""
    return _PLACED_BY_BACKEND.get(backend) or PLACEMENTS[placement]


def load(target: str) -> Any:
    """The object that ``module:name`` names."""
    module_name, _, name = target.partition(":")
    return getattr(importlib.import_module(module_name), name)


class Registry:
    """Env classes by backend name."""

    def __init__(self) -> None:
        self._classes: dict[str, type[Any]] = {}
        self._cpu_bound: dict[str, bool] = {}
        self._hardware: dict[str, bool] = {}

    def register(
        self, name: str, *, cpu_bound: bool | None = None, hardware: bool | None = None
    ) -> Callable[[EnvClass], EnvClass]:
        """Class decorator: makes the class known as backend `name`.

        Args:
            name: what a config entry's ``backend`` says.
            cpu_bound: a step keeps one core busy and waits for nothing (no GPU, no network, no
                real time): with ``envs_per_process: auto`` as many workers as there are cores
                hold all envs of such entries, instead of one each. None: as the built-in backend
                of that name, else False. Only a registration in the trainer's process tells:
                where ``imports`` alone bring the class, workers know it, and nobody before.
            hardware: it moves something real, see `Backend`; None, and where it is told, as for
                `cpu_bound`.

        Registering another class under a taken name replaces it: a module that is
        reloaded, or imported under two names, is not an error.

        Raises:
            TypeError: no name was given, as in a bare ``@ENVS.register``.
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
        """Whether envs of backend `name` may share a worker; False where nobody has said so."""
        backend = BACKENDS.get(name)
        return self._cpu_bound.get(name, backend is not None and backend.cpu_bound)

    def registered(self, name: str) -> type[Any] | None:
        """The class registered in this process under `name`, if any."""
        return self._classes.get(name)

    def is_hardware(self, name: str) -> bool:
        """Whether backend `name` moves something real, as far as this process knows it."""
        backend = BACKENDS.get(name)
        return self._hardware.get(name, backend is not None and backend.hardware)

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
