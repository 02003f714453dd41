"""The watchdog of a Piper arm: a small process that owns the arm's bus.

The program that drives the arm sends its frames through the watchdog, as long as it also sends
heartbeats. When these end, when the program ends, or when its trainer ends or is suspended, the
watchdog makes the safe stop (`guard`), and drops later commands.
Rule: it does nothing else, ignores all signals that can be ignored, and ends with its program.
Absent on purpose: slow imports.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import socket
import struct
import time
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from rlightning_aio.plugins.piper.guard import ArmGuard, CanFrame

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

BITRATE: Final = 1_000_000
MESSAGE_BYTES: Final = 1 << 16
_FEEDBACK: Final = frozenset((*range(0x2A1, 0x2A9), *range(0x261, 0x267)))
"""Frames for the program: status, pose, joints, gripper, and power of the motors."""
_ESSENTIAL: Final = {
    signal.SIGKILL,
    signal.SIGSTOP,
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGFPE,
    signal.SIGILL,
}
_GIVE_UP: Final = 2.0
"""Time limit for a bus to accept a stop, in seconds."""
_FRAME: Final = struct.Struct(">H8s")
_COUNT: Final = struct.Struct(">Q")


class Kind:
    """First byte of a message between a program and its watchdog."""

    FRAMES: Final = b"F"
    """From the program: commands. From the watchdog: the number of messages of commands received
    before the feedback was read, and feedback."""
    BEAT: Final = b"B"
    """Heartbeat of the program."""
    ARM: Final = b"A"
    """Let commands pass while process N (the trainer; 0 for none) is alive; confirmed."""
    STOP: Final = b"S"
    """Stop the arm; confirmed. Without a request: the watchdog stopped the arm, with the cause."""
    OPEN: Final = b"O"
    """The bus is open."""
    FAULT: Final = b"E"
    """The bus can't be opened, or has failed; the watchdog ends."""


class Bus(Protocol):
    """A CAN bus that can be polled."""

    def fileno(self) -> int:
        """Descriptor that is readable when frames have arrived."""
        ...

    def receive(self) -> list[CanFrame]:
        """Read the frames that have arrived, without waiting."""
        ...

    def send(self, frame: CanFrame) -> None:
        """Send a frame; errors of the bus propagate."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


class CanBus:
    """A bus of python-can."""

    def __init__(self, interface: str, channel: str) -> None:
        # Optional and untyped, so imported by name.
        self._can: Any = import_module("can")
        self._bus = self._can.Bus(interface=interface, channel=channel, bitrate=BITRATE)

    def fileno(self) -> int:
        return self._bus.fileno()

    def receive(self) -> list[CanFrame]:
        frames: list[CanFrame] = []
        # Read everything, so that later frames are newer than the next command; with a limit, so
        # that a busy bus can't delay a stop.
        while len(frames) < 512 and (read := self._bus.recv(0)) is not None:
            if len(read.data) == 8 and not (read.is_error_frame or read.is_extended_id):
                frames.append(CanFrame(read.arbitration_id, bytes(read.data)))
        return frames

    def send(self, frame: CanFrame) -> None:
        self._bus.send(
            self._can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
        )

    def close(self) -> None:
        self._bus.shutdown()


class SerialBus(CanBus):
    """A serial adapter, read in larger pieces than the single bytes of python-can."""

    def __init__(self, interface: str, channel: str) -> None:
        super().__init__(interface, channel)
        self._lines = SerialLines()

    def receive(self) -> list[CanFrame]:
        if not (data := os.read(self.fileno(), MESSAGE_BYTES)):
            raise ConnectionError("the serial port was hung up")
        return self._lines.feed(data)


class SerialLines:
    """Parses frames from the ASCII lines of the Lawicel protocol."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[CanFrame]:
        """Add `data`, and return the frames of complete lines."""
        *lines, self._rest = (self._rest + data).split(b"\r")
        frames: list[CanFrame] = []
        for line in lines:
            # Serial lines may carry garbage.
            with contextlib.suppress(ValueError):
                if line[:1] == b"t" and len(line) >= 21:
                    data = bytes.fromhex(line[5:21].decode("ascii"))
                    frames.append(CanFrame(int(line[1:4], 16), data))
        return frames


