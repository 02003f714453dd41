"""`Tables`: the state of a group, which all its parts share: each gets it whole."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from rlightning_aio._core.group.state.conditions import Conditions, Lifetime, Observed
    from rlightning_aio._core.group.state.env_table import EnvTable
    from rlightning_aio._core.group.state.episodes import Episodes
    from rlightning_aio._core.group.state.host_record import HostRecord
    from rlightning_aio._core.group.state.requests import Requests
    from rlightning_aio._core.group.state.slab_layout import SlabLayout
    from rlightning_aio._core.group.state.sums import Sums
    from rlightning_aio._core.hosts.arena import Arena
    from rlightning_aio._core.hosts.base import Driver, Shared
    from rlightning_aio._core.hosts.messages import Completion, Completions


@dataclass(frozen=True)
class Tables:
    """The state of a group.

    Attributes:
        envs, requests, layout, episodes: tables over the slots.
        conditions: the reasons why a step can't take the fast path.
        observed: holds the observer.
        lifetime: whether the group is open.
        arena: the memory that hosts share with the group.
        sums: the numbers of the group.
        clock: monotonic seconds, for the parts that can't be given the time.
        driver: of the group.
        num_cores: that this process and its workers may use.
        shares_thread: other tasks may use the group while a call waits.
        mixed_actions: the actions of envs may differ in shape.
        records: of the hosts, in the order of their slots; complete when the group starts.
        completions: the queue to which hosts post.
        resources: shared by hosts, see `base.Wiring`.
    """

    envs: EnvTable
    requests: Requests
    layout: SlabLayout
    episodes: Episodes
    conditions: Conditions
    observed: Observed
    lifetime: Lifetime
    arena: Arena
    sums: Sums
    clock: Callable[[], float]
    driver: Driver
    num_cores: int = 1
    shares_thread: bool = False
    mixed_actions: bool = False
    records: list[HostRecord] = field(default_factory=list["HostRecord"])
    completions: Completions = field(default_factory=deque["Completion"])
    resources: dict[object, Shared] = field(default_factory=dict[object, "Shared"])

    def record_of(self, slot: int) -> HostRecord:
        """Return the record of the host of an env."""
        return self.records[self.requests.hosts.item(slot)]

    def stop_hardware(self, slots: Iterable[int]) -> None:
        """Stop those of `slots` that move something real, whatever they do now."""
        for slot in slots:
            record = self.record_of(slot)
            if record.is_hardware:
                host = record.host
                host.stop(slot - host.first_slot, self.requests.numbering.number(slot))

    def slots_of(self, record: HostRecord) -> NDArray[np.intp]:
        """Return the slots of the envs that a host has now: others may be with its peer."""
        slots = np.array(record.slots, np.intp)
        return slots[self.requests.hosts[slots] == record.host.host_id]
