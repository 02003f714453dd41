"""The memory of processes, whose threads come and go."""

from __future__ import annotations

import os
import subprocess
import sys
from threading import Event, Thread

from rlightning_aio._core.hosts.processes import resident_mb


def test_a_thread_that_ends_meanwhile_hides_no_memory() -> None:
    is_over = Event()

    def come_and_go() -> None:
        while not is_over.is_set():
            thread = Thread(target=lambda: None)
            thread.start()
            thread.join()

    threads = [Thread(target=come_and_go) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        assert all(resident_mb(os.getpid()) > 0 for _ in range(500))
    finally:
        is_over.set()
        for thread in threads:
            thread.join()


def test_a_process_that_has_ended_has_none() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    assert resident_mb(process.pid) == 0
