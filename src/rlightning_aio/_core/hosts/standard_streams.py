"""Keeps descriptors 0, 1 and 2 open in a program that was started without its streams.

Otherwise the next file would get one of them, and output to stderr would be written into it.
"""

from __future__ import annotations

import os
import sys
from typing import Final, TextIO

_STDOUT: Final = 1
_STDERR: Final = 2


def occupy_standard_streams() -> None:
    """Open /dev/null in place of closed streams, here and in child processes.

    Call it before opening a file that must not get one of these descriptors.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)


def stdout_set_aside() -> TextIO:
    """Redirect descriptor 1 to stderr, here and in child processes.

    Then an env, a C library or a child process that prints can't corrupt output to stdout. Returns
    a stream to the original stdout.
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
