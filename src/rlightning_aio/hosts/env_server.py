"""`EnvServerHost`: the clients of one env_server, as envs of a host like any other.

A client takes a place when it first joins and keeps it, by its name, until the places run
out. Its first result comes unasked; a request to a client that is known to be away is
withdrawn, and its next first result is the answer. Clients of one env_server are of one
kind, so they share one slab, made when the first of them joins.
"""

from __future__ import annotations

import mmap
import time
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.errors import UnknownEnv
from rlightning_aio.hosts.listener import Listener, server_settings
from rlightning_aio.hosts.messages import (
    NO_ACTION,
    Attached,
    Built,
    Closed,
    Failed,
    Joined,
    Reported,
    Result,
    Withdrawn,
)
from rlightning_aio.hosts.row_writer import RowWriter, infos_out_of_band
from rlightning_aio.protocol.columns import row_reader
from rlightning_aio.protocol.entries import Operation, number_of, op_of, slot_of
from rlightning_aio.protocol.net.wire import MAX_BYTES_IN_ALL
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

    from rlightning_aio.hosts.base import Wiring
    from rlightning_aio.hosts.messages import AttachOrder, OutOfBand, StartOrder
    from rlightning_aio.protocol.net.server_session import RemoteResult
    from rlightning_aio.types import EnvMeta

__all__ = ["EnvServerHost"]


class _Place:
    """One client's place in the slab.

    Attributes:
        name: of the client.
        entry: of what it owes.
    """

    def __init__(self, slab: Slab, row: int) -> None:
        self.name = ""
        self.entry = 0
        self._read_action: Callable[[], Any] | None = None
        if slab.action is not None:
            self._read_action = row_reader(slab.layout.action_space, slab.action, row)
        self._slab = slab
        self._row = row
        self._sent_ns = cast("NDArray[np.int64]", slab.sent_ns)

    def take(self, name: str, meta: EnvMeta) -> None:
        """Have the place hold a session of `name`, whose episodes begin anew."""
        self.name = name
        self._writer = RowWriter(
            self._slab,
            self._row,
            env_id=meta.env_id,
            autoreset=meta.autoreset,
            announce=infos_out_of_band,
        )

    def action(self, given: Any) -> Any:
        """The action of a step: what was `given`, or what lies in the row."""
        if given is NO_ACTION and self._read_action is not None:
            return self._read_action()
        return given

    def write(self, result: RemoteResult) -> OutOfBand | None:
        """Put a result into the row; what of it is out of band."""
        writer = self._writer
        ends = writer.checked_ends(result.reward, result.terminated, result.truncated)
        if result.is_reset or result.is_loss:
            # An episode that the client's going has cut short is no whole one.
            writer.begin_episode(result.info)
            if result.is_loss:
                self._slab.truncated[self._row] = ends[2]
        else:
            writer.write_ends(*ends, result.info)
        writer.write_times(time.monotonic_ns(), result.busy_ns)
        # Statistics go by this machine's clock, and what the result says by its client's.
        self._sent_ns[self._row] = result.sent_ns or time.time_ns()
        return writer.write_data(result.observation, result.info, result.extra)

    def write_first(self, result: RemoteResult) -> OutOfBand | None:
        """The same for a first result, once the trainer takes it in."""
        with np.errstate(all="ignore"):
            return self.write(result)


