"""`ServerHost`: the clients of one env_server, as rows of a host like any other.

A client takes a row when it first joins and keeps it, by its name, for as long as the
group lives. Its first result comes unasked; a request to a client that is known to be
away is withdrawn, and its next first result is the answer.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.hosts.episodes import EpisodeSums
from rlightning_aio.protocol.rings import NUMBER_SHIFT, OP_BITS, SLOT_MASK

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Inbox, Watcher
    from rlightning_aio.hosts.remote import RemoteHost
    from rlightning_aio.hosts.runner import Rest
    from rlightning_aio.hosts.worker import AttachOrder
    from rlightning_aio.protocol.server_session import RemoteResult

__all__ = ["MAX_CLIENTS", "ServerHost"]

MAX_CLIENTS: Final = 1024
"""Rows of a server; the sessions refuse clients beyond."""


class ServerHost:
    """See `base.Host`. Its envs come and go, so it may have something to tell unasked."""

    def __init__(
        self, host_id: int, first_slot: int, remote: RemoteHost, inbox: Inbox, watcher: Watcher
    ) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.rows = MAX_CLIENTS
        self.in_flight = 0
        # Its descriptor tells of everything, so there is never anything to sweep.
        self.ordered = 1
        self.inline = False
        self.elastic = True
        self.remote = remote
        self._inbox = inbox
        self._watcher = watcher
        self._names: list[str] = []
        self._rows: dict[str, int] = {}
        self._sums: dict[int, EpisodeSums] = {}
        self._resetting: set[int] = set()
        self._open = False

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Listen."""
        self.remote.start()
        self._open = True
        self._watcher.watch(self)
        self._inbox.on_started(self, [])

    def attach(self, order: AttachOrder) -> None:
        """Clients have no rows in a slab."""
        del order
        self._inbox.on_attached(self)

    def kill(self, *, dump: bool) -> None:
        """Clients are not ours to kill."""

    def close(self) -> None:
        """Say goodbye to the clients."""
        self.release()
        self._inbox.on_closed(self, [])

    def release(self) -> None:
        """Stop listening."""
        if self._open:
            self._open = False
            self._watcher.unwatch(self)
            self.remote.close()

    # -- clients ------------------------------------------------------------------

    def clients(self) -> list[int]:
        """Rows of the clients that are here, in the order of their names."""
        # One that has joined this very moment may not have its row yet.
        return [self._rows[name] for name in sorted(self.remote.clients) if name in self._rows]

    def num_envs(self, row: int) -> int:
        """Sub-environments of the client of `row`, which is here."""
        return self.remote.clients[self._names[row]].num_envs

    def check_step(self, row: int, action: Any) -> None:
        """Raises `BadAction` if the client of `row` can't take `action`."""
        self.remote.check(self._names[row], action)

    @property
    def missing(self) -> int:
        """Clients that a reset has still to wait for."""
        return max(0, self.remote.settings.min_clients - len(self.remote.clients))

    # -- requests -----------------------------------------------------------------

    def request(self, entries: NDArray[np.int64]) -> None:
        """Resets without arguments: a client's steps never fit a row."""
        for entry in entries.tolist():
            row = ((entry >> OP_BITS) & SLOT_MASK) - self.first_slot
            self.request_reset(row, entry >> NUMBER_SHIFT, (None, None))

    def pack(self, content: Any) -> Any:
        """The wire format packs; nothing is pickled."""
        return content

    def request_step(self, row: int, number: int, packed: Any) -> None:
        """See `base.Host.request_step`."""
        now, (action, extras) = time.monotonic(), packed
        self._asked(row, number, self.remote.submit(self._names[row], number, action, extras, now))

    def request_reset(self, row: int, number: int, packed: Any) -> None:
        """See `base.Host.request_reset`."""
        now, name, (seed, options) = time.monotonic(), self._names[row], packed
        self._resetting.add(row)
        self._asked(row, number, self.remote.submit_reset(name, number, seed, options, now))

    def _asked(self, row: int, number: int, will_answer: bool) -> None:
        if will_answer:
            self.in_flight += 1
        else:
            self._inbox.on_withdrawn(self, row, number)

    def request_call(self, row: int, number: int, packed: Any) -> None:
        """Never asked for: the core refuses calls of remote envs."""
        raise NotImplementedError

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        """See `RemoteHost.fileno`."""
        return self.remote.fileno()

    def on_readable(self) -> None:
        """See `base.Source.on_readable`."""
        self.tick(time.monotonic())

    def on_writable(self) -> None:
        """Never asked for: ZMQ sends by itself."""

    def tick(self, now: float) -> None:
        """Take in what clients have sent; find those that are gone."""
        self.remote.pump(now)
        for result in self.remote.take():
            self._deliver(result)

    def deadline(self) -> float | None:
        """When `tick` is due at the latest."""
        return self.remote.deadline()

    def _deliver(self, result: RemoteResult) -> None:
        row = self._rows.get(result.client)
        if row is None:
            row = self._rows[result.client] = len(self._names)
            self._names.append(result.client)
        number = result.number
        if number is None:
            meta = self.remote.clients[result.client]
            agents = (len(meta.agents),) if meta.agents else ()
            sub_envs = (meta.num_envs,) if meta.num_envs > 1 else ()
            self._sums[row] = EpisodeSums((*agents, *sub_envs), meta.autoreset)
            number = self._inbox.on_client(self, row, meta)
        else:
            self.in_flight -= 1
        if result.error is not None:
            self._inbox.on_fault(self, row, number, result.error)
            return
        self._inbox.on_rest(self, row, number, self._rest(row, result))

    def _rest(self, row: int, result: RemoteResult) -> Rest:
        agents = _agents(result.reward)
        reward = _head(result.reward, agents).astype(np.float64)
        terminated, truncated = _head(result.terminated, agents), _head(result.truncated, agents)
        sums = None
        if result.number is None or row in self._resetting:
            self._resetting.discard(row)
            self._sums[row].forget()
        else:
            sums = self._sums[row].add(reward, terminated | truncated)
        return {
            "observation": result.observation,
            "info": result.info,
            "extra": result.extra,
            "head": (reward, terminated, truncated),
            "sums": sums,
            "agents": agents,
            "times": (time.monotonic_ns(), result.busy_ns),
        }

    def order(self, count: int) -> bool:
        """Whatever comes wakes the driver."""
        del count
        return False

    def withdraw(self) -> None:
        """Nothing is ever ordered here."""

    def unread(self) -> int:
        """Nothing waits to be swept here."""
        return 0

    def sweep(self) -> None:
        """Whatever comes wakes the driver."""

    def run_one(self) -> bool:
        """Nothing runs here."""
        return False

    def executing(self) -> tuple[int, int]:
        """Unknown here; the sessions keep clients' time limits."""
        return 0, 0


def _agents(reward: Any) -> tuple[str, ...]:
    return tuple(cast("dict[str, Any]", reward)) if isinstance(reward, dict) else ()


def _head(value: Any, agents: tuple[str, ...]) -> NDArray[Any]:
    """A reward or a flag as an array: agents, then sub-environments, where there are any."""
    return np.array([value[agent] for agent in agents]) if agents else np.array(value)
