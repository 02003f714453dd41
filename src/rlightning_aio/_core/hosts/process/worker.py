"""The worker process of a process host: a plain blocking loop around a few envs.

Rule: one thread, no asyncio. Requests are executed in the order of sending, and every
request gets exactly one reply with its own entry. An idle worker spins for a moment (see
`spinner`), then sleeps on its channel. Left out: awaitable envs, whose requests
`AwaitedEnvs` executes at the same time, on an event loop.
"""

from __future__ import annotations

import contextlib
import gc
import os
import pickle
import select
import socket
import sys
import time
import traceback
import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Final, NoReturn, cast

from rlightning_aio._core.hosts.arena import make_private, map_shared
from rlightning_aio._core.hosts.completion_frames import SENDER, frame_of
from rlightning_aio._core.hosts.logs import log_like
from rlightning_aio._core.hosts.messages import Built, Closed
from rlightning_aio._core.hosts.processes import is_suspended
from rlightning_aio._core.hosts.running.build_env import built_envs, not_built
from rlightning_aio._core.hosts.running.execution import completion_of, execute
from rlightning_aio._core.hosts.running.runner import attach_all, close_all, disconnect_all
from rlightning_aio._core.hosts.spinner import Spinner
from rlightning_aio.envs.hardware import watched
from rlightning_aio.envs.results import is_awaitable
from rlightning_aio.protocol import kernel
from rlightning_aio.protocol.entries import entry, slot_of
from rlightning_aio.protocol.exchange import CAREFUL
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, Frame, FrameKind, FrameReader, encode
from rlightning_aio.protocol.rings import WorkerBell, WorkerRings, bell_size, rings_size

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs
    from rlightning_aio._core.hosts.messages import AttachOrder, Completion, StartOrder, WorkerPlace
    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner
    from rlightning_aio._core.hosts.running.row_writer import Execute
    from rlightning_aio._core.hosts.running.runner import EnvRunner
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.error_text import ErrorText


_LOOKS: Final = 10
"""A worker of hardware looks at its trainer's state in every tenth look, ten times a second."""


class TrainerGone(Exception):
    """The trainer closed the channel, or died."""


