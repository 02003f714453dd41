"""Headers of a WebSocket's first request that may hold a key, and what keeps them out of logs.

websockets logs the headers of its requests, at the level DEBUG. A message about a header names it
and never shows its value.
"""

from __future__ import annotations

import logging
import re
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["check_headers", "secretly"]

_NAME: Final = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_VALUE: Final = re.compile(r"[\t\x20-\x7e]*")
_log: Final = logging.getLogger("rlightning_aio.websockets")
_log.setLevel(logging.INFO)


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


def secretly(headers: Mapping[str, str]) -> dict[str, Any]:
    """Arguments of websockets' `connect` that send `headers` and log none of them."""
    return {"additional_headers": dict(headers), "logger": _log} if headers else {}
