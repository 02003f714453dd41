"""The methods that the asynchronous and the synchronous `EnvGroup` share: those that never wait."""

from __future__ import annotations

import logging
import os
import time
import warnings
import weakref
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from rlightning_aio._core.group.drivers.wait import Scope, this_process
from rlightning_aio._core.group.engine.steps import CollectRules
from rlightning_aio._core.group.setup.build import assemble
from rlightning_aio._core.group.state.conditions import NO_SPAN
from rlightning_aio._core.group.state.episodes import as_int
from rlightning_aio._core.group.timeline import Trace
from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio._core.group.drivers.wait import GroupDriver, Procedure
    from rlightning_aio._core.group.engine.core import Core
    from rlightning_aio._core.group.setup.plan import Plan
    from rlightning_aio.batch import BatchedData

_log = logging.getLogger("rlightning_aio")
_NOT_CLOSED: Final = ("TimeoutError", "WorkerDied")
"""What is said to be raised where a close was cut short, or by what is as good as that."""


def only_result(results: tuple[BatchedData, Any]) -> EnvRet | MultiAgentEnvRet:
    """The one result of a batch of one."""
    return results[0].values()[0]


def response_to(env_id: str, response: PolicyResponse | Any) -> PolicyResponse:
    """Return the response to an env, given it or an action."""
    return response if isinstance(response, PolicyResponse) else PolicyResponse(env_id, response)


class AutoResetContext(Scope):
    """The context of `EnvGroup.auto_reset`: envs are reset at their limit from entry to exit.

    It can be entered again after an exit. For the arguments see `Episodes.begin`.
    """

    def __init__(
        self,
        core: Core,
        max_episode_steps: float | None,
        on_done: bool,
        *,
        needs_limits: bool = True,
        forgets: bool = True,
    ) -> None:
        self._core = core
        self._limit = max_episode_steps
        self._on_done = on_done
        self._needs_limits = needs_limits
        self._forgets = forgets

    def _enter(self) -> None:
        self._core.episodes.begin(
            self._limit, on_done=self._on_done, needs_limits=self._needs_limits
        )

    def _leave(self) -> None:
        self._core.episodes.end(forgets=self._forgets)


def ensure_auto_reset(group: Any) -> AbstractContextManager[Any]:
    """The context in which an `EnvGroup`, or one that is wrapped, resets envs at their ends.

    If the caller has one open, its limits apply. Otherwise each env's own step limit applies, if it
    has one, and the next context continues what this one leaves: a `Collector` opens one for each
    rollout.
    """
    core: Core = group._core  # noqa: SLF001
    if core.episodes.auto_reset_is_open:
        return core.episodes.resetting_ended()
    return AutoResetContext(core, None, on_done=True, needs_limits=False, forgets=False)


def is_resettable(group: Any, env_id: str) -> bool:
    """Return False if an env moves something real."""
    core = group._core  # noqa: SLF001
    return not core.tables.record_of(core.envs.find_one(env_id)).is_hardware


def stop_hardware(group: Any, env_ids: Sequence[str] | None = None) -> None:
    """Stop envs that move something real, of `env_ids` or all, as what plays on them ends early."""
    core: Core = group._core  # noqa: SLF001
    if core.lifetime.open:
        core.tables.stop_hardware(core.envs.chosen(env_ids).tolist())


def is_lost_hardware(group: Any, env_id: str) -> bool:
    """Return True if an env moves something real and is lost, other than by an abort."""
    core: Core = group._core  # noqa: SLF001
    slot = core.envs.find_one(env_id)
    why = core.episodes.why_lost(slot)
    is_lost = why is not None and why.kind != "cancelled"
    return is_lost and core.tables.record_of(slot).is_hardware


def lost_hardware(group: Any) -> list[str]:
    """Return the envs that move something real and are lost, other than by an abort."""
    core: Core = group._core  # noqa: SLF001
    moving = [record.slots for record in core.tables.records if record.is_hardware]
    each = [core.envs.env_ids[slot] for slots in moving for slot in slots]
    return [env_id for env_id in each if is_lost_hardware(group, env_id)]


