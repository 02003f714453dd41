# ruff: noqa: SLF001 (Gymnasium keeps its options in private attributes.)
"""Rewards, terminations and observations of Gymnasium's MuJoCo tasks, version 5, over arrays.

Rule: each formula is Gymnasium's (gymnasium/envs/mujoco/*_v5.py), with the same order of operations
and dtypes, so results are bit-identical; options are read from the Gymnasium env. Comments say
where NumPy computes arrays differently from numbers. Actions are ``[n, *action]``; values gathered
from n simulations are ``[n, ...]`` float64.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np

from rlightning_aio.envs.mujoco.views import flat, joined
from rlightning_aio.envs.wrappers import wrappers_of

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

__all__ = ["Task", "is_batched", "task_of"]

Columns = Callable[[], dict[str, Any]]
"""Makes infos of several simulations, from values that don't change later."""
Judgement = tuple[Any, Any, Columns]
"""Rewards, terminations, infos."""


class Task:
    """Base class of tasks.

    Args:
        env: the unwrapped Gymnasium env.
        fields: of n simulations, by MuJoCo's names: `mujoco_threads.Simulations`.

    Attributes:
        needs_forces: True if the task reads contact forces.
        noise: how a reset draws velocities around the first ones, after positions that it draws
            uniformly; or more than that.
        positions: ``[n, ...]``, last position of the body, for its velocity.
        actions: of the step.
        observations: after the step.
    """

    needs_forces: ClassVar[bool] = False
    noise: ClassVar[Literal["uniform", "normal", "more"]] = "uniform"

    def __init__(self, env: Any, fields: Any) -> None:
        self.env = env
        self.fields = fields
        self._options: Any = env.model.opt
        self._num: int = fields.count
        self._observed = self.gathered(*self.observed())
        self.positions: Any = self.position(fields)
        self.actions: Any = None
        self.observations: Any = None

    def gathered(self, *parts: Callable[[Any], Any]) -> Callable[..., NDArray[np.float64]]:
        """Make a function that copies parts of all simulations, flattened and concatenated.

        With ids, it copies those of the simulations `ids`.
        """
        views = joined([flat(part(self.fields)) for part in parts])

        def gather(ids: Any = None) -> NDArray[np.float64]:
            chosen = views if ids is None else [view[ids] for view in views]
            return chosen[0].copy() if len(chosen) == 1 else np.concatenate(chosen, axis=1)

        return gather

    # -- the differences between tasks ----------------------------------------------------

    def observed(self) -> list[Callable[[Any], Any]]:
        """Parts of a simulation that form an observation."""
        raise NotImplementedError

    def finish(self, observations: NDArray[np.float64]) -> None:
        """Complete observations in place."""

    def position(self, fields: Any) -> Any:
        """Position of the body in `fields` of all simulations or of one; None if unused."""

    def judge(self) -> Judgement:
        """Compute rewards, terminations and infos of a step."""
        raise NotImplementedError

    def begun(self, fields: Any) -> Columns:
        """Infos of a reset, from `fields` of the simulations that were reset."""
        del fields
        return dict

    # -- use --------------------------------------------------------------------------------

    def stepped(self, actions: NDArray[Any]) -> tuple[NDArray[np.float64], Judgement]:
        """Return observations, rewards, terminations and infos of a step with these actions."""
        self.actions = actions
        self.observations = self._observed()
        self.finish(self.observations)
        return self.observations, self.judge()

    def observation(self, ids: NDArray[np.intp]) -> NDArray[np.float64]:
        """Observations of the simulations `ids`, from their fields."""
        found = self._observed(ids)
        self.finish(found)
        return found

    def moved(self, which: Any, fields: Any) -> None:
        """Record the positions of simulations that were moved to `fields` without a step."""
        if self.positions is not None:
            self.positions = self.positions.copy()  # The last infos have views of it.
            self.positions[which] = self.position(fields)

    def velocity(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return current positions, and velocities since the last step."""
        before: NDArray[np.float64] = self.positions
        after: NDArray[np.float64] = self.position(self.fields)
        self.positions = after
        # Gymnasium's `dt`, read with one call of MuJoCo's bindings in place of two.
        velocity: NDArray[np.float64] = (after - before) / (
            self._options.timestep * self.env.frame_skip
        )
        return after, velocity

    def never(self) -> NDArray[np.bool_]:
        return np.zeros(self._num, np.bool_)


def _skipping(env: Any, count: int) -> list[Callable[[Any], Any]]:
    """Positions, without the first `count` if the env excludes them, and velocities."""
    skipped = count if env._exclude_current_positions_from_observation else 0
    return [lambda s: s.qpos[:, skipped:], lambda s: s.qvel]


def _squares(rows: NDArray[Any]) -> Any:
    return np.add.reduce(np.square(rows), axis=1)


_TENDONS = ("tendon_length", "tendon_velocity")


def _begun_at(xy: NDArray[np.float64]) -> Columns:
    """Infos of the reset of a body at these positions."""
    return lambda: {
        "x_position": xy[:, 0],
        "y_position": xy[:, 1],
        "distance_from_origin": _lengths(xy),
    }


def _moved(xy: NDArray[np.float64], velocity: NDArray[np.float64]) -> dict[str, Any]:
    """Infos of robots that move in the plane, in the order of Gymnasium's."""
    return {**_begun_at(xy)(), "x_velocity": velocity[:, 0], "y_velocity": velocity[:, 1]}


def _lengths(vectors: NDArray[np.float64]) -> Any:
    # Like `np.linalg.norm`, which uses a dot product.
    return np.sqrt(np.vecdot(vectors, vectors))


class HalfCheetah(Task):
    noise = "normal"

    def observed(self) -> list[Callable[[Any], Any]]:
        return _skipping(self.env, 1)

    def position(self, fields: Any) -> Any:
        return fields.qpos[..., :1].copy()

    def judge(self) -> Judgement:
        positions, velocities = self.velocity()
        x, velocity = positions[:, 0], velocities[:, 0]
        forward = self.env._forward_reward_weight * velocity
        control = self.env._ctrl_cost_weight * _squares(self.actions)

        def infos() -> dict[str, Any]:
            return {
                "x_position": x,
                "x_velocity": velocity,
                "reward_forward": forward,
                "reward_ctrl": -control,
            }

        return forward - control, self.never(), infos

    def begun(self, fields: Any) -> Columns:
        x = fields.qpos[:, 0]
        return lambda: {"x_position": x}


class Swimmer(Task):
    def observed(self) -> list[Callable[[Any], Any]]:
        return _skipping(self.env, 2)

    def position(self, fields: Any) -> Any:
        return fields.qpos[..., :2].copy()

    def judge(self) -> Judgement:
        xy, velocity = self.velocity()
        forward = self.env._forward_reward_weight * velocity[:, 0]
        control = self.env._ctrl_cost_weight * _squares(self.actions)

        def infos() -> dict[str, Any]:
            return {
                **_moved(xy, velocity),
                "reward_forward": forward,
                "reward_ctrl": -control,
            }

        return forward - control, self.never(), infos

    def begun(self, fields: Any) -> Columns:
        return _begun_at(fields.qpos[:, :2])


class Hopper(Task):
    def __init__(self, env: Any, fields: Any) -> None:
        super().__init__(env, fields)
        (self.state,) = joined([fields.qpos, fields.qvel])
        self.velocities = env.observation_space.shape[0] - env.model.nv

    def observed(self) -> list[Callable[[Any], Any]]:
        return _skipping(self.env, 1)

    def finish(self, observations: NDArray[np.float64]) -> None:
        velocities = observations[:, self.velocities :]
        velocities.clip(-10, 10, out=velocities)

    def position(self, fields: Any) -> Any:
        return fields.qpos[..., :1].copy()

    def healthy(self, state: NDArray[np.float64]) -> NDArray[np.bool_]:
        least, most = self.env._healthy_state_range
        rest = state[:, 2:]
        return self.upright(state) & ((least < rest) & (rest < most)).all(axis=1)

    def upright(self, state: NDArray[np.float64]) -> NDArray[np.bool_]:
        (low, high), (least, most) = self.env._healthy_z_range, self.env._healthy_angle_range
        z, angle = state[:, 1], state[:, 2]
        return (low < z) & (z < high) & (least < angle) & (angle < most)

    def judge(self) -> Judgement:
        env, state = self.env, self.state
        positions, velocities = self.velocity()
        x, velocity = positions[:, 0], velocities[:, 0]
        healthy = self.healthy(state)
        height = state[:, 1] - env.init_qpos[1]
        forward = env._forward_reward_weight * velocity
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * _squares(self.actions)

        def infos() -> dict[str, Any]:
            return {
                "x_position": x,
                "z_distance_from_origin": height,
                "x_velocity": velocity,
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_survive": survive,
            }

        return forward + survive - control, ~healthy & bool(env._terminate_when_unhealthy), infos

    def begun(self, fields: Any) -> Columns:
        positions, height = fields.qpos, self.env.init_qpos[1]
        return lambda: {
            "x_position": positions[:, 0],
            "z_distance_from_origin": positions[:, 1] - height,
        }


class Walker2d(Hopper):
    def healthy(self, state: NDArray[np.float64]) -> NDArray[np.bool_]:
        return self.upright(state)


class Ant(Task):
    needs_forces = True
    noise = "normal"

    def __init__(self, env: Any, fields: Any) -> None:
        self.body = env.model.body(env._main_body).id
        super().__init__(env, fields)
        (self.state,) = joined([fields.qpos, fields.qvel])
        self.forces = flat(fields.cfrc_ext)
        self.first_force = env.observation_structure["qpos"] + env.observation_structure["qvel"]

    def position(self, fields: Any) -> Any:
        return fields.xpos[..., self.body, :2].copy()

    def observed(self) -> list[Callable[[Any], Any]]:
        parts = _skipping(self.env, 2)
        if self.env._include_cfrc_ext_in_observation:
            parts.append(lambda s: s.cfrc_ext[:, 1:])
        return parts

    def finish(self, observations: NDArray[np.float64]) -> None:
        forces = observations[:, self.first_force :]
        forces.clip(*self.env._contact_force_range, out=forces)

    def judge(self) -> Judgement:
        env, state = self.env, self.state
        _, velocity = self.velocity()
        xy = state[:, :2].copy()
        low, high = env._healthy_z_range
        healthy = np.isfinite(state).all(axis=1) & (low <= state[:, 2]) & (state[:, 2] <= high)
        forward = velocity[:, 0] * env._forward_reward_weight
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * _squares(self.actions)
        forces = self.forces.clip(*env._contact_force_range)
        contact = env._contact_cost_weight * _squares(forces)

        def infos() -> dict[str, Any]:
            return {
                **_moved(xy, velocity),
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_contact": -contact,
                "reward_survive": survive,
            }

        rewards = forward + survive - (control + contact)
        return rewards, ~healthy & bool(env._terminate_when_unhealthy), infos

    def begun(self, fields: Any) -> Columns:
        return _begun_at(fields.qpos[:, :2])


class _Humanoid(Task):
    """Base class of the two humanoids."""

    needs_forces = True

    def __init__(self, env: Any, fields: Any) -> None:
        super().__init__(env, fields)
        self.start = self.gathered(lambda s: s.qpos[:, :3])
        self.forces = flat(fields.cfrc_ext)
        self.lengths = self.gathered(lambda s: s.ten_length)
        self.speeds = self.gathered(lambda s: s.ten_velocity)

    def observed(self) -> list[Callable[[Any], Any]]:
        env, parts = self.env, _skipping(self.env, 2)
        if env._include_cinert_in_observation is True:
            parts.append(lambda s: s.cinert[:, 1:])
        if env._include_cvel_in_observation is True:
            parts.append(lambda s: s.cvel[:, 1:])
        if env._include_qfrc_actuator_in_observation is True:
            parts.append(lambda s: s.qfrc_actuator[:, 6:])
        if env._include_cfrc_ext_in_observation is True:
            parts.append(lambda s: s.cfrc_ext[:, 1:])
        return parts

    def clipped(self, weight: float, limits: tuple[float, float]) -> NDArray[np.float64]:
        """Cost of external forces."""
        return (weight * _squares(self.forces)).clip(*limits)


class Humanoid(_Humanoid):
    def position(self, fields: Any) -> Any:
        single = not hasattr(fields, "model_field")
        masses = self.env.model.body_mass if single else fields.model_field("body_mass")
        weighted = masses[..., np.newaxis] * fields.xipos
        return (weighted.sum(axis=-2) / masses.sum(axis=-1, keepdims=True))[..., :2]

    def judge(self) -> Judgement:
        env, start = self.env, self.start()
        _, velocity = self.velocity()
        low, high = env._healthy_z_range
        healthy = (low < start[:, 2]) & (start[:, 2] < high)
        forward = env._forward_reward_weight * velocity[:, 0]
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * _squares(self.fields.ctrl)
        contact = self.clipped(env._contact_cost_weight, env._contact_cost_range)
        lengths, speeds = self.lengths(), self.speeds()

        def infos() -> dict[str, Any]:
            return {
                "x_position": start[:, 0],
                "y_position": start[:, 1],
                "tendon_length": lengths,
                "tendon_velocity": speeds,
                "distance_from_origin": _lengths(start[:, :2]),
                "x_velocity": velocity[:, 0],
                "y_velocity": velocity[:, 1],
                "reward_survive": survive,
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_contact": -contact,
            }

        rewards = forward + survive - (control + contact)
        return rewards, ~healthy & bool(env._terminate_when_unhealthy), infos

    def begun(self, fields: Any) -> Columns:
        xy, tendons = fields.qpos[:, :2], (fields.ten_length, fields.ten_velocity)
        return lambda: {**_begun_at(xy)(), **dict(zip(_TENDONS, tendons, strict=True))}


class HumanoidStandup(_Humanoid):
    def judge(self) -> Judgement:
        env, start = self.env, self.start()
        up = (start[:, 2] - 0) / env.model.opt.timestep
        control = env._ctrl_cost_weight * _squares(self.fields.ctrl)
        impact = self.clipped(env._impact_cost_weight, env._impact_cost_range)
        lengths, speeds, height = self.lengths(), self.speeds(), start[:, 2] - env.init_qpos[2]

        def infos() -> dict[str, Any]:
            return {
                "x_position": start[:, 0],
                "y_position": start[:, 1],
                "z_distance_from_origin": height,
                "tendon_length": lengths,
                "tendon_velocity": speeds,
                "reward_linup": up,
                "reward_quadctrl": -control,
                "reward_impact": -impact,
            }

        return up - control - impact + 1, self.never(), infos

    def begun(self, fields: Any) -> Columns:
        start, tendons = fields.qpos[:, :3], (fields.ten_length, fields.ten_velocity)
        height = start[:, 2] - self.env.init_qpos[2]
        return lambda: {
            "x_position": start[:, 0],
            "y_position": start[:, 1],
            "z_distance_from_origin": height,
            **dict(zip(_TENDONS, tendons, strict=True)),
        }


class InvertedPendulum(Task):
    def observed(self) -> list[Callable[[Any], Any]]:
        return [lambda s: s.qpos, lambda s: s.qvel]

    def judge(self) -> Judgement:
        finite = np.isfinite(self.observations).all(axis=1)
        terminated = ~finite | (np.abs(self.observations[:, 1]) > 0.2)
        survive = (~terminated).astype(np.int64)
        return survive.astype(np.float64), terminated, lambda: {"reward_survive": survive}


class InvertedDoublePendulum(Task):
    noise = "normal"

    def __init__(self, env: Any, fields: Any) -> None:
        super().__init__(env, fields)
        self.tip = self.gathered(lambda s: s.site_xpos[:, 0])
        self.speeds = self.gathered(lambda s: s.qvel[:, 1:3])

    def observed(self) -> list[Callable[[Any], Any]]:
        angles: Callable[[Any], Any] = lambda s: s.qpos[:, 1:]  # noqa: E731
        return [
            lambda s: s.qpos[:, :1],
            angles,
            angles,
            lambda s: s.qvel,
            lambda s: s.qfrc_constraint[:, :1],
        ]

    def finish(self, observations: NDArray[np.float64]) -> None:
        count = self.env.model.nq - 1
        sines, cosines = observations[:, 1 : 1 + count], observations[:, 1 + count : 1 + 2 * count]
        np.sin(sines, out=sines)
        np.cos(cosines, out=cosines)
        rest = observations[:, 1 + 2 * count :]
        rest.clip(-10, 10, out=rest)

    def judge(self) -> Judgement:
        tips, speeds = self.tip().tolist(), self.speeds().tolist()
        # NumPy squares numbers by C's `pow`, but arrays by a product.
        distances = np.array([0.01 * x**2 + (y - 2) ** 2 for x, _, y in tips])
        velocities = np.array([1e-3 * v1**2 + 5e-3 * v2**2 for v1, v2 in speeds])
        terminated = np.array([y <= 1 for _, _, y in tips])
        alive = self.env._healthy_reward * ~terminated

        def infos() -> dict[str, Any]:
            return {
                "reward_survive": alive,
                "distance_penalty": -distances,
                "velocity_penalty": -velocities,
            }

        return alive - distances - velocities, terminated, infos


class Pusher(Task):
    noise = "more"  # It draws places until one is far enough away.

    def observed(self) -> list[Callable[[Any], Any]]:
        arm, thing, goal = (self.env.model.body(name).id for name in ("tips_arm", "object", "goal"))
        return [
            lambda s: s.qpos[:, :7],
            lambda s: s.qvel[:, :7],
            lambda s: s.xpos[:, arm],
            lambda s: s.xpos[:, thing],
            lambda s: s.xpos[:, goal],
        ]

    def judge(self) -> Judgement:
        env = self.env
        arm, thing, goal = (self.observations[:, k : k + 3] for k in (14, 17, 20))
        near = -_lengths(thing - arm) * env._reward_near_weight
        distance = -_lengths(thing - goal) * env._reward_dist_weight
        control = -_squares(self.actions) * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control, "reward_near": near}
        return distance + control + near, self.never(), infos.copy


