"""`is_connections`: which errors of an agent are those of a connection or a server.

Their classes are known by name, because the packages that define them are not imported.
"""

from __future__ import annotations

from typing import Any, Final

_PACKAGES: Final = ("openai", "anthropic", "httpx", "httpcore", "aiohttp", "requests", "urllib3")
_NAMES: Final = frozenset(
    (
        # Of openai and anthropic.
        *("APIConnectionError", "RateLimitError", "InternalServerError"),
        # Of httpx and httpcore: all errors below the protocol.
        *("TransportError", "TimeoutException", "NetworkError", "ProtocolError"),
        # Of aiohttp.
        *("ClientConnectionError", "ClientPayloadError"),
        # Of requests and urllib3.
        *("ConnectionError", "Timeout", "ChunkedEncodingError", "HTTPError"),
    )
)
_OF_FILES: Final = (
    *(FileNotFoundError, FileExistsError, IsADirectoryError, NotADirectoryError),
    PermissionError,
)
_TOO_MANY, _SERVERS_OWN = 429, 500


def is_connections(error: BaseException) -> bool:
    """Return True if an error, or a cause of it, says that a connection or a server has failed.

    Builtin ones do (`OSError`, and so `TimeoutError`, but not those about files), those of the
    usual clients, and any with the status 429 or 5xx. Any other status is about the request.
    """
    seen = set[int]()
    one: BaseException | None = error
    while one is not None and id(one) not in seen:
        seen.add(id(one))
        status = _status_of(one)
        if status is not None:
            return status == _TOO_MANY or status >= _SERVERS_OWN
        if isinstance(one, OSError) and not isinstance(one, _OF_FILES):
            return True
        if any(map(_is_named, type(one).__mro__)):
            return True
        one = one.__cause__
    return False


def _is_named(kind: type) -> bool:
    return kind.__name__ in _NAMES and kind.__module__.partition(".")[0] in _PACKAGES


def _status_of(error: Any) -> int | None:
    """The status of the reply that a client's error is about."""
    for holder in (error, getattr(error, "response", None)):
        for name in ("status_code", "status"):
            status = getattr(holder, name, None)
            if type(status) is int and status > 0:
                return status
    return None
