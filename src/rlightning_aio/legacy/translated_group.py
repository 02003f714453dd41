"""`TranslatedGroup`: our synchronous group under RLightning's ids.

Rule: it knows which envs are busy, and keeps results that arrive before `collect_async` asks for
them. What RLightning's operations mean is in `group`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.contents import parts_of
from rlightning_aio.batch.parts import rows_in_order
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.errors import EnvFault
from rlightning_aio.legacy.hosted import restored
from rlightning_aio.legacy.names import names_in_use
from rlightning_aio.sync import build_env_group
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from rlightning_aio.legacy.plan import Plan

__all__ = ["ResultRow", "TranslatedGroup"]


class ResultRow(NamedTuple):
    """A result.

    Attributes:
        batch_id: its id in batches.
        env_id: the id of its env.
        ret: RLightning's `EnvRet`.
        restarted: it is the first one of a replaced worker's env.
    """

    batch_id: str
    env_id: str
    ret: Any
    restarted: bool = False


class TranslatedGroup:
    """Our group of the planned envs.

    Attributes:
        local_ids, server_ids: RLightning's ids of the local envs and of the env_servers.
        pending: ids of envs and clients in flight.
    """

    def __init__(self, plan: Plan) -> None:
        num_local = len(plan.local)
        self._names = names_in_use()
        self._local_core_ids = plan.core_ids[:num_local]
        self._local_entries = [entry.name for entry in plan.entries if entry.backend == "callable"]
        self._core = build_env_group(plan.entries, mixed_actions=True)
        self._core.init()
        self.pending: set[str] = set()
        self._kept: list[ResultRow] = []
        self.local_ids: list[str] = []
        self.local_ids = self.call_all("of_env", "get_env_id", (), {})
        self.server_ids = plan.ids[num_local:]
        env_ids = [*self.local_ids, *self.server_ids]
        self._id_of = dict(zip(plan.core_ids, env_ids, strict=True))
        self._core_id_of = dict(zip(env_ids, plan.core_ids, strict=True))

    # -- steps and resets of local envs, steps of clients

    def reset(self, options: dict[str, Any] | None) -> list[ResultRow]:
        """Reset every local env, and wait."""
        if not self._local_core_ids:
            return []
        batch, _ = self._core.reset(options=options, env_ids=self._local_core_ids)
        return self._rows_of(batch)

    def send_resets(self, env_ids: Sequence[str]) -> None:
        """Send a reset to each of the local envs."""
        self._core.reset_async(env_ids=[self._core_id_of[env_id] for env_id in env_ids])
        self.pending.update(env_ids)

    def send_steps(self, steps: Sequence[tuple[str, str, Any]]) -> None:
        """Send steps.

        Args:
            steps: id of a local env or of a client, id of the env or of the client's env_server,
                and an action or a `PolicyResponse` with the former id.
        """
        env_ids, owners, forms = zip(*steps, strict=True)
        self._core.step_async(_batch_of([self._core_id_of[id_] for id_ in owners], forms))
        self.pending.update(env_ids)

    def for_client(self, server_id: str, response: Any) -> PolicyResponse:
        """Return `response` with arrays for tensors, addressed to our client."""
        data = {name: as_numpy(value) for name, value in response.to_dict().items()}
        client = response.env_id.partition("/")[2]
        return PolicyResponse(f"{self._core_id_of[server_id]}/{client}", **data)

    def reset_server(self, server_id: str, seed: Any, options: Any) -> list[ResultRow]:
        """Reset the clients of an env_server, and wait."""
        rets: Any = self._core[self._core_id_of[server_id]].reset(seed, options)
        rows: list[ResultRow] = []
        for ret in rets:
            env_id = f"{server_id}/{ret.env_id.partition('/')[2]}"
            own = self._names.EnvRet(env_id, ret.observation, info=ret.info)
            rows.append(ResultRow(server_id, env_id, own))
        self.pending -= {row.env_id for row in rows}
        return rows

    # -- results

    def collected(self, **how: Any) -> list[ResultRow]:
        """Return results of our `collect_async`, with arguments `how`."""
        try:
            batch, _ = self._core.collect_async(**how)
        except EnvFault as fault:
            ended = {fault.env_id, *getattr(fault, "env_ids", ())}
            self.pending -= {self._id_of.get(core_id, core_id) for core_id in ended}
            raise
        rows = self._rows_of(batch)
        self.pending -= {row.env_id for row in rows}
        return rows

    def _rows_of(self, batch: BatchedData) -> list[ResultRow]:
        rows: list[ResultRow] = []
        places = zip(rows_in_order(parts_of(batch)), batch.ids(), batch.env_ids(), strict=True)
        for (part, row), core_id, core_env_id in places:
            batch_id = self._id_of[core_id]
            env_id = batch_id + core_env_id.removeprefix(core_id)
            restarted = part.restarted is not None and bool(part.restarted[row])
            ret = restored(self._names, part, row, env_id)
            rows.append(ResultRow(batch_id, env_id, ret, restarted))
        return rows

    def local_results(self) -> list[ResultRow]:
        """Wait for all outstanding results of local envs."""
        return self.collected(wait_all=True, entries=self._local_entries)

    def settle(self) -> None:
        """Wait for outstanding results of local envs, and keep them for `take_kept`."""
        while not self.pending.isdisjoint(self.local_ids):
            self.keep(self.local_results())

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
        self._core.call_async(name, *args, env_ids=self._local_core_ids)
        return self._core.collect_calls()

    def call_env(self, env_id: str, name: str, *args: Any) -> Any:
        """Call a method of one local env."""
        if env_id in self.pending:
            self.settle()
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


def _batch_of(core_ids: Sequence[str], forms: Sequence[Any]) -> BatchedData:
    """Return a batch of steps: one column if all actions are arrays of one kind."""
    arrays = [cast("NDArray[Any]", form) for form in forms if isinstance(form, np.ndarray)]
    if len(arrays) == len(forms) and len({(a.shape, a.dtype) for a in arrays}) == 1:
        return BatchedData(core_ids, core_ids).respond(action=np.stack(arrays))
    responses = [
        form if isinstance(form, PolicyResponse) else PolicyResponse(core_id, form)
        for core_id, form in zip(core_ids, forms, strict=True)
    ]
    return BatchedData(core_ids, responses)
