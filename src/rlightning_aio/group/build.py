"""From configuration to a group: who runs where, before anything is started.

Rule: everything that can be known to be wrong without starting a process is said here.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.config import EnvConfig, check_installed, parse_configs
from rlightning_aio.errors import ConfigError
from rlightning_aio.group.fleet import Fleet
from rlightning_aio.group.slots import Slots
from rlightning_aio.hosts.arena import Arena
from rlightning_aio.hosts.inline import InlineHost
from rlightning_aio.hosts.pickling import dumped_with_code
from rlightning_aio.hosts.process import ForkServer, ProcessHost
from rlightning_aio.hosts.server import MAX_CLIENTS, ServerHost
from rlightning_aio.hosts.worker import StartOrder
from rlightning_aio.registry import BACKENDS, ENVS
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from rlightning_aio.hosts.base import Host, Watcher

ENV_SERVER: Final = "env_server"

__all__ = ["ENV_SERVER", "Plan", "build_fleet", "plan_group"]

PreprocessFn = Callable[[PolicyResponse], Any]


@dataclass(frozen=True)
class Plan:
    """A group that is checked and not yet started."""

    configs: list[EnvConfig]
    preprocess_fns: list[list[PreprocessFn | None]]
    mixed_actions: bool
    zero_copy: bool


def plan_group(
    cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None,
    *,
    mixed_actions: bool,
    zero_copy: bool,
) -> Plan:
    """Check what `build_env_group` was given.

    Raises:
        ConfigError: a config or a preprocess function can't be used.
    """
    configs = parse_configs(cfgs)
    check_installed(configs)
    for config in configs:
        if config.placement == "ray":
            raise ConfigError(
                f"entry {config.name!r}: placement 'ray' is not available yet; use 'process'"
            )
        if config.backend == ENV_SERVER:
            _check_server(config, ignored=preprocess_fn is not None)
    fns = _preprocess_fns(configs, preprocess_fn)
    return Plan(configs, fns, mixed_actions, zero_copy)


def _check_server(config: EnvConfig, *, ignored: bool) -> None:
    # ZMQ is imported where an env_server is asked for.
    from rlightning_aio.hosts.remote import server_settings  # noqa: PLC0415

    server_settings(config)
    if config.num_workers > 1:
        raise ConfigError(
            f"entry {config.name!r}, num_workers: an env_server is one; its clients are as many as "
            "connect (env_kwargs.min_clients)"
        )
    if config.on_worker_death == "raise":
        raise ConfigError(
            f"entry {config.name!r}, on_worker_death: 'raise' is for workers; what a client owes "
            "that is gone is answered by a truncated result, and it may come back"
        )
    if ignored:
        warnings.warn(
            f"entry {config.name!r}: preprocess_fn is ignored for an env_server; it runs at the "
            "client",
            stacklevel=5,
        )


def _preprocess_fns(
    configs: list[EnvConfig], given: PreprocessFn | Sequence[PreprocessFn | None] | None
) -> list[list[PreprocessFn | None]]:
    """For each entry one function for each of its envs."""
    counts = [config.num_workers for config in configs]
    if given is None or callable(given):
        chosen = [[given] * count for count in counts]
    elif len(given) == len(configs):
        chosen = [[fn] * count for fn, count in zip(given, counts, strict=True)]
    elif len(given) == sum(counts):
        remaining = iter(given)
        chosen = [[next(remaining) for _ in range(count)] for count in counts]
    else:
        raise ConfigError(
            f"{len(given)} preprocess functions for {len(configs)} entries with {sum(counts)} "
            "envs; give one, one for each entry, or one for each env"
        )
    for config, fns in zip(configs, chosen, strict=True):
        # By identity: a callable need not be hashable.
        for fn in {id(fn): fn for fn in fns if fn is not None}.values():
            _check_preprocess(config, fn)
    return chosen


def _check_preprocess(config: EnvConfig, fn: Any) -> None:
    if not callable(fn):
        raise ConfigError(
            f"entry {config.name!r}: preprocess_fn must be callable, not {type(fn).__name__}"
        )
    if config.placement == "inline":
        return
    try:
        dumped_with_code(fn)
    except Exception as error:
        name = getattr(fn, "__qualname__", repr(fn))
        raise ConfigError(
            f"entry {config.name!r}: preprocess_fn {name} can't be sent to a worker: "
            f"{error}{_culprit(fn)}"
        ) from error


def _culprit(fn: Any) -> str:
    """Which captured variable of a function can't be pickled."""
    cells = zip(
        getattr(getattr(fn, "__code__", None), "co_freevars", ()),
        getattr(fn, "__closure__", None) or (),
        strict=False,
    )
    for name, cell in cells:
        try:
            dumped_with_code(cell.cell_contents)
        except Exception:
            return f"; it captures {name!r}, which can't be pickled"
    return ""


