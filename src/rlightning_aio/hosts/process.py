"""`ProcessHost`: the life of a worker process; `ForkServer`: the trainer's handle on its parent.

A worker is watched from two sides, its channel (see `link`) and the fork server that will
bury it, so that no death goes unnoticed.
Absent on purpose: any decision about what a death means; that is the supervisor's.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.fork_server import BOOTSTRAP, Exited, Fork, Forked, Hello, Kill, Ready
from rlightning_aio.hosts.link import Link
from rlightning_aio.hosts.messages import Closed, Death, Died, ErrorText, WorkerPlace
from rlightning_aio.hosts.pickling import dumped, dumped_with_code
from rlightning_aio.protocol.entries import slot_of
from rlightning_aio.protocol.frames import FrameKind
from rlightning_aio.protocol.rings import rings_size
from rlightning_aio.registry import BACKENDS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.hosts.arena import Arena
    from rlightning_aio.hosts.base import Watcher, Wiring
    from rlightning_aio.hosts.messages import AttachOrder, StartOrder

__all__ = ["ForkServer", "ProcessHost"]

_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)


class ForkServer:
    """The trainer's handle on one fork server.

    Args:
        interpreter: its Python.
        env_vars: added to the environment of the trainer.
        preload: modules to import before the first fork.
        watcher: the driver.
    """

    @classmethod
    def shared(cls, config: EnvConfig, wiring: Wiring) -> ForkServer:
        """The group's fork server for the interpreter and the environment of an entry."""
        key = (cls, *_surroundings(config))
        fork_server = wiring.resources.get(key)
        if fork_server is None:
            preload: dict[str, None] = {}
            for other in wiring.configs:
                backend = BACKENDS.get(other.backend)
                if _surroundings(other) == _surroundings(config) and backend is not None:
                    preload.update(dict.fromkeys(backend.preload))
            env_vars = dict(config.env_vars)
            fork_server = cls(config.interpreter, env_vars, tuple(preload), wiring.watcher)
            wiring.resources[key] = fork_server
        assert isinstance(fork_server, ForkServer)
        return fork_server

    def __init__(
        self,
        interpreter: str | None,
        env_vars: dict[str, str],
        preload: tuple[str, ...],
        watcher: Watcher,
    ) -> None:
        self._interpreter = interpreter
        self._env_vars = env_vars
        self._preload = preload
        self._watcher = watcher
        self._hosts: dict[int, ProcessHost] = {}
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: deque[tuple[Fork, socket.socket, int]] = deque()
        self._ready = False

    def fileno(self) -> int:
        """The socket to the fork server."""
        assert self._socket is not None
        return self._socket.fileno()

    def fork(self, host: ProcessHost, channel: socket.socket, arena: Arena, order: Fork) -> None:
        """Start a worker for `host`; starts the fork server first if it isn't running.

        It takes `channel`, the worker's end.
        """
        if self._socket is None:
            self._launch()
        self._hosts[order.place.host_id] = host
        self._orders.append((order, channel, arena.descriptor))
        if len(self._orders) == 1:
            self.on_writable()

    def on_writable(self) -> None:
        """Send the orders that wait; a fork server that is importing reads none for a while."""
        assert self._socket is not None
        while self._orders:
            order, channel, arena = self._orders[0]
            try:
                socket.send_fds(
                    self._socket,
                    [pickle.dumps(order)],
                    [channel.fileno(), arena],
                    socket.MSG_DONTWAIT,
                )
            except BlockingIOError:
                break
            except (BrokenPipeError, ConnectionResetError):
                return  # `on_readable` hears of it, too.
            channel.close()
            self._orders.popleft()
        self._watcher.watch_writable(self, bool(self._orders))

    def kill(self, host: ProcessHost, *, dump: bool) -> None:
        """Kill the worker of `host`, if it is still there."""
        if not self._ready and self._process is not None:
            self._process.kill()  # It hangs in an import, and obeys nobody.
        elif self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.send(pickle.dumps(Kill(host.host_id, dump)))

    def _launch(self) -> None:
        self._ready = False
        modules = ", ".join(self._preload) or "its modules"
        self._failure = f"it ended while it was importing {modules}"
        package = str(Path(__file__).parents[1])
        command = [self._interpreter or sys.executable, "-P", "-c", BOOTSTRAP, package]
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self._process = subprocess.Popen(
                [*command, str(theirs.fileno()), str(os.getpid())],
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_ONE_THREAD, **self._env_vars},
                stdin=subprocess.DEVNULL,
                # Ctrl-C in the terminal is the trainer's business alone.
                start_new_session=True,
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        path = None if self._interpreter else list(sys.path)
        ours.send(pickle.dumps(Hello(path, self._preload)))
        self._socket = ours
        self._watcher.watch(self)

    def on_readable(self) -> None:
        """Pass on what the fork server tells of its workers."""
        assert self._socket is not None
        while True:
            try:
                data = self._socket.recv(1 << 16, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            if not data:
                self._lost()
                return
            self._heard(data)

    def _heard(self, data: bytes) -> None:
        if data.startswith(b"!"):
            self._failure = data[1:].decode(errors="replace")
            return
        message = pickle.loads(data)
        if isinstance(message, Ready):
            self._ready = True
            self._failure = message.error or "it was killed, or it crashed"
        elif isinstance(message, Forked):
            self._hosts[message.host_id].pid = message.pid
        elif isinstance(message, Exited):
            host = self._hosts.pop(message.host_id)
            host.on_exit(message.exit_code, message.stderr_tail)

    def _lost(self) -> None:
        """The fork server is gone, and by the kernel's care so are its workers."""
        hosts = list(self._hosts.values())
        self._hosts.clear()
        self.release(0.0)
        for host in hosts:
            host.on_fork_server_lost(self._failure)

    def release(self, seconds: float) -> None:
        """Let the fork server go; it ends what workers it still has, within `seconds`."""
        if self._socket is None:
            return
        self._watcher.unwatch(self)
        self._socket.close()
        self._socket = None
        while self._orders:
            self._orders.popleft()[1].close()
        if self._process is not None:
            try:
                self._process.wait(seconds)
            except subprocess.TimeoutExpired:
                self._process.kill()  # The kernel then kills its workers.
                self._process.wait()
            self._process = None


def _surroundings(config: EnvConfig) -> tuple[object, ...]:
    return config.interpreter, tuple(sorted(config.env_vars.items()))


class ProcessHost:
    """The trainer's handle on one worker process; see `base.Host`, `Killable` and `Polled`."""

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self.pid: int | None = None
        self._start_payload = dumped_with_code(order)
        self._fork_server = ForkServer.shared(order.config, wiring)
        self._wiring = wiring
        self._place = WorkerPlace(
            host_id,
            wiring.num_hosts,
            first_slot,
            self.num_envs,
            wiring.bell_offset,
            wiring.arena.append(rings_size(self.num_envs)),
        )
        self._link: Link | None = None
        self._alive = False
        self._closing = False
        self._killed = ""

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Fork a worker (a new one, after a death) and tell it what to build."""
        self._closing = False
        self._killed = ""
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._link = Link(self._place, self._wiring, ours)
        try:
            self._fork_server.fork(self, theirs, self._wiring.arena, Fork(self._place))
        except BaseException:
            theirs.close()
            self._link.hang_up()
            raise
        self._alive = True
        self._link.send(FrameKind.START, payload=self._start_payload)

    def attach(self, order: AttachOrder) -> None:
        """See `base.Host.attach`."""
        if self._link is not None:
            self._link.send(FrameKind.ATTACH, payload=pickle.dumps(order))

    def kill(self, *, dump: bool) -> None:
        """See `base.Killable.kill`."""
        self._killed = "did not close in time and was killed" if self._closing else ""
        self._fork_server.kill(self, dump=dump)

    def close(self) -> None:
        """See `base.Host.close`."""
        self._closing = True
        if self._alive and self._link is not None:
            self._link.send(FrameKind.CLOSE)
        else:
            self._wiring.completions.append(Closed(self.host_id, []))

    def release(self) -> None:
        """See `base.Host.release`."""
        self._alive = False
        if self._link is not None:
            self._link.hang_up()
            self._link = None

    def on_exit(self, exit_code: int, stderr_tail: str) -> None:
        """The worker has ended; whatever it still said is heard first."""
        if self._link is not None:
            self._link.read_channel()
        by_us = self._killed and exit_code == -signal.SIGKILL
        self._ended(self._killed if by_us else _ending(exit_code), exit_code, stderr_tail)

    def on_fork_server_lost(self, why: str) -> None:
        """The worker ended with its fork server."""
        self._ended(f"ended with its fork server: {why}", None, "")

    def _ended(self, cause: str, exit_code: int | None, stderr_tail: str) -> None:
        link, tell = self._link, self._wiring.completions.append
        if link is None:
            return
        link.poll()
        requests = link.last_requests()
        self.release()
        self.pid = None
        if not self._closing:
            tell(Died(self.host_id, Death(cause, exit_code, stderr_tail, requests)))
            return
        errors = link.close_errors
        if errors is None:
            index = slot_of(requests[0]) - self.first_slot if requests[0] else 0
            errors = [(index, ErrorText("WorkerDied", f"its worker {cause}", stderr_tail))]
        tell(Closed(self.host_id, errors))

    # -- requests and replies -----------------------------------------------------

    def packed(self, arguments: Any) -> bytes:
        """See `base.Host.packed`."""
        return dumped(arguments, "it")

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None = None) -> None:
        """See `base.Host.submit`."""
        if self._link is not None:
            self._link.submit(entries, arguments)

    def poll(self) -> None:
        """See `base.Polled.poll`."""
        if self._link is not None:
            self._link.poll()

    def executing(self) -> tuple[int, int]:
        """See `base.Killable.executing`."""
        return (0, 0) if self._link is None else self._link.executing()


def _ending(exit_code: int) -> str:
    if exit_code >= 0:
        return f"exited with code {exit_code}"
    try:
        name = signal.Signals(-exit_code).name
    except ValueError:
        name = f"signal {-exit_code}"
    hint = ""
    if exit_code == -signal.SIGKILL:
        hint = " (if you didn't, the kernel may have run out of memory: see dmesg)"
    return f"was killed by {name}{hint}"
