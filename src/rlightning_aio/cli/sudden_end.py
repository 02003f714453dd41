"""Says why a command has no result if an env that it steps in its own process ends that process.

Nothing in the process outlasts a crash in native code, or `os._exit`, so another process watches.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Generator

__all__ = ["explained_sudden_end"]

_WATCH: Final = """
import os, select, sys
try:
    command = os.pidfd_open(int(sys.argv[1]))
except OSError:
    sys.exit()
select.select([command, 0], [], [])
os.set_blocking(0, False)
try:
    ended_in_order = os.read(0, 1)
except BlockingIOError:
    ended_in_order = False
if not ended_in_order:
    sys.stderr.write(sys.argv[2])
"""
_MESSAGE: Final = """\
error: the process of this command ended before there was a result: it was killed, or an env that
it stepped itself crashed or called os._exit. Under `placement: process`, `rlightning-aio rollout`
measures envs in workers alone, and replaces a worker that an env ends.
"""


@contextlib.contextmanager
def explained_sudden_end() -> Generator[None]:
    """Write a message on stderr if this process ends inside, other than by an exception."""
    command = [sys.executable, "-I", "-S", "-c", _WATCH, str(os.getpid()), _MESSAGE]
    with subprocess.Popen(  # noqa: S603 - this very interpreter and a constant
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is not for it.
    ) as watcher:
        try:
            yield
        finally:
            watcher.communicate(b".")
