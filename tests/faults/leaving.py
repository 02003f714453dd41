"""Envs that leave something to the end of their worker, and envs that start processes."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import tempfile
import time
from typing import TYPE_CHECKING, Any

from kit.scripted import Counts

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

ABORT, HANG, SLEEP, EXIT = range(4)


class Leaving(Counts):
    """It never closes what it has opened, and refers to itself.

    Args:
        folder: where its files are.
    """

    def __init__(self, folder: Path) -> None:
        self.itself = self
        self.log = (folder / "log").open("w")
        self.log.write("what it has to say")
        self.scratch = tempfile.TemporaryDirectory(dir=folder)
        self.daemon = multiprocessing.Process(target=time.sleep, args=(1e6,), daemon=True)
        self.daemon.start()

    def told(self) -> dict[str, Any]:
        return {"started": [self.daemon.pid]}


class Starting(Counts):
    """It has started a browser, so to speak: in a session of its own, with a process below it, and
    in the background of a shell that has ended.

    Args:
        environment: of what it has started, in addition.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        script = "sleep 1000000 & echo $! $$; wait"
        browser = subprocess.Popen(
            ["sh", "-c", script],
            start_new_session=True,
            stdout=subprocess.PIPE,
            env={**os.environ, **(environment or {})},
        )
        assert browser.stdout is not None
        script = "setsid sleep 1000000 >/dev/null 2>&1 & echo $!"
        shell = subprocess.run(["sh", "-c", script], stdout=subprocess.PIPE, check=True)
        self.started = [int(pid) for pid in (browser.stdout.readline() + shell.stdout).split()]

    def told(self) -> dict[str, Any]:
        return {"started": self.started}

    def does(self, action: Any) -> None:
        if action == ABORT:
            os.abort()
        if action == EXIT:
            os._exit(0)
        while action == HANG:
            time.sleep(1)
