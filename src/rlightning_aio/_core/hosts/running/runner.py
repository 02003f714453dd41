"""`EnvRunner`: executes requests on one env and puts the results into its row.

The same code runs in a worker process and, for inline placement, in the trainer. A step of a plain
Gymnasium env takes a short way (`RowWriter.short_stepper`).
"""

from __future__ import annotations

import contextlib
import pickle
import random
import time
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from rlightning_aio._core.hosts.messages import (
    NO_ACTION,
    RECORD_VIDEO,
    Attached,
    EnvStarted,
    ErrorText,
    NewSchema,
    OutOfBand,
    Saved,
)
from rlightning_aio._core.hosts.running.checkpoint import Checkpoints, Saver
from rlightning_aio._core.hosts.running.env_calls import call_env
from rlightning_aio._core.hosts.running.env_steps import followed, step_in_halves
from rlightning_aio._core.hosts.running.row_writer import RowWriter
from rlightning_aio.envs.results import (
    has_preprocess_fn,
    input_of,
    is_async_first,
    one_result,
    reads_extras,
    step_of,
)
from rlightning_aio.envs.state import versions_of
from rlightning_aio.protocol.columns import leaves, row_reader
from rlightning_aio.protocol.entries import Operation
from rlightning_aio.protocol.info import InfoSchemas
from rlightning_aio.protocol.slab import RowLayout, Slab

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

    from rlightning_aio._core.hosts.filming.camera import Camera
    from rlightning_aio._core.hosts.messages import AttachOrder, Completion
    from rlightning_aio._core.hosts.running.checkpoint import Send
    from rlightning_aio._core.hosts.running.env_steps import Execute, GetInput, StepWith
    from rlightning_aio.config import VideoConfig
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet

__all__ = [
    "EnvRunner",
    "attach_all",
    "close_all",
    "disconnect_all",
    "give_rows",
    "loaded",
    "placed",
    "resume_all",
    "seed_generators",
]


def loaded(arguments: Any) -> Any:
    """Return the arguments of a request, which may be pickled."""
    return pickle.loads(arguments) if type(arguments) is bytes else arguments


def seed_generators(*entropy: int) -> None:
    """Seed the global generators of NumPy and Python, from the system if no numbers are given.

    For processes that only run envs; in the trainer they belong to the program.
    """
    words = np.random.SeedSequence(entropy or None).generate_state(8)
    np.random.seed(words)  # noqa: NPY002
    random.seed(words.tobytes())


