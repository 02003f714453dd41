"""``client_processes.py ADDRESS COUNT TASK [KEYS]``: runs COUNT clients, named c0, c1, …

It imports their modules once and forks them. It prints their pids and ends with them.
"""

from __future__ import annotations

import os
import signal
import sys
import time

from rlightning_aio.config import EnvConfig
from rlightning_aio.envs.simulators.gymnasium import GymnasiumEnv
from rlightning_aio.remote import RemoteEnvClient


def serve(address: str, name: str, task: str, keys: str | None) -> None:
    env = GymnasiumEnv(EnvConfig(name="env", backend="gymnasium", task=task))
    with RemoteEnvClient(env, address, name=name, keys=keys) as client:
        client.run()


def main(address: str, count: int, task: str, keys: str | None = None) -> None:
    children: list[int] = []
    for k in range(count):
        pid = os.fork()
        if not pid:
            # The program that started this one may be killed.
            try:
                serve(address, f"c{k}", task, keys)
            finally:
                os._exit(0)
        children.append(pid)
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()

    def end(*_: object) -> None:
        for pid in children:
            os.kill(pid, signal.SIGKILL)
        for pid in children:
            os.waitpid(pid, 0)
        os._exit(0)

    signal.signal(signal.SIGTERM, end)
    while os.getppid() != 1:
        time.sleep(0.2)
    end()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
