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
import fcntl
import gc
import importlib
import os
import select
import signal
import socket
import sys
import termios
import threading
import time
import traceback
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rlightning_aio.hosts.fork_messages import (
    Exited,
    Fork,
    Forked,
    Hello,
    Kill,
    MessageSocket,
    Ready,
)
from rlightning_aio.hosts.standard_streams import occupy_standard_streams

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType

    from rlightning_aio.hosts.fork_messages import Message

__all__ = ["BOOTSTRAP", "DUMP_SIGNAL", "main"]

BOOTSTRAP: Final = """
import os, sys
def fail(text):
    os.write(int(sys.argv[2]), b"!" + text[-60000:].encode("utf-8", "replace"))
    os._exit(1)
if sys.path[0] == "":
    del sys.path[0]
if sys.version_info < (3, 11):
    fail("its interpreter %s is Python %s, and workers need Python 3.11 or later"
         % (sys.executable, ".".join(map(str, sys.version_info[:3]))))
try:
    import importlib.util as u
    s = u.spec_from_file_location(
        "rlightning_aio", sys.argv[1] + "/__init__.py", submodule_search_locations=[sys.argv[1]])
    m = sys.modules["rlightning_aio"] = u.module_from_spec(s)
    s.loader.exec_module(m)
    from rlightning_aio.hosts.fork_server import main
except BaseException:
    import traceback
    fail(traceback.format_exc())
main(int(sys.argv[2]), int(sys.argv[3]))
"""
"""Runs `main` from this very package, whatever the interpreter has installed, and of any version.

If that fails, the only packet is `FAILED` and why.
"""

DUMP_SIGNAL: Final = signal.SIGRTMIN + 7
_TAIL_BYTES: Final = 8192
_CHUNK_BYTES: Final = 1 << 16
_GRACE_SECONDS: Final = 1.2
"""How long workers may take to notice that the trainer is gone and stop a robot."""
_DUMP_SECONDS: Final = 0.3
_ERROR_CHARACTERS: Final = 60_000
_OUTLET_BYTES: Final = 1 << 20
_READ_SECONDS: Final = 0.2
"""A trainer that hasn't read anything for so long reads nothing."""
_STDERR: Final = 2


@dataclass
class _Child:
    """A worker. Its end of the channel is kept open until it is buried, so it can be told to stop
    when the trainer is gone.
    """

    host_id: int
    pid: int
    stderr: int
    channel: int
    tail: bytearray = field(default_factory=bytearray)
    kill_at: float | None = None
    silent: bool = False


class _Outlet:
    """Passes on what workers write to stderr, and never blocks.

    A trainer's stderr may be a pipe that nobody reads. Then output waits here, and once
    there is too much of it, in the workers' own pipes.
    """

    def __init__(self, poll: select.poll) -> None:
        self._poll = poll
        self._waiting = bytearray()

    @property
    def full(self) -> bool:
        return len(self._waiting) > _OUTLET_BYTES

    def write(self, data: bytes) -> None:
        self._waiting += data
        self.flush()

    def empty(self, until: float) -> None:
        """Write what is left, as long as somebody reads it."""
        reader = select.poll()
        reader.register(_STDERR, select.POLLOUT)
        while self._waiting and time.monotonic() < until and reader.poll(_READ_SECONDS * 1000):
            self.flush()

    def flush(self) -> None:
        """Write what can be written now; have the poll tell when more can."""
        probe = select.poll()
        probe.register(_STDERR, select.POLLOUT)
        while self._waiting:
            events = probe.poll(0)
            if not events:
                self._poll.register(_STDERR, select.POLLOUT)
                return
            try:
                # A pipe that is writable takes this much without blocking.
                del self._waiting[: os.write(_STDERR, self._waiting[: select.PIPE_BUF])]
            except OSError:
                self._waiting.clear()  # Nobody can ever read it.
        with contextlib.suppress(KeyError):
            self._poll.unregister(_STDERR)


