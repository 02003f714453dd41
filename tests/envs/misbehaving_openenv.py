"""An OpenEnv server that fails as a list of fates says.

It speaks the protocol of OpenEnv 0.10. Each action has a unique number, which the observation
repeats. The server records the numbers that it has executed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Self

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

if TYPE_CHECKING:
    from websockets.http11 import Request, Response

LOG = logging.getLogger("misbehaving")
LOG.setLevel(logging.WARNING)  # Below that, it has the headers of its clients.
ERRORS = ("EXECUTION_ERROR", "FACTORY_ERROR")
"""Fates that are an answer; the others lose the socket, but for `ok` and `another type`."""
GOES_ON = ("ok", "another type")


class Session:
    """One env, of a socket."""

    def __init__(self) -> None:
        self.step_count, self.episode_id = 0, None


class Misbehaving:
    """The server; see the module's docstring.

    Args:
        capacity: the most sessions at once.
        authorization: of those who may connect, if it is given.

    Attributes:
        fates: of the next messages; later ones succeed. `never`: the reply comes after the
            socket is closed.
        executed: number of executions of each action.
        sessions: those that take a slot; most: the largest number at once.
        sockets: of the clients that are connected.
        refused: a connection was refused; asked: a message has come whose fate is `never`.
    """

    def __init__(self, capacity: int, authorization: str | None = None) -> None:
        self.fates: deque[str] = deque()
        self.executed: Counter[int] = Counter()
        self.capacity = capacity
        self.sessions: set[Session] = set()
        self.sockets: set[ServerConnection] = set()
        self.most = 0
        self.refused = asyncio.Event()
        self.asked = asyncio.Event()
        self._authorization = authorization

    async def __aenter__(self) -> Self:
        self._server = await serve(
            self._talk,
            "127.0.0.1",
            0,
            process_request=self._admit,
            close_timeout=0.1,
            ping_interval=None,
            logger=LOG,
        )
        self.url = f"http://127.0.0.1:{self._server.sockets[0].getsockname()[1]}"
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.restart()
        self._server.close()
        await self._server.wait_closed()

    def restart(self) -> None:
        """Forget all sessions."""
        self.sessions.clear()
        for socket in self.sockets:
            socket.transport.abort()

    async def _admit(self, socket: ServerConnection, request: Request) -> Response | None:
        """Let a client talk, or answer it otherwise."""
        if request.headers.get("Authorization") != self._authorization:
            return socket.respond(401, "")
        return None

    # -- messages

    async def _talk(self, socket: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            if len(self.sessions) < self.capacity:
                await self._serve(socket)
                return
            self.refused.set()
            await self._error(socket, "CAPACITY_REACHED", "as it should not")

    async def _serve(self, socket: ServerConnection) -> None:
        session = Session()
        self.sessions.add(session)
        self.most = max(self.most, len(self.sessions))
        self.sockets.add(socket)
        try:
            async for message in socket:
                if not await self._answer(socket, session, json.loads(message)):
                    return
        finally:
            self.sockets.discard(socket)
            self.sessions.discard(session)

    async def _answer(self, socket: ServerConnection, session: Session, message: Any) -> bool:
        fate = self.fates.popleft() if self.fates else "ok"
        if fate in ERRORS:
            await self._error(socket, fate, "as it should not")
            return True
        if fate != "lost before":
            reply = self._executed(session, message)
            if fate == "another type":
                reply["type"] = "state" if reply["type"] == "observation" else "observation"
            await self._begin(socket, fate)
            if fate in (*GOES_ON, "never", "idle loss"):
                await socket.send(json.dumps(reply))
            if fate in GOES_ON:
                return True
        socket.transport.abort()
        return False

    async def _begin(self, socket: ServerConnection, fate: str) -> None:
        """Do what precedes the reply, or replaces it."""
        if fate == "never":
            self.asked.set()
            await socket.wait_closed()
        elif fate == "no JSON":
            await socket.send("{")
        elif fate == "half a frame":
            socket.transport.write(b"\x81\x7e\x01\x00{")
        elif fate == "restart":
            self.restart()

    def _executed(self, session: Session, message: Any) -> dict[str, Any]:
        kind, data = message["type"], message.get("data")
        if kind == "state":
            state = {"step_count": session.step_count, "episode_id": session.episode_id}
            return {"type": "state", "data": state}
        if kind == "mcp":
            return {"type": "mcp", "data": {"result": data["params"]}}
        if kind == "reset":
            session.step_count, session.episode_id = 0, data["episode_id"]
            answers = None
        else:
            answers = data["number"]
            self.executed[answers] += 1
            session.step_count += 1
        seen = {"answers": answers, "episode": session.episode_id, "count": session.step_count}
        observed = {"observation": seen, "reward": 1.0, "done": False}
        return {"type": "observation", "data": observed}

    async def _error(self, socket: ServerConnection, code: str, message: str) -> None:
        data = {"code": code, "message": message}
        await socket.send(json.dumps({"type": "error", "data": data}))


numbers = itertools.count()
