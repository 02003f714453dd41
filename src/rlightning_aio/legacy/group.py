"""RLightning's `EnvGroup` over the public synchronous group of rlightning_aio.

Rule: all that RLightning does another way is settled in this package, its way: ids, what a reset
is given, what `auto_reset` resets, when a window opens, what an empty collect returns. The group
below knows nothing of it.
"""

from __future__ import annotations

import contextlib
import logging
import time
import warnings
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

import numpy as np

from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.data import parts_of
from rlightning_aio.envs.tensors import as_numpy
from rlightning_aio.errors import EnvFault
from rlightning_aio.legacy.counter import EnvStepCounter, ThroughputTracker
from rlightning_aio.legacy.env import default_env_preprocess_fn
from rlightning_aio.legacy.handles import EnvHandle, ServerHandle
from rlightning_aio.legacy.hosted import ARGUMENTS, restored
from rlightning_aio.legacy.names import names_in_use
from rlightning_aio.legacy.plan import Plan, define_env_instance_cfgs, listed_configs, repeated
from rlightning_aio.sync import build_env_group as build_core
from rlightning_aio.types import PolicyResponse

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    import gymnasium as gym
    from numpy.typing import NDArray

__all__ = ["EnvGroup", "build_env_group", "define_env_instance_cfgs"]

_log = logging.getLogger(__name__)


class _Row(NamedTuple):
    """A result: the id that batches call it by, that of its env, and RLightning's `EnvRet`."""

    batch_id: str
    env_id: str
    ret: Any


