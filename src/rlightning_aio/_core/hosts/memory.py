"""The memory of processes, as the trainer, workers and actors ask for it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Final

_PAGE_MB: Final = os.sysconf("SC_PAGE_SIZE") / 1e6


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process and its descendants in MB; 0 if it has ended."""
    process = Path(f"/proc/{pid}")
    try:
        pages = int((process / "statm").read_text().split()[1])
        threads = [*(process / "task").iterdir()]
    except (OSError, ValueError):  # It has ended meanwhile, or this isn't Linux.
        return 0.0
    children: list[int] = []
    for thread in threads:
        with contextlib.suppress(OSError):  # A thread may have ended, too.
            children += map(int, (thread / "children").read_text().split())
    return pages * _PAGE_MB + sum(map(resident_mb, children))
