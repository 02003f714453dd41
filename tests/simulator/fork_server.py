"""A simulated fork server and its workers.

The fork server reacts to each message as the real one does, at events of the world. A worker is the
real `Worker`, in a process of the world.
"""

from __future__ import annotations

import errno
import signal
import subprocess
import traceback
from functools import partial
from typing import TYPE_CHECKING, Any

from simulator.processes import Killed, Living, Process

from rlightning_aio._core.hosts.arena import map_shared
from rlightning_aio._core.hosts.messages import Attached
from rlightning_aio._core.hosts.process.fork_messages import (
    CloseLimit,
    Exited,
    Fork,
    Forked,
    Kill,
    MessageSocket,
    NotForked,
    Ready,
)
from rlightning_aio._core.hosts.process.host import ForkServerHandle
from rlightning_aio._core.hosts.process.worker import TrainerGone, Worker
from rlightning_aio.protocol.rings import WorkerBell, WorkerRings, bell_size, rings_size

if TYPE_CHECKING:
    from collections.abc import Sequence

    from simulator.world import World

    from rlightning_aio._core.hosts.messages import Completion, WorkerPlace

__all__ = ["ForkServer", "kill"]

_kill = ForkServerHandle.kill
_CLOSE_SECONDS = 1.2
_DUMP_SECONDS = 0.3
_LEAST_START_SECONDS = 5.0
"""Less time to start has no entry of a program."""
_DUMP = 'Current thread 0x0000 (most recent call first):\n  File "simulated", line 1 in step\n'


class ForkServer(Living):
    """The process, and the trainer's `subprocess.Popen` of it.

    Args:
        world: where it lives.
        command, pass_fds, others: of `Popen`.
    """

    def __init__(
        self, world: World, command: Sequence[str], *, pass_fds: Sequence[int], **others: Any
    ) -> None:
        del command, others
        if world.refuses():
            raise BlockingIOError(errno.EAGAIN, "no more processes")
        super().__init__(world, "the fork server")
        self.returncode: int | None = None
        self._exit_code = 0
        end = world.sockets.by_number[world.sockets.duplicate(pass_fds[0])]
        end.end.holders.append(self)
        end.end.name = self.name
        self._trainer = MessageSocket(end)  # pyright: ignore[reportArgumentType]
        self._children: dict[int, tuple[_WorkerProcess, int]] = {}
        self._close_seconds: dict[int, float] = {}
        self._is_ready = self._is_looking = False
        self.later(0.01 + world.start_delay(), self._begin)

    # -- as the trainer's child -----------------------------------------------------

    def kill(self) -> None:
        """See `Popen.kill`."""
        self.world.counts["fork servers killed"] += 1
        self.end(-signal.SIGKILL)

    def poll(self) -> int | None:
        """See `Popen.poll`."""
        return None if self.alive else self._exit_code

    def wait(self, timeout: float | None = None) -> int:
        """See `Popen.wait`."""
        self.world.wait_for(lambda: not self.alive, timeout)
        if self.alive:
            assert timeout is not None
            raise subprocess.TimeoutExpired("fork server", timeout)
        self.returncode = self._exit_code
        return self.returncode

    # -- the process ------------------------------------------------------------------

    def _begin(self) -> None:
        """Have imported the modules."""
        self._is_ready = True
        if self.world.refuses():
            self._trainer.send(Ready("ImportError: as the world wants it"))
            self.end(0)
            return
        self._trainer.send(Ready(None))
        self.wake()

    def end(self, code: int) -> None:
        """End at once; the kernel then kills its workers."""
        if not self.alive:
            return
        self.alive = False
        self._exit_code = code
        self.world.counts["fork servers that ended"] += 1
        self.world.note("{} ends with {}", self.name, code)
        self._trainer.close()
        for worker, channel in list(self._children.values()):
            self.world.sockets.close_descriptor(channel)
            worker.end(-signal.SIGKILL)

    def wake(self) -> None:
        """Look at its socket, soon."""
        if self._is_ready and not self._is_looking:
            self._is_looking = True
            self.later(self.world.delay(), self._look)

    def _look(self) -> None:
        self._is_looking = False
        chance, chances = self.world.rng.random(), self.world.faults.fork_servers
        if chance < chances / 2:
            self.end(-signal.SIGKILL)
            return
        if chance < chances:
            self.stop(self.world.long())
        try:
            self._trainer.flush()
            while (received := self._trainer.receive()) is not None:
                self._obey(received.message, received.descriptors)
        except EOFError:
            self._leave()

    def _obey(self, message: Any, descriptors: list[int]) -> None:
        if isinstance(message, Fork):
            self._fork(message.place, *descriptors)
        elif isinstance(message, CloseLimit):
            self._close_seconds[message.host_id] = message.seconds
        elif isinstance(message, Kill) and message.host_id in self._children:
            worker, _ = self._children[message.host_id]
            if message.dump:
                worker.stderr += _DUMP
            self.later(_DUMP_SECONDS if message.dump else 0.0, partial(worker.end, -signal.SIGKILL))

    def check_late(self, host_id: int) -> None:
        """Check a worker that the trainer is about to kill as hung; the order may arrive later."""
        worker, _ = self._children.get(host_id, (None, 0))
        if worker is not None and not (worker.has_started() or worker.is_late()):
            self.world.wrongs.append(f"{worker.name} is killed as late although it wasn't")

    def _fork(self, place: WorkerPlace, channel: int, arena: int) -> None:
        sockets, host_id = self.world.sockets, place.host_id
        if self.world.refuses():
            sockets.close_descriptor(channel)
            sockets.close_descriptor(arena)
            self._trainer.send(NotForked(host_id, "no more processes"))
            return
        kept = sockets.duplicate(channel)
        worker = _WorkerProcess(self.world, place, channel, arena, partial(self._reap, host_id))
        self._children[host_id] = worker, kept
        self._trainer.send(Forked(host_id, worker.pid))

    def _reap(self, host_id: int, code: int, stderr: str) -> None:
        """Handle the exit of a worker, soon."""
        self.later(self.world.delay(), partial(self._report_exit, host_id, code, stderr))

    def _report_exit(self, host_id: int, code: int, stderr: str) -> None:
        _, channel = self._children.pop(host_id)
        self._trainer.send(Exited(host_id, code, stderr))
        self.world.sockets.close_descriptor(channel)

    def _leave(self) -> None:
        """End, as the trainer has closed the socket or is gone: first the workers, in time."""
        for _, channel in self._children.values():
            self.world.sockets.by_number[channel].shutdown(0)
        self._trainer.close()
        self._until_gone(self.world.now_ns)

    def _until_gone(self, since_ns: int) -> None:
        seconds = (self.world.now_ns - since_ns) / 1e9
        for host_id, (worker, _) in self._children.items():
            if worker.alive and seconds >= self._close_seconds.get(host_id, _CLOSE_SECONDS):
                worker.end(-signal.SIGKILL)
        if any(worker.alive for worker, _ in self._children.values()):
            self.later(0.01, partial(self._until_gone, since_ns))
        else:
            self.end(0)


