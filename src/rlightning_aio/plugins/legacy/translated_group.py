"""`TranslatedGroup`: our synchronous group under RLightning's ids.

Rule: it counts steps as results arrive, and keeps results that arrive before `collect_async` asks
for them. What RLightning's operations mean is in `group`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.calling import collect_calls, in_one_call, send_calls
from rlightning_aio.errors import EnvFault, NothingPending, WorkerDied
from rlightning_aio.plugins.legacy.names import names_in_use
from rlightning_aio.sync import build_env_group
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from rlightning_aio.plugins.legacy.counter import EnvStepCounter
    from rlightning_aio.plugins.legacy.plan import Plan

__all__ = ["ResultRow", "TranslatedGroup"]

T = TypeVar("T")


class ResultRow(NamedTuple):
    """A result.

    Attributes:
        batch_id: its id in batches.
        env_id: the id of its env.
        ret: RLightning's `EnvRet`.
        is_reset: it is the first one of an episode.
        at_limit: with it the episode has reached its limit of steps.
    """

    batch_id: str
    env_id: str
    ret: Any
    is_reset: bool = False
    at_limit: bool = False


class TranslatedGroup:
    """Our group of the planned envs.

    Attributes:
        local_ids, server_ids: RLightning's ids of the local envs and of the env_servers.
        counter: of the steps of local envs; None if they are not counted.
    """

    def __init__(self, plan: Plan) -> None:
        num_local = len(plan.local)
        self._names = names_in_use()
        self._local_core_ids = plan.core_ids[:num_local]
        self._core = build_env_group(plan.entries, mixed_actions=True)
        self._core.init()
        # There, a step after an end is nothing unusual.
        self._core.auto_reset(math.inf, on_done=False).__enter__()
        self.counter: EnvStepCounter | None = None
        # What Ctrl-C kept from its caller, or came before `collect_async` asked for it.
        self._kept: list[ResultRow] = []
        self._faults: list[EnvFault] = []
        # Calls of all envs may be unanswered.
        self._calling = False
        self._id_of = dict(zip(plan.core_ids, plan.core_ids, strict=True))
        self.local_ids: list[str] = []
        self.local_ids = self.call_all("of_env", "get_env_id", (), {})
        self.server_ids = plan.ids[num_local:]
        env_ids = [*self.local_ids, *self.server_ids]
        self._id_of = dict(zip(plan.core_ids, env_ids, strict=True))
        self._core_id_of = dict(zip(env_ids, plan.core_ids, strict=True))

    def in_one_call(self, function: Callable[[], T]) -> T:
        """Call a function that uses this group; Ctrl-C interrupts it only where it waits."""
        return in_one_call(self._core, function)

    # -- steps and resets of local envs, steps of clients

    def send_resets(self, env_ids: Sequence[str], options: dict[str, Any] | None = None) -> None:
        """Send a reset to each of the local envs."""
        if not env_ids:
            return
        core_ids = [self._core_id_of[env_id] for env_id in env_ids]
        self._core.reset_async(options=options, env_ids=core_ids)

    def send_steps(self, steps: Sequence[tuple[str, Any]]) -> None:
        """Send steps.

        Args:
            steps: id of a local env and RLightning's `PolicyResponse`, or id of an env_server and
                a `PolicyResponse` of ours for a client.
        """
        ids = [self._core_id_of[env_id] for env_id, _ in steps]
        responses = [
            one if isinstance(one, PolicyResponse) else PolicyResponse(core_id, one)
            for core_id, (_, one) in zip(ids, steps, strict=True)
        ]
        self._core.step_async(BatchedData(ids, responses))

    def for_client(self, server_id: str, response: Any) -> PolicyResponse:
        """Return `response` with arrays for tensors, addressed to our client."""
        data = {name: as_numpy(value) for name, value in response.to_dict().items()}
        client = response.env_id.rpartition("/")[2]
        return PolicyResponse(f"{self._core_id_of[server_id]}/{client}", **data)

    def reset_server(self, server_id: str, seed: Any, options: Any) -> list[ResultRow]:
        """Reset the clients of an env_server, and wait."""
        with self._own_ids():
            rets: Any = self._core[self._core_id_of[server_id]].reset(seed, options)
        rows: list[ResultRow] = []
        for ret in rets:
            env_id = self._own_id(ret.env_id)
            own = self._names.EnvRet(env_id, ret.observation, info=ret.info)
            rows.append(ResultRow(server_id, env_id, own))
        return rows

    # -- results

    def begin_counting(self, counter: EnvStepCounter) -> None:
        """Count results from now on, and those that were kept."""
        self.counter = counter
        self._kept = [self._counted(row) for row in self._kept]

    def _counted(self, row: ResultRow) -> ResultRow:
        counter = self.counter
        if counter is None or row.batch_id in self.server_ids:
            return row
        if row.is_reset:
            counter.reset(row.env_id)
        if not counter.is_reached_max_steps(row.env_id):
            counter.step(row.env_id)
        return row._replace(at_limit=counter.is_reached_max_steps(row.env_id))

    def collected(self, **how: Any) -> list[ResultRow]:
        """Return results of our `collect_async`, with arguments `how`."""
        self._raise_kept()
        return self._collected(**how)

    def _collected(self, **how: Any) -> list[ResultRow]:
        with self._own_ids():
            batch, _ = self._core.collect_async(**how)
        return self.rows_of(batch)

    @property
    def pending(self) -> set[str]:
        """Ids of envs and clients in flight."""
        return {self._own_id(core_id) for core_id in self._core.pending}

    def _own_id(self, core_id: str) -> str:
        if core_id in self._id_of:
            return self._id_of[core_id]
        server_id, _, client = core_id.rpartition("/")
        return f"{self._id_of[server_id]}/{client}"

    @contextlib.contextmanager
    def _own_ids(self) -> Generator[None]:
        """Name envs in errors by RLightning's ids."""
        try:
            yield
        except EnvFault as fault:
            for one in (fault, *fault.others):
                one.env_id = self._own_id(one.env_id)
                if isinstance(one, WorkerDied):
                    one.env_ids = tuple(map(self._own_id, one.env_ids))
            raise

    def rows_of(self, batch: BatchedData) -> list[ResultRow]:
        """Translate results of our group, and count them."""
        ids = [self._id_of[core_id] for core_id in batch.ids()]
        local = [row for row, batch_id in enumerate(ids) if batch_id not in self.server_ids]
        if len(local) == len(ids):
            return self._local_rows(ids, batch)
        found = iter(self._local_rows([ids[row] for row in local], batch.take(local)))
        return [
            ResultRow(batch_id, *self._of_client(batch_id, ours))
            if batch_id in self.server_ids
            else next(found)
            for batch_id, ours in zip(ids, batch.values(), strict=True)
        ]

    def _local_rows(self, ids: list[str], batch: BatchedData) -> list[ResultRow]:
        """Return the results of local envs, whose observations are RLightning's results."""
        if not ids:
            return []
        rets: list[Any] = list(batch.observation)
        for row in batch.restarted.nonzero()[0].tolist():
            info = {**rets[row].info, **batch.info()[row]}
            rets[row] = dataclasses.replace(rets[row], last_truncated=True, info=info)
        rows = zip(ids, ids, rets, batch.is_reset.tolist(), strict=True)
        return [self._counted(ResultRow(*row)) for row in rows]

    def _of_client(self, server_id: str, ours: Any) -> tuple[str, Any]:
        """Return the id of a client, and its result as RLightning's."""
        env_id = f"{server_id}/{ours.env_id.rpartition('/')[2]}"
        return env_id, self._names.EnvRet(**{**vars(ours), "env_id": env_id, "_extra": ours._extra})

    def results_of(self, env_ids: Sequence[str]) -> tuple[list[ResultRow], list[EnvFault]]:
        """Wait for the outstanding results of local envs; return them in this order, and errors.

        If Ctrl-C ends the wait, those that have arrived are kept.
        """
        found: dict[str, ResultRow] = {}
        faults: list[EnvFault] = []
        try:
            while not self.pending.isdisjoint(env_ids):
                try:
                    found.update((row.env_id, row) for row in self._local_results())
                except EnvFault as fault:
                    faults.append(fault)
        except BaseException:
            self.keep([*found.values()])
            self._faults += faults
            raise
        return [found[env_id] for env_id in env_ids if env_id in found], faults

    def _local_results(self) -> list[ResultRow]:
        """Wait for outstanding results of local envs; keep what clients answer meanwhile."""
        awaited = self.pending.intersection(self.local_ids)
        try:
            rows = self._collected(min_results=len(awaited))
        except EnvFault as fault:
            if fault.env_id in self.local_ids:
                raise
            self._faults.append(fault)
            return []
        self.keep([row for row in rows if row.batch_id in self.server_ids])
        return [row for row in rows if row.batch_id not in self.server_ids]

    def settle(self) -> None:
        """Wait for what local envs owe, and keep results for `take_kept`; raise kept errors."""
        self._raise_kept()
        self.end_calls()
        while not self.pending.isdisjoint(self.local_ids):
            self.keep(self._local_results())

    def _raise_kept(self) -> None:
        if self._faults:
            raise self._faults.pop(0)

    def keep(self, rows: list[ResultRow]) -> None:
        """Keep results for `take_kept`."""
        self._kept += rows

    def take_kept(self) -> list[ResultRow]:
        """Return the results that were kept, once."""
        rows, self._kept = self._kept, []
        return rows

    # -- methods of the envs

    def call_all(self, name: str, *args: Any) -> list[Any]:
        """Call a method of all local envs at once. Return the values in the group's order."""
        if not self._local_core_ids:
            return []
        self.settle()
        self._calling = True
        send_calls(self._core, name, *args, env_ids=self._local_core_ids)
        return self._call_values()

    def end_calls(self) -> None:
        """Wait for calls of all envs that Ctrl-C left behind, and drop their values."""
        if self._calling:
            with contextlib.suppress(NothingPending):
                self._call_values()
            self._calling = False

    def _call_values(self) -> list[Any]:
        with self._own_ids():
            values = collect_calls(self._core)
        self._calling = False
        return values

    def call_env(self, env_id: str, name: str, *args: Any) -> Any:
        """Call a method of one local env."""
        if env_id in self.pending:
            self.settle()
        with self._own_ids():
            return self._core[self._core_id_of[env_id]].call(name, *args)

    def server_address(self, server_id: str) -> tuple[str, int]:
        """Return host and port of an env_server."""
        handle: Any = self._core[self._core_id_of[server_id]]
        host, _, port = handle.address.removeprefix("tcp://").rpartition(":")
        return host, int(port)

    def print_timing_summary(self) -> None:
        """Print our group's timing."""
        self._core.print_timing_summary()

    def close(self) -> None:
        """Close all envs and end their workers; idempotent."""
        self._core.close()