class EnvRunner:
    """One env and its row.

    Args:
        env: built, not yet initialised.
        inline: results stay in this process. Results that hold torch tensors are then returned
            without a copy; elsewhere tensors become NumPy arrays on the CPU.
        video: what to film from the first episode on; None films nothing.

    Attributes:
        restarts: how many workers had this env before.
        step: steps with the action in the row.
        begin_step: starts a step that the simulator computes by itself, and returns a function
            that ends it. None if the env has no such step.
        is_awaitable: its requests are awaited, together with those of other envs.

    Raises what `recording.Camera` raises.
    """

    is_awaitable: ClassVar[bool] = False

    def __init__(
        self, env: BaseEnv, *, inline: bool = False, video: VideoConfig | None = None
    ) -> None:
        self.env = env
        self.meta: EnvMeta = env.initialised()
        self.restarts = 0
        self._inline = inline
        self.step: Execute = self._not_attached
        self.begin_step: Callable[[], Execute] | None = None
        self._step_with: StepWith
        self._reset_env: Execute = self._not_attached
        self._input = input_of(env)
        self._bare_reset = None if env.bare_step() is None else env.bare_reset()
        self._checkpoints: Checkpoints
        self._saver: Saver | None = None
        self._camera = None if video is None else _camera(env, video)

    def started(self) -> EnvStarted:
        """Return the description of the env that the trainer gets."""
        any_action = self.env.transforms_actions or has_preprocess_fn(self.env)
        return EnvStarted(
            self.meta, self.layout, reads_extras(self.env), any_action, self.is_awaitable
        )

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
        # The results of bare steps are handed over if the env doesn't use their arrays again.
        hands_over = self._inline and self.env.fresh_results and self.env.bare_step() is not None
        return RowLayout(
            meta.observation_space,
            meta.action_space,
            (*agents, *sub_envs),
            meta.agents,
            observations_out_of_band=hands_over and leaves(meta.observation_space) is not None,
        )

    def attach(
        self,
        slab: Slab,
        row: int,
        announce: Callable[[InfoSchema], int],
        send_checkpoint: Send | None = None,
    ) -> None:
        """Write all results into `row` of `slab` from now on."""
        layout = self.layout
        num_envs = self.env.config.num_envs
        self._slab, self._row, self._announce = slab, row, announce
        self._writer = RowWriter(
            slab,
            row,
            env_id=self.env.env_id,
            autoreset=self.meta.autoreset,
            announce=announce,
            partial_of=num_envs if num_envs > self.meta.num_envs else 0,
            stays_here=self._inline,
        )
        self._checkpoints = Checkpoints(self.env, slab, row, self._writer)
        self._read_action: Callable[[], Any] | None = None
        if slab.action is not None:
            self._read_action = row_reader(layout.action_space, slab.action, row)
        self._send_checkpoint = send_checkpoint
        self._bind()
        if self._camera is not None:
            self._start_filming(self._camera)

    def _bind(self) -> None:
        """Choose the functions that execute requests."""
        self._reset_env = self._reset_from_row
        self.step = self._step_with = self._stepper()
        every = self.env.config.snapshot_every
        if every is not None and self._send_checkpoint is not None:
            over = self._slab.over[self._row, ...]
            self._saver = saver = Saver(self._checkpoints, over, every, self._send_checkpoint)
            self.step = saver.wrap(Operation.STEP, self.step)
            self._reset_env = saver.wrap(Operation.RESET, self._reset_env)
            # A step in halves would bypass the saver.
            self.begin_step = None

    def execute(self, op: int, arguments: Any) -> Any:
        """Execute a request.

        Args:
            op: the operation.
            arguments: as of `base.Host.submit`, or pickled; None if they are in the row.

        Returns the part of the result that is out of band; for a call, its value.
        """
        if arguments is None:
            return self.step() if op == Operation.STEP else self.reset_from_row()
        arguments = loaded(arguments)
        if op == Operation.CALL:
            if arguments[0] == RECORD_VIDEO:
                return self._record_video(*arguments[1])
            return call_env(self.env, *arguments)
        if op == Operation.SNAPSHOT:
            return versions_of(self.env), self._checkpoints.has_result, self._checkpoints.take()
        if op == Operation.RESTORE:
            return self._restore(*arguments)
        execute = partial(self._reset if op == Operation.RESET else self._step, *arguments)
        outcome = execute() if self._saver is None else self._saver.wrap(op, execute)()
        if self._camera is not None:
            self._camera.see()
        return outcome

    def _restore(self, checkpoint: bytes, show: bool) -> None:
        self._checkpoints.load(checkpoint, show=show)
        if self._saver is not None:
            # Where nothing is to be shown, it goes back to where the trainer knows it to be.
            self._saver.save(before=not show)

    def resume(self, checkpoint: bytes) -> None:
        """Continue where the env of a replaced worker was."""
        self._checkpoints.resume(checkpoint)

    def close(self) -> Awaitable[None] | None:
        """Close the env, and the film of an episode that is under way."""
        try:
            if self._camera is not None:
                self._camera.close()
        finally:
            closing = self.env.close()
        return closing

    def _not_attached(self) -> OutOfBand | None:
        raise RuntimeError("this env has no row yet")

    # -- films --------------------------------------------------------------------

    def _record_video(self, video: VideoConfig | None) -> None:
        """Film episodes from the next one on, or stop filming; the current film ends here."""
        camera = None if video is None else _camera(self.env, video)
        former, self._camera = self._camera, camera
        if former is not None:
            self.step, self._reset_env, self.begin_step = self._unfilmed
        if camera is not None:
            self._start_filming(camera)
        if former is not None:
            former.close()

    def _start_filming(self, camera: Camera) -> None:
        """Have the camera see each result."""
        camera.watch(self._slab, self._row, self.meta.autoreset, self.meta.max_episode_steps)
        self._film(camera)

    def _film(self, camera: Camera) -> None:
        self._unfilmed = self.step, self._reset_env, self.begin_step
        self.step = followed(self.step, camera.see)
        self._reset_env = followed(self._reset_env, camera.see)
        # A step in halves would bypass the camera.
        self.begin_step = None

    # -- steps --------------------------------------------------------------------

    def _stepper(self) -> StepWith:
        bare, get_input = self.env.bare_step(), self._input_getter()
        if bare is None:
            return self._plain_stepper(get_input)
        store, clock = self._writer.write_step, time.monotonic_ns
        halves = self.env.bare_step_async()
        if halves is None:
            short = self._writer.short_stepper(bare, get_input)
            if short is not None:
                return short
        else:
            self.begin_step = step_in_halves(*halves, get_input, store)

        def step(get_input: GetInput = get_input) -> OutOfBand | None:
            began = clock()
            return store(bare(get_input()), clock() - began)

        return step

    def _input_getter(self) -> GetInput:
        """Return a function that returns the env's input, made of the action in the row."""
        read_action, make = self._read_action, self._input
        if read_action is None:
            return lambda: make(None, {})
        if self.env.bare_step() is not None and not has_preprocess_fn(self.env):
            return read_action
        return lambda: make(read_action(), {})

    def _plain_stepper(self, get_input: GetInput) -> StepWith:
        """Return the stepper of an env that makes its own `EnvRet`."""
        env, clock = self.env, time.monotonic_ns
        step_env, method = step_of(env), "step"

        def store(returned: Any, busy_ns: int) -> OutOfBand | None:
            return self._write(one_result(env, method, returned), busy_ns, stepped=True)

        if is_async_first(env):
            method = "collect_async"
            self.begin_step = step_in_halves(env.step_async, env.collect_async, get_input, store)

        def step(get_input: GetInput = get_input) -> OutOfBand | None:
            began = clock()
            return store(step_env(get_input()), clock() - began)

        return step

    def _step(self, action: Any, extras: dict[str, Any]) -> OutOfBand | None:
        """Step with an action that didn't come through the row, or with extras."""
        if action is NO_ACTION:
            action = self._action_in_row()
        return self._step_with(partial(self._input, action, extras))

    def _action_in_row(self) -> Any:
        """Return a copy of the action in the row."""
        if self._read_action is None:
            raise RuntimeError("actions of this env don't travel in its row")
        return self._read_action()

    # -- resets -------------------------------------------------------------------

    def reset_from_row(self) -> OutOfBand | None:
        """Start a new episode with the seed in the row, or show the restored result there."""
        return self._show() if self._checkpoints.must_show() else self._reset_env()

    def _show(self) -> OutOfBand | None:
        """Return the restored result; frames that follow aren't of the episode being filmed."""
        if self._camera is not None:
            self._camera.close()
        out_of_band = self._checkpoints.show()
        self._note_reset()
        return out_of_band

    def _reset_from_row(self) -> OutOfBand | None:
        return self._reset(self._slab.take_seed(self._row), None)

    def _seed_generators(self, seed: int | None) -> None:
        """Seed the global generators for an episode that begins with a seed.

        An episode that is repeated after a death gets other numbers: an env that crashes by chance
        would crash at the same step again.
        """
        if seed is not None and not self._inline:
            seed_generators(seed, self.restarts)

    def _reset(self, seed: int | None, options: dict[str, Any] | None) -> OutOfBand | None:
        """Start a new episode."""
        self._checkpoints.forget_result()
        self._seed_generators(seed)
        bare = self._bare_reset if options is None else None
        began = time.monotonic_ns()
        if bare is not None:
            observation, info = bare(seed=seed, options=None)
            busy_ns = time.monotonic_ns() - began
            result = observation, 0.0, False, False, info
            out_of_band = self._writer.write_reset(result, busy_ns)
        else:
            returned = self.env.reset(seed=seed, options=options)
            busy_ns = time.monotonic_ns() - began
            whole = one_result(self.env, "reset", returned)
            out_of_band = self._write(whole, busy_ns, stepped=False)
        self._note_reset()
        return out_of_band

    def _write(
        self, result: EnvRet | MultiAgentEnvRet, busy_ns: int, *, stepped: bool
    ) -> OutOfBand | None:
        ends = result.last_reward, result.last_terminated, result.last_truncated
        parts = result.observation, *ends, result.info
        write = self._writer.write_step if stepped else self._writer.write_reset
        return write(parts, busy_ns, result._extra, result)  # pyright: ignore[reportPrivateUsage]

    def _note_reset(self) -> None:
        """Record that the row holds the first result of an episode."""
        self._checkpoints.note_result()
        if self._writer.is_bypassed and self._writer.whole is not None:
            # The results hold tensors that stay here, so the writer is needed from now on.
            self._writer.is_bypassed = False
            self._bind()
            if self._camera is not None:
                self._film(self._camera)


