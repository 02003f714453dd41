"""Puts a simulated Piper arm on a bus: in this process, or on a pseudo-terminal.

Rule: a program that drives the arm can't tell; the vendor's unmodified SDK speaks to it over
python-can's ``virtual`` bus (same process) or ``slcan`` (any process, the path that
``python -m rlightning_aio.envs.piper_sim`` prints).
Absent on purpose: what the arm does with a frame, which is `piper_arm`'s.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import signal
import sys
import threading
import time
import tty
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol

from rlightning_aio.envs.piper_arm import Frame, SimulatedArm

if TYPE_CHECKING:
    from collections.abc import Callable, Generator
    from types import FrameType

# Optional and untyped, so imported by name.
can: Any = import_module("can")

__all__ = ["FEEDBACK_HZ", "SlcanPort", "VirtualPort", "run", "running"]

FEEDBACK_HZ = 100.0
"""How often joints, pose and status are reported; motors report a fifth as often."""


class Port(Protocol):
    """The arm's end of a bus."""

    def receive(self, timeout: float) -> Frame | None:
        """The next frame, waiting up to `timeout` seconds for it."""
        ...

    def send(self, frame: Frame) -> None:
        """Send a frame, or drop it if nobody takes it."""
        ...

    def close(self) -> None:
        """Leave the bus."""
        ...


class VirtualPort:
    """A channel of python-can's ``virtual`` bus, which reaches this process only."""

    def __init__(self, channel: str) -> None:
        self._bus = can.Bus(interface="virtual", channel=channel)

    def receive(self, timeout: float) -> Frame | None:
        message = self._bus.recv(timeout)
        return None if message is None else Frame(message.arbitration_id, bytes(message.data))

    def send(self, frame: Frame) -> None:
        self._bus.send(
            can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
        )

    def close(self) -> None:
        self._bus.shutdown()


class SlcanPort:
    """A pseudo-terminal that looks like a serial CAN adapter (the Lawicel ASCII protocol).

    Attributes:
        path: of the terminal, which is the channel that the other end opens.
    """

    def __init__(self) -> None:
        self._master, self._terminal = os.openpty()
        tty.setraw(self._terminal)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._terminal)
        self._buffer = b""
        self._open = False

    def receive(self, timeout: float) -> Frame | None:
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

    def _parse(self, line: bytes) -> Frame | None:
        if line[:1] == b"t":
            # Garbage on a serial line is an everyday thing.
            with contextlib.suppress(ValueError):
                return Frame(int(line[1:4], 16), bytes.fromhex(line[5:].decode("ascii")))
        elif line in (b"O", b"C"):
            self._open = line == b"O"
        return None

    def send(self, frame: Frame) -> None:
        if self._open:
            # A full terminal means that nobody reads; a real bus would lose it as well.
            with contextlib.suppress(BlockingIOError):
                text = f"t{frame.can_id:03X}{len(frame.data)}{frame.data.hex().upper()}\r"
                os.write(self._master, text.encode("ascii"))

    def close(self) -> None:
        os.close(self._master)
        os.close(self._terminal)


def run(arm: SimulatedArm, port: Port, feedback_hz: float, stopped: Callable[[], bool]) -> None:
    """Let the arm live on the port until `stopped` says so."""
    last = due = time.monotonic()
    tick = 0
    while not stopped():
        while (frame := port.receive(max(0.0, due - time.monotonic()))) is not None:
            for answer in arm.receive(frame):
                port.send(answer)
        now = time.monotonic()
        arm.advance(now - last)
        last, due = now, max(due + 1 / feedback_hz, now)
        for frame in arm.feedback() + (arm.motor_feedback() if tick % 5 == 0 else []):
            port.send(frame)
        tick += 1


@contextlib.contextmanager
def running(arm: SimulatedArm, port: Port, feedback_hz: float = FEEDBACK_HZ) -> Generator[None]:
    """Let the arm live on `port`, in a thread, for as long as the block."""
    stop = threading.Event()
    thread = threading.Thread(
        target=run, args=(arm, port, feedback_hz, stop.is_set), name="simulated arm", daemon=True
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
        prog="python -m rlightning_aio.envs.piper_sim",
        description="A simulated Piper arm on a pseudo-terminal. Drive it with can_interface: "
        "slcan and the printed path as channel.",
    )
    parser.add_argument(
        "--feedback-hz", type=float, default=FEEDBACK_HZ, help="reports per second (%(default)s)"
    )
    feedback_hz: float = parser.parse_args(arguments).feedback_hz
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    port = SlcanPort()
    sys.stdout.write(f"{port.path}\n")
    sys.stdout.flush()
    try:
        run(SimulatedArm(), port, feedback_hz, stop.is_set)
    finally:
        port.close()


if __name__ == "__main__":
    main()
