"""The memory of processes, as the trainer, workers and actors ask for it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

_PAGE_MB: Final = os.sysconf("SC_PAGE_SIZE") / 1e6


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process and its descendants in MB; 0 if it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        children = [
            int(child)
            for thread in Path(f"/proc/{pid}/task").iterdir()
            for child in (thread / "children").read_text().split()
        ]
    except (OSError, ValueError):  # It has ended meanwhile, or this isn't Linux.
        return 0.0
    return pages * _PAGE_MB + sum(map(resident_mb, children))