class EnvGroup:
    """RLightning's group, whose envs live in worker processes.

    Args:
        env_cfg_list: one `EnvConfig` for each env.
        preprocess_fn: one for all envs, or a list with one for each.

    Attributes:
        env_list, env_servers: handles on the envs, and on the env_servers.
        env_ids: of both; id_to_env, env_to_id, id_to_num_envs: by them.
        step_counter: an `EnvStepCounter` inside `auto_reset`, None outside.
    """

    _STEP_ASYNC_WARNED: ClassVar[bool] = True  # Everything is asynchronous here.
    throughput: ClassVar[ThroughputTracker] = ThroughputTracker()

    def __init__(
        self,
        env_cfg_list: Sequence[Any],
        preprocess_fn: Callable[[Any], Any] | list[Any] | None = default_env_preprocess_fn,
    ) -> None:
        if not env_cfg_list:
            raise ValueError("a group needs at least one config")
        if preprocess_fn is default_env_preprocess_fn:
            preprocess_fn = names_in_use().default_env_preprocess_fn
        fns = repeated(preprocess_fn, len(env_cfg_list))
        if len(fns) != len(env_cfg_list):
            raise ValueError(f"{len(fns)} preprocess functions for {len(env_cfg_list)} envs")
        plan = Plan(env_cfg_list, fns)
        num_local = len(plan.local)
        self._names = names_in_use()
        self._local_core_ids = plan.core_ids[:num_local]
        self._local_entries = [entry.name for entry in plan.entries if entry.backend == "callable"]
        self._core = build_core(plan.entries, mixed_actions=True)
        self._core.init()
        # Envs that owe a result, and results that were waited for and not yet asked for.
        self._pending: set[str] = set()
        self._kept: list[_Row] = []
        self._local_ids: set[str] = set()
        own_ids: list[str] = self._call_all("of_env", "get_env_id", (), {})
        self._forms = dict(zip(own_ids, self._call_all("action_form"), strict=True))
        self.env_ids = [*own_ids, *plan.ids[num_local:]]
        self._local_ids = set(own_ids)
        self._id_of = dict(zip(plan.core_ids, self.env_ids, strict=True))
        self._core_id_of = dict(zip(self.env_ids, plan.core_ids, strict=True))
        self.env_list = [EnvHandle(self, core_id) for core_id in self._local_core_ids]
        self.env_servers = [
            ServerHandle(self, env_id, self._core_id_of[env_id])
            for env_id in self.env_ids[num_local:]
        ]
        handles = [*self.env_list, *self.env_servers]
        self.id_to_env = dict(zip(self.env_ids, handles, strict=True))
        self.env_to_id = dict(zip(handles, self.env_ids, strict=True))
        counts = [config.num_envs for config in (*plan.local, *plan.servers)]
        self.id_to_num_envs = dict(zip(self.env_ids, counts, strict=True))
        self.observation_spaces: list[Any] | None = None
        self.action_spaces: list[Any] | None = None
        self.step_counter: EnvStepCounter | None = None

    @property
    def _in_auto_reset_context(self) -> bool:
        return self.step_counter is not None

    # -- what it holds

    def init(self) -> list[Any]:
        """Call each local env's ``init``; what these return.

        Raises:
            ValueError: shapes of action spaces differ, the axis of sub-environments left out.
        """
        metas = self._call_all("of_env", "init", (), {})
        known = [(meta.env_id, _action_shape(meta)) for meta in metas]
        shapes = [(env_id, shape) for env_id, shape in known if shape is not None]
        for env_id, shape in shapes:
            first_id, first = shapes[0]
            if shape != first:
                raise ValueError(
                    f"all envs of a group have actions of one shape: {first_id} has {first}, and "
                    f"{env_id} has {shape}"
                )
        return metas

    @classmethod
    def build_env(
        cls, env_cfg: Any, preprocess_fn: Any = None, worker_index: int | None = None
    ) -> tuple[Any, bool]:
        """One env in this process, and whether it is an env_server."""
        names = names_in_use()
        fn = preprocess_fn or names.default_env_preprocess_fn
        env = names.ENVS.get(env_cfg.backend)(env_cfg, worker_index=worker_index, preprocess_fn=fn)
        return env, env_cfg.backend == "env_server"

    def __len__(self) -> int:
        """Local envs and env_servers."""
        return len(self.env_list) + len(self.env_servers)

    def size(self) -> int:
        """Local envs."""
        return len(self.env_list)

    def __getitem__(self, env_id: str) -> EnvHandle | ServerHandle:
        return self.id_to_env[env_id]

    def get_observation_spaces(self) -> list[gym.Space[Any]]:
        """Of the local envs."""
        if self.observation_spaces is None:
            self.observation_spaces = self._call_all("of_env", "get_observation_space", (), {})
        return self.observation_spaces

    def get_action_spaces(self) -> list[gym.Space[Any]]:
        """Of the local envs."""
        if self.action_spaces is None:
            self.action_spaces = self._call_all("of_env", "get_action_space", (), {})
        return self.action_spaces

    # -- resets and steps

    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, list[bool]]:
        """Reset every env with these arguments, and no others; the results in the group's order.

        For clients of env_servers, `seed` and `options` count.
        """
        self._settle()
        rows: list[_Row] = []
        if self._local_core_ids:
            options = {ARGUMENTS: (args, kwargs)} if args or kwargs else None
            batch, _ = self._core.reset(options=options, env_ids=self._local_core_ids)
            rows += self._rows_of(batch)
        for server in self.env_servers:
            rows += self._reset_server(server, kwargs.get("seed"), kwargs.get("options"))
        if self.step_counter is not None:
            self.step_counter.reset_all()
        return self._handed_out(rows)

    def _reset_server(self, server: ServerHandle, seed: Any, options: Any) -> list[_Row]:
        rets: Any = self._core[self._core_id_of[server.env_id]].reset(seed, options)
        rows: list[_Row] = []
        for ret in rets:
            env_id = f"{server.env_id}/{ret.env_id.partition('/')[2]}"
            own = self._names.EnvRet(env_id, ret.observation, info=ret.info)
            rows.append(_Row(server.env_id, env_id, own))
        self._pending -= {row.env_id for row in rows}
        return rows

    def step(self, batched_policy_resp: Any) -> tuple[Any, list[bool] | None]:
        """Step the envs of a batch and wait for them; results in its order.

        Returns flags inside `auto_reset`, which tell who has come to the limit; else None.
        """
        ids = batched_policy_resp.ids()
        for env_id in ids:
            if env_id in self.env_ids and env_id not in self._local_ids:
                raise NotImplementedError(
                    f"{env_id} is an env_server; use step_async and collect_async"
                )
        self._settle()
        self._send(batched_policy_resp)
        found: dict[str, _Row] = {}
        while not self._pending.isdisjoint(ids):
            found.update((row.env_id, row) for row in self._local_results())
        batch, flags = self._handed_out([found[env_id] for env_id in ids])
        self.throughput.record("env_throughput_sync", self._num_steps(ids))
        return batch, flags if self._in_auto_reset_context else None

    def step_async(self, batched_policy_resp: Any) -> None:
        """Have the envs of a batch step; `collect_async` gets the results."""
        if not self._pending.isdisjoint(batched_policy_resp.ids()):
            self._settle()
        self._send(batched_policy_resp)

    def collect_async(
        self, timeout: float | None = None, wait_all: bool = False
    ) -> tuple[Any, list[bool]]:
        """Results of `step_async`: those that are ready when the first one is.

        Args:
            timeout: seconds from now in which more may join, beyond the first.
            wait_all: wait for all.

        With nothing to wait for, an empty batch, and a warning in the log.
        """
        if timeout is not None and timeout <= 0:
            raise ValueError(f"timeout must be a positive number of seconds, not {timeout!r}")
        if wait_all and timeout is not None:
            warnings.warn("collect_async(wait_all=True) ignores timeout", stacklevel=2)
            timeout = None
        end = time.monotonic() + (timeout or 0.0)
        rows, self._kept = self._kept, []
        if not rows and not self._pending and not self.env_servers:
            _log.warning("collect_async: nothing was sent, and nothing comes back")
            return self._handed_out([])
        rows = rows or self._collected()
        while wait_all and self._pending:
            rows += self._collected(wait_all=True)
        while self._pending and (left := end - time.monotonic()) > 0:
            try:
                rows += self._collected(deadline=left)
            except TimeoutError:
                break
        self.throughput.record(
            "env_throughput_async", self._num_steps(row.batch_id for row in rows)
        )
        return self._handed_out(rows)

    def _num_steps(self, ids: Any) -> int:
        return sum(self.id_to_num_envs[env_id] for env_id in ids)

    def _send(self, batch: Any) -> None:
        """Have the envs of `batch` step, or reset where the counter says so."""
        counter = self.step_counter
        due: list[str] = []
        steps: list[tuple[str, str, Any]] = []
        for env_id, response in batch.items():
            core_id = self._core_id_of[env_id]
            if env_id not in self._local_ids:
                steps.append((response.env_id, core_id, self._for_client(core_id, response)))
            elif counter is not None and counter.is_reached_max_steps(env_id):
                counter.reset(env_id)
                due.append(env_id)
            else:
                form = self._forms[env_id].of(response, self._names)
                steps.append((env_id, core_id, form))
        if due:
            self._core.reset_async(env_ids=[self._core_id_of[env_id] for env_id in due])
            self._pending.update(due)
        if steps:
            env_ids, core_ids, forms = zip(*steps, strict=True)
            self._core.step_async(_batch_of(core_ids, forms))
            self._pending.update(env_ids)

    @staticmethod
    def _for_client(core_id: str, response: Any) -> PolicyResponse:
        data = {name: as_numpy(value) for name, value in response.to_dict().items()}
        client = response.env_id.partition("/")[2]
        return PolicyResponse(f"{core_id}/{client}", **data)

    def _settle(self) -> None:
        """Wait for what local envs still owe; it is kept for `collect_async`."""
        while not self._pending.isdisjoint(self._local_ids):
            self._kept += self._local_results()

    def _local_results(self) -> list[_Row]:
        return self._collected(wait_all=True, entries=self._local_entries)

    def _collected(self, **how: Any) -> list[_Row]:
        try:
            batch, _ = self._core.collect_async(**how)
        except EnvFault as fault:
            ended = {fault.env_id, *getattr(fault, "env_ids", ())}
            self._pending -= {self._id_of.get(core_id, core_id) for core_id in ended}
            raise
        rows = self._rows_of(batch)
        self._pending -= {row.env_id for row in rows}
        return rows

    def _rows_of(self, batch: BatchedData) -> list[_Row]:
        rows: list[Any] = [None] * len(batch)
        batch_ids, env_ids = batch.ids(), batch.env_ids()
        for part in parts_of(batch):
            positions = range(len(part)) if part.positions is None else part.positions.tolist()
            for row, k in enumerate(positions):
                own_id = self._id_of[batch_ids[k]]
                client = env_ids[k].removeprefix(batch_ids[k])
                env_id = own_id + client
                rows[k] = _Row(own_id, env_id, restored(self._names, part, row, env_id))
        return rows

    def _handed_out(self, rows: list[_Row]) -> tuple[Any, list[bool]]:
        """A batch of `rows`, counted, and who of them has come to the limit."""
        ids = [row.batch_id for row in rows]
        flags = [False] * len(rows)
        counter = self.step_counter
        if counter is not None:
            for k, env_id in enumerate(ids):
                if env_id in self._local_ids:
                    counter.step(env_id)
                    flags[k] = counter.is_reached_max_steps(env_id)
        return self._names.BatchedData(ids, [row.ret for row in rows]), flags

    @contextlib.contextmanager
    def auto_reset(self, max_episode_steps: int | None = None) -> Generator[None]:
        """Reset envs in place of the step after their limit; an end by itself resets nothing.

        Counts begin at -1, and each result counts: with a reset inside, a limit of L gives a
        period of L + 1.

        Args:
            max_episode_steps: the limit for all; None takes each env's own.

        Raises:
            ValueError: the limit isn't a positive int, or it is None and an env has none.
        """
        own: list[int | None] = self._call_all("of_env", "get_max_episode_steps", (), {})
        self.step_counter = EnvStepCounter(
            [self._id_of[core_id] for core_id in self._local_core_ids],
            _limits(own, max_episode_steps),
        )
        try:
            yield
        finally:
            self.step_counter = None

    # -- methods of the envs

    def _call_all(self, name: str, *args: Any) -> list[Any]:
        """Call a method of all local envs at once; the values in the group's order."""
        if not self._local_core_ids:
            return []
        self._settle()
        self._core.call_async(name, *args, env_ids=self._local_core_ids)
        return self._core.collect_calls()

    def call_env(self, core_id: str, name: str, *args: Any) -> Any:
        """For the handles: call a method of one env."""
        if self._id_of[core_id] in self._pending:
            self._settle()
        return self._core[core_id].call(name, *args)

    def results_within(self, seconds: float | None) -> tuple[Any, ...]:
        """For an env_server by itself: results, or none if that time has passed without any."""
        try:
            return tuple(row.ret for row in self._collected(deadline=seconds))
        except TimeoutError:
            return ()

    def server_address(self, core_id: str) -> tuple[str, int]:
        """For the handles: where an env_server listens."""
        handle: Any = self._core[core_id]
        host, _, port = handle.address.removeprefix("tcp://").rpartition(":")
        return host, int(port)

    def offload(self) -> None:
        """Have every env free its device memory."""
        self._call_all("of_env", "offload", (), {})

    def reload(self) -> None:
        """Have every env take it again."""
        self._call_all("of_env", "reload", (), {})

    def apply_evaluate_cfg(self) -> None:
        """Have every env take on its ``evaluate_cfg``."""
        self._call_all("of_env", "apply_evaluate_cfg", (), {})

    def restore_evaluate_cfg(self) -> None:
        """Have every env drop it."""
        self._call_all("of_env", "restore_evaluate_cfg", (), {})

    def close(self) -> None:
        """Close all envs and end their workers; idempotent."""
        self._core.close()

    # -- what was measured

    def get_stats(self) -> dict[str, float]:
        """Env steps per second, of all groups together: ``env_throughput_sync``, ``…_async``."""
        return self.throughput.get_stats()

    def get_env_stats(self, reset: bool = False) -> dict[str, float]:
        """Means of the metrics in ``info["episode_info"]``; `reset` starts them anew."""
        total: dict[str, list[float]] = {}
        # Clients of env_servers keep what they count.
        for stats in self._call_all("of_env", "get_env_stats", (reset,), {}):
            for name, (part, count) in stats.items():
                sums = total.setdefault(name, [0.0, 0])
                sums[0] += part
                sums[1] += count
        self._call_all("of_env", "finish_rollout", (), {})
        return {name: part / count for name, (part, count) in total.items() if count > 0}

    def print_timing_summary(self, reset: bool = False) -> None:
        """Print the group's figures, and have each env log its own."""
        self._core.print_timing_summary()
        self._call_all("of_env", "print_timing_summary", (reset,), {})


