"""A group under a hard limit of 200 descriptors, while another process opens connections to it.

With an argument, this program is that other process: it reads the port, then holds as many
connections as it gets until its input ends.
"""

from __future__ import annotations

import logging
import os
import resource
import signal
import socket
import subprocess
import sys

import psutil

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio._core.group.supervision.hint import LAST_LOOK
from rlightning_aio.sync import EnvGroup, build_env_group

ENTRIES = [
    {
        "name": "local",
        "backend": "gymnasium",
        "task": "CartPole-v1",
        "num_workers": 2,
        "envs_per_process": 1,
        "max_restarts": 99,
    },
    {"name": "server", "backend": "env_server", "env_kwargs": {"insecure": True}},
]
"""Two envs in workers of their own, beside an env_server."""


class Attempts(logging.Handler):
    """Counts the attempts to start a worker that failed for want of descriptors."""

    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Count one attempt."""
        self.count += "Too many open files" in record.getMessage()


def flood() -> None:
    """Hold as many connections to the port as this process gets, until its input ends."""
    port, held = int(sys.stdin.readline()), []
    os.set_blocking(sys.stdin.fileno(), False)
    while sys.stdin.buffer.raw.read(1) is None:
        connection = socket.socket()
        connection.settimeout(0.05)
        try:
            connection.connect(("127.0.0.1", port))
            held.append(connection)
        except OSError:
            connection.close()
        if len(held) > 900:  # The group ends some of them; these are replaced.
            for ended in held[:300]:
                ended.close()
            del held[:300]


def step(group: EnvGroup, ids: list[str]) -> None:
    """Send one step to each of the envs."""
    group.step_async(BatchedData(ids, [PolicyResponse(env_id, 0) for env_id in ids]))


def has_descriptors() -> bool:
    """Return True if this process can open another file."""
    try:
        os.close(os.dup(0))
    except OSError:
        return False
    return True


def main() -> None:
    """Kill a worker in the flood, end the flood after two attempts, and print the outcome."""
    attempts = Attempts()
    logging.getLogger("rlightning_aio").addHandler(attempts)
    flooder = subprocess.Popen([sys.executable, __file__, "flood"], stdin=subprocess.PIPE)
    with build_env_group(ENTRIES) as group, group.auto_reset():
        workers = [p for p in psutil.Process().children(recursive=True) if not p.children()]
        worker = max(process.pid for process in workers if process.pid != flooder.pid)
        group.reset(seed=0, env_ids=["local-0", "local-1"])
        resource.setrlimit(resource.RLIMIT_NOFILE, (200, 200))
        assert flooder.stdin is not None
        flooder.stdin.write(f"{group['server-0'].address.rsplit(':', 1)[1]}\n".encode())
        flooder.stdin.flush()
        steps = 0
        # After that many batches no more hint is looked for.
        while has_descriptors() or steps <= LAST_LOOK:
            step(group, ["local-0", "local-1"])
            assert len(group.collect_async(wait_all=True)[0]) == 2
            steps += 1
        os.kill(worker, signal.SIGKILL)
        step(group, ["local-0", "local-1"])
        steps, marked = 0, []
        while not marked:
            batch, _ = group.collect_async()
            marked = [ret.env_id for ret in batch.values() if "worker_restarted" in ret.info]
            if attempts.count >= 2 and flooder.stdin is not None:
                flooder.stdin.close()
                flooder.wait()
                flooder.stdin = None
            others = [env_id for env_id in batch.ids() if env_id not in marked]
            if others:
                steps += 1
                step(group, others)
        sys.stdout.write(f"{marked} {steps > 0} {attempts.count >= 2}\n")


if __name__ == "__main__":
    flood() if len(sys.argv) > 1 else main()
