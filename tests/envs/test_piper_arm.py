"""The simulated arm, frame by frame, without a bus."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

piper_sdk: Any = pytest.importorskip("piper_sdk")

from rlightning_aio.plugins.piper import arm as arm_module  # noqa: E402 - needs the SDK
from rlightning_aio.plugins.piper.arm import (  # noqa: E402
    GRIPPER_RANGE,
    JOINT_LIMITS,
    CanFrame,
    SimulatedArm,
)

pytestmark = pytest.mark.simulators

ON = CanFrame(0x471, bytes([7, 2, 0, 0, 0, 0, 0, 0]))


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
