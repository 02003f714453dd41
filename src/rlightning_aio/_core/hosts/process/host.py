"""`ProcessHost`: the life of a worker process, and the trainer's ends of what the two share;
`ForkServerHandle`: the trainer's handle on its parent.

Requests go into shared rings, larger data into the channel (a socket pair). A worker is watched
through its channel and by the fork server, which is its parent, so no death goes unnoticed.
Left out on purpose: decisions about a death, which the supervisor makes.
"""

from __future__ import annotations

import errno
import os
import pickle
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.hosts.base import Host
from rlightning_aio._core.hosts.completion_frames import completion_in
from rlightning_aio._core.hosts.descriptors import occupy_standard_streams
from rlightning_aio._core.hosts.messages import Closed, Death, Died, Reported, WorkerPlace
from rlightning_aio._core.hosts.process import spares
from rlightning_aio._core.hosts.process.fork_messages import (
    CloseLimit,
    Exited,
    Fork,
    Forked,
    Kill,
    MessageSocket,
    NotForked,
    Preload,
    Ready,
)
from rlightning_aio._core.hosts.process.fork_server import BOOTSTRAP
from rlightning_aio._core.hosts.process.spares import RunningForkServer
from rlightning_aio._core.hosts.processes import ending, processor_ns, resident_mb
from rlightning_aio.errors import ConfigError
from rlightning_aio.protocol.entries import number_of, slot_of
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, FrameKind, FrameReader, encode
from rlightning_aio.protocol.pickling import dumped, dumped_with_code
from rlightning_aio.protocol.rings import TrainerRings, rings_size
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.arena import Arena
    from rlightning_aio._core.hosts.base import Driver, Wiring
    from rlightning_aio._core.hosts.messages import AttachOrder, StartOrder
    from rlightning_aio._core.hosts.process.fork_messages import Message
    from rlightning_aio.config import EnvConfig

_STDERR: Final = 2
_PACKAGE: Final = str(Path(__file__).parents[3])
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


