"""`EnvRunner`: executes requests on one env and puts the results into its row.

The same code runs in a worker process and, for inline placement, in the trainer. A step of a plain
Gymnasium env takes a short way (`RowWriter.short_stepper`).
"""

from __future__ import annotations

import contextlib
import logging
import pickle
import random
import time
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np

from rlightning_aio._core.hosts.messages import (
    STEP_IN_ROW,
    Attached,
    EnvStarted,
    EnvState,
    NewSchema,
    OutOfBand,
)
from rlightning_aio._core.hosts.running.renewal import HandedOn
from rlightning_aio._core.hosts.running.row_writer import RowWriter
from rlightning_aio.envs.base import initialised
from rlightning_aio.envs.fast_path import fast_path_of
from rlightning_aio.envs.hardware import HELD, begin_stops, checked_input_of, stop, stop_all
from rlightning_aio.envs.results import (
    has_preprocess_fn,
    input_of,
    is_async_first,
    one_result,
    reads_extras,
    step_of,
)
from rlightning_aio.envs.state import load_generators, save_generators, versions_of
from rlightning_aio.errors import ResetNeeded
from rlightning_aio.protocol.columns import row_reader
from rlightning_aio.protocol.entries import RENEW, Operation, answers_with_value
from rlightning_aio.protocol.error_text import ErrorText
from rlightning_aio.protocol.info import InfoSchemas
from rlightning_aio.protocol.pickling import dumped
from rlightning_aio.protocol.slab import RowLayout, Slab
from rlightning_aio.trees import copied

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

    from rlightning_aio._core.hosts.messages import AttachOrder, Completion
    from rlightning_aio._core.hosts.running.renewal import Renewal
    from rlightning_aio._core.hosts.running.row_writer import Execute, ShownResult
    from rlightning_aio.envs.base import BaseEnv
    from rlightning_aio.protocol.info import InfoSchema
    from rlightning_aio.types import EnvMeta

_log = logging.getLogger("rlightning_aio")


def loaded(arguments: Any) -> Any:
    """Return the arguments of a request, which may be pickled."""
    return pickle.loads(arguments) if type(arguments) is bytes else arguments


def seed_generators() -> None:
    """Seed the global generators of NumPy and Python from the system.

    For processes that only run envs; in the trainer they belong to the program.
    """
    words = np.random.SeedSequence().generate_state(8)
    np.random.seed(words)  # noqa: NPY002
    random.seed(words.tobytes())


Finish: TypeAlias = "Callable[[Any, int], Any]"
"""Finishes a request: takes what the env has returned and the ns that it took; returns the part of
the result that is out of band, or for a call its value."""


