"""`EnvRunner`: executes requests on one env and puts the results into its row.

The same code runs in a worker process and, for inline placement, in the trainer. A step
whose env is exactly Gymnasium's goes a short way of its own (`_short_steps`).
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

from rlightning_aio.envs.results import (
    has_preprocess_fn,
    input_of,
    is_async_first,
    one_result,
    reads_extras,
    step_of,
)
from rlightning_aio.envs.state import versions_of
from rlightning_aio.envs.tensors import as_numpy, holds_tensor
from rlightning_aio.hosts.messages import NO_ACTION, RECORD_VIDEO, EnvStarted, ErrorText, OutOfBand
from rlightning_aio.hosts.row_writer import RowWriter
from rlightning_aio.hosts.shown import packed_standing, show, shown_in, standing_of
from rlightning_aio.protocol.columns import leaves, row_reader
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.info import NO_INFO, PICKLED, InfoSchema
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.config import VideoConfig
    from rlightning_aio.envs.base import BareReset, BareResult, BareStep, BaseEnv
    from rlightning_aio.hosts.messages import AttachOrder
    from rlightning_aio.hosts.recording import Camera
    from rlightning_aio.hosts.shown import Shown
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet

__all__ = [
    "EnvRunner",
    "Execute",
    "attach_all",
    "close_all",
    "placed",
    "resume_all",
]

Execute: TypeAlias = "Callable[[], OutOfBand | None]"
"""Executes a step or a reset; returns what of its result is out of band."""
Keep: TypeAlias = "Callable[[bytes, bool], None]"
"""Takes a standing, and whether it is from before the request that is being executed."""
_Take: TypeAlias = "Callable[[], Any]"
"""Gives what one step is taken with."""


class _StepTaking(Protocol):
    """Steps with what `take` gives; without it, with the action that lies in the row."""

    def __call__(self, take: _Take = ...) -> OutOfBand | None: ...


class EnvRunner:
    """One env and its row.

    Args:
        env: built, not yet initialised.
        inline: results stay in this process. Those that hold torch tensors are handed over
            whole and untouched then; elsewhere tensors become NumPy arrays on the CPU.
        video: what is filmed from the first episode on; None: nothing.

    Attributes:
        step: with the action that lies in the row.
        begin_step: starts a step whose simulator computes by itself, and returns what ends
            it; None if it has none. `step` is both in one.
        reset_from_row: with the seed that lies in the row.

    Raises what `recording.Camera` raises.
    """

    def __init__(
        self, env: BaseEnv, *, inline: bool = False, video: VideoConfig | None = None
    ) -> None:
        self.env = env
        self.meta: EnvMeta = env.initialised()
        self._inline = inline
        self.step: Execute = self._not_attached
        self._step_taking: _StepTaking
        self._input = input_of(env)
        self.begin_step: Callable[[], Execute] | None = None
        self.reset_from_row: Execute = self._not_attached
        self._own_reset: Execute = self._not_attached
        self._keep: Keep = _nobody_keeps
        # It has a result; what it is to show of what was put back.
        self._began = False
        self._restored: Shown | None = None
        self._whole: Any = None
        self._camera = None if video is None else _camera(env, video)

    def started(self) -> EnvStarted:
        """What a trainer is told of the env."""
        any_action = self.env.transforms_actions or has_preprocess_fn(self.env)
        return EnvStarted(self.meta, self.layout, reads_extras(self.env), any_action)

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
            observations_out_of_band=self._hands_over
            and leaves(meta.observation_space) is not None,
        )

    @property
    def _hands_over(self) -> bool:
        """Whether the results of bare steps may be kept by the one that gets them."""
        return self._inline and self.env.fresh_results and self.env.bare_step() is not None

    def attach(self, slab: Slab, row: int, announce: Callable[[InfoSchema], int]) -> None:
        """Take `row` of `slab` for all further results."""
        layout = self.layout
        num_envs = self.env.config.num_envs
        self._slab, self._row = slab, row
        self._writer = RowWriter(
            slab,
            row,
            env_id=self.env.env_id,
            autoreset=self.meta.autoreset,
            announce=announce,
            # Results may come from some of the sub-environments at a time.
            turns=num_envs if num_envs > self.meta.num_envs else 0,
            copies=self._inline,
        )
        self._read_action: Callable[[], Any] | None = None
        if slab.action is not None:
            self._read_action = row_reader(layout.action_space, slab.action, row)
        # Where there is a short way, it and the writer tell each other what they have written.
        self._before_writing: Callable[[], None] = _nothing
        self._after_writing: Callable[[], None] = _nothing
        self.reset_from_row = self._first_reset
        self._bind(layout)
        if self._camera is not None:
            self._roll(self._camera)

    def _bind(self, layout: RowLayout) -> None:
        """Make what executes requests."""
        self._own_reset = self._reset_from_row
        self.step = self._step_taking = self._stepper(layout)

    def execute(self, op: int, arguments: Any) -> Any:
        """Execute a request whose arguments came out of band.

        Returns what of the result is out of band; of a call, its value.
        """
        if op == Operation.CALL:
            return self._call(*arguments)
        if op == Operation.SNAPSHOT:
            return versions_of(self.env), self._began, self.standing()
        if op == Operation.RESTORE:
            return self._restore(*arguments)
        execute = self._reset if op == Operation.RESET else self._step_with
        outcome = execute(*arguments)
        if self._camera is not None:
            self._camera.see()
        return outcome

    def close(self) -> None:
        """Close the env, and the film of an episode that is under way."""
        try:
            if self._camera is not None:
                self._camera.close()
        finally:
            self.env.close()

    # -- films --------------------------------------------------------------------

    def _record_video(self, video: VideoConfig | None) -> None:
        """Film episodes from the next one on, or no more; a film under way ends here."""
        camera = None if video is None else _camera(self.env, video)
        former, self._camera = self._camera, camera
        if former is not None:
            self.step, self._own_reset, self.begin_step = self._unfilmed
        if camera is not None:
            self._roll(camera)
        if self._began and self._restored is None:
            self.reset_from_row = self._own_reset
        if former is not None:
            former.close()

    def _roll(self, camera: Camera) -> None:
        """Have the camera see each result. Nothing of it is in the way of others."""
        camera.watch(self._slab, self._row, self.meta.autoreset, self.meta.max_episode_steps)
        self._unfilmed = self.step, self._own_reset, self.begin_step
        self.step = _seen(self.step, camera.see)
        self._own_reset = _seen(self._own_reset, camera.see)
        # Its halves would not come by here.
        self.begin_step = None

    # -- standings ----------------------------------------------------------------

    def standing(self) -> bytes:
        """The env's state, and what it shows."""
        if self._writer.shows_some:
            raise NotImplementedError(
                f"env {self.env.env_id!r} gives results of some sub-environments at a time; there "
                "is no moment at which all of them are idle"
            )
        shown = self._restored
        if shown is None and self._began:
            shown = shown_in(self._slab, self._row, self._writer, self._whole)
        return packed_standing(self.env.save_state(), shown)

    def _restore(self, standing: bytes, shows: bool) -> None:
        """Put the env where it stood; if it `shows` that, by the next reset `AS_RESTORED`."""
        state, shown = standing_of(standing)
        self.env.load_state(state)
        if shows and shown is not None:
            self._began, self._restored = True, shown
            self.reset_from_row = self._show_restored

    def resume(self, standing: bytes) -> None:
        """Stand where the env of a worker that was replaced stood."""
        try:
            self._restore(standing, True)
        except ValueError:
            # Some parts of it may come with its first reset alone.
            self.env.reset()
            self._restore(standing, True)

    def _show_restored(self) -> OutOfBand | None:
        shown, self._restored = self._restored, None
        self.reset_from_row = self._own_reset
        if shown is None or not self._slab.take_as_restored(self._row):
            return self._own_reset()
        self._whole = shown.whole
        out_of_band = show(shown, self._slab, self._row, self._writer, time.monotonic_ns())
        self._after_writing()
        return out_of_band

    def keep_with(self, keep: Keep) -> None:
        """Have the env's standings given to `keep`, if it gives any away by itself."""
        self._keep = keep

    def _call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Call a method of the env, or of what it wraps, from the outside in."""
        if name == "get_attr":
            return _get_attr(self.env, *args, **kwargs)
        if name == "set_attr":
            return _set_attr(self.env, *args, **kwargs)
        if name == RECORD_VIDEO:
            return self._record_video(*args)
        for owner in _layers(self.env):
            if hasattr(owner, name):
                return getattr(owner, name)(*args, **kwargs)
        raise AttributeError(
            f"neither env {self.env.env_id!r} nor its simulator, nor a wrapper around that, has "
            f"{name}()"
        )

    def _not_attached(self) -> OutOfBand | None:
        raise RuntimeError("this env has no row yet")

    # -- steps --------------------------------------------------------------------

    def _stepper(self, layout: RowLayout) -> _StepTaking:
        bare, take = self.env.bare_step(), self._taker()
        if bare is None:
            return self._plain_stepper(take)
        halves = self.env.bare_step_async()
        single = not layout.head and self.meta.autoreset in ("disabled", "same_step")
        if single and halves is None and self._writer.write_observation is not None:
            return self._short_stepper(bare, take, self._writer.write_observation)
        store, clock = self._bare_store(layout), time.monotonic_ns
        if halves is not None:
            self.begin_step = _step_beginner(*halves, take, store)

        def step(take: _Take = take) -> OutOfBand | None:
            began = clock()
            return store(bare(take()), clock() - began)

        return step

    def _taker(self) -> _Take:
        """Gives what the env is stepped with where the action lies in the row."""
        read_action, make = self._read_action, self._input
        if read_action is None:
            return lambda: make(None, {})
        if self.env.bare_step() is not None and not has_preprocess_fn(self.env):
            return read_action
        return lambda: make(read_action(), {})

    def _plain_stepper(self, take: _Take) -> _StepTaking:
        """For an env that gives results of its own making."""
        env, clock = self.env, time.monotonic_ns
        step_env, method = step_of(env), "step"

        def store(returned: Any, busy_ns: int) -> OutOfBand | None:
            return self._store(one_result(env, method, returned), busy_ns, stepped=True)

        if is_async_first(env):
            method = "collect_async"
            self.begin_step = _step_beginner(env.step_async, env.collect_async, take, store)

        def step(take: _Take = take) -> OutOfBand | None:
            began = clock()
            return store(step_env(take()), clock() - began)

        return step

    def _short_stepper(
        self, bare: BareStep, take: _Take, write_observation: Callable[[Any], None]
    ) -> _StepTaking:
        bare_reset = self.env.bare_reset()
        self._before_writing = self._writer.look
        step, reset, self._after_writing = _short_steps(
            bare,
            bare_reset,
            take,
            write_observation,
            self._writer,
            self._slab,
            self._row,
            resets_itself=self.meta.autoreset == "same_step",
        )
        if bare_reset is not None:
            self._own_reset = reset
        return step

    def _bare_store(self, layout: RowLayout) -> Callable[[BareResult, int], OutOfBand | None]:
        """A function that puts a bare result, which took so many ns, into the row."""
        writer, slab, row, clock = self._writer, self._slab, self._row, time.monotonic_ns
        done_times, busy_times = _view(slab.done_ns), _view(slab.busy_ns)
        # Not copied: `fresh_results` says that they are nobody else's.
        store_data = writer.handed_over if layout.observations_out_of_band else writer.write_data

        def store(result: BareResult, busy_ns: int) -> OutOfBand | None:
            observation, reward, terminated, truncated, info = result
            done_times[row] = clock()
            busy_times[row] = busy_ns
            writer.write_ends(reward, terminated, truncated, info)
            return store_data(observation, info)

        return store

    def _step_with(self, action: Any, extras: dict[str, Any]) -> OutOfBand | None:
        """Step with an action that didn't come through the row, or with extras."""
        if type(action) is str and action == NO_ACTION:
            action = self._action_in_row()
        return self._step_taking(partial(self._input, action, extras))

    def _action_in_row(self) -> Any:
        """A copy of the action that the row holds."""
        if self._read_action is None:
            raise RuntimeError("actions of this env don't travel in its row")
        return self._read_action()

    # -- resets -------------------------------------------------------------------

    def _first_reset(self) -> OutOfBand | None:
        outcome = self._own_reset()
        self._began, self.reset_from_row = True, self._own_reset
        return outcome

    def _reset(self, seed: int | None, options: dict[str, Any] | None) -> OutOfBand | None:
        """Start a new episode."""
        self._restored = None
        began = time.monotonic_ns()
        returned = self.env.reset(seed=seed, options=options)
        busy_ns = time.monotonic_ns() - began
        self._began = True
        return self._store(one_result(self.env, "reset", returned), busy_ns, stepped=False)

    def _reset_from_row(self) -> OutOfBand | None:
        """Start a new episode with the seed that the row holds."""
        return self._reset(self._slab.take_seed(self._row), None)

    def _store(
        self, result: EnvRet | MultiAgentEnvRet, busy_ns: int, *, stepped: bool
    ) -> OutOfBand | None:
        writer = self._writer
        writer.write_times(time.monotonic_ns(), busy_ns)
        self._before_writing()
        if stepped:
            ends = writer.checked_ends(
                result.last_reward, result.last_terminated, result.last_truncated
            )
            writer.write_ends(*ends, result.info)
        else:
            writer.begin_episode(result.info)
        self._after_writing()
        observation = result.observation
        self._whole = None
        if holds_tensor(observation):
            if self._inline:
                self._whole = result
                return {"ret": result}
            observation = as_numpy(observation)
        return writer.write_data(observation, result.info, result._extra)  # pyright: ignore[reportPrivateUsage]


