# ruff: noqa: SLF001 (Gymnasium keeps its options in private attributes.)
"""Gymnasium's robots that are to walk or swim: their rewards have one form, see `Terms`.

The compiled function `_advance.c` computes them in MuJoCo's threads. `Walker.judge` is its twin.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.envs.mujoco.outputs import FieldPart, StepArrays, Terms, live_timestep
from rlightning_aio.envs.mujoco.task import Columns, Task, lengths

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.threads import Simulations

__all__ = ["WALKERS", "costs_and_tendons", "observed_of_humanoid", "tendons"]


class Walker(Task):
    """Base class of robots whose reward has a form that the compiled function knows."""

    def __init__(self, env: Any, simulations: Simulations) -> None:
        super().__init__(env, simulations)
        self.terms = self.worth()
        self.place = self.columns[: self.terms.num_places].copy()
        self._timestep = live_timestep(env.model.opt)
        self._at = len(self.columns) - self.num_further
        simulations.judge(self.terms, self._at, self.place, self._timestep)

    def worth(self) -> Terms:
        """Return what a step is worth."""
        raise NotImplementedError

    @property
    def num_further(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.worth().num_places + 1

    def settle(self, ids: Any) -> None:
        self.place[:, ids] = self.columns[: len(self.place), ids]

    def judge(self, frame: StepArrays) -> Columns:
        """The twin of the compiled function."""
        terms, columns, at, size = self.terms, frame.columns, self._at, len(self.place)
        place, now = self.place, columns[:size]
        # By the `dt` of Gymnasium.
        columns[at : at + size] = (now - place) / (self._timestep.value * self.env.frame_skip)
        place[:] = now
        used = self.simulations.squares if terms.control_at is None else columns[terms.control_at]
        columns[at + size] = cost = terms.control * used
        parts = self._parts(columns, cost.dtype)
        forward, healthy = parts["reward_forward"], terms.healthy_at
        reached = forward if healthy is None else forward + parts["reward_survive"]
        contact = parts.get("reward_contact")
        frame.rewards[:] = reached - (cost if contact is None else cost - contact)
        frame.terminated[:] = terms.ends and columns[healthy] == 0
        return partial(self.infos, columns, cost.dtype)

    def explain(self, frame: StepArrays) -> Columns:
        return partial(self._explained, frame.columns, self.simulations.squares.dtype)

    def _explained(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        kind = np.dtype(np.float64) if self.terms.control_at is not None else kind
        return self.infos(columns, kind)

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        """Infos in the order of Gymnasium's; the cost of control has a type of its own."""
        raise NotImplementedError

    def _velocity(self, columns: NDArray[np.float64]) -> NDArray[np.float64]:
        return columns[self._at : self._at + len(self.place)]

    def _parts(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        """Parts of the rewards, by their names in infos."""
        terms = self.terms
        found = {
            "reward_forward": terms.forward * columns[self._at],
            "reward_ctrl": -columns[self._at + len(self.place)].astype(kind),
        }
        if terms.contact_at is not None:
            cost = terms.contact * columns[terms.contact_at]
            found["reward_contact"] = -np.minimum(np.maximum(cost, terms.low), terms.high)
        if terms.healthy_at is not None:
            found["reward_survive"] = (columns[terms.healthy_at] != 0) * terms.alive
        return found


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
        "distance_from_origin": lengths(np.ascontiguousarray(xy.T)),
    }


def _moved(xy: NDArray[np.float64], velocity: NDArray[np.float64]) -> dict[str, Any]:
    """Infos of robots that move in the plane, in the order of Gymnasium's."""
    return {**_at(xy), "x_velocity": velocity[0], "y_velocity": velocity[1]}


class HalfCheetah(Walker):
    noise = "normal"

    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 1)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 1)]

    def worth(self) -> Terms:
        return Terms(1, self.env._forward_reward_weight, self.env._ctrl_cost_weight)

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        (velocity,) = self._velocity(columns)
        return {
            "x_position": columns[0],
            "x_velocity": velocity,
            **self._parts(columns, kind),
        }

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        x = self.columns[0]
        return lambda: {"x_position": x[ids]}


class Swimmer(Walker):
    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 2)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 2)]

    def worth(self) -> Terms:
        return Terms(2, self.env._forward_reward_weight, self.env._ctrl_cost_weight)

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        moved = _moved(columns[:2], self._velocity(columns))
        return {**moved, **self._parts(columns, kind)}

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        xy = self.columns[:2]
        return lambda: _at(xy[:, ids])


class Hopper(Walker):
    def observed(self) -> list[FieldPart]:
        return _skipping(self.env, 1, -10, 10)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 2), *self.healthy()]

    def worth(self) -> Terms:
        env = self.env
        return Terms(
            1,
            env._forward_reward_weight,
            env._ctrl_cost_weight,
            healthy_at=2,
            alive=env._healthy_reward,
            ends=bool(env._terminate_when_unhealthy),
        )

    def healthy(self) -> list[FieldPart]:
        state = self.env._healthy_state_range
        return [*self.upright(), _also("qpos", 2, None, state), _also("qvel", 0, None, state)]

    def upright(self) -> list[FieldPart]:
        height, angle = self.env._healthy_z_range, self.env._healthy_angle_range
        return [FieldPart("qpos", 1, 2, *height, kind="within"), _also("qpos", 2, 3, angle)]

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        (velocity,) = self._velocity(columns)
        return {
            "x_position": columns[0],
            "z_distance_from_origin": columns[1] - self.env.init_qpos[1],
            "x_velocity": velocity,
            **self._parts(columns, kind),
        }

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns, height = self.columns, self.env.init_qpos[1]
        return lambda: {
            "x_position": columns[0, ids],
            "z_distance_from_origin": columns[1, ids] - height,
        }


