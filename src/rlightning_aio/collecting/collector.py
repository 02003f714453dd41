"""`Collector`: steps a group with a policy, and returns rollouts.

It uses the public `EnvGroup`, and owns it while it is in use. If it stops between a result and the
next request (a policy raises, a task is cancelled, a rollout is full), it keeps the unanswered
results, and the next `collect` continues there. Ctrl-C may stop it at any point, so it costs all.
"""

from __future__ import annotations

import asyncio
from enum import Enum, auto
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

import numpy as np

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio._core.group.api.facade import (
    default_min_results,
    ensure_auto_reset,
    is_resettable,
    lost_hardware,
)
from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
from rlightning_aio._core.group.state.episodes import as_int
from rlightning_aio.batch.contents import readable
from rlightning_aio.collecting.kind import OWN_NAMES, EnvKind, Part
from rlightning_aio.collecting.procedure import Procedure, run
from rlightning_aio.collecting.rollout import Rollout
from rlightning_aio.errors import EnvAway, EnvFault, ResetNeeded, RLightningError, WorkerDied
from rlightning_aio.policies.answers import parts_by_policy, policies_of
from rlightning_aio.policies.random_actions import RandomPolicy

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping, Sequence

    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)
H = TypeVar("H", AsyncEnvGroup, SyncEnvGroup)
R = TypeVar("R", Rollout, dict[str, Rollout])


class _State(Enum):
    """What the newest call of `collect` has left."""

    WHOLE = auto()
    RUNNING = auto()
    """It runs, or was cut off by Ctrl-C, as in synchronous code it can be at any point."""
    CUT_OFF = auto()


