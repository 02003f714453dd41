"""A server and clients without sockets, on a simulated network.

Messages of a connection arrive in order. When it breaks, what is on the way is lost, and each end
finds out at its own time.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.protocol.net.client_session import (
    ClientSession,
    Ended,
    Phase,
    Refused,
)
from rlightning_aio.protocol.net.server_session import ClientPlace, ServerSessions
from rlightning_aio.protocol.net.wire import Reset, Step, Welcome
from rlightning_aio.types import EnvMeta, EnvRet

if TYPE_CHECKING:
    from rlightning_aio.protocol.net.server_session import Announcement, Answer

OBSERVATION = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)
ACTION = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


class Client:
    """A client process: its session, its env, and its connection.

    Attributes:
        outbox: routes and messages on the way to the server; None for the end of a connection.
        inbox: messages on the way to the client.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.executed: set[tuple[Any, int]] = set()
        self.ended: list[str] = []
        self.refused: list[str] = []
        self.inbox: list[list[bytes]] = []
        self.outbox: list[tuple[bytes, list[bytes] | None]] = []
        self.route: bytes | None = None
        self.routes = itertools.count()
        self.begin()

    def begin(self) -> None:
        """Start the process, or restart it."""
        self.todo: Step | Reset | None = None
        meta = EnvMeta(env_id="env", observation_space=OBSERVATION, action_space=ACTION)
        self.session = ClientSession(meta, self.name)

    def connect(self) -> None:
        if self.route is None:
            self.route = f"{self.name}:{next(self.routes)}".encode()
            self.session.connected()
            self.flush()

    def hang_up(self) -> None:
        """Close the connection; what was sent arrives."""
        if self.route is not None:
            self.outbox.append((self.route, None))
            self.route = None
            self.inbox.clear()

    def cut(self) -> None:
        """Break the connection; messages on the way are lost, but for its end."""
        if self.route is not None:
            self.outbox = [one for one in self.outbox if one[0] != self.route]
            self.hang_up()
            self.obey(self.session.disconnected("the connection broke"))

    def flush(self) -> None:
        while self.session.outbox:
            parts = self.session.outbox.popleft()
            if self.route is not None:
                self.outbox.append((self.route, parts))

    def receive(self, parts: list[bytes]) -> None:
        event = self.session.receive(parts)
        self.flush()
        self.obey(event)

    def obey(self, event: Any) -> None:
        if isinstance(event, Ended | Refused):
            self.todo = None
            if isinstance(event, Ended):
                self.ended.append(event.cause)
            else:
                self.refused.append(event.text)
            self.hang_up()
        elif event is not None and not isinstance(event, Welcome):
            self.todo = event

    def leave(self) -> None:
        """Send a goodbye and end."""
        self.session.leave("enough")
        self.flush()
        self.hang_up()
        self.begin()

    def execute(self) -> None:
        """Execute the pending request once."""
        request = self.todo
        if not isinstance(request, Step | Reset):
            return
        self.todo = None
        key = (self.route, request.number)
        assert key not in self.executed, "a request was executed twice"
        self.executed.add(key)
        self.session.finish(request.number, self.ret())
        self.flush()

    def ret(self) -> EnvRet:
        return EnvRet(env_id="env", observation=np.zeros(3))


class Recorder:
    """What happens at a place.

    Attributes:
        taken: the clients that have taken it; lost: why they were lost, and if in order.
        answers: that the next test has not taken yet.
        since: when the request was sent that waits for a client.
    """

    def __init__(self) -> None:
        self.taken: list[str] = []
        self.lost: list[tuple[str, bool]] = []
        self.answers: list[Answer] = []
        self.since: float | None = None

    def on_taken(self, announced: Announcement) -> None:
        self.taken.append(announced.meta.env_id)

    def on_answer(self, answer: Answer) -> None:
        self.answers.append(answer)

    def on_lost(self, cause: str, *, in_order: bool) -> None:
        self.lost.append((cause, in_order))

    def waits_since(self) -> float | None:
        return self.since


class World:
    """One server and its clients; messages wait until they are delivered or lost.

    Args:
        names: of the clients.
        places: how many, or the names of their clients.
    """

    def __init__(self, names: str = "ab", places: int | str = 2) -> None:
        listed = [""] * places if isinstance(places, int) else list(places)
        self.seen = [Recorder() for _ in listed]
        self.places = [
            ClientPlace(f"srv/{name or k}", self.seen[k], name) for k, name in enumerate(listed)
        ]
        self.server = ServerSessions("srv", self.places)
        self.clients = {name: Client(name) for name in names}
        self.delivered: dict[tuple[str, bool], list[list[bytes]]] = {}

    def flush(self) -> None:
        """Put the messages of the server onto the network."""
        while self.server.outbox:
            route, parts = self.server.outbox.popleft()
            client = self.clients.get(route.decode().partition(":")[0])
            if client is not None and client.route == route:
                client.inbox.append(parts)
            else:
                self.server.disconnected(route)

    def to_server(self, client: Client) -> None:
        route, parts = client.outbox.pop(0)
        if parts is None:
            self.server.disconnected(route)
        else:
            self.delivered.setdefault((client.name, True), []).append(parts)
            self.server.receive(route, parts)
        self.flush()

    def to_client(self, client: Client) -> None:
        parts = client.inbox.pop(0)
        self.delivered.setdefault((client.name, False), []).append(parts)
        client.receive(parts)

    def settle(self) -> None:
        """Deliver everything in order, and let clients work, until nothing moves."""
        moved = True
        while moved:
            moved = False
            for client in self.clients.values():
                if isinstance(client.todo, Step | Reset):
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

    def place_of(self, name: str) -> ClientPlace | None:
        """The place that a client has."""
        for place in self.places:
            if place.session is not None and place.session.name == name:
                return place
        return None

    def reset(self, name: str) -> None:
        place = self.place_of(name)
        assert place is not None
        self.server.reset(place, None, None)
        self.flush()

    def step(self, name: str) -> None:
        place = self.place_of(name)
        assert place is not None
        self.server.step(place, ACTION.sample(), {})
        self.flush()

    def take(self) -> list[Any]:
        """The answers since the last call, by place."""
        taken = [answer for one in self.seen for answer in one.answers]
        for one in self.seen:
            one.answers.clear()
        return taken

    def serving(self, name: str) -> bool:
        return self.clients[name].session.phase is Phase.SERVING