class EnvRunner:
    """One env and its row.

    Args:
        env: built, not yet initialised.
        inline: results stay in this process. Observations that hold torch tensors are then
            returned without a copy; all other tensors become NumPy arrays on the CPU.
        rebuild: makes the env again; None: that is left to its host, or it moves something real.
        renews: an exception of its reset or step has it rebuilt.
        is_hardware: it moves something real, stops whatever goes wrong, and before it is closed,
            and makes no step before its first reset.

    Attributes:
        inline: it lives in the trainer's process.
        fast_path: what the env offers to save time.
        is_hardware: see above.
        step: steps with the action in the row.
        is_awaitable: its requests are awaited, together with those of other envs.
        renewal: of its worker; None unless the entry is recycled.
        is_spent: another env takes its place before the next request.
        has_closed: it was closed, or is being closed.
    """

    is_awaitable: ClassVar[bool] = False

    def __init__(
        self,
        env: BaseEnv,
        *,
        inline: bool = False,
        rebuild: Callable[[], BaseEnv] | None = None,
        renews: bool = False,
        is_hardware: bool = False,
    ) -> None:
        self.inline = inline
        self.is_hardware = is_hardware
        self._rebuild, self._renews = rebuild, renews
        # It is to be rebuilt, such as after an exception; it was closed for that.
        self.is_spent = self.has_closed = False
        self.step: Execute = self._not_attached
        self._read_action: Callable[[], Any] = _no_action
        self._has_result = False
        self.renewal: Renewal | None = None
        # The next reset may be one that it has handed on, and that nobody else can execute.
        self._has_handed_on = False
        self._attach_again: Callable[[], None]
        self._adopt(env)

    def _adopt(self, env: BaseEnv) -> None:
        """Use a new env from now on; it has no row yet."""
        self.env = env
        self.meta: EnvMeta = initialised(env)
        self.fast_path = fast_path_of(env)
        bare = self.fast_path.bare_step()
        self._step_env: Callable[[Any], Any] = bare or (
            env.step if self.is_awaitable else step_of(env)
        )
        self._is_bare = bare is not None
        self._bare_reset = self.fast_path.bare_reset() if self._is_bare else None
        self._input = self._checked_input() if self.is_hardware else input_of(env)
        free = env.transforms_actions or has_preprocess_fn(env)
        self._actions_beside_row = free or self.layout.action_leaves is None

    def _checked_input(self) -> Callable[[Any, dict[str, Any]], Any]:
        """Return `checked_input_of` the env, which makes no step before its first reset."""
        make = checked_input_of(self.env)

        def checked(action: Any, extras: dict[str, Any]) -> Any:
            if not self._has_result:
                raise ResetNeeded(
                    f"{self.env.env_id}: it moves something real, and makes no step before its "
                    "first reset()"
                )
            return make(action, extras)

        return checked

    def started(self) -> EnvStarted:
        """Return the description of the env that the trainer gets."""
        return EnvStarted(
            self.meta,
            self.layout,
            reads_extras(self.env),
            self._actions_beside_row,
            self.is_awaitable,
        )

    @property
    def layout(self) -> RowLayout:
        """The row that this env needs."""
        # The results of bare steps are handed over if the env doesn't use their arrays again.
        hands_over = self.inline and self._is_bare and self.fast_path.fresh_results
        return RowLayout.of(self.meta, observations_out_of_band=hands_over)

    def attach(self, slab: Slab, row: int, announce: Callable[[InfoSchema], int]) -> None:
        """Write all results into `row` of `slab` from now on."""
        self._slab, self._row, self._announce = slab, row, announce
        self._attach_again = partial(self.attach, slab, row, announce)
        self._writer = RowWriter(
            slab,
            row,
            env_id=self.env.env_id,
            autoreset=self.meta.autoreset,
            announce=announce,
            stays_here=self.inline,
        )
        self._has_result = False
        if slab.action is not None:
            self._read_action = row_reader(slab.action, row)
        self.step = self._stepper()

    def execute(self, op: int, arguments: Any) -> Any:
        """Execute a request.

        Args:
            op: the operation.
            arguments: as of `base.Host.submit`, or pickled; None if they are in the row.

        Returns the part of the result that is out of band; for a call, its value.
        """
        if arguments is None and op == Operation.STEP:
            return self.step()
        call, finish = self.request(op, arguments)
        began = time.monotonic_ns()
        returned = call()
        return finish(returned, time.monotonic_ns() - began)

    def request(self, op: int, arguments: Any) -> tuple[Callable[[], Any], Finish]:
        """Return the call that a request makes, and a function that finishes the request.

        The call may run code of the env and, if the env is awaitable, return an awaitable. The
        other function gets what the call has returned at last and the ns that it took, and returns
        what `execute` does. The arguments are those of `execute`.
        """
        arguments = loaded(arguments)
        if self.is_spent and self._rebuild is not None:
            self._renew()
        if op == Operation.STEP:
            action, extras = arguments or STEP_IN_ROW
            return partial(self._step_with, action, extras), self._store_step
        if op == Operation.RESET:
            return self._reset_request(arguments)
        if op == Operation.SNAPSHOT:
            return self._snapshot, _outcome
        if op == Operation.RESTORE:
            return partial(self._restore, *arguments), self._finish_restore
        if arguments[0] == RENEW:
            return self._spend, _outcome
        return partial(_call, self.env, *arguments), _outcome

    def _spend(self) -> None:
        self.is_spent = not self.is_hardware

    def _snapshot(self) -> EnvState:
        versions = versions_of(self.env)
        if not self._has_result:
            return EnvState(versions, None)
        state = self.env.save_state(), self._writer.shown_result()
        return EnvState(versions, dumped(state, "its state"))

    def _restore(self, versions: dict[str, str], state: bytes) -> ShownResult:
        """Go back to a state that `_snapshot` saved; return the last result at that time.

        Raises:
            ValueError: it was saved with other versions of libraries.
        """
        here = versions_of(self.env)
        for name, version in versions.items():
            # An env may load a library only in its first reset.
            if here.get(name, version) != version:
                raise ValueError(
                    f"its state was saved with version {version} of {name}, and here it is "
                    f"{here[name]}"
                )
        saved, shown_result = pickle.loads(state)
        try:
            self.env.load_state(saved)
        except ValueError:
            if self._has_result or self.is_awaitable:
                raise
            self.env.reset()  # It may create parts of the state.
            self.env.load_state(saved)
        return shown_result

    def _finish_restore(self, shown_result: ShownResult, busy_ns: int) -> OutOfBand | None:
        """Show a result again."""
        del busy_ns
        out_of_band = self._writer.write_shown(shown_result)
        self._note_reset()
        return out_of_band

    def note_error(self, op: int, error: ErrorText) -> None:
        """Record what a request has raised; hardware stops, unless a method call raised it."""
        if self.is_hardware and not answers_with_value(op):
            stop(self.env)
        self.is_spent |= self._renews and error.ends_env(op)

    def _renew(self) -> None:
        """Close the env, which has raised, and make another in its place.

        Raises what that raises; the next request tries again.
        """
        assert self._rebuild is not None
        try:
            self.close()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # It may be in any state.
            text = "env %r, as it was closed to be rebuilt: %s"
            _log.warning(text, self.env.env_id, ErrorText.of(error).summary)
        key = self.layout.key
        self._adopt(self._rebuild())
        self.has_closed = False
        if self.layout.key != key:
            raise ValueError("its spaces changed with the restart")
        self._attach_again()
        self.is_spent = False

    def close(self) -> Awaitable[None] | None:
        """Close the env, once."""
        if self.has_closed:
            return None
        self.has_closed = True
        HELD.discard(self.env)
        return self.env.close()

    def _not_attached(self) -> OutOfBand | None:
        raise RuntimeError("this env has no row yet")

    # -- steps --------------------------------------------------------------------

    def _stepper(self) -> Execute:
        """Return a function that steps with the action in the row."""
        step_env, store, clock = self._step_env, self._store_step, time.monotonic_ns
        read_action, make = self._read_action, self._input
        is_action = self._is_bare and not (self.is_hardware or has_preprocess_fn(self.env))
        get_input = read_action if is_action else lambda: make(read_action(), {})
        if self._is_bare:
            store = self._writer.write_step
            short = self._writer.short_stepper(step_env, get_input)
            if short is not None:
                return short

        def step() -> OutOfBand | None:
            began = clock()
            return store(step_env(get_input()), clock() - began)

        return step

    def _step_with(self, action: Any, extras: dict[str, Any]) -> Any:
        """Step with an action that didn't come through the row, or with extras."""
        if not self._actions_beside_row:
            action = self._read_action()
        return self._step_env(self._input(action, extras))

    def _store_step(self, returned: Any, busy_ns: int) -> OutOfBand | None:
        """Write what a step has returned."""
        if self._is_bare:
            return self._writer.write_step(returned, busy_ns)
        method = "collect_async" if is_async_first(self.env) else "step"
        return self._write(method, returned, busy_ns)

    # -- resets -------------------------------------------------------------------

    def _reset_request(self, arguments: Any) -> tuple[Callable[[], Any], Finish]:
        """Start a new episode."""
        if self.renewal is not None:
            arguments = self._renewed(arguments, self.renewal)
        seed, options = self._seed_and_options(arguments)
        bare = self._bare_reset if options is None else None
        finish = partial(self._finish_reset, is_bare=bare is not None)
        return partial(bare or self.env.reset, seed=seed, options=options), finish

    def _renewed(self, arguments: Any, renewal: Renewal) -> tuple[Any, Any]:
        """Return seed and options of a reset that this worker executes.

        Raises:
            HandedOn: the next one does.
        """
        if arguments and len(arguments) > 2:  # Of a worker before, or handed on in vain.
            *chosen, generators = arguments
            if not self._has_handed_on:
                self._take_over(generators)
        else:
            chosen = arguments or self._seed_and_options(None)
            begins = "reset_mask" not in (chosen[1] or {})  # Else some parts go on.
            is_due = renewal.is_due() if begins else None
            if is_due is not None:
                self._has_handed_on = True
                given = dumped((*chosen, self._generators()), "its reset")
                raise HandedOn(given, is_due=is_due, resident_mb=renewal.resident_mb())
        self._has_handed_on = False
        renewal.begin()
        return chosen[0], chosen[1]

    def _generators(self) -> bytes | str:
        """Return the state of the env's generators, or why it can't be read."""
        try:
            return pickle.dumps(save_generators(self.env))
        except Exception as error:  # It may hold anything.
            return f"{type(error).__name__}: {error}"

    def _take_over(self, generators: bytes | str) -> None:
        """Go on with the random numbers of the env before."""
        try:
            if isinstance(generators, str):
                raise ValueError(generators)
            load_generators(self.env, pickle.loads(generators))
        except Exception as error:
            text = "env %r begins with fresh generators in its new worker (recycle): %s"
            _log.warning(text, self.env.env_id, error)

    def _seed_and_options(self, arguments: Any) -> tuple[int | None, dict[str, Any] | None]:
        """Return what to reset the env with: a copy, as the env may change it, and it may be
        needed again.
        """
        if not arguments:
            return self._slab.take_seed(self._row), None
        seed, options = arguments
        return seed, copied(options)

    def _finish_reset(self, returned: Any, busy_ns: int, *, is_bare: bool) -> OutOfBand | None:
        if is_bare:
            observation, info = returned
            result = observation, 0.0, False, False, info
            out_of_band = self._writer.write_reset(result, busy_ns)
        else:
            out_of_band = self._write("reset", returned, busy_ns)
        self._note_reset()
        return out_of_band

    def _write(self, method: str, returned: Any, busy_ns: int) -> OutOfBand | None:
        """Write what `method` of the env has returned."""
        result = one_result(self.env, method, returned)
        ends = result.last_reward, result.last_terminated, result.last_truncated
        parts = result.observation, *ends, result.info
        write = self._writer.write_reset if method == "reset" else self._writer.write_step
        return write(parts, busy_ns, result._extra)  # pyright: ignore[reportPrivateUsage]

    def _note_reset(self) -> None:
        """Record that the row holds a result that no transition has led to."""
        self._has_result = True
        self._slab.take_seed(self._row)  # Perhaps there still is one, of a reset that was aborted.
        if self._writer.holds_tensor:  # They stay here, so the writer is needed from now on.
            self.step = self._stepper()