def build_fleet(plan: Plan, watcher: Watcher) -> Fleet:
    """The hosts of a plan, not started."""
    local = [config for config in plan.configs if config.backend != ENV_SERVER]
    remote = [config for config in plan.configs if config.backend == ENV_SERVER]
    slots = Slots(
        [config for config in local for _ in range(config.num_workers)],
        [f"{config.name}-{index}" for config in local for index in range(config.num_workers)],
        [(f"{config.name}-0", config, MAX_CLIENTS) for config in remote],
    )
    arena = Arena()
    fleet = Fleet(slots, arena, watcher, mixed_actions=plan.mixed_actions)
    cores = sorted(os.sched_getaffinity(0))
    orders = [
        (config, shares)
        for config, fns in zip(plan.configs, plan.preprocess_fns, strict=True)
        if config.backend != ENV_SERVER
        for shares in _shares(config, fns, len(cores))
    ]
    num_processes = sum(config.placement == "process" for config, _ in orders)
    servers: dict[object, ForkServer] = {}
    first_slot = 0
    for host_id, (config, shares) in enumerate(orders):
        order = StartOrder(
            config=config,
            env_class=ENVS.registered(config.backend),
            worker_indices=tuple(index for index, _ in shares),
            preprocess_fns=tuple(fn for _, fn in shares),
            spins=num_processes <= len(cores),
            core=cores[host_id % len(cores)] if config.cpu_affinity else None,
        )
        host: Host
        if config.placement == "inline":
            host = InlineHost(host_id, first_slot, order, arena, fleet)
        else:
            server = _server_for(config, plan.configs, servers, watcher)
            host = ProcessHost(host_id, first_slot, order, server, arena, fleet, watcher)
        fleet.add(host, config)
        first_slot += len(shares)
    for config in remote:
        host_id = len(fleet.hosts)
        fleet.add(_server_host(config, host_id, first_slot, fleet, watcher), config)
        first_slot += MAX_CLIENTS
    fleet.servers = list(servers.values())
    fleet.lookout.num_cores = len(cores)
    return fleet


def _server_host(
    config: EnvConfig, host_id: int, first_slot: int, fleet: Fleet, watcher: Watcher
) -> ServerHost:
    from rlightning_aio.hosts.remote import RemoteHost, server_settings  # noqa: PLC0415

    listener = RemoteHost(
        f"{config.name}-0",
        server_settings(config),
        step_timeout=config.step_timeout,
        reset_timeout=config.reset_timeout,
        objection=fleet.objection,
    )
    return ServerHost(host_id, first_slot, listener, fleet, watcher)


def _shares(
    config: EnvConfig, fns: Sequence[PreprocessFn | None], num_cores: int
) -> list[list[tuple[int, PreprocessFn | None]]]:
    """Which envs of an entry live together: as evenly as can be, neighbours together."""
    count = config.num_workers
    if config.placement == "inline":
        num_hosts = 1
    elif config.envs_per_process == "auto":
        backend = BACKENDS.get(config.backend)
        cpu_bound = backend is not None and backend.cpu_bound
        num_hosts = min(num_cores, count) if cpu_bound else count
    else:
        num_hosts = -(-count // config.envs_per_process)
    envs = list(enumerate(fns))
    return [envs[count * k // num_hosts : count * (k + 1) // num_hosts] for k in range(num_hosts)]


def _server_for(
    config: EnvConfig,
    configs: Sequence[EnvConfig],
    servers: dict[object, ForkServer],
    watcher: Watcher,
) -> ForkServer:
    key = _server_key(config)
    if key not in servers:
        preload = dict[str, None]()
        for other in configs:
            backend = BACKENDS.get(other.backend)
            if _server_key(other) == key and backend is not None:
                preload.update(dict.fromkeys(backend.preload))
        servers[key] = ForkServer(
            config.interpreter, dict(config.env_vars), tuple(preload), watcher
        )
    return servers[key]


def _server_key(config: EnvConfig) -> tuple[object, ...]:
    return config.interpreter, tuple(sorted(config.env_vars.items()))
