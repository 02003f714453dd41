"""`piper`: a Piper robot arm as an env, through the vendor's SDK.

Rule: nothing is sent that hasn't been checked against the limits, and whatever goes
wrong ends in the configured safe stop. Units are metres, radians and seconds.
Absent on purpose: tasks. A reward comes from a hook, or from a subclass.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.envs.base import BaseEnv, PreprocessFn
from rlightning_aio.envs.options import load_named, read_options
from rlightning_aio.envs.pace import Pace
from rlightning_aio.envs.piper_link import (
    GRIPPER_FRAMES,
    JOINT_FRAMES,
    POSE_FRAMES,
    STATUS_FRAMES,
    ArmLink,
)
from rlightning_aio.envs.piper_options import PiperOptions, action_limits, check_reset_joints
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.types import EnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Generator

    from rlightning_aio.config import EnvConfig

__all__ = ["PiperEnv"]

# What the SDK lets through: it drops feedback beyond these as garbage.
MAX_LENGTH, MAX_ANGLE, MAX_GRIPPER = 1.0, math.radians(361), 0.15

REFUSALS = frozenset({"NO_SOLUTION", "SINGULARITY_POINT", "TARGET_POS_EXCEEDS_LIMIT"})
"""States in which the arm declined one target and waits for another."""

_channels: dict[str, str] = {}


class PiperEnv(BaseEnv):
    """One arm on one CAN channel.

    Observations are a dict of float32 arrays: ``joint_positions`` [6] rad, ``end_pose``
    [6] (x, y, z in m, rx, ry, rz in rad), ``gripper`` [1] m, and one uint8 image for each
    camera. An action is [6], or [7] with a gripper; see `PiperOptions.control`. A step
    sends the action, waits for the end of the control period, and returns feedback that
    is newer than the action.

    ``info`` holds ``arm_status`` (the arm's own word; a target it declined is no error)
    and ``late``, the seconds by which the period was overrun. ``last_truncated`` is True
    at ``max_episode_steps``.

    The arm moves only between a `reset` and the next safe stop. The stop is made on any
    exception in `reset` or `step` (the preprocess function's and a camera's included), in
    `close`, and in `on_disconnect`. For the last this class relies on its host: a worker
    calls `on_disconnect` and then `close` when its channel to the trainer closes, which the
    trainer's death does too. A worker that is itself killed can stop nothing; the arm then
    ends at its last target.
    """

    def __init__(
        self,
        config: EnvConfig,
        worker_index: int = 0,
        preprocess_fn: PreprocessFn | None = None,
        **kwargs: Any,
    ) -> None:
        super().__init__(config, worker_index, preprocess_fn, **kwargs)
        options = self._options = read_options(PiperOptions, self.env_id, config.env_kwargs)
        self._limits = action_limits(self.env_id, options)
        check_reset_joints(self.env_id, options)
        cameras, reward = options.cameras, options.reward
        self._read_images = self._load("cameras.read", cameras.read) if cameras else None
        self._reward = self._load("reward", reward) if reward else None
        self._frames = JOINT_FRAMES | POSE_FRAMES | STATUS_FRAMES
        if options.gripper:
            self._frames |= GRIPPER_FRAMES
        self._stopped = True
        self._num_steps = 0
        self._pace = Pace(options.control_hz)
        self._channel = self._claim_channel()
        self._link: ArmLink | None = None
        try:
            self._link = ArmLink(options.can_interface, self._channel)
            self._link.wait_for_feedback(self._frames, 0.0, options.connect_timeout)
        except BaseException:
            self.close()
            raise

    def _load(self, field: str, name: str) -> Any:
        return load_named(self.env_id, f"env_kwargs.{field}", name)

    def _claim_channel(self) -> str:
        given = self._options.channel
        if isinstance(given, list):
            if len(given) != self.config.num_workers:
                raise ConfigError(
                    f"{self.env_id}: env_kwargs.channel: {len(given)} channels for "
                    f"{self.config.num_workers} envs"
                )
            given = given[self.worker_index]
        if (other := _channels.get(given)) is not None:
            raise ConfigError(
                f"{self.env_id}: env_kwargs.channel: {given!r} is in use by {other}; "
                "give a list with one channel for each env"
            )
        _channels[given] = self.env_id
        return given

    def get_observation_space(self) -> gym.Space[Any]:
        reach = np.array([MAX_LENGTH] * 3 + [MAX_ANGLE] * 3, np.float32)
        spaces: dict[str, gym.Space[Any]] = {
            "joint_positions": gym.spaces.Box(-MAX_ANGLE, MAX_ANGLE, (6,), np.float32),
            "end_pose": gym.spaces.Box(-reach, reach, dtype=np.float32),
        }
        if self._options.gripper:
            spaces["gripper"] = gym.spaces.Box(-MAX_GRIPPER, MAX_GRIPPER, (1,), np.float32)
        if self._options.cameras:
            for name, shape in self._options.cameras.images.items():
                spaces[name] = gym.spaces.Box(0, 255, shape, np.uint8)
        return gym.spaces.Dict(spaces)

    def get_action_space(self) -> gym.Space[Any]:
        return gym.spaces.Box(
            np.array([limit.low for limit in self._limits], np.float32),
            np.array([limit.high for limit in self._limits], np.float32),
            dtype=np.float32,
        )

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        """Switch the motors on, go to the configured position and wait until it is reached.

        Args:
            seed: nothing here is random.
            options: ``{"resume": True}`` ends an emergency stop first, which lets the arm
                fall; without it an arm under emergency stop stays so.

        Raises:
            RuntimeError: the arm is under emergency stop, or reports a fault on its way.
            TimeoutError: the motors aren't on, or the position isn't reached, in time.
            ConnectionError: no feedback comes from the arm.
        """
        del seed
        link = self._require_link()
        with self._stopping_on_error():
            self._leave_emergency_stop(link, resume=bool((options or {}).get("resume")))
            self._stopped = False
            link.enable(self._options.connect_timeout)
            self._go_to_reset_position(link)
            self._num_steps = 0
            self._pace.restart()
            return EnvRet(env_id=self.env_id, observation=self._observe(link), info=self._info(0.0))

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        """One control period: send the action, wait for the period's end, observe.

        Raises:
            BadAction: a number is outside its limits, or not a number; it was not sent.
            RuntimeError: no `reset` since the last safe stop, or the arm reports a fault.
            ConnectionError: no feedback came for ``feedback_timeout`` seconds.
        """
        link = self._require_link()
        with self._stopping_on_error():
            if self._stopped:
                raise RuntimeError(f"{self.env_id}: the arm is stopped; reset() starts it again")
            action = self._checked(self._preprocess_fn(policy_resp))
            sent = time.monotonic()
            self._send(link, action)
            late = self._pace.wait()
            link.wait_for_feedback(self._frames, sent, self._options.feedback_timeout)
            self._raise_faults(link)
            observation = self._observe(link)
            self._num_steps += 1
            return EnvRet(
                env_id=self.env_id,
                observation=observation,
                last_reward=float(self._reward(observation, action)) if self._reward else 0.0,
                last_truncated=self._num_steps == self.max_episode_steps,
                info=self._info(late),
            )

    def on_disconnect(self) -> None:
        """The trainer is gone: make the safe stop."""
        self._safe_stop()

    def close(self) -> None:
        """Make the safe stop and leave the channel. Closing again does nothing."""
        try:
            self._safe_stop()
        finally:
            if self._link is not None:
                self._link.close()
                self._link = None
            if _channels.get(self._channel) == self.env_id:
                del _channels[self._channel]

    def _require_link(self) -> ArmLink:
        if self._link is None:
            raise RuntimeError(f"{self.env_id}: closed")
        return self._link

    @contextlib.contextmanager
    def _stopping_on_error(self) -> Generator[None]:
        try:
            yield
        except BaseException:
            self._safe_stop()
            raise

    def _safe_stop(self) -> None:
        if self._stopped or self._link is None:
            return
        self._stopped = True
        if self._options.safe_stop == "hold":
            self._link.hold(self._options.speed)
        elif self._options.safe_stop == "emergency_stop":
            self._link.emergency_stop()
        else:
            self._link.disable()

    def _leave_emergency_stop(self, link: ArmLink, *, resume: bool) -> None:
        link.wait_for_feedback(STATUS_FRAMES, time.monotonic(), self._options.feedback_timeout)
        if link.status() != "EMERGENCY_STOP":
            return
        if not resume:
            raise RuntimeError(
                f"{self.env_id}: the arm is under emergency stop; when it is safe that the arm "
                'falls, call reset(options={"resume": True})'
            )
        link.resume()
        timeout = self._options.connect_timeout
        if not link.wait_until(lambda: link.status() != "EMERGENCY_STOP", timeout):
            raise TimeoutError(f"{self.env_id}: still under emergency stop after {timeout:g} s")

    def _go_to_reset_position(self, link: ArmLink) -> None:
        options = self._options
        target = np.array(options.reset_joints)

        def distances() -> Any:
            return np.abs(link.joints() - target)

        deadline = time.monotonic() + options.move_timeout
        while True:
            sent = time.monotonic()
            link.command_joints(options.reset_joints, options.speed)
            if options.gripper:
                link.command_gripper(options.reset_gripper, options.gripper_effort)
            # Said again until the arm is there, since a bus may lose it.
            reached = link.wait_until(lambda: distances().max() <= options.reset_tolerance, 0.2)
            link.wait_for_feedback(self._frames, sent, options.feedback_timeout)
            self._raise_faults(link)
            if reached:
                return
            if time.monotonic() >= deadline:
                index = int(distances().argmax())
                raise TimeoutError(
                    f"{self.env_id}: reset position not reached in {options.move_timeout:g} s: "
                    f"joint_{index + 1} is at {link.joints()[index]:.3f} rad, not "
                    f"{target[index]:.3f}; the arm reports {link.status()}"
                )

    def _checked(self, action: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
        values = np.asarray(as_numpy(action), np.float64)
        if values.shape != (len(self._limits),):
            names = ", ".join(limit.name for limit in self._limits)
            raise BadAction(
                f"{self.env_id}: an action has shape ({len(self._limits)},): {names}; "
                f"got {values.shape}"
            )
        for limit, value in zip(self._limits, values.tolist(), strict=True):
            # Written so that NaN is out of bounds.
            if not limit.low <= value <= limit.high:
                raise BadAction(
                    f"{self.env_id}: {limit.name} = {value:.6g} {limit.unit} is outside "
                    f"[{limit.low:.6g}, {limit.high:.6g}]; the action was not sent"
                )
        return values

    def _send(self, link: ArmLink, action: np.ndarray[Any, np.dtype[np.float64]]) -> None:
        values = action.tolist()
        command = link.command_joints if self._options.control == "joint" else link.command_pose
        command(values[:6], self._options.speed)
        if self._options.gripper:
            link.command_gripper(values[6], self._options.gripper_effort)

    def _raise_faults(self, link: ArmLink) -> None:
        status = link.status()
        if status != "NORMAL" and status not in REFUSALS:
            raise RuntimeError(f"{self.env_id}: the arm reports {status}")

    def _observe(self, link: ArmLink) -> dict[str, Any]:
        observation: dict[str, Any] = {
            "joint_positions": link.joints().astype(np.float32),
            "end_pose": link.end_pose().astype(np.float32),
        }
        if self._options.gripper:
            observation["gripper"] = np.array([link.gripper()], np.float32)
        if self._read_images:
            observation |= self._read_images()
        return observation

    def _info(self, late: float) -> dict[str, Any]:
        return {"arm_status": self._require_link().status(), "late": late}