def drop_unraised(group: Any) -> None:
    """Drop the errors of losses that no request has raised, as a reset of all envs does."""
    group._driver.call(group._core.drop_unraised)  # noqa: SLF001


def request_number(group: Any, env_id: str) -> int:
    """Return the number of an env's newest request; what is asked again gets another one."""
    core = group._core  # noqa: SLF001
    return core.requests.numbering.number(core.envs.find_one(env_id))


def numbers_of_attempts(group: Any) -> dict[str, float]:
    """Return what `metrics` of a group has besides its own numbers, to be written to."""
    return group._core.sums.of_attempts  # noqa: SLF001


def default_min_results(group: Any) -> int:
    """Number of results that a policy waits for: half of the envs."""
    return max(1, len(group.env_ids) // 2)


class Facade:
    """The plain methods of an `EnvGroup`."""

    def __init__(self, plan: Plan) -> None:
        self._driver = self._new_driver()
        self._core = assemble(plan, self._driver, shares_thread=self._shares_thread)
        self._steps = self._core.steps
        self._driver.completions = self._core.tables.completions
        self._driver.apply_completions = self._core.apply_completions
        self._finalizer = weakref.finalize(self, self._core.supervisor.shutdown.release)
        self._disowned = False
        self._traces: list[Trace] = []
        _groups.add(self)

    _shares_thread = False
    """True if other tasks may use the group while a call waits."""

    def _new_driver(self) -> GroupDriver:
        raise NotImplementedError

    # -- envs ---------------------------------------------------------------------

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._core.supervisor.workers.summary()})"

    @property
    def env_ids(self) -> list[str]:
        """Ids of the local envs, then of the places of env_servers, in order."""
        return list(self._core.envs.env_ids)

    def __len__(self) -> int:
        """The number of envs, each env_server counted once."""
        return self._core.envs.num_local + len(self._core.supervisor.places.servers)

    def size(self) -> int:
        """The number of local envs."""
        return self._core.envs.num_local

    @property
    def metas(self) -> list[EnvMeta]:
        """The metadata of each env, as returned by `init`.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        self._core.lifetime.check_open()
        return self._core.supervisor.metas

    def get_observation_spaces(self) -> list[gym.Space[Any] | None]:
        """Observation space of each env, in the order of `env_ids`; None for a place
        of an env_server before the first client of its entry has dialled in.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        return [meta.observation_space for meta in self.metas]

    def get_action_spaces(self) -> list[gym.Space[Any] | None]:
        """Action space of each env, in the order of `env_ids`; None for a place
        of an env_server before the first client of its entry has dialled in.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        return [meta.action_space for meta in self.metas]

    # -- requests -----------------------------------------------------------------

    @property
    def pending(self) -> list[str]:
        """Ids of the envs with a request whose result, value or error was not returned yet.

        These envs are busy. `collect_async` returns the results of `step_async` and `reset_async`,
        and their errors.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        return self._driver.look(self._core.pending)

    def step_async(self, batch: BatchedData) -> None:
        """Send a step to each env of `batch`; `collect_async` returns the results. Never blocks.

        Args:
            batch: a batch of responses, from `BatchedData.respond` (columns, fast) or made of
                `PolicyResponse` values.

        The caller may reuse the columns on return: the values sent, and those that
        `BatchedData.sent` returns, are copies.

        Raises (before anything is sent):
            BadAction: an action's shape, dtype or count doesn't fit; it holds NaN, a number that
                its dtype can't hold, or infinity where its space is bounded; or this is not a
                batch.
            EnvBusy: an env has a reply outstanding, or appears twice.
            UnknownEnv: no env of this group has that id.
            WorkerDied, EnvHung: an env was lost meanwhile, and its entry has that raised; the next
                request goes to its replacement.
            EpisodeLost, EnvAway: an env that moves something real was lost; reset it to go on.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.call(self._steps.step_async, batch, time.monotonic())

    def reset_async(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> None:
        """Send a reset to each env; `collect_async` returns the first observations.

        Never blocks. What goes to a place without a client is pending until one dials in.

        Args:
            seed: as for `reset`.
            options: a dict, passed to each env.
            env_ids: the envs to reset; None for all.

        Raises (before anything is sent):
            EnvBusy: an env has a reply outstanding, or appears twice.
            UnknownEnv: no env of this group has that id.
            ValueError: a seed is not an int from 0 to 2**62 - 1, or there isn't one for each env.
            TypeError: the options are no dict, or can't be sent to a worker or a client.
            WorkerDied, EnvHung: an env was lost meanwhile, and its entry has that raised; the next
                request goes to its replacement.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.call(self._core.reset_async, time.monotonic(), seed, options, env_ids)

    def _drain(self, deadline: float | None) -> Procedure[tuple[BatchedData, list[bool]]]:
        check_seconds("deadline", deadline)
        return self._core.drain_requests(time.monotonic(), deadline)

    def _collect(
        self,
        timeout: float | None,
        wait_all: bool,
        min_results: int,
        max_results: int | None,
        deadline: float | None,
    ) -> Procedure[tuple[BatchedData, list[bool]]]:
        if timeout is not None or deadline is not None:
            check_seconds("timeout", timeout)
            check_seconds("deadline", deadline)
        if type(min_results) is not int or min_results < 1:
            min_results = _checked_count("min_results", min_results)
        if max_results is not None and (type(max_results) is not int or max_results < 1):
            max_results = _checked_count("max_results", max_results)
        if max_results is not None and min_results > max_results:
            raise ValueError(f"min_results ({min_results}) is above max_results ({max_results})")
        if wait_all and timeout is not None:
            warnings.warn("collect_async(wait_all=True) ignores timeout", stacklevel=3)
            timeout = None
        rules = CollectRules(
            timeout=timeout,
            wait_all=wait_all,
            min_results=min_results,
            max_results=max_results,
            deadline=deadline,
        )
        return self._steps.collect(time.monotonic(), rules)

    def auto_reset(
        self, max_episode_steps: float | None = None, on_done: bool = True
    ) -> AutoResetContext:
        """Reset envs at their step limit, in place of their next step.

        The step that reaches the limit sets `BatchedData.truncated`, `BatchedData.limit_reached`
        and the flag returned with the batch. The next step of that env performs a reset instead,
        which returns reward 0 and sets `BatchedData.is_reset`. Works with ``with`` and
        ``async with``.

        Args:
            max_episode_steps: the limit for all envs; None uses the limit of each entry, or else
                of its simulator; `math.inf` sets no limit, for envs that end their own episodes.
            on_done: also reset envs when their episode ends; an env with sub-environments or
                agents when the episodes of all of them have ended.

        Raises:
            ValueError: the limit is neither a positive int nor `math.inf`, or it is None and an
                env has no limit.
            RuntimeError: another `auto_reset` context is open; contexts don't nest.
        """
        return AutoResetContext(self._core, max_episode_steps, on_done)

    # -- measurements -------------------------------------------------------------

    def metrics(self, by_entry: bool = False) -> dict[str, float]:
        """The numbers of the group, as Weights & Biases and TensorBoard take them.

        Which side starves, what fails, how episodes end: sums since the start, and what the envs do
        now. docs/metrics.md explains every number. Names are stable, and values are plain numbers.
        Never waits, and works before, during and after other calls.

        Args:
            by_entry: add the numbers of each config entry, as ``envs/<entry>/<name>``.

        Raises:
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        return self._driver.look(partial(self._core.sums.metrics, by_entry=by_entry))

    def get_stats(self) -> dict[str, Any]:
        """Means over the group's life, made of the sums of `metrics`.

        Keys: ``steps_per_second`` (env steps, from the first request to the last result);
        ``entries`` (the same by config entry); ``batch_size`` (results per batch); ``latency_us``
        (of steps and resets: ``step``, the time in the env; ``wait``, from sending until the env
        begins; and ``transfer``, from the end in the env until the result is returned). All are 0
        before the first result.

        Raises:
            RLightningError: as `metrics`.
        """
        return self._driver.look(self._core.sums.summary)

    def get_env_stats(self) -> dict[str, dict[str, Any]]:
        """The sums of `metrics` by env id, with ``mean_return`` and ``mean_length``.

        The means are over all ended episodes, None before the first. To measure a policy, use
        `rlightning_aio.evaluation.evaluate`.

        Raises:
            RLightningError: as `metrics`.
        """
        return self._driver.look(self._core.sums.by_env)

    def get_workers(self) -> list[dict[str, Any]]:
        """The current state of each host: each worker, this process, each place for a client.

        Never waits; other tasks may be waiting for results or for `init`.

        Keys: ``entry``; ``env_ids``; ``client`` (its name, of a place that has one); ``pid`` (of a
        process on this machine, else None); ``state`` (``"new"`` before `init`, ``"starting"``,
        ``"up"``, ``"down"`` before a replacement, ``"empty"`` of a place without a client,
        ``"closed"``); ``owed`` (ids of envs with a request in flight, the oldest first, which is
        the order of execution); ``owed_seconds`` (the age of the oldest); ``restarts`` (the number
        of replacements).

        Raises:
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        return self._driver.look(self._core.describe_workers, time.monotonic_ns())

    def print_timing_summary(self) -> None:
        """Print the numbers of `get_stats` as a table."""
        stats = self.get_stats()
        print(f"{stats['steps_per_second']:12.0f} env steps per second")
        for name, rate in stats["entries"].items():
            print(f"{rate:12.0f}   {name}")
        for kind, microseconds in stats["latency_us"].items():
            print(f"{microseconds:12.1f} µs {kind} (mean)")

    def trace(self, path: str | Path) -> Trace:
        """Record a timeline of this group into a file that https://ui.perfetto.dev opens.

        Use ``with group.trace("run.json"):`` (or ``async with``), or `Trace.start` and
        `Trace.stop`. The timeline shows steps and resets of each env with the numbers of their
        requests, and the calls of the trainer: see docs/metrics.md. `span` adds other
        work of the trainer.

        Args:
            path: of the file, in Chrome's trace event format (JSON). It is written when the
                recording ends, also by an error, Ctrl-C or `close`, and replaces an existing file.

        Raises:
            OSError: the file can't be written.
        """
        return Trace(self._core, path, self._traces)

    def span(self, name: str) -> AbstractContextManager[Any]:
        """Add a slice to the timeline for other work: ``with group.span("learner"):``.

        Does nothing while no timeline is recorded, so the call may stay in the program.
        """
        return self._traces[0].span(name) if self._traces else NO_SPAN

    def _disown(self) -> None:
        """Release this group in a forked child, and leave it intact in the parent."""
        self._disowned = True
        self._driver.disown()
        self._core.supervisor.shutdown.disown()

    def _after_close(self) -> None:
        """End timelines, and warn of what closing has raised."""
        if not self._core.lifetime.closed:
            return  # `close` raised before it closed anything.
        self._finalizer.detach()
        self._core.sums.ended_ns = self._core.sums.ended_ns or time.monotonic_ns()
        for trace in list(self._traces):
            trace.stop()
        close_errors = self._core.supervisor.close_errors
        errors = list(close_errors)
        close_errors.clear()  # Warn once, however often `close` is called.
        left = [env_id for env_id, error in errors if error.type_name in _NOT_CLOSED]
        if left:
            _log.warning(
                "%d envs were not closed, and what they hold may be left behind (close_timeout of "
                "an entry gives its envs more time): %s",
                len(left),
                ", ".join(left),
            )
        # Of envs that were lost with their worker, which have one error, the first.
        first_of = {id(error): (env_id, error) for env_id, error in reversed(errors)}
        for env_id, error in reversed(first_of.values()):
            warnings.warn(f"close() of env {env_id!r} raised {error.summary}", stacklevel=3)


_groups: weakref.WeakSet[Facade] = weakref.WeakSet()


def _disown_all() -> None:
    """Release all groups in a forked child."""
    this_process[0] = os.getpid()
    for group in list(_groups):
        group._disown()  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # Same module.


os.register_at_fork(after_in_child=_disown_all)


def _checked_count(name: str, given: Any) -> int:
    count = as_int(given)
    if count is None or count < 1:
        raise ValueError(f"{name} must be an int, at least 1, not {given!r}")
    return count


def check_seconds(name: str, seconds: float | None) -> None:
    if seconds is not None and not seconds > 0:
        raise ValueError(f"{name} must be a positive number of seconds, not {seconds!r}")
