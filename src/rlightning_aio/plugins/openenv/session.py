"""`OpenEnvSession`: one OpenEnv session, over one WebSocket at a time.

OpenEnv's replies carry no numbers, so one frame is in flight on a socket (`OneFrame`).
Left out: what observations mean (see `openenv`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import urllib.request
from contextvars import Context
from http import HTTPStatus
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast
from urllib.parse import quote, urlsplit, urlunsplit

from aiohttp import ClientError, ClientSession, ClientTimeout
from websockets.exceptions import InvalidHandshake, WebSocketException

from rlightning_aio.plugins.one_frame import OneFrame, keep_alive_by_system

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

__all__ = [
    "OpenEnvSession",
    "ServerGone",
    "ServerRefused",
    "get_json",
    "pauses",
    "post_json",
]

_PAUSE_SECONDS: Final = (0.05, 1.0)
"""Between two attempts to get a session: the first, and the longest."""
_CONNECT_SECONDS: Final = 10.0
"""How long one attempt to connect may take."""
_CREATE_SECONDS: Final = 60.0
"""How long a server may take to create a session."""
_MAX_BYTES: Final = 100 * 1024 * 1024
_KEEPALIVE_SECONDS: Final = 20.0
_REPLIES: Final = {"reset": "observation", "step": "observation", "state": "state", "mcp": "mcp"}
"""The type of a request's reply."""
_AT_CONNECT: Final = ("CAPACITY_REACHED", "FACTORY_ERROR", "SESSION_ERROR")
"""Errors that a server sends unasked, after which it closes the socket."""


class ServerGone(ConnectionError):
    """The server, or the way to it, is gone; an action may or may not have taken effect.

    Attributes:
        is_unsent: the request was not sent, so that it has certainly not taken effect.
    """

    blame = "infrastructure"

    def __init__(self, message: str, *, is_unsent: bool = False) -> None:
        super().__init__(message)
        self.is_unsent = is_unsent


class ServerRefused(RuntimeError):
    """The server has answered with an error.

    Attributes:
        code: OpenEnv's name of the error.
        blame: that the server gives, as ours do; or None.
    """

    def __init__(self, code: str, message: str, blame: str | None = None) -> None:
        super().__init__(f"{code}: {message}")
        self.code, self.blame = code, blame


