"""The other end of a process host: a plain blocking loop around a few envs.

Rule: one thread, no asyncio; requests are executed in the order in which they were
sent, and every request gets exactly one reply under its own number. When there is
nothing to do the worker spins for a moment (see `spinner`), then sleeps on its channel.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import socket
import time
import traceback
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from rlightning_aio.hosts.arena import map_shared
from rlightning_aio.hosts.pickling import dumped, dumped_with_code
from rlightning_aio.hosts.runner import EnvRunner, Rest
from rlightning_aio.hosts.spinner import Spinner
from rlightning_aio.protocol.frames import BELL, CHUNK_BYTES, Frame, FrameKind, FrameReader, encode
from rlightning_aio.protocol.info import InfoSchema, InfoSchemas
from rlightning_aio.protocol.rings import (
    OP_BITS,
    OP_MASK,
    SLOT_MASK,
    STEP,
    WorkerRings,
    entry,
    number_of,
    rings_size,
)
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.registry import ENVS

if TYPE_CHECKING:
    from collections.abc import Callable

    from rlightning_aio.config import EnvConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.types import EnvMeta

__all__ = ["AttachOrder", "ErrorText", "StartOrder", "Started", "Worker", "main"]


@dataclass(frozen=True)
class StartOrder:
    """What a worker is to build; travels by cloudpickle.

    Attributes:
        config: the entry.
        env_class: the class itself where it was registered in the trainer by hand;
            None lets the worker resolve the entry's backend.
        worker_indices: which envs of the entry.
        preprocess_fns: one for each of them; None for the default.
        spins: whether waiting may burn a core for some microseconds.
        core: the core to stay on; None for any.
    """

    config: EnvConfig
    env_class: type[BaseEnv] | None
    worker_indices: tuple[int, ...]
    preprocess_fns: tuple[Any, ...]
    spins: bool
    core: int | None


@dataclass(frozen=True)
class AttachOrder:
    """Where a worker's envs write.

    Attributes:
        slabs: layout, rows and offset in the arena of each slab.
        rows: for each env which slab and which row of it.
    """

    slabs: tuple[tuple[RowLayout, int, int], ...]
    rows: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Started:
    """What a worker tells of an env that it has built."""

    meta: EnvMeta
    layout: RowLayout
    reads_extras: bool
    transforms_actions: bool

    @classmethod
    def of(cls, runner: EnvRunner) -> Started:
        """What `runner` has to tell."""
        return cls(runner.meta, runner.layout, runner.reads_extras, runner.transforms_actions)


@dataclass(frozen=True)
class ErrorText:
    """An exception as text: it crosses processes whatever its class is like."""

    type_name: str
    text: str
    traceback: str

    @classmethod
    def of(cls, error: BaseException) -> ErrorText:
        """`error` in words; a broken ``__str__`` is no obstacle."""
        kind = type(error)
        name = kind.__qualname__
        if kind.__module__ != "builtins":
            name = f"{kind.__module__}.{name}"
        try:
            text = str(error)
        except BaseException as broken:
            text = f"<its __str__ raised {type(broken).__name__}>"
        try:
            lines = "".join(traceback.format_exception(error))
        except BaseException:
            lines = "".join(traceback.format_tb(error.__traceback__)) + f"{name}: {text}\n"
        return cls(name, text, lines)


def build_env(config: EnvConfig, env_class: type[BaseEnv] | None, index: int, fn: Any) -> BaseEnv:
    """Import what the entry asks for and build env `index` of it."""
    for module in config.imports:
        importlib.import_module(module)
    env_class = env_class or ENVS.resolve(config.backend)
    return env_class(config, worker_index=index, preprocess_fn=fn)


class TrainerGone(Exception):
    """The channel has closed from the other side."""


class Worker:
    """Serves the envs of one worker until told to close, or until the trainer is gone.

    Args:
        channel: blocking stream socket to the trainer.
        arena: descriptor of the group's shared memory.
        rings_memory: this worker's rings, mapped.
        first_slot: slot of its first env in the group.
        rows: envs that it will hold.
    """

    def __init__(
        self,
        channel: socket.socket,
        arena: int,
        rings_memory: memoryview,
        first_slot: int,
        rows: int,
    ) -> None:
        self._channel = channel
        self._first_slot = first_slot
        self._arena = arena
        self._frames = FrameReader()
        self._rings = WorkerRings(rings_memory, rows)
        self._runners: list[EnvRunner] = []
        self._steps: list[Callable[[], Rest | None]] = []
        self._schemas = InfoSchemas(self._send_schema)
        self._timed = False
        self._spinner = Spinner(enabled=False)
        self._attached = False
        self._closing = False

    def serve(self) -> None:
        """Run until told to close; envs are closed on every way out."""
        try:
            while not self._attached and not self._closing:
                self._receive(0)
            while not self._closing:
                self.run_requests()
                self._wait()
        except TrainerGone as gone:
            for runner in self._runners:
                with contextlib.suppress(Exception):
                    runner.env.on_disconnect()
            if not isinstance(gone.__cause__, BrokenPipeError | ConnectionResetError | None):
                raise
        finally:
            if not self._closing:
                self._close_envs()

    def run_requests(self) -> None:
        """Execute what the ring holds; frames in between, as they come."""
        rings = self._rings
        while not self._closing:
            if rings.has_frame():
                self._receive(socket.MSG_DONTWAIT)
            elif not rings.serve(self._run, self._ring):
                break
        rings.idle()

    def _run(self, request: int) -> bool:
        """Execute one request of the ring; True if its row holds all of the reply."""
        if self._rings.has_frame():
            self._receive(socket.MSG_DONTWAIT)
        if self._closing:
            return False
        # `slot_of` and `op_of`, spelt out: they would be felt in every step.
        row = ((request >> OP_BITS) & SLOT_MASK) - self._first_slot
        if self._timed:
            self._rings.begin(request, time.monotonic_ns())
        try:
            rest = (
                self._steps[row]()
                if request & OP_MASK == STEP
                else self._runners[row].reset_from_row()
            )
        except BaseException as error:
            self._send_error(row, number_of(request), error)
            return False
        if rest is None:
            return True
        self._send_rest(row, number_of(request), rest)
        return False

    def _ring(self) -> None:
        self._write(BELL)

    def _wait(self) -> None:
        """Return when there may be something to do."""
        if self._closing or self._spinner.spin(self._rings.has_news):
            return
        if self._rings.fall_asleep():
            self._receive(0)
            self._rings.wake_up()
            self._spinner.slept()

    def _receive(self, flags: int) -> None:
        try:
            data = self._channel.recv(CHUNK_BYTES, flags)
        except BlockingIOError:
            return
        except ConnectionResetError:  # It died with something of ours unread.
            data = b""
        if not data:
            raise TrainerGone
        for frame in self._frames.feed(data):
            self._rings.frame_seen()
            self._handle(frame)

    def _begin(self, row: int, number: int) -> None:
        """Say which env is being worked on, should that be the last thing it does."""
        self._rings.begin(entry(number, self._first_slot + row, 0), time.monotonic_ns())

    def _handle(self, frame: Frame) -> None:
        """Execute one frame and answer it."""
        self._begin(frame.row, frame.number)
        try:
            self._handlers[frame.kind](self, frame)
        except TrainerGone:
            raise
        except BaseException as error:
            self._send_error(frame.row, frame.number, error)
        self._rings.idle()

    def _start(self, frame: Frame) -> None:
        order: StartOrder = pickle.loads(frame.payload)
        if order.core is not None:
            os.sched_setaffinity(0, {order.core})
        self._spinner = Spinner(enabled=order.spins)
        self._timed = (order.config.step_timeout or order.config.reset_timeout) is not None
        started: list[Started] = []
        for row, (index, fn) in enumerate(
            zip(order.worker_indices, order.preprocess_fns, strict=True)
        ):
            self._begin(row, 0)
            try:
                env = build_env(order.config, order.env_class, index, fn)
                self._runners.append(EnvRunner(env))
                started.append(Started.of(self._runners[-1]))
            except BaseException as error:
                self._send_error(row, frame.number, error)
                return
        # What was built stays: sparing the collector from walking it saves time and pages.
        gc.collect()
        gc.freeze()
        self._send(FrameKind.STARTED, frame, dumped_with_code(started))

    def _attach(self, frame: Frame) -> None:
        """Map the slabs; the arena's descriptor was inherited for this."""
        order: AttachOrder = pickle.loads(frame.payload)
        slabs = [
            Slab(layout, map_shared(self._arena, offset, layout.size(rows)), rows)
            for layout, rows, offset in order.slabs
        ]
        os.close(self._arena)
        self.adopt(self._runners, [(slabs[slab_index], row) for slab_index, row in order.rows])
        self._attached = True
        self._send(FrameKind.ATTACHED, frame)

    def adopt(self, runners: list[EnvRunner], rows: list[tuple[Slab, int]]) -> None:
        """Serve the envs of `runners`, each in the row of a slab that is given for it."""
        for runner, (slab, row) in zip(runners, rows, strict=True):
            runner.attach(slab, row, self._schemas.announce)
        self._runners = runners
        self._steps = [runner.step for runner in runners]

    def _step(self, frame: Frame) -> None:
        action, extras = pickle.loads(frame.payload)
        rest = self._runners[frame.row].step_with(action, extras)
        self._send_rest(frame.row, frame.number, rest or {})

    def _reset(self, frame: Frame) -> None:
        seed, options = pickle.loads(frame.payload)
        rest = self._runners[frame.row].reset(seed, options)
        self._send_rest(frame.row, frame.number, rest or {})

    def _call(self, frame: Frame) -> None:
        name, args, kwargs = pickle.loads(frame.payload)
        value = self._runners[frame.row].call(name, args, kwargs)
        self._send(FrameKind.VALUE, frame, dumped(value, f"what {name}() returned"))

    def _close(self, frame: Frame) -> None:
        self._closing = True
        errors = self._close_envs()
        self._send(FrameKind.CLOSED, frame, pickle.dumps(errors))

    _handlers: ClassVar[dict[int, Callable[[Worker, Frame], None]]] = {
        FrameKind.START: _start,
        FrameKind.ATTACH: _attach,
        FrameKind.STEP: _step,
        FrameKind.RESET: _reset,
        FrameKind.CALL: _call,
        FrameKind.CLOSE: _close,
    }

    def _close_envs(self) -> list[tuple[int, ErrorText]]:
        errors: list[tuple[int, ErrorText]] = []
        for row, runner in enumerate(self._runners):
            self._begin(row, 0)
            try:
                runner.env.close()
            except BaseException as error:
                errors.append((row, ErrorText.of(error)))
        self._runners.clear()
        return errors

    def _write(self, data: bytes) -> None:
        try:
            self._channel.sendall(data)
        except BaseException as error:
            # A part may be out, which nothing can follow; and no env has raised this.
            raise TrainerGone from error

    def _send(self, kind: FrameKind, asked: Frame, payload: bytes = b"") -> None:
        self._write(encode(kind, asked.row, asked.number, payload))
        self._rings.count_frame()

    def _send_rest(self, row: int, number: int, rest: Rest) -> None:
        try:
            payload = dumped(rest, "the result")
        except BaseException as error:
            self._send_error(row, number, error)
            return
        self._write(encode(FrameKind.RESULT, row, number, payload))
        self._rings.count_frame()

    def _send_error(self, row: int, number: int, error: BaseException) -> None:
        payload = pickle.dumps(ErrorText.of(error))
        self._write(encode(FrameKind.ERROR, row, number, payload))
        self._rings.count_frame()

    def _send_schema(self, number: int, schema: InfoSchema) -> None:
        payload = pickle.dumps(schema)
        self._write(encode(FrameKind.INFO_SCHEMA, 0, number, payload))
        self._rings.count_frame()


def main(channel: socket.socket, arena: int, rings_offset: int, first_slot: int, rows: int) -> None:
    """Run a worker in this process; returns when it has closed."""
    rings_memory = map_shared(arena, rings_offset, rings_size(rows))
    Worker(channel, arena, rings_memory, first_slot, rows).serve()
