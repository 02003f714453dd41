"""The simulated arm, frame by frame, without a bus."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

piper_sdk: Any = pytest.importorskip("piper_sdk")

from rlightning_aio.plugins.piper import arm as arm_module  # noqa: E402 - needs the SDK
from rlightning_aio.plugins.piper.arm import (  # noqa: E402
    GRIPPER_RANGE,
    JOINT_LIMITS,
    JOINT_SPEED,
    CanFrame,
    SimulatedArm,
)

pytestmark = pytest.mark.simulators

ON = CanFrame(0x471, bytes([7, 2, 0, 0, 0, 0, 0, 0]))
STOP = CanFrame(0x150, bytes([1, 0, 0, 0, 0, 0, 0, 0]))
RESUME = CanFrame(0x150, bytes([2, 0, 0, 0, 0, 0, 0, 0]))


def mode(move: int, speed: int) -> CanFrame:
    return CanFrame(0x151, bytes([1, move, speed, 0, 0, 0, 0, 0]))


def joint_frames(degrees: list[float]) -> list[CanFrame]:
    values = [round(angle * 1000) for angle in degrees]
    return [CanFrame(0x155 + i, struct.pack(">ii", *values[2 * i : 2 * i + 2])) for i in range(3)]


def pose_frames(pose: list[float]) -> list[CanFrame]:
    values = [round(value * 1000) for value in pose]
    return [CanFrame(0x152 + i, struct.pack(">ii", *values[2 * i : 2 * i + 2])) for i in range(3)]


def started(move: int = 1, speed: int = 100) -> SimulatedArm:
    arm = SimulatedArm()
    arm.receive(ON)
    arm.receive(mode(move, speed))
    return arm


def status_of(arm: SimulatedArm) -> int:
    return arm.feedback()[0].data[1]


class ArmMachine(RuleBasedStateMachine):
    """Any frames in any order, known ones and noise, with time passing between them."""

    def __init__(self) -> None:
        super().__init__()
        self.arm = SimulatedArm()
        self.stopped = False

    @rule(on=st.booleans(), motor=st.integers(0, 8))
    def power(self, on: bool, motor: int) -> None:
        self.arm.receive(CanFrame(0x471, bytes([motor, 2 if on else 1, 0, 0, 0, 0, 0, 0])))

    @rule(speed=st.integers(0, 255), move=st.integers(0, 5))
    def set_mode(self, speed: int, move: int) -> None:
        self.arm.receive(mode(move, speed))

    @rule(degrees=st.lists(st.floats(-400, 400), min_size=6, max_size=6))
    def go(self, degrees: list[float]) -> None:
        for frame in joint_frames(degrees):
            self.arm.receive(frame)

    @rule(opening=st.integers(-(2**31), 2**31 - 1), code=st.integers(0, 255))
    def grip(self, opening: int, code: int) -> None:
        self.arm.receive(CanFrame(0x159, struct.pack(">iHBB", opening, 1000, code, 0)))

    @rule(stop=st.booleans())
    def emergency(self, stop: bool) -> None:
        self.arm.receive(STOP if stop else RESUME)
        self.stopped = stop

    @rule(can_id=st.integers(0x160, 0x7FF), data=st.binary(max_size=8))
    def noise(self, can_id: int, data: bytes) -> None:
        if can_id != 0x471:
            self.arm.receive(CanFrame(can_id, data))

    @rule(seconds=st.floats(0.001, 1.0))
    def wait(self, seconds: float) -> None:
        before, gripper = self.arm.joints.copy(), self.arm.gripper
        self.arm.advance(seconds)
        moved = np.abs(self.arm.joints - before)
        assert moved.max() <= JOINT_SPEED * seconds + 1e-9
        assert not moved[~np.array(self.arm.enabled)].any()
        if self.stopped:
            assert not moved.any()
            assert self.arm.gripper == gripper

    @invariant()
    def stays_within_limits(self) -> None:
        for angle, (low, high) in zip(self.arm.joints, JOINT_LIMITS, strict=True):
            assert low - 1e-3 <= angle <= high + 1e-3
        assert GRIPPER_RANGE[0] <= self.arm.gripper <= GRIPPER_RANGE[1]

    @invariant()
    def reports_well_formed_frames(self) -> None:
        frames = self.arm.feedback() + self.arm.motor_feedback()
        assert all(len(frame.data) == 8 for frame in frames)
        assert (status_of(self.arm) == 1) == self.stopped


TestArmMachine = pytest.mark.simulators(ArmMachine.TestCase)
TestArmMachine.settings = settings(stateful_step_count=30)


def test_joints_reach_their_targets_at_the_set_speed() -> None:
    """At 50 % a joint turns 1.5 rad in one second, then stays where it was sent."""
    arm = started(speed=50)
    for frame in joint_frames([math.degrees(2.0), 0, 0, 0, 0, 0]):
        arm.receive(frame)
    arm.advance(1.0)
    assert arm.joints[0] == pytest.approx(1.5)
    arm.advance(10.0)
    assert arm.joints[0] == pytest.approx(2.0, abs=1e-5)


def test_a_target_beyond_the_limits_is_declined() -> None:
    """The joint keeps its target, the status says why, and a good target clears it."""
    arm = started()
    for frame in joint_frames([160, 0, 0, 0, 0, 0]):
        arm.receive(frame)
    arm.advance(1.0)
    assert arm.joints[0] == 0
    assert status_of(arm) == 4
    assert arm.feedback()[0].data[6] == 1  # The bit of joint 1.
    for frame in joint_frames([10, 0, 0, 0, 0, 0]):
        arm.receive(frame)
    assert status_of(arm) == 0


def test_an_emergency_stop_lasts_until_it_is_resumed() -> None:
    """Targets are ignored under the stop; resuming drops the power, as the vendor says."""
    arm = started()
    arm.receive(STOP)
    for frame in joint_frames([10, 0, 0, 0, 0, 0]):
        arm.receive(frame)
    arm.receive(ON)
    arm.advance(1.0)
    assert arm.joints[0] == 0
    assert status_of(arm) == 1
    arm.receive(RESUME)
    assert status_of(arm) == 0
    assert arm.enabled == [False] * 6


@settings(deadline=None, max_examples=50)
@given(st.data())
def test_nearby_poses_are_found(data: st.DataObject) -> None:
    """Any pose that small joint motions reach is reached, to 0.1 mm and 0.1 degrees."""
    middle = [(low + high) / 2 for low, high in JOINT_LIMITS]
    goal = [data.draw(st.floats(angle - 0.2, angle + 0.2)) for angle in middle]
    arm = started(move=0)
    arm.joints = np.array(middle)
    pose = arm.end_pose(goal)
    for frame in pose_frames(pose):
        arm.receive(frame)
    arm.advance(10.0)
    assert status_of(arm) == 0
    # Compared as a rotation: roll and yaw mean little by themselves when the hand points down.
    miss = arm_module._difference(
        arm_module._as_transform(arm.end_pose(arm.joints)), arm_module._as_transform(pose)
    )
    assert np.abs(miss[:3]).max() < 1e-4
    assert np.degrees(np.abs(miss[3:])).max() < 0.1


def test_a_pose_out_of_reach_is_declined() -> None:
    """The arm stays where it is and reports that there is no solution."""
    arm = started(move=0)
    for frame in pose_frames([650, 0, 700, 0, 0, 0]):
        arm.receive(frame)
    arm.advance(1.0)
    assert status_of(arm) == 2
    assert not arm.joints.any()


def test_questions_are_answered_and_answers_are_not() -> None:
    """Limits and firmware are reported on request; another arm's report is no request."""
    arm = SimulatedArm()
    (limits,) = arm.receive(CanFrame(0x472, bytes([2, 1, 0, 0, 0, 0, 0, 0])))
    assert struct.unpack(">BhhHx", limits.data) == (2, 1799, 0, 3000)
    (acceleration,) = arm.receive(CanFrame(0x472, bytes([2, 2, 0, 0, 0, 0, 0, 0])))
    assert acceleration.can_id == 0x47C
    (firmware,) = arm.receive(CanFrame(0x4AF, bytes([1, 0, 0, 0, 0, 0, 0, 0])))
    assert arm.receive(firmware) == []


def test_the_sdk_states_the_same_limits() -> None:
    """The arm, the env and the vendor's SDK agree on every limit."""
    from rlightning_aio.plugins.piper import options

    parameters = piper_sdk.C_PiperInterface_V2("limits", False, False)
    vendor = tuple(tuple(parameters.GetSDKJointLimitParam(f"j{i}")) for i in range(1, 7))
    assert vendor == JOINT_LIMITS == tuple(options.JOINT_LIMITS.values())
    assert (
        tuple(parameters.GetSDKGripperRangeParam())
        == GRIPPER_RANGE
        == options.GRIPPER_LIMITS["gripper"]
    )