_Placed = TypeVar("_Placed", "EnvRunner", "EnvStarted")


def placed(
    runners: Sequence[_Placed],
    order: AttachOrder,
    map_part: Callable[[int, int], memoryview],
) -> Iterator[tuple[_Placed, Slab, int]]:
    """Each env of a host with the slab and the row that it is given.

    Args:
        runners: of the host's envs, or what is known of these where they live elsewhere.
        order: of the group.
        map_part: maps a part of the arena, given its offset and size.
    """
    slabs: dict[int, Slab] = {}
    for runner, (slab_index, row) in zip(runners, order.rows, strict=True):
        if slab_index not in slabs:
            (offset, rows), layout = order.slabs[slab_index], runner.layout
            slabs[slab_index] = Slab(layout, map_part(offset, layout.size(rows)), rows)
        yield runner, slabs[slab_index], row


def attach_all(
    runners: Sequence[EnvRunner],
    order: AttachOrder,
    map_part: Callable[[int, int], memoryview],
    announce: Callable[[InfoSchema], int],
    keep: Callable[[int, bytes, bool], None],
) -> None:
    """Give each env of a host the row for its results, and have it stand where it is to.

    Args:
        runners: of the host's envs.
        order: of the group.
        map_part: maps a part of the arena, given its offset and size.
        announce: tells the trainer of a new way in which infos lie in rows.
        keep: tells the trainer of a standing: the env's index, and as of `messages.Saved`.
    """
    for index, (runner, slab, row) in enumerate(placed(runners, order, map_part)):
        runner.attach(slab, row, announce)
        runner.keep_with(partial(keep, index))
    resume_all(runners, order.standings)


