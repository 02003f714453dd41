"""Keeps descriptors 0, 1 and 2 taken in a program that was started without its streams.

Otherwise, whatever is opened next would get one of them, and all that goes to stderr would be
written into it.
"""

from __future__ import annotations

import os
import sys
from typing import Final, TextIO

__all__ = ["occupy_standard_streams", "stdout_set_aside"]

_STDOUT: Final = 1
_STDERR: Final = 2


def occupy_standard_streams() -> None:
    """Have /dev/null in place of those that are closed, here and in what this process starts.

    Call it before opening what must not land there.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)


def stdout_set_aside() -> TextIO:
    """Have descriptor 1 lead to stderr from now on, here and in what this process starts.

    Whoever prints, an env, a library written in C or a process that either starts, can then spoil
    no result. Returns the stream that leads where stdout has led until now.
    """
    occupy_standard_streams()
    before = sys.stdout
    if before is not None:  # pyright: ignore[reportUnnecessaryComparison]  # Closed by the caller.
        before.flush()
    kept = os.dup(_STDOUT)
    os.dup2(_STDERR, _STDOUT)
    return os.fdopen(
        kept,
        "w",
        encoding=getattr(before, "encoding", None),
        errors=getattr(before, "errors", None),
    )
