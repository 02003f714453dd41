"""Many simulations of one of Gymnasium's MuJoCo tasks, stepped with one call.

Rule: results are bit-identical to those of separate envs of `gymnasium.make`. One Gymnasium env
reads the options, renders and answers calls, for one simulation at a time. MuJoCo steps and resets
all simulations (`threads`), and rewards, observations and noise are computed as arrays (`tasks`,
`resets`). A task whose reset does more than draw noise is reset by the Gymnasium env, one after
the other. Unlike in Gymnasium, a simulation that fails ends its episode.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from rlightning_aio.envs.mujoco.infos import Begun, Finished, of_step
from rlightning_aio.envs.mujoco.resets import can_draw, drawn, generator_of, noise_of
from rlightning_aio.envs.mujoco.tasks import task_of
from rlightning_aio.envs.mujoco.threads import Simulations
from rlightning_aio.envs.state import load_state, save_state
from rlightning_aio.envs.wrappers import ClassName, check_running, has_wrapper, wrappers_of
from rlightning_aio.sharing import num_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.envs.mujoco.outputs import StepArrays
    from rlightning_aio.envs.mujoco.task import Task

# Its stubs are incomplete.
mujoco: Any = import_module("mujoco")

FAILED: Final = "simulation_failed"
"""Key of an info with the reason why the simulation failed."""
_OWN: Final = ("_np_random", "_np_random_seed", "goal", "goal_pos", "cylinder_pos")
"""Attributes of the Gymnasium env that belong to one simulation, in addition to its data."""
_FIXED: Final = (*_OWN, "data", "model", "np_random", "_elapsed_steps")
"""Attributes that can't be set from outside."""
_READERS: Final = ("get_wrapper_attr", "has_wrapper_attr")
_NEXT_STEP: Final = AutoresetMode.NEXT_STEP
_SAME_STEP: Final = AutoresetMode.SAME_STEP
_STATE: Final = ("_num_steps", "_last", "_ended")
"""Attributes that are part of the state, in addition to the simulations."""


