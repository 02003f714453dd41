"""The connection to a Piper arm through the vendor's SDK, in SI units.

Rule: the interface uses metres, radians and seconds; the SDK's 0.001 mm and 0.001 degrees are
internal. The arm's watchdog (`watchdog`), a separate process, owns the bus; the SDK encodes
commands and parses feedback. A thread reads feedback, so that a wait ends with the frame it needs,
and sends heartbeats.
Absent on purpose: limits, rates and episodes, which are in `env`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import select
import socket
import subprocess
import sys
import threading
import time
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.plugins.piper.guard import CanFrame
from rlightning_aio.plugins.piper.watchdog import (
    BITRATE,
    MESSAGE_BYTES,
    Kind,
    feedback,
    packed,
    serve,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    import numpy.typing as npt

# Optional and untyped, so imported by name.
can: Any = import_module("can")
piper_sdk: Any = import_module("piper_sdk")

STATUS_FRAMES = frozenset({0x2A1})
POSE_FRAMES = frozenset({0x2A2, 0x2A3, 0x2A4})
JOINT_FRAMES = frozenset({0x2A5, 0x2A6, 0x2A7})
GRIPPER_FRAMES = frozenset({0x2A8})
POWER_FRAMES = frozenset(range(0x261, 0x267))

MOVE_P, MOVE_J = 0, 1

_BEATS: Final = 5
"""Number of heartbeats within the watchdog's timeout."""
_OPEN_SECONDS: Final = 30.0
"""A serial adapter takes seconds to open."""
_STOP_SECONDS: Final = 1.0
"""Time limit for a watchdog to stop the arm, before a new watchdog is started to do it."""
_END_SECONDS: Final = 5.0
_CLAIM_SECONDS: Final = 1.0
"""Time limit for the previous owner of a channel to stop the arm and release the channel."""
_BOOTSTRAP: Final = """
import json, sys
sys.path[:] = json.loads(sys.argv[2])
from rlightning_aio.plugins.piper.watchdog import main
main(sys.argv[1])
"""


class InUse(Exception):
    """Another process, or another env of this one, uses the channel."""