class OpenEnvSession:
    """See the module.

    Args:
        url: of the server, ``http(s)://…`` or ``ws(s)://…``.
        keep: create the session by OpenEnv's RPC, and attach sockets to it: it survives a socket
            that is lost. Close it, or its slot at the server leaks.
        headers: sent with each connection; they may hold a key, and are never logged.
    """

    def __init__(
        self, url: str, *, keep: bool, headers: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        self.url = url
        self._keep = keep
        self._headers = headers
        self._socket: OneFrame | None = None
        self._session_id: str | None = None
        self._creating: asyncio.Task[None] | None = None
        self._ending: asyncio.Task[None] | None = None
        self._is_closed = False
        self._pings: asyncio.Task[None] | None = None

    async def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Send one frame on the open socket; the ``data`` of its reply.

        Cancelled, it closes the socket: the reply would otherwise answer the next request.

        Raises:
            ServerRefused: the reply is an error, after which the session goes on.
            ServerGone: the socket is lost.
        """
        socket = self._socket
        if socket is None:
            raise ServerGone(f"{self.url}: no session is open", is_unsent=True)
        self._stop_pings()
        frames, expected = [json.dumps(message)], _REPLIES[message["type"]]
        is_unsent = not socket.is_open
        if is_unsent:  # A refusal may have come before the end.
            frames, expected = [], "error"
        try:
            reply = _parsed(await socket.ask(*frames), expected)
        except (OSError, WebSocketException, ValueError) as error:
            self._abandon()
            raise ServerGone(f"{self.url} was lost: {error}", is_unsent=is_unsent) from error
        except BaseException:
            self._abandon()
            raise
        if reply["type"] == "error":
            refusal = _refusal(reply)
            if refusal.code in _AT_CONNECT:
                self._abandon()
            else:
                self._pings = asyncio.create_task(_keep_alive(socket))
            raise refusal
        self._pings = asyncio.create_task(_keep_alive(socket))
        return reply["data"]

    async def open(self, first: dict[str, Any], *, may_create: bool = True) -> dict[str, Any]:
        """Connect, send the first frame, and return the ``data`` of its reply.

        Waits as long as the server has no free slot, or a lost socket still holds the session.

        Args:
            first: the frame.
            may_create: begin another session where the server has forgotten a kept one.

        Raises:
            ServerRefused: the server refuses for good.
            ServerGone: the server can't be reached, or has forgotten the session.
        """
        pause = pauses()
        while True:
            try:
                if self._socket is None:
                    await self._connect(may_create=may_create)
                return await self.ask(first)
            except ServerRefused as refusal:
                text = str(refusal)
                if refusal.code == "SESSION_ERROR" and "Unknown session" in text:
                    self._session_id = None
                    continue
                is_held = "already" in text or "initializing" in text
                if refusal.code != "CAPACITY_REACHED" and not (
                    refusal.code == "SESSION_ERROR" and is_held
                ):
                    raise
            await asyncio.sleep(next(pause))

    async def _connect(self, *, may_create: bool) -> None:
        query = ""
        if self._keep:
            if self._session_id is None:
                if not may_create:
                    raise ServerGone(f"{self.url} has forgotten the session", is_unsent=True)
                await self._create()
            query = f"session_id={quote(str(self._session_id))}"
        try:
            self._socket = await OneFrame.connected(
                _address(self.url, "ws", "/ws", query),
                self._headers,
                open_timeout=_CONNECT_SECONDS,
                close_timeout=0.3,
                max_bytes=_MAX_BYTES,
            )
        except (OSError, InvalidHandshake, TimeoutError) as error:
            raise ServerGone(f"{self.url} can't be reached: {error}", is_unsent=True) from error
        keep_alive_by_system(self._socket.transport)

    async def _create(self) -> None:
        """Create the session, in a task that goes on when this is cancelled, lest a slot leak."""
        if self._creating is None:
            # Not in the env's context, or its host would cancel the task.
            self._creating = asyncio.create_task(self._take_slot(), context=Context())
        creating = self._creating
        try:
            await asyncio.shield(creating)
        finally:
            if creating.done():
                self._creating = None

    async def _take_slot(self) -> None:
        created = await self._call("openenv/session/create", {}, _CREATE_SECONDS)
        self._session_id = str(created["session_id"])
        if self._is_closed:
            await self._give_slot_back()

    async def _give_slot_back(self) -> None:
        session_id, self._session_id = self._session_id, None
        if session_id is not None:
            # A server that knows no such session has none to close.
            with contextlib.suppress(ServerRefused):
                arguments = {"session_id": session_id}
                await self._call("openenv/session/close", arguments, _CONNECT_SECONDS)

    async def _call(self, method: str, params: dict[str, Any], seconds: float) -> dict[str, Any]:
        """Call one of OpenEnv's methods over HTTP."""
        request = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        try:
            async with asyncio.timeout(seconds):
                reply = await post_json(_address(self.url, "http", "/mcp"), request, self._headers)
        except (OSError, ValueError, ClientError) as error:
            raise ServerGone(f"{self.url} can't be reached: {error}", is_unsent=True) from error
        error = reply.get("error")
        if error is not None:
            data: dict[str, Any] = error.get("data") or {}
            code = "SESSION_REFUSED"
            if "max_sessions" in data:
                code = "CAPACITY_REACHED"
            elif "factory_name" in data:
                code = "FACTORY_ERROR"
            raise ServerRefused(code, error.get("message", ""))
        return reply["result"]

    def _abandon(self) -> None:
        """Close the socket without waiting."""
        socket, self._socket = self._socket, None
        self._stop_pings()
        if socket is not None:
            socket.abort()

    async def close(self) -> None:
        """Close the socket and the session.

        Raises:
            ServerGone: the server can't be told that the session is over.
        """
        self._is_closed = True
        socket = self._socket
        try:
            if socket is not None and not self._keep:
                await socket.close()
        finally:
            self._abandon()
        if self._keep:
            # Whoever cancels this gives up waiting for the server, which is told all the same.
            self._ending = asyncio.create_task(self._end(), context=Context())
            await asyncio.shield(self._ending)

    async def _end(self) -> None:
        if self._creating is not None:
            await asyncio.wait({self._creating})
        await self._give_slot_back()

    def _stop_pings(self) -> None:
        pings, self._pings = self._pings, None
        if pings is not None:
            pings.cancel()


def pauses() -> Iterator[float]:
    """Yield the seconds to wait before each further attempt: twice as long each time."""
    pause, longest = _PAUSE_SECONDS
    while True:
        yield pause
        pause = min(2 * pause, longest)


async def _keep_alive(socket: OneFrame) -> None:
    """Keep an idle connection from being cut; a lost one is found by the next request."""
    try:
        while True:
            await asyncio.sleep(_KEEPALIVE_SECONDS)
            await socket.ping()
    except WebSocketException:
        return


def _parsed(frame: str | bytes, expected: str) -> dict[str, Any]:
    """A reply of the expected type, or an error.

    Raises:
        ValueError: the frame is none.
    """
    reply: Any = json.loads(frame)
    if isinstance(reply, dict):
        found = cast("dict[str, Any]", reply)
        if found.get("type") in (expected, "error") and isinstance(found.get("data"), dict):
            return found
    raise ValueError(f"a frame that is no reply to the request: {str(frame)[:80]!r}")


def _refusal(reply: dict[str, Any]) -> ServerRefused:
    data = reply["data"]
    details = f" ({data['errors']})" if data.get("errors") else ""
    code, message = str(data.get("code", "ERROR")), f"{data.get('message', '')}{details}"
    return ServerRefused(code, message, data.get("blame"))


def _address(url: str, scheme: str, path: str, query: str = "") -> str:
    """The address of one of the server's routes, with ``ws`` or ``http``, secure if `url` is."""
    parts = urlsplit(url if "://" in url else f"http://{url}")
    secure = "s" if parts.scheme in ("https", "wss") else ""
    return urlunsplit((scheme + secure, parts.netloc, parts.path.rstrip("/") + path, query, ""))


async def post_json(
    url: str, body: dict[str, Any], headers: Mapping[str, str] = MappingProxyType({})
) -> dict[str, Any]:
    """Return the JSON that a server answers to POST `body`.

    Raises:
        OSError, ValueError, ClientError: there is no such answer.
    """
    timeout = ClientTimeout(total=None, connect=_CONNECT_SECONDS)
    async with (
        ClientSession(timeout=timeout) as session,
        session.post(url, json=body, headers=headers, allow_redirects=False) as reply,
    ):
        if reply.status >= HTTPStatus.MULTIPLE_CHOICES:
            raise ConnectionError(f"HTTP {reply.status} {reply.reason}")
        return await reply.json(content_type=None)


def get_json(url: str, path: str, headers: Mapping[str, str] = MappingProxyType({})) -> Any:
    """Return the answer of a server to GET `path`."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    request = urllib.request.Request(_address(url, "http", path))  # noqa: S310  # It is http(s).
    for name, value in headers.items():  # Not sent to where the server may redirect to.
        request.add_unredirected_header(name, value)
    with opener.open(request, timeout=_CONNECT_SECONDS) as reply:
        return json.load(reply)
