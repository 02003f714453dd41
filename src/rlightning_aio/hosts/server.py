"""`ServerHost`: the clients of one env_server, as rows of a host like any other.

A client takes a row when it first joins and keeps it, by its name, until the rows run
out. Its first result comes unasked; a request to a client that is known to be away is
withdrawn, and its next first result is the answer. Clients of one server are of one
kind, so they share one slab, made when the first of them joins.
"""

from __future__ import annotations

import mmap
import time
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from rlightning_aio.hosts.episodes import EpisodeSum, EpisodeSums
from rlightning_aio.hosts.runner import NO_ACTION
from rlightning_aio.protocol.columns import row_reader, row_writer
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.rings import RESET, STEP, entry, number_of, op_of, slot_of
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Callable

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Inbox, Watcher
    from rlightning_aio.hosts.remote import RemoteHost
    from rlightning_aio.hosts.runner import Rest
    from rlightning_aio.hosts.worker import AttachOrder
    from rlightning_aio.protocol.net.server_session import RemoteResult
    from rlightning_aio.types import EnvMeta

__all__ = ["MAX_CLIENTS", "ServerHost"]

MAX_CLIENTS: Final = 1024
"""Rows of a server at most; twice as many as it lets in at once."""
_SLAB_BYTES: Final = 1 << 32
"""So large may a slab be; of what no client uses, the system takes nothing."""


class _Row:
    """One client's place in the slab.

    Attributes:
        name: of the client.
        sums: of its episode.
        resetting: what it owes is a reset; entry: the entry of what it owes.
        write_observation, read_action: None where that doesn't fit the row.
    """

    def __init__(self, slab: Slab, row: int) -> None:
        layout = slab.layout
        self.name = ""
        self.sums: EpisodeSum | EpisodeSums = EpisodeSums(layout.head, "disabled")
        self.resetting = False
        self.entry = 0
        self.write_observation: Callable[[Any], None] | None = None
        self.read_action: Callable[[], Any] | None = None
        if slab.observation is not None:
            self.write_observation = row_writer(
                layout.observation_space, slab.observation, row, "observation"
            )
        if slab.action is not None:
            self.read_action = row_reader(layout.action_space, slab.action, row)