class Reacher(Task):
    noise = "more"  # As above.

    def __init__(self, env: Any, fields: Any) -> None:
        super().__init__(env, fields)
        tip, target = (env.model.body(name).id for name in ("fingertip", "target"))
        self.tip = self.gathered(lambda s: s.xpos[:, tip])
        self.target = self.gathered(lambda s: s.xpos[:, target])

    def observed(self) -> list[Callable[[Any], Any]]:
        angles: Callable[[Any], Any] = lambda s: s.qpos[:, :2]  # noqa: E731
        # The last one is a placeholder for the distance to the target.
        return [
            angles,
            angles,
            lambda s: s.qpos[:, 2:],
            lambda s: s.qvel[:, :2],
            lambda s: s.xpos[:, 0, :2],
        ]

    def finish(self, observations: NDArray[np.float64]) -> None:
        cosines, sines = observations[:, :2], observations[:, 2:4]
        np.cos(cosines, out=cosines)
        np.sin(sines, out=sines)
        observations[:, -2:] = (self.tip() - self.target())[:, :2]

    def judge(self) -> Judgement:
        env = self.env
        distance = -_lengths(self.tip() - self.target()) * env._reward_dist_weight
        control = -_squares(self.actions) * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control}
        return distance + control, self.never(), infos.copy