def packed(frames: Iterable[CanFrame]) -> bytes:
    """Encode frames as the content of a message."""
    return b"".join(_FRAME.pack(*frame) for frame in frames)


def unpacked(content: bytes) -> list[CanFrame]:
    """Decode frames that `packed` has encoded."""
    return [CanFrame(*fields) for fields in _FRAME.iter_unpack(content)]


def feedback(content: bytes) -> tuple[int, list[CanFrame]]:
    """Decode feedback: number of messages of commands received before it, and frames."""
    return _COUNT.unpack_from(content)[0], unpacked(content[_COUNT.size :])


class Watchdog:
    """Serves one program until it is gone and the arm is stopped.

    Args:
        program: a socket to the program, which preserves message boundaries.
        bus: of the arm.
        guard: filters commands and decides when to stop.
        timeout: seconds for which the trainer may be suspended.
    """

    def __init__(self, program: socket.socket, bus: Bus, guard: ArmGuard, timeout: float) -> None:
        self._program = program
        self._bus = bus
        self._guard = guard
        self._timeout = timeout
        self._trainer: _Process | None = None
        self._looked = self._ran = time.monotonic()
        self._connected = True
        self._taken = 0
        self._stop_requested = False
        self._fault: Exception | None = None
        self._failing_since: float | None = None
        self._unsent: list[bytes] = [Kind.OPEN]
        self._poll = select.poll()
        self._poll.register(program, select.POLLIN)
        self._poll.register(bus.fileno(), select.POLLIN)

    def serve(self) -> None:
        """Return when the program is gone and its arm is stopped, or the bus has failed."""
        while self._connected or self._guard.stopping:
            wait = self._guard.wait(time.monotonic())
            if self._trainer is not None and self._guard.armed:
                wait = min(wait or self._timeout, self._timeout / 10)
            ready = {d for d, _ in self._poll.poll(None if wait is None else 1000 * wait)}
            # Read before sending, because these frames are older than the next commands.
            if self._bus.fileno() in ready:
                self._listen()
            # Unread heartbeats count, even if this process was delayed.
            if self._connected and self._program.fileno() in ready:
                self._obey()
            if self._guard.armed and self._trainer is not None:
                self._look_at(self._trainer)
            self._act()
            self._post()
            if self._fault is not None and not self._guard.stopping:
                break

    def _obey(self) -> None:
        while True:
            try:
                data = self._program.recv(MESSAGE_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            now = time.monotonic()
            if not data:
                self._connected = False
                self._poll.unregister(self._program)
                self._guard.stop("the program that drove it has ended", now)
                return
            self._handle(data[:1], data[1:], now)

    def _handle(self, kind: bytes, content: bytes, now: float) -> None:
        if kind == Kind.FRAMES:
            self._taken += 1
            for frame in unpacked(content):
                if self._guard.passes(frame, now):
                    with contextlib.suppress(Exception):  # The program will miss feedback.
                        self._bus.send(frame)
        elif kind == Kind.BEAT:
            self._guard.beat(now)
        elif kind == Kind.ARM:
            pid = int(content)
            self._trainer = _Process(pid) if pid else None
            self._ran = now
            self._guard.arm(now)
            self._unsent.append(Kind.ARM)
        elif kind == Kind.STOP:
            self._guard.stop("", now)
            self._stop_requested = True

    def _listen(self) -> None:
        try:
            frames = self._bus.receive()
        except Exception as error:  # noqa: BLE001 - drivers raise all sorts of errors
            self._fail(error)
            return
        now = time.monotonic()
        for frame in frames:
            self._guard.heard(frame, now)
        wanted = [frame for frame in frames if frame.can_id in _FEEDBACK]
        if wanted and self._connected:
            # A program that doesn't read loses feedback, and is stopped soon.
            with contextlib.suppress(OSError):
                data = Kind.FRAMES + _COUNT.pack(self._taken) + packed(wanted)
                self._program.send(data, socket.MSG_DONTWAIT)

    def _fail(self, error: Exception) -> None:
        if self._fault is None:
            self._fault = error
            self._poll.unregister(self._bus.fileno())
            self._unsent.append(Kind.FAULT + str(error).encode())
        self._guard.stop(f"its bus failed: {error}", time.monotonic())

    def _look_at(self, trainer: _Process) -> None:
        now = time.monotonic()
        if now < self._looked + self._timeout / 10:
            return
        self._looked = now
        state = trainer.state()
        if state is None:
            self._guard.stop(f"the trainer, process {trainer.pid}, has ended", now)
        elif state not in "tT":
            self._ran = now
        elif now > self._ran + self._timeout:
            self._guard.stop(f"the trainer, process {trainer.pid}, was stopped", now)

    def _act(self) -> None:
        was_stopping = self._guard.stopping
        now = time.monotonic()
        frames = self._guard.act(now)
        try:
            for frame in frames:
                self._bus.send(frame)
        except Exception as error:  # noqa: BLE001 - drivers raise all sorts of errors
            self._guard.not_sent()
            self._failing_since = self._failing_since or now
            if now > self._failing_since + _GIVE_UP:
                self._fail(error)
                self._guard.stopping = was_stopping = self._stop_requested = False
                _say(f"an arm's watchdog could not stop it, switch it off: its bus failed: {error}")
        else:
            if frames:
                self._failing_since = None
        if was_stopping and not self._guard.stopping:
            if self._guard.cause:
                _say(f"an arm's watchdog has stopped it: {self._guard.cause}")
            self._unsent.append(Kind.STOP + self._guard.cause.encode())
            self._stop_requested = False
        elif self._stop_requested and not self._guard.stopping:
            self._unsent.append(Kind.STOP)  # It was already stopped.
            self._stop_requested = False

    def _post(self) -> None:
        while self._unsent and self._connected:
            try:
                self._program.send(self._unsent[0], socket.MSG_DONTWAIT)
            except OSError:
                return
            self._unsent.pop(0)


def _say(text: str) -> None:
    """Write a line to stderr, if there is one; the program that drove the arm may be gone."""
    with contextlib.suppress(OSError):
        os.write(2, f"rlightning_aio: {text}\n".encode())


class _Process:
    """Another process, distinguished from later ones with the same pid."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._started = self._status()[1]

    def state(self) -> str | None:
        """State of the process, as the kernel's letter; None if it has ended."""
        state, started = self._status()
        return None if started != self._started or state in "ZX" else state

    def _status(self) -> tuple[str, str]:
        try:
            text = Path(f"/proc/{self.pid}/stat").read_text()
        except OSError:
            return "X", ""
        # The name of the command, in parentheses, may contain any character.
        fields = text.rpartition(")")[2].split()
        return fields[0], fields[19]


def serve(program: socket.socket, bus: Bus, orders: Mapping[str, Any]) -> None:
    """Run the watchdog of the program at the other end of a socket, then close the bus.

    Args:
        program: the socket.
        bus: of the arm.
        orders: arguments of an `ArmGuard` (``stop``, ``timeout``, ``speed``,
            ``gripper_effort``), and ``armed``, True if the arm may already be moving.
    """
    guard = ArmGuard(orders["stop"], orders["timeout"], orders["speed"], orders["gripper_effort"])
    if orders["armed"]:
        guard.arm(time.monotonic())
    try:
        Watchdog(program, bus, guard, orders["timeout"]).serve()
    finally:
        with contextlib.suppress(Exception):
            bus.close()
        program.close()


def main(arguments: str) -> None:
    """Serve a program; `arguments` is JSON: orders, ``interface``, ``channel``, a descriptor."""
    orders: dict[str, Any] = json.loads(arguments)
    for number in signal.valid_signals() - _ESSENTIAL:
        # A hangup or a key that ends the program must not end its watchdog.
        with contextlib.suppress(OSError):
            signal.signal(number, signal.SIG_IGN)
    program = socket.socket(fileno=orders["program"])
    try:
        kind = SerialBus if orders["interface"] == "slcan" else CanBus
        bus = kind(orders["interface"], orders["channel"])
    except Exception as error:  # noqa: BLE001 - drivers raise all sorts of errors
        with contextlib.suppress(OSError):
            program.send(Kind.FAULT + str(error).encode())
        return
    serve(program, bus, orders)