class ServerHost:
    """See `base.Host`. Its envs come and go, so it may have something to tell unasked."""

    def __init__(
        self, host_id: int, first_slot: int, remote: RemoteHost, inbox: Inbox, watcher: Watcher
    ) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.rows = MAX_CLIENTS
        self.in_flight = 0
        self.ordered = 0
        self.inline = False
        self.elastic = True
        self.remote = remote
        self._inbox = inbox
        self._watcher = watcher
        self._slab: Slab | None = None
        self._places: list[_Row] = []
        self._row_of: dict[str, int] = {}
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
        return [self._row_of[n] for n in sorted(self.remote.clients) if n in self._row_of]

    def num_envs(self, row: int) -> int:
        """Sub-environments of the client of `row`, which is here."""
        return self.remote.clients[self._places[row].name].num_envs

    def check_step(self, row: int, action: Any) -> None:
        """Raises `BadAction` if the client of `row` can't take `action`."""
        self.remote.check(self._places[row].name, action)

    @property
    def missing(self) -> int:
        """Clients that a reset has still to wait for."""
        return max(0, self.remote.settings.min_clients - len(self.remote.clients))

    def _seat(self, name: str, meta: EnvMeta) -> int | None:
        """The row of a client that joins; None if all are taken."""
        slab = self._slab
        if slab is None:
            slab = self._slab = _slab_for(meta)
            self._inbox.on_slab(self, slab)
        row = self._row_of.get(name)
        if row is None:
            row = self._free_row(slab)
            if row is None:
                return None
            place = self._places[row]
            self._row_of.pop(place.name, None)
            place.name = name
            self._row_of[name] = row
        single = not slab.layout.head and meta.autoreset == "disabled"
        sums = EpisodeSum() if single else EpisodeSums(slab.layout.head, meta.autoreset)
        self._places[row].sums = sums
        return row

    def _free_row(self, slab: Slab) -> int | None:
        row = len(self._places)
        if row < slab.rows:
            self._places.append(_Row(slab, row))
            return row
        for row, place in enumerate(self._places):
            if place.name not in self.remote.clients and self._inbox.is_idle(self, row):
                return row
        return None

    # -- requests -----------------------------------------------------------------

    def request(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.request`."""
        slab, now = cast("Slab", self._slab), time.monotonic()
        asked: list[int] = entries.tolist()
        for one in asked:
            row, number = slot_of(one) - self.first_slot, number_of(one)
            if op_of(one) == STEP:
                self._step(row, number, NO_ACTION, {}, now)
            else:
                self._reset(row, number, slab.take_seed(row), None, now)

    def pack(self, content: Any) -> Any:
        """The wire format packs; nothing is pickled."""
        return content

    def request_step(self, row: int, number: int, packed: Any) -> None:
        """See `base.Host.request_step`."""
        action, extras = packed
        self._step(row, number, action, extras, time.monotonic())

    def request_reset(self, row: int, number: int, packed: Any) -> None:
        """See `base.Host.request_reset`."""
        seed, options = packed
        self._reset(row, number, seed, options, time.monotonic())

    def _step(self, row: int, number: int, action: Any, extras: dict[str, Any], now: float) -> None:
        place = self._places[row]
        place.entry = entry(number, self.first_slot + row, STEP)
        if action is NO_ACTION and place.read_action is not None:
            action = place.read_action()
        self._asked(row, number, self.remote.submit(place.name, number, action, extras, now))

    def _reset(
        self, row: int, number: int, seed: int | None, options: dict[str, Any] | None, now: float
    ) -> None:
        place = self._places[row]
        place.resetting = True
        place.entry = entry(number, self.first_slot + row, RESET)
        answered = self.remote.submit_reset(place.name, number, seed, options, now)
        self._asked(row, number, answered)

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
        done: list[int] = []
        for result in self.remote.take():
            self._deliver(result, done)
        if done:
            self._inbox.on_reports(np.array(done, np.int64))

    def deadline(self) -> float | None:
        """When `tick` is due at the latest."""
        return self.remote.deadline()

    def _deliver(self, result: RemoteResult, done: list[int]) -> None:
        """Put a result into its row; `done` takes the entry of one that fits there."""
        number = result.number
        if number is None:
            joined = self._join(result.client)
            if joined is None:
                return
            row, number = joined
        else:
            row = self._row_of[result.client]
            self.in_flight -= 1
        if result.error is not None:
            self._inbox.on_fault(self, row, number, result.error)
            return
        rest = self._write(row, result)
        if rest:
            self._inbox.on_rest(self, row, number, rest)
        else:
            done.append(self._places[row].entry)

    def _join(self, name: str) -> tuple[int, int] | None:
        """Row of a client that has joined, and the number to give its first result."""
        meta = self.remote.clients.get(name)
        if meta is None:
            return None  # It has left again already.
        row = self._seat(name, meta)
        if row is None:
            self.remote.dismiss(name, "the server has no place for another client")
            return None
        owed = self._inbox.on_client(self, row, meta, self.remote.traits(name))
        self._places[row].entry = owed
        return row, number_of(owed)

    def _write(self, row: int, result: RemoteResult) -> Rest:
        """Put `result` into its row; what doesn't fit."""
        slab, place = cast("Slab", self._slab), self._places[row]
        rest: Rest = {}
        if place.write_observation is not None:
            place.write_observation(result.observation)
        else:
            rest["observation"] = result.observation
        slab.info_mark[row] = PICKLED if result.info else NO_INFO
        if result.info:
            rest["info"] = result.info
        if result.extra:
            rest["extra"] = result.extra
        slab.busy_ns[row] = result.busy_ns
        slab.done_ns[row] = time.monotonic_ns()
        self._write_head(slab, row, result)
        return rest

    def _write_head(self, slab: Slab, row: int, result: RemoteResult) -> None:
        agents = slab.layout.agents
        for column, value in (
            (slab.reward, result.reward),
            (slab.terminated, result.terminated),
            (slab.truncated, result.truncated),
        ):
            column[row] = [value[agent] for agent in agents] if agents else value
        place = self._places[row]
        if result.number is None or place.resetting or result.is_loss:
            # An episode that the client's going has cut short is no whole one.
            place.resetting = False
            place.sums.forget()
            slab.episode_length[row] = 0
            return
        if isinstance(place.sums, EpisodeSum):
            ended = bool(slab.terminated[row] or slab.truncated[row])
            sums = place.sums.add(float(slab.reward[row]), ended)
        else:
            sums = place.sums.add(slab.reward[row], slab.ends[row])
        if sums is not None:
            slab.episode_return[row], slab.episode_length[row] = sums

    def order(self, count: int) -> bool:
        """Whatever comes from now on wakes the driver."""
        del count
        return self.remote.is_readable()

    def has_news(self) -> bool:
        """Whatever comes wakes the driver."""
        return False

    def withdraw(self) -> None:
        """Nothing is ever ordered here."""

    def unread(self) -> int:
        """As many as there may be, if there is anything."""
        return self.in_flight if self.remote.is_readable() else 0

    def sweep(self) -> None:
        """See `base.Host.sweep`."""
        if self.remote.is_readable():
            self.tick(time.monotonic())

    def run_one(self) -> bool:
        """Nothing runs here."""
        return False

    def executing(self) -> tuple[int, int]:
        """Unknown here; the sessions keep clients' time limits."""
        return 0, 0


def _slab_for(meta: EnvMeta) -> Slab:
    """Rows for clients of one kind, in memory of this process alone."""
    agents = (len(meta.agents),) if meta.agents else ()
    sub_envs = (meta.num_envs,) if meta.num_envs > 1 else ()
    layout = RowLayout(
        cast("gym.Space[Any]", meta.observation_space),
        cast("gym.Space[Any]", meta.action_space),
        (*agents, *sub_envs),
        meta.agents,
    )
    rows = max(1, min(MAX_CLIENTS, _SLAB_BYTES // layout.size(1)))
    memory = mmap.mmap(-1, layout.size(rows), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return Slab(layout, memoryview(memory), rows)
