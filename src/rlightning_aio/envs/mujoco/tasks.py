# ruff: noqa: SLF001 (Gymnasium keeps its options in private attributes.)
"""Rewards, terminations and observations of Gymnasium's MuJoCo tasks, version 5, over arrays.

Rule: each formula is Gymnasium's (gymnasium/envs/mujoco/*_v5.py), with the same order of operations
and dtypes, so results are bit-identical; options are read from the Gymnasium env. Comments say
where NumPy computes arrays differently from numbers. Actions and observations are ``[n, ...]``;
what rewards are made of is ``[..., n]`` where NumPy is faster so.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np

from rlightning_aio.envs.mujoco.outputs import FieldPart, live_timestep
from rlightning_aio.envs.wrappers import wrappers_of

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.threads import Simulations

__all__ = ["Task", "is_batched", "task_of"]

Columns = Callable[[], dict[str, Any]]
"""Makes infos of several simulations, from values that don't change later."""
Judgement = tuple[Any, Any, Columns]
"""Rewards, terminations or None, infos."""


class Task:
    """Base class of tasks.

    Args:
        env: the unwrapped Gymnasium env.
        simulations: n of them; their outputs become those of the task.

    Attributes:
        needs_forces: True if the task reads contact forces.
        noise: how a reset draws velocities around the first ones, after positions that it draws
            uniformly; or more than that.
        columns: what rewards and infos are made of, ``[..., n]``: a new array in each step.
        place: position of the body, for its velocity: ``[n]`` or ``[2, n]``.
        observations: after the step.
    """

    needs_forces: ClassVar[bool] = False
    noise: ClassVar[Literal["uniform", "normal", "more"]] = "uniform"

    def __init__(self, env: Any, simulations: Simulations) -> None:
        simulations.forget_outputs()
        self.env = env
        self.simulations = simulations
        self._timestep = live_timestep(env.model.opt)
        self._num: int = simulations.count
        self._observed = simulations.output(*self.observed())
        self._watched = simulations.output(*self.watched(), by_columns=True)
        self._columns_before = self.columns
        self.place: Any = None

    @property
    def columns(self) -> NDArray[np.float64]:
        return self._watched.values

    @property
    def observations(self) -> NDArray[np.float64]:
        return self._observed.values

    # -- the differences between tasks ----------------------------------------------------

    def observed(self) -> list[FieldPart]:
        """Parts of a simulation that form an observation."""
        raise NotImplementedError

    def watched(self) -> list[FieldPart]:
        return []

    def finish(self, which: Any = ...) -> None:
        """Complete the observations of some simulations in place."""

    def position(self) -> Any:
        """Position of the body; None if unused."""

    def judge(self) -> Judgement:
        """Compute rewards, terminations and infos of a step."""
        raise NotImplementedError

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        """Infos of a reset of the simulations `ids`."""
        del ids
        return dict

    # -- use --------------------------------------------------------------------------------

    def renew(self, observations: NDArray[np.float64] | None = None) -> None:
        """Write the next outputs to new arrays, as somebody has the last ones.

        Args:
            observations: where to write them if some simulations stay as they are.
        """
        self._columns_before = self.columns
        if observations is None:
            self._observed.renew()
            self._watched.renew()
        else:
            self._observed.put(observations)
            self._watched.copy()

    def keep(self, ids: list[int], observations: NDArray[np.float64]) -> None:
        """Leave the outputs of the simulations `ids` as they were; observations are given."""
        self.observations[ids] = observations[ids]
        self.columns[:, ids] = self._columns_before[:, ids]

    def put(self, k: int, data: Any) -> None:
        """Move simulation `k` to `data`, without a step."""
        self._watched.copy()
        self.simulations.put(k, data, unread=self._observed)
        self.settle([k])

    def settle(self, ids: Any) -> None:
        """Record where the simulations `ids` are after a reset."""
        now = self.position()
        if now is not None:
            self.place = now.copy() if self.place is None else self.place.copy()
            self.place[..., ids] = now[..., ids]

    def stepped(self) -> Judgement:
        """Return rewards, terminations and infos of a step."""
        self.finish()
        return self.judge()

    def velocity(self) -> NDArray[np.float64]:
        """Record the current positions, and return velocities since the last step."""
        before, self.place = self.place, self.position()
        return (self.place - before) / (self._timestep.value * self.env.frame_skip)  # By its `dt`.

    def ended(self, healthy: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Terminations of robots that end their episodes when they fall, if they do."""
        return ~healthy if self.env._terminate_when_unhealthy else None


def _skipping(env: Any, count: int, low: float = -np.inf, high: float = np.inf) -> list[FieldPart]:
    """Positions, without the first `count` if the env excludes them, and clipped velocities."""
    skipped = count if env._exclude_current_positions_from_observation else 0
    return [FieldPart("qpos", skipped), FieldPart("qvel", low=low, high=high)]


def _also(
    field: str,
    first: int = 0,
    stop: int | None = None,
    limits: tuple[float, float] = (-np.inf, np.inf),
) -> FieldPart:
    """Part that must be within limits, or finite, in addition to the part before."""
    return FieldPart(field, first, stop, *limits, kind="also_within")


def _including(low: float, high: float) -> tuple[float, float]:
    """Make limits that are not within themselves but let the given ones be."""
    return float(np.nextafter(low, -np.inf)), float(np.nextafter(high, np.inf))


def _at(xy: NDArray[np.float64]) -> dict[str, Any]:
    """Infos of bodies at these positions ``[2, n]``."""
    return {
        "x_position": xy[0],
        "y_position": xy[1],
        "distance_from_origin": _lengths(np.ascontiguousarray(xy.T)),
    }


def _moved(xy: NDArray[np.float64], velocity: NDArray[np.float64]) -> dict[str, Any]:
    """Infos of robots that move in the plane, in the order of Gymnasium's."""
    return {**_at(xy), "x_velocity": velocity[0], "y_velocity": velocity[1]}


def _lengths(vectors: NDArray[np.float64]) -> Any:
    # Like `np.linalg.norm`, which uses a dot product.
    return np.sqrt(np.vecdot(vectors, vectors))


class HalfCheetah(Task):
    noise = "normal"

    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 1)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 1)]

    def position(self) -> Any:
        return self.columns[0]

    def judge(self) -> Judgement:
        velocity, x = self.velocity(), self.columns[0]
        forward = self.env._forward_reward_weight * velocity
        control = self.env._ctrl_cost_weight * self.simulations.squares

        def infos() -> dict[str, Any]:
            return {
                "x_position": x,
                "x_velocity": velocity,
                "reward_forward": forward,
                "reward_ctrl": -control,
            }

        return forward - control, None, infos

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        x = self.columns[0]
        return lambda: {"x_position": x[ids]}


