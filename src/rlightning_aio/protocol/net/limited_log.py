"""`LimitedLog`: warnings that a peer can cause, without a way for it to fill the log.

Rule: of each kind, a text is logged once until another text of that kind is logged, and one text
every ten seconds at most. Both ends of env_server use the logger `LOG`.
"""

from __future__ import annotations

import logging
from typing import Final

__all__ = ["LOG", "LimitedLog"]

LOG: Final = logging.getLogger("rlightning_aio.remote")
_SECONDS_BETWEEN_WARNINGS: Final = 10.0


class LimitedLog:
    """Logs warnings in the name of one server or client."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._last: dict[str, tuple[float, str]] = {}

    def warn(self, kind: str, text: str, now: float) -> None:
        """Log `text`, unless it is a repetition or comes too soon after another of its `kind`."""
        last = self._last.get(kind)
        if last is None or (text != last[1] and now - last[0] >= _SECONDS_BETWEEN_WARNINGS):
            self._last[kind] = (now, text)
            LOG.warning("%s: %s", self._name, text)
