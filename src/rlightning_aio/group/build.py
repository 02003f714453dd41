"""From configuration to a group: who runs where, before anything is started.

Rule: everything that can be known to be wrong without starting a process is said here.
"""

from __future__ import annotations

import os
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.config import EnvConfig, check_installed, parse_configs
from rlightning_aio.errors import ConfigError
from rlightning_aio.group.core import Core
from rlightning_aio.group.env_table import EnvTable
from rlightning_aio.group.poller import Poller
from rlightning_aio.group.requests import Requests
from rlightning_aio.group.single import SingleEnvCore, StepsAtOnce
from rlightning_aio.group.slab_layout import SlabLayout
from rlightning_aio.group.supervisor import Supervisor
from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.base import Wiring
from rlightning_aio.hosts.messages import StartOrder
from rlightning_aio.hosts.pickling import dumped_with_code
from rlightning_aio.protocol.bell import TrainerBell, bell_size
from rlightning_aio.registry import BACKENDS, ENVS, PLACEMENTS, load
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from rlightning_aio.hosts.base import HostFactory, Watcher

ENV_SERVER: Final = "env_server"
MAX_CLIENTS: Final = 1024
"""Places of an env_server; twice as many as it lets in at once."""

__all__ = ["ENV_SERVER", "Plan", "assemble", "plan_group"]

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
        host_class(config)
        if config.backend == ENV_SERVER:
            _check_server(config, ignored=preprocess_fn is not None)
    fns = _preprocess_fns(configs, preprocess_fn)
    return Plan(configs, fns, mixed_actions, zero_copy)


def host_class(config: EnvConfig) -> HostFactory:
    """What makes the hosts of an entry.

    Raises:
        ConfigError: its placement is not available.
    """
    if config.backend == ENV_SERVER:
        return load(BACKENDS[ENV_SERVER].target)
    target = PLACEMENTS[config.placement].target
    if target is None:
        raise ConfigError(
            f"entry {config.name!r}: placement {config.placement!r} is not available yet; use "
            "'process'"
        )
    return load(target)


def _check_server(config: EnvConfig, *, ignored: bool) -> None:
    # ZMQ is imported where an env_server is asked for.
    from rlightning_aio.hosts.listener import server_settings  # noqa: PLC0415

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
    if not PLACEMENTS[config.placement].spreads:
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


def assemble(plan: Plan, watcher: Watcher, *, shares_thread: bool) -> Core:
    """The core of a plan, with all of its hosts, not started.

    Args:
        plan: what `plan_group` made.
        watcher: the driver.
        shares_thread: other tasks may use the group while a procedure waits.
    """
    local = [config for config in plan.configs if config.backend != ENV_SERVER]
    servers = [config for config in plan.configs if config.backend == ENV_SERVER]
    envs = EnvTable(
        [config for config in local for _ in range(config.num_workers)],
        [f"{config.name}-{index}" for config in local for index in range(config.num_workers)],
        [(f"{config.name}-0", config, MAX_CLIENTS) for config in servers],
    )
    cores = sorted(os.sched_getaffinity(0))
    orders = _orders(plan, servers, cores)
    arena = Arena()
    bell_offset = arena.append(bell_size(len(orders)))
    bell_memory = map_shared(arena.descriptor, bell_offset, bell_size(len(orders)))
    bell = TrainerBell(bell_memory, len(orders))
    requests = Requests(
        np.repeat(np.arange(len(orders)), [len(order.worker_indices) for order in orders]),
        len(orders),
    )
    layout = SlabLayout(len(envs))
    supervisor = Supervisor(
        envs,
        requests,
        layout,
        arena,
        mixed_actions=plan.mixed_actions,
        num_cores=len(cores),
    )
    supervisor.resources["bell"] = bell
    poller = Poller(requests, bell, len(cores))
    wiring = Wiring(
        completions=deque(),
        watcher=watcher,
        arena=arena,
        bell=bell,
        bell_offset=bell_offset,
        num_hosts=len(orders),
        configs=plan.configs,
        objection=supervisor.objection,
        is_idle=requests.is_idle,
        resources=supervisor.resources,
    )
    first_slot = 0
    for host_id, order in enumerate(orders):
        host = host_class(order.config)(host_id, first_slot, order, wiring)
        supervisor.add(host, order.config)
        poller.add(host)
        first_slot += host.num_envs
    parts = (envs, requests, layout, supervisor, poller, wiring.completions, watcher)
    host = supervisor.hosts[0]
    if not shares_thread and len(envs) == 1 and isinstance(host, StepsAtOnce):
        core = SingleEnvCore(*parts, zero_copy=plan.zero_copy)
        core.single_host = host
        return core
    return Core(*parts, zero_copy=plan.zero_copy)


def _orders(plan: Plan, servers: Sequence[EnvConfig], cores: Sequence[int]) -> list[StartOrder]:
    """What each host is to build: local ones first, then the env_servers."""
    shares = [
        (config, share)
        for config, fns in zip(plan.configs, plan.preprocess_fns, strict=True)
        if config.backend != ENV_SERVER
        for share in _shares(config, fns, len(cores))
    ]
    num_processes = sum(PLACEMENTS[config.placement].spreads for config, _ in shares)
    orders = [
        StartOrder(
            config=config,
            env_class=ENVS.registered(config.backend),
            worker_indices=tuple(index for index, _ in share),
            preprocess_fns=tuple(fn for _, fn in share),
            spins=num_processes <= len(cores),
            core=cores[host_id % len(cores)] if config.cpu_affinity else None,
        )
        for host_id, (config, share) in enumerate(shares)
    ]
    everybody = tuple(range(MAX_CLIENTS))
    return orders + [
        StartOrder(config, None, everybody, (None,) * MAX_CLIENTS, spins=False, core=None)
        for config in servers
    ]


def _shares(
    config: EnvConfig, fns: Sequence[PreprocessFn | None], num_cores: int
) -> list[list[tuple[int, PreprocessFn | None]]]:
    """Which envs of an entry live together: as evenly as can be, neighbours together."""
    count = config.num_workers
    if not PLACEMENTS[config.placement].spreads:
        num_hosts = 1
    elif config.envs_per_process == "auto":
        backend = BACKENDS.get(config.backend)
        cpu_bound = backend is not None and backend.cpu_bound
        num_hosts = min(num_cores, count) if cpu_bound else count
    else:
        num_hosts = -(-count // config.envs_per_process)
    envs = list(enumerate(fns))
    return [envs[count * k // num_hosts : count * (k + 1) // num_hosts] for k in range(num_hosts)]
