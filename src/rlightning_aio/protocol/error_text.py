"""`ErrorText`: an exception as it travels to another process; and texts of peers, safe to show.

Rule: no text of a peer reaches a terminal unchanged. Characters that can't be printed (escapes, and
those that reorder a line) become Python's escapes, and a text that is too long loses its middle.
"""

from __future__ import annotations

import logging
import traceback
from dataclasses import dataclass
from typing import Any, Final

from rlightning_aio.outcomes import BLAMES
from rlightning_aio.protocol.entries import answers_with_value

LOG: Final = logging.getLogger("rlightning_aio.remote")
"""Of both ends of env_server."""
_ONE_LINE: Final = 1000
_LINES: Final = 100_000


@dataclass(frozen=True)
class ErrorText:
    """An exception as text, which any process can read, whatever its class.

    Attributes:
        blame: of `Outcome`, as the exception itself says in an attribute of this name; or empty.
    """

    type_name: str
    text: str
    traceback: str
    blame: str = ""

    @property
    def summary(self) -> str:
        """The last line of the traceback: the type, and the text if there is one."""
        return f"{self.type_name}: {self.text}" if self.text else self.type_name

    def ends_env(self, op: int) -> bool:
        """Return True if an env that raised this in an operation may be unusable.

        A method call leaves it as usable as before, and Ctrl-C is no error of the env.
        """
        return not (answers_with_value(op) or self.type_name == "KeyboardInterrupt")

    @classmethod
    def of(cls, error: BaseException) -> ErrorText:
        """Describe `error` in plain text, even if methods of its class raise.

        A group of one exception is described as that exception.
        """
        name, text = _described(error)
        try:
            lines = _plain("".join(traceback.format_exception(error)))
        except BaseException:  # noqa: BLE001
            frames = traceback.format_tb(_TRACEBACK.__get__(error))
            lines = "".join(frames) + f"{name}: {text}\n"
        blame: Any = getattr(error, "blame", "")
        return cls(name, text, lines, blame if type(blame) is str and blame in BLAMES else "")


def _described(error: BaseException) -> tuple[str, str]:
    """Return the name of the class of `error`, and its text."""
    parts = _parts_of(error)
    if len(parts) == 1:
        return _described(parts[0])
    kind = type(error)
    name = _plain(_NAME.__get__(kind))
    module = _MODULE.__get__(kind)
    if isinstance(module, str) and module != "builtins":
        name = f"{_plain(module)}.{name}"
    try:
        text = _plain(str(error))
    except BaseException as broken:  # noqa: BLE001  # It is the author's code, as above.
        text = f"<its __str__ raised {_plain(_NAME.__get__(type(broken)))}>"
    if parts:
        named = [": ".join(filter(None, _described(part))) for part in parts[:_MOST_PARTS]]
        text += ": " + "; ".join(named + ["…"] * (len(parts) > _MOST_PARTS))
    return name, text


def _parts_of(error: BaseException) -> tuple[BaseException, ...]:
    """Return the exceptions in a group of exceptions; any other has none."""
    return _PARTS.__get__(error) if issubclass(type(error), BaseExceptionGroup) else ()


_MOST_PARTS: Final = 3
"""Exceptions of a group that are named."""
_PARTS: Final[Any] = vars(BaseExceptionGroup)["exceptions"]
_NAME: Final[Any] = vars(type)["__qualname__"]
_MODULE: Final[Any] = vars(type)["__module__"]
_TRACEBACK: Final[Any] = vars(BaseException)["__traceback__"]
"""Descriptors of Python itself, because classes may redefine these attributes."""


def _plain(text: str) -> str:
    """Return `text` as a plain `str`: other processes may lack its subclass."""
    return str.__str__(text)


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