class MujocoBatch(gym.vector.VectorEnv[Any, Any, Any]):
    """Simulations of one task.

    They share their model and all options, so a change of these affects all.

    Args:
        env: the task, from `gymnasium.make`.
        num_envs: the number of simulations.
        autoreset_mode: when a simulation is reset after the end of its episode.
        num_threads: number of threads for steps, including the caller's; None for one per core
            that this process may use.

    Attributes:
        env: the unwrapped env, in the state of the simulation that used it last.
        fresh_results: see `FastPath`.

    Raises:
        NotImplementedError: the task isn't one of Gymnasium's v5 tasks, or is wrapped; or MuJoCo is
            older than 3.17.
    """

    fresh_results = True

    def __init__(
        self,
        env: gym.Env[Any, Any],
        num_envs: int,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        *,
        num_threads: int | None = None,
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
        threads = num_threads or num_cores()
        self._simulations = Simulations(self.env.model, num_envs, threads, forces=kind.needs_forces)
        # Where the generator of a simulation is; not for those of the set, which have new ones.
        self._generators, self._unknown = np.zeros(num_envs, np.uintp), set(range(num_envs))
        # The Gymnasium env resets and renders with these data.
        self._data = self.env.data
        self._made: Any = env
        self._mode = autoreset_mode
        # Steps of all; those of a simulation began at its element of `_began`.
        self._clock = 0
        self._began = self._simulations.began
        self._read_options(kind)
        self._own: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        for k in range(num_envs):
            self._take_back(k)
        # The observations that were returned last; never written to.
        self._last = np.zeros((num_envs, *self.env.observation_space.shape))
        # None until each simulation was reset once.
        self._ended: NDArray[np.bool_] | None = None
        self._unused = np.ones(num_envs, np.bool_)
        self._nobody = np.zeros(num_envs, np.bool_)
        self._is_whole = True  # No step or reset was interrupted.

    def _read_options(self, kind: type[Task]) -> None:
        """Read the options of the env."""
        self._limiter: Any = None
        self._limit: int = np.iinfo(np.int64).max
        for wrapper in wrappers_of(self._made):
            if isinstance(wrapper, gym.wrappers.TimeLimit):
                self._limiter = wrapper
                self._limit = self._limiter._max_episode_steps  # noqa: SLF001
        simulations, env = self._simulations, self.env
        simulations.limit(self._limit)
        self._task = task = kind(env, simulations)
        # A reset of the task only draws noise, and MuJoCo needs nothing else.
        self._resets_together = (
            task.noise != "more"
            and env.render_mode != "human"
            and not (task.needs_forces and env.model.nsensor)
            and can_draw(env._reset_noise_scale)  # noqa: SLF001
        )
        noise = noise_of(env, task.noise, self._generators) if self._resets_together else None
        simulations.draw(noise)
        self._draws = noise is None

    @property
    def _num_steps(self) -> NDArray[np.int64]:
        """Steps since the last reset."""
        return self._clock - self._began

    @_num_steps.setter
    def _num_steps(self, values: NDArray[np.int64]) -> None:
        self._began[:] = self._clock - values

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
        mask = np.ones(self.num_envs, np.bool_)
        if options is not None and "reset_mask" in options:
            options = dict(options)
            mask = options.pop("reset_mask")
            if not (self._is_whole or mask.all()):
                raise ResetNeeded("a step or reset was interrupted: call reset() without a mask")
        self._is_whole = False
        ids, observations = np.flatnonzero(mask), self._last.copy()
        begun = self._begin(ids, observations, [seeds[k] for k in ids.tolist()], options)
        self._unused &= ~mask
        if self._ended is not None or not self._unused.any():
            ended = (self._nobody if self._ended is None else self._ended) & ~mask
            self._ended = ended if ended.any() else self._nobody
        self._is_whole = True
        self._keep(observations)
        return observations, self._infos(partial(begun.added, {}, self.num_envs))

    def _infos(self, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return infos."""
        return make()

    def _keep(self, observations: NDArray[Any]) -> None:
        """Keep what is returned; where masks are usual, a copy that the caller can't change."""
        is_masked = self._mode == AutoresetMode.DISABLED
        self._last = observations.copy() if is_masked else observations

    def _begin(
        self,
        ids: NDArray[np.intp],
        observations: NDArray[Any],
        seeds: Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> Begun:
        """Reset the simulations `ids`, and write their observations into those of all.

        Args:
            ids: the simulations.
            observations: of all simulations.
            seeds: of the simulations `ids`.
            options: passed to the task.
        """
        self._began[ids] = self._clock
        if not self._resets_together:
            given = [None] * len(ids) if seeds is None else seeds
            for k, seed in zip(ids.tolist(), given, strict=True):
                self._reset(k, observations, seed, options)
            return Begun(ids, self._task.begun(ids))
        task = self._task
        self._draw(ids, seeds)
        task.renew(observations)
        self._simulations.advance(ids.astype(np.int32))
        task.finish(ids)
        task.settle(ids)
        return Begun(ids, task.begun(ids))

    def _draw(self, ids: NDArray[np.intp], seeds: Sequence[int | None] | None = None) -> None:
        """Draw first states of the simulations `ids`, for MuJoCo to begin with."""
        simulations = self._simulations
        if seeds is not None or self._unknown or self._draws:
            chosen = list[int](ids.tolist())
            given = [None] * len(chosen) if seeds is None else seeds
            found = [self._generator(k, seed) for k, seed in zip(chosen, given, strict=True)]
            if self._draws:
                env, kind = self.env, self._task.noise
                scale: Any = env._reset_noise_scale  # noqa: SLF001
                noise = drawn(found, kind, scale, env.model.nq, env.model.nv)
                simulations.starts[ids] = np.concatenate([env.init_qpos, env.init_qvel]) + noise
        simulations.begin(ids)

    def _generator(self, k: int, seed: int | None) -> np.random.Generator:
        """The generator of simulation `k`, seeded like that of a Gymnasium env."""
        own = self._own[k]
        if seed is not None or own.get("_np_random") is None:
            own["_np_random"], own["_np_random_seed"] = seeding.np_random(seed)
            self._unknown.add(k)
        generator: np.random.Generator = own["_np_random"]
        if k in self._unknown:
            self._generators[k] = generator_of(generator)
            self._unknown.remove(k)
        return generator

    def _reset(
        self, k: int, observations: NDArray[Any], seed: int | None, options: dict[str, Any] | None
    ) -> None:
        """Reset simulation k by the Gymnasium env."""
        self._lend(k)
        observations[k], _ = self.env.reset(seed=seed, options=options)
        _ = self.env.np_random  # Without a seed, this makes a randomly seeded generator.
        self._take_back(k)
        self._task.put(k, self._data)

    def _lend(self, k: int) -> None:
        """Set the attributes of the Gymnasium env to those of simulation k, except for its data."""
        self.env.__dict__.update(self._own[k])

    def _take_back(self, k: int) -> None:
        now = cast("dict[str, Any]", self.env.__dict__)
        self._own[k] = {name: now[name] for name in _OWN if name in now}
        self._unknown.add(k)

    # -- steps --------------------------------------------------------------------------

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
            ResetNeeded: a simulation was not reset yet, or a call was interrupted.
            ValueError: the actions have the wrong shape.
        """
        check_running(self)
        ended, actions = self._ended, np.asarray(actions)
        if ended is None or not self._is_whole:
            what = "before calling env.reset()" if ended is None else "after an interrupted call"
            raise ResetNeeded(f"Cannot call env.step() {what}")
        if actions.shape != self.action_space.shape:
            raise ValueError(
                f"actions must have shape {self.action_space.shape}, not {actions.shape}"
            )
        self._is_whole, task = False, self._task
        due = ended.nonzero()[0] if self._mode == _NEXT_STEP and ended is not self._nobody else None
        self._clock += 1
        begun, failures = self._simulate(actions, due)
        columns = task.stepped()
        frame, failed = task.frame, list(failures)
        observations = frame.observations
        if due is not None:
            begun = begun or self._begin(due, observations)
        ended = self._ends(frame, due, failed)
        finished = None
        if self._mode == _SAME_STEP and ended is not self._nobody:
            ids = ended.nonzero()[0]
            finished = Finished(ended, observations[ids])
            begun = self._begin(ids, observations)
        self._keep(observations)
        causes = {k: {FAILED: cause} for k, cause in failures.items()}
        infos = partial(of_step, columns, self.num_envs, causes, begun, finished, self._add_info)
        self._is_whole = True
        # PyTorch takes a subclass of dict for a leaf, and TorchRL looks for `final_obs` there.
        made = self._infos(infos) if finished is None else infos()
        return observations, frame.rewards, frame.terminated, frame.truncated, made

    def _ends(self, frame: StepArrays, due: Any, failed: list[int]) -> NDArray[np.bool_]:
        """Complete the ends of a step, and rewards of those that did none. Return who has ended."""
        simulations, limit = self._simulations, self._limit
        has_judged, any_ended = simulations.has_judged, simulations.any_ended
        if not has_judged:
            frame.truncated[:] = self._clock - self._began >= limit
        if due is not None and not (has_judged and self._resets_together):
            self._began[due], frame.rewards[due] = self._clock, 0.0
            frame.terminated[due] = frame.truncated[due] = frame.ended[due] = False
        if failed:
            frame.observations[failed], frame.rewards[failed] = self._last[failed], 0.0
            frame.terminated[failed], frame.truncated[failed] = False, True
        if failed or not has_judged:
            np.logical_or(frame.terminated, frame.truncated, out=frame.ended)
            any_ended = bool(np.count_nonzero(frame.ended))  # `any` takes four times as long.
        self._ended = frame.ended if any_ended else self._nobody
        return self._ended

    def _simulate(
        self, actions: NDArray[Any], due: NDArray[np.intp] | None
    ) -> tuple[Begun | None, dict[int, str]]:
        """Step all simulations but those that are due for a reset, and reset these if possible.

        Returns:
            Those that were reset, and failures with their reasons.
        """
        simulations, task = self._simulations, self._task
        simulations.control(actions, self.env.frame_skip)
        begun = ids = None
        if due is not None and not self._resets_together:
            ids = np.setdiff1d(np.arange(self.num_envs, dtype=np.int32), due)
            task.renew(self._last.copy())
        else:
            if due is not None:
                self._draw(due)
            task.renew()
            if due is not None:
                begun = Begun(due, task.begun(due))
        failures = simulations.advance(ids, self._clock)
        if failures:
            # What was not computed may be anything.
            task.keep(list(failures), self._last)
        return begun, failures

    # -- attributes ---------------------------------------------------------------------

    def call(self, name: str, /, *args: Any) -> tuple[Any, ...]:
        """Get attribute `name` of the env of each simulation; ``render`` renders a frame of each.

        Args:
            name: of the attribute, or ``get_wrapper_attr`` or ``has_wrapper_attr``.
            args: the name for these two.

        Raises:
            NotImplementedError: it is another method, which exists once for all simulations.
        """
        return tuple(self.call_one(k, name, *args) for k in range(self.num_envs))

    def call_one(self, k: int, name: str, /, *args: Any) -> Any:
        """The same for simulation `k` alone. Of its ``data`` this is a copy."""
        if name == "render":
            return self.render_one(k)
        self._lend(k)
        self.env.data = self._simulations.data_of(k)
        if self._limiter is not None and self._ended is not None:
            self._limiter._elapsed_steps = int(self._num_steps[k])  # noqa: SLF001
        try:
            found = self._made.get_wrapper_attr(name)
            if name in _READERS:
                found = found(*args)
        finally:
            self._take_back(k)
            self.env.data = self._data
        if callable(found):
            raise NotImplementedError(
                f"{name}() can't be called for simulations that are stepped together: read "
                "attributes, such as data, or make separate envs (vectorization_mode='async')"
            )
        return found

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of all envs to one value.

        Raises:
            ValueError: the simulations, which share a model and all options, would differ, or there
                isn't one value for each.
        """
        check_running(self)
        different: Iterator[bool] = iter(())
        if isinstance(values, list | tuple):
            each = cast("list[Any]", values)
            if len(each) != self.num_envs:
                raise ValueError(f"{len(each)} values for num_envs={self.num_envs}")
            values, different = each[0], (not _same(each[0], other) for other in each)
        if name in _FIXED or any(different):
            raise _shared(name)
        self._made.set_wrapper_attr(name, values)
        self._note_options(self._task.place)

    def _note_options(self, place: Any) -> None:
        """Read the options of the env, which may have changed; the bodies stay where they are."""
        self._read_options(type(self._task))
        if place is not None:
            self._task.place[:] = place

    def is_wrapped(self, name: ClassName) -> bool:
        """Return True if the env has a wrapper of the class `name`."""
        return has_wrapper(self._made, name)

    # -- state and rendering ------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Save the state of all simulations; see `BaseEnv.save_state`."""
        return {
            "kind": self._kind,
            # With the model and all options.
            "env": save_state(self._made),
            "simulations": self._simulations.save_state(),
            "place": None if self._task.place is None else self._task.place.copy(),
            "own": self._own,
            **{name: getattr(self, name) for name in _STATE},
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore the state of all simulations.

        Raises:
            ValueError: it is that of another model, another number of simulations, another mode or
                step limit; nothing was changed.
        """
        if state["kind"] != self._kind:
            raise ValueError(f"the state is of a batch with {state['kind']}, not {self._kind}")
        was_whole, self._is_whole = self._is_whole, False
        try:
            load_state(self._made, state["env"])
        except ValueError:
            self._is_whole = was_whole
            raise
        self._note_options(state["place"])
        self._simulations.load_state(state["simulations"])
        self._own = [dict(own) for own in state["own"]]
        self._unknown.update(range(self.num_envs))
        for name in _STATE:
            setattr(self, name, state[name])
        self._is_whole = True

    @property
    def _kind(self) -> dict[str, Any]:
        """Facts besides the model that a state must share."""
        mode = self.metadata["autoreset_mode"].value
        return {"num_envs": self.num_envs, "autoreset_mode": mode, "max_episode_steps": self._limit}

    def render(self) -> tuple[Any, ...]:
        """Render a frame of each simulation."""
        return tuple(self.render_one(k) for k in range(self.num_envs))

    def render_one(self, k: int) -> Any:
        """Render a frame of simulation k in the render mode of the task.

        Raises:
            ResetNeeded: there was no reset yet.
        """
        check_running(self)
        if self._ended is None:
            raise ResetNeeded("Cannot call env.render() before calling env.reset()")
        mujoco.mj_copyData(self._data, self.env.model, self._simulations.data_of(k))
        return self.env.render()

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self._simulations.close()
        cast("gym.Env[Any, Any]", self.env).close()


def _shared(name: str) -> ValueError:
    return ValueError(
        f"{name} can't be set for simulations that are stepped together, which share their "
        "model and options; make separate envs (vectorization_mode='async')"
    )


def _same(one: Any, other: Any) -> bool:
    """Return True if two values, or arrays, have the same type and are equal."""
    return one is other or (type(one) is type(other) and np.array_equal(one, other))
