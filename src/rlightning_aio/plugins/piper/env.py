"""`piper`: a Piper robot arm as an env, through the vendor's SDK.

Rule: each action is checked against the limits before it is sent, and any failure leads to the
configured safe stop. Units are metres, radians and seconds.
Absent on purpose: tasks. A reward comes from a hook, or from a subclass.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio import BaseEnv, EnvRet, PolicyResponse
from rlightning_aio.envs.options import load_named, read_options
from rlightning_aio.envs.pace import Pace
from rlightning_aio.errors import BadAction, ConfigError
from rlightning_aio.plugins.piper.cameras import Cameras
from rlightning_aio.plugins.piper.link import (
    GRIPPER_FRAMES,
    JOINT_FRAMES,
    POSE_FRAMES,
    STATUS_FRAMES,
    ArmLink,
    InUse,
)
from rlightning_aio.plugins.piper.options import PiperOptions, action_limits, check_reset_position
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from collections.abc import Generator

    from rlightning_aio import EnvConfig

# The SDK drops feedback beyond these as garbage.
MAX_LENGTH, MAX_ANGLE, MAX_GRIPPER = 1.0, math.radians(361), 0.15

REFUSALS = frozenset({"NO_SOLUTION", "SINGULARITY_POINT", "TARGET_POS_EXCEEDS_LIMIT"})
"""States of an arm that has declined a target and waits for another."""

GRIPPER_TOLERANCE = 0.002
"""Tolerance of the gripper's reset position, in m."""


