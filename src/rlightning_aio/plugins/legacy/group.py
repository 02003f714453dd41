"""RLightning's `EnvGroup` over the public synchronous group of rlightning_aio.

Rule: RLightning's behaviour is reproduced in this package: ids, the arguments of a reset, what
`auto_reset` resets, when a window opens, what an empty collect returns. Our own group does not
know of it.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import time
import warnings
from typing import TYPE_CHECKING, Any, ClassVar, Concatenate, ParamSpec, TypeVar

from rlightning_aio.errors import EnvFault, UnknownEnv
from rlightning_aio.plugins.legacy.counter import EnvStepCounter, ThroughputTracker
from rlightning_aio.plugins.legacy.env import default_env_preprocess_fn
from rlightning_aio.plugins.legacy.handles import EnvHandle, ServerHandle
from rlightning_aio.plugins.legacy.hosted import ARGUMENTS, off_device
from rlightning_aio.plugins.legacy.names import names_in_use
from rlightning_aio.plugins.legacy.plan import (
    Plan,
    define_env_instance_cfgs,
    listed_configs,
    repeated,
)
from rlightning_aio.plugins.legacy.translated_group import TranslatedGroup

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    import gymnasium as gym

    from rlightning_aio.plugins.legacy.translated_group import ResultRow

__all__ = ["EnvGroup", "build_env_group", "define_env_instance_cfgs"]

P = ParamSpec("P")
T = TypeVar("T")

_log = logging.getLogger(__name__)


def _one_call(
    method: Callable[Concatenate[EnvGroup, P], T],
) -> Callable[Concatenate[EnvGroup, P], T]:
    """Let Ctrl-C interrupt a method only where it waits, so that it takes no result."""

    @functools.wraps(method)
    def in_one_call(self: EnvGroup, *args: P.args, **kwargs: P.kwargs) -> T:
        group = self._group  # pyright: ignore[reportPrivateUsage]  # Same module.
        return group.in_one_call(functools.partial(method, self, *args, **kwargs))

    return in_one_call


class EnvGroup:
    """RLightning's group, whose envs live in worker processes.

    Args:
        env_cfg_list: one `EnvConfig` for each env.
        preprocess_fn: one for all envs, or a list with one for each.

    Attributes:
        env_list, env_servers: handles on the local envs and on the env_servers.
        env_ids: the ids of both; id_to_env, env_to_id and id_to_num_envs are mappings.
        step_counter: an `EnvStepCounter` inside `auto_reset`, None outside.
    """

    _STEP_ASYNC_WARNED: ClassVar[bool] = True  # No warning is needed: everything is asynchronous.
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
        self._names = names_in_use()
        self._group = TranslatedGroup(plan)
        local_ids = self._group.local_ids
        self._local_ids = frozenset(local_ids)
        self.env_ids = [*local_ids, *self._group.server_ids]
        self.env_list = [EnvHandle(self._group, env_id) for env_id in local_ids]
        self.env_servers = [ServerHandle(self._group, id_) for id_ in self._group.server_ids]
        handles = [*self.env_list, *self.env_servers]
        self.id_to_env = dict(zip(self.env_ids, handles, strict=True))
        self.env_to_id = dict(zip(handles, self.env_ids, strict=True))
        counts = [config.num_envs for config in (*plan.local, *plan.servers)]
        self.id_to_num_envs = dict(zip(self.env_ids, counts, strict=True))
        self.observation_spaces: list[Any] | None = None
        self.action_spaces: list[Any] | None = None

    @property
    def step_counter(self) -> EnvStepCounter | None:
        return self._group.counter

    @property
    def _in_auto_reset_context(self) -> bool:
        return self.step_counter is not None

    # -- contents

    def init(self) -> list[Any]:
        """Call each local env's ``init`` and return the values.

        Raises:
            ValueError: shapes of action spaces differ, not counting the axis of sub-environments.
        """
        metas = self._group.call_all("of_env", "init", (), {})
        known = [(meta.env_id, _action_shape(meta)) for meta in metas]
        shapes = [(env_id, shape) for env_id, shape in known if shape is not None]
        for env_id, shape in shapes:
            first_id, first = shapes[0]
            if shape != first:
                raise ValueError(
                    f"all envs of a group need actions of one shape: {first_id} has {first}, and "
                    f"{env_id} has {shape}"
                )
        return metas

    @classmethod
    def build_env(
        cls, env_cfg: Any, preprocess_fn: Any = None, worker_index: int | None = None
    ) -> tuple[Any, bool]:
        """Make one env in this process. Return it, and True if it is an env_server."""
        names = names_in_use()
        fn = preprocess_fn or names.default_env_preprocess_fn
        env = names.ENVS.get(env_cfg.backend)(env_cfg, worker_index=worker_index, preprocess_fn=fn)
        return env, env_cfg.backend == "env_server"

    def __len__(self) -> int:
        """Return the number of local envs and env_servers."""
        return len(self.env_list) + len(self.env_servers)

    def size(self) -> int:
        """Return the number of local envs."""
        return len(self.env_list)

    def __getitem__(self, env_id: str) -> EnvHandle | ServerHandle:
        return self.id_to_env[env_id]

    def get_observation_spaces(self) -> list[gym.Space[Any]]:
        """Return the observation spaces of the local envs."""
        if self.observation_spaces is None:
            self.observation_spaces = self._group.call_all(
                "of_env", "get_observation_space", (), {}
            )
        return self.observation_spaces

    def get_action_spaces(self) -> list[gym.Space[Any]]:
        """Return the action spaces of the local envs."""
        if self.action_spaces is None:
            self.action_spaces = self._group.call_all("of_env", "get_action_space", (), {})
        return self.action_spaces

    # -- resets and steps

    @_one_call
    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, list[bool]]:
        """Reset every env with exactly these arguments. Return results in the group's order.

        Clients of env_servers get only `seed` and `options`.
        """
        self._group.settle()
        local_ids = self._group.local_ids
        self._group.send_resets(local_ids, {ARGUMENTS: (args, kwargs)} if args or kwargs else None)
        rows = self._results_of(local_ids)
        try:
            for env_id in self._group.server_ids:
                rows += self._group.reset_server(env_id, kwargs.get("seed"), kwargs.get("options"))
        except EnvFault as fault:
            if fault.results is not None:
                rows += self._group.rows_of(fault.results)
            fault.results, _ = self._batch_and_flags(rows)
            raise
        except BaseException:
            self._group.keep(rows)
            raise
        return self._batch_and_flags(rows)

    @_one_call
    def step(self, batched_policy_resp: Any) -> tuple[Any, list[bool] | None]:
        """Step the envs of a batch and wait for them. Return the results in the batch's order.

        Inside `auto_reset`, the second value has a flag for each env that reached its limit;
        outside it is None. An error has the results of the other envs as `results`.
        """
        ids = batched_policy_resp.ids()
        for env_id in ids:
            if env_id in self.env_ids and env_id not in self._local_ids:
                raise NotImplementedError(
                    f"{env_id} is an env_server; use step_async and collect_async"
                )
        self._group.settle()
        self._send(batched_policy_resp)
        rows = self._results_of(ids)
        self.throughput.record("env_throughput_sync", self._num_steps(ids))
        batch, flags = self._batch_and_flags(rows)
        return batch, flags if self._in_auto_reset_context else None

    def _results_of(self, ids: Sequence[str]) -> list[ResultRow]:
        """Wait for results of local envs. An error has the results of the other envs."""
        rows, faults = self._group.results_of(ids)
        if faults:
            faults[0].results, faults[0].others = self._batch_and_flags(rows)[0], tuple(faults[1:])
            raise faults[0]
        return rows

    @_one_call
    def step_async(self, batched_policy_resp: Any) -> None:
        """Send a step to the envs of a batch; `collect_async` returns the results."""
        if not self._group.pending.isdisjoint(batched_policy_resp.ids()):
            self._group.settle()
        self._send(batched_policy_resp)

    @_one_call
    def collect_async(
        self, timeout: float | None = None, wait_all: bool = False
    ) -> tuple[Any, list[bool]]:
        """Wait for results of `step_async`, and return those that are ready with the first.

        Args:
            timeout: seconds from now during which more results may join the first.
            wait_all: wait for all results.

        If nothing was sent, return an empty batch and log a warning.
        """
        if timeout is not None and timeout <= 0:
            raise ValueError(f"timeout must be a positive number of seconds, not {timeout!r}")
        if wait_all and timeout is not None:
            warnings.warn("collect_async(wait_all=True) ignores timeout", stacklevel=5)
            timeout = None
        end = time.monotonic() + (timeout or 0.0)
        self._group.end_calls()
        rows = self._group.take_kept()
        if not rows and not self._group.pending and not self.env_servers:
            _log.warning("collect_async: nothing was sent, so there is nothing to collect")
            return self._batch_and_flags([])
        try:
            rows = rows or self._group.collected()
            while wait_all and self._group.pending:
                rows += self._group.collected(wait_all=True)
            while self._group.pending and (left := end - time.monotonic()) > 0:
                rows += self._within(left)
        except BaseException:
            self._group.keep(rows)
            raise
        self.throughput.record(
            "env_throughput_async", self._num_steps(row.batch_id for row in rows)
        )
        return self._batch_and_flags(rows)

    def _num_steps(self, ids: Any) -> int:
        return sum(self.id_to_num_envs[env_id] for env_id in ids)

    def _send(self, batch: Any) -> None:
        """Step the envs of `batch`, and reset those that the counter has at their limit."""
        for env_id in batch.ids():
            if env_id not in self.id_to_env:
                raise UnknownEnv(f"no env of this group has the id {env_id!r}; nothing was sent")
        counter = self.step_counter
        due: list[str] = []
        steps: list[tuple[str, Any]] = []
        for env_id, response in batch.items():
            if env_id not in self._local_ids:
                steps.append((env_id, self._group.for_client(env_id, response)))
            elif counter is not None and counter.is_reached_max_steps(env_id):
                due.append(env_id)
            else:
                steps.append((env_id, off_device(response)))
        # Steps come first: if they are refused, nothing was sent.
        if steps:
            self._group.send_steps(steps)
        self._group.send_resets(due)

    def _batch_and_flags(self, rows: list[ResultRow]) -> tuple[Any, list[bool]]:
        """Return the batch of `rows`, and a flag for each env at its limit."""
        batch = self._names.BatchedData([row.batch_id for row in rows], [row.ret for row in rows])
        return batch, [row.at_limit for row in rows]

    @contextlib.contextmanager
    def auto_reset(self, max_episode_steps: int | None = None) -> Generator[None]:
        """Reset an env instead of its next step once it is at the limit, and only then.

        Counts begin at -1, and each result counts, also that of a reset, so a limit of L gives a
        period of L + 1 calls.

        Args:
            max_episode_steps: the limit for all envs; None uses each env's own.

        Raises:
            ValueError: the limit isn't a positive int, or it is None and an env has none.
        """
        own: list[int | None] = self._group.call_all("of_env", "get_max_episode_steps", (), {})
        limits = _limits(own, max_episode_steps)
        self._group.begin_counting(EnvStepCounter(self._group.local_ids, limits))
        try:
            yield
        finally:
            self._group.counter = None

    # -- methods of the envs

    def results_within(self, seconds: float | None) -> tuple[Any, ...]:
        """Return results that arrive within `seconds`, for an env_server on its own."""
        return tuple(row.ret for row in self._within(seconds))

    def _within(self, seconds: float | None) -> list[ResultRow]:
        """Return the first results that arrive within `seconds`."""
        try:
            return self._group.collected(deadline=seconds)
        except EnvFault:
            raise  # Among them those of envs that raised `TimeoutError`.
        except TimeoutError:
            return []

    def offload(self) -> None:
        """Make every env free its device memory."""
        self._group.call_all("of_env", "offload", (), {})

    def reload(self) -> None:
        """Make every env allocate its device memory again."""
        self._group.call_all("of_env", "reload", (), {})

    def apply_evaluate_cfg(self) -> None:
        """Make every env apply its ``evaluate_cfg``."""
        self._group.call_all("of_env", "apply_evaluate_cfg", (), {})

    def restore_evaluate_cfg(self) -> None:
        """Make every env undo `apply_evaluate_cfg`."""
        self._group.call_all("of_env", "restore_evaluate_cfg", (), {})

    def close(self) -> None:
        """Close all envs and end their workers; idempotent."""
        self._group.close()

    # -- statistics

    def get_stats(self) -> dict[str, float]:
        """Return env steps per second of all groups: ``env_throughput_sync``, ``…_async``."""
        return self.throughput.get_stats()

    def get_env_stats(self, reset: bool = False) -> dict[str, float]:
        """Return the mean of each metric in ``info["episode_info"]``; `reset` clears them."""
        # Programs for RLightning may have put objects of their own into these lists.
        envs: list[Any] = [*self.env_list, *self.env_servers]
        total: dict[str, list[float]] = {}
        for env in envs:
            for name, (part, count) in env.get_env_stats(reset).items():
                sums = total.setdefault(name, [0.0, 0])
                sums[0] += part
                sums[1] += count
        for env in envs:
            env.finish_rollout()
        return {name: part / count for name, (part, count) in total.items() if count > 0}

    def print_timing_summary(self, reset: bool = False) -> None:
        """Print the group's timing, and make each env log its own."""
        self._group.print_timing_summary()
        self._group.call_all("of_env", "print_timing_summary", (reset,), {})


def _action_shape(meta: Any) -> tuple[int, ...] | None:
    """Return the action shape of one sub-environment, or None if the space has no shape."""
    shape = getattr(meta.action_space, "shape", None)
    return shape[1:] if shape is not None and meta.num_envs > 1 else shape


def _limits(own: list[int | None], given: int | None) -> list[int]:
    if given is None:
        if None in own:
            raise ValueError("an env has no max_episode_steps; pass one to auto_reset")
        return [limit for limit in own if limit is not None]
    if not isinstance(given, int) or given <= 0:  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"max_episode_steps must be a positive int, not {given!r}")
    if any(limit not in (None, given) for limit in own):
        warnings.warn(
            f"auto_reset(max_episode_steps={given}) overrides the envs' own limits", stacklevel=4
        )
    return [given] * len(own)


def build_env_group(env_cfgs: Any, preprocess_fn: Any = default_env_preprocess_fn) -> EnvGroup:
    """Build the configured envs and return their group.

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
