"""`AwaitedEnvs`: executes requests on awaitable envs, all at once, on one event loop.

The trainer's loop host and a worker with awaitable envs are both thin layers over it. Each request
is a task in its env's context. A request that takes longer than its limit is cancelled; the env
is then closed, rebuilt and reset, and that result answers the request, marked as a restart.
Invariant: each request ends in one completion, or `done` is called for it, whatever its env does.
Left out: how requests and completions travel.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections import deque
from contextvars import Context, copy_context
from copy import copy
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio.errors import EnvHung, WorkerDied
from rlightning_aio.hosts.awaited_runner import Abandoned, AwaitedRunner
from rlightning_aio.hosts.build_env import built_env
from rlightning_aio.hosts.event_loop import (
    OWNER,
    TimeLimit,
    cancel,
    cancel_leftovers,
    log,
    new_task,
    place_of,
    tasks_of,
    time_collector,
    watched,
)
from rlightning_aio.hosts.messages import ErrorText, Failed, NotBuilt, Raised, Result, Value
from rlightning_aio.hosts.restart_pause import restart_pause
from rlightning_aio.hosts.runner import disconnect_all
from rlightning_aio.protocol.entries import Operation, answers_with_value, op_of, slot_of

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    from rlightning_aio.hosts.messages import Completion, EnvStarted, StartOrder

__all__ = ["AwaitedEnvs"]

_CANCEL_SECONDS: Final = 0.4
"""How long a task may go on after it was cancelled."""
_CLOSE_SECONDS: Final = 0.6
"""How long an env may take to close. A group waits longer than both together for its hosts."""
_TURN_SECONDS: Final = 0.02
"""How long envs are built before other tasks of the loop get a turn."""


class _Env:
    """An env of the host, which may be replaced, and the request that it is executing.

    Attributes:
        index: of the env in its host.
        context: in which its code runs.
        task: executes the request; None while there is none.
        answering: the coroutine that the task awaits.
        entry: of the request; 0 while there is none.
        closing: the task that closes the env, once it has begun.
        losses: how often the env was replaced since it last completed a step.
        fault: why the env was given up, if it was.
    """

    def __init__(self, index: int, runner: AwaitedRunner | None = None) -> None:
        self.index = index
        self.context = copy_context()
        self.context.run(OWNER.set, self)
        self.runner: Any = runner
        self.task: asyncio.Task[Any] | None = None
        self.answering: Coroutine[Any, Any, Any] | None = None
        self.entry = 0
        self.closing: asyncio.Task[None] | None = None
        self.losses = 0
        self.fault: WorkerDied | None = None

    @property
    def name(self) -> str:
        """The env's id, for messages."""
        return self.runner.env.env_id

    def close(self) -> asyncio.Task[None]:
        """Begin to close the env, unless that has begun."""
        if self.closing is None:
            loop = asyncio.get_running_loop()
            self.closing = new_task(_close(self.runner), loop, self.context)
        return self.closing


