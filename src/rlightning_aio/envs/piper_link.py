"""The connection to a Piper arm through the vendor's SDK, in SI units.

Rule: metres, radians and seconds on this side; the SDK's 0.001 mm and 0.001 degrees
stay in here. Frames are read by a thread of ours, so that a wait ends with the frame it
waits for and a lost bus is noticed; the SDK parses and sends.
Absent on purpose: limits, rates and episodes, which are `piper`'s.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    import numpy.typing as npt

# Optional and untyped, so imported by name.
piper_sdk: Any = import_module("piper_sdk")

__all__ = ["GRIPPER_FRAMES", "JOINT_FRAMES", "POSE_FRAMES", "STATUS_FRAMES", "ArmLink"]

STATUS_FRAMES = frozenset({0x2A1})
POSE_FRAMES = frozenset({0x2A2, 0x2A3, 0x2A4})
JOINT_FRAMES = frozenset({0x2A5, 0x2A6, 0x2A7})
GRIPPER_FRAMES = frozenset({0x2A8})
POWER_FRAMES = frozenset(range(0x261, 0x267))

BITRATE = 1_000_000
FRESH = 0.5
"""Feedback older than this, in seconds, says nothing about where the arm is."""
MOVE_P, MOVE_J = 0, 1
ALL_MOTORS = 7


class ArmLink:
    """One arm on one CAN channel.

    The SDK keeps one interface object for each channel name and process, with what it
    last heard; that is why a new link waits for new frames before it believes anything.

    Args:
        interface: python-can's name: ``socketcan``, ``slcan`` or ``virtual``. On
            ``virtual``, which reaches this process only, the link brings a simulated arm.
        channel: the CAN interface or serial port.

    Raises:
        ConnectionError: the channel can't be opened; nothing is left open.
    """

    def __init__(self, interface: str, channel: str) -> None:
        self._name = f"{interface} channel {channel!r}"
        self._arrived = threading.Condition()
        self._arrivals: dict[int, float] = {}
        self._fault: Exception | None = None
        self._closing = threading.Event()
        with contextlib.ExitStack() as cleanup:
            if interface == "virtual":
                sim: Any = import_module("rlightning_aio.envs.piper_sim")
                port = sim.VirtualPort(channel)
                cleanup.callback(port.close)
                cleanup.enter_context(sim.running(sim.SimulatedArm(), port))
            self._sdk: Any = piper_sdk.C_PiperInterface_V2(
                can_name=channel, judge_flag=False, can_auto_init=False
            )
            bus = self._open(interface, channel)
            cleanup.callback(self._sdk.DisconnectPort)
            self._sdk.ConnectPort(start_thread=False)
            reader = threading.Thread(
                target=self._read, args=(bus,), name=f"feedback of {channel}", daemon=True
            )
            reader.start()
            cleanup.callback(self._stop_reading, reader)
            self._cleanup = cleanup.pop_all()

    def _open(self, interface: str, channel: str) -> Any:
        try:
            self._sdk.CreateCanBus(
                channel, bustype=interface, expected_bitrate=BITRATE, judge_flag=False
            )
        except ConnectionError as error:
            raise ConnectionError(self._closed_hint(interface, channel)) from error
        opened = self._sdk.GetCanBus()
        if opened.recv_bus is None:
            raise ConnectionError(self._closed_hint(interface, channel))
        if interface == "virtual":
            # The SDK opens one bus to receive and one to send. Nobody reads the second,
            # and on this interface what isn't read is kept for ever.
            opened.send_bus.shutdown()
            opened.send_bus = opened.recv_bus
        return opened.recv_bus

    def _closed_hint(self, interface: str, channel: str) -> str:
        if interface == "socketcan":
            return (
                f"{self._name} can't be opened; bring it up first: "
                f"ip link set {channel} up type can bitrate {BITRATE}"
            )
        if interface == "slcan" and find_spec("serial") is None:
            return f"{self._name} needs pyserial: pip install 'python-can[serial]<5'"
        return f"{self._name} can't be opened; is it there, and may this user read and write it?"

    def _read(self, bus: Any) -> None:
        try:
            while not self._closing.is_set():
                message = bus.recv(0.1)
                if message is None or len(message.data) != 8:
                    continue
                self._sdk.ParseCANFrame(message)
                with self._arrived:
                    self._arrivals[message.arbitration_id] = time.monotonic()
                    self._arrived.notify_all()
        except Exception as error:  # noqa: BLE001 - whatever ends the reading reaches the waiter
            with self._arrived:
                self._fault = error
                self._arrived.notify_all()

    def _stop_reading(self, reader: threading.Thread) -> None:
        self._closing.set()
        reader.join()

    def close(self) -> None:
        """Leave the channel; the arm keeps doing what it was last told."""
        self._cleanup.close()

    def wait_for_feedback(self, frames: Iterable[int], since: float, timeout: float) -> None:
        """Wait until each of these frames has come after `since` (on the monotonic clock).

        Raises:
            ConnectionError: the bus failed, or `timeout` seconds passed first.
        """
        if self._wait(lambda: not self._missing(frames, since), timeout):
            return
        missing = ", ".join(f"0x{frame:X}" for frame in sorted(self._missing(frames, since)))
        cause = f": {self._fault}" if self._fault else f" for {timeout:g} s (missing {missing})"
        raise ConnectionError(
            f"no feedback from the arm on {self._name}{cause}; is it powered and connected?"
        ) from self._fault

    def _missing(self, frames: Iterable[int], since: float) -> set[int]:
        return {frame for frame in frames if self._arrivals.get(frame, -math.inf) <= since}

    def _wait(self, done: Callable[[], bool], timeout: float) -> bool:
        with self._arrived:
            self._arrived.wait_for(lambda: done() or self._fault is not None, timeout)
            return done()

    def wait_until(self, done: Callable[[], bool], timeout: float) -> bool:
        """Wait for feedback that makes `done` true; whether it became so in `timeout` seconds."""
        return self._wait(done, timeout)

    def joints(self) -> npt.NDArray[np.float64]:
        """Joint positions, [6] rad."""
        state = self._sdk.GetArmJointMsgs().joint_state
        return np.radians([getattr(state, f"joint_{i}") / 1000 for i in range(1, 7)])

    def end_pose(self) -> npt.NDArray[np.float64]:
        """X, y, z in m, then rx, ry, rz in rad: [6]."""
        pose = self._sdk.GetArmEndPoseMsgs().end_pose
        position = [pose.X_axis / 1e6, pose.Y_axis / 1e6, pose.Z_axis / 1e6]
        turns = [pose.RX_axis / 1000, pose.RY_axis / 1000, pose.RZ_axis / 1000]
        return np.array([*position, *np.radians(turns)])

    def gripper(self) -> float:
        """Opening of the gripper in m."""
        return self._sdk.GetArmGripperMsgs().gripper_state.grippers_angle / 1e6

    def status(self) -> str:
        """The arm's own word for its state: ``NORMAL``, ``EMERGENCY_STOP``, …"""
        return self._sdk.GetArmStatus().arm_status.arm_status.name

    def is_enabled(self) -> bool:
        """Whether all six motors have power."""
        return all(self._sdk.GetArmEnableStatus())

    def enable(self, timeout: float) -> None:
        """Switch the six motors on.

        Raises:
            TimeoutError: they aren't on after `timeout` seconds.
        """
        deadline = time.monotonic() + timeout
        while True:
            asked = time.monotonic()
            self._sdk.EnablePiper()
            # The command is repeated, since a bus may lose it; motors report ten times a
            # second or more.
            self._wait(lambda since=asked: not self._missing(POWER_FRAMES, since), 0.2)
            if self.is_enabled() and not self._missing(POWER_FRAMES, asked):
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

    def command_pose(self, pose: Sequence[float], speed: int) -> None:
        """Go to an end pose [6] in m and rad, at `speed` percent."""
        self._sdk.MotionCtrl_2(1, MOVE_P, speed, 0)
        position = (round(value * 1e6) for value in pose[:3])
        self._sdk.EndPoseCtrl(*position, *(_to_millidegrees(angle) for angle in pose[3:]))

    def command_gripper(self, opening: float, effort: float) -> None:
        """Open or close to `opening` in m, with at most `effort` in N·m."""
        self._sdk.GripperCtrl(round(opening * 1e6), round(effort * 1000), 1, 0)

    def hold(self, speed: int) -> None:
        """Stay where the arm is; without fresh feedback that is unknown, so stop it instead."""
        if self._missing(JOINT_FRAMES, time.monotonic() - FRESH):
            self.emergency_stop()
        else:
            self.command_joints(self.joints().tolist(), speed)

    def emergency_stop(self) -> None:
        """The arm's own emergency stop, which lasts until `resume`."""
        self._sdk.MotionCtrl_1(1, 0, 0)

    def resume(self) -> None:
        """End an emergency stop. The arm drops its power and falls, if it hasn't yet."""
        self._sdk.MotionCtrl_1(2, 0, 0)

    def disable(self) -> None:
        """Switch the motors off. The arm falls."""
        self._sdk.DisableArm(ALL_MOTORS)


def _to_millidegrees(angle: float) -> int:
    return round(math.degrees(angle) * 1000)
