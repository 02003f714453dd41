"""The fork server: a small process that forks workers and tells how they ended.

One runs for each combination of interpreter and environment variables. It has the
simulator's modules imported, so that a worker starts in milliseconds; it keeps the
last lines that each worker wrote to stderr; it outlives no trainer: when the trainer's
end of its socket closes, all workers are killed.
Rule: one thread whenever it forks. Nothing is built here.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import gc
import importlib
import os
import pickle
import select
import signal
import socket
import sys
import threading
import time
import traceback
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

__all__ = ["BOOTSTRAP", "DUMP_SIGNAL", "Exited", "Fork", "Forked", "Hello", "Kill", "Ready", "main"]

BOOTSTRAP: Final = """
import sys, importlib.util as u
try:
    s = u.spec_from_file_location(
        "rlightning_aio", sys.argv[1] + "/__init__.py", submodule_search_locations=[sys.argv[1]])
    m = sys.modules["rlightning_aio"] = u.module_from_spec(s)
    s.loader.exec_module(m)
    from rlightning_aio.hosts.forkserver import main
except BaseException:
    import os, traceback
    os.write(int(sys.argv[2]), b"!" + traceback.format_exc()[-60000:].encode())
    os._exit(1)
main(int(sys.argv[2]))
"""
"""Runs `main` from this very package, whatever the interpreter has installed.

If that fails, the only message is ``!`` and a traceback.
"""

DUMP_SIGNAL: Final = signal.SIGRTMIN + 7
_TAIL_BYTES: Final = 8192
_GRACE_SECONDS: Final = 1.2
"""How long workers may take to notice that the trainer is gone and stop a robot."""
_DUMP_SECONDS: Final = 0.3
_MESSAGE_BYTES: Final = 1 << 16


@dataclass(frozen=True)
class Hello:
    """First message of the trainer: what to import before anything is forked."""

    path: list[str] | None
    preload: tuple[str, ...]


@dataclass(frozen=True)
class Ready:
    """First message of the fork server; `error` says why it can't serve."""

    error: str | None


@dataclass(frozen=True)
class Fork:
    """Fork worker `host_id`; the channel's and the arena's descriptors ride along."""

    host_id: int
    first_slot: int
    rings_offset: int
    rows: int


@dataclass(frozen=True)
class Forked:
    """Worker `host_id` runs as process `pid`."""

    host_id: int
    pid: int


@dataclass(frozen=True)
class Kill:
    """Kill worker `host_id`; with `dump`, have it write its stacks to stderr first."""

    host_id: int
    dump: bool


@dataclass(frozen=True)
class Exited:
    """Worker `host_id` has ended: exit code (negative for a signal), last words."""

    host_id: int
    exit_code: int
    stderr_tail: str


@dataclass
class _Child:
    host_id: int
    pid: int
    stderr: int
    tail: bytearray = field(default_factory=bytearray)
    kill_at: float | None = None


def _die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        pr_set_pdeathsig = 1
        ctypes.CDLL(None, use_errno=True).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _on_child(signal_number: int, frame: FrameType | None) -> None:
    """Does nothing: a signal that has a handler reaches the wake-up descriptor."""


