"""`Outbox`: messages of an env_server that wait to be sent, oldest first."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from rlightning_aio.protocol.net.wire import Writer

__all__ = ["Outbox", "OutgoingMessage"]


class OutgoingMessage(NamedTuple):
    """A message and the route of the connection that it is for."""

    route: bytes
    parts: list[bytes]


class Outbox(deque[OutgoingMessage]):
    """A queue that encodes messages. The sender removes them.

    Attributes:
        writer: encodes requests, which carry frames.
    """

    def __init__(self) -> None:
        super().__init__()
        self.writer = Writer()

    def post(self, route: bytes, message: Any) -> None:
        """Queue a message that has a header only."""
        self.append(OutgoingMessage(route, self.writer.write(message)))

    def post_parts(self, route: bytes, parts: list[bytes]) -> None:
        """Queue a message that is already encoded."""
        self.append(OutgoingMessage(route, parts))
