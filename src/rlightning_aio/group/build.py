"""From configuration to a group: who runs where, before anything is started.

Rule: everything that can be known to be wrong without starting a process is said here.
"""

from __future__ import annotations

import inspect
import itertools
import os
import warnings
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.config import EnvConfig, check_installed, moved, parse_configs
from rlightning_aio.errors import ConfigError
from rlightning_aio.group.core import Core
from rlightning_aio.group.devices import dealt_out
from rlightning_aio.group.env_table import EnvTable
from rlightning_aio.group.poller import Poller
from rlightning_aio.group.requests import Requests
from rlightning_aio.group.resumption import Resumption
from rlightning_aio.group.single import SingleEnvCore, StepsAtOnce
from rlightning_aio.group.slab_layout import SlabLayout
from rlightning_aio.group.supervisor import Supervisor
from rlightning_aio.group.videos import check_videos, filmed_alone
from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.base import Wiring
from rlightning_aio.hosts.known_tasks import known_tasks
from rlightning_aio.hosts.messages import StartOrder
from rlightning_aio.hosts.pickling import dumped_with_code
from rlightning_aio.protocol.bell import TrainerBell, bell_size
from rlightning_aio.registry import ENVS, load, placement_of
from rlightning_aio.sharing import num_cores
from rlightning_aio.types import PolicyResponse, default_env_preprocess_fn

if TYPE_CHECKING:
    from rlightning_aio.hosts.base import HostFactory, Watcher
    from rlightning_aio.hosts.messages import Completions
    from rlightning_aio.registry import Placement

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
    env_cfgs: Any,
    preprocess_fn: PreprocessFn | Sequence[PreprocessFn | None] | None,
    *,
    mixed_actions: bool,
    zero_copy: bool,
) -> Plan:
    """Check what `build_env_group` was given.

    Raises:
        ConfigError: a config or a preprocess function can't be used.
    """
    configs = parse_configs(env_cfgs)
    check_installed(configs)
    check_videos(configs)
    fns = _preprocess_fns(configs, preprocess_fn)
    for config, own in zip(configs, fns, strict=True):
        host_class(config)
        if config.backend == ENV_SERVER:
            _check_server(config, ignored=own[0] not in (None, default_env_preprocess_fn))
        for make in _distinct(config.make_env):
            _check_sendable(config, "make_env", make)
    return Plan(configs, fns, mixed_actions, zero_copy)


def _place(config: EnvConfig) -> Placement:
    return placement_of(config.backend, config.placement)


def _has_worker_here(config: EnvConfig) -> bool:
    """Whether its envs live in processes of their own, on this machine."""
    place = _place(config)
    return place.spreads and place.local


def host_class(config: EnvConfig) -> HostFactory:
    """What makes the hosts of an entry.

    Raises:
        ConfigError: a package is missing that its placement needs.
    """
    place = _place(config)
    try:
        return load(place.target)
    except ImportError as error:
        if not place.extra:
            raise
        raise ConfigError(
            f"entry {config.name!r}: placement {config.placement!r} needs a package that is not "
            f"installed ({error}): pip install 'rlightning-aio[{place.extra}]'"
        ) from error


