"""Many simulations of one of Gymnasium's MuJoCo tasks, stepped with one call.

Rule: results are bit-identical to those of separate envs of `gymnasium.make`. One Gymnasium env
reads the options, resets, renders and answers calls, for one simulation at a time. MuJoCo steps
all simulations (`mujoco_threads`), and rewards and observations are computed as arrays
(`mujoco_tasks`). Unlike in Gymnasium, a simulation that fails ends its episode.
"""

from __future__ import annotations

import time
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.mujoco.randomize import Randomizer
from rlightning_aio.envs.mujoco.tasks import task_of
from rlightning_aio.envs.mujoco.threads import Simulations, state_of
from rlightning_aio.envs.state import load_state, save_state
from rlightning_aio.envs.wrappers import ClassName, has_wrapper, wrappers_of
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

__all__ = ["FAILED", "MujocoBatch", "is_brief"]

# Its stubs are incomplete.
mujoco: Any = import_module("mujoco")

FAILED: Final = "simulation_failed"
"""Key of an info with the reason why the simulation failed."""
_OWN: Final = ("_np_random", "_np_random_seed", "goal", "goal_pos", "cylinder_pos")
"""Attributes of the Gymnasium env that belong to one simulation, in addition to its data."""
_FIXED: Final = (*_OWN, "data", "model", "np_random", "_elapsed_steps")
"""Attributes that can't be set from outside."""
_NEXT_STEP: Final = AutoresetMode.NEXT_STEP
_SAME_STEP: Final = AutoresetMode.SAME_STEP
_BRIEF_NS: Final = 500_000
_STATE: Final = ("_num_steps", "_before", "_substeps", "_observations", "_ended")
"""Attributes that are part of the state, in addition to the simulations."""


def is_brief(env: gym.Env[Any, Any], num_envs: int, num_threads: int) -> bool:
    """Return True if a step of so many simulations seems to be too short to switch threads for."""
    inner: Any = env.unwrapped
    data = mujoco.MjData(inner.model)
    mujoco.mj_step(inner.model, data, inner.frame_skip)  # The first one is slower.
    began = time.monotonic_ns()
    mujoco.mj_step(inner.model, data, inner.frame_skip)
    return (time.monotonic_ns() - began) * num_envs < _BRIEF_NS * num_threads


