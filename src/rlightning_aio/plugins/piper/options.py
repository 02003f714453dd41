"""``env_kwargs`` of a `piper` entry, and the resulting limits.

Rule: limits may be narrowed, never widened.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rlightning_aio.errors import ConfigError
from rlightning_aio.plugins.piper import guard
from rlightning_aio.plugins.piper.guard import SafeStop

# The bounds of the end pose contain the arm's reach; the arm refuses unreachable poses.
JOINT_LIMITS = {f"joint_{i}": limits for i, limits in enumerate(guard.JOINT_LIMITS, 1)}
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
ORIENTATION = frozenset({"rx", "ry", "rz"})
"""Periodic angles."""
HALF_UNIT = {"m": 0.5e-6, "rad": math.radians(0.0005)}
"""Rounding errors of the units of the bus, 0.001 mm and 0.001 degrees."""


class CameraOptions(BaseModel):
    """Camera images of an observation."""

    model_config = ConfigDict(extra="forbid")

    read: str
    """``module:callable`` that returns ``{name: image}``, called once for each observation."""
    images: dict[str, tuple[int, int, int]] = Field(min_length=1)
    """Height, width and channels of each image, which are uint8."""


class PiperOptions(BaseModel):
    """Fields of ``env_kwargs``."""

    model_config = ConfigDict(extra="forbid")

    can_interface: Literal["socketcan", "slcan", "virtual"] = "socketcan"
    """``virtual`` makes a simulated arm."""
    channel: str | list[str] = "can0"
    """CAN interface or serial port; a list has one for each env of the entry."""
    control: Literal["joint", "end_pose"] = "joint"
    """Meaning of actions: six joint positions in rad, or x, y, z in m and rx, ry, rz in rad."""
    gripper: bool = True
    """True if the arm has a gripper; its opening in m is the last number of an action."""
    gripper_effort: float = Field(default=1.0, ge=0, le=5)
    """Maximum torque of the gripper, in N·m."""
    speed: int = Field(default=50, ge=1, le=100)
    """Percentage of the arm's maximum speed."""
    control_hz: float = Field(default=30.0, gt=0, le=200)
    """Steps per second."""
    limits: dict[str, tuple[float, float]] = Field(default_factory=dict)
    """Narrower limits of action elements, by name (joint_1, …, x, …, gripper)."""
    reset_joints: tuple[float, float, float, float, float, float] = (0, 0, 0, 0, 0, 0)
    """Reset position of the joints, in rad."""
    reset_gripper: float = Field(default=0.0, ge=0, le=0.07)
    """Opening of the gripper after `reset`, in m."""
    reset_tolerance: float = Field(default=0.02, gt=0)
    """Tolerance of each joint's reset position, in rad."""
    move_timeout: float = Field(default=15.0, gt=0)
    """Time limit for the move to the reset position, in seconds."""
    connect_timeout: float = Field(default=5.0, gt=0)
    """Time limit for the first feedback, and for switching the motors on, in seconds."""
    feedback_timeout: float = Field(default=0.5, gt=0)
    """Seconds without feedback after which the arm counts as lost."""
    safe_stop: SafeStop = "hold"
    """The stop on an exception, at `close`, and when the trainer or this process is gone."""
    watchdog_timeout: float = Field(default=0.5, ge=0.1, le=10)
    """Seconds for which this process or the trainer may be suspended before the arm is stopped."""
    cameras: CameraOptions | None = None
    camera_timeout: float = Field(default=0.5, gt=0)
    """Seconds that ``cameras.read`` may take before the arm is stopped."""
    reward: str | None = None
    """``module:callable`` of (observation, action) that returns a float; None for 0."""


class Limit(NamedTuple):
    """Bounds of one element of an action, in rad or m."""

    name: str
    low: float
    high: float

    @property
    def unit(self) -> str:
        return "m" if self.name in IN_METRES else "rad"

    @property
    def low32(self) -> np.float32:
        """`low` as float32, rounded outwards."""
        rounded = np.float32(self.low)
        return rounded if float(rounded) <= self.low else np.nextafter(rounded, np.float32(-np.inf))

    @property
    def high32(self) -> np.float32:
        """`high` as float32, rounded outwards."""
        rounded = np.float32(self.high)
        return rounded if float(rounded) >= self.high else np.nextafter(rounded, np.float32(np.inf))

    def within(self, value: float) -> float | None:
        """Convert `value` to the value to send, never beyond a bound; None if it is outside.

        Values beyond a bound by rounding errors of float32 or of the bus are set to the bound. An
        orientation may have any number of extra turns.
        """
        if self.name in ORIENTATION and math.isfinite(value):
            value += math.tau * round(((self.low + self.high) / 2 - value) / math.tau)
        slack = HALF_UNIT[self.unit] + float(np.spacing(np.float32(max(-self.low, self.high, 0))))
        # In this form NaN is outside.
        if not self.low - slack <= value <= self.high + slack:
            return None
        return min(max(value, self.low), self.high)


def action_limits(env_id: str, options: PiperOptions) -> tuple[Limit, ...]:
    """Bounds of the elements of an action, in order.

    Raises:
        ConfigError: a configured limit names no element, or is wider than that of the arm.
    """
    widest = JOINT_LIMITS if options.control == "joint" else POSE_LIMITS
    widest = widest | (GRIPPER_LIMITS if options.gripper else {})
    for name, (low, high) in options.limits.items():
        if name not in widest:
            raise ConfigError(
                f"{env_id}: env_kwargs.limits.{name}: an action of this env has {', '.join(widest)}"
            )
        if not _is_narrower(name, low, high, widest[name]):
            raise ConfigError(
                f"{env_id}: env_kwargs.limits.{name}: [{low}, {high}] is not within the arm's own "
                f"{list(widest[name])}"
            )
    return tuple(Limit(name, *(widest | options.limits)[name]) for name in widest)


def _is_narrower(name: str, low: float, high: float, widest: tuple[float, float]) -> bool:
    if name in ORIENTATION:
        # Bounds may be around half a turn, where the hand points down.
        return -math.tau <= low < high <= math.tau and high - low <= math.tau
    return widest[0] <= low < high <= widest[1]


def check_reset_position(env_id: str, options: PiperOptions) -> None:
    """Check the reset position.

    Raises:
        ConfigError: it is outside the limits of the arm or of the config.
    """
    limits = {**JOINT_LIMITS, **GRIPPER_LIMITS, **options.limits}
    positions = dict(zip(JOINT_LIMITS, options.reset_joints, strict=True))
    if options.gripper:
        positions["gripper"] = options.reset_gripper
    for name, position in positions.items():
        limit = Limit(name, *limits[name])
        if limit.within(position) is None:
            field = "reset_gripper" if name == "gripper" else "reset_joints"
            raise ConfigError(
                f"{env_id}: env_kwargs.{field}: {name} = {position} {limit.unit} is outside "
                f"[{limit.low}, {limit.high}]; name a reset position within the limits"
            )
