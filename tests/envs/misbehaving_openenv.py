"""An OpenEnv server that fails as a list of fates says.

It speaks the protocol of OpenEnv 0.10. Each action has a unique number, which the observation
repeats. The server records the numbers that it has executed.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections import Counter, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

from aiohttp import WSMsgType, web

if TYPE_CHECKING:
    from collections.abc import Callable

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


@dataclass(frozen=True, eq=False)
class Socket:
    """A connection of a client, which can be lost.

    Attributes:
        answers_pings: those that arrive while it waits for a message.
        pongs: has one for each that the client has sent.
    """

    messages: web.WebSocketResponse
    transport: asyncio.Transport
    answers_pings: bool
    pongs: asyncio.Semaphore

    async def receive(self) -> Any:
        """The next message; None once the client has left."""
        async for message in self.messages:
            if message.type is WSMsgType.TEXT:
                return json.loads(message.data)
            if message.type is WSMsgType.PONG:
                self.pongs.release()
            elif message.type is WSMsgType.PING and self.answers_pings:
                await self.messages.pong(message.data)
        return None

    async def send(self, message: Any) -> None:
        await self.messages.send_str(json.dumps(message))

    async def ping(self) -> None:
        """Send a ping, and wait for its pong."""
        await self.messages.ping()
        await self.pongs.acquire()


class Session:
    """One env. `is_kept`: it outlives its socket; `is_attached`: it has a socket."""

    def __init__(self, *, is_kept: bool) -> None:
        self.is_kept = is_kept
        self.is_attached = self.is_closing = self.is_leaked = False
        self.step_count, self.episode_id = 0, None


class Misbehaving:
    """The server; see the module's docstring.

    Attributes:
        fates, connect_fates: of the next messages and connections; later ones succeed.
        executed: number of executions of each action.
        sessions: by id; most: the largest number at once.
        refused: a connection was refused.
        creating, may_create: set while a session waits to be created; set to let it continue.
        loses_pongs: pings are never answered.
        on_never: gets the number of an action whose fate is `never`.
    """

    def __init__(self, capacity: int) -> None:
        self.fates: deque[str] = deque()
        self.connect_fates: deque[str] = deque()
        self.executed: Counter[int] = Counter()
        self.capacity = capacity
        self.sessions: dict[str, Session] = {}
        self.most = 0
        self.refused = asyncio.Event()
        self.creating, self.may_create = asyncio.Event(), asyncio.Event()
        self.may_create.set()
        self.loses_pongs = False
        self.on_never: Callable[[int], object] = lambda number: None
        self._ids = map(str, itertools.count())
        self._sockets: set[Socket] = set()

    async def __aenter__(self) -> Self:
        app = web.Application()
        routes = [web.get("/ws", self._talk), web.post("/mcp", self._post)]
        app.add_routes([*routes, web.get("/health", self._health)])
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        self.url = f"http://127.0.0.1:{self._runner.addresses[0][1]}"
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.restart()
        await self._runner.cleanup()

    def reap(self) -> None:
        """Free the leaked slots."""
        for key in [key for key, session in self.sessions.items() if session.is_leaked]:
            self.sessions[key].is_leaked = False
            self._detach(key)

    def restart(self) -> None:
        """Forget all sessions."""
        self.sessions.clear()
        for socket in self._sockets:
            socket.transport.abort()

    async def _health(self, request: web.Request) -> web.Response:
        del request
        return web.json_response({"status": "healthy"})

    # -- sessions

    async def _post(self, request: web.Request) -> web.Response:
        message = await request.json()
        if message["method"] == "openenv/session/create":
            self.creating.set()
            await self.may_create.wait()
        answer = self._rpc(message["method"], message["params"])
        return web.json_response({"jsonrpc": "2.0", "id": message["id"], **answer})

    def _rpc(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        if method == "openenv/session/create":
            created = self._created(is_kept=True)
            if created in self.sessions:
                return {"result": {"session_id": created}}
            data = {"max_sessions": 1} if created == "CAPACITY_REACHED" else {"factory_name": "f"}
            return {"error": {"code": -32000, "message": created, "data": data}}
        assert method == "openenv/session/close"
        session = self.sessions.get(params["session_id"])
        if session is None:
            return {"error": {"code": -32602, "message": "Unknown session_id"}}
        session.is_closing = True
        if not session.is_attached:
            del self.sessions[params["session_id"]]
        return {"result": {"closing": session.is_attached}}

    def _created(self, *, is_kept: bool) -> str:
        """Return the id of a new session, or the code of an error."""
        fate = self.connect_fates.popleft() if self.connect_fates else "ok"
        if len(self.sessions) >= self.capacity:
            fate = "CAPACITY_REACHED"
        if fate != "ok":
            self.refused.set()
            self.reap()
            return "FACTORY_ERROR" if fate == "unreachable" else fate
        key = next(self._ids)
        self.sessions[key] = Session(is_kept=is_kept)
        self.most = max(self.most, len(self.sessions))
        return key

    def _attached(self, key: str) -> tuple[str, str]:
        """Return the id of the session for a socket, or the code and text of an error."""
        if key == "":
            key = self._created(is_kept=False)
            if key not in self.sessions:
                return key, "as it should not"
        elif key not in self.sessions:
            return "SESSION_ERROR", f"Unknown session_id: {key}"
        elif self.sessions[key].is_attached:
            self.reap()
            return "SESSION_ERROR", f"Session {key} already has an attached WebSocket"
        self.sessions[key].is_attached = True
        return key, ""

    def _detach(self, key: str) -> None:
        session = self.sessions.get(key)
        if session is not None and not session.is_leaked:
            session.is_attached = False
            if session.is_closing or not session.is_kept:
                del self.sessions[key]

    # -- messages

    async def _talk(self, request: web.Request) -> web.StreamResponse:
        assert request.transport is not None
        if self.connect_fates and self.connect_fates[0] == "unreachable":
            self.connect_fates.popleft()
            request.transport.abort()
            return web.Response()
        found = web.WebSocketResponse(timeout=0.1, autoping=False)
        await found.prepare(request)
        pongs = asyncio.Semaphore(0)
        socket = Socket(found, request.transport, not self.loses_pongs, pongs)
        with contextlib.suppress(ConnectionResetError):
            await self._serve(socket, *self._attached(request.query.get("session_id", "")))
        return found

    async def _serve(self, socket: Socket, key: str, text: str) -> None:
        if text:
            await self._error(socket, key, text)
            return
        self._sockets.add(socket)
        session = self.sessions[key]
        try:
            while (message := await socket.receive()) is not None:
                if not await self._answer(socket, session, message):
                    return
        finally:
            self._sockets.discard(socket)
            if self.sessions.get(key) is session:
                self._detach(key)

    async def _answer(self, socket: Socket, session: Session, message: Any) -> bool:
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
                await socket.send(reply)
            if fate in GOES_ON:
                return True
        socket.transport.abort()
        return False

    async def _begin(self, socket: Socket, session: Session, fate: str, message: Any) -> None:
        """Do what precedes the reply, or replaces it."""
        if fate == "late":
            await asyncio.sleep(0.005)
        elif fate == "never":
            self.on_never(message["data"]["number"])
            await socket.receive()
        elif fate == "no JSON":
            await socket.messages.send_str("{")
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

    async def _error(self, socket: Socket, code: str, message: str) -> None:
        data = {"code": code, "message": message}
        await socket.send({"type": "error", "data": data})


numbers = itertools.count()
