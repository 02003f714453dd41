"""`EnvServerHost`: one place of an env_server, as a host whose worker starts itself.

A place is down until a client dials in, and again when the client is lost; the group holds its
requests meanwhile. `EnvServer` is what all places of an entry share: the sockets, and one slab with
a row for each place, which is made when the first client has told its spaces.
"""

from __future__ import annotations

import mmap
import time
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio._core.hosts.base import Host, Shared
from rlightning_aio._core.hosts.env_server.listener import Listener
from rlightning_aio._core.hosts.env_server.settings import server_settings
from rlightning_aio._core.hosts.messages import (
    STEP_IN_ROW,
    Built,
    Closed,
    Death,
    Died,
    EnvStarted,
    Raised,
    Result,
    Taken,
)
from rlightning_aio._core.hosts.running.row_writer import RowWriter, infos_out_of_band
from rlightning_aio.protocol.columns import row_reader
from rlightning_aio.protocol.entries import Operation, op_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.server_session import ClientPlace, ServerSessions
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.base import Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, OutOfBand, StartOrder
    from rlightning_aio.config import EnvConfig
    from rlightning_aio.protocol.net.payload import ResultFields
    from rlightning_aio.protocol.net.server_session import Announcement, Answer
    from rlightning_aio.protocol.net.wire import ClientResult
    from rlightning_aio.types import EnvMeta


