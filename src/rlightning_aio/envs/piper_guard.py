"""`ArmGuard`: which commands reach a Piper arm, and how it is brought to its safe stop.

Rule: no I/O and no clock; frames and seconds come in, frames go out. Nothing passes but
between `arm` and the next stop, so a command that comes late moves nothing. What a stop
needs to know, where the arm is and what its gripper does, is read from the frames that
pass by. Layouts are those of the vendor's protocol V2, as in `piper_arm`.
Absent on purpose: numpy and the SDK. It runs in a small process, see `piper_watchdog`.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

__all__ = ["JOINT_LIMITS", "ArmGuard", "Frame", "SafeStop"]

SafeStop = Literal["hold", "emergency_stop", "disable"]

JOINT_LIMITS: Final = (
    (-2.6179, 2.6179),
    (0.0, 3.14),
    (-2.967, 0.0),
    (-1.745, 1.745),
    (-1.22, 1.22),
    (-2.09439, 2.09439),
)
"""Of each joint, in rad, as the vendor's SDK states them."""

MODE, GRIPPER, POWER, STOP = 0x151, 0x159, 0x471, 0x150
JOINTS: Final = (0x155, 0x156, 0x157)
JOINT_FEEDBACK: Final = (0x2A5, 0x2A6, 0x2A7)
GRIPPER_FEEDBACK: Final = 0x2A8

_REPEATS: Final = 3
"""How often a stop is said, since a bus may lose it."""
_PAUSE: Final = 0.02
_LOOK: Final = 0.005
_FRESH: Final = 0.1
"""Feedback older than this, in seconds, is not held at."""
_PATIENCE: Final = 0.25
"""Seconds until an arm that says nothing gets an emergency stop for a hold."""
_STILL: Final = 0.25
"""Seconds after which a gripper that has not moved has arrived, or has something in its grip."""
_STILL_WITHIN: Final = 200
"""What counts as not having moved, in 0.001 mm."""
_MAX_OPENING: Final = 70_000


class Frame(NamedTuple):
    """One standard CAN frame."""

    can_id: int
    data: bytes


@dataclass
class _Gripper:
    """What is known of one; lengths in 0.001 mm, effort in 0.001 N·m."""

    effort: int
    opening: int | None = None
    commanded: int | None = None
    still_at: int = 0
    still_since: float = math.inf

    def heard(self, opening: int, now: float) -> None:
        self.opening = opening
        if abs(opening - self.still_at) > _STILL_WITHIN:
            self.still_at, self.still_since = opening, now

    def told(self, target: int, now: float) -> None:
        # What presses already, and is told to press on, has not been set in motion.
        if target != self.commanded and not (
            self._presses(self.commanded) and self._presses(target)
        ):
            self.still_since = now
        self.commanded = target

    def _presses(self, target: int | None) -> bool:
        """Whether a gripper that goes to `target` would have to close further."""
        inside = (self.opening or 0) - _STILL_WITHIN
        return target is not None and target < inside