class MujocoBatch(gym.vector.VectorEnv[Any, Any, Any]):
    """Simulations of one task.

    They share their model, so a change of it affects all, unless it is randomized.

    Args:
        env: the task, from `gymnasium.make`.
        num_envs: the number of simulations.
        autoreset_mode: when a simulation is reset after the end of its episode.
        num_threads: number of threads for steps, including the caller's; None for one per core
            that this process may use.
        randomize: factors of model fields, drawn at each reset; see `mujoco_randomize`. The info
            of a reset has them as ``randomized``.

    Attributes:
        env: the unwrapped env, in the state of the simulation that used it last.
        takes_masks: True, as it can reset only some simulations.
        fresh_results: see `BaseEnv`.
        releases_gil: True, as steps may be computed in a thread.
        steps_briefly: see `BaseEnv`.

    Raises:
        NotImplementedError: the task isn't one of Gymnasium's v5 tasks, or is wrapped; or MuJoCo is
            older than 3.17.
        ConfigError: `randomize` is wrong.
    """

    takes_masks = True
    fresh_results = True
    releases_gil = True

    def __init__(
        self,
        env: gym.Env[Any, Any],
        num_envs: int,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        *,
        num_threads: int | None = None,
        randomize: Mapping[str, Any] | None = None,
    ) -> None:
        self.env: Any = env.unwrapped
        self.num_envs = num_envs
        self.spec = env.spec
        self.metadata = {**env.metadata, "autoreset_mode": autoreset_mode}
        self.render_mode = self.env.render_mode
        # Annotated here because Gymnasium doesn't say what its spaces hold.
        self.single_observation_space: gym.Space[Any] = self.env.observation_space
        self.single_action_space: gym.Space[Any] = self.env.action_space
        self.observation_space: gym.Space[Any] = batch_space(self.env.observation_space, num_envs)
        self.action_space: gym.Space[Any] = batch_space(self.env.action_space, num_envs)
        kind = task_of(env)
        self._simulations = Simulations(
            self.env.model,
            num_envs,
            num_threads or num_cores(),
            forces=kind.needs_forces,
            own_models=bool(randomize),
        )
        self._randomizer = Randomizer(self._simulations, randomize) if randomize else None
        self._task = kind(self.env, self._simulations)
        # The Gymnasium env resets and renders with these data.
        self._data = self.env.data
        self._made: Any = env
        self._own: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        for k in range(num_envs):
            self._take_back(k)
        self._mode = autoreset_mode
        self._read_step_limit()
        self._num_steps = np.zeros(num_envs, np.int64)
        # All data of a simulation follow from this state and a number of MuJoCo's steps; 0 means a
        # reset.
        self._before = self._simulations.rows.copy()
        self._substeps = np.zeros(num_envs, np.int64)
        self._observations = np.zeros((num_envs, *self.env.observation_space.shape))
        self._ended: NDArray[np.bool_] | None = None
        self._everywhere = np.ones(num_envs, np.bool_)

    def _read_step_limit(self) -> None:
        self._limiter: Any = None
        self._limit: int = np.iinfo(np.int64).max
        for wrapper in wrappers_of(self._made):
            if isinstance(wrapper, gym.wrappers.TimeLimit):
                self._limiter = wrapper
                self._limit = self._limiter._max_episode_steps  # noqa: SLF001

    # -- resets -------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset all simulations, or those in ``options["reset_mask"]``, bools ``[num_envs]``.

        Args:
            seed: simulation k gets ``seed + k``, or element k of a sequence.
            options: passed to the task, without the mask.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + k for k in range(self.num_envs)]
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds for num_envs={self.num_envs}")
        mask = self._everywhere
        if options is not None and "reset_mask" in options:
            options = dict(options)
            mask = options.pop("reset_mask")
        infos: dict[str, Any] = {}
        for k in np.flatnonzero(mask).tolist():
            infos = self._add_info(infos, self._reset(k, seeds[k], options), k)
        ended = np.zeros(self.num_envs, np.bool_) if self._ended is None else self._ended
        self._ended = ended & ~mask
        return self._observations.copy(), infos

    def _reset(
        self, k: int, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """Reset simulation k by the Gymnasium env, and store its observation. Return the info."""
        factors = None if self._randomizer is None else self._randomizer.draw(k, seed)
        self._simulations.show_model(k)
        self._lend(k)
        self._observations[k], info = self.env.reset(seed=seed, options=options)
        _ = self.env.np_random  # Without a seed, this makes a randomly seeded generator.
        self._take_back(k)
        self._put(k, self._data)
        self._before[k] = self._simulations.rows[k]
        self._num_steps[k] = 0
        return info if factors is None else {**info, "randomized": factors}

    def _lend(self, k: int) -> None:
        """Set the attributes of the Gymnasium env to those of simulation k, except for its data."""
        self.env.__dict__.update(self._own[k])

    def _take_back(self, k: int) -> None:
        now = cast("dict[str, Any]", self.env.__dict__)
        self._own[k] = {name: now[name] for name in _OWN if name in now}

    def _put(self, k: int, data: Any) -> None:
        """Continue simulation k from `data`."""
        state_of(self.env.model, data, self._simulations.rows[k])
        self._task.moved(k, data)
        self._substeps[k] = 0

    # -- steps --------------------------------------------------------------------------

    @property
    def steps_briefly(self) -> bool:
        return self._simulations.busy_ns < _BRIEF_NS

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:  # fmt: skip
        """Step all simulations; with `AutoresetMode.NEXT_STEP`, reset those that are over instead.

        A simulation that fails returns its last observation again, with reward 0, truncated; its
        info has the cause as ``simulation_failed``.

        Args:
            actions: ``[num_envs, *action]``.

        Raises:
            ResetNeeded: there was no reset yet.
            ValueError: the actions have the wrong shape.
        """
        ended, actions = self._ended, np.asarray(actions)
        if ended is None:
            raise ResetNeeded("Cannot call env.step() before calling env.reset()")
        if actions.shape != self.action_space.shape:
            raise ValueError(
                f"actions must have shape {self.action_space.shape}, not {actions.shape}"
            )
        # `any` of an array takes four times as long as `count_nonzero`.
        due = ended if self._mode == _NEXT_STEP and np.count_nonzero(ended) else None
        failures = self._simulate(actions, due)
        observations, (rewards, terminated, columns) = self._task.stepped(actions)
        self._num_steps += 1
        truncated = self._num_steps >= self._limit
        # Infos of simulations that have failed or were reset instead.
        apart = {k: {FAILED: cause} for k, cause in failures.items()}
        if due is not None:
            apart |= {k: self._reset(k) for k in np.flatnonzero(due).tolist()}
        if apart:
            chosen = list(apart)
            observations[chosen] = self._observations[chosen]
            rewards[chosen] = 0.0
            terminated[chosen] = truncated[chosen] = False
            truncated[list(failures)] = True
        infos = self._infos(columns, apart)
        self._observations[:] = observations
        self._ended = ended = terminated | truncated
        if self._mode == _SAME_STEP and np.count_nonzero(ended):
            observations, infos = self._reset_ended(ended, observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _simulate(self, actions: NDArray[Any], due: NDArray[np.bool_] | None) -> dict[int, str]:
        """Step all simulations except those due for a reset. Return failures with their reasons."""
        simulations = self._simulations
        self._before[:] = simulations.rows
        self._substeps[:] = self.env.frame_skip
        simulations.ctrl[:] = actions
        ids = None if due is None else np.flatnonzero(~due).astype(np.int32)
        failures = simulations.step(self.env.frame_skip, ids)
        for k in failures:
            self._before[k], self._substeps[k] = simulations.rows[k], 0
        return failures

    def _infos(
        self, columns: dict[str, NDArray[Any]], apart: dict[int, dict[str, Any]]
    ) -> dict[str, Any]:
        """Return the infos of a step with masks, as in Gymnasium.

        Args:
            columns: of all simulations, ``[num_envs, ...]``.
            apart: the infos of simulations that have failed or were reset instead.
        """
        infos, stepped = dict[str, Any](), self._everywhere.copy()
        if not apart:
            for name, column in columns.items():
                infos[name], infos["_" + name] = column, stepped
            return infos
        chosen = list(apart)
        stepped[chosen] = False
        if len(chosen) < self.num_envs:
            for name, column in columns.items():
                infos[name], infos["_" + name] = column.copy(), stepped.copy()
                infos[name][chosen] = 0
        for k, info in apart.items():
            infos = self._add_info(infos, info, k)
        return infos

    def _reset_ended(
        self, ended: NDArray[np.bool_], last: NDArray[Any], infos: dict[str, Any]
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset simulations that have ended. Return observations, and infos with the last ones."""
        final = np.full(self.num_envs, None, object)
        for k in np.flatnonzero(ended).tolist():
            final[k] = last[k].copy()
        final_info = _only(infos, ended)
        infos = _only(infos, ~ended)
        for k in np.flatnonzero(ended).tolist():
            infos = self._add_info(infos, self._reset(k), k)
        infos.update(final_obs=final, _final_obs=ended.copy())
        infos.update(final_info=final_info, _final_info=ended.copy())
        return self._observations.copy(), infos

    # -- calls --------------------------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of the env of each simulation, or get its attribute."""
        if name == "set_wrapper_attr":
            attribute, value = _attribute(*args, **kwargs)
            self.set_attr(attribute, [value] * self.num_envs)
            return (True,) * self.num_envs
        return tuple(self.call_one(k, name, *args, **kwargs) for k in range(self.num_envs))

    def call_one(self, k: int, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env of simulation `k`, or get its attribute.

        The env has a copy of the data of the simulation; changes of them take effect.

        Raises:
            ValueError: the call sets an attribute, which all simulations share.
        """
        if name == "set_wrapper_attr":
            raise _shared(_attribute(*args, **kwargs)[0])
        if name == "render":
            return self.render_one(k)
        self._lend(k)
        self.env.data = data = self._data_of(k)
        if self._limiter is not None and self._ended is not None:
            self._limiter._elapsed_steps = int(self._num_steps[k])  # noqa: SLF001
        try:
            found = self._made.get_wrapper_attr(name)
            return found(*args, **kwargs) if callable(found) else found
        finally:
            self._take_back(k)
            self.env.data = self._data
            state = np.empty_like(self._before[k])
            state_of(self.env.model, data, state)
            if not np.array_equal(state, self._simulations.rows[k], equal_nan=True):
                self._put(k, data)
                self._before[k] = state
            if self._limiter is not None and self._limiter._elapsed_steps is not None:  # noqa: SLF001
                self._num_steps[k] = self._limiter._elapsed_steps  # noqa: SLF001

    def _data_of(self, k: int) -> Any:
        """All data of simulation k, bit-identical to those of a Gymnasium env."""
        return self._simulations.data_of(k, self._before[k], int(self._substeps[k]))

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of all envs to one value.

        Raises:
            ValueError: the simulations, which share a model and all options, would differ, or there
                isn't one value for each.
        """
        different: Iterator[bool] = iter(())
        if isinstance(values, list | tuple):
            each = cast("list[Any]", values)
            if len(each) != self.num_envs:
                raise ValueError(f"{len(each)} values for num_envs={self.num_envs}")
            values, different = each[0], (not _same(each[0], other) for other in each)
        if name in _FIXED or any(different):
            raise _shared(name)
        self._made.set_wrapper_attr(name, values)
        self._note_options(self._task.positions)

    def _note_options(self, positions: Any) -> None:
        """Read the options of the env, which may have changed; the positions are the last ones."""
        self._read_step_limit()
        self._task = type(self._task)(self.env, self._simulations)
        self._task.positions = positions

    def is_wrapped(self, name: ClassName) -> bool:
        """Return True if the env has a wrapper of the class `name`."""
        return has_wrapper(self._made, name)

    # -- state and rendering ------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Save the state of all simulations; see `BaseEnv.save_state`."""
        return {
            # With the model and all options.
            "env": save_state(self._made),
            "rows": self._simulations.rows.copy(),
            "positions": self._task.positions,
            "own": self._own,
            "randomizer": None if self._randomizer is None else self._randomizer.save_state(),
            **{name: getattr(self, name) for name in _STATE},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore the state of all simulations.

        Raises:
            ValueError: it is that of another model, or of simulations with another `randomize`;
                nothing was changed.
        """
        drawn = state["randomizer"]
        if self._randomizer is not None:
            self._randomizer.check_fits(drawn)
        elif drawn is not None:
            raise ValueError("the snapshot's simulations are randomized, and this env's are not")
        load_state(self._made, state["env"])
        self._simulations.rows[:] = state["rows"]
        self._own = [dict(own) for own in state["own"]]
        if self._randomizer is not None:
            self._randomizer.load_state(drawn)
        for name in _STATE:
            setattr(self, name, state[name])
        self._note_options(state["positions"])

    def render(self) -> tuple[Any, ...]:
        """Render a frame of each simulation."""
        return tuple(self.render_one(k) for k in range(self.num_envs))

    def render_one(self, k: int) -> Any:
        """Render a frame of simulation k in the render mode of the task.

        Raises:
            ResetNeeded: there was no reset yet.
        """
        if self._ended is None:
            raise ResetNeeded("Cannot call env.render() before calling env.reset()")
        mujoco.mj_copyData(self._data, self.env.model, self._data_of(k))
        return self.env.render()

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self._simulations.close()
        cast("gym.Env[Any, Any]", self.env).close()


def _only(infos: dict[str, Any], chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Copy what the columns have for the simulations `chosen`, with masks as in Gymnasium."""
    found: dict[str, Any] = {}
    for name, column in infos.items():
        if name.startswith("_"):
            continue
        mask = infos["_" + name] & chosen
        if mask.any():
            found[name] = column.copy()
            found[name][~mask] = None if column.dtype == object else 0
            found["_" + name] = mask
    return found


def _attribute(name: str, value: Any, *, force: bool = True) -> tuple[str, Any]:
    """Return name and value from the arguments of `set_wrapper_attr`."""
    del force
    return name, value


def _shared(name: str) -> ValueError:
    return ValueError(
        f"{name} can't be set for simulations that are stepped together, which share their "
        "model and options; make separate envs (vectorization_mode='async')"
    )


def _same(one: Any, other: Any) -> bool:
    """Return True if two values, or arrays, have the same type and are equal."""
    return one is other or (type(one) is type(other) and np.array_equal(one, other))
