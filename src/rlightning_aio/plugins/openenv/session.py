"""`OpenEnvSession`: one session of an OpenEnv server, over one WebSocket.

Rule: OpenEnv's replies carry no numbers, so one frame is in flight, and whoever stops waiting for
a reply closes the socket, so that a late one can't answer another request. Headers may hold keys,
so no log shows them.
Left out: what observations mean (see `env`).
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket as sockets
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast
from urllib.parse import urlsplit, urlunsplit

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from websockets.asyncio.client import ClientConnection

_PAUSE_SECONDS: Final = (0.05, 1.0)
"""Between two attempts to get a session: the first, and the longest."""
_CONNECT_SECONDS: Final = 10.0
"""How long one attempt to connect may take."""
_CLOSE_SECONDS: Final = 0.3
"""How long a server may take to answer the end of a session."""
_KEEPALIVE_SECONDS: Final = 20.0
_MAX_BYTES: Final = 100 * 1024 * 1024
_REPLIES: Final = {"reset": "observation", "step": "observation", "state": "state", "mcp": "mcp"}
"""The type of a request's reply."""
_AT_CONNECT: Final = ("CAPACITY_REACHED", "FACTORY_ERROR", "SESSION_ERROR")
"""Errors that a server sends unasked, after which it closes the socket."""
_LOG: Final = logging.getLogger("rlightning_aio.openenv")
# At a lower level, websockets logs headers.
_LOG.setLevel(logging.INFO)


class ServerGone(ConnectionError):
    """The server, or the way to it, is gone; an action may or may not have taken effect."""

    blame = "infrastructure"


class ServerRefused(RuntimeError):
    """The server has answered with an error.

    Attributes:
        code: OpenEnv's name of the error.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code


class OpenEnvSession:
    """See the module.

    Args:
        url: of the server, ``http(s)://…`` or ``ws(s)://…``.
        headers: of the request that opens the connection.
    """

    def __init__(self, url: str, headers: Mapping[str, str] = MappingProxyType({})) -> None:
        self.url = url
        self._headers = headers
        self._socket: ClientConnection | None = None

    async def ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Send one frame, and return the ``data`` of its reply.

        Cancelled, it closes the socket, and with it the session.

        Raises:
            ServerRefused: the reply is an error, after which the session continues.
            ServerGone: the socket is lost.
            TypeError, ValueError: the message has no form in JSON, and was not sent.
        """
        frame, socket = json.dumps(message), self._socket
        if socket is None:
            raise ServerGone(f"{self.url}: no session is open")
        try:
            reply = await _exchange(socket, frame, _REPLIES[message["type"]])
        except (OSError, ConnectionClosed, ValueError) as error:
            self._abandon()
            raise ServerGone(f"{self.url} was lost: {error}") from error
        except BaseException:
            self._abandon()
            raise
        if reply["type"] == "error":
            refusal = _refusal(reply["data"])
            if refusal.code in _AT_CONNECT:
                self._abandon()
            raise refusal
        return reply["data"]

    async def open(self, first: dict[str, Any]) -> dict[str, Any]:
        """Connect if no socket is open, send the first frame, and return the ``data`` of its reply.

        Waits as long as the server has no free slot.

        Raises:
            ServerRefused: the server refuses for good.
            ServerGone: the server can't be reached.
        """
        for pause in pauses():
            if self._socket is None:
                self._socket = await self._connected()
            try:
                return await self.ask(first)
            except ServerRefused as refusal:
                if refusal.code != "CAPACITY_REACHED":
                    raise
            await asyncio.sleep(pause)
        raise AssertionError("pauses never end")

    async def _connected(self) -> ClientConnection:
        secretly: dict[str, Any] = {"additional_headers": dict(self._headers), "logger": _LOG}
        try:
            socket = await connect(
                _address(self.url),
                open_timeout=_CONNECT_SECONDS,
                close_timeout=_CLOSE_SECONDS,
                max_size=_MAX_BYTES,
                # They keep an idle connection from being cut. Nobody waits for their answers: a
                # server that computes a reply may not look at its connections meanwhile.
                ping_interval=_KEEPALIVE_SECONDS,
                ping_timeout=None,
                # It costs more time, on both sides, than the bytes that it saves.
                compression=None,
                proxy=None,
                **(secretly if self._headers else {}),
            )
        except (OSError, InvalidHandshake, EOFError) as error:
            raise ServerGone(f"{self.url} can't be reached: {error}") from error
        _keep_alive_by_system(socket.transport)
        return socket

    def _abandon(self) -> None:
        """Close the socket without waiting."""
        socket, self._socket = self._socket, None
        if socket is not None:
            socket.transport.abort()

    async def close(self) -> None:
        """Close the socket, so that the server ends the session."""
        try:
            if self._socket is not None:
                await self._socket.close()
        finally:
            self._abandon()


def pauses() -> Iterator[float]:
    """Yield the seconds to wait before each further attempt: twice as long each time."""
    pause, longest = _PAUSE_SECONDS
    while True:
        yield pause
        pause = min(2 * pause, longest)


async def _exchange(socket: ClientConnection, frame: str, expected: str) -> dict[str, Any]:
    """Send a frame, and return the next one, which is of the expected type or an error.

    Raises:
        OSError, ConnectionClosed: the connection is lost.
        ValueError: the reply is of neither type.
    """
    try:
        await socket.send(frame)
    except ConnectionClosed:
        expected = "error"  # A refusal may have come before the end.
    received = await socket.recv()
    reply: Any = json.loads(received)
    if isinstance(reply, dict):
        found = cast("dict[str, Any]", reply)
        if found.get("type") in (expected, "error") and isinstance(found.get("data"), dict):
            return found
    raise ValueError(f"a frame that is no reply to the request: {str(received)[:80]!r}")


def _refusal(data: dict[str, Any]) -> ServerRefused:
    details = f" ({data['errors']})" if data.get("errors") else ""
    return ServerRefused(str(data.get("code", "ERROR")), f"{data.get('message', '')}{details}")


def _keep_alive_by_system(transport: asyncio.Transport) -> None:
    """Let the system find a far end that has vanished, also while a reply is awaited."""
    socket = transport.get_extra_info("socket")
    socket.setsockopt(sockets.SOL_SOCKET, sockets.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 20), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
        if hasattr(sockets, name):
            socket.setsockopt(sockets.IPPROTO_TCP, getattr(sockets, name), value)


def _address(url: str) -> str:
    """The address of the server's WebSocket, secure if `url` is."""
    parts = urlsplit(url if "://" in url else f"http://{url}")
    scheme = "wss" if parts.scheme in ("https", "wss") else "ws"
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + "/ws", "", ""))
