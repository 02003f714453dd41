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
from websockets.frames import Opcode

if TYPE_CHECKING:
    from collections.abc import Callable

    from websockets.http11 import Request, Response

LOG = logging.getLogger("misbehaving")
LOG.setLevel(logging.WARNING)  # Below that, it has the headers of its clients.
STEP_ERRORS = ("INVALID_JSON", "UNKNOWN_TYPE", "VALIDATION_ERROR", "EXECUTION_ERROR")
CONNECT_ERRORS = ("CAPACITY_REACHED", "FACTORY_ERROR", "SESSION_ERROR", "unreachable")
FATES = (
    "ok",
    "late",
    "never",
    "lost before",
    "lost after",
    "half a frame",
    "no JSON",
    "another type",
    "leaked",
    "idle loss",
    "restart",
    *STEP_ERRORS,
)
"""`never`: the reply comes after the socket is closed; `leaked`: the slot stays taken, too."""
GOES_ON = ("ok", "late", "another type")
ANSWERED = (*GOES_ON, "never", "idle loss")


class Session:
    """One env, of a socket."""

    def __init__(self) -> None:
        self.is_leaked = False
        self.step_count, self.episode_id = 0, None


class Misbehaving:
    """The server; see the module's docstring.

    Args:
        capacity: the most sessions at once.
        authorization: of those who may connect, if it is given.

    Attributes:
        fates, connect_fates: of the next messages and connections; later ones succeed.
        executed: number of executions of each action.
        sessions: those that take a slot; most: the largest number at once.
        sockets: of the clients that are connected.
        refused: a connection was refused.
        loses_pongs: pings are never answered.
        on_never: gets the number of an action whose fate is `never`.
    """

    def __init__(self, capacity: int, authorization: str | None = None) -> None:
        self.fates: deque[str] = deque()
        self.connect_fates: deque[str] = deque()
        self.executed: Counter[int] = Counter()
        self.capacity = capacity
        self.sessions: set[Session] = set()
        self.sockets: set[ServerConnection] = set()
        self.most = 0
        self.refused = asyncio.Event()
        self.loses_pongs = False
        self.on_never: Callable[[int], object] = lambda number: None
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

    def reap(self) -> None:
        """Free the leaked slots."""
        self.sessions = {session for session in self.sessions if not session.is_leaked}

    def restart(self) -> None:
        """Forget all sessions."""
        self.sessions.clear()
        for socket in self.sockets:
            socket.transport.abort()

    async def _admit(self, socket: ServerConnection, request: Request) -> Response | None:
        """Let a client talk, or answer it otherwise."""
        if request.headers.get("Authorization") != self._authorization:
            return socket.respond(401, "")
        if self.connect_fates and self.connect_fates[0] == "unreachable":
            self.connect_fates.popleft()
            socket.transport.abort()
        elif self.loses_pongs:
            send_frame = socket.protocol.send_frame
            socket.protocol.send_frame = lambda frame: (
                None if frame.opcode is Opcode.PONG else send_frame(frame)
            )
        return None

    # -- messages

    async def _talk(self, socket: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            fate = self.connect_fates.popleft() if self.connect_fates else "ok"
            if len(self.sessions) >= self.capacity:
                fate = "CAPACITY_REACHED"
            if fate != "ok":
                self.refused.set()
                self.reap()
                code = "FACTORY_ERROR" if fate == "unreachable" else fate
                await self._error(socket, code, "as it should not")
                return
            await self._serve(socket)

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
            if not session.is_leaked:
                self.sessions.discard(session)

    async def _answer(self, socket: ServerConnection, session: Session, message: Any) -> bool:
        fate = self.fates.popleft() if self.fates else "ok"
        if fate == "never" and message["type"] != "step":
            fate = "late"  # Only steps have a short limit.
        if fate in STEP_ERRORS:
            await self._error(socket, fate, "as it should not")
            return True
        if fate != "lost before":
            reply = self._executed(session, message)
            if fate == "another type":
                reply["type"] = "state" if reply["type"] == "observation" else "observation"
            await self._begin(socket, session, fate, message)
            if fate in ANSWERED:
                await socket.send(json.dumps(reply))
            if fate in GOES_ON:
                return True
        socket.transport.abort()
        return False

    async def _begin(
        self, socket: ServerConnection, session: Session, fate: str, message: Any
    ) -> None:
        """Do what precedes the reply, or replaces it."""
        if fate == "late":
            await asyncio.sleep(0.005)
        elif fate == "never":
            self.on_never(message["data"]["number"])
            await socket.wait_closed()
        elif fate == "no JSON":
            await socket.send("{")
        elif fate == "half a frame":
            socket.transport.write(b"\x81\x7e\x01\x00{")
        elif fate == "restart":
            self.restart()
        session.is_leaked = fate == "leaked"

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
