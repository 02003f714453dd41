"""`ProcessHost`: the life of a worker process; `ForkServer`: the trainer's handle on its parent.

A worker is watched from two sides, its channel (see `link`) and the fork server that will
bury it, so that no death goes unnoticed.
Absent on purpose: any decision about what a death means; that is the supervisor's.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlightning_aio.hosts.fork_messages import (
    Exited,
    Fork,
    Forked,
    Hello,
    Kill,
    MessageSocket,
    Ready,
)
from rlightning_aio.hosts.fork_server import BOOTSTRAP
from rlightning_aio.hosts.link import Link
from rlightning_aio.hosts.messages import Closed, Death, Died, ErrorText, WorkerPlace
from rlightning_aio.hosts.pickling import dumped, dumped_with_code
from rlightning_aio.hosts.standard_streams import occupy_standard_streams
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
    from rlightning_aio.hosts.fork_messages import Message
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
        self._messages: MessageSocket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._ready = False
        # Why it ended, as far as that is known better than by its exit code.
        self._failure: str | None = None

    def fileno(self) -> int:
        """The socket to the fork server."""
        assert self._messages is not None
        return self._messages.fileno()

    def fork(self, host: ProcessHost, channel: socket.socket, arena: Arena, order: Fork) -> None:
        """Start a worker for `host`; starts the fork server first if it isn't running.

        It takes `channel`, the worker's end.
        """
        messages = self._messages or self._launch()
        self._hosts[order.place.host_id] = host
        messages.send(order, channel, (arena.descriptor,))
        self._watcher.watch_writable(self, messages.waiting)

    def on_writable(self) -> None:
        """Send what waits; a fork server that is importing reads nothing for a while."""
        if self._messages is not None:
            self._messages.flush()
            self._watcher.watch_writable(self, self._messages.waiting)

    def kill(self, host: ProcessHost, *, dump: bool) -> None:
        """Kill the worker of `host`, if it is still there."""
        if not self._ready and self._process is not None:
            self._failure = f"it was killed while it was importing {self._imports}"
            self._process.kill()  # It hangs in an import, and obeys nobody.
        elif self._messages is not None:
            self._messages.send(Kill(host.host_id, dump))
            self._watcher.watch_writable(self, self._messages.waiting)

    def destroy(self) -> None:
        """Kill the fork server itself; the kernel then kills its workers."""
        if self._process is not None:
            self._failure = "it didn't react to any request, and was killed"
            self._process.kill()

    @property
    def _imports(self) -> str:
        return ", ".join(self._preload) or "its modules"

    def _launch(self) -> MessageSocket:
        self._ready = False
        self._failure = None
        package = str(Path(__file__).parents[1])
        command = [self._interpreter or sys.executable, "-c", BOOTSTRAP, package]
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
        messages = self._messages = MessageSocket(ours)
        try:
            self._watcher.watch(self)
        except BaseException:
            self._end(0.0)
            raise
        path = None if self._interpreter else list(sys.path)
        messages.send(Hello(path, self._preload))
        return messages

    def on_readable(self) -> None:
        """Pass on what the fork server tells of its workers."""
        try:
            while self._messages is not None and (received := self._messages.receive()) is not None:
                self._heard(received.message)
        except EOFError:
            self._lost()

    def _heard(self, message: Message) -> None:
        if isinstance(message, Ready):
            self._ready = message.error is None
            self._failure = message.error
        elif isinstance(message, Forked):
            self._hosts[message.host_id].pid = message.pid
        elif isinstance(message, Exited):
            host = self._hosts.pop(message.host_id)
            host.on_exit(message.exit_code, message.stderr_tail)

    def _lost(self) -> None:
        """The fork server is gone, and by the kernel's care so are its workers."""
        hosts = list(self._hosts.values())
        self._hosts.clear()
        exit_code = self._end(0.0)
        why = self._failure
        if why is None:
            why = f"it {_ending(exit_code)}"
            if not self._ready:
                why += f" while it was importing {self._imports}"
            if not self._ready and self._interpreter:
                why += f"; is {self._interpreter} a Python with the packages that workers need?"
        for host in hosts:
            host.on_fork_server_lost(why.rstrip())

    def release(self, seconds: float) -> None:
        """Let the fork server go; it ends what workers it still has, within `seconds`."""
        self._end(seconds)

    def disown(self) -> None:
        """See `base.Shared.disown`."""
        if self._messages is not None:
            self._messages.close()
            self._messages = None
        if self._process is not None:
            self._process.returncode = 0  # Another process's child, of which nobody is to warn.
            self._process = None

    def _end(self, seconds: float) -> int:
        """See `release`; its exit code, 0 if there was none."""
        if self._messages is not None:
            self._watcher.unwatch(self)
            self._messages.close()
            self._messages = None
        process, self._process = self._process, None
        if process is None:
            return 0
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()  # The kernel then kills its workers.
            return process.wait()


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
        occupy_standard_streams()  # A program may have closed them since.
        ours, theirs = socket.socketpair()
        try:
            ours.setblocking(False)
            self._link = Link(self._place, self._wiring, ours)
            self._fork_server.fork(self, theirs, self._wiring.arena, Fork(self._place))
        except BaseException:
            # Another attempt may follow, when there are descriptors again.
            self.release()
            ours.close()
            theirs.close()
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

    def destroy(self) -> None:
        """See `base.Killable.destroy`."""
        self._fork_server.destroy()

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

    @property
    def traffic(self) -> int:
        """See `base.Killable.traffic`."""
        return 0 if self._link is None else self._link.traffic

    def catch_up(self) -> bool:
        """See `base.Killable.catch_up`."""
        told, traffic = len(self._wiring.completions), self.traffic
        self._fork_server.on_readable()
        if self._link is not None:
            self._link.catch_up()
        return (len(self._wiring.completions), self.traffic) != (told, traffic)


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