def resume_all(runners: Sequence[EnvRunner], standings: Sequence[bytes | None]) -> None:
    """Have the envs of a replacement stand where they were kept, as far as they were."""
    for runner, standing in zip(runners, standings, strict=False):
        if standing is not None:
            runner.resume(standing)


def close_all(
    runners: list[EnvRunner], begin: Callable[[int], None] | None = None
) -> list[tuple[int, ErrorText]]:
    """Close the envs of a host, and forget them.

    Args:
        runners: emptied.
        begin: is told the index of each env before it is closed.

    Returns what closing has raised, with the env's index.
    """
    errors: list[tuple[int, ErrorText]] = []
    for index, runner in enumerate(runners):
        if begin is not None:
            begin(index)
        try:
            runner.close()
        except BaseException as error:
            errors.append((index, ErrorText.of(error)))
    runners.clear()
    return errors


def _seen(execute: Execute, see: Callable[[], None]) -> Execute:
    """`execute`, whose result is then seen."""

    def execute_and_see() -> OutOfBand | None:
        outcome = execute()
        see()
        return outcome

    return execute_and_see


def _camera(env: BaseEnv, video: VideoConfig) -> Camera:
    # Not at the top: few workers need it.
    from rlightning_aio.hosts.recording import Camera  # noqa: PLC0415

    return Camera(env, video)


