# ruff: noqa: SLF001 (Gymnasium keeps its options in private attributes.)
"""Rewards, terminations and observations of Gymnasium's MuJoCo tasks, version 5, over arrays.

Rule: each formula is Gymnasium's (gymnasium/envs/mujoco/*_v5.py), with the same order of operations
and dtypes, so results are bit-identical; options are read from the Gymnasium env. Comments say
where NumPy computes arrays differently from numbers. Those that walk are in `walkers`.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from rlightning_aio.envs.mujoco.outputs import FieldPart, StepArrays
from rlightning_aio.envs.mujoco.task import Columns, Task, lengths
from rlightning_aio.envs.mujoco.walkers import (
    WALKERS,
    costs_and_tendons,
    observed_of_humanoid,
    tendons,
)
from rlightning_aio.envs.wrappers import wrappers_of

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from numpy.typing import NDArray

__all__ = ["is_batched", "task_of"]


class HumanoidStandup(Task):
    needs_forces = True

    def observed(self) -> list[FieldPart]:
        return observed_of_humanoid(self.env)

    def watched(self) -> list[FieldPart]:
        return [FieldPart("qpos", 0, 3), *costs_and_tendons()]

    def judge(self, frame: StepArrays) -> Columns:
        env, columns = self.env, frame.columns
        up = (columns[2] - 0) / env.model.opt.timestep
        control = env._ctrl_cost_weight * columns[3]
        low, high = env._impact_cost_range
        impact = np.minimum(np.maximum(env._impact_cost_weight * columns[4], low), high)
        frame.rewards[:], frame.terminated[:] = up - control - impact + 1, False

        def infos() -> dict[str, Any]:
            return {
                **self.stands(columns),
                "reward_linup": up,
                "reward_quadctrl": -control,
                "reward_impact": -impact,
            }

        return infos

    def stands(self, columns: NDArray[np.float64]) -> dict[str, Any]:
        return {
            "x_position": columns[0],
            "y_position": columns[1],
            "z_distance_from_origin": columns[2] - self.env.init_qpos[2],
            **tendons(columns[5:]),
        }

    def begun(self, ids: NDArray[np.intp]) -> Columns:
        columns = self.columns
        return lambda: self.stands(columns[:, ids])


class InvertedPendulum(Task):
    def observed(self) -> list[FieldPart]:
        return [FieldPart("qpos"), FieldPart("qvel")]

    def judge(self, frame: StepArrays) -> Columns:
        finite = np.isfinite(frame.observations).all(axis=1)
        terminated = ~finite | (np.abs(frame.observations[:, 1]) > 0.2)
        survive = (~terminated).astype(np.int64)
        frame.rewards[:], frame.terminated[:] = survive, terminated
        return lambda: {"reward_survive": survive}


class InvertedDoublePendulum(Task):
    noise = "normal"

    def observed(self) -> list[FieldPart]:
        position, angles = FieldPart("qpos", 0, 1), FieldPart("qpos", 1)
        clipped = [FieldPart("qvel", 0, None, -10, 10), FieldPart("qfrc_constraint", 0, 1, -10, 10)]
        return [position, angles, angles, *clipped]

    def watched(self) -> list[FieldPart]:
        return [FieldPart("site_xpos", 0, 3), FieldPart("qvel", 1, 3)]

    def finish(self, which: Any = ...) -> None:
        observations, count = self.frame.observations[which], self.env.model.nq - 1
        sines, cosines = observations[:, 1 : 1 + count], observations[:, 1 + count : 1 + 2 * count]
        np.sin(sines, out=sines)
        np.cos(cosines, out=cosines)
        self.frame.observations[which] = observations

    def judge(self, frame: StepArrays) -> Columns:
        columns = frame.columns
        values = columns.T.tolist()
        # NumPy squares numbers by C's `pow`, but arrays by a product.
        distances = np.array([0.01 * x**2 + (y - 2) ** 2 for x, _, y, _, _ in values])
        velocities = np.array([1e-3 * v1**2 + 5e-3 * v2**2 for _, _, _, v1, v2 in values])
        terminated = columns[2] <= 1
        alive = self.env._healthy_reward * ~terminated

        def infos() -> dict[str, Any]:
            return {
                "reward_survive": alive,
                "distance_penalty": -distances,
                "velocity_penalty": -velocities,
            }

        frame.rewards[:], frame.terminated[:] = alive - distances - velocities, terminated
        return infos


class Pusher(Task):
    noise = "more"  # It draws places until one is far enough away.

    def observed(self) -> list[FieldPart]:
        firsts = [3 * self.env.model.body(name).id for name in ("tips_arm", "object", "goal")]
        places = [FieldPart("xpos", first, first + 3) for first in firsts]
        return [FieldPart("qpos", 0, 7), FieldPart("qvel", 0, 7), *places]

    def judge(self, frame: StepArrays) -> Columns:
        env = self.env
        arm, thing, goal = (frame.observations[:, k : k + 3] for k in (14, 17, 20))
        near = -lengths(thing - arm) * env._reward_near_weight
        distance = -lengths(thing - goal) * env._reward_dist_weight
        control = -self.simulations.squares * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control, "reward_near": near}
        frame.rewards[:], frame.terminated[:] = distance + control + near, False
        return infos.copy


class Reacher(Task):
    noise = "more"  # As above.

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

    def watched(self) -> list[FieldPart]:
        firsts = [3 * self.env.model.body(name).id for name in ("fingertip", "target")]
        return [FieldPart("xpos", first, first + 3) for first in firsts]

    def _missing(self) -> NDArray[np.float64]:
        """From the target to the finger, ``[n, 3]``."""
        tip, target = self.columns[:3], self.columns[3:]  # `np.split` is slow.
        return np.ascontiguousarray((tip - target).T)

    def finish(self, which: Any = ...) -> None:
        observations = self.frame.observations[which]
        cosines, sines = observations[:, :2], observations[:, 2:4]
        np.cos(cosines, out=cosines)
        np.sin(sines, out=sines)
        observations[:, -2:] = self._missing()[which, :2]
        self.frame.observations[which] = observations

    def judge(self, frame: StepArrays) -> Columns:
        env = self.env
        distance = -lengths(self._missing()) * env._reward_dist_weight
        control = -self.simulations.squares * env._reward_control_weight
        infos = {"reward_dist": distance, "reward_ctrl": control}
        frame.rewards[:], frame.terminated[:] = distance + control, False
        return infos.copy


_KINDS = WALKERS | {
    "humanoidstandup_v5:HumanoidStandupEnv": HumanoidStandup,
    "inverted_double_pendulum_v5:InvertedDoublePendulumEnv": InvertedDoublePendulum,
    "inverted_pendulum_v5:InvertedPendulumEnv": InvertedPendulum,
    "pusher_v5:PusherEnv": Pusher,
    "reacher_v5:ReacherEnv": Reacher,
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
