"""`start_orders`: which host runs which envs, and with which cores and variables."""

from __future__ import annotations

import inspect
import itertools
from collections import Counter
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from rlightning_aio._core.group.setup.plan import Plan, PreprocessFn, placement_for
from rlightning_aio._core.hosts.logs import log_settings
from rlightning_aio._core.hosts.messages import StartOrder
from rlightning_aio._core.hosts.running.known_tasks import known_tasks
from rlightning_aio.config import EnvConfig, makers_of
from rlightning_aio.registry import ENVS, load

if TYPE_CHECKING:
    from collections.abc import Sequence

Share: TypeAlias = "list[tuple[int, PreprocessFn | None]]"
"""The envs of a host: their positions in the entry, and their preprocess functions."""


def _has_worker_here(config: EnvConfig) -> bool:
    """True if the envs of an entry run in worker processes on this machine."""
    place = placement_for(config)
    return place.spreads and place.local


def start_orders(plan: Plan, num_cores: int) -> list[StartOrder]:
    """The start order of each host: first those whose envs are built with the group."""
    shares = _all_shares(plan, num_cores)
    num_processes = sum(_has_worker_here(config) for config, _ in shares)
    variables = _environment_variables([config for config, _ in shares])
    elsewhere = any(placement_for(config).spreads for config, _ in shares)
    tasks = known_tasks() if elsewhere else ()
    logs = log_settings() if elsewhere else None
    orders = [
        StartOrder(
            config=(own := _own_makers(config, [index for index, _ in share])).model_copy(
                update={"env_vars": variables[host_id]}
            ),
            env_class=ENVS.registered(config.backend),
            worker_indices=tuple(index for index, _ in share),
            preprocess_fns=tuple(fn for _, fn in share),
            spins=num_processes <= num_cores,
            tasks=tasks,
            is_hardware=own.is_hardware,
            logs=logs,
        )
        for host_id, (config, share) in enumerate(shares)
    ]
    places = [c for c in plan.configs if placement_for(c).places]
    return orders + [order for config in places for order in _orders_of_places(config)]


def _all_shares(plan: Plan, num_cores: int) -> list[tuple[EnvConfig, Share]]:
    """The entry and the envs of each local host."""
    local = [
        (config, fns)
        for config, fns in zip(plan.configs, plan.preprocess_fns, strict=True)
        if not placement_for(config).places
    ]
    counts = nums_hosts([config for config, _ in local], num_cores)
    return [
        (config, share)
        for (config, fns), num_hosts in zip(local, counts, strict=True)
        for share in _shares(fns, num_hosts)
    ]


def _orders_of_places(config: EnvConfig) -> list[StartOrder]:
    """The order of each place of an env_server."""
    count = len(load(placement_for(config).places)(config))
    return [StartOrder(config, None, (k,), (None,), spins=False) for k in range(count)]


def _environment_variables(workers: Sequence[EnvConfig]) -> list[dict[str, str]]:
    """The environment variables of each worker, given its entry.

    ``{process_index}`` in a value is replaced by the number of the worker within its entry.
    """
    count = Counter[str]()
    found: list[dict[str, str]] = []
    for config in workers:
        index = str(count[config.name])
        count[config.name] += 1
        found.append({k: v.replace("{process_index}", index) for k, v in config.env_vars.items()})
    return found


def _own_makers(config: EnvConfig, indices: Sequence[int]) -> EnvConfig:
    """`config` for a host of the envs at `indices`, with only their callables."""
    if not (makers := makers_of(config)):
        return config
    return config.model_copy(update={"task": tuple(makers[k] for k in indices)})


def nums_hosts(configs: Sequence[EnvConfig], num_cores: int) -> list[int]:
    """The number of hosts of each entry.

    With ``envs_per_process: auto``, entries of CPU-bound simulators share the cores in proportion
    to their envs. Entries on other machines don't, as the cores there are unknown here. Envs that
    only wait are all in one worker, which keeps an event loop for them. Others have a worker each,
    as it is not known whether they may share a process.
    """
    nums: list[int] = []
    sharing: list[int] = []
    for k, config in enumerate(configs):
        if not placement_for(config).spreads:
            nums.append(1)
        elif config.envs_per_process != "auto":
            nums.append(-(-config.num_workers // config.envs_per_process))
        elif ENVS.is_awaitable(config.backend):
            nums.append(1)
        elif _shares_cores(config):
            nums.append(1)
            sharing.append(k)
        else:
            nums.append(config.num_workers)
    for _ in range(num_cores - len(sharing)):
        # Add a worker to the entry with the most envs per worker.
        crowded = max(sharing, key=lambda k: configs[k].num_workers / nums[k], default=None)
        if crowded is None or nums[crowded] == configs[crowded].num_workers:
            break
        nums[crowded] += 1
    return nums


def _shares_cores(config: EnvConfig) -> bool:
    """True for envs that are known to compute, or that wait on the event loop of a worker."""
    if not ENVS.is_cpu_bound(config.backend) or not placement_for(config).local:
        return False
    task: Any = config.task
    if isinstance(task, tuple):
        task = cast("tuple[Any, ...]", task)[0]
    return ENVS.computes(config.backend, config.task) or inspect.iscoroutinefunction(
        getattr(task, "step", None)
    )


def _shares(fns: Sequence[PreprocessFn | None], num_hosts: int) -> list[Share]:
    """The envs of each host of an entry: consecutive ones, evenly divided."""
    count, envs = len(fns), list(enumerate(fns))
    bounds = [count * k // num_hosts for k in range(num_hosts + 1)]
    return [envs[first:end] for first, end in itertools.pairwise(bounds)]