_Placed = TypeVar("_Placed", "EnvRunner", "EnvStarted")


def placed(
    runners: Sequence[_Placed],
    order: AttachOrder,
    map_part: Callable[[int, int], memoryview],
) -> Iterator[tuple[_Placed, Slab, int]]:
    """Each env of a host with its slab and row.

    Args:
        runners: of the host's envs, or their descriptions if the envs are elsewhere.
        order: of the group.
        map_part: maps a part of the arena, given its offset and size.
    """
    slabs: dict[int, Slab] = {}
    for runner, (slab_index, row) in zip(runners, order.rows, strict=True):
        if slab_index not in slabs:
            (offset, rows), layout = order.slabs[slab_index], runner.layout
            slabs[slab_index] = Slab(layout, map_part(offset, layout.size(rows)), rows)
        yield runner, slabs[slab_index], row


def give_rows(
    placed_runners: Iterable[tuple[EnvRunner, Slab, int]],
    host_id: int,
    post: Callable[[Completion], None],
) -> None:
    """Give each env of a host the row for its results.

    Args:
        placed_runners: the host's envs, by index, each with its slab and row.
        host_id: of the host.
        post: gets completions: new schemas of infos, and checkpoints.
    """

    def save(index: int, checkpoint: bytes, before: bool) -> None:
        post(Saved(host_id, index, checkpoint, before))

    schemas = InfoSchemas(lambda number, schema: post(NewSchema(host_id, number, schema)))
    for index, (runner, slab, row) in enumerate(placed_runners):
        runner.attach(slab, row, schemas.announce, partial(save, index))


