"""`ProcessHost`: the trainer's handle on a worker process, and `ForkServer`, on its parent.

Requests go into the shared rings, larger things into the channel (a socket pair); the
worker's end is watched from two sides, its channel and the fork server that will bury
it, so that no death goes unnoticed.
Absent on purpose: any decision about what a death means; that is the core's.
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

import rlightning_aio
from rlightning_aio.hosts.arena import Arena, map_shared
from rlightning_aio.hosts.base import Death, Inbox, Watcher
from rlightning_aio.hosts.fork_server import BOOTSTRAP, Exited, Fork, Forked, Hello, Kill, Ready
from rlightning_aio.hosts.pickling import dumped, dumped_with_code
from rlightning_aio.hosts.worker import ErrorText
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, Frame, FrameKind, FrameReader, encode
from rlightning_aio.protocol.rings import TrainerRings, rings_size, slot_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio.hosts.worker import AttachOrder, StartOrder

__all__ = ["END_SECONDS", "ForkServer", "ProcessHost"]

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


END_SECONDS = 1.5
"""How long a fork server that is let go may take to end its workers and pass on their words."""


class ForkServer:
    """The trainer's handle on one fork server.

    Args:
        interpreter: its Python.
        env_vars: added to the environment of the trainer.
        preload: modules to import before the first fork.
        watcher: the driver.
    """

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
        self._hosts[order.host_id] = host
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
        package = str(Path(rlightning_aio.__file__).parent)
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


class ProcessHost:
    """The trainer's handle on one worker process; see `base.Host`."""

    def __init__(
        self,
        host_id: int,
        first_slot: int,
        order: StartOrder,
        fork_server: ForkServer,
        arena: Arena,
        inbox: Inbox,
        watcher: Watcher,
    ) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.rows = len(order.worker_indices)
        self.in_flight = 0
        self.ordered = 0
        self.elastic = False
        self.inline = False
        self.pid: int | None = None
        self._start_payload = dumped_with_code(order)
        self._fork_server = fork_server
        self._arena = arena
        self._inbox = inbox
        self._watcher = watcher
        self._rings_offset = arena.append(rings_size(self.rows))
        self._rings_memory = map_shared(arena.descriptor, self._rings_offset, rings_size(self.rows))
        self._socket: socket.socket | None = None
        self._alive = False

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Fork a worker (a new one, after a death) and tell it what to build."""
        self._rings_memory[:] = bytes(len(self._rings_memory))
        self._rings = TrainerRings(self._rings_memory, self.rows)
        self._frames = FrameReader()
        self._frames_received = 0
        self._outgoing = bytearray()
        self._frames_outgoing = 0
        self.ordered = 0
        self._closing = False
        self._hung = False
        self._killed = ""
        self._close_errors: list[tuple[int, ErrorText]] | None = None
        self.in_flight = 0
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._socket = ours
        try:
            self._fork_server.fork(
                self,
                theirs,
                self._arena,
                Fork(self.host_id, self.first_slot, self._rings_offset, self.rows),
            )
        except BaseException:
            theirs.close()
            raise
        self._alive = True
        self._watcher.watch(self)
        self._send(FrameKind.START, payload=self._start_payload)

    def attach(self, order: AttachOrder) -> None:
        """See `base.Host.attach`."""
        self._send(FrameKind.ATTACH, payload=pickle.dumps(order))

    def kill(self, *, dump: bool) -> None:
        """See `base.Host.kill`."""
        self._hung = self._hung or dump
        self._killed = "did not close in time and was killed" if self._closing else ""
        self._fork_server.kill(self, dump=dump)

    def close(self) -> None:
        """See `base.Host.close`."""
        self._closing = True
        if self._alive:
            self._send(FrameKind.CLOSE)
        else:
            self._inbox.on_closed(self, [])

    def release(self) -> None:
        """See `base.Host.release`."""
        self._hang_up()
        self.in_flight = 0
        # A mapping has a descriptor of its own, which goes with the last that refers to it.
        self._rings_memory = memoryview(bytearray(rings_size(1)))
        self._rings = TrainerRings(self._rings_memory, 1)

    def _hang_up(self) -> None:
        self._alive = False
        if self._socket is not None:
            self._watcher.unwatch(self)
            self._socket.close()
            self._socket = None

    def on_exit(self, exit_code: int, stderr_tail: str) -> None:
        """The worker has ended; whatever it still said is heard first."""
        if self._socket is not None:
            self._read_channel()
        by_us = self._killed and exit_code == -signal.SIGKILL
        self._ended(self._killed if by_us else _ending(exit_code), exit_code, stderr_tail)

    def on_fork_server_lost(self, why: str) -> None:
        """The worker ended with its fork server."""
        self._ended(f"ended with its fork server: {why}", None, "")

    def _ended(self, cause: str, exit_code: int | None, stderr_tail: str) -> None:
        self.sweep()
        self._hang_up()
        self.pid = None
        self.in_flight = 0
        current, _ = self._rings.current()
        if not self._closing:
            last = (current, *self._rings.last_requests())
            self._inbox.on_death(self, Death(cause, exit_code, stderr_tail, self._hung, last))
            return
        errors = self._close_errors
        if errors is None:
            row = slot_of(current) - self.first_slot if current else 0
            errors = [(row, ErrorText("WorkerDied", f"its worker {cause}", stderr_tail))]
        self._inbox.on_closed(self, errors)

    # -- requests -----------------------------------------------------------------

    def request(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.request`."""
        self.in_flight += len(entries)
        if self._rings.request(entries):
            self._write(BELL)

    def pack(self, content: Any) -> bytes:
        """See `base.Host.pack`."""
        return dumped(content, "it")

    def request_step(self, row: int, number: int, packed: bytes) -> None:
        """See `base.Host.request_step`."""
        self.in_flight += 1
        self._send(FrameKind.STEP, row, number, packed)

    def request_reset(self, row: int, number: int, packed: bytes) -> None:
        """See `base.Host.request_reset`."""
        self.in_flight += 1
        self._send(FrameKind.RESET, row, number, packed)

    def request_call(self, row: int, number: int, packed: bytes) -> None:
        """See `base.Host.request_call`."""
        self.in_flight += 1
        self._send(FrameKind.CALL, row, number, packed)

    def _send(self, kind: FrameKind, row: int = 0, number: int = 0, payload: bytes = b"") -> None:
        self._frames_outgoing += 1
        self._write(encode(kind, row, number, payload))

    def _write(self, data: bytes) -> None:
        if self._outgoing:
            self._outgoing += data
            return
        sent = self._write_some(data)
        if sent < len(data):
            self._outgoing += data[sent:]
            self._watcher.watch_writable(self, True)
        else:
            self._all_written()

    def _write_some(self, data: bytes | bytearray) -> int:
        if self._socket is None:
            return len(data)
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except (BrokenPipeError, ConnectionResetError):
            # The worker is gone; its end is announced by the fork server.
            return len(data)

    def on_writable(self) -> None:
        """See `base.Source.on_writable`."""
        sent = self._write_some(self._outgoing)
        del self._outgoing[:sent]
        if not self._outgoing:
            self._watcher.watch_writable(self, False)
            self._all_written()

    def _all_written(self) -> None:
        # Only now: a worker that is told of a frame expects to find all of it.
        while self._frames_outgoing:
            self._frames_outgoing -= 1
            self._rings.count_frame()

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        """The channel."""
        assert self._socket is not None
        return self._socket.fileno()

    def order(self, count: int) -> bool:
        """See `base.Host.order`."""
        if count == self.ordered:
            return False
        self.ordered = count
        if self._rings.want(count):
            self.ordered = 0  # Too late for a bell: the caller has to sweep.
            return True
        return False

    def on_readable(self) -> None:
        """See `base.Source.on_readable`."""
        self._read_channel()
        self.sweep()

    def withdraw(self) -> None:
        """See `base.Host.withdraw`."""
        if self.ordered:
            self.ordered = 0
            self._rings.forget_want()

    def unread(self) -> int:
        """See `base.Host.unread`."""
        return self._rings.unread()

    def sweep(self) -> None:
        """See `base.Host.sweep`."""
        if not self._rings.unread():
            return
        entries = self._rings.reports()
        if self._rings.frames_from_worker() > self._frames_received:
            self._read_channel()
        self.in_flight -= len(entries)
        self._inbox.on_reports(entries)

    def _read_channel(self) -> None:
        # A bell may be among what is read, and it rings once for each order.
        self.ordered = 0
        while self._socket is not None:
            try:
                data = self._socket.recv(CHUNK_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            if not data:
                # The fork server holds the other end until it has buried the worker, and
                # tells why it died; there is nothing more to hear from here.
                self._watcher.unwatch(self)
                self._socket.close()
                self._socket = None
                return
            for frame in self._frames.feed(data):
                self._frames_received += 1
                self._receive(frame)
            if len(data) < CHUNK_BYTES:
                return

    def _receive(self, frame: Frame) -> None:
        inbox, kind, row, number = self._inbox, frame.kind, frame.row, frame.number
        if kind == FrameKind.RESULT:
            self.in_flight -= 1
            inbox.on_rest(self, row, number, frame.payload)
        elif kind == FrameKind.INFO_SCHEMA:
            inbox.on_schema(self, number, pickle.loads(frame.payload))
        elif kind in (FrameKind.VALUE, FrameKind.STARTED):
            self._receive_object(kind, row, number, frame.payload)
        elif kind == FrameKind.ERROR:
            self._receive_error(row, number, pickle.loads(frame.payload))
        elif kind == FrameKind.ATTACHED:
            inbox.on_attached(self)
        elif kind == FrameKind.CLOSED:
            self._close_errors = pickle.loads(frame.payload)

    def _receive_object(self, kind: int, row: int, number: int, payload: bytes) -> None:
        """Take in an object of the user's, whose class may be unknown here."""
        try:
            received = pickle.loads(payload)
        except Exception as error:
            self._receive_error(row, number, ErrorText.of(error))
            return
        if kind == FrameKind.STARTED:
            self._inbox.on_started(self, received)
        else:
            self.in_flight -= 1
            self._inbox.on_value(self, row, number, received)

    def _receive_error(self, row: int, number: int, error: ErrorText) -> None:
        if number:
            self.in_flight -= 1
            self._inbox.on_error(self, row, number, error)
        else:
            self._inbox.on_start_error(self, row, error)

    def executing(self) -> tuple[int, int]:
        """See `base.Host.executing`."""
        return self._rings.current()

    def run_one(self) -> bool:
        """Nothing runs here."""
        return False


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