def _batch_of(core_ids: Sequence[str], forms: Sequence[Any]) -> BatchedData:
    """A batch of steps for the group below: one column, where actions are arrays of one kind."""
    arrays = [cast("NDArray[Any]", form) for form in forms if isinstance(form, np.ndarray)]
    if len(arrays) == len(forms) and len({(a.shape, a.dtype) for a in arrays}) == 1:
        return BatchedData(core_ids, core_ids).respond(action=np.stack(arrays))
    responses = [
        form if isinstance(form, PolicyResponse) else PolicyResponse(core_id, form)
        for core_id, form in zip(core_ids, forms, strict=True)
    ]
    return BatchedData(core_ids, responses)


def _action_shape(meta: Any) -> tuple[int, ...] | None:
    """Of one sub-environment; None where there is no such thing."""
    shape = getattr(meta.action_space, "shape", None)
    return shape[1:] if shape is not None and meta.num_envs > 1 else shape


def _limits(own: list[int | None], given: int | None) -> list[int]:
    if given is None:
        if None in own:
            raise ValueError("an env has no max_episode_steps; pass auto_reset one")
        return [limit for limit in own if limit is not None]
    if not isinstance(given, int) or given <= 0:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"max_episode_steps must be a positive int, not {given!r}")
    if any(limit not in (None, given) for limit in own):
        warnings.warn(
            f"auto_reset(max_episode_steps={given}) overrides the envs' own limits", stacklevel=4
        )
    return [given] * len(own)


def build_env_group(env_cfgs: Any, preprocess_fn: Any = default_env_preprocess_fn) -> EnvGroup:
    """A group of the configured envs, which are built here and now.

    Args:
        env_cfgs: one `EnvConfig`, or a list of them; each makes ``num_workers`` envs.
        preprocess_fn: one for all, or a list with one for each config.
    """
    configs = listed_configs(env_cfgs)
    fns = repeated(preprocess_fn, len(configs))
    copies: list[Any] = []
    own_fns: list[Any] = []
    for config, fn in zip(configs, fns, strict=True):
        copies += define_env_instance_cfgs(config, config.num_workers)
        own_fns += [fn] * config.num_workers
    return EnvGroup(copies, own_fns)
