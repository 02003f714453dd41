"""Texts from the network in a form that is safe to show in logs, errors and terminals.

Both ends of env_server use the logger `LOG`.

Rule: no text of a peer reaches a terminal unchanged. Characters that can't be printed (escapes, and
those that reorder a line) become Python's escapes, and a text that is too long loses its middle.
"""

from __future__ import annotations

import logging
from typing import Final

LOG: Final = logging.getLogger("rlightning_aio.remote")
_ONE_LINE: Final = 1000
_LINES: Final = 100_000


def in_one_line(text: str) -> str:
    """Return `text` without control characters and line ends, at most about 1,000 characters."""
    return _printable(text, "", _ONE_LINE, " … ")


def in_lines(text: str) -> str:
    """Return a traceback without control characters, with its lines, at most 100,000 characters."""
    return _printable(text, "\n\t", _LINES, "\n…\n")


def _cut(text: str, most: int, gap: str) -> str:
    return text if len(text) <= most else text[: most // 2] + gap + text[-(most // 2) :]


def _printable(text: str, kept: str, most: int, gap: str) -> str:
    text = _cut(text, most, gap)
    if text.isprintable():
        return text
    printable = (
        char if char.isprintable() or char in kept else char.encode("unicode_escape").decode()
        for char in text
    )
    return _cut("".join(printable), most, gap)