class AwaitedEnvs:
    """See the module.

    Args:
        host_id, first_slot: of the host.
        order: what to build.
        inline: see `EnvRunner`.
        post: gets every completion.
        done: gets the entries of requests whose results are all in their rows.
        enter: gets an entry whenever the code of its env is about to run; None: nobody needs it.

    Attributes:
        num_busy: how many envs execute a request now.
    """

    def __init__(
        self,
        host_id: int,
        first_slot: int,
        order: StartOrder,
        *,
        inline: bool,
        post: Callable[[Completion], object],
        done: Callable[[int], object],
        enter: Callable[[int], object] | None = None,
    ) -> None:
        self._host_id = host_id
        self._first_slot = first_slot
        self._order = order
        self._inline = inline
        self._post = post
        self._done = done
        self._enter = enter
        self._loop: asyncio.AbstractEventLoop
        time_collector()
        self._all: list[_Env] = []
        self._queue: deque[tuple[_Env, int, Any]] = deque()
        self.num_busy = 0
        self._most_busy = order.config.max_concurrency or len(order.worker_indices)
        self._ending = False
        config = order.config
        limits = {Operation.STEP: config.step_timeout, Operation.RESET: config.reset_timeout}
        self._limits = {
            int(op): TimeLimit(seconds, self._expire)
            for op, seconds in limits.items()
            if seconds is not None
        }
        # Tasks that replace envs, and tasks that go on although they were cancelled.
        self._replacing: set[asyncio.Task[None]] = set()
        self._stray: set[asyncio.Task[Any]] = set()

    @property
    def runners(self) -> list[AwaitedRunner]:
        """The envs' runners, by index."""
        return [env.runner for env in self._all]

    # -- life ---------------------------------------------------------------------

    def adopt(self, runners: Iterable[AwaitedRunner]) -> None:
        """Take over envs that were built elsewhere, by index; they belong to the running loop."""
        self._loop = asyncio.get_running_loop()
        self._all = [_Env(index, runner) for index, runner in enumerate(runners)]

    async def build(self) -> list[EnvStarted] | None:
        """Build the envs, a few milliseconds at a time; None if one can't be, which is posted."""
        self._loop = asyncio.get_running_loop()
        count = len(self._order.worker_indices)
        turn_ends = 0.0
        try:
            for index in range(count):
                if time.monotonic() >= turn_ends:
                    await asyncio.sleep(0)
                    turn_ends = time.monotonic() + _TURN_SECONDS
                env = _Env(index)
                env.runner = self._built(env)
                self._all.append(env)
            return [runner.started() for runner in self.runners]
        except BaseException as error:
            text, index = ErrorText.of(error), min(len(self._all), count - 1)
            self._post(NotBuilt(self._host_id, index, text))
            if isinstance(error, KeyboardInterrupt):
                raise
            return None

    def _built(self, env: _Env) -> AwaitedRunner:
        runner = env.context.run(built_env, self._order, env.index, inline=self._inline)
        assert isinstance(runner, AwaitedRunner)
        return runner

    async def close(self) -> list[tuple[int, ErrorText]]:
        """Cancel all requests and close all envs at the same time.

        Returns what was wrong, with the env's index.
        """
        self._end()
        stubborn = await cancel(self._tasks(), _CANCEL_SECONDS)
        closing = [env.close() for env in self._all]
        if closing:
            await asyncio.wait(closing, timeout=_CLOSE_SECONDS)
        errors = [
            (env.index, error)
            for env, task in zip(self._all, closing, strict=True)
            if (error := _close_error(task, is_stubborn=env.task in stubborn)) is not None
        ]
        await cancel([task for task in closing if not task.done()], _CANCEL_SECONDS / 4)
        await cancel_leftovers({env: env.name for env in self._all}, _CANCEL_SECONDS / 4)
        return errors

    def disconnect(self) -> None:
        """Bring the envs to a safe state: the trainer is gone."""
        disconnect_all(self.runners)

    def release(self) -> None:
        """Cancel everything without waiting, also tasks that envs have started. Idempotent."""
        self._end()
        if self._all and not self._loop.is_closed():
            for task in self._tasks() | tasks_of(set(self._all), self._loop).keys():
                task.cancel()
        self._all.clear()

    def _end(self) -> None:
        """Begin nothing more, and post nothing more."""
        self._ending = True
        self._queue.clear()
        for limit in self._limits.values():
            limit.end()

    def _tasks(self) -> set[asyncio.Task[Any]]:
        running = {env.task for env in self._all if env.task is not None}
        return running | self._replacing | self._stray

    # -- requests -----------------------------------------------------------------

    def submit(self, entry: int, arguments: Any) -> None:
        """Execute a request; queue it while as many envs are busy as may be at once.

        Args:
            entry: of the request.
            arguments: as of `AwaitedRunner.answer`.
        """
        if self._ending:
            return
        env = self._all[slot_of(entry) - self._first_slot]
        self._queue.append((env, entry, arguments))
        self._begin_queued()

    def _begin_queued(self) -> None:
        while self._queue and self.num_busy < self._most_busy:
            env, entry, arguments = self._queue.popleft()
            if env.fault is not None:
                # Not at once: a completion never comes before its request was handed over.
                fault = Failed(self._host_id, entry, copy(env.fault))
                self._loop.call_soon(self._post_unless_ending, fault)
                continue
            self.num_busy += 1
            env.entry = entry
            op = op_of(entry)
            execution = self._execute(env, env.runner, entry, op, arguments)
            env.task = new_task(execution, self._loop, env.context)
            if op in self._limits:
                self._limits[op].begin(env, self._loop)

    def _post_unless_ending(self, completion: Completion) -> None:
        if not self._ending:
            self._post(completion)

    async def _execute(
        self, env: _Env, runner: AwaitedRunner, entry: int, op: int, arguments: Any
    ) -> None:
        env.answering = answering = runner.answer(op, arguments)
        try:
            outcome = await watched(answering, self._report, self._enter, entry)
        except BaseException as error:
            if isinstance(error, Abandoned) or self._is_past(env, runner):
                return
            # A CancelledError, too, is the env's own.
            self._ended(env, runner, Raised(self._host_id, entry, ErrorText.of(error)))
            # In the trainer it may be the user's Ctrl-C; a worker gets none.
            if self._inline and isinstance(error, KeyboardInterrupt):
                raise
            return
        if op == Operation.STEP:
            env.losses = 0
        if answers_with_value(op):
            self._ended(env, runner, Value(self._host_id, entry, outcome))
        elif outcome is None:
            self._ended(env, runner, entry)
        else:
            self._ended(env, runner, Result(self._host_id, entry, outcome))

    def _report(self, entry: int, seconds: float) -> None:
        """Report an env that has held the event loop for long."""
        env = self._all[slot_of(entry) - self._first_slot]
        log.warning(
            "env %r of entry %r blocked the event loop for %.0f ms in a %s; nothing else ran "
            "meanwhile: await what it waits for, or run it by asyncio.to_thread()",
            env.name,
            self._order.config.name,
            1e3 * seconds,
            Operation(op_of(entry)).name.lower(),
        )

    def _is_past(self, env: _Env, runner: AwaitedRunner) -> bool:
        """Return True if nobody waits for the end of the request any more."""
        return self._ending or runner.is_abandoned or runner is not env.runner

    def _ended(self, env: _Env, runner: AwaitedRunner, what: Completion | int) -> None:
        """The request of an env has ended: post `what`, or call `done` for this entry."""
        if self._is_past(env, runner):
            return
        env.task = env.answering = None
        env.entry = 0
        self.num_busy -= 1
        if isinstance(what, int):
            self._done(what)
        else:
            self._post(what)
        self._begin_queued()

    # -- envs that take too long --------------------------------------------------

    def _expire(self, env: _Env, seconds: float) -> None:
        if self._ending:
            return
        # At once: what still comes of the request is too late from now on.
        env.runner.is_abandoned = True
        doing = Operation(op_of(env.entry)).name.lower()
        place = place_of(env.answering)
        what = f"env {env.name!r} took longer than {seconds} s for a {doing} and was cancelled"
        message = f"{what} while it waited in {place}" if place else what
        # In no env's context, or the end of that env would cancel it: the timer may have been set
        # when a request of another env ended.
        task = new_task(self._replace(env, message, doing), self._loop, Context())
        self._replacing.add(task)
        task.add_done_callback(self._replacing.discard)

    async def _replace(self, env: _Env, message: str, doing: str) -> None:
        """Replace an env that took too long, and answer its request by a reset of the new one."""
        entry, kind = env.entry, EnvHung
        seed = env.runner.reset_with if op_of(entry) == Operation.RESET else (None, None)
        await self._put_away(env)
        while not self._is_given_up(env, kind, message):
            await asyncio.sleep(restart_pause(env.losses))
            try:
                runner = self._built(env)
                runner.place_like(env.runner)
            except BaseException as error:
                kind, message = WorkerDied, f"env {env.name!r} could not be rebuilt: {error!r}"
                continue
            env.runner, env.closing = runner, None
            answer = runner.answer(Operation.RESET, seed)
            env.task = new_task(answer, self._loop, env.context)
            limit = self._limits.get(Operation.RESET)
            if not await _ends(env.task, None if limit is None else limit.seconds):
                kind, message = EnvHung, f"env {env.name!r} took too long for the reset after that"
                await self._put_away(env)
                continue
            cause = f"hung in a {doing} and was cancelled"
            self._ended(env, runner, _first_result(self._host_id, entry, env.task, cause))
            return
        assert env.fault is not None
        env.runner.is_abandoned = False  # Only to be heard once more.
        self._ended(env, env.runner, Failed(self._host_id, entry, env.fault))

    async def _put_away(self, env: _Env) -> None:
        """Cancel what an env is doing, and close it."""
        env.runner.is_abandoned = True
        assert env.task is not None
        for stray in await cancel({env.task}, _CANCEL_SECONDS):
            self._stray.add(stray)
            stray.add_done_callback(self._stray.discard)
            log.warning("env %r goes on although it was cancelled; it is replaced", env.name)
        closing = env.close()
        await asyncio.wait({closing}, timeout=_CLOSE_SECONDS)
        error = _close_error(closing, is_stubborn=False)
        if error is not None:
            log.warning("env %r, in close() before it is rebuilt: %s", env.name, error.summary)
        await cancel({closing}, _CANCEL_SECONDS)
        await cancel_leftovers({env: env.name}, _CANCEL_SECONDS, but=self._stray)

    def _is_given_up(self, env: _Env, kind: type[WorkerDied], message: str) -> bool:
        """Count a loss of an env; give the env up if that was one too many."""
        env.losses += 1
        config = self._order.config
        if config.on_worker_death == "raise":
            outcome = "on_worker_death is 'raise', so it is not rebuilt"
        elif env.losses > config.max_restarts:
            outcome = f"it is not rebuilt after {env.losses - 1} restarts in a row (max_restarts)"
        else:
            count = f"restart {env.losses} of {config.max_restarts} in a row"
            log.warning("%s; %s, in %g s", message, count, restart_pause(env.losses))
            return False
        env.fault = kind(f"{message}; {outcome}", env_id=env.name, exit_code=None, stderr_tail="")
        env.fault.env_ids = (env.name,)
        return True


