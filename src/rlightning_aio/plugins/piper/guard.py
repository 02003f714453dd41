"""`ArmGuard`: filters commands to a Piper arm, and makes its safe stop.

Rule: no I/O and no clock; frames and seconds are arguments, frames are results. Commands pass only
between `arm` and the next stop, so a late command moves nothing. The position of the arm and the
state of its gripper, which a stop needs, are read from the frames in both directions. Frames have
the layout of the vendor's protocol V2, as in `arm`.
Absent on purpose: numpy and the SDK, because this runs in a small process (`watchdog`).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

SafeStop = Literal["hold", "emergency_stop", "disable"]

JOINT_LIMITS: Final = (
    (-2.6179, 2.6179),
    (0.0, 3.14),
    (-2.967, 0.0),
    (-1.745, 1.745),
    (-1.22, 1.22),
    (-2.09439, 2.09439),
)
"""Limits of each joint in rad, from the vendor's SDK."""

MODE, GRIPPER, POWER, STOP = 0x151, 0x159, 0x471, 0x150
JOINTS: Final = (0x155, 0x156, 0x157)
JOINT_FEEDBACK: Final = (0x2A5, 0x2A6, 0x2A7)
GRIPPER_FEEDBACK: Final = 0x2A8

_REPEATS: Final = 3
"""Number of times that a stop is sent, because a bus may lose frames."""
_PAUSE: Final = 0.02
_LOOK: Final = 0.005
_FRESH: Final = 0.1
"""Maximum age in seconds of feedback that gives the position for a hold."""
_PATIENCE: Final = 0.25
"""Seconds until an arm without feedback gets an emergency stop instead of a hold."""
_STILL: Final = 0.25
"""Seconds after which a gripper that doesn't move has arrived, or grips an object."""
_STILL_WITHIN: Final = 200
"""Largest motion that counts as standing still, in 0.001 mm."""
_MAX_OPENING: Final = 70_000


class CanFrame(NamedTuple):
    """One standard CAN frame."""

    can_id: int
    data: bytes


@dataclass
class _Gripper:
    """The known state of the gripper; lengths in 0.001 mm, effort in 0.001 N·m."""

    effort: int
    opening: int | None = None
    commanded: int | None = None
    still_at: int = 0
    still_since: float = math.inf

    def heard(self, opening: int, now: float) -> None:
        self.opening = opening
        if abs(opening - self.still_at) > _STILL_WITHIN:
            self.still_at, self.still_since = opening, now

    def sent(self, target: int, now: float) -> None:
        # If it presses already, and must continue to press, the command doesn't move it.
        if target != self.commanded and not (
            self._presses(self.commanded) and self._presses(target)
        ):
            self.still_since = now
        self.commanded = target

    def _presses(self, target: int | None) -> bool:
        """Return True if the gripper must close further to reach `target`."""
        inside = (self.opening or 0) - _STILL_WITHIN
        return target is not None and target < inside