class Swimmer(Task):
    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 2)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 2)]

    def position(self) -> Any:
        return self.columns

    def judge(self) -> Judgement:
        velocity, xy = self.velocity(), self.columns
        forward = self.env._forward_reward_weight * velocity[0]
        control = self.env._ctrl_cost_weight * self.simulations.squares

        def infos() -> dict[str, Any]:
            return {
                **_moved(xy, velocity),
                "reward_forward": forward,
                "reward_ctrl": -control,
            }

        return forward - control, None, infos

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        xy = self.columns
        return lambda: _at(xy[:, ids])


class Hopper(Task):
    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 1, -10, 10)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 2), *self.healthy()]

    def position(self) -> Any:
        return self.columns[0]

    def healthy(self) -> list[FieldPart]:
        state = self.env._healthy_state_range
        return [*self.upright(), _also("qpos", 2, None, state), _also("qvel", 0, None, state)]

    def upright(self) -> list[FieldPart]:
        height, angle = self.env._healthy_z_range, self.env._healthy_angle_range
        return [FieldPart("qpos", 1, 2, *height, kind="within"), _also("qpos", 2, 3, angle)]

    def judge(self) -> Judgement:
        env, columns = self.env, self.columns
        velocity, healthy = self.velocity(), columns[2] != 0
        forward = env._forward_reward_weight * velocity
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * self.simulations.squares

        def infos() -> dict[str, Any]:
            return {
                "x_position": columns[0],
                "z_distance_from_origin": columns[1] - env.init_qpos[1],
                "x_velocity": velocity,
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_survive": survive,
            }

        return forward + survive - control, self.ended(healthy), infos

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns, height = self.columns, self.env.init_qpos[1]
        return lambda: {
            "x_position": columns[0, ids],
            "z_distance_from_origin": columns[1, ids] - height,
        }


class Walker2d(Hopper):
    def healthy(self) -> list[FieldPart]:
        return self.upright()


