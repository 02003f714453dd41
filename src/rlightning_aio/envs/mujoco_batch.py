"""Many simulations of one of Gymnasium's MuJoCo tasks, stepped with one call.

Rule: to the bit what as many envs of `gymnasium.make` do. Gymnasium's own env, made once, reads
the options, resets, renders and answers calls, for one simulation at a time; only steps are
computed here, for all simulations at once, by `mujoco_tasks`. Absent on purpose: MuJoCo's own
`rollout`, which does not carry each simulation's warm start from call to call.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.mujoco_state import load_data, load_model, save_data, save_model
from rlightning_aio.envs.mujoco_tasks import task_of
from rlightning_aio.envs.wrappers import wrappers_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["MujocoBatch"]

# Its stubs leave out half of it.
mujoco: Any = import_module("mujoco")

_OWN: Final = ("data", "_np_random", "_np_random_seed", "goal", "goal_pos", "cylinder_pos")
"""What of Gymnasium's env belongs to one simulation."""
_FIXED: Final = (*_OWN, "model", "np_random", "_elapsed_steps")
"""What can't be set from outside."""


class MujocoBatch(gym.vector.VectorEnv[Any, Any, Any]):
    """Simulations of one task.

    They share their model: what is changed in it is changed for all.

    Args:
        env: what `gymnasium.make` made of the task.
        num_envs: how many.
        autoreset_mode: what each does after its episode's end.

    Attributes:
        env: the same, unwrapped; its state is that of the simulation it was lent to last.
        takes_masks: it resets those that a mask names alone.

    Raises:
        NotImplementedError: the task is none of Gymnasium's v5 tasks, or is wrapped.
    """

    takes_masks = True

    def __init__(
        self,
        env: gym.Env[Any, Any],
        num_envs: int,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.env: Any = env.unwrapped
        self.num_envs = num_envs
        self.spec = env.spec
        self.metadata = {**env.metadata, "autoreset_mode": autoreset_mode}
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
        self._made: Any = env
        self._own: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        for k, simulation in enumerate(self._simulations):
            self._take_back(k)
            self._own[k]["data"] = simulation
        self._mode = autoreset_mode
        self._read_options()
        self._num_steps = np.zeros(num_envs, np.int64)
        self._ended: NDArray[np.bool_] | None = None
        self._everywhere = np.ones(num_envs, np.bool_)

    def _read_options(self) -> None:
        """Take up what the env was made with, or what was set since."""
        self._task = task_of(self._made, self._simulations)
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
        """Reset all, or those of ``options["reset_mask"]``, a bool array ``[num_envs]``.

        Args:
            seed: simulation k gets ``seed + k``, or its own of a sequence.
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
        return self._task.observe(), infos

    def _reset(
        self, k: int, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> dict[str, Any]:
        """Have Gymnasium's env reset simulation k; its info."""
        self._lend(k)
        _, info = self.env.reset(seed=seed, options=options)
        _ = self.env.np_random  # Without a seed it gets its generator here, by chance.
        self._take_back(k)
        self._num_steps[k] = 0
        return info

    def _lend(self, k: int) -> None:
        """Have Gymnasium's env be the one of simulation k."""
        self.env.__dict__.update(self._own[k])

    def _take_back(self, k: int) -> None:
        now = cast("dict[str, Any]", self.env.__dict__)
        self._own[k] = {name: now[name] for name in _OWN if name in now}

    # -- steps --------------------------------------------------------------------------

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:  # fmt: skip
        """Step all; with `AutoresetMode.NEXT_STEP`, those that are over are reset instead.

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
        resets: list[int] = []
        if self._mode == AutoresetMode.NEXT_STEP:
            resets = np.flatnonzero(ended).tolist()
        self._task.begin(actions)
        self._simulate(actions, set(resets))
        self._num_steps += 1
        infos_of_resets = [self._reset(k) for k in resets]
        observations = self._task.observe()
        rewards, terminated, infos = self._task.judge()
        truncated = self._num_steps >= self._limit
        masked = dict[str, Any]()
        for name, column in infos.items():
            masked[name], masked["_" + name] = column, self._everywhere
        if resets:
            rewards[resets] = 0.0
            terminated[resets] = truncated[resets] = False
            masked = self._reset_infos(masked, ended, resets, infos_of_resets)
        self._ended = ended = terminated | truncated
        if self._mode == AutoresetMode.SAME_STEP and ended.any():
            observations, masked = self._begun_anew(ended, observations, masked)
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

    def _begun_anew(
        self, ended: NDArray[np.bool_], last: NDArray[Any], infos: dict[str, Any]
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Reset those that have ended; their observations, and the last ones among the infos."""
        chosen: list[int] = np.flatnonzero(ended).tolist()
        final = np.full(self.num_envs, None, object)
        for k in chosen:
            final[k] = last[k].copy()
        final_info = _only(infos, ended)
        infos = self._reset_infos(infos, ended, chosen, [self._reset(k) for k in chosen])
        infos.update(final_obs=final, _final_obs=ended.copy())
        infos.update(final_info=final_info, _final_info=ended.copy())
        return self._task.observe(), infos

    def _reset_infos(
        self,
        infos: dict[str, Any],
        ended: NDArray[np.bool_],
        resets: list[int],
        infos_of_resets: list[dict[str, Any]],
    ) -> dict[str, Any]:
        """Infos of a step, with those of resets in place of the step's own."""
        infos = _only(infos, ~ended)
        for k, info in zip(resets, infos_of_resets, strict=True):
            infos = self._add_info(infos, info, k)
        return infos

    # -- one of them --------------------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of the env of each simulation, or get its attribute."""
        if name == "set_wrapper_attr":
            attribute, value = _attribute(*args, **kwargs)
            self.set_attr(attribute, [value] * self.num_envs)
            return (True,) * self.num_envs
        return tuple(self.call_one(k, name, *args, **kwargs) for k in range(self.num_envs))

    def call_one(self, k: int, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env of simulation `k`, or get its attribute.

        Raises:
            ValueError: it sets an attribute, which all simulations share.
        """
        if name == "set_wrapper_attr":
            raise _shared(_attribute(*args, **kwargs)[0])
        if name == "render":
            return self.render_one(k)
        self._lend(k)
        if self._limiter is not None and self._ended is not None:
            self._limiter._elapsed_steps = int(self._num_steps[k])  # noqa: SLF001
        found = self._made.get_wrapper_attr(name)
        try:
            return found(*args, **kwargs) if callable(found) else found
        finally:
            self._take_back(k)
            if self._limiter is not None and self._limiter._elapsed_steps is not None:  # noqa: SLF001
                self._num_steps[k] = self._limiter._elapsed_steps  # noqa: SLF001

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of all envs to one value.

        Raises:
            ValueError: the simulations, which share a model and all options, would differ.
        """
        different: Iterator[bool] = iter(())
        if isinstance(values, list | tuple):
            each = cast("list[Any]", values)
            values, different = each[0], (not _same(each[0], other) for other in each)
        if name in _FIXED or any(different):
            raise _shared(name)
        self._made.set_wrapper_attr(name, values)
        self._read_options()

    def is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Whether `wrapper_class` is among the wrappers of each."""
        return any(isinstance(wrapper, wrapper_class) for wrapper in wrappers_of(self._made))

    # -- its state ----------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """All simulations as they are; see `BaseEnv.save_state`."""
        return {
            "model": save_model(self.env.model),
            "simulations": [save_data(simulation) for simulation in self._simulations],
            "own": [{name: own[name] for name in own if name != "data"} for own in self._own],
            "num_steps": self._num_steps,
            "ended": self._ended,
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Put all simulations back."""
        load_model(self.env.model, state["model"])
        for simulation, saved in zip(self._simulations, state["simulations"], strict=True):
            load_data(simulation, saved)
        self._own = [
            {**own, "data": simulation}
            for own, simulation in zip(state["own"], self._simulations, strict=True)
        ]
        self._num_steps, self._ended = state["num_steps"], state["ended"]

    def render(self) -> tuple[Any, ...]:
        """A frame of each."""
        return tuple(self.render_one(k) for k in range(self.num_envs))

    def render_one(self, k: int) -> Any:
        """A frame of simulation k, in the mode that the task was made with.

        Raises:
            ResetNeeded: there was no reset yet.
        """
        if self._ended is None:
            raise ResetNeeded("Cannot call env.render() before calling env.reset()")
        self.env.data = self._shown
        mujoco.mj_copyData(self._shown, self.env.model, self._simulations[k])
        return self.env.render()

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self.env.data = self._shown
        cast("gym.Env[Any, Any]", self.env).close()


def _only(infos: dict[str, Any], chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """A copy of columns that are everywhere, for some alone, as Gymnasium has them."""
    if not chosen.any():
        return {}
    found: dict[str, Any] = {}
    for name, column in infos.items():
        if not name.startswith("_"):
            found[name] = column.copy()
            found[name][~chosen] = 0
            found["_" + name] = chosen.copy()
    return found


def _attribute(name: str, value: Any, *, force: bool = True) -> tuple[str, Any]:
    """What `set_wrapper_attr` is called with."""
    del force
    return name, value


def _shared(name: str) -> ValueError:
    return ValueError(
        f"{name} can't be set for simulations that are stepped together, which share their "
        "model and options; make separate envs (vectorization_mode='async')"
    )


def _same(one: Any, other: Any) -> bool:
    """Whether two values are of one type and equal, arrays included."""
    return one is other or (type(one) is type(other) and np.array_equal(one, other))