def _nobody_keeps(standing: bytes, before: bool) -> None:
    del standing, before


def _nothing() -> None: ...


def _short_steps(  # noqa: PLR0915  # A call more would be felt in every step.
    bare: BareStep,
    bare_reset: BareReset | None,
    take: _Take,
    write_observation: Callable[[Any], None],
    writer: RowWriter,
    slab: Slab,
    row: int,
    *,
    resets_itself: bool,
) -> tuple[_StepTaking, Execute, Callable[[], None]]:
    """The hot path of plain Gymnasium envs: (step, reset, look at what others wrote to the row).

    It writes what `RowWriter` would. Closures over memoryviews: assigning an element of one
    costs a fifth of assigning an element of an array. Flags are written when they change.
    """
    write_info, kept = writer.write_info, writer.kept
    rewards, marks, resets, overs, terminations, truncations = map(
        _view,
        (slab.reward, slab.info_mark, slab.is_reset, slab.over, slab.terminated, slab.truncated),
    )
    returns, lengths = _view(slab.episode_return), _view(slab.episode_length)
    done_times, busy_times = _view(slab.done_ns), _view(slab.busy_ns)
    clock = time.monotonic_ns
    episode_return, episode_length = 0.0, 0
    # Whether the last result was a reset; whether it or one before it was an end.
    fresh = over = False

    def look() -> None:
        nonlocal episode_return, episode_length, fresh, over
        episode_return, episode_length = returns[row], lengths[row]
        fresh, over = resets[row], overs[row]

    def step(take: _Take = take) -> OutOfBand | None:
        nonlocal episode_return, episode_length, fresh, over
        began = clock()
        observation, reward, terminated, truncated, info = bare(take())
        done = clock()
        done_times[row] = done
        busy_times[row] = done - began
        write_observation(observation)
        try:
            rewards[row] = reward
        except TypeError:
            rewards[row] = reward = writer.number("reward", reward)
        if fresh:
            resets[row] = fresh = False
        if over and resets_itself:
            episode_return = episode_length = 0
        returns[row] = episode_return = episode_return + reward
        lengths[row] = episode_length = episode_length + 1
        if over or terminated or truncated:
            terminations[row] = terminated
            truncations[row] = truncated
            if over and not resets_itself:
                # What comes after an end belongs to no episode; see `EpisodeSums`.
                returns[row] = lengths[row] = 0
            overs[row] = over = terminated or truncated or not resets_itself
        marks[row] = mark = write_info(info) if info else NO_INFO
        return kept({"info": info}) if mark == PICKLED else None

    def reset() -> OutOfBand | None:
        nonlocal episode_return, episode_length, fresh, over
        assert bare_reset is not None
        began = clock()
        observation, info = bare_reset(seed=slab.take_seed(row), options=None)
        done = clock()
        episode_return, episode_length, fresh, over = 0.0, 0, True, False
        resets[row] = True
        terminations[row] = truncations[row] = overs[row] = False
        rewards[row] = returns[row] = 0.0
        lengths[row] = 0
        done_times[row] = done
        busy_times[row] = done - began
        write_observation(observation)
        marks[row] = mark = write_info(info) if info else NO_INFO
        return kept({"info": info}) if mark == PICKLED else None

    return step, reset, look


