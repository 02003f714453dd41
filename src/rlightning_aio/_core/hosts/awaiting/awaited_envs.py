"""`AwaitedEnvs`: executes requests on awaitable envs, all at once, on one event loop.

The trainer's loop host and a worker with awaitable envs are both thin layers over it; a worker has
an event loop of its own, which its channel wakes. Each env has a task of its own (`AwaitedEnv`). A
request that takes longer than its limit is cancelled; the env is then closed, and the group hears
that it is lost; the next request makes another. So it is if a step raises `EnvAway`: the env has
lost what it talks to.
Invariant: each request ends in one completion, or `done` is called for it, whatever its env does.
A worker says whose code runs, and that none does while all envs wait: if it dies, the trainer knows
which env is at fault. While envs have time limits, it also says every now and then that its loop is
alive: the trainer kills a worker whose loop an env blocks for longer than the limit.
Left out: how requests and completions travel.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from rlightning_aio._core.hosts import times
from rlightning_aio._core.hosts.awaiting.awaited_env import (
    AwaitedEnv,
    end_all,
    reraise,
)
from rlightning_aio._core.hosts.awaiting.event_loop import (
    awaited_calls,
    leave_behind,
    log,
    new_task,
    run_loop,
    watched,
)
from rlightning_aio._core.hosts.limits import hung, limits_of
from rlightning_aio._core.hosts.messages import Lost, NotBuilt, Raised
from rlightning_aio._core.hosts.running.build_env import built_env, check_distinct
from rlightning_aio._core.hosts.running.execution import completion_of
from rlightning_aio._core.hosts.running.runner import disconnect_all
from rlightning_aio.envs.hardware import begin_stops, stop_all
from rlightning_aio.errors import EnvAway
from rlightning_aio.outcomes import Loss
from rlightning_aio.protocol.entries import Operation, op_of, slot_of
from rlightning_aio.protocol.entries import entry as entry_of
from rlightning_aio.protocol.error_text import ErrorText

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Coroutine
    from contextvars import Context

    from rlightning_aio._core.hosts.messages import Completion, EnvStarted, StartOrder
    from rlightning_aio._core.hosts.running.awaited_runner import AwaitedRunner

_LINES, _EVERY = 3, 100
"""Turns that hold the event loop for long: the first ones are logged, then each of this number."""


class _EnvRecord:
    """An index of the host: the env that has it now, and the request to it. Envs may be replaced.

    Attributes:
        index: in the host.
        context: of all envs that come to have the index; each has a copy of it.
        env: that has it now; None while there is none.
        runner: of that env, or of the one before.
        entry: of the request that is being executed; 0 while there is none.
        arguments: of that request.
        due: when its time is up.
        answered: entry of the last request that was answered.
        is_ending: the env before has left by itself, and has not closed yet.
        lost: why the env before is gone, and the same as a message; None if there was none.
        leaving: the task that puts the env before away.
        rebuilding: the task that makes another env.
    """

    def __init__(self, index: int, context: Context) -> None:
        self.index = index
        self.context = context
        self.env: AwaitedEnv | None = None
        self.runner: Any = None
        self.entry = 0
        self.arguments: Any = None
        self.due = math.inf
        self.answered = 0
        self.is_ending = False
        self.lost: tuple[Loss, str] | None = None
        self.leaving: asyncio.Task[None] | None = None
        self.rebuilding: asyncio.Task[None] | None = None

    @property
    def name(self) -> str:
        """The env's id, for messages."""
        return self.runner.env.env_id


