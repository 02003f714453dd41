"""What the asynchronous and the synchronous `EnvGroup` share: everything that never waits."""

from __future__ import annotations

import os
import time
import warnings
import weakref
from typing import TYPE_CHECKING, Any, Protocol

from rlightning_aio.batch import BatchedData
from rlightning_aio.errors import BadAction, RLightningError
from rlightning_aio.group.build import Plan, assemble
from rlightning_aio.group.scope import Scope
from rlightning_aio.group.trace import NO_SPAN, Trace
from rlightning_aio.hosts.base import Watcher
from rlightning_aio.types import EnvMeta, EnvRet, MultiAgentEnvRet, PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    import gymnasium as gym

    from rlightning_aio.group.core import Core
    from rlightning_aio.group.wait import Procedure
    from rlightning_aio.hosts.base import Membership

__all__ = ["AutoResetContext", "Facade", "ServerView", "check_process", "only_result", "steps_of"]


def only_result(results: tuple[BatchedData, Any]) -> EnvRet | MultiAgentEnvRet:
    """The one result of a batch of one."""
    return results[0].values()[0]


def steps_of(env_id: str, response: PolicyResponse | Any) -> BatchedData:
    """A batch of one step; `BadAction` for a response to another env."""
    if not isinstance(response, PolicyResponse):
        response = PolicyResponse(env_id, response)
    elif response.env_id != env_id and not response.env_id.startswith(f"{env_id}/"):  # Its client.
        raise BadAction(
            f"the response is for env {response.env_id!r}, and this is the handle of {env_id!r}; "
            "step that env, or the group; nothing was sent"
        )
    return BatchedData([env_id], [response])


class AutoResetContext(Scope):
    """What `EnvGroup.auto_reset` returns: its rule holds from entry to exit.

    It may be entered again after an exit.
    """

    def __init__(
        self, core: Core, max_episode_steps: int | None, on_done: bool, mark_truncated: bool
    ) -> None:
        self._core = core
        self._limit = max_episode_steps
        self._on_done = on_done
        self._mark_truncated = mark_truncated

    def _enter(self) -> None:
        self._core.auto.begin(
            self._limit, on_done=self._on_done, mark_truncated=self._mark_truncated
        )

    def _leave(self) -> None:
        self._core.auto.end()


class ServerView:
    """What both kinds of `ServerHandle` know without waiting."""

    _membership: Membership

    @property
    def env_id(self) -> str:
        """Its id, as in `EnvGroup.env_ids` and in batches of its clients' results."""
        return self._membership.server_id

    @property
    def address(self) -> str:
        """Where clients connect to, as ``tcp://host:port``, with the port that was picked.

        Raises:
            RuntimeError: it does not listen yet, before `init`.
        """
        return self._membership.address()

    @property
    def clients(self) -> list[str]:
        """Ids of the envs of the clients that are connected, ``<server id>/<client name>``."""
        return [f"{self.env_id}/{name}" for name in self._membership.members()]

    @property
    def metas(self) -> list[EnvMeta]:
        """The metadata of these clients' envs, in the same order."""
        return list(self._membership.members().values())


class Driver(Watcher, Protocol):
    """What waits for a group.

    Attributes:
        drain: takes in what sources have told; to be called whenever one has.
    """

    drain: Callable[[], None]

    def check_caller(self) -> None:
        """Raises `RLightningError` if the group is in use, or belongs, elsewhere."""
        ...

    def forget(self) -> None:
        """Forget all sources, without a word to the kernel: another process watches them."""
        ...


def check_process(pid: int) -> None:
    """Raises `RLightningError` in a child that process `pid` has forked."""
    if _this_process[0] != pid:
        raise RLightningError(
            f"this group belongs to process {pid}, which has forked this one; only it can use and "
            "close the group; build another one here"
        )


