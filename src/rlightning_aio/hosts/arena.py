"""The arena: all shared memory of one group, in one file without a name.

The trainer makes it and hands its descriptor to each worker; parts are appended at
page boundaries, so that each side maps just what it needs. Nothing has to be cleaned
up: the memory goes with the last process that maps it.
"""

from __future__ import annotations

import mmap
import os

__all__ = ["Arena", "map_shared"]


def map_shared(descriptor: int, offset: int, size: int) -> memoryview:
    """Map a part of an arena, readable and writable; unmapped when nothing refers to it."""
    return memoryview(mmap.mmap(descriptor, size, offset=offset))


class Arena:
    """The trainer's end: owns the descriptor and appends parts."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("rlightning_aio", os.MFD_CLOEXEC)
        self._size = 0

    def append(self, size: int) -> int:
        """Reserve `size` zeroed bytes; their offset."""
        offset = self._size
        self._size += -(-max(size, 1) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        os.ftruncate(self.descriptor, self._size)
        return offset

    def close(self) -> None:
        """Give the descriptor back; what is mapped stays mapped."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1
