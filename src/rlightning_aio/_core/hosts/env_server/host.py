"""`EnvServerHost`: the clients of one env_server, as envs of a host.

A client takes a position in the host when it first joins, and keeps it under its name until another
client needs it. A client's first result answers no request. A request to a client that is known to
be absent is withdrawn, and the client's next first result answers it. Clients of one env_server are
of one kind, so they share one slab, which is made when the first of them joins.
"""

from __future__ import annotations

import mmap
import time
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio._core.hosts.base import Membership
from rlightning_aio._core.hosts.env_server.listener import Listener
from rlightning_aio._core.hosts.env_server.settings import server_settings
from rlightning_aio._core.hosts.messages import (
    STEP_IN_ROW,
    Attached,
    Built,
    Closed,
    Joined,
    Raised,
    Reported,
    Result,
    Withdrawn,
)
from rlightning_aio._core.hosts.running.row_writer import RowWriter, infos_out_of_band
from rlightning_aio.protocol.columns import row_reader
from rlightning_aio.protocol.entries import Operation, number_of, op_of, slot_of
from rlightning_aio.protocol.net.server_session import ServerSessions
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, OutOfBand, StartOrder
    from rlightning_aio.protocol.net.server_session import RemoteResult
    from rlightning_aio.types import ClientTraits, EnvMeta

__all__ = ["EnvServerHost"]

_MAX_SLAB_BYTES = 1 << 30


class _ClientRow:
    """One client's row of the slab.

    Attributes:
        name: of the client.
        entry: the client's pending request.
    """

    def __init__(self, slab: Slab, row: int) -> None:
        self.name = ""
        self.entry = 0
        self._read_action: Callable[[], Any] | None = None
        if slab.action is not None:
            self._read_action = row_reader(slab.action, row)
        self._slab = slab
        self._row = row
        self._sent_ns = cast("NDArray[np.int64]", slab.sent_ns)

    def assign(self, name: str, meta: EnvMeta, traits: ClientTraits) -> None:
        """Give the row to a new session of the client `name`."""
        self.name = name
        self._is_free = traits.free_actions
        self._writer = RowWriter(
            self._slab,
            self._row,
            env_id=meta.env_id,
            autoreset=meta.autoreset,
            announce=infos_out_of_band,
        )

    def action(self, given: Any) -> Any:
        """Return the action of a step: `given`, or that of the row if it travels there."""
        return given if self._read_action is None or self._is_free else self._read_action()

    def write(self, result: RemoteResult) -> OutOfBand | None:
        """Write a result into the row; return the parts that have no place there."""
        ends = result.reward, result.terminated, result.truncated
        parts = result.observation, *ends, result.info
        # Statistics use this machine's clock; the result has the time of its client's.
        self._sent_ns[self._row] = result.sent_ns or time.time_ns()
        if result.is_reset or result.is_loss:
            return self._writer.write_reset(
                parts, result.busy_ns, result.extra, is_loss=result.is_loss
            )
        return self._writer.write_step(parts, result.busy_ns, result.extra)

    def write_first(self, result: RemoteResult) -> OutOfBand | None:
        """Write a first result, when the group accepts it."""
        with np.errstate(all="ignore"):
            return self.write(result)