_KINDS: dict[str, type[Task]] = {
    "ant_v5:AntEnv": Ant,
    "half_cheetah_v5:HalfCheetahEnv": HalfCheetah,
    "hopper_v5:HopperEnv": Hopper,
    "humanoid_v5:HumanoidEnv": Humanoid,
    "humanoidstandup_v5:HumanoidStandupEnv": HumanoidStandup,
    "inverted_double_pendulum_v5:InvertedDoublePendulumEnv": InvertedDoublePendulum,
    "inverted_pendulum_v5:InvertedPendulumEnv": InvertedPendulum,
    "pusher_v5:PusherEnv": Pusher,
    "reacher_v5:ReacherEnv": Reacher,
    "swimmer_v5:SwimmerEnv": Swimmer,
    "walker2d_v5:Walker2dEnv": Walker2d,
}


def is_batched(spec: EnvSpec) -> bool:
    """Return True if `task_of` supports `spec` without the checker, and MuJoCo has batches."""
    entry = str(spec.entry_point).removeprefix("gymnasium.envs.mujoco.")
    known = entry in _KINDS and spec.order_enforce and not spec.additional_wrappers
    return known and tuple(map(int, version("mujoco").split(".")[:2])) >= (3, 17)


def task_of(env: gym.Env[Any, Any]) -> type[Task]:
    """Class of the task of `env`, which `gymnasium.make` has made.

    Raises:
        NotImplementedError: it isn't one of Gymnasium's v5 tasks, or has a wrapper that changes it.
    """
    kind = type(env.unwrapped)
    found = _KINDS.get(
        f"{kind.__module__}:{kind.__qualname__}".removeprefix("gymnasium.envs.mujoco.")
    )
    if found is None:
        raise NotImplementedError(
            f"{kind.__name__} is not one of Gymnasium's MuJoCo tasks, version 5"
        )
    for wrapper in wrappers_of(env):
        if not isinstance(wrapper, gym.wrappers.OrderEnforcing | gym.wrappers.TimeLimit):
            raise NotImplementedError(f"it is wrapped in {type(wrapper).__name__}")
    return found
