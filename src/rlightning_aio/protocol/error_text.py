"""`ErrorText`: an exception as it travels to another process."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from typing import Any, Final

from rlightning_aio.outcomes import BLAMES
from rlightning_aio.protocol.entries import answers_with_value


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
