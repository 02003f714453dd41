"""A simulated network between env_servers and their clients.

It takes the place of ZMQ on both sides. A client is the real `RemoteEnvClient` in a process of the
world, and the server is the real host, whose listener is simulated. What is sent over a connection
arrives in order and late; when the connection breaks, the rest is lost. Each end finds out at its
own time: the server when it sends something, the client by an event. Then the client dials again.
"""

from __future__ import annotations

import itertools
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import zmq
from simulator.processes import Killed, Process

from rlightning_aio.protocol.net.wire import PINGS_PER_HEARTBEAT
from rlightning_aio.remote import client as client_module
from rlightning_aio.remote.client import RemoteEnvClient

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from simulator.world import World

    from rlightning_aio._core.hosts.env_server.settings import ServerSettings
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.net.server_session import ServerSessions

__all__ = ["ClientProcess", "Network"]

_DIAL_SECONDS: Final = (0.1, 5.0)


class Network:
    """The network of a world.

    Attributes:
        listeners: by address.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.listeners: dict[str, _Listener] = {}
        self.routes = itertools.count(1)

    def replacements(self) -> list[tuple[Any, str, Any]]:
        """What takes which place."""
        from rlightning_aio._core.hosts.env_server import (
            host as env_server,  # Few programs need it.
        )

        return [
            (env_server, "Listener", partial(_Listener, self)),
            (client_module, "zmq", _Zmq(self)),
            (client_module, "recv_monitor_message", lambda monitor, _: monitor.take()),
        ]

    def client(
        self,
        make_env: Callable[[], BaseEnv],
        address: str,
        name: str,
        on_trouble: Callable[[], object] = lambda: None,
    ) -> ClientProcess:
        """Start a client that lends an env to the env_server at an address.

        `on_trouble` is called whenever something happens to it that may end its session.
        """
        host, _, port = address.removeprefix("tcp://").rpartition(":")

        def main() -> int:
            try:
                with RemoteEnvClient(make_env(), host, int(port), name=name) as client:
                    client.run()
            except Killed:
                raise
            except BaseException as error:  # noqa: BLE001  # The process ends with it.
                self.world.note("client {} raises {}", name, repr(error))
                return 1
            return 0

        return ClientProcess(self.world, f"client {name}", main, on_trouble)


class ClientProcess(Process):
    """The process of a client, whose connection ends with it.

    Args:
        on_trouble: see `Network.client`.
    """

    def __init__(
        self, world: World, name: str, main: Callable[[], int], on_trouble: Callable[[], object]
    ) -> None:
        self.on_trouble = on_trouble
        self.dealer: _Dealer | None = None
        super().__init__(world, name, main, lambda *_: None)

    def stop(self, seconds: float) -> None:
        self.on_trouble()
        super().stop(seconds)
        if self.dealer is not None and seconds > self.dealer.silence:
            self.world.after(self.dealer.silence, self.cut)

    def end(self, code: int) -> None:
        if self.alive and self.dealer is not None:
            self.on_trouble()
            is_machine = self.world.rng.random() < 0.3  # Then nobody says that it is gone.
            self.world.after(self.dealer.silence if is_machine else 0.0, self.cut)
        super().end(code)

    def cut(self) -> None:
        """Break its connection."""
        if self.dealer is not None:
            self.dealer.cut()


class _Connection:
    """A connection, from a handshake to its end."""

    def __init__(self, network: Network, dealer: _Dealer, listener: _Listener) -> None:
        self.route = b"%d" % next(network.routes)
        self.dealer = dealer
        self.listener = listener
        self.is_up = True
        self._world = network.world
        self._arrived_ns = {True: 0, False: 0}
        listener.connections[self.route] = self

    def send(self, parts: list[bytes], *, to_server: bool) -> None:
        """Have a message arrive later, or break the connection."""
        world = self._world
        if world.rng.random() < world.faults.cuts:
            self.cut()
            return
        at = max(self._arrived_ns[to_server], world.now_ns + int(world.delay() * 1e9))
        self._arrived_ns[to_server] = at
        world.after((at - world.now_ns) / 1e9, partial(self._arrive, parts, to_server))

    def _arrive(self, parts: list[bytes], to_server: bool) -> None:
        if self.is_up and to_server:
            self.listener.incoming.append((self.route, parts))
        elif self.is_up:
            self.dealer.receive(parts)

    def cut(self) -> None:
        """Break it."""
        if not self.is_up:
            return
        self.is_up = False
        self.dealer.process.on_trouble()
        world = self._world
        world.counts["cuts"] += 1
        world.note("the connection of {} breaks", self.dealer.process.name)
        world.after(world.delay(), partial(self.listener.connections.pop, self.route, None))
        world.after(world.delay(), partial(self.dealer.lose, self))


class _Listener:
    """See `hosts.listener.Listener`; it is also what its descriptor stands for."""

    def __init__(
        self, network: Network, server_id: str, settings: ServerSettings, sessions: ServerSessions
    ) -> None:
        del server_id
        self.incoming: deque[tuple[bytes, list[bytes]]] = deque()
        self.connections: dict[bytes, _Connection] = {}
        self._network = network
        self._sessions = sessions
        self.silence = 3 * settings.heartbeat / PINGS_PER_HEARTBEAT
        self._port = settings.port
        self._descriptor = -1
        self._has_more = False

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self._port}"

    def start(self) -> None:
        self._port = self._port or 40_000 + len(self._network.listeners)
        self._descriptor = self._network.world.sockets.adopt(self)
        self._network.listeners[self.address] = self

    def close(self) -> None:
        if self._descriptor < 0:
            return
        self._sessions.close("the trainer closed its group")
        self._send(0.0)
        del self._network.listeners[self.address]
        del self._network.world.sockets.by_number[self._descriptor]
        self._descriptor = -1
        for connection in list(self.connections.values()):
            # What it has sent arrives first.
            self._network.world.after(0.2, connection.cut)

    def fileno(self) -> int:
        return self._descriptor

    def is_readable(self) -> bool:
        return bool(self.incoming) or self._has_more

    def is_writable(self) -> bool:
        return True

    def is_hung_up(self) -> bool:
        return False

    def deadline(self) -> float | None:
        return self._sessions.deadline()

    def pump(self, now: float) -> None:
        self._has_more = False
        while self.incoming:
            route, parts = self.incoming.popleft()
            self._sessions.receive(route, None, parts, now)
        self._sessions.tick(now)
        self._send(now)

    def flush(self, now: float) -> None:
        self._send(now)
        self._has_more = self._sessions.has_results

    def _send(self, now: float) -> None:
        outbox = self._sessions.outbox
        while outbox:
            route, parts = outbox.popleft()
            if route in self.connections:
                self.connections[route].send([bytes(part) for part in parts], to_server=False)
            else:
                self._sessions.on_unreachable(route, now)


class _Frame:
    """See `zmq.Frame`."""

    def __init__(self, content: bytes, *, more: bool) -> None:
        self.bytes, self.more = content, more

    @property
    def buffer(self) -> memoryview:
        return memoryview(self.bytes)

    def __len__(self) -> int:
        return len(self.bytes)


class _Monitor:
    """Events of a connection, in order."""

    def __init__(self) -> None:
        self.events: deque[int] = deque()

    def take(self) -> dict[str, int]:
        if not self.events:
            raise zmq.Again
        return {"event": self.events.popleft()}

    def has_input(self) -> bool:
        return bool(self.events)

    def close(self, linger: int) -> None:
        del linger


class _Dealer:
    """See a `zmq.Socket` of kind ``DEALER``."""

    def __init__(self, network: Network) -> None:
        running = network.world.running
        assert isinstance(running, ClientProcess)
        self.process = running
        running.dealer = self
        self._network = network
        self._monitor = _Monitor()
        self._connection: _Connection | None = None
        self._frames: deque[_Frame] = deque()
        self._parts: list[bytes] = []
        self._address = ""
        self._attempt = 0

    def set(self, option: int, value: Any) -> None:
        """Do nothing: all options are about what is not simulated."""

    @property
    def silence(self) -> float:
        """Seconds after which heartbeats of ZMQ break the connection to an end that is silent."""
        return 0.0 if self._connection is None else self._connection.listener.silence

    def get_monitor_socket(self) -> _Monitor:
        return self._monitor

    def disable_monitor(self) -> None:
        self._monitor.events.clear()

    def close(self, linger: int) -> None:
        del linger
        self._attempt = -1
        if self._connection is not None:
            self._network.world.after(0.1, self._connection.cut)

    # -- the connection -----------------------------------------------------------

    def connect(self, address: str) -> None:
        self._address = address
        self._attempt = number = self._attempt + 1
        self._later(self._network.world.start_delay(), partial(self._dial, number, 0))

    def disconnect(self, address: str) -> None:
        del address
        self._attempt += 1
        self.cut()

    def cut(self) -> None:
        """Break the connection, if there is one."""
        if self._connection is not None:
            self._connection.cut()

    def _later(self, seconds: float, callback: Callable[[], object]) -> None:
        self.process.later(seconds, callback)

    def _dial(self, number: int, count: int) -> None:
        if number != self._attempt or self._connection is not None:
            return
        listener = self._network.listeners.get(self._address)
        if listener is None:
            self._add_event(zmq.EVENT_CONNECT_RETRIED)
            pause = min(_DIAL_SECONDS[1], _DIAL_SECONDS[0] * 2**count)
            self._later(pause, partial(self._dial, number, count + 1))
            return
        self._connection = _Connection(self._network, self, listener)
        self._add_event(zmq.EVENT_HANDSHAKE_SUCCEEDED)

    def lose(self, connection: _Connection) -> None:
        """Find out that a connection is gone, and dial again."""
        if self._connection is connection:
            self._connection = None
            self._add_event(zmq.EVENT_DISCONNECTED)
            self._later(_DIAL_SECONDS[0], partial(self._dial, self._attempt, 0))

    def _add_event(self, event: int) -> None:
        self._monitor.events.append(event)
        self.process.wake()

    # -- messages -----------------------------------------------------------------

    def receive(self, parts: Sequence[bytes]) -> None:
        """Take a message that has arrived."""
        last = len(parts) - 1
        self._frames += [_Frame(part, more=k < last) for k, part in enumerate(parts)]
        self.process.wake()

    def has_input(self) -> bool:
        return bool(self._frames)

    def recv(self, flags: int, *, copy: bool) -> _Frame:
        del flags, copy
        if not self._frames:
            raise zmq.Again
        return self._frames.popleft()

    def send(self, part: Any, flags: int, *, copy: bool) -> None:
        del copy
        self._network.world.point()
        if self._connection is None:
            self._parts.clear()
            raise zmq.Again
        self._parts.append(bytes(part))
        if not flags & zmq.SNDMORE:
            parts, self._parts = self._parts, []
            self._connection.send(parts, to_server=True)


class _Poller:
    """See `zmq.Poller`."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._sources: list[Any] = []

    def register(self, source: Any, events: int) -> None:
        del events
        self._sources.append(source)

    def poll(self, timeout_ms: float | None) -> list[tuple[Any, int]]:
        self._world.point()
        seconds = None if timeout_ms is None else timeout_ms / 1000
        return self._world.wait_for(self._ready, seconds)

    def _ready(self) -> list[tuple[Any, int]]:
        return [(source, zmq.POLLIN) for source in self._sources if source.has_input()]


class _Context:
    """See `zmq.Context`."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def socket(self, kind: int) -> _Dealer:
        assert kind == zmq.DEALER
        return _Dealer(self._network)

    def term(self) -> None: ...

    def destroy(self, linger: int) -> None: ...


class _Zmq:
    """Takes the place of the module `zmq` in the client."""

    def __init__(self, network: Network) -> None:
        self.Poller = partial(_Poller, network.world)
        self.Context = {client_module._Socket: partial(_Context, network)}

    def __getattr__(self, name: str) -> Any:
        return getattr(zmq, name)