def _die_with_parent() -> None:
    """Have the kernel kill this process when its parent dies (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        pr_set_pdeathsig = 1
        ctypes.CDLL(None, use_errno=True).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _on_child(signal_number: int, frame: FrameType | None) -> None:
    """Does nothing: a signal that has a handler reaches the wake-up descriptor."""


class _ForkServer:
    """Args: the socket to the trainer, and a descriptor of its process (-1 if unknown)."""

    def __init__(self, trainer: MessageSocket, trainer_process: int) -> None:
        self._trainer = trainer
        self._trainer_process = trainer_process
        self._children: dict[int, _Child] = {}
        self._poll = select.poll()
        if trainer_process >= 0:
            self._poll.register(trainer_process, select.POLLIN)
        self._outlet = _Outlet(self._poll)
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
        events = select.POLLIN | select.POLLOUT if self._trainer.waiting else select.POLLIN
        self._poll.register(self._trainer, events)
        for descriptor, _ in self._poll.poll(timeout):
            if descriptor == self._trainer_process:
                return False
            if descriptor == self._trainer.fileno():
                self._trainer.flush()
                if not self._obey():
                    return False
            else:
                self._attend(descriptor)
        self._kill_due()
        self._bury()
        return True

    def _attend(self, descriptor: int) -> None:
        if descriptor == self._wakeup.fileno():
            with contextlib.suppress(BlockingIOError):
                self._wakeup.recv(4096)
        elif descriptor == _STDERR:
            self._outlet.flush()
            self._choose_heard()
        else:
            self._listen(descriptor)

    def _obey(self) -> bool:
        try:
            received = self._trainer.receive()
        except EOFError:
            return False
        if received is None:
            return True
        if isinstance(received.message, Fork):
            self._fork(received.message, received.descriptors)
        elif isinstance(received.message, Kill):
            self._kill(received.message)
        return True

    def _fork(self, order: Fork, descriptors: list[int]) -> None:
        pipe: list[int] = []
        parent = os.getpid()
        try:
            if len(descriptors) < 2:
                raise OSError("its descriptors didn't arrive: too many are open")
            pipe += os.pipe()
            pid = os.fork()
        except OSError as error:
            for descriptor in (*pipe, *descriptors):
                os.close(descriptor)
            why = f"no worker could be forked: {error}"
            self._trainer.send(Exited(order.place.host_id, 1, why))
            return
        reader, writer = pipe
        channel, arena = descriptors
        if pid == 0:
            _run_worker(self._become_worker, parent, writer, order, channel, arena)
        os.close(writer)
        os.close(arena)
        os.set_blocking(reader, False)
        self._children[pid] = _Child(order.place.host_id, pid, reader, channel)
        self._choose_heard()
        self._trainer.send(Forked(order.place.host_id, pid))

    def _become_worker(self) -> None:
        """Leave behind, in the child, what belongs to the fork server."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for child in self._children.values():
            os.close(child.stderr)
            os.close(child.channel)
        if self._trainer_process >= 0:
            os.close(self._trainer_process)
        for end in (self._trainer, self._wakeup, self._wakeup_writer):
            end.close()

    def _kill(self, order: Kill) -> None:
        for child in self._children.values():
            if child.host_id == order.host_id:
                if order.dump:
                    os.kill(child.pid, DUMP_SIGNAL)
                child.kill_at = time.monotonic() + (_DUMP_SECONDS if order.dump else 0.0)
        self._choose_heard()

    def _kill_due(self) -> None:
        now = time.monotonic()
        for child in self._children.values():
            if child.kill_at is not None and child.kill_at <= now:
                os.kill(child.pid, signal.SIGKILL)
                child.kill_at = None

    def _choose_heard(self) -> None:
        """Read from all workers, unless too much waits; from one to be killed in any case."""
        for child in self._children.values():
            heard = not child.silent and (not self._outlet.full or child.kill_at is not None)
            if heard:
                self._poll.register(child.stderr, select.POLLIN)
            else:
                with contextlib.suppress(KeyError):
                    self._poll.unregister(child.stderr)

    def _listen(self, descriptor: int) -> None:
        """Pass on what a worker wrote to stderr, and keep its end."""
        for child in self._children.values():
            if child.stderr == descriptor:
                self._drain(child)

    def _drain(self, child: _Child, most: int = _CHUNK_BYTES) -> None:
        try:
            data = os.read(child.stderr, most)
        except BlockingIOError:
            return
        if not data:
            child.silent = True
            self._choose_heard()
            return
        child.tail += data
        del child.tail[:-_TAIL_BYTES]
        was_full = self._outlet.full
        self._outlet.write(data)
        if self._outlet.full != was_full:
            self._choose_heard()

    def _bury(self) -> None:
        for pid in list(self._children):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if not ended:
                continue
            child = self._children.pop(pid)
            # No more than lies there now: a process that it has started may go on writing.
            if unread := _unread(child.stderr):
                self._drain(child, unread)
            with contextlib.suppress(KeyError):
                self._poll.unregister(child.stderr)
            os.close(child.stderr)
            tail = bytes(child.tail).decode(errors="replace")
            self._trainer.send(Exited(child.host_id, os.waitstatus_to_exitcode(status), tail))
            os.close(child.channel)

    def _end_all(self) -> None:
        """The trainer is gone: workers see their channel close; kill those that stay."""
        self._poll.unregister(self._trainer)
        self._trainer.close()
        if self._trainer_process >= 0:
            self._poll.unregister(self._trainer_process)
        for child in self._children.values():
            # A child that the trainer has forked may hold the other end of it still.
            with (
                socket.socket(fileno=os.dup(child.channel)) as channel,
                contextlib.suppress(OSError),
            ):
                channel.shutdown(socket.SHUT_RDWR)
        until = time.monotonic() + _GRACE_SECONDS
        while self._children and time.monotonic() < until:
            self._wait_for_children(until)
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)
        self._outlet.empty(until)

    def _wait_for_children(self, until: float) -> None:
        for descriptor, _ in self._poll.poll(max(0.0, until - time.monotonic()) * 1000):
            self._attend(descriptor)
        self._bury()