class EnvServer(Shared):
    """What the places of one entry share; see `base.Server`.

    Args:
        config: the entry.
        wiring: of the group.

    Attributes:
        places: of the entry, in order.
        listener: for them.
    """

    def __init__(self, config: EnvConfig, wiring: Wiring) -> None:
        self._settings = settings = server_settings(config)
        self.server_id = f"{config.name}-0"
        self.connect_timeout = settings.connect_timeout
        self.places: list[ClientPlace] = []
        self.sessions = ServerSessions(
            self.server_id,
            self.places,
            num_envs=config.num_envs,
            heartbeat=settings.heartbeat,
            objection=wiring.objection,
        )
        self.listener = Listener(self.server_id, settings, self.sessions)
        self._driver = wiring.driver
        self._slab: Slab | None = None

    def add(self, index: int, host: EnvServerHost) -> ClientPlace:
        """Add a place before the start; they come in order."""
        name = self._settings.places[index]
        place = ClientPlace(f"{self.server_id}/{name or index}", host, name)
        self.places.append(place)
        return place

    def slab_for(self, meta: EnvMeta) -> tuple[Slab, bool]:
        """Return the slab of all places, and True if this has made it."""
        if self._slab is not None:
            return self._slab, False
        layout, rows = RowLayout.of(meta), len(self.places)
        memory = mmap.mmap(-1, layout.size(rows), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        self._slab = slab = Slab(layout, memoryview(memory), rows)
        slab.sent_ns = np.zeros(rows, np.int64)
        return slab, True

    # -- what the group asks of it ---------------------------------------------------

    def address(self) -> str:
        return self.listener.address

    def is_readable(self) -> bool:
        return self.listener.is_readable()

    def poll(self) -> None:
        if self.listener.is_readable():
            self.listener.on_readable()

    # -- its life -------------------------------------------------------------------

    def listen(self) -> None:
        """Let clients dial in."""
        self._driver.watch(self.listener)

    def close(self) -> None:
        """Send the clients a goodbye, and stop listening; idempotent."""
        self._driver.unwatch(self.listener)
        self.listener.close()

    def release(self, seconds: float) -> None:
        """See `base.Shared`."""
        del seconds
        self.close()


class EnvServerHost(Host):
    """See `base.Host`, `base.Killable` and `base.SelfStarting`. It has one env."""

    num_envs = 1

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        config = order.config
        self.host_id = host_id
        self.first_slot = first_slot
        key = "env_server", config.name
        server = wiring.resources.get(key)
        if not isinstance(server, EnvServer):
            server = wiring.resources[key] = EnvServer(config, wiring)
        self.server: EnvServer = server
        self._row = order.worker_indices[0]
        self._place = server.add(self._row, self)
        self._post = wiring.completions.append
        self._busy_since = wiring.busy_since
        self._entry = self._since_ns = self._num_messages = 0
        # Clients that have dialled in, and those of them that the group knows.
        self._num_taken = self._num_admitted = 0
        # Seed and options of the reset in flight, and of the one that was lost with a client.
        self._reset: tuple[Any, Any] = (None, None)
        self._lost_reset: tuple[Any, Any] = (None, None)
        self._writer: RowWriter
        self._read_action: Callable[[], Any] | None = None
        self._sent_ns: NDArray[np.int64]

    @property
    def env_id(self) -> str:
        return self._place.env_id

    @property
    def client(self) -> str:
        return "" if self._place.session is None else self._place.session.name

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Have the address to listen on."""
        self.server.listener.start()
        self._post(Built(self.host_id, []))

    def attach(self, order: AttachOrder) -> None:
        """Let clients dial in. The row is known when the first one does."""
        del order
        if not self._row:  # Once is enough for all places.
            self.server.listen()

    def close(self) -> None:
        """Send the clients of all places a goodbye."""
        self.server.close()
        self._post(Closed(self.host_id, []))

    def release(self) -> None:
        """Stop listening."""
        self.server.close()

    # -- requests -----------------------------------------------------------------

    def admit(self) -> None:
        self._num_admitted += 1

    def drop_reset(self) -> None:
        self._lost_reset = (None, None)

    def check_step(self, action: Any, extras: dict[str, Any]) -> None:
        self.server.sessions.check_step(self._place, self._action(action), extras)

    def check_reset(self, seed: int | None, options: dict[str, Any] | None) -> None:
        self.server.sessions.check_reset(self.env_id, seed, options)

    def packed(self, arguments: Any) -> Any:
        """Return `arguments` as they are: other checks have found what can't be sent."""
        return arguments

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[Any] | None = None) -> None:
        """Send the request of the only env; without arguments, a reset may repeat a lost one."""
        given = None if arguments is None else arguments[0]
        is_reset = op_of(int(entries[0])) == Operation.RESET
        if self._place.session is None or self._num_admitted < self._num_taken:
            # The client is gone that this is for: its `Died` is in the queue.
            self._lost_reset = given or self._lost_reset if is_reset else (None, None)
            return
        self._entry, self._since_ns = int(entries[0]), time.monotonic_ns()
        sessions = self.server.sessions
        if is_reset:
            lost, self._lost_reset = self._lost_reset, (None, None)
            # A mask resets a part of an env, so it can't begin an episode of another one.
            again = (None, None) if "reset_mask" in (lost[1] or {}) else lost
            self._reset = given or again
            sessions.reset(self._place, *self._reset)
        else:
            action, extras = given or STEP_IN_ROW
            sessions.step(self._place, self._action(action), extras)
        self.server.listener.flush()

    def _action(self, given: Any) -> Any:
        """Return the action of a step: `given`, or that of the row if it travels there."""
        return given if self._read_action is None else self._read_action()

    def stop(self, index: int, number: int) -> None:
        """Send the client away, which stops its env, whatever that does now."""
        del index, number
        self.server.sessions.drop(self._place, "an action was refused, or a call ended early")
        self.server.listener.flush()

    # -- events of the place -------------------------------------------------------------

    def on_taken(self, announced: Announcement) -> None:
        self._num_taken += 1
        meta = announced.meta.model_copy(update={"env_id": self.env_id})
        slab, is_new = self.server.slab_for(meta)
        self._writer = RowWriter(
            slab,
            self._row,
            env_id=self.env_id,
            autoreset=meta.autoreset,
            announce=infos_out_of_band,
        )
        self._sent_ns = cast("NDArray[np.int64]", slab.sent_ns)
        in_row = slab.action is not None and not announced.hello.free_actions
        self._read_action = row_reader(slab.action, self._row) if in_row else None
        started = EnvStarted(meta, slab.layout, announced.hello.reads_extras, not in_row)
        new, first_slot = slab if is_new else None, self.first_slot - self._row
        self._post(Taken(self.host_id, started, announced.hello.hardware, new, first_slot))

    def on_answer(self, answer: Answer) -> None:
        self._num_messages += 1
        entry, self._entry = self._entry, 0
        if isinstance(answer, ErrorText):
            self._post(Raised(self.host_id, entry, answer))
            return
        # The trainer may let its own arithmetic raise; a client's numbers must not.
        with np.errstate(all="ignore"):
            out_of_band = self._write(*answer, is_reset=op_of(entry) == Operation.RESET)
        self._post(Result(self.host_id, entry, out_of_band or {}))

    def _write(
        self, outcome: ResultFields, result: ClientResult, *, is_reset: bool
    ) -> OutOfBand | None:
        """Write a result into the row; return the parts that have no place there."""
        # Statistics use this machine's clock; the result has the time of its client's.
        self._sent_ns[self._row] = result.sent_ns or time.time_ns()
        if is_reset:
            info = {**result.info, "client": self.client}
            parts = *outcome, info
            return self._writer.write_reset(parts, result.busy_ns, result.extra)
        parts = *outcome, result.info
        return self._writer.write_step(parts, result.busy_ns, result.extra)

    def on_lost(self, cause: str, *, in_order: bool) -> None:
        entry, self._entry = self._entry, 0
        requests = (entry,) if entry else ()
        if entry:  # Without, a reset that was lost before waits for the next client, still.
            is_reset = op_of(entry) == Operation.RESET
            self._lost_reset = self._reset if is_reset else (None, None)
        self._post(Died(self.host_id, Death(cause, requests=requests, in_order=in_order)))

    def waits_since(self) -> float | None:
        return self._busy_since(self.first_slot)

    # -- as one that can be killed --------------------------------------------------------

    def current_request(self) -> tuple[int, int]:
        return (self._entry, self._since_ns) if self._entry else (0, 0)

    @property
    def traffic(self) -> int:
        return self._num_messages

    def catch_up(self) -> bool:
        has_news = self.server.is_readable()
        self.server.poll()
        return has_news

    def kill(self, *, dump: bool) -> None:
        """Send the client away; its env has stopped, or will when it hears of that."""
        del dump
        self.server.sessions.drop(self._place, "the trainer no longer waits for its answer")
        self.server.listener.flush()

    def destroy(self) -> None:
        """Do nothing: nothing is left when a client was sent away."""