def _check_server(config: EnvConfig, *, ignored: bool) -> None:
    # ZMQ is imported where an env_server is asked for.
    from rlightning_aio.hosts.listener import server_settings  # noqa: PLC0415

    server_settings(config)
    if ignored:
        warnings.warn(
            f"entry {config.name!r}: preprocess_fn is ignored for an env_server; it runs at the "
            "client",
            stacklevel=4,
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
        for fn in _distinct(tuple(fns)):
            if not callable(fn):
                raise ConfigError(
                    f"entry {config.name!r}: preprocess_fn must be callable, not "
                    f"{type(fn).__name__}"
                )
            _check_sendable(config, "preprocess_fn", fn)
    return chosen


def _distinct(fns: Any) -> list[Any]:
    """One callable, or a tuple of them, without repetitions; callables need not be hashable."""
    listed = cast("tuple[Any, ...]", fns if isinstance(fns, tuple) else (fns,))
    return list({id(fn): fn for fn in listed if fn is not None}.values())


def _check_sendable(config: EnvConfig, field: str, fn: Any) -> None:
    """Raises `ConfigError` if a function can't travel to where the entry's envs live."""
    if not _place(config).spreads:
        return
    try:
        dumped_with_code(fn)
    except Exception as error:
        name = getattr(fn, "__qualname__", repr(fn))
        raise ConfigError(
            f"entry {config.name!r}: {field} {name} can't be sent to a worker: "
            f"{error}{_culprit(fn)}"
        ) from error


def _culprit(fn: Any) -> str:
    """Which captured variable of a function can't be pickled."""
    fn = inspect.unwrap(fn)
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

    Raises what a host raises that can't be made; nothing is left of the others then.
    """
    arena = Arena()
    try:
        return _assembled(plan, watcher, arena, shares_thread=shares_thread)
    except BaseException:
        arena.close()
        raise


def _assembled(plan: Plan, watcher: Watcher, arena: Arena, *, shares_thread: bool) -> Core:
    local = [config for config in plan.configs if config.backend != ENV_SERVER]
    servers = [config for config in plan.configs if config.backend == ENV_SERVER]
    envs = EnvTable(
        [config for config in local for _ in range(config.num_workers)],
        [f"{config.name}-{index}" for config in local for index in range(config.num_workers)],
        [(f"{config.name}-0", config, MAX_CLIENTS) for config in servers],
    )
    cores = num_cores()
    orders = _orders(plan, servers, cores)
    bell_offset = arena.append(bell_size(len(orders)))
    bell_memory = map_shared(arena.descriptor, bell_offset, bell_size(len(orders)))
    bell = TrainerBell(bell_memory, len(orders))
    requests = Requests(
        np.repeat(np.arange(len(orders)), [len(order.worker_indices) for order in orders]),
        len(orders),
    )
    layout = SlabLayout(len(envs))
    resumption = Resumption(requests)
    completions: Completions = deque()
    supervisor = Supervisor(
        envs,
        requests,
        layout,
        resumption,
        arena,
        completions.append,
        mixed_actions=plan.mixed_actions,
        num_cores=cores,
    )
    supervisor.resources["bell"] = bell
    poller = Poller(requests, bell, cores)
    wiring = Wiring(
        completions=completions,
        watcher=watcher,
        arena=arena,
        bell=bell,
        bell_offset=bell_offset,
        num_hosts=len(orders),
        configs=[order.config for order in orders],
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
    parts = (envs, requests, layout, resumption, supervisor, poller, completions, watcher)
    host = supervisor.hosts[0]
    if not shares_thread and len(envs) == 1 and isinstance(host, StepsAtOnce):
        core = SingleEnvCore(*parts, zero_copy=plan.zero_copy)
        core.single_host = host
        return core
    return Core(*parts, zero_copy=plan.zero_copy)


def _orders(plan: Plan, servers: Sequence[EnvConfig], num_cores: int) -> list[StartOrder]:
    """What each host is to build: local ones first, then the env_servers."""
    local = [
        (config, fns)
        for config, fns in zip(plan.configs, plan.preprocess_fns, strict=True)
        if config.backend != ENV_SERVER
    ]
    nums_hosts = _nums_hosts([config for config, _ in local], num_cores)
    shares = [
        (config, share)
        for (config, fns), num_hosts in zip(local, nums_hosts, strict=True)
        for share in _shares(config, fns, num_hosts)
    ]
    # This process is as good as one worker, whatever the number of entries.
    for k, (config, share) in list(enumerate(shares))[::-1]:
        if _place(config).own_share:
            shares[k] = moved(config, "inline"), share
            break
    cores = sorted(os.sched_getaffinity(0))
    num_processes = sum(_has_worker_here(config) for config, _ in shares)
    surroundings = _surroundings([config for config, _ in shares])
    elsewhere = any(config.placement != "inline" for config, _ in shares)
    tasks = known_tasks() if elsewhere else ()
    orders = [
        StartOrder(
            config=_own_makers(config, [index for index, _ in share]).model_copy(
                update={"env_vars": surroundings[host_id]}
            ),
            env_class=ENVS.registered(config.backend),
            worker_indices=tuple(index for index, _ in share),
            preprocess_fns=tuple(fn for _, fn in share),
            spins=num_processes <= num_cores,
            core=cores[host_id % len(cores)] if config.cpu_affinity else None,
            tasks=tasks,
        )
        for host_id, (config, share) in enumerate(shares)
    ]
    everybody = tuple(range(MAX_CLIENTS))
    return orders + [
        StartOrder(config, None, everybody, (None,) * MAX_CLIENTS, spins=False, core=None)
        for config in servers
    ]


def _surroundings(workers: Sequence[EnvConfig]) -> list[dict[str, str]]:
    """The environment variables of each worker, given its entry.

    Those of the entry come before what says which devices it has; ``{worker_index}`` in one is
    the number of the worker among the entry's.
    """
    devices = iter(dealt_out([config for config in workers if _has_worker_here(config)]))
    count = Counter[str]()
    found: list[dict[str, str]] = []
    for config in workers:
        index = str(count[config.name])
        count[config.name] += 1
        own = {k: v.replace("{worker_index}", index) for k, v in config.env_vars.items()}
        dealt = next(devices) if _has_worker_here(config) else {}
        found.append({**dealt, **own})
    return found


def _own_makers(config: EnvConfig, indices: Sequence[int]) -> EnvConfig:
    """`config` for a host of some of the entry's envs, with what makes these."""
    makers: Any = config.make_env
    if not isinstance(makers, tuple):
        return config
    makers = cast("tuple[Any, ...]", makers)
    return config.model_copy(update={"make_env": tuple(makers[k] for k in indices)})


def _nums_hosts(configs: Sequence[EnvConfig], num_cores: int) -> list[int]:
    """Over how many hosts the envs of each entry are spread.

    Entries of CPU-bound simulators that don't say it share the cores, by their numbers of envs;
    not those on other machines, whose cores nobody knows here.
    """
    nums: list[int] = []
    sharing: list[int] = []
    for k, config in enumerate(configs):
        if not _place(config).spreads:
            nums.append(1)
        elif config.envs_per_process != "auto":
            nums.append(-(-config.num_workers // config.envs_per_process))
        elif ENVS.is_cpu_bound(config.backend) and _place(config).local:
            nums.append(1)
            sharing.append(k)
        else:
            nums.append(config.num_workers)
    for _ in range(num_cores - len(sharing)):
        # One more worker where most envs share one.
        crowded = max(sharing, key=lambda k: configs[k].num_workers / nums[k], default=None)
        if crowded is None or nums[crowded] == configs[crowded].num_workers:
            break
        nums[crowded] += 1
    return nums


def _shares(
    config: EnvConfig, fns: Sequence[PreprocessFn | None], num_hosts: int
) -> list[list[tuple[int, PreprocessFn | None]]]:
    """Which envs of an entry live together: as evenly as can be, neighbours together, but for
    those that are filmed.
    """
    count = len(fns)
    envs = list(enumerate(fns))
    bounds = {count * k // num_hosts for k in range(num_hosts + 1)}
    if _place(config).spreads:
        bounds |= {k + side for k in filmed_alone(config) for side in (0, 1)}
    return [envs[first:end] for first, end in itertools.pairwise(sorted(bounds))]