class Collector(Generic[G, R]):
    """Steps the envs of a group with a policy, and collects their transitions.

    Without `wait_all` envs are stepped first come, first served: the policy is called as soon as
    `min_results` results have arrived, and a rollout has a fixed total of transitions, more of a
    fast env than of a slow one. ``min_results=len(group)`` waits for all envs each time, which
    makes a run reproducible. With `wait_all` each env makes the same number of transitions, and a
    rollout is a block ``[T, N]``; envs whose episode is over are reset before the policy is
    called, so its batch always has all envs, in the order of the group.

    No transition is lost or duplicated between rollouts: requests in flight when a rollout is full
    begin the next one, and the next `collect` answers the results that have filled it, with the
    policy at that time. Resets, transitions that were lost with a worker, and steps of a
    sub-environment that waits for others to end are in no rollout.

    Envs whose episode is over are reset, at the limits of the `auto_reset` context that is open, or
    else at their own, if they have any. The first call resets all envs with `seed`. From then on
    the collector owns the group: call `restart` after steps or resets of your own, and after
    Ctrl-C; snapshots and calls of methods disturb nothing.

        async with rl.build_env_group(config) as group:
            collector = Collector(group, policy, num_transitions=2048, min_results=4, seed=0)
            for _ in range(updates):
                rollout = await collector.collect()
                learn(rollout)
                collector.policy_version += 1

    With a group of `rlightning_aio.sync`, call ``collector.collect()`` without ``await``.

    Args:
        group: an initialised group.
        policy: called with a batch of results (`BatchedData`); returns actions, a dict of columns
            with ``action``, or what `BatchedData.respond` returns. A column has one row for each
            result, ``[n, …]``, or for each sub-environment, ``[n, num_envs, …]``: arrays, or CPU
            tensors without gradient. It may be a coroutine function if the group is asynchronous.
            None: random actions. Envs of different kinds need one policy for each config entry, as
            a mapping by its name; `collect` then returns a dict of rollouts with `num_transitions`
            transitions in total.
        num_transitions: transitions of each rollout, counting sub-environments; T * N with
            `wait_all`.
        min_results: number of results to wait for before the policy is called, or all pending
            ones if they are fewer; an env with sub-environments returns one result. None is half
            of the envs.
        wait_all: collect blocks ``[T, N]``.
        infos: names of numbers in infos, such as ``("success",)``. Each becomes a float64 column
            of the rollout, NaN where the info of a transition has no such number.
        seed: of the first reset; see `EnvGroup.reset`.

    Attributes:
        policy_version: set it to the version of the policy. Each transition records the version
            that chose its action.

    Raises:
        ValueError: a number is below 1, both `min_results` and `wait_all` are given, or a name of
            `infos` is that of a column of every rollout.
    """

    @overload
    def __init__(
        self: Collector[H, Rollout],
        group: H,
        policy: Callable[[BatchedData], Any] | None,
        *,
        num_transitions: int,
        min_results: int | None = None,
        wait_all: bool = False,
        infos: Sequence[str] = (),
        seed: Any = None,
    ) -> None: ...

    @overload
    def __init__(
        self: Collector[H, dict[str, Rollout]],
        group: H,
        policy: Mapping[str, Callable[[BatchedData], Any] | None],
        *,
        num_transitions: int,
        min_results: int | None = None,
        wait_all: bool = False,
        infos: Sequence[str] = (),
        seed: Any = None,
    ) -> None: ...

    def __init__(
        self,
        group: Any,
        policy: Any,
        *,
        num_transitions: int,
        min_results: int | None = None,
        wait_all: bool = False,
        infos: Sequence[str] = (),
        seed: Any = None,
    ) -> None:
        for name, number in (("num_transitions", num_transitions), ("min_results", min_results)):
            if number is not None and number < 1:
                raise ValueError(f"{name} must be at least 1, not {number!r}")
        if wait_all and min_results is not None:
            raise ValueError("wait_all waits for all envs: give it no min_results")
        if isinstance(infos, str):
            raise ValueError(f"infos is a sequence of names: give ({infos!r},)")
        for name in (OWN_NAMES | {"action"}).intersection(infos):
            raise ValueError(f"infos: a rollout already has {name!r}; rename the env's info")
        self.policy_version = 0
        self._group = group
        self._infos = infos
        self._policies: dict[str, Callable[[BatchedData], Any] | None] = policies_of(policy)
        self._quota = num_transitions
        self._min_results = min_results
        self._block = wait_all
        self._seed = seed
        self._state = _State.WHOLE
        self._metas: dict[str, EnvMeta] = {}
        self._begin_anew()
        # Its user has asked for a reset of all envs, also of those that were lost.
        self._is_restarted = False

    def _begin_anew(self) -> None:
        """Forget all results and transitions."""
        self._started = False
        self._kinds: dict[str, EnvKind] = {}
        # Results in order of progress: received, not yet stored, not yet answered.
        # `_expecting`: wait for results next.
        self._received: BatchedData | None = None
        self._unstored: list[Part] = []
        self._unanswered: list[Part] = []
        self._expecting = False
        # Envs whose error was raised, and that have sent no result since.
        self._failed: set[str] = set()

    def restart(self, seed: Any = None, *, batch: BatchedData | None = None) -> None:
        """Begin the episodes of all envs again in the next `collect`.

        What the envs owe then is awaited and dropped. Transitions that are in no rollout yet are
        lost. Columns and spaces may be others.

        Args:
            seed: of the reset, and of random actions; see `EnvGroup.reset`.
            batch: go on from these results in place of a reset: what `EnvGroup.reset` or
                `EnvGroup.restore` of all envs has just returned.

        Raises:
            RuntimeError: a call of `collect` is in progress.
            ValueError: `batch` and a seed are given, or `batch` lacks an env.
        """
        if batch is not None:
            if seed is not None:
                raise ValueError("restart: a seed is of a reset, and a batch is in place of one")
            lacking = {meta.env_id for meta in self._group.metas}
            lacking.difference_update(batch.env_ids())
            if lacking:
                raise ValueError(
                    f"restart: the batch has no result of env {min(lacking)!r}; give what a reset "
                    "or restore of all envs returned"
                )
        if self._state is _State.RUNNING and isinstance(self._group, AsyncEnvGroup):
            raise RuntimeError("restart: a collect is in progress; cancel it first, or await it")
        self._begin_anew()
        self._is_restarted = True
        self._seed = seed
        self._received = batch
        self._state = _State.WHOLE

    @overload
    def collect(self: Collector[SyncEnvGroup, R]) -> R: ...

    @overload
    def collect(self: Collector[AsyncEnvGroup, R]) -> Coroutine[Any, Any, R]: ...

    def collect(self) -> Any:
        """Step the envs until a rollout is full, and return it; await it if the group is async.

        The rollout owns its arrays until the second call after it. Cancellation and errors lose
        nothing: the next call continues. An env whose error was raised takes part again from a
        reset that you have sent by `reset_async`, or else this resets it; but what moves something
        real is reset only by you. Other envs go on.

        Raises:
            ResetNeeded: an earlier call was interrupted by Ctrl-C; call `restart`.
            RuntimeError: a call is in progress.
            ValueError, TypeError: the policy's answer doesn't fit; envs differ, and need a policy
                for each entry; or these envs can't fill a block.
            EnvRaised, WorkerDied, EnvHung: as for `EnvGroup.collect_async`.
            RLightningError: only envs that move something real are left that have raised.
            BadAction: the policy's actions don't fit the action space; nothing was sent.
        """
        return run(self._collect(), self._group)

    # -- the loop -----------------------------------------------------------------

    def _collect(self) -> Procedure[R]:
        if self._state is _State.RUNNING and isinstance(self._group, AsyncEnvGroup):
            raise RuntimeError(
                "this collector is already collecting; only one collect can run at a time"
            )
        if self._state is not _State.WHOLE:
            raise ResetNeeded(
                "a collect was interrupted by Ctrl-C, and its results are lost; call "
                "restart(seed=…) to begin all episodes again, or restart(batch=…) with the results "
                "of group.reset()"
            )
        with ensure_auto_reset(self._group):
            self._state = _State.RUNNING
            try:
                rollout = yield from self._filled()
            except (Exception, asyncio.CancelledError):
                self._state = _State.WHOLE
                raise
            except BaseException:
                self._state = _State.CUT_OFF
                raise
        self._state = _State.WHOLE
        return rollout

    def _filled(self) -> Procedure[R]:
        """Step the envs until a rollout is full, and return it."""
        if not self._started:
            yield from self._start()
        has_rejoined = False
        while True:
            if self._received is not None:
                received, faults = readable(self._received)
                if faults:
                    for fault in faults:
                        self._note(fault)
                    self._received = received if len(received) else None
                    raise faults[0]
                self._split_received(received)
                self._received = None
            if not self._store():
                return self._full()
            if self._failed and not has_rejoined:
                self._rejoin()
            has_rejoined = True
            if self._block and not (self._unanswered or self._expecting):
                self._plan()
            while self._unanswered:
                yield from self._answer(self._unanswered[0])
            yield from self._wait()

    def _wait(self) -> Procedure[None]:
        """Wait for the next results."""
        self._expecting = True
        try:
            self._received, _ = yield self._receive
        except EnvFault as fault:
            self._note(fault)
            self._expecting = bool(self._group.pending)
            raise
        else:
            self._expecting = False

    def _start(self) -> Procedure[None]:
        """Reset all envs, and wait for all of them, unless there is a batch to go on from."""
        if self._received is None:
            lost = () if self._is_restarted else lost_hardware(self._group)
            for env_id in self._failed.union(lost):
                if not is_resettable(self._group, env_id):
                    raise self._refusal(env_id, "restart() has the next collect reset all envs")
            try:  # It drops what a start that was cancelled, or a call before `restart`, has left.
                self._received, _ = yield partial(self._group.reset, seed=self._seed)
            except EnvFault as fault:
                self._note(fault)
                raise
        if self._min_results is None:
            self._min_results = default_min_results(self._group)
        self._started = True

    def _receive(self) -> Any:
        if self._block:
            return self._group.collect_async(wait_all=True)
        return self._group.collect_async(min_results=self._min_results)

    def _split_received(self, batch: BatchedData) -> None:
        if self._failed:
            self._failed.difference_update(batch.env_ids())
        self._unstored = [kind.part(own) for kind, own in self._split(batch)]
        if not self._block:
            self._unanswered = list(self._unstored)
            return
        for part in self._unstored:
            part.kind.hold(part)
        if not (self._failed or any(kind.num_steps for kind in self._kinds.values())):
            self._lay_out()

    def _split(self, batch: BatchedData) -> list[tuple[EnvKind, BatchedData]]:
        return [(self._kind(name), part) for name, part in parts_by_policy(batch, self._policies)]

    def _kind(self, name: str) -> EnvKind:
        if name not in self._kinds:
            policy = self._policies[name] or RandomPolicy(
                lambda env_id: self._meta_of(env_id).action_space, as_int(self._seed)
            )
            self._kinds[name] = EnvKind(policy, self._quota, self._meta_of, self._infos)
        return self._kinds[name]

    def _meta_of(self, env_id: str) -> EnvMeta:
        """Return the metadata of an env; a place has spaces once a client has dialled in."""
        if env_id not in self._metas or self._metas[env_id].action_space is None:
            self._metas = {meta.env_id: meta for meta in self._group.metas}
        return self._metas[env_id]

    # -- after errors -----------------------------------------------------------------

    def _note(self, fault: EnvFault) -> set[str]:
        """Note envs whose error was raised, and return them."""
        noted: set[str] = set()
        for one in (fault, *fault.others):
            env_ids = one.env_ids if isinstance(one, WorkerDied | EnvAway) else ()
            noted.update(env_ids or [one.env_id])
        self._failed |= noted
        return noted

    def _rejoin(self) -> None:
        """Begin episodes of envs whose error was raised.

        Raises:
            WorkerDied, EnvHung: one has been lost once more meanwhile.
            RLightningError: only envs that may move something real are left, or a block needs one.
        """
        pending = self._group.pending
        self._expecting |= bool(pending)
        left = sorted(self._failed.difference(pending))
        to_reset = [env_id for env_id in left if is_resettable(self._group, env_id)]
        alone = [env_id for env_id in left if env_id not in to_reset]  # Until the program asks.
        others = to_reset or self._expecting or self._unanswered
        if alone and (self._block or not others):
            raise self._refusal(alone[0], self._asks_for(alone[0]))
        if to_reset:
            self._group.reset_async(env_ids=to_reset)
            self._expecting = True

    @staticmethod
    def _asks_for(env_id: str) -> str:
        return f"group.reset_async(env_ids=[{env_id!r}]), whose result the next collect takes"

    @staticmethod
    def _refusal(env_id: str, remedy: str) -> RLightningError:
        return RLightningError(
            f"env {env_id!r} was lost or has raised an error, and may move something real, so it "
            f"is reset only if you ask for it: {remedy}"
        )

    # -- blocks -------------------------------------------------------------------

    def _lay_out(self) -> None:
        """Compute the number of steps of a block, once all envs have been reset."""
        for meta in self._group.metas:
            if meta.num_envs > 1 and meta.autoreset != "same_step":
                raise ValueError(
                    f"no [T, N] block can be made with env {meta.env_id!r}, which has "
                    "sub-environments that are reset together, or each a step later; collect "
                    "chains of any length, with min_results instead of wait_all"
                )
        kinds = self._kinds.values()
        counts = [len(kind.held.results.index) for kind in kinds if kind.held is not None]
        num_steps, rest = divmod(self._quota, sum(counts))
        if rest or not num_steps:
            raise ValueError(
                f"num_transitions={self._quota} can't fill a block of {sum(counts)} envs "
                "(sub-environments counted); give a multiple of that"
            )
        for kind, count in zip(kinds, counts, strict=True):
            kind.num_steps = num_steps
            kind.quota = num_steps * count

    def _plan(self) -> None:
        """Choose what happens next: resets first, then steps of envs that are behind others."""
        parts = [kind.held for kind in self._kinds.values() if kind.held is not None]
        over = [env_id for part in parts for env_id in part.waiting_for_reset()]
        if over:
            for env_id in set(over).intersection(lost_hardware(self._group)):
                self._failed.add(env_id)
                raise self._refusal(env_id, self._asks_for(env_id))
            try:
                self._group.reset_async(env_ids=over)
            except EnvFault as fault:
                self._note(fault)
                raise
            return
        most = max(int(part.steps().max()) for part in parts)
        behind = [part.behind(most) for part in parts]
        self._unanswered = [part for part in behind if part is not None] or parts

    # -- one turn -----------------------------------------------------------------

    def _store(self) -> int:
        """Store the transitions that fit the rollout; return how many are still missing."""
        room = self._quota
        for kind in self._kinds.values():
            room -= kind.staging.complete
        remaining: list[Part] = []
        for part in self._unstored:
            room -= part.store(room)
            if len(part.unstored):
                remaining.append(part)
        self._unstored = remaining
        return room

    def _answer(self, part: Part) -> Procedure[None]:
        """Call the policy for `part`, and send its actions."""
        version = self.policy_version
        with self._group.span("policy"):
            answer = yield partial(part.kind.policy, part.batch)
        responses, columns = part.kind.columns_of(part, answer)
        # Copy before sending: the columns may be views of rows that envs will overwrite.
        part.kind.staging.begin(part.results.index, columns, version)
        try:
            self._group.step_async(responses)
        except EnvFault as error:
            self._leave_out(part, self._note(error))
            raise
        part.kind.staging.note_sent()
        del self._unanswered[0]

    def _leave_out(self, part: Part, env_ids: set[str]) -> None:
        """Go on without some envs."""
        is_left_out = np.isin(part.batch.env_ids(), [*env_ids])
        left = part.only(~is_left_out)
        self._unanswered[:1] = [] if left is None else [left]
        self._expecting = bool(self._group.pending)

    def _full(self) -> R:
        waiting = {id(part.kind): part.results for part in self._unanswered}
        found = {
            name: kind.rollout(
                waiting.get(id(kind)) if kind.held is None else kind.held.results,
                self.policy_version,
            )
            for name, kind in self._kinds.items()
        }
        return cast("R", found.get("", found))