def kill(handle: Any, host: Any, *, dump: bool) -> None:
    """Do what `ForkServerHandle.kill` does, and check that a worker which is killed as hung is."""
    if dump and handle._server is not None:
        handle._server.process.check_late(host.host_id)
    _kill(handle, host, dump=dump)


class _Worker(Worker):
    """Notes that it is about to tell of its start."""

    has_attached = False

    def _post(self, completion: Completion) -> None:
        self.has_attached |= isinstance(completion, Attached)
        super()._post(completion)


class _WorkerProcess(Process):
    """The worker of `place`, as it is forked.

    Args:
        channel, arena: its descriptors.
        world, on_exit: see `Process`.
    """

    def __init__(
        self, world: World, place: WorkerPlace, channel: int, arena: int, on_exit: Any
    ) -> None:
        self._place, self._channel, self._arena = place, channel, arena
        self._worker: _Worker | None = None
        super().__init__(world, f"worker {place.host_id}", self._serve, on_exit)
        world.note("{} is forked", self.name)
        self._end = world.sockets.by_number[channel].end
        self._end.name = self.name
        self.descriptors = {channel, arena}
        self._end.holders.append(self)

    def is_late(self) -> bool:
        """It has had the time to start since it got its last order, and has not started."""
        since_order = self.world.now_ns - self._end.received_ns
        return since_order > _LEAST_START_SECONDS * 1e9 and not self.has_started()

    def has_started(self) -> bool:
        return self._worker is not None and self._worker.has_attached

    def _serve(self) -> int:
        place, sockets = self._place, self.world.sockets
        try:
            memory = map_shared(self._arena, place.bell_offset, bell_size(place.num_hosts))
            bell = WorkerBell(memory, place.num_hosts, place.host_id)
            memory = map_shared(self._arena, place.rings_offset, rings_size(place.num_envs))
            rings = WorkerRings(memory, place.num_envs, bell)
            channel = sockets.by_number[self._channel]
            self._worker = _Worker(channel, self._arena, rings, place.first_slot)  # pyright: ignore[reportArgumentType]
            self._worker.serve()
        except Killed:
            raise
        except BaseException as error:  # noqa: BLE001  # As in a real one, it goes to stderr.
            self.stderr += traceback.format_exc()
            if not isinstance(error, TrainerGone):
                self.world.wrongs.append(f"{self.name} ended by {error!r}")
            return 1
        return 0