class AwaitedEnvs:
    """See the module.

    Args:
        host_id, first_slot: of the host.
        order: what to build.
        post: gets every completion.
        done: gets the entries of requests whose results are all in their rows.
        enter: gets an entry whenever the code of its env is about to run, and 0 after that; None:
            the envs are in the trainer's process.

    Attributes:
        num_busy: how many envs execute a request now.
        runners: of the envs, by index; that of one that is gone until another takes its place.
    """

    def __init__(
        self,
        host_id: int,
        first_slot: int,
        order: StartOrder,
        *,
        post: Callable[[Completion], object],
        done: Callable[[int], object],
        enter: Callable[[int], object] | None = None,
    ) -> None:
        self._host_id = host_id
        self._first_slot = first_slot
        self._order = order
        self._inline = enter is None
        self._post = post
        self._done = done
        self._enter = enter
        self._watch = partial(watched, report=self._report, enter=enter)
        self._loop: asyncio.AbstractEventLoop
        self.runners: list[AwaitedRunner] = []
        self._records: list[_EnvRecord] = []
        self._queue: deque[tuple[_EnvRecord, int, Any]] = deque()
        self.num_busy = self._num_held = 0
        self._queues = order.config.max_concurrency is not None
        self._most_busy = order.config.max_concurrency or len(order.worker_indices)
        self._ending = False
        config = order.config
        self._close_seconds = config.close_timeout or times.AWAITED_CLOSE
        self._limits = limits_of(config)
        self._pause = times.between_looks(self._limits.values())
        self._look: asyncio.TimerHandle | None = None
        # All envs whose tasks run, and the tasks that replace envs or put them away.
        self._envs: set[AwaitedEnv] = set()
        self._tasks: set[asyncio.Task[None]] = set()

    # -- life ---------------------------------------------------------------------

    def serve(
        self,
        runners: list[AwaitedRunner],
        channel: socket.socket,
        take_requests: Callable[[], bool],
    ) -> list[tuple[int, ErrorText]]:
        """Execute requests on an event loop until there are no more, and close the envs.

        Args:
            runners: of the envs, by index, built elsewhere; the list changes when one takes the
                place of another.
            channel: readable when there are requests.
            take_requests: submits them; False if there will be no more. If it raises, the trainer
                is gone: the envs come to a safe stop before they are closed.

        Returns what closing has raised, with the env's index.
        """
        return run_loop(self._serve(runners, channel, take_requests))

    async def _serve(
        self,
        runners: list[AwaitedRunner],
        channel: socket.socket,
        take_requests: Callable[[], bool],
    ) -> list[tuple[int, ErrorText]]:
        self._adopt(runners)
        loop = self._loop
        ended: asyncio.Future[None] = loop.create_future()

        def look() -> None:
            try:
                if take_requests() or ended.done():
                    return
            except BaseException as error:
                loop.remove_reader(channel)
                ended.set_exception(error)
            else:
                ended.set_result(None)

        loop.add_reader(channel, look)
        # uvloop has made it non-blocking; a reply that the socket can't hold waits for the trainer.
        channel.setblocking(True)
        look()
        try:
            await ended
        except BaseException:
            disconnect_all([record.runner for record in self._records if record.env is not None])
            await self.close()
            raise
        finally:
            loop.remove_reader(channel)
        return await self.close()

    def _adopt(self, runners: list[AwaitedRunner]) -> None:
        """Take over envs that were built elsewhere; they belong to the running loop."""
        self.runners = runners
        self._loop = asyncio.get_running_loop()
        context = copy_context()
        for index, runner in enumerate(runners):
            record = _EnvRecord(index, context)
            record.runner = runner
            record.env = self._new_env(record, lambda runner=runner: runner)
            self._records.append(record)
        if self._limits and self._enter is not None:
            self._beat(min(self._limits.values()) / 4, self._enter)

    def _beat(self, seconds: float, enter: Callable[[int], object]) -> None:
        """Say again and again that no env holds the loop now."""
        enter(0)
        self._loop.call_later(seconds, self._beat, seconds, enter)

    async def build(self) -> list[EnvStarted] | None:
        """Build the envs, one in each turn of the loop; None if one can't be, which is posted."""
        self._loop = asyncio.get_running_loop()
        context, simulations = copy_context(), dict[int, str]()
        index = 0
        try:
            for index in range(len(self._order.worker_indices)):
                record = _EnvRecord(index, context)
                if (error := await self._build(record)) is not None:
                    raise error
                self._records.append(record)
                check_distinct(record.runner.env, simulations)
            return [runner.started() for runner in self.runners]
        except BaseException as error:
            self._post(NotBuilt(self._host_id, index, ErrorText.of(error)))
            if isinstance(error, KeyboardInterrupt):
                raise
            return None

    def _new_env(self, record: _EnvRecord, make: Callable[[], AwaitedRunner]) -> AwaitedEnv:
        events = self._on_outcome, self._on_broken
        env = AwaitedEnv(record.index, make, record.context, self._watch, *events)
        self._envs.add(env)
        env.task.add_done_callback(lambda _: self._envs.discard(env))
        return env

    async def _build(self, record: _EnvRecord) -> BaseException | None:
        """Build an env; return the error if that fails."""
        order = self._order
        if record.runner is not None:
            order = replace(order, is_again=True)
        make: Any = partial(built_env, order, record.index, inline=self._inline)
        if self._enter is not None:
            entry = entry_of(0, self._first_slot + record.index, 0)
            make = partial(_entered, make, self._enter, entry)
        env = self._new_env(record, make)
        try:
            error = await asyncio.shield(env.made)
        except BaseException:  # Whatever is made next waits for its close.
            env.leave()
            record.leaving = self._spawn(self._close(env))
            raise
        if error is None:
            if record.runner is not None:
                env.runner.use_rows_of(record.runner)
            record.env, record.runner = env, env.runner
            self.runners[record.index : record.index + 1] = [env.runner]
        return error

    async def close(self) -> list[tuple[int, ErrorText]]:
        """Cancel all requests and close all envs at the same time.

        Returns what was wrong, with the env's index.
        """
        self._end()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=times.CANCEL)
        # Others that still run were closed, and reported, when they were put away.
        open_ = [env for env in self._envs if not env.has_closed]
        envs = sorted(open_, key=lambda env: env.index)
        try:
            await end_all(envs, self._close_seconds)
        except BaseException:
            # A close that is cancelled with everything else has ended, too, but not well.
            if left := [env.name for env in envs if env.close_error or not env.has_closed]:
                log.error("interrupted; these envs were not closed: %s", ", ".join(left))
            raise
        errors = [(env.index, error) for env in envs if (error := env.close_error) is not None]
        for env in self._envs:
            for task in env.tasks():
                leave_behind(task)
        return errors

    def release(self) -> None:
        """Cancel everything without waiting, but for stops of hardware. Idempotent."""
        self._end()
        moving = [one for one in self.runners if one.is_hardware and not one.has_closed]
        stop_all([runner.env for runner in moving])
        if self._envs and not self._loop.is_closed():
            for task in self._tasks.union(*(env.tasks() for env in self._envs)):
                task.cancel()
        for env in self._envs if self._envs and not self._loop.is_running() else ():
            leave_behind(env.task)  # The warning about the group says enough.
        self._records.clear()
        self.runners.clear()

    def _end(self) -> None:
        """Begin nothing more, and post nothing more."""
        self._ending = True
        self._queue.clear()
        if self._look is not None:
            self._look.cancel()

    # -- requests -----------------------------------------------------------------

    def submit(self, entry: int, arguments: Any) -> None:
        """Execute a request; queue it while as many envs are busy as may be at once.

        Args:
            entry: of the request.
            arguments: as of `AwaitedRunner.answer`.
        """
        if self._ending:
            return
        record = self._records[slot_of(entry) - self._first_slot]
        self._queue.append((record, entry, arguments))
        self._begin_queued()

    def _begin_queued(self) -> None:
        while self._queue and self.num_busy < self._most_busy:
            record, entry, arguments = self._queue.popleft()
            self.num_busy += 1
            record.entry, record.arguments = entry, arguments
            if self._queues:
                record.runner.note_begin()
            if record.env is not None:
                self._give(record, record.env)
            elif record.is_ending:
                continue  # Its end takes the request along.
            elif op_of(entry) == Operation.STEP and record.lost is not None:
                # Another env has no episode for it: it was sent before the trainer knew, or it is
                # hardware. The trainer may be sending more now, and would not hear of this.
                self._loop.call_soon(self._report_again, record, entry, *record.lost)
            else:
                record.rebuilding = self._spawn(self._rebuild(record))

    def _give(self, record: _EnvRecord, env: AwaitedEnv) -> None:
        """Have an env execute the request in its record."""
        env.give(record.entry, record.arguments)
        if (seconds := self._limits.get(op_of(record.entry))) is not None:
            record.due = time.monotonic() + seconds
            if self._look is None:
                self._plan_look()

    def _on_outcome(
        self, env: AwaitedEnv, entry: int, outcome: Any, error: BaseException | None
    ) -> None:
        record = self._records[env.index]
        if isinstance(error, EnvAway) and op_of(entry) == Operation.STEP:
            self._end_env(record, env)
            why = Loss(str(error), "env_away", "infrastructure", record.name)
            self._report_loss(record, why, f"env {record.name!r} {error}")
            return
        completion = completion_of(self._host_id, env.runner, entry, outcome, error)
        self._finish(record, completion, by=env)

    @staticmethod
    def _take_request(record: _EnvRecord) -> int:
        """Return the entry of the request of an env, which executes none from now on."""
        entry, record.entry, record.arguments = record.entry, 0, None
        record.due = math.inf
        return entry

    def _finish(
        self, record: _EnvRecord, completion: Completion | None, *, by: AwaitedEnv | None = None
    ) -> None:
        """Report that a request has ended, `by` what an env has done; put away one that is spent.

        None: its row holds the whole result.
        """
        if by is not None and record.env is by and by.runner.is_spent:
            self._end_env(record, by)
        if self._ending:
            return
        entry = record.answered = self._take_request(record)
        self.num_busy -= 1
        if completion is None:
            self._done(entry)
        else:
            self._post(completion)
        self._begin_queued()

    def _report(self, entry: int, seconds: float) -> None:
        """Report an env that has held the event loop for long: the first ones, and then few."""
        self._num_held += 1
        if self._num_held > _LINES and self._num_held % _EVERY:
            return
        log.warning(
            "env %r of entry %r blocked the event loop for %.0f ms in a %s; nothing else ran "
            "meanwhile: await what it waits for, or run it by asyncio.to_thread() (a large "
            "collection of Python's garbage collector is counted, too)%s",
            self._records[slot_of(entry) - self._first_slot].name,
            self._order.config.name,
            1e3 * seconds,
            Operation(op_of(entry)).name.lower(),
            f"; every {_EVERY}th such turn is logged" if self._num_held >= _LINES else "",
        )

    def abort(self, entry: int) -> None:
        """End a request at once, if it has not ended; the env that executes it is replaced."""
        if self._ending:
            return
        record = self._records[slot_of(entry) - self._first_slot]
        aborted = Raised(self._host_id, entry, ErrorText.of(asyncio.CancelledError("aborted")))
        if record.entry == entry:
            if record.rebuilding is not None:
                record.rebuilding.cancel()
            if record.env is not None:
                self._end_env(record, record.env)
            self._finish(record, aborted)
            return
        queued = [one for one in self._queue if one[1] != entry]
        if len(queued) < len(self._queue):
            self._queue = deque(queued)
            self._post(aborted)

    # -- envs that are lost -------------------------------------------------------

    def _plan_look(self) -> None:
        planned = time.monotonic() + self._pause
        self._look = self._loop.call_later(self._pause, self._look_for_late, planned)

    def _look_for_late(self, planned: float) -> None:
        """Find the requests that take too long.

        While something else blocked the event loop, no env could go on, so that isn't counted.
        """
        self._look = None
        if self._ending:
            return
        now = time.monotonic()
        for record in self._records:
            record.due += max(0.0, now - planned)
            if now >= record.due:
                self._expire(record)
        # What has begun in place of a request that was late may have planned one.
        if self._look is None and any(record.due < math.inf for record in self._records):
            self._plan_look()

    def _expire(self, record: _EnvRecord) -> None:
        """Put an env away whose request takes too long."""
        env = record.env
        if env is None:
            return
        op = op_of(record.entry)
        doing = Operation(op).name.lower()
        seconds = self._limits[op]
        message = (
            f"env {record.name!r} took longer than {seconds} s for a {doing} and was cancelled"
        )
        if waits_in := awaited_calls(env.answering):
            message += f" while it waited in {waits_in}"
        self._end_env(record, env)
        why = hung(f"hung in a {doing} and was cancelled", op, record.name)
        self._report_loss(record, why, message)

    def _report_loss(self, record: _EnvRecord, why: Loss, message: str) -> None:
        """Report that an env is gone, and the request with it that it was executing."""
        record.lost = why, message
        entry = self._take_request(record)
        if self._ending:
            return
        self.num_busy -= entry != 0
        answered = record.answered
        self._post(Lost(self._host_id, record.index, why, entry, message, answered))
        self._begin_queued()

    def _report_again(self, record: _EnvRecord, entry: int, why: Loss, message: str) -> None:
        if record.entry == entry:
            self._report_loss(record, why, message)

    def _on_broken(self, env: AwaitedEnv) -> None:
        """An env has left by itself while it was idle."""
        if self._ending or (record := self._records[env.index]).env is not env:
            return
        record.env, record.is_ending = None, True
        record.leaving = env.task

        late = self._loop.call_later(self._close_seconds, env.cut_short, self._close_seconds)

        def closed(_: object) -> None:
            late.cancel()
            record.is_ending = False
            cause = "ended while it was idle: something cancelled its task"
            if env.close_error is not None:
                cause = f"ended while it was idle: {env.close_error.summary}"
            self._note_closed(env)
            why = Loss(cause, "env_died", "env", record.name)
            self._report_loss(record, why, f"env {record.name!r} {cause}")

        # No task of ours waits for that: perhaps the event loop ends.
        env.task.add_done_callback(closed)

    def _end_env(self, record: _EnvRecord, env: AwaitedEnv) -> None:
        """Cancel what an env is doing, and close it. What it still does goes nowhere."""
        if self._order.is_hardware:
            begin_stops([env.runner.env])
        env.leave()
        record.env = None
        record.leaving = self._spawn(self._close(env))

    async def _close(self, env: AwaitedEnv) -> None:
        await end_all([env], self._close_seconds)
        self._note_closed(env)

    def _note_closed(self, env: AwaitedEnv) -> None:
        """Report what was wrong with an env that was put away."""
        if (error := env.close_error) is not None and not self._ending:
            log.warning("env %r, as it was put away to be rebuilt: %s", env.name, error.summary)

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = new_task(coroutine, self._loop)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _rebuild(self, record: _EnvRecord) -> None:
        """Make another env once the one before has closed, and give it the request."""
        if record.leaving is not None:
            await asyncio.wait({record.leaving})  # It ends in time: see `end_all`.
        error, env = await self._build(record), record.env
        if env is not None:
            self._give(record, env)
        elif self._inline and isinstance(error, KeyboardInterrupt):
            self._loop.call_soon(reraise, error)
            self._finish(record, Raised(self._host_id, record.entry, ErrorText.of(error)))
        else:
            cause = f"could not be rebuilt: {error!r}"
            why = Loss(cause, "not_started", "env", record.name)
            self._report_loss(record, why, f"env {record.name!r} {cause}")


def _entered(make: Callable[[], Any], enter: Callable[[int], object], entry: int) -> Any:
    """Make an env, whose code runs meanwhile."""
    enter(entry)
    try:
        return make()
    finally:
        enter(0)
