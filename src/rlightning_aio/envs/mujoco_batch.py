"""Many simulations of one of Gymnasium's MuJoCo tasks, stepped with one call.

Rule: to the bit what as many envs of `gymnasium.make` do. Gymnasium's own env, made once, reads
the options, resets and renders; only steps are computed here, for all simulations at once, by
`mujoco_tasks`. Absent on purpose: MuJoCo's own `rollout`, which does not carry each
simulation's warm start from call to call.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.mujoco_tasks import task_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["MujocoBatch"]

# Its stubs leave out half of it.
mujoco: Any = import_module("mujoco")


class MujocoBatch(gym.vector.VectorEnv[Any, Any, Any]):
    """Simulations of one task, each of which resets itself in the step after its episode's end.

    They share their model: what is changed in it is changed for all.

    Args:
        env: what `gymnasium.make` made of the task.
        num_envs: how many.

    Attributes:
        env: the same, unwrapped; its state is of no simulation.

    Raises:
        NotImplementedError: the task is none of Gymnasium's v5 tasks, or is wrapped.
    """

    def __init__(self, env: gym.Env[Any, Any], num_envs: int) -> None:
        self.env: Any = env.unwrapped
        self.num_envs = num_envs
        self.spec = env.spec
        self.metadata = {**env.metadata, "autoreset_mode": AutoresetMode.NEXT_STEP}
        self.render_mode = self.env.render_mode
        # Annotated here: Gymnasium leaves open what its spaces hold.
        self.single_observation_space: gym.Space[Any] = self.env.observation_space
        self.single_action_space: gym.Space[Any] = self.env.action_space
        self.observation_space: gym.Space[Any] = batch_space(self.env.observation_space, num_envs)
        self.action_space: gym.Space[Any] = batch_space(self.env.action_space, num_envs)
        model = self.env.model
        # Not the env's own: that is the one that it renders.
        self._shown = self.env.data
        self._simulations = [mujoco.MjData(model) for _ in range(num_envs)]
        self._controls = [simulation.ctrl for simulation in self._simulations]
        self._generators: list[Any] = [None] * num_envs
        self._task = task_of(env, self._simulations)
        limit = env.spec.max_episode_steps if env.spec else None
        self._limit = np.iinfo(np.int64).max if limit is None else limit
        self._num_steps = np.zeros(num_envs, np.int64)
        self._ended: NDArray[np.bool_] | None = None
        self._everywhere = np.ones(num_envs, np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset all; simulation k with ``seed + k``, or its own of a sequence."""
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
        infos: dict[str, Any] = {}
        for k, own in zip(range(self.num_envs), seeds, strict=True):
            infos = self._add_info(infos, self._reset(k, own, options), k)
        self._ended = np.zeros(self.num_envs, np.bool_)
        return self._task.observe(), infos

    def _reset(self, k: int, seed: int | None, options: dict[str, Any] | None) -> dict[str, Any]:
        """Have Gymnasium's env reset simulation k; its info."""
        env = self.env
        # Each has a generator of its own; None becomes one with a seed of chance.
        env.data, env._np_random = self._simulations[k], self._generators[k]  # noqa: SLF001
        _, info = env.reset(seed=seed, options=options)
        self._generators[k] = env.np_random
        self._num_steps[k] = 0
        return info

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:  # fmt: skip
        """Step all; those whose episode ended in the step before are reset instead.

        Args:
            actions: ``[num_envs, *action]``.

        Raises:
            ResetNeeded: there was no reset yet.
            ValueError: the actions have another shape.
        """
        ended = self._ended
        if ended is None:
            raise ResetNeeded("Cannot call env.step() before calling env.reset()")
        if np.shape(actions) != self.action_space.shape:
            raise ValueError(
                f"actions must have shape {self.action_space.shape}, not {np.shape(actions)}"
            )
        resets = np.flatnonzero(ended).tolist()
        self._task.begin(actions)
        self._simulate(actions, set(resets))
        self._num_steps += 1
        infos_of_resets = [self._reset(k, None, None) for k in resets]
        observations = self._task.observe()
        rewards, terminated, infos = self._task.judge()
        truncated = self._num_steps >= self._limit
        masked = dict[str, Any]()
        for name, column in infos.items():
            masked[name], masked["_" + name] = column, self._everywhere
        if resets:
            rewards[resets] = 0.0
            terminated[resets] = truncated[resets] = False
            masked = self._without(masked, ended)
            for k, info in zip(resets, infos_of_resets, strict=True):
                masked = self._add_info(masked, info, k)
        self._ended = terminated | truncated
        return observations, rewards, terminated, truncated, masked

    def _simulate(self, actions: NDArray[Any], without: set[int]) -> None:
        step, model, num_frames = mujoco.mj_step, self.env.model, self.env.frame_skip
        forces = mujoco.mj_rnePostConstraint if self._task.needs_forces else None
        rows = actions.astype(np.float64)
        for k, simulation in enumerate(self._simulations):
            if k not in without:
                self._controls[k][:] = rows[k]
                step(model, simulation, num_frames)
                if forces is not None:
                    forces(model, simulation)

    def _without(self, infos: dict[str, Any], ended: NDArray[np.bool_]) -> dict[str, Any]:
        """Infos of those that were stepped, as Gymnasium has them."""
        if ended.all():
            return {}
        live = ~ended
        for name in [name for name in infos if not name.startswith("_")]:
            infos[name][ended] = 0
            infos["_" + name] = live.copy()
        return infos

    def render(self) -> tuple[Any, ...]:
        """A frame of each."""
        return tuple(self.render_one(k) for k in range(self.num_envs))

    def render_one(self, k: int) -> Any:
        """A frame of simulation k, in the mode that the task was made with."""
        self.env.data = self._shown
        mujoco.mj_copyData(self._shown, self.env.model, self._simulations[k])
        return self.env.render()

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self.env.data = self._shown
        cast("gym.Env[Any, Any]", self.env).close()