def _unread(pipe: int) -> int:
    """How many bytes lie in it."""
    return int.from_bytes(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)), sys.byteorder)


def _run_worker(
    leave: Callable[[], None], parent: int, stderr: int, order: Fork, channel: int, arena: int
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

        trainer = socket.socket(fileno=channel)
        worker.main(trainer, arena, order.place)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _watch_trainer(trainer: MessageSocket, process: int, finished: socket.socket) -> None:
    """Exit if the trainer dies while modules are still being imported."""
    poll = select.poll()
    poll.register(trainer, select.POLLRDHUP)
    poll.register(finished, select.POLLIN)
    if process >= 0:
        poll.register(process, select.POLLIN)
    for descriptor, _ in poll.poll():
        if descriptor != finished.fileno():
            os._exit(0)


def _preload(trainer: MessageSocket, process: int, modules: tuple[str, ...]) -> str | None:
    """Import what every worker needs; an error that only one env would meet is left to it."""
    finish, finished = socket.socketpair()
    watcher = threading.Thread(
        target=_watch_trainer, args=(trainer, process, finished), daemon=True
    )
    watcher.start()
    error = None
    try:
        importlib.import_module("rlightning_aio.hosts.worker")
        # Each worker is sent its entry's config, and would import this for itself.
        importlib.import_module("rlightning_aio.config")
        for module in modules:
            with contextlib.suppress(Exception):
                importlib.import_module(module)
    except Exception:
        error = traceback.format_exc()[-_ERROR_CHARACTERS:]
    finish.close()
    watcher.join()
    finished.close()
    return error


def _process_of(pid: int) -> int:
    """A descriptor that is readable once process `pid` is dead; -1 where there is no such thing.

    The trainer's sockets would do, but for a trainer that has forked: its child holds them, too.
    """
    try:
        return os.pidfd_open(pid)
    except ProcessLookupError:
        os._exit(0)
    except (AttributeError, OSError):
        return -1


def _first_message(trainer: MessageSocket) -> Message:
    poll = select.poll()
    poll.register(trainer, select.POLLIN)
    while True:
        poll.poll()
        received = trainer.receive()
        if received is not None:
            return received.message


def main(descriptor: int, trainer_pid: int) -> None:
    """Serve the trainer, which is at the other end of socket `descriptor`; never returns."""
    # What the trainer's thread has blocked is inherited, by workers as well: they would miss the
    # signals that tell of a death, write stacks, or end them.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    occupy_standard_streams()
    trainer = MessageSocket(socket.socket(fileno=descriptor))
    process = _process_of(trainer_pid)
    try:
        hello = _first_message(trainer)
    except EOFError:
        os._exit(0)
    assert isinstance(hello, Hello)
    if hello.path is not None:
        sys.path[:] = hello.path
    # Looking for garbage takes a tenth of the imports' time, finds next to none, and would
    # touch the memory that workers share with this process.
    gc.disable()
    error = _preload(trainer, process, hello.preload)
    gc.freeze()
    gc.enable()
    trainer.send(Ready(error))
    if error is None:
        _ForkServer(trainer, process).serve()
    os._exit(0)
