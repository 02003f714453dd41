"""`PostConnection`: a connection of a websockets server that answers POST requests as well.

websockets parses GET requests alone. A connection that begins with POST gets one answer of JSON,
and is closed.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

from websockets.asyncio.server import ServerConnection

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from http import HTTPStatus

__all__ = ["PostConnection"]

_MAX_BYTES: Final = 1024 * 1024


class PostConnection(ServerConnection):
    """See the module.

    Args:
        answer: gets the path and the body of a POST request; returns a status and a body.
    """

    def __init__(
        self,
        *args: Any,
        answer: Callable[[str, bytes], Awaitable[tuple[HTTPStatus, bytes]]],
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        self._answer = answer
        self._received = b""
        self._is_get = False
        self._post: asyncio.Future[tuple[str, bytes]] = self.loop.create_future()

    def data_received(self, data: bytes) -> None:
        if self._is_get:
            super().data_received(data)
            return
        self._received += data
        if not (self._received.startswith(b"POST ") or b"POST ".startswith(self._received)):
            self._is_get = True
            super().data_received(self._received)
        elif len(self._received) > _MAX_BYTES:
            self.transport.abort()
        elif not self._post.done():
            self._look_for_end()

    def _look_for_end(self) -> None:
        head, end, body = self._received.partition(b"\r\n\r\n")
        lines = head.decode("latin-1").split("\r\n")
        headers = dict(line.lower().split(":", 1) for line in lines[1:] if ":" in line)
        length = headers.get("content-length", "0").strip()
        if end and (not length.isdecimal() or len(body) >= int(length)):
            self._post.set_result((lines[0].split(" ")[1].partition("?")[0], body))

    async def handshake(self, *args: Any, **kwargs: Any) -> None:
        """Answer a POST request; for any other, see `ServerConnection`."""
        first = (self._post, self.request_rcvd, self.connection_lost_waiter)
        await asyncio.wait(first, return_when=asyncio.FIRST_COMPLETED)
        if not self._post.done():
            await super().handshake(*args, **kwargs)
            return
        status, body = await self._answer(*self._post.result())
        head = (
            f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: application/json\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        self.transport.write(head.encode() + body)
        self.transport.close()
        await asyncio.shield(self.connection_lost_waiter)
