"""`Collector`: steps a group with a policy, and returns rollouts.

It uses the public `EnvGroup`. If it is interrupted between a result and the next request (a
policy raises, a task is cancelled, a rollout is full), it keeps the unanswered results, and the
next `collect` continues there; `Newest` says which of them are old by then.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

import numpy as np

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio._core.group.api.facade import default_min_results, ensure_auto_reset
from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
from rlightning_aio._core.group.engine.newest import newest_of
from rlightning_aio.collecting.kind import OWN_NAMES, EnvKind, Part
from rlightning_aio.collecting.procedure import BREAK, Interruptible, Procedure, run_as_one_call
from rlightning_aio.collecting.rollout import Rollout
from rlightning_aio.errors import EnvBusy, EnvFault, NothingPending, WorkerDied
from rlightning_aio.policies.answers import parts_by_policy
from rlightning_aio.policies.random_actions import RandomPolicy

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    import gymnasium as gym

    from rlightning_aio._core.group.engine.newest import Newest
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import EnvMeta

__all__ = ["Collector"]

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)
H = TypeVar("H", AsyncEnvGroup, SyncEnvGroup)
R = TypeVar("R", Rollout, dict[str, Rollout])


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
    else at their own, if they have any. Between two calls, envs may be reset, restored and called
    by others: their chains end, and new ones begin with what `EnvGroup.reset` or `EnvGroup.restore`
    returned last. Envs that others have stepped begin a new episode, and so do envs that raised an
    error and were not reset. A robot's or a client's env does that only if you reset it. The first
    call resets all envs, unless one call has reset or restored them all since the collector was
    made; to resume, make the collector and then restore a snapshot.

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
        self._policy: Any = policy
        self._policies: Mapping[str, Callable[[BatchedData], Any] | None] | None = (
            policy if isinstance(policy, Mapping) else None
        )
        self._quota = num_transitions
        self._min_results = min_results
        self._block = wait_all
        self._num_steps = 0
        self._seed = seed
        self._kinds: dict[str, EnvKind] = {}
        self._started = self._start_cut_off = self._start_raised = False
        self._start_fault: EnvFault | None = None
        self._newest: Newest = newest_of(self._group)
        self._newest.begin_keeping()
        self._collecting = False
        self._metas: dict[str, EnvMeta] = {}
        # Results in order of progress: received, not yet stored, not yet answered.
        # `_expecting`: wait for results next.
        self._received: BatchedData | None = None
        self._unstored: list[Part] = []
        self._unanswered: list[Part] = []
        self._expecting = False
        # Envs of workers whose error was raised.
        self._was_raised: set[str] = set()

    @overload
    def collect(self: Collector[SyncEnvGroup, R]) -> R: ...

    @overload
    def collect(self: Collector[AsyncEnvGroup, R]) -> Coroutine[Any, Any, R]: ...

    def collect(self) -> Any:
        """Step the envs until a rollout is full, and return it; await it if the group is async.

        The rollout owns its arrays until the second call after it. Cancellation, Ctrl-C and errors
        lose nothing: the next call continues.

        Raises:
            RuntimeError: a call is in progress.
            ValueError, TypeError: the policy's answer doesn't fit; envs differ, and need a policy
                for each entry; or these envs can't fill a block.
            EnvRaised, WorkerDied, EnvHung: as for `EnvGroup.collect_async`. An env that raised
                takes part again in the next call, and one whose worker is not replaced doesn't.
            RLightningError: a robot's or a client's env has raised and was not reset since.
            BadAction: the policy's actions don't fit the action space; nothing was sent.
        """
        return run_as_one_call(self._collect(), self._group)

    # -- the loop -----------------------------------------------------------------

    def _collect(self) -> Procedure[R]:
        if self._collecting:
            raise RuntimeError(
                "this collector is already collecting; only one collect can run at a time"
            )
        with ensure_auto_reset(self._group):
            self._collecting = True
            try:
                if not self._started:
                    yield from self._start()
                is_resumed = False
                while True:
                    if self._received is not None:
                        self._split_received(self._received)
                        self._received = None
                    if not self._store():
                        yield BREAK  # After this, it would wait for the learner's next collect.
                        return self._full()
                    if not is_resumed:
                        self._resume()
                        is_resumed = True
                    if self._block and not (self._unanswered or self._expecting):
                        self._plan()
                    while self._unanswered:
                        yield from self._answer(self._unanswered[0])
                    yield from self._wait()
            finally:
                self._collecting = False

    def _wait(self) -> Procedure[None]:
        """Wait for the next results."""
        self._expecting = True
        try:
            self._received, _ = yield self._receive
        except WorkerDied as error:
            if not self._was_raised_before(error):
                raise
            self._expecting = bool(self._group.pending)
            if self._block or not self._has_others():
                raise
            return
        self._expecting = False

    def _start(self) -> Procedure[None]:
        """Reset all envs, and wait for all of them, unless the program has done so."""
        try:
            if not (self._start_cut_off or self._start_raised):
                self._received = self._newest.take_all_returned()
            if self._received is None:
                self._received, _ = yield partial(self._group.reset, seed=self._seed)
        except EnvBusy:
            if self._start_cut_off:
                yield from self._await_start()
            elif self._start_raised:
                yield from self._start_again()
                return
            else:
                raise
        except BaseException as error:
            self._start_cut_off = not isinstance(error, Exception)
            self._start_raised = isinstance(error, EnvFault)
            raise
        if self._min_results is None:
            self._min_results = default_min_results(self._group)
        self._started = True

    def _start_again(self) -> Procedure[None]:
        """Begin again where envs have raised, and the program has reset some of them meanwhile."""
        yield partial(self._group.collect_async, wait_all=True)
        self._start_raised = False
        yield from self._start()

    def _await_start(self) -> Procedure[None]:
        """Wait for the results of a reset that was sent and then cancelled.

        As with a reset that is not cancelled, there are results of all envs, or an error.
        """
        while True:
            try:
                batch, _ = yield partial(self._group.collect_async, wait_all=True)
            except EnvFault as fault:
                self._start_fault = self._start_fault or fault
            except NothingPending:
                if self._start_fault is None:
                    raise
                break
            else:
                self._received = batch
                break
        fault, self._start_fault = self._start_fault, None
        if fault is not None:
            self._received, self._start_cut_off, self._start_raised = None, False, True
            raise fault

    def _receive(self) -> Any:
        if self._block:
            return self._group.collect_async(wait_all=True)
        return self._group.collect_async(min_results=self._min_results)

    def _split_received(self, batch: BatchedData) -> None:
        self._unstored = self._parts(batch)
        if not self._block:
            self._unanswered = list(self._unstored)
            return
        for part in self._unstored:
            part.kind.hold(part)
        if not self._num_steps:
            self._lay_out()

    def _parts(self, batch: BatchedData) -> list[Part]:
        """Split a batch by policy, as soon as it was received."""
        marks = self._newest.marks
        return [kind.part(own, marks(own)) for kind, own in self._split(batch)]

    def _split(self, batch: BatchedData) -> list[tuple[EnvKind, BatchedData]]:
        policies = self._policies
        return [
            (self._kind(name, self._policy if policies is None else policies[name]), part)
            for name, part in parts_by_policy(batch, policies)
        ]

    def _kind(self, name: str, policy: Callable[[BatchedData], Any] | None) -> EnvKind:
        if name not in self._kinds:
            policy = policy or RandomPolicy(
                self._action_space_of, self._seed if isinstance(self._seed, int) else None
            )
            self._kinds[name] = EnvKind(policy, self._quota, self._meta_of, self._infos)
        return self._kinds[name]

    def _action_space_of(self, env_id: str) -> gym.Space[Any] | None:
        meta = self._meta_of(env_id)
        return None if meta is None else meta.action_space

    def _meta_of(self, env_id: str) -> EnvMeta | None:
        group = self._group
        if not self._metas:
            self._metas = {meta.env_id: meta for meta in group.metas}
        if env_id not in self._metas:
            for server_id in [meta.env_id for meta in group.metas if _is_server(meta)]:
                self._metas.update((meta.env_id, meta) for meta in group[server_id].metas)
        return self._metas.get(env_id)

    # -- between two calls ----------------------------------------------------------

    def _resume(self) -> None:
        """Go on from what has become of the envs since the last call.

        Drop results that are no longer the newest of their envs, which were reset, restored or
        stepped otherwise. Take envs back that have no request: with the result of the reset that
        the program has made, or else, after an error, with a new episode.
        """
        newest, parts = self._newest, self._unanswered
        if self._block:
            parts = [kind.held for kind in self._kinds.values() if kind.held is not None]
        known = _newest_parts(parts, newest)
        count = 0
        for part in known:
            count += len(part.marks)
        if known == parts and not self._expecting and count == newest.num_idle():
            return  # Nobody else has asked any env.
        for part in parts:
            part.cut(~part.is_newest(newest))
        self._unanswered = _newest_parts(self._unanswered, newest)
        pending = set(self._group.pending)
        self._expecting = bool(pending) and (self._expecting or known != parts)
        idle = [id_ for id_ in newest.idle(part.batch for part in known) if id_ not in pending]
        for batch in newest.take_returned(idle):
            self._take(batch)
            idle = [id_ for id_ in idle if id_ not in batch.env_ids()]
        if idle:
            self._reset(idle)

    def _take(self, batch: BatchedData) -> None:
        """Go on from results that a reset has returned to the program."""
        for part in self._parts(batch):
            part.store(0)
            if self._block:
                part.kind.hold(part)
            else:
                self._unanswered.append(part)

    def _reset(self, idle: list[str]) -> None:
        """Begin episodes of idle envs, except of those that are given up.

        Raises:
            WorkerDied, EnvHung: all envs are given up, and no client can come.
            RLightningError: an env may move something real.
        """
        gone = {env_id for worker in self._group.get_workers() for env_id in worker["given_up"]}
        left = [env_id for env_id in idle if env_id not in gone]
        self._newest.check_resettable(left)
        if left or not self._has_others():
            self._group.reset_async(env_ids=left or idle)
            self._expecting = True

    def _has_others(self) -> bool:
        """Return True if results are there or may come."""
        has_results = bool(self._expecting or self._unanswered)
        return has_results or any(map(_is_server, self._group.metas))

    # -- blocks -------------------------------------------------------------------

    def _lay_out(self) -> None:
        """Compute the number of steps of a block, once all envs have been reset."""
        for meta in self._group.metas:
            if _is_server(meta) or (meta.num_envs > 1 and meta.autoreset != "same_step"):
                why = (
                    "has clients that come and go"
                    if _is_server(meta)
                    else "has sub-environments that are reset together, or each a step later"
                )
                raise ValueError(
                    f"no [T, N] block can be made with env {meta.env_id!r}, which {why}; collect "
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
        self._num_steps = num_steps
        for kind, count in zip(kinds, counts, strict=True):
            kind.num_steps = num_steps
            kind.quota = num_steps * count

    def _plan(self) -> None:
        """Choose what happens next: resets first, then steps of envs that are behind others."""
        parts = [kind.held for kind in self._kinds.values() if kind.held is not None]
        over = [env_id for part in parts for env_id in part.waiting_for_reset()]
        if over:
            self._group.reset_async(env_ids=over)
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
            answer = yield Interruptible(partial(part.kind.policy, part.batch))
        responses, columns = part.kind.columns_of(part, answer)
        # Copy before sending: the columns may be views of rows that envs will overwrite.
        part.kind.staging.begin(part.results.index, columns, version)
        try:
            self._group.step_async(responses)
        except KeyboardInterrupt:
            # A synchronous group raises it once the requests are sent.
            if part.batch.env_ids()[0] in self._group.pending:
                part.kind.staging.note_sent()
            raise
        except WorkerDied as error:
            if self._block:  # It needs all envs.
                raise
            was_raised = self._was_raised_before(error)
            self._leave_out(part, error.env_ids)
            if not (was_raised and self._has_others()):
                raise
            return
        part.kind.staging.note_sent()
        del self._unanswered[0]

    def _was_raised_before(self, error: WorkerDied) -> bool:
        """Note a death, for all envs of the worker: some may reply, or fail, at other times."""
        before = self._was_raised.issuperset(error.env_ids)
        for worker in self._group.get_workers():
            if not set(error.env_ids).isdisjoint(worker["given_up"]):
                self._was_raised.update(worker["given_up"])
        return before

    def _leave_out(self, part: Part, given_up: Sequence[str]) -> None:
        """Go on without envs that were given up."""
        is_left_out = np.isin(part.batch.env_ids(), given_up)
        part.cut(is_left_out)
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
        return cast("R", found[""] if self._policies is None else found)


def _newest_parts(parts: list[Part], newest: Newest) -> list[Part]:
    """The parts with the envs whose newest results they are."""
    found: list[Part] = []
    for part in parts:
        own = part.only(part.is_newest(newest))
        if own is not None:
            found.append(own)
    return found


def _is_server(meta: EnvMeta) -> bool:
    return meta.observation_space is None
