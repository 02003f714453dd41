"""What commands keep for the process they run in is made before tests count descriptors."""

from __future__ import annotations

import multiprocessing
import sys

import pytest
import uvloop

# libuv keeps a pipe for signals from its first loop to the end of the process.
uvloop.new_event_loop().close()
# And multiprocessing the memory that Gymnasium's AsyncVectorEnv shares with its processes.
multiprocessing.RawArray("b", 1)


@pytest.fixture(autouse=True)
def path_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command adds the working folder to the path of its process."""
    monkeypatch.setattr(sys, "path", list(sys.path))
