"""Texts of the other end as people may be shown them: in logs, errors and terminals.

Rule: what a peer says reaches nobody's terminal as it came. Characters that can't be printed
(escapes, and what reorders a line) stand there as Python writes them, and what is too long
loses its middle.
"""

from __future__ import annotations

from typing import Final

__all__ = ["in_lines", "in_one_line"]

_ONE_LINE: Final = 1000
_LINES: Final = 100_000


def in_one_line(text: str) -> str:
    """`text` without control characters and line ends, some 1,000 characters at most."""
    return _printable(text, "", _ONE_LINE, " … ")


def in_lines(text: str) -> str:
    """The same for a traceback: its lines stay, and 100,000 characters."""
    return _printable(text, "\n\t", _LINES, "\n…\n")


def _cut(text: str, most: int, gap: str) -> str:
    return text if len(text) <= most else text[: most // 2] + gap + text[-(most // 2) :]


def _printable(text: str, kept: str, most: int, gap: str) -> str:
    text = _cut(text, most, gap)
    if text.isprintable():
        return text
    shown = (
        char if char.isprintable() or char in kept else char.encode("unicode_escape").decode()
        for char in text
    )
    return _cut("".join(shown), most, gap)