class ArmGuard:
    """Filters the commands of one program to one arm.

    Args:
        stop: the kind of safe stop.
        timeout: seconds without a heartbeat (`beat`) after which the arm is stopped.
        speed: percent, for the command of a hold.
        gripper_effort: for holding the gripper, in 0.001 N·m; None without a gripper.

    Attributes:
        armed: True while commands pass.
        stopping: True until a stop that has begun was sent often enough.
        cause: reason of the last stop.
    """

    def __init__(
        self, stop: SafeStop, timeout: float, speed: int, gripper_effort: int | None
    ) -> None:
        self.armed = False
        self.stopping = False
        self.cause = ""
        self._stop: SafeStop = stop
        self._timeout = timeout
        self._beat = 0.0
        self._speed = speed
        self._joints: dict[int, tuple[float, bytes]] = {}
        self._gripper = None if gripper_effort is None else _Gripper(gripper_effort)
        self._how: SafeStop = stop
        self._began = 0.0
        self._num_sent = 0
        self._send_again_at = 0.0

    def arm(self, now: float) -> None:
        """Let commands pass, as long as heartbeats come."""
        self.armed, self.stopping, self._beat = True, False, now

    def beat(self, now: float) -> None:
        """Record a heartbeat of the program."""
        self._beat = now

    def passes(self, frame: CanFrame, now: float) -> bool:
        """Return True if a command of the program may reach the arm, and record it."""
        if not self.armed:
            return False
        if frame.can_id == GRIPPER and self._gripper is not None:
            self._gripper.sent(struct.unpack_from(">i", frame.data)[0], now)
        return True

    def heard(self, frame: CanFrame, now: float) -> None:
        """Record feedback of the arm."""
        if frame.can_id in JOINT_FEEDBACK:
            self._joints[frame.can_id] = (now, frame.data)
        elif frame.can_id == GRIPPER_FEEDBACK and self._gripper is not None:
            self._gripper.heard(struct.unpack_from(">i", frame.data)[0], now)

    def stop(self, cause: str, now: float) -> None:
        """Begin the safe stop if the guard is armed; `act` returns its frames."""
        if self.armed:
            self.armed, self.stopping, self.cause = False, True, cause
            self._how, self._began, self._num_sent, self._send_again_at = self._stop, now, 0, now

    def act(self, now: float) -> list[CanFrame]:
        """Begin a stop if the heartbeat is late. Return the frames to send now."""
        if self.armed and now - self._beat > self._timeout:
            self.stop(f"it gave no sign of life for {self._timeout:g} s", now)
        if not self.stopping or now < self._send_again_at:
            return []
        frames = self._held(now) if self._how == "hold" else self._cut()
        self._send_again_at = now + (_PAUSE if frames else _LOOK)
        self.stopping = self._num_sent < _REPEATS
        return frames

    def not_sent(self) -> None:
        """Record that the bus didn't accept the last frames of `act`."""
        self._num_sent = max(0, self._num_sent - 1)
        self.stopping = True

    def wait(self, now: float) -> float | None:
        """Maximum number of seconds until the next call of `act`; None if none is needed."""
        if self.stopping:
            return max(0.001, self._send_again_at - now)
        return max(0.001, self._beat + self._timeout - now) if self.armed else None

    def _held(self, now: float) -> list[CanFrame]:
        """Hold the position of the feedback; only feedback after the stop began counts as final.

        Without such feedback, use the arm's emergency stop.
        """
        known = min(self._joints.get(i, (-math.inf, b""))[0] for i in JOINT_FEEDBACK)
        if known > self._began:
            self._num_sent += 1
        elif now - self._began > _PATIENCE:
            self._how = "emergency_stop"
            return self._cut()
        elif now - known > _FRESH:
            return []
        targets = [n for i in JOINT_FEEDBACK for n in struct.unpack(">ii", self._joints[i][1])]
        # Without power the arm may be beyond its limits, where it would refuse the target.
        inside = [
            min(max(n, math.ceil(math.degrees(low) * 1000)), math.floor(math.degrees(high) * 1000))
            for n, (low, high) in zip(targets, JOINT_LIMITS, strict=True)
        ]
        return [
            *self._held_gripper(now),
            CanFrame(MODE, bytes([1, 1, self._speed, 0, 0, 0, 0, 0])),
            *(
                CanFrame(JOINTS[k], struct.pack(">ii", inside[2 * k], inside[2 * k + 1]))
                for k in range(3)
            ),
        ]

    def _held_gripper(self, now: float) -> list[CanFrame]:
        """Hold the opening of a moving gripper; one that grips an object continues to."""
        gripper = self._gripper
        if gripper is None or gripper.opening is None:
            return []
        if self._began - gripper.still_since > _STILL:
            return []
        opening = min(max(gripper.opening, 0), _MAX_OPENING)
        gripper.sent(opening, now)
        return [CanFrame(GRIPPER, struct.pack(">iHBB", opening, gripper.effort, 1, 0))]

    def _cut(self) -> list[CanFrame]:
        """Return the arm's emergency stop, or switch off all motors, including the gripper's."""
        self._num_sent += 1
        if self._how == "emergency_stop":
            return [
                *self._held_gripper(self._began),
                CanFrame(STOP, bytes([1, 0, 0, 0, 0, 0, 0, 0])),
            ]
        frames = [CanFrame(POWER, bytes([7, 1, 0, 0, 0, 0, 0, 0]))]
        if self._gripper is not None:
            frames.append(
                CanFrame(GRIPPER, struct.pack(">iHBB", self._gripper.opening or 0, 0, 0, 0))
            )
        return frames