class PiperEnv(BaseEnv):
    """One arm on one CAN channel.

    Observations are a dict of float32 arrays: ``joint_positions`` [6] rad, ``end_pose``
    [6] (x, y, z in m, rx, ry, rz in rad), ``gripper`` [1] m, and one uint8 image for each
    camera. An action is [6], or [7] with a gripper; see `PiperOptions.control`. A step
    sends the action, waits for the end of the control period, and returns feedback that
    is newer than the action.

    ``info`` has ``arm_status`` (as the arm reports it; declining a target is not an error) and
    ``late``, the seconds by which the period was overrun. ``last_truncated`` is True at
    ``max_episode_steps``.

    The arm moves only between a `reset` and the next safe stop. Any exception in `reset` or `step`
    (also of the preprocess function or a camera), `close` and `on_disconnect` make the stop. So
    does the arm's watchdog, a separate process, if this process or the trainer ends in any way
    (including SIGKILL) or is suspended.
    """

    # The group must not reject invalid actions, because only the env can stop the arm.
    transforms_actions = True
    hardware = True

    def __init__(self, config: EnvConfig, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        options = self._options = read_options(PiperOptions, self.env_id, config.env_kwargs)
        self._limits = action_limits(self.env_id, options)
        check_reset_position(self.env_id, options)
        cameras, reward = options.cameras, options.reward
        self._cameras: Cameras | None = None
        if cameras:
            read = self._load("cameras.read", cameras.read)
            self._cameras = Cameras(read, options.camera_timeout)
        self._reward = self._load("reward", reward) if reward else None
        self._frames = JOINT_FRAMES | POSE_FRAMES | STATUS_FRAMES
        if options.gripper:
            self._frames |= GRIPPER_FRAMES
        self._stopped = True
        # Held while the arm is started or stopped: `stop` comes from another thread.
        self._stopping = threading.RLock()
        self._num_steps = 0
        self._pace = Pace(options.control_hz)
        self._link: ArmLink | None = None
        try:
            self._link = self._linked(self._own_channel())
            self._link.wait_for_feedback(self._frames, 0, options.connect_timeout)
        except BaseException:
            self.close()
            raise

    def _load(self, field: str, name: str) -> Any:
        return load_named(self.env_id, f"env_kwargs.{field}", name)

    def _own_channel(self) -> str:
        given = self._options.channel
        if not isinstance(given, list):
            return given
        if len(given) != self.config.num_workers:
            raise ConfigError(
                f"{self.env_id}: env_kwargs.channel: {len(given)} channels for "
                f"{self.config.num_workers} envs"
            )
        return given[self.worker_index]

    def _linked(self, channel: str) -> ArmLink:
        options = self._options
        orders = {
            "stop": options.safe_stop,
            "timeout": options.watchdog_timeout,
            "speed": options.speed,
            "gripper_effort": round(options.gripper_effort * 1000) if options.gripper else None,
        }
        try:
            return ArmLink(options.can_interface, channel, orders)
        except InUse as error:
            raise ConfigError(
                f"{self.env_id}: env_kwargs.channel: {error}; an arm has one env, and several "
                "envs need a list with one channel for each"
            ) from None

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
            np.array([limit.low32 for limit in self._limits]),
            np.array([limit.high32 for limit in self._limits]),
            dtype=np.float32,
        )

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> EnvRet:
        """Switch the motors on, go to the reset position and wait until it is reached.

        Args:
            seed: ignored.
            options: ``{"resume": True}`` first ends an emergency stop, which lets the arm fall.

        Raises:
            RuntimeError: the arm is under emergency stop, or reports a fault.
            TimeoutError: the motors aren't on, or the position isn't reached, in time.
            ConnectionError: the arm sends no feedback.
        """
        del seed
        with self._stopping_on_error():
            link = self._answering_link()
            must_resume = self._must_resume(link, bool((options or {}).get("resume")))
            with self._stopping:
                self._stopped = False
                link.arm(self.trainer_pid, self._options.connect_timeout)
            if must_resume:
                self._resume(link)
            link.enable(self._options.connect_timeout)
            self._check_watchdog(link)
            self._go_to_reset_position(link)
            self._num_steps = 0
            self._pace.restart()
            return EnvRet(env_id=self.env_id, observation=self._observe(link), info=self._info(0.0))

    def step(self, policy_resp: PolicyResponse) -> EnvRet:
        """Run one control period: send the action, wait for the end of the period, observe.

        Raises:
            BadAction: the action has the wrong shape, or contains NaN or a number outside its
                limits. It was not sent, and the arm is stopped.
            RuntimeError: no `reset` since the last safe stop, or the arm reports a fault.
            ConnectionError: no feedback came for ``feedback_timeout`` seconds.
        """
        link = self._require_link()
        with self._stopping_on_error():
            if self._stopped:
                raise RuntimeError(f"{self.env_id}: the arm is stopped; reset() starts it again")
            self._check_watchdog(link)
            action = self._checked(self._preprocess_fn(policy_resp))
            self._send(link, action)
            sent = link.mark()
            late = self._pace.wait()
            link.wait_for_feedback(self._frames, sent, self._options.feedback_timeout)
            self._check_watchdog(link)
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
        """Make the safe stop, as the trainer is gone."""
        self._safe_stop()

    def stop(self) -> None:
        """Make the safe stop, also from another thread; a reset or step at work then raises."""
        self._safe_stop("the env's stop() was called")

    def close(self) -> None:
        """Make the safe stop and leave the channel; idempotent."""
        if self._cameras:
            self._cameras.close()
        with self._stopping:
            try:
                self._safe_stop()
            finally:
                if self._link is not None:
                    self._link.close()
                    self._link = None

    def _require_link(self) -> ArmLink:
        if self._link is None:
            raise RuntimeError(f"{self.env_id}: closed")
        return self._link

    def _answering_link(self) -> ArmLink:
        """Return the link to the arm; a new one if the watchdog or the bus is gone."""
        link = self._require_link()
        if self._stopped:
            link.check_watchdog()
        if link.is_lost:
            self._safe_stop()
            link.close()
            link = self._link = self._linked(self._own_channel())
            link.wait_for_feedback(self._frames, 0, self._options.connect_timeout)
        return link

    @contextlib.contextmanager
    def _stopping_on_error(self) -> Generator[None]:
        try:
            yield
        except BaseException:
            self._safe_stop()
            raise

    def _safe_stop(self, cause: str = "") -> None:
        with self._stopping:
            if not self._stopped and self._link is not None:
                self._stopped = True
                self._link.stop(cause)

    def _check_watchdog(self, link: ArmLink) -> None:
        if cause := link.stopped_because:
            raise RuntimeError(
                f"{self.env_id}: the arm's watchdog stopped it: {cause}; reset() starts it again"
            )

    def _must_resume(self, link: ArmLink, is_allowed: bool) -> bool:
        """Return True if an emergency stop must be ended.

        Raises:
            RuntimeError: it must be, but the caller doesn't allow it.
        """
        link.wait_for_feedback(STATUS_FRAMES, link.mark(), self._options.feedback_timeout)
        if link.status() != "EMERGENCY_STOP":
            return False
        if not is_allowed:
            raise RuntimeError(
                f"{self.env_id}: the arm is under emergency stop; when it is safe that the arm "
                'falls, call reset(options={"resume": True})'
            )
        return True

    def _resume(self, link: ArmLink) -> None:
        link.resume()
        timeout = self._options.connect_timeout
        if not link.wait_until(lambda: link.status() != "EMERGENCY_STOP", timeout):
            raise TimeoutError(f"{self.env_id}: still under emergency stop after {timeout:g} s")

    def _go_to_reset_position(self, link: ArmLink) -> None:
        options = self._options
        deadline = time.monotonic() + options.move_timeout
        while True:
            link.command_joints(options.reset_joints, options.speed)
            if options.gripper:
                link.command_gripper(options.reset_gripper, options.gripper_effort)
            sent = link.mark()
            # Repeated until the arm is there, because the bus may lose frames.
            link.wait_until(lambda: self._is_over(link), 0.2)
            link.wait_for_feedback(self._frames, sent, options.feedback_timeout)
            self._check_watchdog(link)
            self._raise_faults(link)
            if not (missing := self._off_target(link)):
                return
            if time.monotonic() >= deadline:
                raise TimeoutError(
                    f"{self.env_id}: reset position not reached in {options.move_timeout:g} s: "
                    f"{missing}; the arm reports {link.status()}"
                )

    def _is_over(self, link: ArmLink) -> bool:
        """Return True if the move to the reset position is over, or was stopped."""
        return bool(link.stopped_because) or not self._off_target(link)

    def _off_target(self, link: ArmLink) -> str:
        """Describe the joint or gripper that is furthest from its reset position, if any."""
        options = self._options
        distances = np.abs(link.joints() - np.array(options.reset_joints))
        index = int(distances.argmax())
        if distances[index] > options.reset_tolerance:
            return (
                f"joint_{index + 1} is at {link.joints()[index]:.3f} rad, not "
                f"{options.reset_joints[index]:.3f}"
            )
        if options.gripper and abs(link.gripper() - options.reset_gripper) > GRIPPER_TOLERANCE:
            return f"the gripper is at {link.gripper():.3f} m, not {options.reset_gripper:.3f}"
        return ""

    def _checked(self, action: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
        try:
            values = np.asarray(as_numpy(action), np.float64)
            found = f"shape {values.shape}"
        except (TypeError, ValueError):
            values, found = np.empty(0), f"a {type(action).__name__}"
        if values.shape != (len(self._limits),):
            numbers = ", ".join(
                f"{limit.name} in [{limit.low:.6g}, {limit.high:.6g}] {limit.unit}"
                for limit in self._limits
            )
            raise BadAction(
                f"{self.env_id}: an action has shape ({len(self._limits)},): {numbers}; got "
                f"{'None' if action is None else found}; the action was not sent"
            )
        within = [
            limit.within(value) for limit, value in zip(self._limits, values.tolist(), strict=True)
        ]
        for limit, value, sent in zip(self._limits, values.tolist(), within, strict=True):
            if sent is None:
                raise BadAction(
                    f"{self.env_id}: {limit.name} = {value:.6g} {limit.unit} is outside "
                    f"[{limit.low:.6g}, {limit.high:.6g}]; the action was not sent"
                )
        return np.array(within, np.float64)

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
        if self._cameras:
            observation |= self._cameras.read()
        return observation

    def _info(self, late: float) -> dict[str, Any]:
        return {"arm_status": self._require_link().status(), "late": late}