class ForkServerHandle:
    """The trainer's handle on one fork server.

    Args:
        interpreter: its Python.
        env_vars: added to the environment of the trainer.
        preload: modules to import before the first fork.
        driver: of the group.
    """

    @classmethod
    def shared(cls, config: EnvConfig, wiring: Wiring) -> ForkServerHandle:
        """Return the fork server of the group for the interpreter and env_vars of an entry."""
        key = (cls, *_surroundings(config))
        fork_server = wiring.resources.get(key)
        if fork_server is None:
            preload: dict[str, None] = {}
            for other in wiring.configs:
                backend = ENVS.described(other.backend)
                if _surroundings(other) == _surroundings(config) and backend is not None:
                    preload.update(dict.fromkeys(backend.preload))
            env_vars = dict(config.env_vars)
            fork_server = cls(config.interpreter, env_vars, tuple(preload), wiring.driver)
            wiring.resources[key] = fork_server
        assert isinstance(fork_server, ForkServerHandle)
        return fork_server

    def __init__(
        self,
        interpreter: str | None,
        env_vars: dict[str, str],
        preload: tuple[str, ...],
        driver: Driver,
    ) -> None:
        self._interpreter = interpreter
        self._env_vars = env_vars
        self._preload = preload
        self._driver = driver
        self._hosts: dict[int, ProcessHost] = {}
        self._server: RunningForkServer | None = None
        self._key: spares.Key = ()
        self._ready = False
        # The group has started: a start that fails must leave no process.
        self._is_used = False
        # The reason of its exit, if that says more than the exit code.
        self._failure: str | None = None

    def fileno(self) -> int:
        """Return the descriptor of the socket to the fork server."""
        assert self._server is not None
        return self._server.messages.fileno()

    def fork(self, host: ProcessHost, channel: socket.socket, arena: Arena, order: Fork) -> None:
        """Start a worker for `host`, and first a fork server if none is running.

        Args:
            host: of the worker.
            channel: the worker's end, which is closed here.
            arena: of the group.
            order: for the fork server.
        """
        server = self._server or self._launch()
        self._hosts[order.place.host_id] = host
        self._send(server, order, channel, (arena.descriptor,))

    def _send(
        self,
        server: RunningForkServer,
        message: Message,
        given: socket.socket | None = None,
        lent: Sequence[int] = (),
    ) -> None:
        server.messages.send(message, given, lent)
        self._driver.watch_writable(self, server.messages.waiting)

    def on_writable(self) -> None:
        """Send waiting messages; a fork server reads nothing while it imports modules."""
        if self._server is not None:
            messages = self._server.messages
            messages.flush()
            self._driver.watch_writable(self, messages.waiting)

    def kill(self, host: ProcessHost, *, dump: bool) -> None:
        """Kill the worker of `host`, if it still runs."""
        if self._server is None:
            return
        if not self._ready:
            self._failure = f"it was killed while it was importing {self._imports}"
            self._server.kill()  # It hangs in an import and reads no messages.
        else:
            self._send(self._server, Kill(host.host_id, dump))

    def note_used(self, host: ProcessHost, close_seconds: float) -> None:
        """Note that the group has started, and how long the envs of `host` may take to close."""
        self._is_used = True
        if self._server is not None:
            self._send(self._server, CloseLimit(host.host_id, close_seconds))

    def destroy(self) -> None:
        """Kill the fork server itself, with its workers."""
        if self._server is not None:
            self._failure = "it didn't react to any request, and was killed"
            self._server.kill()

    @property
    def _imports(self) -> str:
        return ", ".join(self._preload) or "its modules"

    def _launch(self) -> RunningForkServer:
        self._failure = None
        self._key = (self._preload, self._interpreter, *self._env_vars.items())
        self._key += spares.inherited()
        spare = spares.take(self._key)
        self._ready = spare is not None
        server = self._server = spare or self._started()
        try:
            self._driver.watch(self)
        except BaseException:
            self._end(0.0)
            raise
        if spare is None:
            path = None if self._interpreter else list(sys.path)
            server.messages.send(Preload(path, self._preload))
        return server

    def _started(self) -> RunningForkServer:
        command = [self._interpreter or sys.executable, "-c", BOOTSTRAP, _PACKAGE]
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            process = subprocess.Popen(
                [*command, str(theirs.fileno()), str(os.getpid())],
                pass_fds=[theirs.fileno()],
                env={**os.environ, **_ONE_THREAD, **self._env_vars},
                stdin=subprocess.DEVNULL,
                # Only the trainer should react to Ctrl-C in the terminal.
                start_new_session=True,
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        return RunningForkServer(MessageSocket(ours), process)

    def on_readable(self) -> None:
        """Read messages of the fork server, and pass them to the hosts of its workers."""
        try:
            while self._server is not None and (received := self._server.messages.receive()):
                self._handle(received.message)
        except EOFError:
            self._lost()

    def _handle(self, message: Message) -> None:
        if isinstance(message, Ready):
            self._ready = message.error is None
            self._failure = message.error
        elif isinstance(message, Forked):
            self._hosts[message.host_id].pid = message.pid
        elif isinstance(message, Exited):
            host = self._hosts.pop(message.host_id)
            host.on_exit(message.exit_code, message.stderr_tail)
        elif isinstance(message, NotForked):
            host = self._hosts.pop(message.host_id)
            host.on_end(Death(f"could not be forked: {message.why}", refused=True))

    def _lost(self) -> None:
        """Handle the exit of the fork server; the kernel killed its workers."""
        hosts = list(self._hosts.values())
        self._hosts.clear()
        exit_code = self._end(0.0)
        why = self._failure
        if why is None:
            why = f"it {ending(exit_code)}"
            if not self._ready:
                why += f" while it was importing {self._imports}"
            if not self._ready and self._interpreter:
                why += f"; is {self._interpreter} a Python with the packages that workers need?"
        for host in hosts:
            host.on_end(Death(f"ended with its fork server: {why.rstrip()}", with_server=True))

    def release(self, seconds: float) -> None:
        """Keep the fork server for another group if this one had started, and it has no workers and
        is well; otherwise end it, which ends its workers within `seconds`.
        """
        server = self._server
        is_well = self._is_used and self._ready and self._failure is None and not self._hosts
        if server is None or not is_well or server.messages.waiting:
            self._end(seconds)
            return
        self._driver.unwatch(self)
        self._server = None
        spares.keep(self._key, server)

    def disown(self) -> None:
        if self._server is not None:
            self._server.disown()
            self._server = None

    def _end(self, seconds: float) -> int:
        """End it, as `release` does; return its exit code, or 0 if it wasn't running."""
        server, self._server = self._server, None
        if server is None:
            return 0
        self._driver.unwatch(self)
        return server.end(seconds)


def _surroundings(config: EnvConfig) -> tuple[object, ...]:
    return config.interpreter, tuple(sorted(config.env_vars.items()))


class ProcessHost(Host):
    """The trainer's handle on one worker process, and on its replacements.

    See `base.Host` and `Killable`.

    Attributes:
        pid: of the worker, once it is known.
        traffic: see `base.Killable.traffic`.
    """

    on_bell = True

    def __init__(self, host_id: int, first_slot: int, order: StartOrder, wiring: Wiring) -> None:
        self.host_id = host_id
        self.first_slot = first_slot
        self.num_envs = len(order.worker_indices)
        self.pid: int | None = None
        self._start_payload = dumped_with_code(order)
        self._fork_server = ForkServerHandle.shared(order.config, wiring)
        self._wiring = wiring
        rings_offset = wiring.arena.append(rings_size(self.num_envs))
        self._place = WorkerPlace(
            host_id,
            wiring.num_hosts,
            first_slot,
            self.num_envs,
            wiring.bell_offset,
            rings_offset,
        )
        self._is_replacement = False
        self._memory: memoryview | None = None
        # Of the worker that lives. Its channel may end before it does.
        self._rings: TrainerRings | None = None
        self._socket: socket.socket | None = None
        self._frames = FrameReader()
        self._outgoing = bytearray()
        self._frames_outgoing = 0
        # What its envs raised when it closed.
        self._close_errors: list[tuple[int, ErrorText]] | None = None
        self._closing = False
        self._killed = ""
        self.traffic = 0

    # -- life ---------------------------------------------------------------------

    def start(self) -> None:
        """Fork a worker (a new one, after a death) and send it the order to build its envs."""
        self._closing = False
        self._killed = ""
        ours, theirs = _new_channel()
        try:
            ours.setblocking(False)
            self._open(ours)
            self._fork_server.fork(self, theirs, self._wiring.arena, Fork(self._place))
        except BaseException:
            # The supervisor may try again, when there are descriptors.
            self.release()
            ours.close()
            theirs.close()
            raise
        self._send(FrameKind.START, int(self._is_replacement), self._start_payload)

    def _open(self, channel: socket.socket) -> None:
        """Clear the rings and use a new channel, for the next worker."""
        wiring = self._wiring
        if self._memory is None:
            self._memory = wiring.arena.map(self._place.rings_offset, rings_size(self.num_envs))
        self._rings = TrainerRings(self._memory, self.num_envs, wiring.bell, self.host_id)
        self._socket, self._frames = channel, FrameReader()
        self._close_errors = None
        wiring.rings[self.host_id] = self._rings.ring(self._wake)
        wiring.driver.watch(self)

    def attach(self, order: AttachOrder) -> None:
        self._is_replacement = True  # Whatever comes next.
        self._fork_server.note_used(self, order.close_seconds)
        self._send(FrameKind.ATTACH, payload=pickle.dumps(order))

    def kill(self, *, dump: bool) -> None:
        self._killed = "did not close in time and was killed" if self._closing else ""
        self._fork_server.kill(self, dump=dump)

    def destroy(self) -> None:
        self._fork_server.destroy()

    def close(self) -> None:
        self._closing = True
        if self._rings is not None:
            self._send(FrameKind.CLOSE)
        else:
            self._wiring.completions.append(Closed(self.host_id, []))

    def release(self) -> None:
        self._part()
        self._memory = None

    def _part(self) -> None:
        """Take the rings away, and close the channel; what is unread or unsent is lost."""
        if self._rings is not None:
            self._wiring.rings[self.host_id] = self._rings = None
        self._outgoing, self._frames_outgoing = bytearray(), 0
        self._close_channel()

    def _close_channel(self) -> None:
        if self._socket is not None:
            self._wiring.driver.unwatch(self)
            self._socket.close()
            self._socket = None

    def on_exit(self, exit_code: int, stderr_tail: str) -> None:
        """Handle the exit of the worker; read its pending output first."""
        self.on_readable()
        by_us = self._killed and exit_code == -signal.SIGKILL
        cause = self._killed if by_us else ending(exit_code)
        self.on_end(Death(cause, exit_code, stderr_tail))

    def on_end(self, death: Death) -> None:
        """Handle the end of the worker; its requests are added here."""
        rings, post = self._rings, self._wiring.completions.append
        if rings is None:
            return
        self.poll()
        requests = (rings.current()[0], *rings.last_requests())
        self._part()
        self.pid = None
        if not self._closing:
            post(Died(self.host_id, replace(death, requests=requests)))
            return
        errors = self._close_errors
        if errors is None:
            # Before that env it has closed all others, unless it was in a request.
            is_closing = requests[0] and not number_of(requests[0])
            first = slot_of(requests[0]) - self.first_slot if is_closing else 0
            text = ErrorText("WorkerDied", f"its worker {death.cause}", death.stderr_tail)
            errors = [(index, text) for index in range(first, self.num_envs)]
        post(Closed(self.host_id, errors))

    # -- requests -----------------------------------------------------------------

    def packed(self, arguments: Any) -> bytes:
        return dumped(arguments, "it")

    def submit(self, entries: NDArray[np.int64], arguments: Sequence[bytes] | None = None) -> None:
        if self._rings is None:
            return
        if arguments is None:
            if self._rings.request(entries):
                self._wake()
            return
        frames = [
            encode(FrameKind.REQUEST, entry, packed)
            for entry, packed in zip(entries.tolist(), arguments, strict=True)
        ]
        self._frames_outgoing += len(frames)
        self._write(b"".join(frames))

    def abort(self, entries: NDArray[np.int64]) -> None:
        """See `base.Host.abort`. A worker only reads this between requests, if its envs block."""
        for entry in entries.tolist():
            self._send(FrameKind.ABORT, entry)

    def stop(self, index: int, number: int) -> None:
        if self._rings is not None:
            self._rings.stop(index, number)

    def _wake(self) -> None:
        """Wake the sleeping worker: its ring has requests."""
        if self._socket is None or self._outgoing:
            self._write(BELL)
            return
        try:
            self._socket.send(BELL)  # Few enough bytes to be sent whole or not at all.
        except OSError:
            self._write(BELL)

    def _send(self, kind: FrameKind, number: int = 0, payload: bytes = b"") -> None:
        """Send a frame, now or when the channel has room; drop it if there is no worker."""
        if self._rings is not None:
            self._frames_outgoing += 1
            self._write(encode(kind, number, payload))

    def _write(self, data: bytes) -> None:
        if self._outgoing:
            self._outgoing += data
            return
        sent = self._write_some(data)
        if sent < len(data):
            self._outgoing += data[sent:]
            self._wiring.driver.watch_writable(self, True)
        elif self._frames_outgoing:
            self._all_written()

    def _write_some(self, data: bytes | bytearray) -> int:
        if self._socket is None:
            return len(data)
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except (BrokenPipeError, ConnectionResetError):
            # The worker is gone; the fork server will report its exit.
            return len(data)
        except OSError as error:
            if error.errno not in (errno.ENOBUFS, errno.ENOMEM):
                raise
            return 0

    def on_writable(self) -> None:
        sent = self._write_some(self._outgoing)
        del self._outgoing[:sent]
        self.traffic += sent
        if not self._outgoing:
            self._wiring.driver.watch_writable(self, False)
            self._all_written()

    def _all_written(self) -> None:
        # Only now: a worker expects a counted frame to be complete.
        assert self._rings is not None
        while self._frames_outgoing:
            self._frames_outgoing -= 1
            self._rings.count_frame()

    # -- replies ------------------------------------------------------------------

    def fileno(self) -> int:
        """Return the descriptor of the channel."""
        assert self._socket is not None
        return self._socket.fileno()

    def on_readable(self) -> None:
        """Read all frames. Reports come by `poll`, from the rings of all workers."""
        while self._socket is not None and self._rings is not None:
            try:
                data = self._socket.recv(CHUNK_BYTES)
            except BlockingIOError:
                return
            except ConnectionResetError:
                data = b""
            if not data:
                # The fork server keeps the other end open until it has handled the exit, and it
                # reports the cause. Until that is read, the ring takes further requests.
                self._close_channel()
                return
            self.traffic += len(data)
            if data == BELL and self._frames.is_empty:
                return
            for frame in self._frames.feed(data):
                self._rings.frame_seen()
                completion = completion_in(self.host_id, frame)
                if isinstance(completion, Closed):  # Posted when the worker has ended.
                    self._close_errors = completion.errors
                else:
                    self._wiring.completions.append(completion)
            if len(data) < CHUNK_BYTES:
                return

    def poll(self) -> None:
        if self._rings is None:
            return
        entries = self._rings.reports()
        if len(entries):
            # Frames that were sent before these reports come first.
            if self._rings.has_frame():
                self.on_readable()
            self._wiring.completions.append(Reported(self.host_id, entries))

    def catch_up(self) -> bool:
        posted, traffic = len(self._wiring.completions), self.traffic
        self._fork_server.on_readable()
        if self._outgoing:
            self.on_writable()
        self.on_readable()
        self.poll()
        return (len(self._wiring.completions), self.traffic) != (posted, traffic)

    # -- the state of the worker ------------------------------------------------------

    def current_request(self) -> tuple[int, int]:
        return (0, 0) if self._rings is None else self._rings.current()

    def resident_mb(self) -> float:
        return 0.0 if self.pid is None else resident_mb(self.pid)

    def processor_ns(self) -> int | None:
        return None if self.pid is None else processor_ns(self.pid)


def check_system(config: EnvConfig) -> None:
    """Check that worker processes can run on this system.

    Raises:
        ConfigError: it is not Linux.
    """
    if sys.platform != "linux":
        raise ConfigError(
            f"entry {config.name!r}: worker processes (placement: process) need Linux, and this is "
            f"{sys.platform}. Here, use placement: inline (the envs live in this process), "
            "placement: loop (awaitable envs, in the asynchronous group) or backend: env_server "
            "(envs elsewhere connect); make_vec steps MuJoCo's tasks in one batch in this process"
        )


def _new_channel() -> tuple[socket.socket, socket.socket]:
    """Make a pair of sockets, neither of which takes the place of a standard stream."""
    ours, theirs = socket.socketpair()
    if min(ours.fileno(), theirs.fileno()) > _STDERR:
        return ours, theirs
    ours.close()
    theirs.close()
    occupy_standard_streams()  # The program has closed some since the group was built.
    return socket.socketpair()