def _no_action() -> None:
    """Return the action of an env whose actions don't travel in its row."""


def _outcome(returned: Any, busy_ns: int) -> Any:
    """Finish a request that is answered by a value."""
    del busy_ns
    return returned


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
        post: gets completions: new schemas of infos.
    """
    schemas = InfoSchemas(lambda number, schema: post(NewSchema(host_id, number, schema)))
    for runner, slab, row in placed_runners:
        runner.attach(slab, row, schemas.announce)


def attach_all(
    runners: Sequence[EnvRunner],
    order: AttachOrder,
    map_part: Callable[[int, int], memoryview],
    host_id: int,
    post: Callable[[Completion], None],
) -> None:
    """Give the envs of a host their rows, and post that.

    Args:
        runners: of the host's envs.
        order: of the group.
        map_part: maps a part of the arena, given its offset and size.
        host_id: of the host.
        post: gets completions, as of `give_rows`, and `Attached`.
    """
    give_rows(placed(runners, order, map_part), host_id, post)
    post(Attached(host_id))


def close_all(
    runners: list[EnvRunner], begin: Callable[[int], None] | None = None
) -> list[tuple[int, ErrorText]]:
    """Close the envs of a host, hardware after it was stopped, and empty the list.

    Args:
        runners: of the host's envs.
        begin: called with the index of each env before it is closed.

    Returns what closing raised, with the env's index.
    """
    stop_all([runner.env for runner in runners if runner.is_hardware])
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
    """Bring the envs of a host to a safe state, because the trainer is gone.

    Of hardware, one line says so, which explains at the robot why it stands still.
    """
    hardware = [runner.env for runner in runners if runner.is_hardware]
    stop_all(hardware)
    for env in hardware:
        _log.warning("env %r was stopped, as the trainer has ended", env.env_id)
    for runner in runners:
        with contextlib.suppress(Exception):
            runner.env.on_disconnect()


def stop_one(runners: Sequence[EnvRunner], index: int) -> None:
    """Begin to stop one of the envs of a host in this process, if it is built."""
    for runner in runners[index : index + 1]:
        begin_stops([runner.env])


# -- methods and attributes of an env, by name -------------------------------------


def _call(env: BaseEnv, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    """Call a method of the env, or else of the outermost wrapper that has it.

    Raises:
        AttributeError: none of them has it.
    """
    if name == "get_attr":
        return _get_attr(env, *args, **kwargs)
    if name == "set_attr":
        return _set_attr(env, *args, **kwargs)
    return getattr(_layer_with(env, name, f"{name}()"), name)(*args, **kwargs)


def _layer_with(env: BaseEnv, name: str, words: str) -> Any:
    for layer in _layers(env):
        if hasattr(layer, name):
            return layer
    raise AttributeError(
        f"neither env {env.env_id!r} nor its simulator, nor a wrapper around that, has {words}"
    )


def _layers(env: BaseEnv) -> Iterator[Any]:
    """The env, its simulator's wrappers from the outermost in, and the simulator itself."""
    seen: set[int] = set()
    layer: Any = env
    while layer is not None and id(layer) not in seen:
        yield layer
        seen.add(id(layer))
        layer = getattr(layer, "env", None)
    yield _simulator(env)


def _simulator(env: BaseEnv) -> Any:
    return env if env.env is None else getattr(env.env, "unwrapped", env.env)


def _get_attr(env: BaseEnv, name: str) -> Any:
    return getattr(_layer_with(env, name, name), name)


def _set_attr(env: BaseEnv, name: str, value: Any) -> None:
    owner = next((layer for layer in _layers(env) if hasattr(layer, name)), _simulator(env))
    setattr(owner, name, value)
