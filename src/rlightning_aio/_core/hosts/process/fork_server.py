"""The fork server: a small process that forks workers and reports their exit.

One runs for each combination of interpreter and environment variables. It has imported the modules
of the simulator, so a worker starts in milliseconds. It passes on what workers write to stdout and
stderr, and keeps the end of each. When the trainer closes its end of the socket or dies, it shuts
down the channels of all workers, and kills those that don't close in time. What a killed worker has
started is killed with it.
Rule: it has one thread when it forks. It builds no env.
"""

from __future__ import annotations

import atexit
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
import weakref
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, cast

from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.descriptors import occupy_standard_streams
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
from rlightning_aio._core.hosts.processes import adopt_orphans, children, kill_below

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from io import TextIOWrapper
    from types import FrameType

    from rlightning_aio._core.hosts.process.fork_messages import Message

GYMNASIUM: Final = (1, 2)
"""The oldest version that workers can use; that of pyproject.toml."""

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
    from rlightning_aio._core.hosts.process.fork_server import main
except BaseException:
    import traceback
    fail(traceback.format_exc())
main(int(sys.argv[2]), int(sys.argv[3]))
"""
"""Runs `main` of this package, even if the interpreter has another version of it installed.

If that fails, the only packet is `REFUSED` and the reason.
"""

DUMP_SIGNAL: Final = getattr(signal, "SIGRTMIN", 0) + 7  # `bench` imports this on macOS, too.
_TAIL_BYTES: Final = 8192
_CHUNK_BYTES: Final = 1 << 16
_ERROR_CHARACTERS: Final = 60_000
_IN_ORDER: Final = 86
"""The exit code of a worker that has closed its envs; an env may end its process with 0."""
_STDOUT: Final = 1
_STDERR: Final = 2


# What `multiprocessing` uses of them at the end of a process has no public name.
_atexit: Any = atexit
_threading: Any = threading


@dataclass
class _Child:
    """A worker. Its end of the channel stays open here until its exit is handled, so that it can be
    shut down when the trainer is gone.
    """

    host_id: int
    pid: int
    outputs: list[_Output]
    channel: int
    kill_at: float | None = None
    close_seconds: float = times.CLOSE_ALONE

    def tail(self) -> str:
        """The end of what it wrote to stdout, and of what it wrote to stderr."""
        return "".join(output.tail.decode(errors="replace") for output in self.outputs)


@dataclass
class _Output:
    """What a worker writes to stdout, to stderr, or to both if they are the same file here."""

    reader: int
    descriptor: int
    tail: bytearray = field(default_factory=bytearray)


def _pass_on(descriptor: int, data: bytes) -> None:
    """Write as much as the descriptor takes at once.

    The stderr of the trainer may be a pipe without a reader. The rest is dropped, because all
    workers would wait while the fork server did.
    """
    probe = select.poll()
    probe.register(descriptor, select.POLLOUT)
    for begin in range(0, len(data), select.PIPE_BUF):
        if not probe.poll(0):
            return
        try:
            # A pipe that is writable takes this much without blocking.
            os.write(descriptor, data[begin : begin + select.PIPE_BUF])
        except OSError:  # The reader is gone.
            return


def die_with_parent() -> None:
    """Make the kernel kill this process when its parent dies (Linux)."""
    with contextlib.suppress(OSError, AttributeError):
        pr_set_pdeathsig = 1
        ctypes.CDLL(None, use_errno=True).prctl(pr_set_pdeathsig, signal.SIGKILL)


def _on_child(signal_number: int, frame: FrameType | None) -> None:
    """Do nothing: a signal with a handler reaches the wake-up descriptor."""


class _ForkServer:
    """Forks workers and handles their exits.

    Args:
        trainer: the socket.
        trainer_process: a descriptor of the process (-1 if unknown).
    """

    def __init__(self, trainer: MessageSocket, trainer_process: int) -> None:
        self._trainer = trainer
        self._trainer_process = trainer_process
        self._children: dict[int, _Child] = {}
        # Processes that workers have left running when they closed in order.
        self._left: set[int] = set()
        adopt_orphans()
        self._poll = select.poll()
        if trainer_process >= 0:
            self._poll.register(trainer_process, select.POLLIN)
        # Where both are the same file, such as a terminal, one pipe keeps the order of lines.
        is_one = os.path.sameopenfile(_STDOUT, _STDERR)
        self._streams = (_STDERR,) if is_one else (_STDOUT, _STDERR)
        # A byte arrives here whenever a child exits.
        self._wakeup, wakeup = socket.socketpair()
        self._wakeup.setblocking(False)
        wakeup.setblocking(False)
        self._wakeup_writer = wakeup
        signal.set_wakeup_fd(wakeup.fileno(), warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, _on_child)
        self._poll.register(self._wakeup, select.POLLIN)
        # A worker that can't write its stacks yet doesn't die of the request.
        signal.signal(DUMP_SIGNAL, signal.SIG_IGN)

    def serve(self) -> None:
        """Serve until the trainer is gone; then end all workers."""
        while True:
            events = select.POLLIN | select.POLLOUT if self._trainer.waiting else select.POLLIN
            self._poll.register(self._trainer, events)
            if not self._step():
                break
        self._end_all()

    def _next_due(self) -> float | None:
        times = [one.kill_at for one in self._children.values() if one.kill_at]
        return min(times, default=None)

    def _step(self) -> bool:
        """Handle what happens next, or kill those whose time is up; False: the trainer is gone."""
        until = self._next_due()
        timeout = None if until is None else max(0.0, until - time.monotonic()) * 1000
        for descriptor, _ in self._poll.poll(timeout):
            if descriptor == self._trainer_process:
                return False
            if descriptor == self._trainer.fileno():
                self._trainer.flush()
                if not self._obey():
                    return False
            elif descriptor == self._wakeup.fileno():
                with contextlib.suppress(BlockingIOError):
                    self._wakeup.recv(4096)
            else:
                self._forward(descriptor)
        self._kill_due()
        self._handle_exits()
        return True

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
        elif isinstance(received.message, CloseLimit):
            for child in self._children.values():
                if child.host_id == received.message.host_id:
                    child.close_seconds = received.message.seconds
        return True

    def _fork(self, order: Fork, descriptors: list[int]) -> None:
        pipes: list[int] = []
        parent = os.getpid()
        try:
            if len(descriptors) < 2:
                raise OSError("its descriptors didn't arrive: too many are open")
            for _ in self._streams:
                pipes += os.pipe()
            pid = os.fork()
        except OSError as error:
            for descriptor in (*pipes, *descriptors):
                os.close(descriptor)
            self._trainer.send(NotForked(order.place.host_id, str(error)))
            return
        readers, writers = pipes[::2], pipes[1::2]
        channel, arena = descriptors
        if pid == 0:
            _run_worker(self._become_worker, parent, writers, order, channel, arena)
        for descriptor in (*writers, arena):
            os.close(descriptor)
        for reader in readers:
            os.set_blocking(reader, False)
            self._poll.register(reader, select.POLLIN)
        outputs = [_Output(*both) for both in zip(readers, self._streams, strict=True)]
        self._children[pid] = _Child(order.place.host_id, pid, outputs, channel)
        self._trainer.send(Forked(order.place.host_id, pid))

    def _become_worker(self) -> None:
        """Release in the child what belongs to the fork server."""
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for child in self._children.values():
            for output in child.outputs:
                os.close(output.reader)
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
                child.kill_at = time.monotonic() + (times.GRACE if order.dump else 0.0)

    def _kill_due(self) -> None:
        now = time.monotonic()
        for child in self._children.values():
            if child.kill_at is not None and child.kill_at <= now:
                os.kill(child.pid, signal.SIGKILL)
                child.kill_at = None

    def _forward(self, descriptor: int) -> None:
        """Forward the output of a worker, and keep the end of it."""
        for child in self._children.values():
            for output in child.outputs:
                if output.reader == descriptor:
                    self._drain(output)

    def _drain(self, output: _Output, most: int = _CHUNK_BYTES) -> None:
        try:
            data = os.read(output.reader, most)
        except BlockingIOError:
            return
        if not data:
            self._poll.unregister(output.reader)
            return
        output.tail += data
        del output.tail[:-_TAIL_BYTES]
        _pass_on(output.descriptor, data)

    def _handle_exits(self) -> None:
        """Report the workers that exited, and kill what those have started that were killed."""
        exited: list[tuple[_Child, int]] = []
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                break
            if not pid:
                break
            child = self._children.pop(pid, None)
            if child is not None:  # Others are what workers have left.
                exited.append((child, os.waitstatus_to_exitcode(status)))
        for child, code in exited:  # First, as it frees descriptors.
            self._report(child, 0 if code == _IN_ORDER else code)
        if any(code != _IN_ORDER for _, code in exited):
            kill_below(os.getpid(), but={*self._children, *self._left})
        elif exited:
            # They ended as Python ends, which leaves alone what goes on in the background.
            self._left = {*children().get(os.getpid(), [])} - self._children.keys()

    def _report(self, child: _Child, exit_code: int) -> None:
        for output in child.outputs:
            # Only what is in the pipe now: a process that it started may continue to write.
            if unread := _unread(output.reader):
                self._drain(output, unread)
            with contextlib.suppress(KeyError):
                self._poll.unregister(output.reader)
            os.close(output.reader)
        self._trainer.send(Exited(child.host_id, exit_code, child.tail()))
        os.close(child.channel)

    def _end_all(self) -> None:
        """Close the channels of all workers, then kill those that still run."""
        self._poll.unregister(self._trainer)
        self._trainer.close()
        if self._trainer_process >= 0:
            self._poll.unregister(self._trainer_process)
        for child in self._children.values():
            # A process that the trainer forked may still have the other end open.
            with (
                socket.socket(fileno=os.dup(child.channel)) as channel,
                contextlib.suppress(OSError),
            ):
                channel.shutdown(socket.SHUT_RDWR)
        now = time.monotonic()
        for child in self._children.values():
            child.kill_at = now + child.close_seconds
        while self._children and self._next_due() is not None:
            self._step()
        # The kernel ends those that can't be killed now.
        if self._children:
            kill_below(os.getpid(), but=self._left)


def _unread(pipe: int) -> int:
    """Return the number of unread bytes."""
    return int.from_bytes(fcntl.ioctl(pipe, termios.FIONREAD, bytes(4)), sys.byteorder)


def _run_worker(
    leave: Callable[[], None],
    parent: int,
    outputs: Sequence[int],
    order: Fork,
    channel: int,
    arena: int,
) -> None:
    """Run a worker in a forked child; never returns."""
    code = 1
    try:
        os.dup2(outputs[0], _STDOUT)
        os.dup2(outputs[-1], _STDERR)
        for output in outputs:
            os.close(output)
        # What an env prints comes at once, and isn't lost if the worker is killed.
        cast("TextIOWrapper", sys.stdout).reconfigure(line_buffering=True)
        leave()
        die_with_parent()
        adopt_orphans()
        _drop_inherited()
        if os.getppid() != parent:
            os._exit(1)
        faulthandler.enable(all_threads=True)
        faulthandler.register(DUMP_SIGNAL, all_threads=True)
        # Not at the top: the fork server sends messages before imports that may fail.
        from rlightning_aio._core.hosts.process import worker  # noqa: PLC0415

        trainer = socket.socket(fileno=channel)
        worker.main(trainer, arena, order.place)
        _run_finalisers()
        code = _IN_ORDER
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


# -- how a worker ends: as Python does, without what the fork server has left to be done at its end.
# Python's own end would also run the exit functions of the fork server's modules, and some of those
# delete what other workers use. `multiprocessing` ends its processes likewise.


def _drop_inherited() -> None:
    """Forget, in a process that was forked just now, what its parent does at its end."""
    _atexit._clear()  # noqa: SLF001
    finalize: Any = weakref.finalize
    for finaliser in list(finalize._registry):  # noqa: SLF001
        finaliser.atexit = False
    finalize._registered_with_atexit = False  # noqa: SLF001
    if util := _multiprocessing():
        util._finalizer_registry.clear()  # noqa: SLF001


def _run_finalisers() -> None:
    """Wait for threads, run finalisers and exit functions, and collect garbage.

    This closes files that have no references, removes temporary folders, and ends daemons of
    `multiprocessing`.
    """
    gc.collect()
    _threading._shutdown()  # noqa: SLF001
    if util := _multiprocessing():
        util._exit_function()  # noqa: SLF001
    _atexit._run_exitfuncs()  # noqa: SLF001


def _multiprocessing() -> Any:
    return sys.modules.get("multiprocessing.util")


# -- the start ------------------------------------------------------------------


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


def _import(trainer: MessageSocket, process: int, modules: tuple[str, ...]) -> str | None:
    """Import the modules of workers; return an error of ours. Envs report those of simulators."""
    finish, finished = socket.socketpair()
    watcher = threading.Thread(
        target=_watch_trainer, args=(trainer, process, finished), daemon=True
    )
    watcher.start()
    error = None
    try:
        importlib.import_module("rlightning_aio._core.hosts.process.worker")
        # Each worker gets the config of its entry, and would import this itself.
        importlib.import_module("rlightning_aio.config")
        for module in modules:
            with contextlib.suppress(Exception):
                importlib.import_module(module)
    except Exception:
        error = f"{_outdated()}{traceback.format_exc()[-_ERROR_CHARACTERS:]}"
    finish.close()
    watcher.join()
    finished.close()
    return error


def _outdated() -> str:
    """Name the version of Gymnasium that is needed, if this interpreter has an older one."""
    # Not at the top: nothing else needs it, and it takes time.
    from importlib.metadata import PackageNotFoundError, version  # noqa: PLC0415

    try:
        found = version("gymnasium")
        is_old = tuple(map(int, found.split(".")[:2])) < GYMNASIUM
    except (PackageNotFoundError, ValueError):
        return ""
    needed = ".".join(map(str, GYMNASIUM))
    words = f"{sys.executable} has gymnasium {found}, and workers need {needed} or later:"
    return f"{words} pip install 'gymnasium>={needed}'\n" if is_old else ""


def _process_of(pid: int) -> int:
    """Return a descriptor that is readable once process `pid` is dead; -1 if not supported.

    The socket is not enough: if the trainer forked, its child has it open, too.
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
    """Serve the trainer at the other end of socket `descriptor`; never returns."""
    # The mask is inherited from the thread of the trainer. Blocked signals would not report exits,
    # write stacks, or end workers.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    occupy_standard_streams()
    trainer = MessageSocket(socket.socket(fileno=descriptor))
    process = _process_of(trainer_pid)
    try:
        preload = _first_message(trainer)
    except EOFError:
        os._exit(0)
    assert isinstance(preload, Preload)
    if preload.path is not None:
        sys.path[:] = preload.path
    # Garbage collection takes a tenth of the import time, finds hardly anything, and would write
    # to memory that workers share with this process.
    gc.disable()
    error = _import(trainer, process, preload.modules)
    gc.freeze()
    gc.enable()
    trainer.send(Ready(error))
    if error is None:
        _ForkServer(trainer, process).serve()
    os._exit(0)
