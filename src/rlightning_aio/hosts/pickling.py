"""Values as bytes between a trainer and the workers that it has forked itself.

Rule: what either end may hold in a module travels by pickle, which is fast; what may be
code of the user's (classes and functions of a script, lambdas) by cloudpickle. Both are
read by `pickle.loads`.
Absent on purpose: anything from a network; that is never pickled.
"""

from __future__ import annotations

import pickle
from typing import Any

import cloudpickle

__all__ = ["dumped", "dumped_with_code"]


def dumped(value: Any, what: str) -> bytes:
    """The pickle of `value`; with the code in it only if it can't do without.

    Args:
        value: travels to the other end.
        what: what an error calls it.

    Raises:
        TypeError: it can't be pickled.
    """
    try:
        pickled = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
        # The other end has a `__main__` of its own, which has none of this one's names.
        return dumped_with_code(value) if b"__main__" in pickled else pickled
    except Exception:
        try:
            return dumped_with_code(value)
        except Exception as error:
            raise TypeError(f"{what} can't be pickled: {error}") from error


def dumped_with_code(value: Any) -> bytes:
    """The pickle of `value`, with functions and classes that the other end can't import.

    Raises whatever the value's own pickling raises.
    """
    return cloudpickle.dumps(value)  # pyright: ignore[reportUnknownMemberType]  # No annotations.