class _ForkServer:
    def __init__(self, trainer: socket.socket) -> None:
        self._trainer = trainer
        self._children: dict[int, _Child] = {}
        self._poll = select.poll()
        self._poll.register(trainer, select.POLLIN)
        # A byte arrives here whenever a child has ended.
        self._wakeup, wakeup = socket.socketpair()
        self._wakeup.setblocking(False)
        wakeup.setblocking(False)
        self._wakeup_writer = wakeup
        signal.set_wakeup_fd(wakeup.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, _on_child)
        self._poll.register(self._wakeup, select.POLLIN)

    def serve(self) -> None:
        """Fork and bury until the trainer is gone; then see that no worker is left."""
        while self._step(self._next_kill()):
            pass
        self._end_all()

    def _next_kill(self) -> float | None:
        times = [child.kill_at for child in self._children.values() if child.kill_at is not None]
        return min(times) if times else None

    def _step(self, until: float | None) -> bool:
        timeout = None if until is None else max(0.0, until - time.monotonic()) * 1000
        for descriptor, _ in self._poll.poll(timeout):
            if descriptor == self._trainer.fileno():
                if not self._obey():
                    return False
            elif descriptor == self._wakeup.fileno():
                with contextlib.suppress(BlockingIOError):
                    self._wakeup.recv(4096)
            else:
                self._listen(descriptor)
        self._kill_due()
        self._bury()
        return True

    def _obey(self) -> bool:
        try:
            data, descriptors, _, _ = socket.recv_fds(self._trainer, _MESSAGE_BYTES, 2)
        except ConnectionResetError:
            return False
        if not data:
            return False
        message = pickle.loads(data)
        if isinstance(message, Fork):
            self._fork(message, descriptors)
        elif isinstance(message, Kill):
            self._kill(message)
        return True

    def _fork(self, order: Fork, descriptors: list[int]) -> None:
        reader, writer = os.pipe()
        parent = os.getpid()
        pid = os.fork()
        if pid == 0:
            _run_worker(self._become_worker, parent, writer, order, descriptors)
        for descriptor in (writer, *descriptors):
            os.close(descriptor)
        os.set_blocking(reader, False)
        self._children[pid] = _Child(order.host_id, pid, reader)
        self._poll.register(reader, select.POLLIN)
        self._tell(Forked(order.host_id, pid))

    def _become_worker(self) -> None:
        """Leave behind, in the child, what belongs to the fork server."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for child in self._children.values():
            os.close(child.stderr)
        for end in (self._trainer, self._wakeup, self._wakeup_writer):
            end.close()

    def _kill(self, order: Kill) -> None:
        for child in self._children.values():
            if child.host_id == order.host_id:
                if order.dump:
                    os.kill(child.pid, DUMP_SIGNAL)
                child.kill_at = time.monotonic() + (_DUMP_SECONDS if order.dump else 0.0)

    def _kill_due(self) -> None:
        now = time.monotonic()
        for child in self._children.values():
            if child.kill_at is not None and child.kill_at <= now:
                os.kill(child.pid, signal.SIGKILL)
                child.kill_at = None

    def _listen(self, descriptor: int) -> None:
        """Pass on what a worker wrote to stderr, and keep its end."""
        for child in self._children.values():
            if child.stderr == descriptor:
                self._drain(child)

    def _drain(self, child: _Child) -> bool:
        try:
            data = os.read(child.stderr, 1 << 16)
        except BlockingIOError:
            return False
        if not data:
            with contextlib.suppress(KeyError):
                self._poll.unregister(child.stderr)
            return False
        child.tail += data
        del child.tail[:-_TAIL_BYTES]
        with contextlib.suppress(OSError):
            os.write(2, data)
        return True

    def _bury(self) -> None:
        for pid in list(self._children):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended:
                continue
            child = self._children.pop(pid)
            while self._drain(child):
                pass
            with contextlib.suppress(KeyError):
                self._poll.unregister(child.stderr)
            os.close(child.stderr)
            tail = bytes(child.tail).decode(errors="replace")
            self._tell(Exited(child.host_id, os.waitstatus_to_exitcode(status), tail))

    def _tell(self, message: Any) -> None:
        # The trainer may be gone, and its socket closed.
        with contextlib.suppress(OSError):
            self._trainer.send(pickle.dumps(message))

    def _end_all(self) -> None:
        """The trainer is gone: workers see their channel close; kill whoever stays."""
        self._poll.unregister(self._trainer)
        self._trainer.close()
        until = time.monotonic() + _GRACE_SECONDS
        while self._children and time.monotonic() < until:
            self._wait_for_children(until)
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)

    def _wait_for_children(self, until: float) -> None:
        for descriptor, _ in self._poll.poll(max(0.0, until - time.monotonic()) * 1000):
            if descriptor == self._wakeup.fileno():
                with contextlib.suppress(BlockingIOError):
                    self._wakeup.recv(4096)
            else:
                self._listen(descriptor)
        self._bury()


def _run_worker(
    leave: Callable[[], None], parent: int, stderr: int, order: Fork, descriptors: list[int]
) -> None:
    """Everything that a forked child does; never returns."""
    code = 1
    try:
        # Standard output too: the trainer's may be read by a program.
        os.dup2(stderr, 1)
        os.dup2(stderr, 2)
        os.close(stderr)
        leave()
        _die_with_parent()
        if os.getppid() != parent:
            os._exit(1)
        faulthandler.enable(all_threads=True)
        faulthandler.register(DUMP_SIGNAL, all_threads=True)
        # Not above: the fork server speaks before it imports what may fail.
        from rlightning_aio.hosts import worker  # noqa: PLC0415

        channel = socket.socket(fileno=descriptors[0])
        worker.main(channel, descriptors[1], order.rings_offset, order.first_slot, order.rows)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _watch_trainer(trainer: socket.socket, finished: socket.socket) -> None:
    """Exit if the trainer dies while modules are still being imported."""
    poll = select.poll()
    poll.register(trainer, select.POLLRDHUP)
    poll.register(finished, select.POLLIN)
    for descriptor, _ in poll.poll():
        if descriptor == trainer.fileno():
            os._exit(0)


def _preload(trainer: socket.socket, modules: tuple[str, ...]) -> str | None:
    """Import what every worker needs; an error that only one env would meet is left to it."""
    finish, finished = socket.socketpair()
    watcher = threading.Thread(target=_watch_trainer, args=(trainer, finished), daemon=True)
    watcher.start()
    error = None
    try:
        importlib.import_module("rlightning_aio.hosts.worker")
        for module in modules:
            with contextlib.suppress(Exception):
                importlib.import_module(module)
    except Exception:
        error = traceback.format_exc()
    finish.close()
    watcher.join()
    finished.close()
    return error


def main(descriptor: int) -> None:
    """Serve the trainer at the other end of socket `descriptor`; never returns."""
    trainer = socket.socket(fileno=descriptor)
    hello: Hello = pickle.loads(trainer.recv(_MESSAGE_BYTES))
    if hello.path is not None:
        sys.path[:] = hello.path
    error = _preload(trainer, hello.preload)
    gc.collect()
    gc.freeze()
    trainer.send(pickle.dumps(Ready(error)))
    if error is None:
        _ForkServer(trainer).serve()
    os._exit(0)
