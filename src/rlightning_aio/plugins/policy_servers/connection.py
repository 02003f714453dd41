"""`connected`: a WebSocket to a policy server, which may still be starting."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from websockets.exceptions import InvalidHandshake, InvalidStatus

from rlightning_aio.errors import ConfigError, PolicyServerError
from rlightning_aio.plugins.one_frame import OneFrame, check_headers

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["MAX_BYTES", "Address", "connected"]

MAX_BYTES: Final = 64 * 1024 * 1024
"""A larger frame of a server is refused."""
_PAUSE_SECONDS: Final = 0.2
"""Between two attempts to connect."""
_CLOSE_SECONDS: Final = 1.0


@dataclass(frozen=True, slots=True)
class Address:
    """Where a policy server is, and how long to wait for it.

    Attributes:
        url: ``ws://host:port`` or ``wss://…``.
        timeout: seconds for an answer.
        connect_timeout: seconds for a server that refuses connections, because it is starting.
        headers: of the request that opens a connection.

    Raises:
        ConfigError: it is no such URL, a time is not positive, or a header can't be sent.
    """

    url: str
    timeout: float
    connect_timeout: float
    headers: Mapping[str, str]

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.url)
            is_good = parts.scheme in ("ws", "wss") and bool(parts.hostname) and parts.port != 0
        except ValueError:  # The port is no number.
            is_good = False
        if not is_good:
            raise ConfigError(f"{self.url!r}: should look like ws://localhost:8000")
        if self.timeout <= 0 or self.connect_timeout < 0:
            raise ConfigError("timeout must be above 0, and connect_timeout at least 0")
        try:
            check_headers(self.headers)
        except ValueError as error:
            raise ConfigError(f"{self.url}: {error}") from None


async def connected(address: Address) -> OneFrame:
    """Connect, again and again while nothing listens there.

    Raises:
        PolicyServerError: nothing listens there, or the server refuses.
    """
    until = time.monotonic() + address.connect_timeout
    while True:
        try:
            return await OneFrame.connected(
                address.url,
                address.headers,
                # A server may compute for a while before it looks at its connections.
                open_timeout=address.timeout,
                close_timeout=_CLOSE_SECONDS,
                max_bytes=MAX_BYTES,
            )
        except (OSError, InvalidHandshake, EOFError) as error:
            may_start = not isinstance(error, InvalidStatus) or error.response.status_code >= 500
            if isinstance(error, TimeoutError) or not may_start or time.monotonic() >= until:
                raise PolicyServerError(
                    f"the policy server {address.url} can't be reached: {error or 'it is silent'}; "
                    "start it, or correct the address"
                ) from error
        await asyncio.sleep(_PAUSE_SECONDS)
