"""How long the threads of a process have run, and waited for a core, from the kernel's accounts."""

from __future__ import annotations

from pathlib import Path

__all__ = ["processor_times"]


def processor_times(pid: int) -> tuple[int, int] | None:
    """Return the ns for which the living threads of a process have run, and have waited for a core.

    None if the process has ended, or the kernel keeps no such accounts.
    """
    ran = queued = 0
    try:
        for accounts in Path(f"/proc/{pid}/task").glob("*/schedstat"):
            on_core, in_queue, _ = accounts.read_text().split()
            ran += int(on_core)
            queued += int(in_queue)
    except (OSError, ValueError):
        return None  # A thread has ended meanwhile, or the accounts have another form.
    return (ran, queued) if ran else None