class ArmGuard:
    """Stands between one program and one arm.

    Args:
        stop: what a safe stop is.
        timeout: seconds without a sign of life (`beat`) after which the arm is stopped.
        speed: percent, at which a hold is said.
        gripper_effort: of a gripper that is held, in 0.001 N·m; None if there is none.

    Attributes:
        armed: commands pass.
        stopping: a stop has begun, and has not been said often enough yet.
        cause: why the arm was stopped last.
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
        self._said = 0
        self._say_again = 0.0

    def arm(self, now: float) -> None:
        """Let commands pass from now on, for as long as signs of life come."""
        self.armed, self.stopping, self._beat = True, False, now

    def beat(self, now: float) -> None:
        """A sign of life of the program."""
        self._beat = now

    def passes(self, frame: Frame, now: float) -> bool:
        """Whether a command of the program may reach the arm."""
        if not self.armed:
            return False
        if frame.can_id == GRIPPER and self._gripper is not None:
            self._gripper.told(struct.unpack_from(">i", frame.data)[0], now)
        return True

    def heard(self, frame: Frame, now: float) -> None:
        """Take note of what the arm reports."""
        if frame.can_id in JOINT_FEEDBACK:
            self._joints[frame.can_id] = (now, frame.data)
        elif frame.can_id == GRIPPER_FEEDBACK and self._gripper is not None:
            self._gripper.heard(struct.unpack_from(">i", frame.data)[0], now)

    def stop(self, cause: str, now: float) -> None:
        """Begin the safe stop, if the arm may be moving; `act` says what to send for it."""
        if self.armed:
            self.armed, self.stopping, self.cause = False, True, cause
            self._how, self._began, self._said, self._say_again = self._stop, now, 0, now

    def act(self, now: float) -> list[Frame]:
        """Stop if no sign of life came in time; what is to be sent now."""
        if self.armed and now - self._beat > self._timeout:
            self.stop(f"it gave no sign of life for {self._timeout:g} s", now)
        if not self.stopping or now < self._say_again:
            return []
        frames = self._held(now) if self._how == "hold" else self._cut()
        self._say_again = now + (_PAUSE if frames else _LOOK)
        self.stopping = self._said < _REPEATS
        return frames

    def not_sent(self) -> None:
        """The bus didn't take what `act` had to say last, so it counts as unsaid."""
        self._said = max(0, self._said - 1)
        self.stopping = True

    def wait(self, now: float) -> float | None:
        """Seconds until `act` must be called at the latest; None if there is nothing to do."""
        if self.stopping:
            return max(0.001, self._say_again - now)
        return max(0.001, self._beat + self._timeout - now) if self.armed else None

    def _held(self, now: float) -> list[Frame]:
        """Stay where the feedback says the arm is; said last with what came after the stop began.

        Unless that is known, the arm's own stop has to do.
        """
        known = min(self._joints.get(i, (-math.inf, b""))[0] for i in JOINT_FEEDBACK)
        if known > self._began:
            self._said += 1
        elif now - self._began > _PATIENCE:
            self._how = "emergency_stop"
            return self._cut()
        elif now - known > _FRESH:
            return []
        targets = [n for i in JOINT_FEEDBACK for n in struct.unpack(">ii", self._joints[i][1])]
        # Beyond its limits, where it may lie when it is off, the arm would take no target.
        inside = [
            min(max(n, math.ceil(math.degrees(low) * 1000)), math.floor(math.degrees(high) * 1000))
            for n, (low, high) in zip(targets, JOINT_LIMITS, strict=True)
        ]
        return [
            *self._held_gripper(now),
            Frame(MODE, bytes([1, 1, self._speed, 0, 0, 0, 0, 0])),
            *(
                Frame(JOINTS[k], struct.pack(">ii", inside[2 * k], inside[2 * k + 1]))
                for k in range(3)
            ),
        ]

    def _held_gripper(self, now: float) -> list[Frame]:
        """Keep the gripper where it is. One that grips something goes on gripping it."""
        gripper = self._gripper
        if gripper is None or gripper.opening is None:
            return []
        if self._began - gripper.still_since > _STILL:
            return []
        opening = min(max(gripper.opening, 0), _MAX_OPENING)
        gripper.told(opening, now)
        return [Frame(GRIPPER, struct.pack(">iHBB", opening, gripper.effort, 1, 0))]

    def _cut(self) -> list[Frame]:
        """The arm's own stop, or its motors off, the gripper's included."""
        self._said += 1
        if self._how == "emergency_stop":
            return [*self._held_gripper(self._began), Frame(STOP, bytes([1, 0, 0, 0, 0, 0, 0, 0]))]
        frames = [Frame(POWER, bytes([7, 1, 0, 0, 0, 0, 0, 0]))]
        if self._gripper is not None:
            frames.append(Frame(GRIPPER, struct.pack(">iHBB", self._gripper.opening or 0, 0, 0, 0)))
        return frames