class EnvServerHost:
    """See `base.Host`, `Polled` and `Membership`. It may have something to tell unasked."""

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        config = order.config
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self.server_id = f"{config.name}-0"
        self._listener = Listener(
            self.server_id,
            server_settings(config),
            step_timeout=config.step_timeout,
            reset_timeout=config.reset_timeout,
            objection=wiring.objection,
        )
        self._tell = wiring.completions.append
        self._watcher = wiring.watcher
        self._is_idle = wiring.is_idle
        self._slab: Slab | None = None
        self._places: list[_Place] = []
        self._index_of: dict[str, int] = {}
        self._open = False

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Listen."""
        self._listener.start()
        self._open = True
        self._watcher.watch(self)
        self._tell(Built(self.host_id, []))

    def attach(self, order: AttachOrder) -> None:
        """Clients get their rows when they join."""
        del order
        self._tell(Attached(self.host_id))

    def close(self) -> None:
        """Say goodbye to the clients."""
        self.release()
        self._tell(Closed(self.host_id, []))

    def release(self) -> None:
        """Stop listening."""
        if self._open:
            self._open = False
            self._watcher.unwatch(self)
            self._listener.close()

    # -- clients ------------------------------------------------------------------

    def address(self) -> str:
        """See `base.Membership.address`."""
        return self._listener.address

    def members(self) -> Mapping[str, EnvMeta]:
        """See `base.Membership.members`."""
        return self._listener.clients

    def member_indices(self) -> list[int]:
        """See `base.Membership.member_indices`."""
        # One that has joined this very moment may not have its place yet.
        return [self._index_of[name] for name in sorted(self.members()) if name in self._index_of]

    def num_sub_envs(self, index: int) -> int:
        """See `base.Membership.num_sub_envs`."""
        return self.members()[self._places[index].name].num_envs

    def check_step(self, index: int, action: Any, extras: dict[str, Any]) -> None:
        """See `base.Membership.check_step`."""
        place = self._places[index]
        self._listener.check(place.name, place.action(action), extras)

    def check_reset(self, index: int, seed: int | None, options: dict[str, Any]) -> None:
        """See `base.Membership.check_reset`."""
        self._listener.check_reset(self._places[index].name, seed, options)

    def missing(self, waited: float) -> float | None:
        """See `base.Membership.missing`."""
        settings = self._listener.settings
        if len(self.members()) >= settings.min_clients:
            return None
        if waited >= settings.connect_timeout:
            raise TimeoutError(
                f"{len(self.members())} of {settings.min_clients} clients have joined "
                f"{self.server_id!r} at {self.address()} within "
                f"{settings.connect_timeout} s; start more, or lower min_clients"
            )
        return settings.connect_timeout

    def _place_of(self, name: str, meta: EnvMeta) -> int | None:
        """The place of a client that joins; None if all are taken."""
        slab = self._slab
        if slab is None:
            slab = self._slab = _slab_for(meta, self.num_envs)
        index = self._index_of.get(name)
        if index is None:
            index = self._free_place(slab)
            if index is None:
                return None
            self._index_of.pop(self._places[index].name, None)
            self._index_of[name] = index
        self._places[index].take(name, meta)
        return index

    def _free_place(self, slab: Slab) -> int | None:
        index = len(self._places)
        if index < slab.rows:
            self._places.append(_Place(slab, index))
            return index
        for index, place in enumerate(self._places):
            if place.name not in self.members() and self._is_idle(self.first_slot + index):
                return index
        return None

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> Any:
        """The wire format packs; what it has no form for, `check_step` and `check_reset` find."""
        return arguments

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """See `base.Host.submit`."""
        now = time.monotonic()
        try:
            self._submit(entries, arguments, now)
        finally:
            self._listener.flush(now)

    def _submit(
        self, entries: NDArray[np.int64], arguments: Sequence[Any] | None, now: float
    ) -> None:
        for position, entry in enumerate(cast("list[int]", entries.tolist())):
            given = None if arguments is None else arguments[position]
            try:
                will_answer = self._ask(entry, given, now)
            except UnknownEnv:
                # It was away, and its seat was needed.
                will_answer = False
            if not will_answer:
                self._tell(Withdrawn(self.host_id, entry))

    def _ask(self, entry: int, given: Any, now: float) -> bool:
        index = slot_of(entry) - self.first_slot
        place = self._places[index]
        place.entry = entry
        if op_of(entry) == Operation.STEP:
            return self._step(place, entry, given, now)
        return self._reset(place, index, entry, given, now)

    def _step(
        self, place: _Place, entry: int, given: tuple[Any, dict[str, Any]] | None, now: float
    ) -> bool:
        action, extras = given or (NO_ACTION, {})
        number = number_of(entry)
        return self._listener.submit(place.name, number, place.action(action), extras, now)

    def _reset(
        self, place: _Place, index: int, entry: int, given: tuple[Any, Any] | None, now: float
    ) -> bool:
        slab = cast("Slab", self._slab)
        seed, options = given or (slab.take_seed(index), None)
        return self._listener.submit_reset(place.name, number_of(entry), seed, options, now)

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        """See `Listener.fileno`."""
        return self._listener.fileno()

    def on_readable(self) -> None:
        """See `base.Source.on_readable`."""
        self.tick(time.monotonic())

    def on_writable(self) -> None:
        """Never asked for: ZMQ sends by itself."""

    def is_readable(self) -> bool:
        """See `base.Membership.is_readable`."""
        return self._listener.is_readable()

    def poll(self) -> None:
        """See `base.Polled.poll`."""
        if self._open and self._listener.is_readable():
            self.tick(time.monotonic())

    def deadline(self) -> float | None:
        """See `base.Membership.deadline`."""
        return self._listener.deadline()

    def tick(self, now: float) -> None:
        """See `base.Membership.tick`."""
        self._listener.pump(now)
        results = self._listener.take()
        if results:
            # The trainer may have its own arithmetic raise; a client's numbers must not.
            with np.errstate(all="ignore"):
                self._take_in(results)

    def _take_in(self, results: list[RemoteResult]) -> None:
        done: list[int] = []
        for result in results:
            if result.number is None:
                self._join(result)
                continue
            place = self._places[self._index_of[result.client]]
            if result.error is not None:
                self._tell(Failed(self.host_id, place.entry, result.error))
                continue
            out_of_band = place.write(result)
            if out_of_band is None:
                done.append(place.entry)
            else:
                self._tell(Result(self.host_id, place.entry, out_of_band, result.is_loss))
        if done:
            self._tell(Reported(self.host_id, np.array(done, np.int64)))

    def _join(self, result: RemoteResult) -> None:
        """Tell of a client that has come, and of its first result."""
        name = result.client
        meta = self.members().get(name)
        if meta is None:
            return  # It has left again already.
        known = self._slab
        index = self._place_of(name, meta)
        if index is None:
            self._listener.dismiss(name, "the server has no place for another client")
            return
        slab = self._slab if known is None else None
        traits = self._listener.traits(name)
        write = partial(self._places[index].write_first, result)
        self._tell(Joined(self.host_id, index, meta, traits, slab, write))


def _slab_for(meta: EnvMeta, most: int) -> Slab:
    """Rows for clients of one kind, in memory of this process alone."""
    agents = (len(meta.agents),) if meta.agents else ()
    sub_envs = (meta.num_envs,) if meta.num_envs > 1 else ()
    layout = RowLayout(
        cast("gym.Space[Any]", meta.observation_space),
        cast("gym.Space[Any]", meta.action_space),
        (*agents, *sub_envs),
        meta.agents,
    )
    # Of what no client uses, the system takes nothing.
    rows = max(1, min(most, MAX_BYTES_IN_ALL // layout.size(1)))
    memory = mmap.mmap(-1, layout.size(rows), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    slab = Slab(layout, memoryview(memory), rows)
    slab.sent_ns = np.zeros(rows, np.int64)
    return slab
