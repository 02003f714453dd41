"""`Members`: the envs that join and leave while the group runs, and the hosts that they join."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rlightning_aio._core.group.drivers.wait import earliest
from rlightning_aio._core.group.state.slab_layout import check_actions
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.tables import Tables
    from rlightning_aio._core.hosts.base import Membership
    from rlightning_aio.types import EnvMeta

__all__ = ["Members"]


class Members:
    """See the module.

    Attributes:
        possible: envs may join.
        server_ids: of the hosts that envs join, in order.
    """

    def __init__(self, tables: Tables) -> None:
        self._tables = tables
        self._envs = tables.envs
        self._servers: list[Membership] = []
        self.possible = False

    def add(self, server: Membership) -> None:
        """Add a host that envs join."""
        self._servers.append(server)
        self.possible = True

    @property
    def server_ids(self) -> list[str]:
        return [server.server_id for server in self._servers]

    def server(self, server_id: str) -> Membership | None:
        """Return the host with that id that envs join, or None."""
        return next((one for one in self._servers if one.server_id == server_id), None)

    def slots(self) -> list[int]:
        """Return the slots of the members that are present, by host and name."""
        return [
            server.first_slot + index
            for server in self._servers
            for index in server.member_indices()
        ]

    def everyone(self) -> NDArray[np.intp]:
        """Return the slots of the local envs, and of the members that are present."""
        members = self.slots()
        return np.concatenate((self._envs.all, members)) if members else self._envs.all

    def rank(self) -> None:
        """Number the members' seeds after those of the local envs, in the order of `slots`."""
        offset = self._envs.num_seeds
        for server in self._servers:
            for index in server.member_indices():
                self._envs.seed_offset[server.first_slot + index] = offset
                offset += server.num_sub_envs(index)

    def missing(self, waited: float) -> float | None:
        """Return the seconds that a reset may wait in all for members; None if there are enough.

        Raises:
            TimeoutError: it has waited for longer than a host's ``connect_timeout``.
        """
        return earliest(*(server.missing(waited) for server in self._servers))

    def objection(self, meta: EnvMeta, local: Sequence[EnvMeta]) -> str | None:
        """Return the reason why an env may not join, or None.

        Unless the group allows mixed actions, all its actions must have one shape.

        Args:
            meta: of the env.
            local: metadata of the group's own envs.
        """
        known = [one for one in local if one.action_space is not None]
        known += [one for server in self._servers for one in server.members().values()]
        try:
            if not self._tables.mixed_actions:
                check_actions([*known[:1], meta])
        except ConfigError as error:
            return str(error)
        return None

    def next_deadline(self) -> float | None:
        """Return the time when `tick` must be called at the latest."""
        return earliest(*(server.deadline() for server in self._servers))

    def tick(self, now: float) -> None:
        """Let hosts find members that have been silent for too long."""
        for server in self._servers:
            due = server.deadline()
            if due is not None and due <= now:
                server.tick(now)
