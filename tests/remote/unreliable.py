"""A server and clients without sockets, on a simulated network."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.net.client_session import (
    ClientSession,
    Ended,
    Phase,
    ResetRequest,
    StepRequest,
)
from rlightning_aio.protocol.net.server_session import ServerSessions
from rlightning_aio.types import EnvMeta, EnvRet

if TYPE_CHECKING:
    from rlightning_aio.protocol.net.server_records import RemoteResult

HEARTBEAT = 8.0
OBSERVATION = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
ACTION = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
EXTRAS: dict[str, Any] = {}


def counter() -> Any:
    return itertools.count(1).__next__


class Clock:
    now = 0.0


class Client:
    """A client process: its session, its env (which only counts), and its connection.

    The observation is (which client, which life, steps since the last reset).
    """

    def __init__(
        self, name: str, identity: int, clock: Clock, heartbeat: float = HEARTBEAT
    ) -> None:
        self.name = name
        self.identity = identity
        self.clock = clock
        self.heartbeat = heartbeat
        self.lives = 0
        self.executed: set[tuple[Any, int]] = set()
        self.ended: list[str] = []
        self.inbox: list[list[bytes]] = []
        self.outbox: list[list[bytes]] = []
        self.route: bytes | None = None
        self.routes = itertools.count()
        self.raises = False
        self.begin()

    def begin(self) -> None:
        """Start the process, or restart it."""
        self.lives += 1
        self.steps = 0
        self.todo: StepRequest | ResetRequest | None = None
        meta = EnvMeta(env_id="env", observation_space=OBSERVATION, action_space=ACTION)
        # Nonces must differ between lives, as real ones do.
        start = 1000 * self.lives + 100_000 * self.identity
        self.session = ClientSession(
            meta,
            self.name,
            heartbeat=self.heartbeat,
            new_token=itertools.count(start).__next__,
        )

    def connect(self) -> None:
        if self.route is None:
            self.route = f"{self.name}:{next(self.routes)}".encode()
            self.session.connected(self.clock.now)
            self.flush()

    def cut(self) -> None:
        """Break the connection; messages on the way are lost."""
        if self.route is not None:
            self.route = None
            self.inbox.clear()
            self.outbox.clear()
            self.session.disconnected(self.clock.now)
            self.flush()

    def kill(self) -> None:
        self.cut()
        self.begin()

    def flush(self) -> None:
        while self.session.outbox:
            parts = self.session.outbox.popleft()
            if self.route is not None:
                self.outbox.append(parts)

    def receive(self, parts: list[bytes]) -> None:
        event = self.session.receive(parts, self.clock.now)
        self.obey(event)
        self.flush()

    def obey(self, event: Any) -> None:
        if isinstance(event, Ended):
            self.todo = None
            self.ended.append(event.cause)
        elif event is not None:
            self.todo = event

    def tick(self) -> None:
        self.obey(self.session.tick(self.clock.now))
        self.flush()

    def execute(self) -> None:
        """Execute the pending request once."""
        request = self.todo
        if not isinstance(request, StepRequest | ResetRequest):
            return
        self.todo = None
        key = (self.lives, self.session._session, request.number)
        assert key not in self.executed, "a request was executed twice"
        self.executed.add(key)
        if self.raises and request.number:
            self.session.fail(request.number, ErrorText("Oops", "no", "trace"))
        else:
            self.steps = 0 if isinstance(request, ResetRequest) else self.steps + 1
            self.session.finish(request.number, self.ret())
        self.flush()

    def observation(self) -> np.ndarray[Any, Any]:
        return np.array([self.identity, self.lives, self.steps], float)

    def ret(self) -> EnvRet:
        return EnvRet(env_id="env", observation=self.observation(), last_reward=float(self.steps))


class World:
    """One server and its clients; messages wait until they are delivered or lost."""

    def __init__(self, names: str = "ab", **server: Any) -> None:
        self.clock = Clock()
        self.server = ServerSessions("srv", heartbeat=HEARTBEAT, new_token=counter(), **server)
        self.clients = {name: Client(name, k + 1, self.clock) for k, name in enumerate(names)}
        self.results: list[RemoteResult] = []
        self.delivered: dict[tuple[str, bool], list[list[bytes]]] = {}

    def replay(self, client: Client, k: int, *, to_server: bool) -> None:
        """Deliver an earlier message again, the latest first."""
        delivered = self.delivered.get((client.name, to_server), [])
        if client.route is None or not delivered or (client.todo is not None and not to_server):
            return
        parts = delivered[-1 - k % len(delivered)]
        if to_server:
            self.server.receive(client.route, None, parts, self.clock.now)
            self.flush()
        else:
            client.receive(parts)

    def flush(self) -> None:
        """Put the messages of the server onto the network."""
        while self.server.outbox:
            route, parts = self.server.outbox.popleft()
            client = self.clients[route.decode().partition(":")[0]]
            if client.route == route:
                client.inbox.append(parts)
            else:
                self.server.on_unreachable(route, self.clock.now)
        self.results += self.server.take()

    def to_server(self, client: Client, k: int = 0, *, keep: bool = False) -> None:
        parts = client.outbox[k] if keep else client.outbox.pop(k)
        assert client.route is not None
        self.delivered.setdefault((client.name, True), []).append(parts)
        self.server.receive(client.route, None, parts, self.clock.now)
        self.flush()

    def to_client(self, client: Client, k: int = 0, *, keep: bool = False) -> None:
        parts = client.inbox[k] if keep else client.inbox.pop(k)
        self.delivered.setdefault((client.name, False), []).append(parts)
        client.receive(parts)

    def pass_time(self, seconds: float) -> None:
        self.clock.now += seconds
        self.server.tick(self.clock.now)
        self.flush()
        for client in self.clients.values():
            client.tick()

    def settle(self) -> None:
        """Deliver everything in order, and let clients work, until nothing moves."""
        moved = True
        while moved:
            moved = False
            for client in self.clients.values():
                if isinstance(client.todo, StepRequest | ResetRequest):
                    client.execute()
                    moved = True
                while client.outbox:
                    self.to_server(client)
                    moved = True
                while client.inbox and client.todo is None:
                    self.to_client(client)
                    moved = True

    def join_all(self) -> None:
        for client in self.clients.values():
            client.connect()
        self.settle()

    def submit(self, name: str, number: int) -> bool:
        answered = self.server.requests.step(name, number, ACTION.sample(), EXTRAS, self.clock.now)
        self.flush()
        return answered

    def submit_reset(self, name: str, number: int, **options: Any) -> bool:
        answered = self.server.requests.reset(
            name, number, options.get("seed"), options.get("options"), self.clock.now
        )
        self.flush()
        return answered

    def take(self) -> list[RemoteResult]:
        taken, self.results = self.results, []
        return taken

    def serving(self, name: str) -> bool:
        return self.clients[name].session.phase is Phase.SERVING
