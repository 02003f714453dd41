"""Processes and their resources, observed from outside through /proc and descriptors."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import threading
from pathlib import Path

from harness import shared_memory


class Processes:
    """Other processes, held by descriptors, so that a reused number can't be hit."""

    def __init__(self) -> None:
        self._held: dict[int, int] = {}
        self._lock = threading.RLock()

    def hold(self, pid: int, parent: int) -> None:
        """Keep a descriptor of this process, if it is still that parent's child."""
        if pid in self._held:
            return
        with self._lock, contextlib.suppress(ProcessLookupError, FileNotFoundError):
            descriptor = os.pidfd_open(pid)
            try:
                stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                if int(stat[1]) == parent:
                    self._held[pid], descriptor = descriptor, -1
            finally:
                if descriptor >= 0:
                    os.close(descriptor)

    def signal(self, pid: int, number: int) -> bool:
        """Send a signal to it; return True if it existed."""
        with self._lock:
            descriptor = self._held.get(pid)
            if descriptor is None:
                return False
            try:
                signal.pidfd_send_signal(descriptor, number)
            except ProcessLookupError:
                self.forget(pid)
                return False
            return True

    def forget(self, pid: int) -> None:
        """Drop a process that is gone."""
        with self._lock:
            descriptor = self._held.pop(pid, None)
            if descriptor is not None:
                os.close(descriptor)

    def close(self) -> None:
        """Close all descriptors."""
        for pid in list(self._held):
            self.forget(pid)


def processes_marked(text: str) -> list[int]:
    """Return the processes that were started with `text` in their environment."""
    wanted, found = text.encode(), []
    for path in Path("/proc").iterdir():
        if path.name.isdigit() and int(path.name) != os.getpid():
            with contextlib.suppress(OSError):
                if wanted in (path / "environ").read_bytes():
                    found.append(int(path.name))
    return found


def process_state(pid: int) -> str:
    """Describe a process."""
    with contextlib.suppress(OSError):
        folder = Path(f"/proc/{pid}")
        state = (folder / "stat").read_text().rpartition(")")[2].split()[:2]
        command = (folder / "cmdline").read_bytes().replace(b"\0", b" ")[:60]
        return f"process {pid} (state {state[0]}, child of {state[1]}): {command!r}"
    return f"process {pid}: gone"


def resources() -> dict[str, float]:
    """Return the numbers of this process's resources."""
    status = Path("/proc/self/status").read_text()
    return {
        "rss_mib": int(status.partition("VmRSS:")[2].split()[0]) / 1024,
        "descriptors": len(list(Path("/proc/self/fd").iterdir())),
        "threads": threading.active_count(),
        "maps": Path("/proc/self/maps").read_text().count("\n"),
    }


def processor_seconds() -> float:
    """Return the processor time of this process and its finished children."""
    found = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in found)


def held() -> set[str]:
    """Return the child processes, descriptors, threads and shared memory of this process."""
    children = {
        f"process {pid}"
        for path in Path("/proc/self/task").glob("*/children")
        for pid in path.read_text().split()
    }
    descriptors: set[str] = set()
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # The descriptor of the listing itself.
            descriptors.add(f"descriptor {path.name}: {path.readlink()}")
    maps = {
        f"map {line}"
        for line in Path("/proc/self/maps").read_text().splitlines()
        if "memfd:" in line or "/dev/shm" in line
    }
    threads = {f"thread {thread.name}" for thread in threading.enumerate()}
    return children | descriptors | maps | threads | {f"shared {n}" for n in shared_memory()}