class Ant(Task):
    needs_forces = True
    noise = "normal"

    def __init__(self, env: Any, simulations: Simulations) -> None:
        self.body = env.model.body(env._main_body).id
        super().__init__(env, simulations)

    def observed(self) -> list[FieldPart]:
        parts = _skipping(self.env, 2)
        if self.env._include_cfrc_ext_in_observation:
            parts.append(FieldPart("cfrc_ext", 6, None, *self.env._contact_force_range))
        return parts

    def watched(self) -> list[FieldPart]:
        first, (low, high) = 3 * self.body, self.env._healthy_z_range
        return [
            FieldPart("xpos", first, first + 2),
            FieldPart("qpos", 0, 2),
            # Its bounds are healthy, too.
            FieldPart("qpos", 2, 3, *_including(low, high), kind="within"),
            _also("qpos"),
            _also("qvel"),
            FieldPart("cfrc_ext", 0, None, *self.env._contact_force_range, kind="squares"),
        ]

    def position(self) -> Any:
        return self.columns[:2]

    def judge(self) -> Judgement:
        env, velocity, xy = self.env, self.velocity(), self.columns[2:4]
        healthy = self.columns[4] != 0
        forward = velocity[0] * env._forward_reward_weight
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * self.simulations.squares
        contact = env._contact_cost_weight * self.columns[5]

        def infos() -> dict[str, Any]:
            return {
                **_moved(xy, velocity),
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_contact": -contact,
                "reward_survive": survive,
            }

        return forward + survive - (control + contact), self.ended(healthy), infos

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        xy = self.columns[2:4]
        return lambda: _at(xy[:, ids])


class _Humanoid(Task):
    """Base class of the two humanoids."""

    needs_forces = True

    def observed(self) -> list[FieldPart]:
        env, parts = self.env, _skipping(self.env, 2)
        if env._include_cinert_in_observation is True:
            parts.append(FieldPart("cinert", 10))
        if env._include_cvel_in_observation is True:
            parts.append(FieldPart("cvel", 6))
        if env._include_qfrc_actuator_in_observation is True:
            parts.append(FieldPart("qfrc_actuator", 6))
        if env._include_cfrc_ext_in_observation is True:
            parts.append(FieldPart("cfrc_ext", 6))
        return parts

    def watched(self) -> list[FieldPart]:
        squares = [FieldPart(name, kind="squares") for name in ("ctrl", "cfrc_ext")]
        tendons = [FieldPart("ten_length"), FieldPart("ten_velocity")]
        return [FieldPart("qpos", 0, 3), *squares, *tendons]

    def clipped(self, weight: float, limits: tuple[float, float]) -> NDArray[np.float64]:
        """Cost of external forces."""
        low, high = limits
        return np.minimum(np.maximum(weight * self.columns[4], low), high)


