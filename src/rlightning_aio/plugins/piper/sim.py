"""Connects a simulated Piper arm to a bus: in this process, or on a pseudo-terminal.

Rule: for a program, it behaves like a real arm. Any process can use it over ``slcan``, at the path
printed by ``python -m rlightning_aio.plugins.piper.sim``; this process also over a `VirtualBus`.
Absent on purpose: the behaviour of the arm, which is in `arm`.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import socket
import sys
import threading
import time
import tty
from typing import TYPE_CHECKING

from rlightning_aio.plugins.piper.arm import CanFrame, SimulatedArm

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

FEEDBACK_HZ = 100.0
"""Rate of reports of joints, pose and status; that of motors is a fifth of it."""


class VirtualPort:
    """The arm's end of a bus inside this process; `bus` is the other end."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._end, self.bus = VirtualBus(ours), VirtualBus(theirs)

    def receive(self, timeout: float) -> CanFrame | None:
        """Wait up to `timeout` seconds for the next frame."""
        if not select.select([self._end], [], [], timeout)[0]:
            return None
        frames = self._end.receive(most=1)
        return frames[0] if frames else None

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames without waiting; drop them if they aren't read, as on a real bus."""
        with contextlib.suppress(OSError):
            for frame in frames:
                self._end.send(frame)

    def close(self) -> None:
        self._end.close()


class VirtualBus:
    """One end of a bus inside this process; see `watchdog.Bus`."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self, most: int = 64) -> list[CanFrame]:
        frames: list[CanFrame] = []
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while len(frames) < most and (data := self._socket.recv(64)):
                frames.append(CanFrame(int.from_bytes(data[:2], "big"), data[2:]))
        return frames

    def send(self, frame: CanFrame) -> None:
        self._socket.send(frame.can_id.to_bytes(2, "big") + frame.data)

    def close(self) -> None:
        self._socket.close()


class SlcanPort:
    """A pseudo-terminal that acts as a serial CAN adapter (the Lawicel ASCII protocol).

    Attributes:
        path: of the terminal, the channel for the other end.
    """

    def __init__(self) -> None:
        self._master, self._terminal = os.openpty()
        tty.setraw(self._terminal)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._terminal)
        self._buffer = b""
        self._open = False

    def receive(self, timeout: float) -> CanFrame | None:
        deadline = time.monotonic() + timeout
        while True:
            while b"\r" in self._buffer:
                line, _, self._buffer = self._buffer.partition(b"\r")
                if (frame := self._parse(line)) is not None:
                    return frame
            remaining = max(0.0, deadline - time.monotonic())
            if not select.select([self._master], [], [], remaining)[0]:
                return None
            self._buffer += os.read(self._master, 4096)

    def _parse(self, line: bytes) -> CanFrame | None:
        if line[:1] == b"t":
            # Serial lines may carry garbage.
            with contextlib.suppress(ValueError):
                return CanFrame(int(line[1:4], 16), bytes.fromhex(line[5:].decode("ascii")))
        elif line in (b"O", b"C"):
            self._open = line == b"O"
        return None

    def send(self, frames: list[CanFrame]) -> None:
        if self._open:
            lines = [f"t{f.can_id:03X}{len(f.data)}{f.data.hex().upper()}\r" for f in frames]
            # A terminal without a reader is full; a real bus would lose the frames too.
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, "".join(lines).encode("ascii"))

    def close(self) -> None:
        os.close(self._master)
        os.close(self._terminal)


def run(
    arm: SimulatedArm,
    port: VirtualPort | SlcanPort,
    feedback_hz: float,
    stopped: Callable[[], bool],
) -> None:
    """Run the arm on the port until `stopped` returns True."""
    last = due = time.monotonic()
    tick = 0
    while not stopped():
        while (frame := port.receive(max(0.0, due - time.monotonic()))) is not None:
            port.send(arm.receive(frame))
        now = time.monotonic()
        arm.advance(now - last)
        last, due = now, max(due + 1 / feedback_hz, now)
        port.send(arm.feedback() + (arm.motor_feedback() if tick % 5 == 0 else []))
        tick += 1


@contextlib.contextmanager
def running(arm: SimulatedArm, port: VirtualPort | SlcanPort) -> Generator[None]:
    """Run the arm on `port` in a thread, during the block."""
    stop = threading.Event()
    thread = threading.Thread(
        target=run, args=(arm, port, FEEDBACK_HZ, stop.is_set), name="simulated arm", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def main(arguments: list[str] | None = None) -> None:
    """Print the path of the arm's terminal, then simulate until interrupted or terminated."""
    parser = argparse.ArgumentParser(
        prog="python -m rlightning_aio.plugins.piper.sim",
        description="A simulated Piper arm on a pseudo-terminal. Drive it with can_interface: "
        "slcan and the printed path as channel.",
    )
    parser.add_argument(
        "--feedback-hz", type=float, default=FEEDBACK_HZ, help="reports per second (%(default)s)"
    )
    feedback_hz: float = parser.parse_args(arguments).feedback_hz
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: stop.set())
    port = SlcanPort()
    sys.stdout.write(f"{port.path}\n")
    sys.stdout.flush()
    try:
        run(SimulatedArm(), port, feedback_hz, stop.is_set)
    finally:
        port.close()


if __name__ == "__main__":
    main()
