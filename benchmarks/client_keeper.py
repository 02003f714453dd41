"""``client_keeper.py``: starts env clients again whenever they end, by commands on stdin.

    keep NAME HOST PORT HEARTBEAT    start that client, and again whenever it ends
    drop NAME                        kill it for good
    flood HOST PORT SEED             open many connections at once that are no clients

It imports the clients' modules once and forks them. They end with it, and it ends with its stdin.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import random
import select
import signal
import socket
import sys
import time
from dataclasses import dataclass

import zmq
from witness import WitnessEnv

from rlightning_aio.config import EnvConfig
from rlightning_aio.remote import RemoteEnvClient

CONNECTIONS = 60
FLOOD_SECONDS = 0.3
PAUSE = 0.05
"""Seconds until a client that has ended is started again."""


@dataclass
class Kept:
    """A client: its arguments, and its process or the time of its next start."""

    name: str
    host: str
    port: int
    heartbeat: float
    pid: int = 0
    start_at: float = 0.0


def fork() -> int:
    """Like `os.fork`, but the child dies with this process and has default signal handlers."""
    pid = os.fork()
    if not pid:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        os.close(0)
        os.open(os.devnull, os.O_RDONLY)
    return pid


def serve(kept: Kept) -> None:
    """Run the client until it ends."""
    env = WitnessEnv(EnvConfig(name="client", backend="witness", task="t"), int(kept.name[1:]))
    with RemoteEnvClient(
        env, kept.host, kept.port, name=kept.name, heartbeat=kept.heartbeat
    ) as client:
        client.run()


def flood(host: str, port: int, seed: int) -> None:
    """Connect many times at once; some peers send nothing, some nonsense, some nonsense in ZMQ."""
    rng = random.Random(seed)
    held: list[socket.socket] = []
    context = zmq.Context()
    for _ in range(CONNECTIONS):
        kind = rng.randrange(3)
        if kind == 2:
            dealer = context.socket(zmq.DEALER)
            dealer.connect(f"tcp://{host}:{port}")
            for _ in range(3):
                with contextlib.suppress(zmq.ZMQError):
                    dealer.send_multipart([rng.randbytes(rng.randrange(1, 200))], zmq.NOBLOCK)
        else:
            with contextlib.suppress(OSError):
                held.append(socket.create_connection((host, port), 1.0))
                if kind:
                    held[-1].sendall(rng.randbytes(rng.randrange(1, 2000)))
    time.sleep(FLOOD_SECONDS)
    context.destroy(0)


class Keeper:
    """See the module."""

    def __init__(self) -> None:
        self._kept: dict[str, Kept] = {}
        self._wakeup, writer = socket.socketpair()
        self._wakeup.setblocking(False)
        writer.setblocking(False)
        self._writer = writer
        signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)

    def run(self) -> None:
        """Execute commands until stdin ends."""
        waiting = b""
        while True:
            self._start_due()
            starts = [kept.start_at for kept in self._kept.values() if not kept.pid]
            timeout = max(0.0, min(starts) - time.monotonic()) if starts else None
            ready = select.select([0, self._wakeup], [], [], timeout)[0]
            if self._wakeup in ready:
                with contextlib.suppress(BlockingIOError):
                    self._wakeup.recv(4096)
            self._reap()
            if 0 in ready:
                data = os.read(0, 1 << 16)
                if not data:
                    return
                *lines, waiting = (waiting + data).split(b"\n")
                for line in lines:
                    self._obey(line.decode().split())

    def _obey(self, order: list[str]) -> None:
        match order:
            case ["keep", name, host, port, heartbeat]:
                self._kept[name] = Kept(name, host, int(port), float(heartbeat))
            case ["drop", name]:
                kept = self._kept.pop(name)
                if kept.pid:
                    os.kill(kept.pid, signal.SIGKILL)
            case ["flood", host, port, seed]:
                if not fork():
                    self._end(lambda: flood(host, int(port), int(seed)))
            case _:
                raise ValueError(order)

    def _start_due(self) -> None:
        for kept in self._kept.values():
            if not kept.pid and kept.start_at <= time.monotonic():
                kept.pid = fork()
                if not kept.pid:
                    self._end(lambda kept=kept: serve(kept))

    def _end(self, what: object) -> None:
        try:
            what()  # type: ignore[operator]
        except BaseException as error:  # noqa: BLE001  # Nobody else would tell.
            sys.stderr.write(f"client {os.getpid()}: {type(error).__name__}: {error}\n")
            sys.stderr.flush()
        finally:
            os._exit(0)

    def _reap(self) -> None:
        with contextlib.suppress(ChildProcessError):
            while (pid := os.waitpid(-1, os.WNOHANG)[0]) > 0:
                for kept in self._kept.values():
                    if kept.pid == pid:
                        kept.pid, kept.start_at = 0, time.monotonic() + PAUSE


if __name__ == "__main__":
    Keeper().run()