def attach_all(
    runners: Sequence[EnvRunner],
    order: AttachOrder,
    map_part: Callable[[int, int], memoryview],
    host_id: int,
    post: Callable[[Completion], None],
) -> None:
    """Give the envs of a host their rows, restore those that have a checkpoint, and post that.

    Args:
        runners: of the host's envs.
        order: of the group.
        map_part: maps a part of the arena, given its offset and size.
        host_id: of the host.
        post: gets completions, as of `give_rows`, and `Attached`.
    """
    give_rows(placed(runners, order, map_part), host_id, post)
    resume_all(runners, order)
    post(Attached(host_id))


def resume_all(runners: Sequence[EnvRunner], order: AttachOrder) -> None:
    """Seed a replacement, and restore its envs that have a checkpoint."""
    if order.seed is not None:
        # Not the numbers of an episode that begins with that seed.
        seed_generators(order.seed, order.restarts, 1)
    for runner in runners:
        runner.restarts = order.restarts
    for runner, checkpoint in zip(runners, order.checkpoints, strict=False):
        if checkpoint is not None:
            runner.resume(checkpoint)


def close_all(
    runners: list[EnvRunner], begin: Callable[[int], None] | None = None
) -> list[tuple[int, ErrorText]]:
    """Close the envs of a host, and empty the list.

    Args:
        runners: of the host's envs.
        begin: called with the index of each env before it is closed.

    Returns what closing raised, with the env's index.
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


def disconnect_all(runners: Sequence[EnvRunner]) -> None:
    """Bring the envs of a host to a safe state, because the trainer is gone."""
    for runner in runners:
        with contextlib.suppress(Exception):
            runner.env.on_disconnect()


def _camera(env: BaseEnv, video: VideoConfig) -> Camera:
    # Not at the top: few workers need it.
    from rlightning_aio._core.hosts.filming.camera import Camera  # noqa: PLC0415

    return Camera(env, video)
