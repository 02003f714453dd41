"""Pickles for messages between a trainer and its own workers.

Rule: pickle is fast and suffices for objects of importable modules; cloudpickle is for code of the
user (classes and functions of a script, lambdas). `pickle.loads` reads both.
Left out on purpose: data from a network, which is never unpickled.
"""

from __future__ import annotations

import pickle
from typing import Any

import cloudpickle

__all__ = ["dumped", "dumped_with_code"]


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
    except Exception:
        try:
            return dumped_with_code(value)
        except Exception as error:
            raise TypeError(f"{what} can't be pickled: {error}") from error


def dumped_with_code(value: Any) -> bytes:
    """Pickle `value` with functions and classes that the receiver can't import.

    Raises what pickling the value raises.
    """
    return cloudpickle.dumps(value)  # pyright: ignore[reportUnknownMemberType]  # No annotations.
