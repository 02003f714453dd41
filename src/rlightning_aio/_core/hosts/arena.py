"""The arena: all shared memory of one group, in one file without a name.

The trainer creates it and passes its descriptor to each worker. Parts begin at page boundaries, so
that each side maps only what it needs. The system frees the memory with the last process that maps
it, so nothing has to be cleaned up.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import tempfile
from typing import Final

from rlightning_aio._core.hosts.descriptors import occupy_standard_streams

_MAP_FIXED: Final = 0x10


def map_shared(descriptor: int, offset: int, size: int) -> memoryview:
    """Map a part of an arena, readable and writable, until nothing refers to it."""
    return memoryview(mmap.mmap(descriptor, size, offset=offset))


def make_private(memory: memoryview) -> None:
    """Make a part of an arena private to this process, with the same address and contents."""
    held = bytes(memory)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    libc = ctypes.CDLL(None, use_errno=True)
    libc.mmap.argtypes = (
        ctypes.c_void_p,
        ctypes.c_size_t,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_int,
        ctypes.c_long,
    )
    libc.mmap.restype = ctypes.c_void_p
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED
    found = libc.mmap(address, len(held), mmap.PROT_READ | mmap.PROT_WRITE, flags, -1, 0)
    if found != address:
        raise OSError(ctypes.get_errno(), "shared memory can't be made private")
    memory[:] = held


def _nameless_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlightning_aio", os.MFD_CLOEXEC)
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


class Arena:
    """The trainer's end: owns the descriptor and appends parts."""

    def __init__(self) -> None:
        occupy_standard_streams()  # The arena is the first descriptor of a group.
        self.descriptor = _nameless_file()
        self._size = 0

    def append(self, size: int) -> int:
        """Reserve `size` zeroed bytes and return their offset."""
        offset = self._size
        self._size += -(-max(size, 1) // mmap.ALLOCATIONGRANULARITY) * mmap.ALLOCATIONGRANULARITY
        os.ftruncate(self.descriptor, self._size)
        return offset

    def map(self, offset: int, size: int) -> memoryview:
        """Map a part, as `map_shared` does."""
        return map_shared(self.descriptor, offset, size)

    def close(self) -> None:
        """Close the descriptor; mapped parts stay mapped."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1