async def _close(runner: AwaitedRunner) -> None:
    closing: Any = runner.close()
    if inspect.isawaitable(closing):
        await closing


def _close_error(task: asyncio.Task[None], *, is_stubborn: bool) -> ErrorText | None:
    """The error of an env that should have closed by now; None if it has closed properly."""
    if not task.done():
        text = f"close() took longer than {_CLOSE_SECONDS} s and was cancelled"
        return ErrorText("TimeoutError", text, text)
    error = asyncio.CancelledError() if task.cancelled() else task.exception()
    if error is not None:
        return ErrorText.of(error)
    text = "its step or reset goes on although it was cancelled"
    return ErrorText("TimeoutError", text, text) if is_stubborn else None


async def _ends(task: asyncio.Task[Any], seconds: float | None) -> bool:
    """Wait for a task; False if it takes longer than that."""
    return not (await asyncio.wait({task}, timeout=seconds))[1]


def _first_result(host_id: int, entry: int, task: asyncio.Task[Any], cause: str) -> Result | Raised:
    """The completion for the reset of an env that was rebuilt."""
    error = asyncio.CancelledError() if task.cancelled() else task.exception()
    if error is None:
        return Result(host_id, entry, task.result() or {}, restarted=cause)
    text = ErrorText.of(error)
    message = f"{text.text} (in the reset after its env {cause})"
    return Raised(host_id, entry, ErrorText(text.type_name, message, text.traceback))