class ArmLink:
    """One arm on one CAN channel, which it owns exclusively on this machine.

    The SDK keeps one interface object for each channel name and process, with the last feedback, so
    a new link must wait for new frames.

    Args:
        interface: ``socketcan`` or ``slcan``, as in python-can; or ``virtual``, for a simulated
            arm in this process.
        channel: the CAN interface or serial port.
        orders: for the watchdog: ``stop``, ``timeout``, ``speed``, ``gripper_effort``; see
            `guard.ArmGuard`.

    Attributes:
        stopped_because: why the arm was stopped; empty if that was asked for without a cause, or
            it was not stopped.

    Raises:
        InUse: another process or link uses the channel.
        ConnectionError: the channel can't be opened; nothing is left open.
    """

    def __init__(self, interface: str, channel: str, orders: dict[str, Any]) -> None:
        self._interface, self._channel, self._orders = interface, channel, orders
        self._name = f"{interface} channel {channel!r}"
        self._period: float = orders["timeout"] / _BEATS
        self._changed = threading.Condition()
        self._arrivals: dict[int, int] = {}
        self._commanded: list[CanFrame] = []
        self._num_sent = 0
        self._confirmed: set[bytes] = set()
        self.stopped_because = self._own_cause = ""
        self._fault: Exception | None = None
        self._closing = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.ExitStack() as cleanup:
            self._lock = _claimed(interface, channel)
            cleanup.callback(self._lock.close)
            if interface == "virtual":
                self._program = self._watch_simulated_arm(cleanup)
            else:
                self._program = self._start_watchdog(armed=False)
                cleanup.callback(self._end_watchdog)
            self._poll = select.poll()
            self._poll.register(self._program, select.POLLIN)
            self._sdk = self._own_sdk(cleanup)
            reader = threading.Thread(target=self._read, name=f"feedback of {channel}", daemon=True)
            reader.start()
            cleanup.callback(self._stop_reading, reader)
            if not self.wait_until(lambda: Kind.OPEN in self._confirmed, _OPEN_SECONDS):
                raise ConnectionError(self._closed_hint()) from self._fault
            self._cleanup = cleanup.pop_all()

    def _watch_simulated_arm(self, cleanup: contextlib.ExitStack) -> socket.socket:
        """Run the watchdog in a thread, as a simulated arm ends with this process anyway."""
        sim: Any = import_module("rlightning_aio.plugins.piper.sim")
        port = sim.VirtualPort()
        cleanup.callback(port.close)
        cleanup.enter_context(sim.running(sim.SimulatedArm(), port))
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        watchdog = threading.Thread(
            target=serve,
            args=(theirs, port.bus, {**self._orders, "armed": False}),
            name=f"watchdog of {self._channel}",
            daemon=True,
        )
        watchdog.start()
        cleanup.callback(watchdog.join)
        cleanup.callback(ours.close)
        return ours

    def _start_watchdog(self, *, armed: bool) -> socket.socket:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        orders = {
            "interface": self._interface,
            "channel": self._channel,
            "program": theirs.fileno(),
            "armed": armed,
            **self._orders,
        }
        path = json.dumps([str(Path(entry).absolute()) for entry in sys.path])
        with theirs, self._lock as lock:
            # The watchdog inherits the lock, and releases the channel when it ends.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _BOOTSTRAP, json.dumps(orders), path],
                pass_fds=[theirs.fileno(), lock.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # A killed worker doesn't take it along: it stops the arm, and then ends.
                env={**os.environ, "RLIGHTNING_AIO_OUTLIVES": "1"},
                # Protects it from Ctrl-C, Ctrl-Z and the end of the terminal's session.
                start_new_session=True,
            )
        return ours

    def _end_watchdog(self) -> None:
        self._program.close()
        assert self._process is not None
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _own_sdk(self, cleanup: contextlib.ExitStack) -> Any:
        """Make the SDK's interface, which sends to the watchdog."""
        sdk = piper_sdk.C_PiperInterface_V2(
            can_name=self._channel, judge_flag=False, can_auto_init=False
        )
        # It must open a bus of python-can; this kind is confined to this process.
        sdk.CreateCanBus(self._channel, bustype="virtual", judge_flag=False)
        opened = sdk.GetCanBus()
        for bus in (opened.recv_bus, opened.send_bus):
            bus.shutdown()
        opened.recv_bus = opened.send_bus = _Sender(self._commanded)
        sdk.ConnectPort(piper_init=False, start_thread=False)
        cleanup.callback(sdk.DisconnectPort)
        return sdk

    def _closed_hint(self) -> str:
        if self._interface == "socketcan":
            return (
                f"{self._name} can't be opened; bring it up first: "
                f"ip link set {self._channel} up type can bitrate {BITRATE}"
            )
        if self._interface == "slcan" and find_spec("serial") is None:
            return f"{self._name} needs pyserial: pip install 'python-can[serial]<5'"
        return f"{self._name} can't be opened; is it there, and may this user read and write it?"

    def _read(self) -> None:
        due = 0.0
        try:
            while not self._closing.is_set():
                now = time.monotonic()
                if now >= due:
                    due = now + self._period
                    # A full socket has enough heartbeats.
                    with contextlib.suppress(BlockingIOError):
                        self._program.send(Kind.BEAT, socket.MSG_DONTWAIT)
                if self._poll.poll(1000 * self._period):
                    data = self._program.recv(MESSAGE_BYTES)
                    if not data:
                        raise ConnectionError("its watchdog has ended")
                    self._hear(data[:1], data[1:])
        except Exception as error:  # noqa: BLE001 - waiters get any error of the reader
            with self._changed:
                self._fault = self._fault or error
                self._changed.notify_all()

    def _hear(self, kind: bytes, content: bytes) -> None:
        taken, frames = feedback(content) if kind == Kind.FRAMES else (0, [])
        now = time.time()
        for frame in frames:
            self._sdk.ParseCANFrame(
                can.Message(timestamp=now, arbitration_id=frame.can_id, data=frame.data)
            )
        with self._changed:
            self._arrivals.update((frame.can_id, taken) for frame in frames)
            if kind == Kind.FAULT:
                self._fault = ConnectionError(content.decode())
            elif kind == Kind.STOP:
                self.stopped_because = content.decode() or self._own_cause
            elif kind == Kind.ARM:
                self.stopped_because = ""
            self._confirmed.add(kind)
            self._changed.notify_all()

    def _stop_reading(self, reader: threading.Thread) -> None:
        self._closing.set()
        reader.join()

    def close(self) -> None:
        """Leave the channel, which stops an arm that is not stopped yet."""
        self._cleanup.close()

    def _request(self, kind: bytes, content: bytes, timeout: float) -> bool:
        """Send the watchdog a request. Return True if it confirms in time."""
        self._confirmed.discard(kind)
        try:
            self._program.send(kind + content)
        except OSError:
            return False
        return self.wait_until(lambda: kind in self._confirmed, timeout)

    def arm(self, trainer_pid: int | None, timeout: float) -> None:
        """Let commands reach the arm, until `stop` or the watchdog stops it.

        Args:
            trainer_pid: a process whose end or suspension also stops the arm.
            timeout: seconds to wait for the watchdog to confirm.

        Raises:
            ConnectionError: the watchdog didn't confirm.
        """
        if not self._request(Kind.ARM, b"%d" % (trainer_pid or 0), timeout):
            cause = self._fault or f"it did not answer for {timeout:g} s"
            raise ConnectionError(f"the watchdog of the arm on {self._name} is gone: {cause}")

    def stop(self, cause: str = "") -> None:
        """Make the safe stop. If the watchdog can't, start another one that only does this.

        Args:
            cause: what `stopped_because` says from now on.
        """
        self._own_cause = cause
        if self._request(Kind.STOP, b"", _STOP_SECONDS) or self._process is None:
            return
        self._fault = self._fault or ConnectionError("its watchdog did not answer")
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(InUse):
            self._lock = _claimed(self._interface, self._channel)
            self._start_watchdog(armed=True).close()
            self._process.wait(_END_SECONDS)

    def check_watchdog(self) -> None:
        """Mark the link as lost if the watchdog of a stopped arm doesn't answer."""
        if not self.is_lost and not self._request(Kind.STOP, b"", _STOP_SECONDS):
            self._fault = self._fault or ConnectionError("its watchdog does not answer")
            if self._process is not None:
                self._process.kill()

    @property
    def is_lost(self) -> bool:
        """True if the watchdog or the bus is gone; only a new link reaches the arm."""
        return self._fault is not None

    def mark(self) -> int:
        """Send pending commands. Return a number for `wait_for_feedback` of newer feedback."""
        self._num_sent += 1
        data = Kind.FRAMES + packed(self._commanded)
        self._commanded.clear()
        # The wait for feedback detects a dead watchdog.
        with contextlib.suppress(OSError):
            self._program.send(data)
        return self._num_sent

    def wait_for_feedback(self, frames: Iterable[int], since: int, timeout: float) -> None:
        """Wait until each of `frames` has come after the `mark` that returned `since`.

        Raises:
            ConnectionError: the bus failed, or `timeout` seconds passed first.
        """
        if self.wait_until(lambda: not self._missing(frames, since), timeout):
            return
        missing = ", ".join(f"0x{frame:X}" for frame in sorted(self._missing(frames, since)))
        cause = f": {self._fault}" if self._fault else f" for {timeout:g} s (missing {missing})"
        raise ConnectionError(
            f"no feedback from the arm on {self._name}{cause}; is it powered and connected? "
            "reset() connects again"
        ) from self._fault

    def _missing(self, frames: Iterable[int], since: int) -> set[int]:
        return {frame for frame in frames if self._arrivals.get(frame, -1) < since}

    def wait_until(self, done: Callable[[], bool], timeout: float) -> bool:
        """Wait for a message that makes `done` true. Return False on a fault or a timeout."""
        with self._changed:
            self._changed.wait_for(lambda: done() or self._fault is not None, timeout)
            return done()

    def joints(self) -> npt.NDArray[np.float64]:
        """Joint positions, [6] rad."""
        state = self._sdk.GetArmJointMsgs().joint_state
        return np.radians([getattr(state, f"joint_{i}") / 1000 for i in range(1, 7)])

    def end_pose(self) -> npt.NDArray[np.float64]:
        """End pose, [6]: x, y, z in m, then rx, ry, rz in rad."""
        pose = self._sdk.GetArmEndPoseMsgs().end_pose
        position = [pose.X_axis / 1e6, pose.Y_axis / 1e6, pose.Z_axis / 1e6]
        turns = [pose.RX_axis / 1000, pose.RY_axis / 1000, pose.RZ_axis / 1000]
        return np.array([*position, *np.radians(turns)])

    def gripper(self) -> float:
        """Opening of the gripper in m."""
        return self._sdk.GetArmGripperMsgs().gripper_state.grippers_angle / 1e6

    def status(self) -> str:
        """State that the arm reports: ``NORMAL``, ``EMERGENCY_STOP``, …"""
        return self._sdk.GetArmStatus().arm_status.arm_status.name

    def is_enabled(self) -> bool:
        """Return True if all six motors have power."""
        return all(self._sdk.GetArmEnableStatus())

    def enable(self, timeout: float) -> None:
        """Switch the six motors on, unless the arm is stopped meanwhile.

        Raises:
            TimeoutError: they aren't on after `timeout` seconds.
        """
        deadline = time.monotonic() + timeout
        while True:
            self._sdk.EnablePiper()
            sent = self.mark()
            # Repeated, because the bus may lose frames; motors report at least every 0.1 s.
            self.wait_until(lambda since=sent: not self._missing(POWER_FRAMES, since), 0.2)
            if self.stopped_because:
                return
            if self.is_enabled() and not self._missing(POWER_FRAMES, sent):
                return
            if time.monotonic() >= deadline:
                raise TimeoutError(
                    f"the motors on {self._name} are not enabled after {timeout:g} s; "
                    f"the arm reports {self.status()}"
                )

    def command_joints(self, joints: Sequence[float], speed: int) -> None:
        """Go to joint positions [6] in rad, at `speed` percent."""
        self._sdk.MotionCtrl_2(1, MOVE_J, speed, 0)
        self._sdk.JointCtrl(*(_to_millidegrees(angle) for angle in joints))
        self.mark()

    def command_pose(self, pose: Sequence[float], speed: int) -> None:
        """Go to an end pose [6] in m and rad, at `speed` percent."""
        self._sdk.MotionCtrl_2(1, MOVE_P, speed, 0)
        position = (round(value * 1e6) for value in pose[:3])
        self._sdk.EndPoseCtrl(*position, *(_to_millidegrees(angle) for angle in pose[3:]))
        self.mark()

    def command_gripper(self, opening: float, effort: float) -> None:
        """Open or close to `opening` in m, with at most `effort` in N·m."""
        self._sdk.GripperCtrl(round(opening * 1e6), round(effort * 1000), 1, 0)
        self.mark()

    def resume(self) -> None:
        """End an emergency stop. The arm switches its motors off, and may fall."""
        self._sdk.MotionCtrl_1(2, 0, 0)
        self.mark()


