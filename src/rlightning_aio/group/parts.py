"""`Parts`: what a group's core is built from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rlightning_aio.group.poller import Poller
    from rlightning_aio.group.supervisor import Supervisor
    from rlightning_aio.group.tables import Tables
    from rlightning_aio.hosts.base import Watcher
    from rlightning_aio.hosts.messages import Completions
    from rlightning_aio.protocol.exchange import Ring
    from rlightning_aio.protocol.rings import TrainerBell

__all__ = ["Parts"]


@dataclass(frozen=True)
class Parts:
    """The arguments of `Core`.

    Attributes:
        tables: the state of the group.
        supervisor, poller: of the hosts.
        bell, rings: shared memory; workers post replies in rings, and the bell announces them.
        completions: queue of the outcomes of requests, posted by hosts.
        watcher: the driver.
    """

    tables: Tables
    supervisor: Supervisor
    poller: Poller
    bell: TrainerBell
    rings: list[Ring | None]
    completions: Completions
    watcher: Watcher
