"""Makes what commands keep open in a process before tests count descriptors."""

from __future__ import annotations

import multiprocessing
import sys

import pytest

# Multiprocessing keeps the memory that Gymnasium's AsyncVectorEnv shares with its processes.
multiprocessing.RawArray("b", 1)


@pytest.fixture(autouse=True)
def path_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the path, to which a command adds the working directory."""
    monkeypatch.setattr(sys, "path", list(sys.path))
