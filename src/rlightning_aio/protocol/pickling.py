"""Pickles for messages between a trainer and its own workers.

Rule: pickle is fast and suffices for objects of importable modules; cloudpickle is for code of the
user (classes and functions of a script, lambdas). `pickle.loads` reads both.
Left out on purpose: data from a network. Only what Ray has carried is unpickled.
"""

from __future__ import annotations

import io
import pickle
from collections import ChainMap
from types import CodeType
from typing import TYPE_CHECKING, Any, Final

import cloudpickle

if TYPE_CHECKING:
    from collections.abc import Callable


_REDUCERS: Final[Any] = cloudpickle.Pickler.dispatch_table


def _reduced(code: CodeType) -> tuple[Callable[..., CodeType], tuple[Any, ...]]:
    return _restored, (_REDUCERS[CodeType](code), code.co_filename)


def _restored(reduced: tuple[Any, ...], filename: str) -> CodeType:
    make, arguments = reduced
    return make(*arguments).replace(co_filename=filename)


class CodePickler(cloudpickle.Pickler):
    """Pickles code with the name of its file, which tracebacks show.

    cloudpickle itself, from 3.1.3 on, puts ``<dynamic-code>`` in its place.
    """

    dispatch_table: Final[Any] = ChainMap({CodeType: _reduced}, _REDUCERS)

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)  # pyright: ignore[reportUnknownMemberType]


def dumped(value: Any, what: str) -> bytes:
    """Pickle `value`, with code only if necessary.

    Args:
        value: the object to send.
        what: its name in errors.

    Raises:
        TypeError: it can't be pickled.
    """
    try:
        pickled = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        # `__main__` is another module in the receiver.
        return dumped_with_code(value) if b"__main__" in pickled else pickled
    except Exception:  # noqa: BLE001  # An object may raise anything.
        try:
            return dumped_with_code(value)
        except Exception as error:
            raise TypeError(f"{what} can't be pickled: {error}") from error


def dumped_with_code(value: Any) -> bytes:
    """Pickle `value` with functions and classes that the receiver can't import.

    Raises what pickling the value raises.
    """
    file = io.BytesIO()
    CodePickler(file).dump(value)  # pyright: ignore[reportUnknownMemberType]
    return file.getvalue()
