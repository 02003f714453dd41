"""``unlucky_clients.py ADDRESS COUNT FOLDER SEED``: clients that are killed and stopped at random.

They are named c0, c1, …, and each appends the number of every step that it executes to a file of
its name in FOLDER. One that was killed is started again; one that ends by itself is a failure. All
end with the standard input.
"""

from __future__ import annotations

import os
import random
import select
import signal
import sys
import time
import traceback
from pathlib import Path

from remote.recording import HEARTBEAT, RecordingEnv

from rlightning_aio.remote import RemoteEnvClient


def started(address: str, k: int, folder: str) -> int:
    """Fork a client; return its pid."""
    pid = os.fork()
    if pid:
        return pid
    try:
        env = RecordingEnv(k, Path(folder, f"c{k}"))
        env.stays = True
        with RemoteEnvClient(env, address, name=f"c{k}") as client:
            client.run()
    except BaseException:  # noqa: BLE001  # This process ends here.
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(1)


def ended(pid: int) -> bool:
    """Kill a client; return True if it had ended by itself."""
    os.kill(pid, signal.SIGKILL)
    return os.waitpid(pid, 0)[1] != signal.SIGKILL


def main(address: str, count: int, folder: str, seed: int) -> None:
    chance = random.Random(seed)
    pids = {k: started(address, k, folder) for k in range(count)}
    stopped: list[tuple[float, int]] = []
    tally, failed = {"killed": 0, "stopped": 0}, 0
    while not select.select([sys.stdin], [], [], chance.expovariate(max(4, count / 4)))[0]:
        now, k = time.monotonic(), chance.randrange(count)
        for until, pid in stopped:
            if until <= now and pid in pids.values():
                os.kill(pid, signal.SIGCONT)
        stopped = [one for one in stopped if one[0] > now]
        if chance.random() < 0.5:
            tally["killed"] += 1
            failed += ended(pids[k])
            pids[k] = started(address, k, folder)
        else:
            tally["stopped"] += 1
            os.kill(pids[k], signal.SIGSTOP)
            stopped.append((now + chance.uniform(0, 3 * HEARTBEAT), pids[k]))
    failed += sum(map(ended, pids.values()))
    sys.stdout.write(repr(tally))
    sys.exit(failed)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