def _step_beginner(
    start: Callable[[Any], None],
    wait: Callable[[], Any],
    take: _Take,
    store: Callable[[Any, int], OutOfBand | None],
) -> Callable[[], Execute]:
    """A function that starts a step and returns what ends it.

    Its time is that of the two halves: in between, the trainer's own goes by.
    """
    clock = time.monotonic_ns

    def begin() -> Callable[[], OutOfBand | None]:
        began = clock()
        start(take())
        spent = clock() - began

        def end() -> OutOfBand | None:
            began = clock()
            result = wait()
            return store(result, spent + clock() - began)

        return end

    return begin


def _view(array: NDArray[Any]) -> memoryview[Any]:
    # NumPy's types know that arrays are buffers from Python 3.12 on.
    return memoryview(array)  # pyright: ignore[reportArgumentType]


def _layers(env: BaseEnv) -> Iterator[Any]:
    """The env, its simulator's wrappers from the outermost in, and the simulator itself."""
    seen: set[int] = set()
    layer: Any = env
    while layer is not None and id(layer) not in seen:
        yield layer
        seen.add(id(layer))
        layer = getattr(layer, "env", None)
    yield _target(env, "unwrapped")


def _target(env: BaseEnv, target: str) -> Any:
    inner = env.env
    if target == "outer" or inner is None:
        return env if inner is None else inner
    if target == "unwrapped":
        return getattr(inner, "unwrapped", inner)
    raise ValueError(f"target must be 'unwrapped' or 'outer', not {target!r}")


def _get_attr(env: BaseEnv, name: str, target: str = "unwrapped") -> Any:
    """Attribute `name` of the simulator itself, or of its outermost wrapper."""
    return getattr(_target(env, target), name)


def _set_attr(env: BaseEnv, name: str, value: Any, target: str = "unwrapped") -> None:
    """Set attribute `name` of the simulator itself, or of its outermost wrapper."""
    setattr(_target(env, target), name, value)