class Walker2d(Hopper):
    def healthy(self) -> list[FieldPart]:
        return self.upright()


class Ant(Walker):
    needs_forces = True
    noise = "normal"

    def observed(self) -> list[FieldPart]:
        parts = _skipping(self.env, 2)
        if self.env._include_cfrc_ext_in_observation:
            parts.append(FieldPart("cfrc_ext", 6, None, *self.env._contact_force_range))
        return parts

    def watched(self) -> list[FieldPart]:
        env = self.env
        first, (low, high) = 3 * env.model.body(env._main_body).id, env._healthy_z_range
        return [
            FieldPart("xpos", first, first + 2),
            FieldPart("qpos", 0, 2),
            # Its bounds are healthy, too.
            FieldPart("qpos", 2, 3, *_including(low, high), kind="within"),
            _also("qpos"),
            _also("qvel"),
            FieldPart("cfrc_ext", 0, None, *env._contact_force_range, kind="squares"),
        ]

    def worth(self) -> Terms:
        env = self.env
        return Terms(
            2,
            env._forward_reward_weight,
            env._ctrl_cost_weight,
            healthy_at=4,
            alive=env._healthy_reward,
            ends=bool(env._terminate_when_unhealthy),
            contact_at=5,
            contact=env._contact_cost_weight,
        )

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        moved = _moved(columns[2:4], self._velocity(columns))
        return {**moved, **self._parts(columns, kind)}

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        xy = self.columns[2:4]
        return lambda: _at(xy[:, ids])


def observed_of_humanoid(env: Any) -> list[FieldPart]:
    """Return what the two humanoids observe."""
    parts = _skipping(env, 2)
    if env._include_cinert_in_observation is True:
        parts.append(FieldPart("cinert", 10))
    if env._include_cvel_in_observation is True:
        parts.append(FieldPart("cvel", 6))
    if env._include_qfrc_actuator_in_observation is True:
        parts.append(FieldPart("qfrc_actuator", 6))
    if env._include_cfrc_ext_in_observation is True:
        parts.append(FieldPart("cfrc_ext", 6))
    return parts


def costs_and_tendons() -> list[FieldPart]:
    """Return what both humanoids watch: squares of controls and contact forces, and tendons."""
    squares = [FieldPart(name, kind="squares") for name in ("ctrl", "cfrc_ext")]
    return [*squares, FieldPart("ten_length"), FieldPart("ten_velocity")]


def tendons(columns: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Infos of lengths and velocities of tendons."""
    half = len(columns) // 2  # `np.split` is slow.
    lengths, velocities = columns[:half], columns[half:]
    return {"tendon_length": lengths.T.copy(), "tendon_velocity": velocities.T.copy()}


class Humanoid(Walker):
    needs_forces = True

    def observed(self) -> list[FieldPart]:
        return observed_of_humanoid(self.env)

    def watched(self) -> list[FieldPart]:
        return [
            FieldPart("xipos", kind="centre", weights=self.env.model.body_mass),
            FieldPart("qpos", 0, 3),
            FieldPart("qpos", 2, 3, *self.env._healthy_z_range, kind="within"),
            *costs_and_tendons(),
        ]

    def worth(self) -> Terms:
        env = self.env
        return Terms(
            2,
            env._forward_reward_weight,
            env._ctrl_cost_weight,
            control_at=6,
            healthy_at=5,
            alive=env._healthy_reward,
            ends=bool(env._terminate_when_unhealthy),
            contact_at=7,
            contact=env._contact_cost_weight,
            low=env._contact_cost_range[0],
            high=env._contact_cost_range[1],
        )

    def infos(self, columns: NDArray[np.float64], kind: Any) -> dict[str, Any]:
        parts = self._parts(columns, kind)
        return {
            **_moved(columns[2:4], self._velocity(columns)),
            **tendons(columns[8 : self._at]),
            "reward_survive": parts.pop("reward_survive"),
            **parts,
        }

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns, end = self.columns, self._at
        return lambda: {**_at(columns[2:4, ids]), **tendons(columns[8:end, ids])}


WALKERS: dict[str, type[Task]] = {
    "ant_v5:AntEnv": Ant,
    "half_cheetah_v5:HalfCheetahEnv": HalfCheetah,
    "hopper_v5:HopperEnv": Hopper,
    "humanoid_v5:HumanoidEnv": Humanoid,
    "swimmer_v5:SwimmerEnv": Swimmer,
    "walker2d_v5:Walker2dEnv": Walker2d,
}
"""Tasks by the entry points of Gymnasium's."""