class Worker:
    """Serves the envs of one worker until it gets `CLOSE` or the trainer is gone.

    Args:
        channel: blocking stream socket to the trainer.
        arena: descriptor of the group's shared memory.
        rings: of this worker.
        first_slot: slot of its first env in the group.
        shared: memory that is mapped already.
    """

    def __init__(
        self,
        channel: socket.socket,
        arena: int,
        rings: WorkerRings,
        first_slot: int,
        shared: Sequence[memoryview] = (),
    ) -> None:
        self._channel = channel
        self._first_slot = first_slot
        self._arena = arena
        self._frames = FrameReader()
        self._rings = rings
        self._runners: list[EnvRunner] = []
        self._steps: list[Execute] = []
        self._spinner = Spinner(enabled=False)
        self._attached = False
        self._closing = False
        self._awaits = False
        self._awaited: AwaitedEnvs
        self._order: StartOrder
        self._shared = list(shared)
        self._is_child = False
        self._unwatch: Callable[[], None] | None = None

    def serve(self) -> None:
        """Serve until it gets `CLOSE` or the trainer is gone; close the envs in any case."""
        try:
            while not self._attached and not self._closing:
                self._receive(0)
            if self._awaits and not self._closing:
                self._serve_awaitable()
            while not self._closing:
                self.run_requests()
                self._wait()
        except TrainerGone as gone:
            if not self._closing:
                disconnect_all(self._runners)
            if not isinstance(gone.__cause__, BrokenPipeError | ConnectionResetError | None):
                raise
        finally:
            if not self._closing:
                self._close_envs()

    def _serve_awaitable(self) -> None:
        """Serve envs whose `reset` and `step` are coroutine functions concurrently."""
        # Not at the top: no other worker needs asyncio.
        from rlightning_aio._core.hosts.awaiting.awaited_envs import AwaitedEnvs  # noqa: PLC0415

        rings, ring = self._rings, self._ring
        self._awaited = awaited = AwaitedEnvs(
            SENDER,
            self._first_slot,
            self._order,
            post=self._post,
            done=lambda entry: rings.report(entry, ring),
            enter=lambda entry: rings.begin(entry, time.monotonic_ns()),
        )
        runners = cast("list[AwaitedRunner]", self._runners)
        try:
            errors = awaited.serve(runners, self._channel, self._take_requests)
        finally:
            self._closing = True  # The event loop has closed them.
            self._end_watch()
        self._post(Closed(SENDER, errors))

    def _take_requests(self) -> bool:
        """Read requests and begin to execute them; return False to close."""
        rings = self._rings
        while not self._closing:
            self._receive(socket.MSG_DONTWAIT)
            for request in rings.requests():
                self._awaited.submit(request, None)
            # From now on the trainer sends a wake-up for each request, even if envs are busy.
            if rings.fall_asleep() and not self._closing:
                return True
        return False

    def run_requests(self) -> None:
        """Execute the requests in the ring, and frames as they arrive."""
        rings = self._rings
        while not self._closing:
            if rings.has_frame():
                self._receive_some()
            elif not kernel.serve(
                rings.side,
                self._run,
                self._finish,
                self._ring,
                self._receive_some,
                self._steps,
                self._first_slot,
                rings.fence,
            ):
                break

    def _run(self, request: int) -> bool:
        """Execute one request of the ring; return True if its row holds the whole reply.

        Most steps are executed by `kernel.serve` itself.
        """
        if self._closing:
            return False
        return self._execute(request, None)

    def _execute(self, request: int, arguments: bytes | None) -> bool:
        """Execute one request; return True if its row holds the whole reply, else send that."""
        index = slot_of(request) - self._first_slot
        runner = self._runners[index]
        completion = execute(SENDER, runner, request, arguments, self._on_end)
        self._steps[index] = runner.step  # Perhaps of an env that was rebuilt.
        if completion is not None:
            self._post(completion)
        return completion is None

    def _finish(self, request: int, outcome: Any) -> None:
        """Reply to a step whose outcome is not in its row alone.

        Args:
            request: the entry.
            outcome: what is out of band, or the exception that the env raised.
        """
        error = outcome if isinstance(outcome, BaseException) else None
        self._on_end(error)
        runner = self._runners[slot_of(request) - self._first_slot]
        completion = completion_of(SENDER, runner, request, outcome, error)
        if completion is not None:
            self._post(completion)

    def _on_end(self, error: BaseException | None) -> None:
        """End a process that an env forked, which must not reply; pass `TrainerGone` on."""
        if self._is_child:
            _end_child(error)
        if isinstance(error, TrainerGone):  # A schema, say, could not be sent.
            raise error

    def _ring(self) -> None:
        self._write(BELL)

    def _wait(self) -> None:
        """Return when there may be a request."""
        if self._closing or self._spinner.spin(self._rings.has_news):
            return
        if self._rings.fall_asleep():
            self._receive(0)
            self._rings.wake_up()
            self._spinner.slept()

    def _receive_some(self) -> None:
        """Execute the frames that the channel holds."""
        self._receive(socket.MSG_DONTWAIT)

    def _receive(self, flags: int) -> None:
        try:
            data = self._channel.recv(CHUNK_BYTES, flags)
        except BlockingIOError:
            return
        except ConnectionResetError:  # It died before it read everything.
            data = b""
        if not data:
            raise TrainerGone
        for frame in self._frames.feed(data):
            self._rings.frame_seen()
            self._handle(frame)

    def _handle(self, frame: Frame) -> None:
        """Execute one frame and answer it."""
        try:
            self._handlers[frame.kind](self, frame)
        finally:
            self._rings.idle()

    def become_child(self) -> None:
        """Release the channel and the shared memory in a process that an env forked.

        It continues in the code of the env. It ends if that code returns.
        """
        self._is_child = True
        self._rings.own[CAREFUL] = 1
        self._channel.close()
        for memory in self._shared:
            make_private(memory)

    def _begin(self, request: int) -> None:
        """Publish the current request, in case the worker dies in it."""
        if self._is_child:
            _end_child(sys.exception())
        self._rings.begin(request, time.monotonic_ns())

    def _begin_with(self, index: int) -> None:
        """Publish which env is being built or closed."""
        self._begin(entry(0, self._first_slot + index, 0))

    def _start(self, frame: Frame) -> None:
        order: StartOrder | None = None
        try:
            self._begin_with(0)
            order = pickle.loads(frame.payload)
            assert order is not None
            order = replace(order, is_again=order.is_again or frame.number > 0)
            self._spinner = Spinner(enabled=order.spins)
            self._order = order
            if order.logs is not None:
                log_like(order.logs, _name_of(order))
            for runner in built_envs(order):
                self._runners.append(runner)
                self._begin_with(len(self._runners) % len(order.worker_indices))
            if order.is_hardware:
                self._unwatch = watched(self._watch(order.trainer_pid))
            self._awaits = any(is_awaitable(runner.env) for runner in self._runners)
            started = [runner.started() for runner in self._runners]
        except BaseException as error:
            self._post(not_built(SENDER, order, len(self._runners), error))
            return
        # Most of these objects stay. They are not frozen, or the last collection would have to look
        # at all that the fork server has imported, whose pages the workers share.
        gc.collect()
        self._post(Built(SENDER, started))

    def _watch(self, trainer_pid: int | None) -> Callable[[], list[BaseEnv]]:
        """Return what says which envs must stop now: all, once the trainer is gone or stopped."""
        poll = select.poll()
        poll.register(self._channel, select.POLLRDHUP)
        num_looks, is_stopped = 0, False

        def to_stop() -> list[BaseEnv]:
            nonlocal num_looks, is_stopped
            runners, was_stopped = self._runners, is_stopped
            num_looks += 1
            if trainer_pid is not None and not num_looks % _LOOKS:
                is_stopped = is_suspended(trainer_pid)
            if not poll.poll(0):
                chosen = self._rings.to_stop(self._first_slot, whatever=is_stopped)
                if was_stopped or not is_stopped:
                    runners = [runners[k] for k in chosen]
            return [runner.env for runner in runners if not runner.has_closed]

        return to_stop

    def _end_watch(self) -> None:
        """Stop nothing any more but what must stop now, and keep no env for that."""
        end, self._unwatch = self._unwatch, None
        if end is not None:
            end()

    def _attach(self, frame: Frame) -> None:
        """Map the slabs from the inherited descriptor of the arena."""
        order: AttachOrder = pickle.loads(frame.payload)
        attach_all(self._runners, order, self._map_part, SENDER, self._post)
        self._steps = [runner.step for runner in self._runners]
        os.close(self._arena)
        self._attached = True

    def _map_part(self, offset: int, size: int) -> memoryview:
        memory = map_shared(self._arena, offset, size)
        self._shared.append(memory)
        return memory

    def _request(self, frame: Frame) -> None:
        """Execute a request whose arguments came out of band."""
        request = frame.number
        self._begin(request)
        if self._awaits:
            self._awaited.submit(request, frame.payload)
            return
        if self._execute(request, frame.payload):
            self._rings.report(request, self._ring)

    def _abort(self, frame: Frame) -> None:
        """Cancel a request to an awaitable env; any other ends by itself, or with this worker."""
        if self._awaits:
            for request in self._rings.requests():  # It may be the newest.
                self._awaited.submit(request, None)
            self._awaited.abort(frame.number)

    def _close(self, frame: Frame) -> None:
        del frame
        self._closing = True
        self._rings.own[CAREFUL] = 1
        if self._awaits and self._attached:
            return  # The event loop closes them.
        self._post(Closed(SENDER, self._close_envs()))

    _handlers: ClassVar[dict[int, Callable[[Worker, Frame], None]]] = {
        FrameKind.START: _start,
        FrameKind.ATTACH: _attach,
        FrameKind.REQUEST: _request,
        FrameKind.ABORT: _abort,
        FrameKind.CLOSE: _close,
    }

    def _close_envs(self) -> list[tuple[int, ErrorText]]:
        self._end_watch()
        return close_all(self._runners, self._begin_with)

    def _write(self, data: bytes) -> None:
        if self._is_child:
            _end_child(sys.exception())
        try:
            try:
                sent = self._channel.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            if sent < len(data):
                self._write_rest(memoryview(data)[sent:])
        except BaseException as error:
            # No frame can follow a partial one, and this is not an error of an env.
            raise TrainerGone from error

    def _write_rest(self, rest: memoryview) -> None:
        """Write data that the channel had no room for.

        This waits for the trainer, so it doesn't count as time of the env.
        """
        paused_ns = time.monotonic_ns()
        since_ns = self._rings.pause()
        self._channel.sendall(rest)
        self._rings.resume(since_ns + time.monotonic_ns() - paused_ns)

    def _post(self, completion: Completion) -> None:
        """Send a completion to the trainer."""
        self._write(encode(*frame_of(completion)))
        self._rings.count_frame()


