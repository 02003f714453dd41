"""A simulated Piper arm, driven by the vendor's CAN frames.

Rule: no I/O and no clock; frames and seconds are arguments, frames are results, so `sim` can
connect it to any bus. Frames have the layout of the vendor's protocol V2: big-endian, 8 bytes,
standard ids, angles in 0.001 degrees, lengths in 0.001 mm.
Absent on purpose: gravity, torque and contact; joints move at a limited rate.
"""

from __future__ import annotations

import math
import struct
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.plugins.piper.guard import JOINT_LIMITS, CanFrame

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

# Optional and untyped, so imported by name.
piper_sdk: Any = import_module("piper_sdk")

GRIPPER_RANGE = (0.0, 0.07)
"""Opening in m."""

JOINT_SPEED = 3.0
"""Speed of each joint at 100 %, in rad/s."""
GRIPPER_SPEED = 0.1
"""In m/s."""
ALL_MOTORS = (7, 0xFF)

# From the Denavit-Hartenberg table of the SDK's kinematics, in m.
SHOULDER = np.array([0.0, 0.0, 0.123])
HAND_LENGTH = 0.091
REACH = 0.28503 + math.hypot(0.25075, 0.02198) + 1e-4
"""Maximum distance of the wrist from the shoulder."""

NORMAL, EMERGENCY_STOP, NO_SOLUTION, TARGET_POS_EXCEEDS_LIMIT = 0, 1, 2, 4
MOVE_P, MOVE_J, MOVE_L = 0, 1, 2

_LOWS, _HIGHS = np.array(JOINT_LIMITS).T
# Starting postures that find most poses: arm forward, to either side, wrist turned.
_STARTS = tuple(
    np.array([turn, 1.5, -1.3, wrist, 0.6, 0.0]) for turn in (0, 1.3, -1.3) for wrist in (0, 1)
)


