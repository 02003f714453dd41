"""Processes of groups: what their ids are, how they end or stop, what they have sent."""

from __future__ import annotations

import os
import select
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

from patience import HANG

from rlightning_aio._core.hosts.process.host import ForkServerHandle

if TYPE_CHECKING:
    from kit.driven import Driven


def pid_of(group: Driven, env_id: str) -> int:
    """Return the process id of an env's worker."""
    return group.call(env_id, "returns", os.getpid)


def kill(pid: int) -> None:
    """Kill a process; return when it is dead."""
    descriptor = os.pidfd_open(pid)
    try:
        signal.pidfd_send_signal(descriptor, signal.SIGKILL)
        assert select.select([descriptor], [], [], HANG)[0], "the process is still alive"
    finally:
        os.close(descriptor)


def stop(pid: int) -> None:
    """Stop a process; return when it has stopped, which may take a moment on another core."""
    os.kill(pid, signal.SIGSTOP)
    while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "T":
        os.sched_yield()


def fork_server_pid(group: Any) -> int:
    """Return the process id of the only fork server of a group, which no public name gives."""
    shared = group._core.tables.resources.values()
    (server,) = (one for one in shared if isinstance(one, ForkServerHandle))
    return server._server.process.pid


def wait_for_reply(group: Any, worker: int) -> None:
    """Wait until a worker's next reply has begun to fill its channel; nobody reads it here, as all
    that is public would.
    """
    host = group._core.supervisor.hosts[worker]
    assert select.select([host.fileno()], [], [], HANG)[0]