def _name_of(order: StartOrder) -> str:
    """The ids of a worker's envs, such as ``pole-3`` or ``pole-0 to pole-3``."""
    first, last = order.worker_indices[0], order.worker_indices[-1]
    name = f"{order.config.name}-{first}"
    return name if first == last else f"{name} to {order.config.name}-{last}"


def _end_child(error: BaseException | None) -> NoReturn:
    """End a process that an env forked; print its error, and send no reply."""
    code = 1
    if isinstance(error, SystemExit) and (error.code is None or isinstance(error.code, int)):
        code = error.code or 0
    elif error is not None:
        traceback.print_exception(error)
    else:
        sys.stderr.write(
            "a process that an env forked has returned from the env's code and ends here; it "
            "should have ended by os._exit\n"
        )
    with contextlib.suppress(Exception):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)


def main(channel: socket.socket, arena: int, place: WorkerPlace) -> None:
    """Run a worker in this process until it has closed."""
    bell_memory = map_shared(arena, place.bell_offset, bell_size(place.num_hosts))
    bell = WorkerBell(bell_memory, place.num_hosts, place.host_id)
    rings_memory = map_shared(arena, place.rings_offset, rings_size(place.num_envs))
    rings = WorkerRings(rings_memory, place.num_envs, bell)
    worker = Worker(channel, arena, rings, place.first_slot, (bell_memory, rings_memory))
    # Not for ever: the env and what it holds are dropped with the worker.
    known = weakref.ref(worker)

    def in_child() -> None:
        if (forked := known()) is not None:
            forked.become_child()

    os.register_at_fork(after_in_child=in_child)
    worker.serve()
