"""Descriptors 0, 1 and 2, which are nobody's in a program that was started without its streams.

What is opened next would land there, and be written into by whatever writes to stderr.
"""

from __future__ import annotations

import os
from typing import Final

__all__ = ["occupy_standard_streams"]

_STDERR: Final = 2


def occupy_standard_streams() -> None:
    """Have /dev/null in place of those that are closed, here and in what this process starts.

    Call it before opening what must not land there.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
