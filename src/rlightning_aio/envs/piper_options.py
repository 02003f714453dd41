"""What a `piper` entry may say in ``env_kwargs``, and the limits that follow from it.

Rule: limits may be narrowed, never widened.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rlightning_aio.errors import ConfigError

__all__ = ["CameraOptions", "Limit", "PiperOptions", "action_limits", "check_reset_joints"]

# As the SDK's `JointCtrl` and `GripperCtrl` state them. The end pose is bounded by the
# arm's reach; what it can't reach within that, the arm itself refuses.
JOINT_LIMITS = {
    "joint_1": (-2.6179, 2.6179),
    "joint_2": (0.0, 3.14),
    "joint_3": (-2.967, 0.0),
    "joint_4": (-1.745, 1.745),
    "joint_5": (-1.22, 1.22),
    "joint_6": (-2.09439, 2.09439),
}
POSE_LIMITS = {
    "x": (-0.7, 0.7),
    "y": (-0.7, 0.7),
    "z": (0.0, 0.8),
    "rx": (-math.pi, math.pi),
    "ry": (-math.pi, math.pi),
    "rz": (-math.pi, math.pi),
}
GRIPPER_LIMITS = {"gripper": (0.0, 0.07)}
IN_METRES = frozenset({"x", "y", "z", "gripper"})


class CameraOptions(BaseModel):
    """Where camera images come from."""

    model_config = ConfigDict(extra="forbid")

    read: str
    """``module:callable`` that returns ``{name: image}``, called once for each observation."""
    images: dict[str, tuple[int, int, int]] = Field(min_length=1)
    """Height, width and channels of each image, which are uint8."""


class PiperOptions(BaseModel):
    """What ``env_kwargs`` of the backend may hold."""

    model_config = ConfigDict(extra="forbid")

    can_interface: Literal["socketcan", "slcan", "virtual"] = "socketcan"
    """``virtual`` brings a simulated arm of its own."""
    channel: str | list[str] = "can0"
    """CAN interface or serial port; a list has one for each of the entry's envs."""
    control: Literal["joint", "end_pose"] = "joint"
    """What an action is: six joint positions in rad, or x, y, z in m and rx, ry, rz in rad."""
    gripper: bool = True
    """Whether there is one; its opening in m is the last number of an action."""
    gripper_effort: float = Field(default=1.0, ge=0, le=5)
    """Most torque of the gripper, in N·m."""
    speed: int = Field(default=50, ge=1, le=100)
    """Percent of the arm's speed."""
    control_hz: float = Field(default=30.0, gt=0, le=200)
    """Steps per second."""
    limits: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """Narrower limits of an action's numbers, by name (joint_1, …, x, …, gripper)."""
    reset_joints: tuple[float, float, float, float, float, float] = (0, 0, 0, 0, 0, 0)
    """Where `reset` goes, in rad."""
    reset_gripper: float = Field(default=0.0, ge=0, le=0.07)
    """Opening of the gripper after `reset`, in m."""
    reset_tolerance: float = Field(default=0.02, gt=0)
    """How near to its reset position each joint must come, in rad."""
    move_timeout: float = Field(default=15.0, gt=0)
    """Seconds that the way to the reset position may take."""
    connect_timeout: float = Field(default=5.0, gt=0)
    """Seconds until the first feedback, and until the motors are on."""
    feedback_timeout: float = Field(default=0.5, gt=0)
    """Seconds without feedback after which the arm counts as lost."""
    safe_stop: Literal["hold", "emergency_stop", "disable"] = "hold"
    """What is done on an exception, at `close`, and when the trainer is gone."""
    cameras: CameraOptions | None = None
    reward: str | None = None
    """``module:callable`` of (observation, action) that returns a float; else rewards are 0."""


class Limit(NamedTuple):
    """Bounds of one number of an action, as float32 can express them."""

    name: str
    low: float
    high: float

    @property
    def unit(self) -> str:
        return "m" if self.name in IN_METRES else "rad"


def action_limits(env_id: str, options: PiperOptions) -> tuple[Limit, ...]:
    """Bounds of an action's numbers, in their order.

    Raises:
        ConfigError: a configured limit names no such number, or is wider than the arm's own.
    """
    widest = JOINT_LIMITS if options.control == "joint" else POSE_LIMITS
    widest = widest | (GRIPPER_LIMITS if options.gripper else {})
    for name, (low, high) in options.limits.items():
        if name not in widest:
            raise ConfigError(
                f"{env_id}: env_kwargs.limits.{name}: an action of this env has {', '.join(widest)}"
            )
        if not widest[name][0] <= low < high <= widest[name][1]:
            raise ConfigError(
                f"{env_id}: env_kwargs.limits.{name}: [{low}, {high}] is not within the arm's own "
                f"{list(widest[name])}"
            )
    return tuple(_rounded_inwards(name, *(widest | options.limits)[name]) for name in widest)


def check_reset_joints(env_id: str, options: PiperOptions) -> None:
    """Refuse a reset position that the arm can't take.

    Raises:
        ConfigError: it is outside the limits of a joint.
    """
    for (name, (low, high)), angle in zip(JOINT_LIMITS.items(), options.reset_joints, strict=True):
        if not low <= angle <= high:
            raise ConfigError(
                f"{env_id}: env_kwargs.reset_joints: {name} = {angle} rad is outside "
                f"[{low}, {high}]"
            )


def _rounded_inwards(name: str, low: float, high: float) -> Limit:
    """Bounds as float32, none outside the given ones."""
    low32, high32 = np.float32(low), np.float32(high)
    if float(low32) < low:
        low32 = np.nextafter(low32, np.float32(np.inf))
    if float(high32) > high:
        high32 = np.nextafter(high32, np.float32(-np.inf))
    return Limit(name, float(low32), float(high32))