class Facade:
    """The plain methods of an `EnvGroup`."""

    def __init__(self, plan: Plan) -> None:
        self._driver = self._new_driver()
        self._core = assemble(plan, self._driver, shares_thread=self._shares_thread)
        self._driver.drain = self._core.drain
        supervisor = self._core.supervisor
        self._finalizer = weakref.finalize(self, supervisor.abandon)
        self._disowned = False
        self._traces: list[Trace] = []
        _groups.add(self)

    _shares_thread = False
    """Whether other tasks may use the group while a call waits."""

    def _new_driver(self) -> Driver:
        raise NotImplementedError

    @property
    def _metas(self) -> list[EnvMeta]:
        self._core.supervisor.check_open()
        return self._core.supervisor.metas

    # -- what it holds ------------------------------------------------------------

    @property
    def env_ids(self) -> list[str]:
        """Ids of the local envs, then of the env_servers, in order."""
        envs = self._core.envs
        return [*envs.local_ids, *envs.server_ids]

    def __len__(self) -> int:
        """Envs of the group, each env_server counted once."""
        return len(self.env_ids)

    def size(self) -> int:
        """Local envs of the group."""
        return len(self._core.envs.local_ids)

    @property
    def metas(self) -> list[EnvMeta]:
        """What `init` has returned.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._metas

    def get_observation_spaces(self) -> list[gym.Space[Any] | None]:
        """Observation space of each env, in the order of `env_ids`; None for an env_server.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        return [meta.observation_space for meta in self._metas]

    def get_action_spaces(self) -> list[gym.Space[Any] | None]:
        """Action space of each env, in the order of `env_ids`; None for an env_server.

        Raises:
            GroupClosed: the group was not initialised, or is closed.
        """
        return [meta.action_space for meta in self._metas]

    # -- requests -----------------------------------------------------------------

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
            WorkerDied, EnvHung: an env's worker is gone and is not replaced.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.check_caller()
        self._core.step_async(batch, time.monotonic())

    def reset_async(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> None:
        """Send a reset to all envs, or to those of `env_ids`; `collect_async` returns the first
        observations. Never blocks, and doesn't wait for clients of an env_server.

        Args:
            seed: as of `reset`.
            options: passed to each env.
            env_ids: which envs; None: all local ones and the clients that are connected.

        Raises (before anything is sent):
            EnvBusy: an env has a reply outstanding, or appears twice.
            UnknownEnv: no env of this group has that id.
            ValueError: a seed is not an int from 0 to 2**62 - 1, or there isn't one for each env.
            TypeError: the options can't be sent to a worker or a client.
            WorkerDied, EnvHung: an env's worker is gone and is not replaced.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.check_caller()
        self._core.reset_async(time.monotonic(), seed, options, env_ids)

    def call_async(
        self, name: str, /, *args: Any, env_ids: Sequence[str] | None = None, **kwargs: Any
    ) -> None:
        """Call method `name` of all local envs, or of those of `env_ids`, all at once;
        `collect_calls` returns the values. Never blocks.

        Raises (before anything is sent):
            EnvBusy: an env has a reply outstanding, or appears twice.
            UnknownEnv: no env of this group has that id.
            TypeError: the arguments can't be sent to a worker.
            NotImplementedError: an env is a client's, whose methods can't be called.
            WorkerDied, EnvHung: an env's worker is gone and is not replaced.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.check_caller()
        self._core.calls.call_async(time.monotonic(), env_ids, (name, args, kwargs))

    def _collect_calls(self, deadline: float | None) -> Procedure[list[Any]]:
        _check_seconds("deadline", deadline)
        return self._core.calls.collect_calls(time.monotonic(), deadline)

    def _collect(
        self,
        timeout: float | None,
        wait_all: bool,
        min_results: int | None,
        max_results: int | None,
        deadline: float | None,
        entries: Sequence[str] | None,
        ordered: bool,
    ) -> Procedure[tuple[BatchedData, list[bool]]]:
        _check_seconds("timeout", timeout)
        _check_seconds("deadline", deadline)
        if min_results is None:
            usual = self._core.envs.usual_min_results(entries)
            min_results = usual if max_results is None else max(1, min(usual, max_results))
        if min_results < 1:
            raise ValueError(f"min_results must be at least 1, not {min_results!r}")
        if max_results is not None and max_results < 1:
            raise ValueError(f"max_results must be at least 1, not {max_results!r}")
        if max_results is not None and min_results > max_results:
            raise ValueError(f"min_results ({min_results}) is above max_results ({max_results})")
        if wait_all and timeout is not None:
            warnings.warn("collect_async(wait_all=True) ignores timeout", stacklevel=3)
            timeout = None
        return self._core.collect(
            time.monotonic(),
            timeout=timeout,
            wait_all=wait_all,
            min_results=min_results,
            max_results=max_results,
            deadline=deadline,
            entries=entries,
            ordered=ordered,
        )

    def auto_reset(
        self,
        max_episode_steps: int | None = None,
        on_done: bool = True,
        mark_truncated: bool = False,
    ) -> AutoResetContext:
        """Reset envs at their step limit, in place of their next step.

        The result of the step that reaches the limit says so (`BatchedData.limit_reached`, and
        the flag that comes with it). The env's next step is replaced by a
        reset, which returns reward 0 and `BatchedData.is_reset`. Works with ``with`` and
        ``async with``.

        Args:
            max_episode_steps: the limit for all envs; None takes each entry's own, or the
                simulator's.
            on_done: also reset envs whose episode has ended by itself: with sub-environments
                or agents, when all of them have ended.
            mark_truncated: set `BatchedData.truncated`, too, where the limit is reached.

        Raises:
            ValueError: the limit isn't a positive int, or it is None and an env has none.
            RuntimeError: contexts don't nest.
        """
        return AutoResetContext(self._core, max_episode_steps, on_done, mark_truncated)

    @property
    def resets_by_itself(self) -> bool:
        """Whether an `auto_reset` context is open."""
        return self._core.auto.active

    # -- what was measured --------------------------------------------------------

    def get_stats(self) -> dict[str, Any]:
        """Throughput and latencies over the last ten seconds, or the last thousand batches.

        An env step is a step of one sub-environment: a result of an env with ``num_envs: n``
        stands for n of them, that of a multi-agent env for one, a reset for none.

        Keys: ``steps_per_second`` (env steps); ``entries`` (by config entry, env steps per
        second of ``step``, as ``sync``, and of ``collect_async``, as ``async``);
        ``batch_size`` (results in a batch: mean, min, max); ``latency_us`` with ``p50`` and
        ``p99`` of the steps' ``step`` (in the env), ``wait`` (from sending until the env
        begins) and ``transfer`` (from the env's end until the result is returned). Where
        nothing was measured yet, a dict is empty.
        """
        return self._core.stats.summary()

    def get_env_stats(
        self, reset: bool = False, by_entry: bool = False
    ) -> dict[str, dict[str, Any]]:
        """By env id: requests sent, episodes ended, mean and last return and length.

        An episode ends by itself or at the step limit of `auto_reset`. Where the env judges its
        episodes (``info["success"]`` and ``info["fail"]`` of the results that end them),
        ``success_rate`` and ``fail_rate`` are the shares that were true; None where it doesn't.

        A client whose place in the group another has taken counts only in its entry's sums.

        Args:
            reset: start the sums from zero after this call.
            by_entry: add up the figures of each config entry.
        """
        stats = self._core.stats
        found = stats.by_entry() if by_entry else stats.by_env()
        if reset:
            stats.reset_envs()
        return found

    def get_workers(self) -> list[dict[str, Any]]:
        """What each place where envs live is doing now: each worker, this process, each env_server.

        It waits for nothing, and may be called while another task waits for results, or for
        `init`.

        Keys: ``entry``; ``env_ids`` (of a server, those of clients that have joined); ``pid`` (of
        a process on this machine, else None); ``state`` (``"new"`` before `init`, ``"starting"``,
        ``"up"``, ``"down"`` where a replacement is due, ``"failed"``, ``"closed"``);
        ``owed`` (ids of the envs whose results are outstanding, the oldest first, which is the
        order in which a worker executes them) and ``owed_seconds``, for how long that of the
        first is; ``restarts`` (how often it was replaced).

        Raises:
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        self._driver.check_caller()
        return self._core.describe_workers(time.monotonic_ns())

    def print_timing_summary(self) -> None:
        """Print the figures of `get_stats` as a table."""
        stats = self.get_stats()
        print(f"{stats['steps_per_second']:12.0f} env steps per second")
        for name, rates in stats["entries"].items():
            print(f"{rates['sync'] + rates['async']:12.0f}   {name}")
        for kind, figures in stats["latency_us"].items():
            print(f"{figures['p50']:12.1f} µs {kind} (median), {figures['p99']:.1f} µs (p99)")

    def trace(self, path: str | Path) -> Trace:
        """Record a timeline of this group into a file that https://ui.perfetto.dev opens.

        ``with group.trace("run.json"):`` (or ``async with``) records what happens within; so do
        `Trace.start` and `Trace.stop`. It shows when each env stepped and was reset, what its
        worker and the trainer waited for, which request led to which result, and restarts, hangs
        and step limits: docs/timeline.md. `span` adds the trainer's other work.

        Args:
            path: of the file, in Chrome's trace event format (JSON). It is written when the
                recording ends, also by an error, Ctrl-C or `close`, and replaces what was there.

        Raises:
            OSError: the file can't be written there.
        """
        return Trace(self._core, path, self._traces, by_task=self._shares_thread)

    def span(self, name: str) -> AbstractContextManager[Any]:
        """Mark, with ``with group.span("learner"):``, what the trainer does as a slice of the
        timeline. It may stay in the program: while nothing is recorded, nothing happens.
        """
        return self._traces[0].span(name) if self._traces else NO_SPAN

    def _disown(self) -> None:
        """Leave it to the process that has forked this one: let go of all that they share."""
        self._disowned = True
        self._driver.forget()
        self._core.supervisor.disown()

    def _closed(self) -> None:
        if not self._core.supervisor.closed:
            return  # It was refused.
        self._finalizer.detach()
        for trace in list(self._traces):
            trace.stop()
        close_errors = self._core.supervisor.close_errors
        errors = list(close_errors)
        close_errors.clear()  # Told once, however often it is closed.
        _warn_of(errors)


_groups: weakref.WeakSet[Facade] = weakref.WeakSet()


# Every call asks for it, and asking the system takes as long as all the rest of its checks.
_this_process = [os.getpid()]


def _disown_all() -> None:
    """Leave all groups to the process that has forked this one."""
    _this_process[0] = os.getpid()
    for group in list(_groups):
        group._disown()  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # Nobody else's.


os.register_at_fork(after_in_child=_disown_all)


def _warn_of(errors: Sequence[tuple[str, Any]]) -> None:
    for env_id, error in errors:
        warnings.warn(f"close() of env {env_id!r} raised {error.summary}", stacklevel=4)


def _check_seconds(name: str, seconds: float | None) -> None:
    if seconds is not None and not seconds > 0:
        raise ValueError(f"{name} must be a positive number of seconds, not {seconds!r}")