class EnvServerHost(Membership):
    """See `base.Host` and `Membership`. It also posts results that answer no request."""

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        config = order.config
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self.server_id = f"{config.name}-0"
        self._settings = server_settings(config)
        self._sessions = ServerSessions(
            self.server_id,
            step_timeout=config.step_timeout,
            reset_timeout=config.reset_timeout,
            objection=wiring.objection,
        )
        self._listener = Listener(self.server_id, self._settings, self._sessions)
        self._post = wiring.completions.append
        self._driver = wiring.driver
        self._is_idle = wiring.is_idle
        self._slab: Slab | None = None
        self._rows: list[_ClientRow] = []
        self._index_of: dict[str, int] = {}
        self._open = False

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Listen."""
        self._listener.start()
        self._open = True
        self._driver.watch(self)
        self._post(Built(self.host_id, []))

    def attach(self, order: AttachOrder) -> None:
        """Clients get their rows when they join."""
        del order
        self._post(Attached(self.host_id))

    def close(self) -> None:
        """Send the clients a goodbye."""
        self.release()
        self._post(Closed(self.host_id, []))

    def release(self) -> None:
        """Stop listening."""
        if self._open:
            self._open = False
            self._driver.unwatch(self)
            self._listener.close()

    # -- clients ------------------------------------------------------------------

    def address(self) -> str:
        return self._listener.address

    def members(self) -> Mapping[str, EnvMeta]:
        return self._sessions.clients

    def member_indices(self) -> list[int]:
        # A client that has joined this very moment may not have its row yet.
        return [self._index_of[name] for name in sorted(self.members()) if name in self._index_of]

    def num_sub_envs(self, index: int) -> int:
        return self.members()[self._rows[index].name].num_envs

    def check_step(self, index: int, action: Any, extras: dict[str, Any]) -> None:
        row = self._rows[index]
        self._sessions.check_step(row.name, row.action(action), extras)

    def check_reset(self, index: int, seed: int | None, options: dict[str, Any]) -> None:
        self._sessions.check_reset(self._rows[index].name, seed, options)

    def missing(self, waited: float) -> float | None:
        settings = self._settings
        if len(self.members()) >= settings.min_clients:
            return None
        if waited >= settings.connect_timeout:
            raise TimeoutError(
                f"{len(self.members())} of {settings.min_clients} clients have joined "
                f"{self.server_id!r} at {self.address()} within "
                f"{settings.connect_timeout} s; start more, or lower min_clients"
            )
        return settings.connect_timeout

    def _assign_row(self, name: str, meta: EnvMeta) -> int | None:
        """Give a client that joins a row. Return its index, or None if no row is free."""
        slab = self._slab
        if slab is None:
            slab = self._slab = _slab_for(meta, self.num_envs)
        index = self._index_of.get(name)
        if index is None:
            index = self._free_index(slab)
            if index is None:
                return None
            self._index_of.pop(self._rows[index].name, None)
            self._index_of[name] = index
        self._rows[index].assign(name, meta, self._sessions.traits(name))
        return index

    def _free_index(self, slab: Slab) -> int | None:
        index = len(self._rows)
        if index < slab.rows:
            self._rows.append(_ClientRow(slab, index))
            return index
        for index, row in enumerate(self._rows):
            if row.name not in self.members() and self._is_idle(self.first_slot + index):
                return index
        return None

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> Any:
        """Return `arguments` unpacked: `check_step` and `check_reset` find what can't be sent."""
        return arguments

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        now = time.monotonic()
        try:
            self._submit(entries, arguments, now)
        finally:
            self._listener.flush()

    def _submit(
        self, entries: NDArray[np.int64], arguments: Sequence[Any] | None, now: float
    ) -> None:
        for position, entry in enumerate(cast("list[int]", entries.tolist())):
            given = None if arguments is None else arguments[position]
            if not self._request(entry, given, now):
                self._post(Withdrawn(self.host_id, entry))

    def _request(self, entry: int, given: Any, now: float) -> bool:
        """Send one request; return False if its client is absent and the trainer knows that."""
        index, number = slot_of(entry) - self.first_slot, number_of(entry)
        row = self._rows[index]
        row.entry = entry
        if op_of(entry) == Operation.STEP:
            action, extras = given or STEP_IN_ROW
            return self._sessions.step(row.name, number, row.action(action), extras, now)
        seed, options = given or (cast("Slab", self._slab).take_seed(index), None)
        return self._sessions.reset(row.name, number, seed, options, now)

    def abort(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.abort`. The client is lost, and may come back with a new session."""
        for entry in cast("list[int]", entries.tolist()):
            row = self._rows[slot_of(entry) - self.first_slot]
            self._sessions.dismiss(row.name, "the trainer aborted its request")
        now = time.monotonic()
        self._listener.flush()
        self.tick(now)

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        return self._listener.fileno()

    def on_readable(self) -> None:
        self.tick(time.monotonic())

    def on_writable(self) -> None:
        """Do nothing: ZMQ sends by itself, so no driver calls this."""

    def is_readable(self) -> bool:
        return self._listener.is_readable()

    def poll(self) -> None:
        if self._open and self._listener.is_readable():
            self.tick(time.monotonic())

    def deadline(self) -> float | None:
        return self._listener.deadline()

    def tick(self, now: float) -> None:
        self._listener.pump(now)
        results = self._sessions.take()
        if results:
            # The trainer may let its own arithmetic raise; a client's numbers must not.
            with np.errstate(all="ignore"):
                self._post_results(results)

    def _post_results(self, results: list[RemoteResult]) -> None:
        done: list[int] = []
        for result in results:
            if result.number is None:
                self._join(result)
                continue
            row = self._rows[self._index_of[result.client]]
            if result.error is not None:
                self._post(Raised(self.host_id, row.entry, result.error))
                continue
            out_of_band = row.write(result)
            if out_of_band is None:
                done.append(row.entry)
            else:
                self._post(Result(self.host_id, row.entry, out_of_band, result.is_loss))
        if done:
            self._post(Reported(self.host_id, np.array(done, np.int64)))

    def _join(self, result: RemoteResult) -> None:
        """Post that a client has joined, with its first result."""
        name = result.client
        meta = self.members().get(name)
        if meta is None:
            return  # It has left again.
        known = self._slab
        index = self._assign_row(name, meta)
        if index is None:
            self._sessions.dismiss(name, "the server has no room for another client")
            return
        slab = self._slab if known is None else None
        traits = self._sessions.traits(name)
        write = partial(self._rows[index].write_first, result)
        self._post(Joined(self.host_id, index, meta, traits, slab, write))


def _slab_for(meta: EnvMeta, max_rows: int) -> Slab:
    """Return rows for clients of one kind, in memory of this process alone."""
    layout = RowLayout.of(meta)
    # Unused rows cost no memory.
    rows = max(1, min(max_rows, _MAX_SLAB_BYTES // layout.size(1)))
    memory = mmap.mmap(-1, layout.size(rows), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    slab = Slab(layout, memoryview(memory), rows)
    slab.sent_ns = np.zeros(rows, np.int64)
    return slab