def _tendons(columns: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Infos of lengths and velocities of tendons, from what humanoids watch."""
    lengths, velocities = np.split(columns[5:], 2)
    return {"tendon_length": lengths.T.copy(), "tendon_velocity": velocities.T.copy()}


class Humanoid(_Humanoid):
    def __init__(self, env: Any, simulations: Simulations) -> None:
        super().__init__(env, simulations)
        self.places = simulations.output(FieldPart("xipos"), by_columns=True)
        self.masses = simulations.model_field("body_mass")  # Changes show here.

    def position(self) -> Any:
        masses = self.masses
        places = self.places.values.reshape(-1, 3, self._num)[:, :2]
        # Of each simulation, or of all.
        weights = masses.T[:, np.newaxis] if masses.ndim == 2 else masses[:, np.newaxis, np.newaxis]
        return np.add.reduce(weights * places, axis=0) / np.add.reduce(masses, axis=-1)

    def judge(self) -> Judgement:
        env, columns, velocity = self.env, self.columns, self.velocity()
        (low, high), z = env._healthy_z_range, columns[2]
        healthy = (low < z) & (z < high)
        forward = env._forward_reward_weight * velocity[0]
        survive = healthy * env._healthy_reward
        control = env._ctrl_cost_weight * self.columns[3]
        contact = self.clipped(env._contact_cost_weight, env._contact_cost_range)

        def infos() -> dict[str, Any]:
            return {
                **_moved(columns[:2], velocity),
                **_tendons(columns),
                "reward_survive": survive,
                "reward_forward": forward,
                "reward_ctrl": -control,
                "reward_contact": -contact,
            }

        return forward + survive - (control + contact), self.ended(healthy), infos

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns = self.columns
        return lambda: {**_at(columns[:2, ids]), **_tendons(columns[:, ids])}


class HumanoidStandup(_Humanoid):
    def judge(self) -> Judgement:
        env, columns = self.env, self.columns
        up = (columns[2] - 0) / env.model.opt.timestep
        control = env._ctrl_cost_weight * self.columns[3]
        impact = self.clipped(env._impact_cost_weight, env._impact_cost_range)

        def infos() -> dict[str, Any]:
            return {
                **self.stands(columns),
                "reward_linup": up,
                "reward_quadctrl": -control,
                "reward_impact": -impact,
            }

        return up - control - impact + 1, None, infos

    def stands(self, columns: NDArray[np.float64]) -> dict[str, Any]:
        return {
            "x_position": columns[0],
            "y_position": columns[1],
            "z_distance_from_origin": columns[2] - self.env.init_qpos[2],
            **_tendons(columns),
        }

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns = self.columns
        return lambda: self.stands(columns[:, ids])


class InvertedPendulum(Task):
    def observed(self) -> list[FieldPart]:
        return [FieldPart("qpos"), FieldPart("qvel")]

    def judge(self) -> Judgement:
        finite = np.isfinite(self.observations).all(axis=1)
        terminated = ~finite | (np.abs(self.observations[:, 1]) > 0.2)
        survive = (~terminated).astype(np.int64)
        return survive.astype(np.float64), terminated, lambda: {"reward_survive": survive}


class InvertedDoublePendulum(Task):
    noise = "normal"

    def observed(self) -> list[FieldPart]:
        position, angles = FieldPart("qpos", 0, 1), FieldPart("qpos", 1)
        clipped = [FieldPart("qvel", 0, None, -10, 10), FieldPart("qfrc_constraint", 0, 1, -10, 10)]
        return [position, angles, angles, *clipped]

    def watched(self) -> list[FieldPart]:
        return [FieldPart("site_xpos", 0, 3), FieldPart("qvel", 1, 3)]

    def finish(self, which: Any = ...) -> None:
        observations, count = self.observations[which], self.env.model.nq - 1
        sines, cosines = observations[:, 1 : 1 + count], observations[:, 1 + count : 1 + 2 * count]
        np.sin(sines, out=sines)
        np.cos(cosines, out=cosines)
        self.observations[which] = observations

    def judge(self) -> Judgement:
        values = self.columns.T.tolist()
        # NumPy squares numbers by C's `pow`, but arrays by a product.
        distances = np.array([0.01 * x**2 + (y - 2) ** 2 for x, _, y, _, _ in values])
        velocities = np.array([1e-3 * v1**2 + 5e-3 * v2**2 for _, _, _, v1, v2 in values])
        terminated = self.columns[2] <= 1
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

    def observed(self) -> list[FieldPart]:
        firsts = [3 * self.env.model.body(name).id for name in ("tips_arm", "object", "goal")]
        places = [FieldPart("xpos", first, first + 3) for first in firsts]
        return [FieldPart("qpos", 0, 7), FieldPart("qvel", 0, 7), *places]

    def judge(self) -> Judgement:
        env = self.env
        arm, thing, goal = (self.observations[:, k : k + 3] for k in (14, 17, 20))
        near = -_lengths(thing - arm) * env._reward_near_weight
        distance = -_lengths(thing - goal) * env._reward_dist_weight
        control = -self.simulations.squares * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control, "reward_near": near}
        return distance + control + near, None, infos.copy


class Reacher(Task):
    noise = "more"  # As above.

    def __init__(self, env: Any, simulations: Simulations) -> None:
        super().__init__(env, simulations)
        self.tip, self.target = (
            simulations.output(FieldPart("xpos", 3 * body, 3 * body + 3))
            for body in (env.model.body(name).id for name in ("fingertip", "target"))
        )

    def observed(self) -> list[FieldPart]:
        angles = FieldPart("qpos", 0, 2)
        # The last one is a placeholder for the distance to the target.
        return [
            angles,
            angles,
            FieldPart("qpos", 2),
            FieldPart("qvel", 0, 2),
            FieldPart("xpos", 0, 2),
        ]

    def finish(self, which: Any = ...) -> None:
        observations = self.observations[which]
        cosines, sines = observations[:, :2], observations[:, 2:4]
        np.cos(cosines, out=cosines)
        np.sin(sines, out=sines)
        observations[:, -2:] = (self.tip.values - self.target.values)[which, :2]
        self.observations[which] = observations

    def judge(self) -> Judgement:
        env = self.env
        distance = -_lengths(self.tip.values - self.target.values) * env._reward_dist_weight
        control = -self.simulations.squares * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control}
        return distance + control, None, infos.copy


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