class SimulatedArm:
    """State and protocol of one arm.

    Attributes:
        joints: joint positions, [6] rad.
        targets: target positions, [6] rad.
        gripper: opening in m.
        enabled: True for each of the 6 motors with power.
        emergency_stopped: True from an emergency stop until the resume command.
    """

    def __init__(self) -> None:
        self.joints: Floats = np.zeros(6)
        self.targets: Floats = np.zeros(6)
        self.gripper = self.gripper_target = 0.0
        self.gripper_enabled = False
        self.enabled = [False] * 6
        self.emergency_stopped = False
        self._can_control = False
        self._move_mode = MOVE_J
        self._speed = 0.0
        self._refused_joints: set[int] = set()
        self._no_solution = False
        self._pose_target = [0] * 6
        self._kinematics: Any = piper_sdk.C_PiperForwardKinematics()
        self._commands: dict[int, Callable[[bytes], list[CanFrame]]] = {
            0x150: self._stop_or_resume,
            0x151: self._set_mode,
            0x152: lambda data: self._set_pose(0, data),
            0x153: lambda data: self._set_pose(2, data),
            0x154: lambda data: self._set_pose(4, data),
            0x155: lambda data: self._set_joints(0, data),
            0x156: lambda data: self._set_joints(2, data),
            0x157: lambda data: self._set_joints(4, data),
            0x159: self._set_gripper,
            0x471: self._set_power,
            0x472: self._report_limits,
            0x4AF: self._report_firmware,
        }

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        """Execute a command and return the answers; other frames are ignored."""
        command = self._commands.get(frame.can_id)
        return [] if command is None or len(frame.data) != 8 else command(frame.data)

    def advance(self, seconds: float) -> None:
        """Move towards the targets for `seconds`, at the set speed."""
        if self.emergency_stopped or not self._can_control:
            return
        reach = JOINT_SPEED * self._speed * seconds
        step = np.clip(self.targets - self.joints, -reach, reach)
        self.joints = self.joints + step * np.array(self.enabled)
        if self.gripper_enabled:
            reach = GRIPPER_SPEED * seconds
            self.gripper += min(max(self.gripper_target - self.gripper, -reach), reach)

    def feedback(self) -> list[CanFrame]:
        """Return the periodic feedback: status, end pose, joints and gripper."""
        joints = [_to_millidegrees(angle) for angle in self.joints]
        pose = [round(value * 1000) for value in self.end_pose(self.joints)]
        gripper = struct.pack(
            ">ihBB", round(self.gripper * 1e6), 0, 0x40 if self.gripper_enabled else 0, 0
        )
        return [
            CanFrame(0x2A1, self._status()),
            *(CanFrame(0x2A2 + i, struct.pack(">ii", *pose[2 * i : 2 * i + 2])) for i in range(3)),
            *(
                CanFrame(0x2A5 + i, struct.pack(">ii", *joints[2 * i : 2 * i + 2]))
                for i in range(3)
            ),
            CanFrame(0x2A8, gripper),
        ]

    def motor_feedback(self) -> list[CanFrame]:
        """Return speed, position, temperature and power of each motor."""
        frames: list[CanFrame] = []
        for motor, (angle, enabled) in enumerate(zip(self.joints, self.enabled, strict=True)):
            position = struct.pack(">hhi", 0, 0, round(angle * 1000))
            power = struct.pack(">HhbBH", 240, 30, 30, 0x40 if enabled else 0, 100)
            frames += [CanFrame(0x251 + motor, position), CanFrame(0x261 + motor, power)]
        return frames

    def end_pose(self, joints: Sequence[float] | Floats) -> list[float]:
        """End pose (x, y, z in mm, rx, ry, rz in degrees) for joint angles in rad."""
        return self._kinematics.CalFK(list(joints))[-1]

    def _status(self) -> bytes:
        if self.emergency_stopped:
            status = EMERGENCY_STOP
        elif self._refused_joints:
            status = TARGET_POS_EXCEEDS_LIMIT
        else:
            status = NO_SOLUTION if self._no_solution else NORMAL
        moving = bool(np.abs(self.targets - self.joints).max() > 1e-4)
        faults = sum(1 << (8 + joint) for joint in self._refused_joints)
        return struct.pack(
            ">BBBBBBH", self._can_control, status, self._move_mode, 0, moving, 0, faults
        )

    def _stop_or_resume(self, data: bytes) -> list[CanFrame]:
        if data[0] == 1:
            self.emergency_stopped = True
        elif data[0] == 2:
            # With the stop, the arm clears its power and errors.
            self.emergency_stopped = self._can_control = self._no_solution = False
            self.enabled = [False] * 6
            self._refused_joints.clear()
        self.targets = self.joints.copy()
        return []

    def _set_mode(self, data: bytes) -> list[CanFrame]:
        self._can_control = data[0] == 1
        self._move_mode = data[1]
        self._speed = min(data[2], 100) / 100
        return []

    def _set_joints(self, first: int, data: bytes) -> list[CanFrame]:
        if self._obeys() and self._move_mode == MOVE_J:
            self._no_solution = False
            for joint, angle in enumerate(struct.unpack(">ii", data), start=first):
                self._set_target(joint, math.radians(angle / 1000))
        return []

    def _set_target(self, joint: int, angle: float) -> None:
        low, high = JOINT_LIMITS[joint]
        if not low - 1e-4 <= angle <= high + 1e-4:
            self._refused_joints.add(joint)
            return
        self._refused_joints.discard(joint)
        self.targets[joint] = angle

    def _set_pose(self, first: int, data: bytes) -> list[CanFrame]:
        if self._obeys() and self._move_mode in (MOVE_P, MOVE_L):
            self._pose_target[first : first + 2] = struct.unpack(">ii", data)
            if first == 4:
                solution = self._solve([value / 1000 for value in self._pose_target])
                self._no_solution = solution is None
                self._refused_joints.clear()
                if solution is not None:
                    self.targets = solution
        return []

    def _set_gripper(self, data: bytes) -> list[CanFrame]:
        opening, _effort, code, _zero = struct.unpack(">iHBB", data)
        if not self.emergency_stopped:
            self.gripper_enabled = code in (1, 3)
            self.gripper_target = min(max(opening / 1e6, GRIPPER_RANGE[0]), GRIPPER_RANGE[1])
        return []

    def _set_power(self, data: bytes) -> list[CanFrame]:
        motor, flag = data[0], data[1]
        for index in range(6):
            if motor in (*ALL_MOTORS, index + 1) and flag in (1, 2):
                self.enabled[index] = flag == 2
                self.targets[index] = self.joints[index]
        return []

    def _report_limits(self, data: bytes) -> list[CanFrame]:
        motor, content = data[0], data[1]
        if not 1 <= motor <= 6:
            return []
        if content == 2:
            return [CanFrame(0x47C, struct.pack(">BH5x", motor, 500))]
        low, high = (round(math.degrees(limit) * 10) for limit in JOINT_LIMITS[motor - 1])
        return [CanFrame(0x473, struct.pack(">BhhHx", motor, high, low, round(JOINT_SPEED * 1000)))]

    def _report_firmware(self, data: bytes) -> list[CanFrame]:
        # Requests and answers have the same id, so only the request is answered.
        return [CanFrame(0x4AF, b"S-V1.8-0")] if data == bytes([1, 0, 0, 0, 0, 0, 0, 0]) else []

    def _obeys(self) -> bool:
        return self._can_control and not self.emergency_stopped

    def _solve(self, pose: list[float]) -> Floats | None:
        """Find joint angles that reach `pose`, preferably near the current ones; None if none."""
        target = _as_transform(pose)
        wrist = target[0] - target[1][:, 2] * HAND_LENGTH
        if np.linalg.norm(wrist - SHOULDER) > REACH:
            return None
        for start in (self.joints, *_STARTS):
            if (joints := self._search(target, start)) is not None:
                return joints
        return None

    def _search(self, target: tuple[Floats, Floats], start: Floats) -> Floats | None:
        """Run damped least squares on the geometric Jacobian, within the limits of the joints.

        Positions are in metres, so that they weigh as much as angles.
        """
        joints = np.clip(start, _LOWS, _HIGHS)
        for _ in range(40):
            links = [_as_transform(pose) for pose in self._kinematics.CalFK(joints.tolist())]
            error = _difference(links[-1], target)
            if np.abs(error[:3]).max() < 5e-5 and np.abs(error[3:]).max() < 5e-4:
                return joints
            # Each joint turns about the z axis of its link.
            axes = np.array([rotation[:, 2] for _, rotation in links])
            arms = links[-1][0] - np.array([position for position, _ in links])
            jacobian = np.vstack([np.cross(axes, arms).T, axes.T])
            damped = jacobian.T @ jacobian + 1e-6 * np.eye(6)
            step = np.linalg.solve(damped, jacobian.T @ error)
            joints = np.clip(joints + np.clip(step, -0.5, 0.5), _LOWS, _HIGHS)
        return None


def _to_millidegrees(angle: float) -> int:
    return round(math.degrees(angle) * 1000)


def _as_transform(pose: Sequence[float]) -> tuple[Floats, Floats]:
    """Convert x, y, z in mm and roll, pitch, yaw in degrees to position in m and rotation."""
    roll, pitch, yaw = np.radians(pose[3:])
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a), math.cos(a)) for a in (roll, pitch, yaw))
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return np.array(pose[:3]) / 1000, rotation


def _difference(start: tuple[Floats, Floats], end: tuple[Floats, Floats]) -> Floats:
    """Compute the small motion from `start` to `end`: [3] m, then [3] rad about the base axes."""
    turn = end[1] @ start[1].T
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = float(np.linalg.norm(axis)) / 2
    angle = math.atan2(sine, (float(np.trace(turn)) - 1) / 2)
    rotation = axis / 2 if sine < 1e-9 else axis / (2 * sine) * angle
    return np.concatenate([end[0] - start[0], rotation])