class _Sender(can.BusABC):
    """The SDK's bus: it only collects frames to send."""

    def __init__(self, commanded: list[CanFrame]) -> None:
        super().__init__("the watchdog")  # pyright: ignore[reportUnknownMemberType]
        self._commanded = commanded

    def send(self, msg: Any, timeout: float | None = None) -> None:
        del timeout
        self._commanded.append(CanFrame(msg.arbitration_id, bytes(msg.data)))


def _claimed(interface: str, channel: str) -> socket.socket:
    """Lock a channel, until the last process with the socket has closed it.

    Raises:
        InUse: another process hasn't released it in time; the message names it.
    """
    name = channel
    if interface == "virtual":
        name = f"{os.getpid()}:{channel}"  # Each process has its own.
    elif interface == "slcan":
        name = str(Path(channel).resolve())  # A serial port has many names.
    # A path may be longer than an address.
    address = f"\0rlightning_aio.piper:{interface}:{hashlib.sha256(name.encode()).hexdigest()}"
    lock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    until = time.monotonic() + _CLAIM_SECONDS
    while True:
        try:
            lock.bind(address)
            # Lets `_holder` find this process.
            lock.listen(0)
        except OSError:
            if time.monotonic() < until:
                time.sleep(0.02)
                continue
            lock.close()
            raise InUse(f"{channel!r} is in use by {_holder(address)}") from None
        return lock


def _holder(address: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as caller:
        try:
            caller.setblocking(False)
            caller.connect(address)
            credentials = caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        except OSError:
            return "another process"
        pid = int.from_bytes(credentials[:4], sys.byteorder)
    return "another env of this process" if pid == os.getpid() else f"process {pid}"


def _to_millidegrees(angle: float) -> int:
    return round(math.degrees(angle) * 1000)
