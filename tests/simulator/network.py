"""A simulated network between env_servers and their clients.

It takes the place of ZMQ on both sides. A client is the real `RemoteEnvClient` in a process of the
world, and the server is the real host, whose listener is simulated. What is sent over a connection
arrives in order and late; when the connection breaks, the rest is lost. Each end finds out at its
own time. A socket of a client has one connection at most, and a client that has lost one dials
again with another.
"""

from __future__ import annotations

import itertools
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any

import zmq
from simulator.processes import Killed, Process

from rlightning_aio.protocol.net.wire import DEFAULT_HEARTBEAT, ping_ms
from rlightning_aio.remote import client as client_module
from rlightning_aio.remote.client import RemoteEnvClient

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from simulator.world import World

    from rlightning_aio._core.hosts.env_server.settings import ServerSettings
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.net.server_session import ServerSessions

__all__ = ["ClientProcess", "Network"]


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

        kill = env_server.EnvServerHost.kill

        def checked(host: Any, *, dump: bool) -> None:
            if dump:
                host.server.listener.check_unread(host.client)
            kill(host, dump=dump)

        return [
            (env_server, "Listener", partial(_Listener, self)),
            (env_server.EnvServerHost, "kill", checked),
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
        world.after(world.delay(), partial(self.listener.lose, self.route))
        world.after(world.delay(), self.dealer.lose)


class _Listener:
    """See `hosts.listener.Listener`; it is also what its descriptor stands for."""

    def __init__(
        self, network: Network, server_id: str, settings: ServerSettings, sessions: ServerSessions
    ) -> None:
        del server_id
        self.incoming: deque[tuple[bytes, list[bytes] | None]] = deque()
        self.connections: dict[bytes, _Connection] = {}
        self._network = network
        self._sessions = sessions
        self.silence = sum(ping_ms(settings.heartbeat or DEFAULT_HEARTBEAT)[:2]) / 1000
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
        self._send()
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

    def lose(self, route: bytes) -> None:
        """Find out that a connection is gone."""
        if self.connections.pop(route, None) is not None:
            self.incoming.append((route, None))

    def on_writable(self) -> None: ...

    def check_unread(self, name: str) -> None:
        """Check that a client that is about to be sent away as hung has not replied."""
        clients = {c.route: c.dealer.process.name for c in self.connections.values()}
        unread = [clients.get(route) for route, parts in self.incoming if parts is not None]
        if f"client {name}" in unread:
            self._network.world.wrongs.append(f"client {name} is sent away, and has replied")

    def on_readable(self) -> None:
        self._has_more = False
        while self.incoming:
            route, parts = self.incoming.popleft()
            if parts is None:
                self._sessions.disconnected(route)
            else:
                self._sessions.receive(route, parts)
        self._send()

    def flush(self) -> None:
        self._send()

    def _send(self) -> None:
        outbox = self._sessions.outbox
        while outbox:
            route, parts = outbox.popleft()
            if route in self.connections:
                self.connections[route].send([bytes(part) for part in parts], to_server=False)
            else:
                self._sessions.disconnected(route)
                self._has_more = True


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
        self._is_open = True

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
        self._is_open = False
        if self._connection is not None:
            self._network.world.after(0.1, self._connection.cut)

    # -- the connection -----------------------------------------------------------

    def connect(self, address: str) -> None:
        self.process.later(self._network.world.start_delay(), partial(self._dial, address))

    def cut(self) -> None:
        """Break the connection, if there is one."""
        if self._connection is not None:
            self._connection.cut()

    def _dial(self, address: str) -> None:
        if not self._is_open:
            return
        listener = self._network.listeners.get(address)
        if listener is None:
            self._add_event(zmq.EVENT_CLOSED)
            return
        self._connection = _Connection(self._network, self, listener)
        self._add_event(zmq.EVENT_HANDSHAKE_SUCCEEDED)

    def lose(self) -> None:
        """Find out that the connection is gone."""
        self._connection = None
        if self._is_open:
            self._add_event(zmq.EVENT_DISCONNECTED)

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

    def destroy(self, linger: int) -> None: ...


class _Zmq:
    """Takes the place of the module `zmq` in the client."""

    def __init__(self, network: Network) -> None:
        self.Poller = partial(_Poller, network.world)
        self.Context = {client_module._Socket: partial(_Context, network)}

    def __getattr__(self, name: str) -> Any:
        return getattr(zmq, name)
