"""`ErrorText`: an exception as it travels to another process."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from typing import Any, Final

__all__ = ["ErrorText"]


@dataclass(frozen=True)
class ErrorText:
    """An exception as text, which any process can read, whatever its class."""

    type_name: str
    text: str
    traceback: str

    @property
    def summary(self) -> str:
        """The last line of the traceback: the type, and the text if there is one."""
        return f"{self.type_name}: {self.text}" if self.text else self.type_name

    @classmethod
    def of(cls, error: BaseException) -> ErrorText:
        """Describe `error` in plain text, even if methods of its class raise."""
        kind = type(error)
        name = _plain(_NAME.__get__(kind))
        module = _MODULE.__get__(kind)
        if isinstance(module, str) and module != "builtins":
            name = f"{_plain(module)}.{name}"
        try:
            text = _plain(str(error))
        except BaseException as broken:  # noqa: BLE001  # It is the author's code, as below.
            text = f"<its __str__ raised {_plain(_NAME.__get__(type(broken)))}>"
        try:
            lines = _plain("".join(traceback.format_exception(error)))
        except BaseException:  # noqa: BLE001
            frames = traceback.format_tb(_TRACEBACK.__get__(error))
            lines = "".join(frames) + f"{name}: {text}\n"
        return cls(name, text, lines)


_NAME: Final[Any] = vars(type)["__qualname__"]
_MODULE: Final[Any] = vars(type)["__module__"]
_TRACEBACK: Final[Any] = vars(BaseException)["__traceback__"]
"""Descriptors of Python itself, because classes may redefine these attributes."""


def _plain(text: str) -> str:
    """Return `text` as a plain `str`: other processes may lack its subclass."""
    return str.__str__(text)
