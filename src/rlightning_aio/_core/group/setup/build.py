"""Build a group from its plan: create the hosts and the parts of the core."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rlightning_aio._core.group.engine.core import Core
from rlightning_aio._core.group.engine.waiting import Poller
from rlightning_aio._core.group.setup.plan import host_class, placement_for
from rlightning_aio._core.group.setup.start_orders import start_orders
from rlightning_aio._core.group.state.conditions import Conditions, Lifetime, Observed
from rlightning_aio._core.group.state.env_table import EnvTable
from rlightning_aio._core.group.state.episodes import Episodes
from rlightning_aio._core.group.state.requests import Requests
from rlightning_aio._core.group.state.slab_layout import SlabLayout
from rlightning_aio._core.group.state.sums import Sums
from rlightning_aio._core.group.supervision.supervisor import Supervisor
from rlightning_aio._core.group.tables import Tables
from rlightning_aio._core.hosts.arena import Arena
from rlightning_aio._core.hosts.base import Wiring
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.rings import TrainerBell, bell_size
from rlightning_aio.registry import load
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rlightning_aio._core.group.setup.plan import Plan
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.hosts.base import Driver
    from rlightning_aio._core.hosts.messages import StartOrder


def assemble(plan: Plan, driver: Driver, *, shares_thread: bool) -> Core:
    """Create the core of a group and its hosts, without starting anything.

    An error of a host's factory propagates, after everything created before it is released.

    Args:
        plan: from `plan_group`.
        driver: of the group.
        shares_thread: other tasks may use the group while a procedure waits.

    Raises:
        ConfigError: an entry needs the event loop that a synchronous group doesn't have.
    """
    for config in plan.configs:
        if not shares_thread and placement_for(config).awaits == "only":
            raise ConfigError(
                f"entry {config.name!r}: a synchronous group has no event loop for placement "
                f"{config.placement!r}; use placement: process, whose workers run awaitable envs "
                "on event loops of their own, or the asynchronous group"
            )
    cores = num_cores()
    orders = start_orders(plan, cores)
    tables = _tables(plan, orders, driver, cores, shares_thread=shares_thread)
    try:
        return _assembled(plan, orders, tables)
    except BaseException:
        tables.arena.close()
        raise


def _assembled(plan: Plan, orders: Sequence[StartOrder], tables: Tables) -> Core:
    arena = tables.arena
    num_hosts = len(tables.requests.rings)
    bell_offset = arena.append(bell_size(num_hosts))
    bell_memory = arena.map(bell_offset, bell_size(num_hosts))
    bell = TrainerBell(bell_memory, num_hosts)
    tables.resources["bell"] = bell
    supervisor = Supervisor(tables)
    poller = Poller(tables.requests, bell, tables.num_cores, clock=tables.clock)
    wiring = Wiring(
        completions=tables.completions,
        driver=tables.driver,
        arena=arena,
        bell=bell,
        bell_offset=bell_offset,
        rings=tables.requests.rings,
        num_hosts=num_hosts,
        configs=[order.config for order in orders],
        objection=supervisor.objection,
        busy_since=tables.requests.busy_since,
        resources=tables.resources,
    )
    first_slot = 0
    for host_id, order in enumerate(orders):
        host = host_class(order.config)(host_id, first_slot, order, wiring)
        supervisor.add(host, order.config)
        poller.add(host)
        first_slot += host.num_envs
    for order, record in zip(orders, list(tables.records), strict=True):
        if not order.config.recycle:
            continue
        host_id = len(supervisor.hosts)
        again = replace(order, is_again=True)
        host = host_class(order.config)(host_id, record.slots.start, again, wiring)
        supervisor.add(host, order.config, record)
        poller.add(host)
    return Core(tables, supervisor, poller, zero_copy=plan.zero_copy)


def _tables(
    plan: Plan, orders: Sequence[StartOrder], driver: Driver, cores: int, *, shares_thread: bool
) -> Tables:
    """Make the state of a group whose hosts get `orders`."""
    configs = [order.config for order in orders for _ in order.worker_indices]
    env_ids: list[str] = []
    for order in orders:
        name, find = order.config.name, placement_for(order.config).places
        places: list[str] = load(find)(order.config) if find else []
        env_ids += [
            f"{name}-0/{places[k]}" if find else f"{name}-{k}" for k in order.worker_indices
        ]
    num_local = sum(not placement_for(config).places for config in configs)
    envs = EnvTable(configs, env_ids, num_local)
    conditions = Conditions()
    nums_envs = [len(order.worker_indices) for order in orders]
    hosts = np.repeat(np.arange(len(orders)), nums_envs)
    num_peers = sum(bool(order.config.recycle) for order in orders)
    requests = Requests(hosts, len(orders) + num_peers, conditions)
    records: list[HostRecord] = []
    return Tables(
        envs=envs,
        requests=requests,
        layout=SlabLayout(len(envs)),
        episodes=Episodes(envs, conditions),
        conditions=conditions,
        observed=Observed(),
        lifetime=Lifetime(conditions),
        arena=Arena(),
        sums=Sums(envs, requests, records),
        records=records,
        clock=time.monotonic,
        driver=driver,
        num_cores=cores,
        shares_thread=shares_thread,
        mixed_actions=plan.mixed_actions,
    )
