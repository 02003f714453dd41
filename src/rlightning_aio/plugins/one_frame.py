"""`OneFrame`: a WebSocket with at most one request in flight, for protocols without numbers.

Rule: replies are paired with requests by order alone. Whoever stops waiting for a reply closes the
socket, so that a late one can't answer another request. Headers may hold keys, so no log shows
them.
"""

from __future__ import annotations

import logging
import re
import socket as sockets
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Self

from websockets.asyncio.client import connect
from websockets.protocol import State

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Mapping

    from websockets.asyncio.client import ClientConnection

__all__ = ["OneFrame", "check_headers", "keep_alive_by_system"]

_NAME: Final = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_VALUE: Final = re.compile(r"[\t\x20-\x7e]*")
_LOG: Final = logging.getLogger("rlightning_aio.websockets")
# At a lower level, websockets logs headers.
_LOG.setLevel(logging.INFO)


class OneFrame:
    """A connection; see the module.

    Attributes:
        is_open: False once either side has closed it.
    """

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket

    @classmethod
    async def connected(
        cls,
        url: str,
        headers: Mapping[str, str] = MappingProxyType({}),
        *,
        open_timeout: float,
        close_timeout: float,
        max_bytes: int,
    ) -> Self:
        """Connect to ``ws://…`` or ``wss://…``.

        Args:
            url: of the server.
            headers: of the request that opens the connection.
            open_timeout: seconds for the server to accept.
            close_timeout: seconds for it to answer the end.
            max_bytes: a larger frame of the server ends the connection.

        Raises:
            OSError, InvalidHandshake, EOFError: nothing listens there, or the server refuses.
        """
        secretly: dict[str, Any] = {"additional_headers": dict(headers), "logger": _LOG}
        return cls(
            await connect(
                url,
                open_timeout=open_timeout,
                close_timeout=close_timeout,
                max_size=max_bytes,
                # A server that computes a reply may not look at its connections meanwhile.
                ping_interval=None,
                # It costs more time, on both sides, than the bytes that it saves.
                compression=None,
                proxy=None,
                **(secretly if headers else {}),
            )
        )

    @property
    def is_open(self) -> bool:
        return self._socket.state is State.OPEN

    @property
    def transport(self) -> asyncio.Transport:
        """The transport below."""
        return self._socket.transport

    async def ask(self, *frames: str | bytes) -> str | bytes:
        """Send frames, or none, and return the next frame that arrives.

        Cancelled, or with any error, it closes the socket.

        Raises:
            OSError, WebSocketException: the connection is lost.
        """
        try:
            for frame in frames:
                await self._socket.send(frame)
            return await self._socket.recv()
        except BaseException:
            self.abort()
            raise

    async def ping(self) -> None:
        """Send a ping, which keeps an idle connection from being cut.

        Raises:
            WebSocketException: the connection is lost.
        """
        await self._socket.ping()

    def abort(self) -> None:
        """Close the socket without waiting; idempotent."""
        self._socket.transport.abort()

    async def close(self) -> None:
        """Close the socket, and wait for the server to answer."""
        await self._socket.close()


def check_headers(headers: Mapping[str, str]) -> None:
    """Check that headers can be sent.

    Raises:
        ValueError: a name or a value can't.
    """
    for name, value in headers.items():
        if not _NAME.fullmatch(name):
            raise ValueError(f"{name!r} is no name of a header")
        if not _VALUE.fullmatch(value):
            raise ValueError(f"the value of {name} has characters that are none of a header")


def keep_alive_by_system(transport: asyncio.Transport) -> None:
    """Let the system find a far end that has vanished, also while a reply is awaited."""
    socket = transport.get_extra_info("socket")
    socket.setsockopt(sockets.SOL_SOCKET, sockets.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 20), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
        if hasattr(sockets, name):
            socket.setsockopt(sockets.IPPROTO_TCP, getattr(sockets, name), value)
