"""`EnvRunner`: executes requests on one env and puts the results into its row.

The same code runs in a worker process and, for inline placement, in the trainer.
What of a result doesn't fit the row (a pickled observation, a nested info) is
returned as a dict, the *rest*; None means that the row holds everything.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio.envs.base import (
    BareReset,
    BareResult,
    BareStep,
    BareStepAsync,
    BareStepWait,
    BaseEnv,
    default_env_preprocess_fn,
    result_of,
)
from rlightning_aio.envs.tensors import as_numpy, holds_tensor
from rlightning_aio.hosts.copied import copied
from rlightning_aio.hosts.episodes import EpisodeSums
from rlightning_aio.protocol.columns import fitted_tree, leaves, row_reader, row_writer
from rlightning_aio.protocol.info import NO_INFO, PICKLED, InfoSchema, InfoWriter
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["NO_ACTION", "EnvRunner", "Rest"]

NO_ACTION: Final = "the action is in the row"
"""Travels in place of an action whose extras alone did not fit the row."""
Rest = dict[str, Any]
"""Keys: ``observation``, ``info``, ``extra`` (the result's ``_extra``), ``ret`` (all of it)."""


class EnvRunner:
    """One env and its row.

    Args:
        env: built, not yet initialised.
        inline: results stay in this process. Those that hold torch tensors are handed over
            whole and untouched then; elsewhere tensors become NumPy arrays on the CPU.

    Attributes:
        begin_step: starts a step whose simulator computes by itself, and returns what ends
            it; None if it has none. `step` is both in one.
    """

    def __init__(self, env: BaseEnv, *, inline: bool = False) -> None:
        self.env = env
        self.meta: EnvMeta = env.init()
        self._inline = inline
        self.step: Callable[[], Rest | None] = self._not_attached
        self.begin_step: Callable[[], Callable[[], Rest | None]] | None = None
        self.reset_from_row: Callable[[], Rest | None] = self._not_attached

    @property
    def layout(self) -> RowLayout:
        """The row that this env needs."""
        meta = self.meta
        sub_envs = (meta.num_envs,) if meta.num_envs > 1 else ()
        agents = (len(meta.agents),) if meta.agents else ()
        if meta.observation_space is None or meta.action_space is None:
            raise TypeError(
                f"env {meta.env_id!r} reports no "
                f"{'observation' if meta.observation_space is None else 'action'} space"
            )
        return RowLayout(
            meta.observation_space,
            meta.action_space,
            (*agents, *sub_envs),
            meta.agents,
            observations_apart=self._hands_over and leaves(meta.observation_space) is not None,
        )

    @property
    def _hands_over(self) -> bool:
        """Whether the results of bare steps may be kept by whoever gets them."""
        return self._inline and self.env.fresh_results and self.env.bare_step() is not None

    @property
    def reads_extras(self) -> bool:
        """Whether anything here can read more of a response than a plain action."""
        return self.env.bare_step() is None and (
            not type(self.env).__module__.startswith("rlightning_aio.envs.")
            or self.env._preprocess_fn is not default_env_preprocess_fn  # pyright: ignore[reportPrivateUsage]
        )

    @property
    def transforms_actions(self) -> bool:
        """Whether an action may have any shape and type."""
        return (
            self.env.transforms_actions or self.env._preprocess_fn is not default_env_preprocess_fn  # pyright: ignore[reportPrivateUsage]
        )

    def attach(self, slab: Slab, row: int, announce: Callable[[InfoSchema], int]) -> None:
        """Take `row` of `slab` for all further results."""
        layout = self._layout = self.layout
        self._row = row
        self._slab = slab
        self._write_observation: Callable[[Any], None] | None = None
        if slab.observation is not None:
            self._write_observation = row_writer(
                layout.observation_space, slab.observation, row, "observation"
            )
        self._read_action: Callable[[], Any] | None = None
        if slab.action is not None:
            self._read_action = row_reader(layout.action_space, slab.action, row)
        self._info_writer = InfoWriter(memoryview(slab.info[row]), announce)
        # With an ellipsis an entry of a plain column is a view, too.
        self._reward, self._ends = slab.reward[row, ...], slab.ends[row, ...]
        # Whether results come from some of the sub-environments at a time.
        self._takes_turns = self.env.config.num_envs > self.meta.num_envs
        episodes = (self.env.config.num_envs,) if self._takes_turns else layout.head
        self._episodes = EpisodeSums(episodes, self.meta.autoreset)
        self.reset_from_row = self._reset_from_row
        self.step = self._stepper()

    def _action_in_row(self) -> Any:
        """A copy of the action that the row holds."""
        if self._read_action is None:
            raise RuntimeError("actions of this env don't travel in its row")
        return self._read_action()

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call a method of the env; ``get_attr`` and ``set_attr`` reach through wrappers."""
        if name == "get_attr":
            return get_attr(self.env, *args, **kwargs)
        if name == "set_attr":
            return set_attr(self.env, *args, **kwargs)
        method = getattr(self.env, name, None)
        if method is None:
            method = getattr(self.env.env, name)
        return method(*args, **kwargs)

    def _not_attached(self) -> Rest | None:
        raise RuntimeError("this env has no row yet")

    def _stepper(self) -> Callable[[], Rest | None]:
        bare, read_action = self.env.bare_step(), self._read_action
        if read_action is None:
            return lambda: self.step_with(None, {})
        if bare is None:
            return lambda: self.step_with(read_action(), {})
        halves = self.env.bare_step_async()
        single = not self._layout.head and self.meta.autoreset == "disabled"
        if single and halves is None and self._write_observation is not None:
            return self._single_stepper(bare, read_action, self._write_observation)
        store, clock = self._bare_store(), time.monotonic_ns
        if halves is not None:
            self.begin_step = _step_beginner(halves, read_action, store)

        def step() -> Rest | None:
            began = clock()
            return store(bare(read_action()), clock() - began)

        return step

    def _single_stepper(
        self,
        bare: BareStep,
        read_action: Callable[[], Any],
        write_observation: Callable[[Any], None],
    ) -> Callable[[], Rest | None]:
        bare_reset = self.env.bare_reset()
        self.reset_episode, step, reset = _bare_stepper(
            bare,
            bare_reset,
            read_action,
            write_observation,
            self._info_writer.write,
            self._beside,
            self._slab,
            self._row,
        )
        if bare_reset is not None:
            self.reset_from_row = reset
        return step

    def _bare_store(self) -> Callable[[BareResult, int], Rest | None]:
        """A function that puts a bare result, which took so many ns, into the row."""
        slab, row, clock = self._slab, self._row, time.monotonic_ns
        reward, terminated, truncated = self._reward, self._ends[..., 0], self._ends[..., 1]
        done_times, busy_times = _view(slab.done_ns), _view(slab.busy_ns)
        count_step = self._count_step
        store_data = self._hand_over if self._layout.observations_apart else self._store_data

        def store(result: BareResult, busy_ns: int) -> Rest | None:
            observation, reward[...], terminated[...], truncated[...], info = result
            done_times[row] = clock()
            busy_times[row] = busy_ns
            count_step(info)
            return store_data(observation, info) or None

        return store

    def _hand_over(self, observation: Any, info: dict[str, Any]) -> Rest:
        """What the row would only copy."""
        space = self._layout.observation_space
        return {"observation": fitted_tree(space, observation, "observation"), "info": info}

    def _store_data(self, observation: Any, info: dict[str, Any]) -> Rest:
        """Put them into the row; what doesn't fit there."""
        if self._layout.observations_apart:
            return self._beside(self._hand_over(observation, info))
        rest: Rest = {}
        if self._write_observation is None:
            rest["observation"] = observation
        else:
            self._write_observation(observation)
        mark = self._slab.info_mark[self._row] = self._info_writer.write(info)
        if mark == PICKLED:
            rest["info"] = as_numpy(info)
        return self._beside(rest)

    def _beside(self, rest: Rest) -> Rest:
        """`rest` as the trainer may keep it; it is pickled on its way to another process."""
        return copied(rest) if rest and self._inline else rest

    def reset_episode(self) -> None:
        """Forget what was summed up of the current episode."""
        self._episodes.forget()

    def step_with(self, action: Any, extras: dict[str, Any]) -> Rest | None:
        """Step with an action that didn't come through the row, or with extras."""
        if type(action) is str and action == NO_ACTION:
            action = self._action_in_row()
        began = time.monotonic_ns()
        bare = self.env.bare_step()
        if bare is not None:
            result = result_of(self.env.env_id, bare(action))
        else:
            result = self.env.step(PolicyResponse(self.env.env_id, action, **extras))
        return self._store(result, began, stepped=True)

    def reset(self, seed: int | None, options: dict[str, Any] | None) -> Rest | None:
        """Start a new episode."""
        began = time.monotonic_ns()
        result = self.env.reset(seed=seed, options=options)
        self.reset_episode()
        if self._takes_turns:
            # The others' first observations are still to come, as results of steps.
            assert isinstance(result, EnvRet)
            self._episodes.forget(begun=np.asarray(result.info["env_id"]))
        return self._store(result, began, stepped=False)

    def _reset_from_row(self) -> Rest | None:
        """Start a new episode with the seed that the row holds."""
        return self.reset(self._slab.take_seed(self._row), None)

    def _store(self, result: Any, began_ns: int, *, stepped: bool) -> Rest | None:
        done_ns = time.monotonic_ns()
        self._slab.done_ns[self._row] = done_ns
        self._slab.busy_ns[self._row] = done_ns - began_ns
        if not isinstance(result, EnvRet | MultiAgentEnvRet):
            raise TypeError(
                f"{'step' if stepped else 'reset'}() of env {self.env.env_id!r} must return an "
                f"EnvRet or a MultiAgentEnvRet, not {type(result).__name__}"
            )
        rest: Rest = {}
        if holds_tensor(result.observation):
            if self._inline:
                rest["ret"] = result
            observation = as_numpy(result.observation)
        else:
            observation = result.observation
        self._store_head(result, stepped=stepped)
        if "ret" in rest:
            return rest
        rest = self._store_data(observation, result.info)
        if result._extra:  # pyright: ignore[reportPrivateUsage]
            rest |= self._beside({"extra": result._extra})  # pyright: ignore[reportPrivateUsage]
        return rest or None

    def _store_head(self, result: EnvRet | MultiAgentEnvRet, *, stepped: bool) -> None:
        slab, row = self._slab, self._row
        reward, terminated, truncated = slab.reward[row : row + 1], slab.terminated, slab.truncated
        if not stepped:
            reward[...] = 0.0
            terminated[row] = truncated[row] = False
            return
        agents = slab.layout.agents
        self._store_flag("reward", slab.reward, result.last_reward, agents)
        self._store_flag("terminated", terminated, result.last_terminated, agents)
        self._store_flag("truncated", truncated, result.last_truncated, agents)
        self._count_step(result.info)

    def _count_step(self, info: dict[str, Any]) -> None:
        """Add the step that the row holds to its episodes."""
        which = np.asarray(info["env_id"]) if self._takes_turns else ...
        sums = self._episodes.add(self._reward, self._ends, which)
        if sums is not None:
            slab, row = self._slab, self._row
            slab.episode_return[row], slab.episode_length[row] = sums

    def _store_flag(self, what: str, column: Any, value: Any, agents: tuple[str, ...]) -> None:
        head = column.shape[1:]
        if agents:
            value = [as_numpy(value[agent]) for agent in agents]
        array = np.asarray(as_numpy(value))
        if array.shape != head and array.size == column[self._row].size:
            array = array.reshape(head)  # ManiSkill's (1,) for one sub-environment, say.
        if array.shape != head:
            raise ValueError(
                f"{what} of env {self.env.env_id!r} has shape {array.shape}, expected {head}"
            )
        column[self._row] = array


def _bare_stepper(
    bare: BareStep,
    bare_reset: BareReset | None,
    read_action: Callable[[], Any],
    write_observation: Callable[[Any], None],
    write_info: Callable[[dict[str, Any]], int],
    beside: Callable[[Rest], Rest],
    slab: Slab,
    row: int,
) -> tuple[Callable[[], None], Callable[[], Rest | None], Callable[[], Rest | None]]:
    """The hot path of plain Gymnasium envs: (forget the episode, step, reset).

    Closures over memoryviews: assigning an element of one costs a fifth of assigning an
    element of an array.
    """
    rewards, terminations = _view(slab.reward), _view(slab.terminated)
    truncations, marks = _view(slab.truncated), _view(slab.info_mark)
    done_times, busy_times = _view(slab.done_ns), _view(slab.busy_ns)
    clock = time.monotonic_ns
    episode_return = 0.0
    episode_length = 0
    over = False

    def forget() -> None:
        nonlocal episode_return, episode_length, over
        episode_return, episode_length, over = 0.0, 0, False

    def step() -> Rest | None:
        nonlocal episode_return, episode_length, over
        began = clock()
        observation, reward, terminated, truncated, info = bare(read_action())
        done = clock()
        done_times[row] = done
        busy_times[row] = done - began
        write_observation(observation)
        rewards[row] = reward
        terminations[row] = terminated
        truncations[row] = truncated
        episode_return += reward
        episode_length += 1
        if terminated or truncated:
            slab.episode_return[row] = episode_return
            # What comes after an end belongs to no episode; see `EpisodeSums`.
            slab.episode_length[row] = 0 if over else episode_length
            over = True
        marks[row] = mark = write_info(info) if info else NO_INFO
        return beside({"info": info}) if mark == PICKLED else None

    def reset() -> Rest | None:
        assert bare_reset is not None
        began = clock()
        observation, info = bare_reset(seed=slab.take_seed(row), options=None)
        done = clock()
        forget()
        done_times[row] = done
        busy_times[row] = done - began
        write_observation(observation)
        rewards[row] = 0.0
        terminations[row] = truncations[row] = False
        marks[row] = mark = write_info(info) if info else NO_INFO
        return beside({"info": info}) if mark == PICKLED else None

    return forget, step, reset


def _step_beginner(
    halves: tuple[BareStepAsync, BareStepWait],
    read_action: Callable[[], Any],
    store: Callable[[BareResult, int], Rest | None],
) -> Callable[[], Callable[[], Rest | None]]:
    """A function that starts a step and returns what ends it.

    Its time is that of the two halves: in between, the trainer's own goes by.
    """
    start, wait = halves
    clock = time.monotonic_ns

    def begin() -> Callable[[], Rest | None]:
        began = clock()
        start(read_action())
        spent = clock() - began

        def end() -> Rest | None:
            began = clock()
            result = wait()
            return store(result, spent + clock() - began)

        return end

    return begin


def _view(array: NDArray[Any]) -> memoryview[Any]:
    # NumPy's types know that arrays are buffers from Python 3.12 on.
    return memoryview(array)  # pyright: ignore[reportArgumentType]


def _target(env: BaseEnv, target: str) -> Any:
    inner = env.env
    if target == "outer" or inner is None:
        return env if inner is None else inner
    if target == "unwrapped":
        return getattr(inner, "unwrapped", inner)
    raise ValueError(f"target must be 'unwrapped' or 'outer', not {target!r}")


def get_attr(env: BaseEnv, name: str, target: str = "unwrapped") -> Any:
    """Attribute `name` of the simulator itself, or of its outermost wrapper."""
    return getattr(_target(env, target), name)


def set_attr(env: BaseEnv, name: str, value: Any, target: str = "unwrapped") -> None:
    """Set attribute `name` of the simulator itself, or of its outermost wrapper."""
    setattr(_target(env, target), name, value)
