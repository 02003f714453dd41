"""RLightning's `EnvGroup` over the public synchronous group of rlightning_aio.

Rule: RLightning's behaviour is reproduced in this package: ids, the arguments of a reset, what
`auto_reset` resets, requests to an env that still owes a result, what an empty collect returns. Our
own group does not know of it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from rlightning_aio import BatchedData, PolicyResponse
from rlightning_aio.errors import EnvFault, UnknownEnv, WorkerDied
from rlightning_aio.plugins.legacy.config import EnvConfig
from rlightning_aio.plugins.legacy.env import default_env_preprocess_fn
from rlightning_aio.plugins.legacy.hosted import ARGUMENTS, SERVER, entries_of, off_device
from rlightning_aio.plugins.legacy.names import named
from rlightning_aio.sync import build_env_group as build_our_group
from rlightning_aio.trees import as_numpy

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable, Sequence

    import gymnasium as gym

_PATIENCE_SECONDS: Final = 60.0
"""How long a reset waits for a call of a method that was interrupted."""
_log = logging.getLogger(__name__)


class _Row(NamedTuple):
    """A result.

    Attributes:
        batch_id: its id in batches; of a client's result, that of the env_server.
        ret: RLightning's `EnvRet`.
        at_limit: with it the episode has reached its limit of steps.
    """

    batch_id: str
    ret: Any
    at_limit: bool = False


class EnvGroup:
    """RLightning's group, whose envs live in worker processes.

    Args:
        env_cfg_list: one `EnvConfig` for each env.
        preprocess_fn: one for all envs, or a list with one for each.

    Attributes:
        env_list, env_servers: handles on the local envs and on the env_servers.
        env_ids: the ids of both.
        step_counter: an `EnvStepCounter` inside `auto_reset`, None outside.
    """

    def __init__(
        self,
        env_cfg_list: Sequence[Any],
        preprocess_fn: Callable[[Any], Any] | list[Any] | None = default_env_preprocess_fn,
    ) -> None:
        if not env_cfg_list:
            raise ValueError("a group needs at least one config")
        fns = _listed(preprocess_fn, len(env_cfg_list))
        if len(fns) != len(env_cfg_list):
            raise ValueError(f"{len(fns)} preprocess functions for {len(env_cfg_list)} envs")
        entries = entries_of(env_cfg_list, fns)
        self._group = build_our_group([entry for entry, _ in entries], mixed_actions=True)
        self._group.init()
        # There, a step after an end is nothing unusual.
        self._group.auto_reset(math.inf, on_done=False).__enter__()
        self.env_ids = [env_id for _, ids in entries for env_id in ids]
        core_ids = [f"{entry.name}-{k}" for entry, ids in entries for k in range(len(ids))]
        self._id_of = dict(zip(core_ids, self.env_ids, strict=True))
        self._core_id_of = dict(zip(self.env_ids, core_ids, strict=True))
        num_local = sum(len(ids) for entry, ids in entries if entry.backend != SERVER)
        self._local, self._servers = core_ids[:num_local], core_ids[num_local:]
        # Clients come and go, so there are places to spare, which whoever dials in takes.
        self._places = _places_of(self._group.env_ids, self._servers)
        self._id_of |= {
            place: f"{self._id_of[server_id]}/{place.rpartition('/')[2]}"
            for place, server_id in self._places.items()
        }
        if self._places:
            self._group.reset_async(env_ids=list(self._places))
        self.env_list = [EnvHandle(self, env_id) for env_id in self.env_ids[:num_local]]
        self.env_servers = [
            ServerHandle(self._group[one], self._id_of[one]) for one in self._servers
        ]
        self._env_of = dict(zip(self.env_ids, [*self.env_list, *self.env_servers], strict=True))
        self.step_counter: EnvStepCounter | None = None
        # Results that came before `collect_async` has asked for them.
        self._kept: list[_Row] = []
        self._num_steps = {"sync": 0, "async": 0}
        self._began = time.monotonic()

    # -- contents

    def init(self) -> list[Any]:
        """Call each local env's ``init`` and return the values.

        Raises:
            ValueError: shapes of action spaces differ, not counting the axis of sub-environments.
        """
        metas = self.call_all("init")
        shapes = {meta.env_id: _action_shape(meta) for meta in metas}
        if len({shape for shape in shapes.values() if shape is not None}) > 1:
            raise ValueError(f"all envs of a group need actions of one shape, not {shapes}")
        return metas

    def __len__(self) -> int:
        """Return the number of local envs and env_servers."""
        return len(self.env_list) + len(self.env_servers)

    def size(self) -> int:
        """Return the number of local envs."""
        return len(self.env_list)

    def __getitem__(self, env_id: str) -> EnvHandle | ServerHandle:
        return self._env_of[env_id]

    def get_observation_spaces(self) -> list[gym.Space[Any]]:
        """Return the observation spaces of the local envs."""
        return self.call_all("get_observation_space")

    def get_action_spaces(self) -> list[gym.Space[Any]]:
        """Return the action spaces of the local envs."""
        return self.call_all("get_action_space")

    # -- resets and steps

    def reset(self, *args: Any, **kwargs: Any) -> tuple[Any, list[bool]]:
        """Reset every env with exactly these arguments. Return results in the group's order.

        What local envs still owe, as after Ctrl-C, is awaited and dropped. Clients of env_servers
        get only `seed` and `options`; this waits for the first of them.
        """
        while self._local_pending():
            with contextlib.suppress(EnvFault):
                self._await(self._local)
        with contextlib.suppress(EnvFault):
            if not self._servers:  # A call that Ctrl-C has left may still run.
                self._group.drain(deadline=_PATIENCE_SECONDS)
        self._kept = [row for row in self._kept if self._core_id_of[row.batch_id] in self._servers]
        rows: list[_Row] = []
        with self._own_ids(rows):
            if self._local:
                options = {ARGUMENTS: (args, kwargs)} if args or kwargs else None
                rows += self._rows(self._group.reset(options=options, env_ids=self._local)[0])
            self._add_first_results(rows, kwargs.get("seed"), kwargs.get("options"))
        return _batch_and_flags(rows)

    def step(self, batched_policy_resp: Any) -> tuple[Any, list[bool] | None]:
        """Step the envs of a batch and wait for them. Return the results in the batch's order.

        Inside `auto_reset`, the second value has a flag for each env that reached its limit;
        outside it is None. An error has the results of the other envs as `results`.
        """
        ids = batched_policy_resp.ids()
        for env_id in ids:
            if self._core_id_of.get(env_id) in self._servers:
                raise NotImplementedError(
                    f"{env_id} is an env_server; use step_async and collect_async"
                )
        steps, due = self._requests(batched_policy_resp)
        rows: list[_Row] = []
        with self._own_ids(rows):
            if steps is not None:
                rows += self._rows(self._group.step(steps)[0])
            if due:
                rows += self._rows(self._group.reset(env_ids=due)[0])
        self._num_steps["sync"] += len(rows)
        if due:
            places = {env_id: place for place, env_id in enumerate(ids)}
            rows.sort(key=lambda row: places[row.batch_id])
        batch, flags = _batch_and_flags(rows)
        return batch, None if self.step_counter is None else flags

    def step_async(self, batched_policy_resp: Any) -> None:
        """Send a step to the envs of a batch; `collect_async` returns the results."""
        steps, due = self._requests(batched_policy_resp)
        # Steps come first: if they are refused, nothing was sent.
        if steps is not None:
            self._group.step_async(steps)
        if due:
            self._group.reset_async(env_ids=due)

    def collect_async(
        self, timeout: float | None = None, wait_all: bool = False
    ) -> tuple[Any, list[bool]]:
        """Wait for results of `step_async`, and return those that are ready with the first.

        Args:
            timeout: seconds after the first result during which more may join it.
            wait_all: wait for all results.

        If nothing was sent, return an empty batch and log a warning.
        """
        if timeout is not None and timeout <= 0:
            raise ValueError(f"timeout must be a positive number of seconds, not {timeout!r}")
        rows, in_flight = self._kept, bool(self._group.pending)
        if not rows or (wait_all and in_flight):
            if not in_flight:
                _log.warning("collect_async: nothing was sent, so there is nothing to collect")
                return _batch_and_flags([])
            how: dict[str, Any] = {"timeout": timeout, "wait_all": wait_all and in_flight}
            if wait_all and self._places:  # Nobody may ever take the places to spare.
                how = {"min_results": max(1, len(_owing(self._group)))}
            rows = [*rows, *self._collected(**how)]
        self._kept = []
        self._num_steps["async"] += len(rows)
        return _batch_and_flags(rows)

    def _requests(self, batch: Any) -> tuple[BatchedData | None, list[str]]:
        """Return the steps of a batch, and the envs that the counter has at their limit instead.

        Envs that still owe a result are awaited.
        """
        counter, due, owing = self.step_counter, list[str](), self._local_pending()
        steps: list[tuple[str, PolicyResponse]] = []
        for env_id, response in batch.items():
            core_id = self._core_id_of.get(env_id)
            if core_id is None:
                raise UnknownEnv(f"no env of this group has the id {env_id!r}; nothing was sent")
            if core_id in self._servers:
                client = _for_client(core_id, response)
                steps.append((client.env_id, client))
                continue
            if core_id in owing:
                self._await([core_id])
            if counter is not None and counter.is_reached_max_steps(env_id):
                due.append(core_id)
            else:
                steps.append((core_id, PolicyResponse(core_id, off_device(response))))
        ids, responses = [core_id for core_id, _ in steps], [response for _, response in steps]
        return (BatchedData(ids, responses) if steps else None), due

    # -- results

    def _add_first_results(self, rows: list[_Row], seed: Any, options: Any) -> None:
        """Reset clients, and wait for the first of those that are there, or that come."""
        if not self._places:
            return
        pending = set(self._group.pending)
        if idle := [place for place in self._places if place not in pending]:
            self._group.reset_async(seed=seed, options=options, env_ids=idle)
        num_local = len(rows)
        rows += self._kept
        self._kept = []
        while len(rows) == num_local or _owing(self._group).intersection(idle):
            rows += self._rows(self._group.collect_async()[0])

    def _local_pending(self) -> set[str]:
        return set(self._group.pending).intersection(self._local)

    def _await(self, core_ids: Iterable[str]) -> None:
        """Wait for what envs owe, and keep it for `collect_async`."""
        while not self._local_pending().isdisjoint(core_ids):
            self._kept += self._collected()

    def _collected(self, **how: Any) -> list[_Row]:
        with self._own_ids([]):
            return self._rows(self._group.collect_async(**how)[0])

    def _rows(self, batch: BatchedData) -> list[_Row]:
        """Translate results of our group, and count them."""
        restarted, is_reset = batch.restarted.tolist(), batch.is_reset.tolist()
        ours = batch.values() if self._servers else []  # They cost more than their columns.
        rets: Any = [one.observation for one in ours] if self._servers else batch.observation
        rows: list[_Row] = []
        for k, (core_id, ret) in enumerate(zip(batch.ids(), rets, strict=True)):
            if core_id in self._places:
                rows.append(self._row_of_client(core_id, ours[k]))
                continue
            if restarted[k]:
                info = {**ret.info, **batch.info()[k]}
                ret = dataclasses.replace(ret, last_truncated=True, info=info)  # noqa: PLW2901
            env_id, counter = self._id_of[core_id], self.step_counter
            at_limit = counter is not None and counter.count(env_id, is_reset=is_reset[k])
            rows.append(_Row(env_id, ret, at_limit))
        return rows

    def _row_of_client(self, core_id: str, ours: Any) -> _Row:
        env_id = self._id_of[ours.env_id]
        fields: dict[str, Any] = {**vars(ours), "env_id": env_id, "_extra": ours._extra}
        return _Row(self._id_of[self._places[core_id]], named("EnvRet")(**fields))

    @contextlib.contextmanager
    def _own_ids(self, rows: list[_Row]) -> Generator[None]:
        """Name envs in errors by RLightning's ids; their results are `rows` and their own."""
        try:
            yield
        except EnvFault as fault:
            if fault.results is not None:
                rows += self._rows(fault.results)
            fault.results = _batch_and_flags(rows)[0] if rows else None
            for one in (fault, *fault.others):
                one.env_id = self._id_of[one.env_id]
                if isinstance(one, WorkerDied):
                    one.env_ids = tuple(map(self._id_of.__getitem__, one.env_ids))
            raise

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
        limits = _limits(self.call_all("get_max_episode_steps"), max_episode_steps)
        self.step_counter = EnvStepCounter([self._id_of[one] for one in self._local], limits)
        try:
            yield
        finally:
            self.step_counter = None

    # -- methods of the envs

    def call_all(self, name: str) -> list[Any]:
        """Call a method of all local envs at once. Return the values in the group's order."""
        if not self._local:
            return []
        self._await(self._local)
        with self._own_ids([]):
            return self._group.call("of_env", name, (), {}, env_ids=self._local)

    def call_env(self, env_id: str, name: str, *args: Any) -> Any:
        """Call a method of our env around a local env."""
        core_id = self._core_id_of[env_id]
        self._await([core_id])
        with self._own_ids([]):
            return self._group[core_id].call(name, *args)

    def offload(self) -> None:
        """Make every env free its device memory."""
        self.call_all("offload")

    def reload(self) -> None:
        """Make every env allocate its device memory again."""
        self.call_all("reload")

    def apply_evaluate_cfg(self) -> None:
        """Make every env apply its ``evaluate_cfg``."""
        self.call_all("apply_evaluate_cfg")

    def restore_evaluate_cfg(self) -> None:
        """Make every env undo `apply_evaluate_cfg`."""
        self.call_all("restore_evaluate_cfg")

    def close(self) -> None:
        """Close all envs and end their workers; idempotent."""
        self._group.close()

    # -- statistics

    def get_stats(self) -> dict[str, float]:
        """Return results per second since the group was built, of `step` and of `collect_async`."""
        seconds = time.monotonic() - self._began
        return {f"env_throughput_{how}": n / seconds for how, n in self._num_steps.items() if n}

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
        """Print the group's timing."""
        del reset  # Of RLightning's timers of methods.
        self._group.print_timing_summary()


class EnvStepCounter:
    """Steps of each env's episode: -1 before the first reset, 0 after it.

    Args:
        env_ids: of all envs.
        max_steps_list: the limit of each.
    """

    def __init__(self, env_ids: Sequence[str], max_steps_list: Sequence[int]) -> None:
        self._limits = dict(zip(env_ids, max_steps_list, strict=True))
        self._steps = dict.fromkeys(env_ids, -1)

    def count(self, env_id: str, *, is_reset: bool) -> bool:
        """Count one result of an env, at most to its limit; return True if that is reached."""
        if is_reset:
            self._steps[env_id] = -1
        if not self.is_reached_max_steps(env_id):
            self._steps[env_id] += 1
        return self.is_reached_max_steps(env_id)

    def __getitem__(self, env_id: str) -> int:
        """Return the count of an env."""
        return self._steps[env_id]

    def is_reached_max_steps(self, env_id: str) -> bool:
        """Return True if an env has reached its limit."""
        return self._steps[env_id] == self._limits[env_id]


class EnvHandle:
    """A handle on an env: its methods are called, and its attributes read, in its worker."""

    def __init__(self, group: EnvGroup, env_id: str) -> None:
        self._group = group
        self._env_id = env_id

    def __getattr__(self, name: str) -> Any:
        # `copy` and `pickle` look for special methods, which must not be found in the worker.
        if name.startswith("__") or "_group" not in vars(self):
            raise AttributeError(name)
        is_method, value = self._group.call_env(self._env_id, "look", name)
        if not is_method:
            return value

        def method(*args: Any, **kwargs: Any) -> Any:
            return self._group.call_env(self._env_id, "of_env", name, args, kwargs)

        return method


class ServerHandle:
    """A handle on an env_server, without access to its clients' envs."""

    def __init__(self, ours: Any, env_id: str) -> None:
        self._ours = ours
        self.env_id = env_id

    def get_address_port(self) -> tuple[str, int]:
        """Return the host and port for clients."""
        host, _, port = self._ours.address.removeprefix("tcp://").rpartition(":")
        return host, int(port)

    def get_env_stats(self, reset: bool = False) -> dict[str, list[float]]:
        """Return no statistics: clients keep their own."""
        del reset
        return {}

    def finish_rollout(self) -> None:
        """Do nothing."""


def _places_of(env_ids: Sequence[str], servers: Sequence[str]) -> dict[str, str]:
    """Return the env_server of each place."""
    found = {env_id: env_id.rpartition("/")[0] for env_id in env_ids}
    return {place: server_id for place, server_id in found.items() if server_id in servers}


def _owing(group: Any) -> set[str]:
    """Return the ids of what owes a result and is there."""
    empty = [worker["env_ids"] for worker in group.get_workers() if worker["state"] == "empty"]
    return set(group.pending).difference(*empty)


def _for_client(core_id: str, response: Any) -> PolicyResponse:
    """Return `response` with arrays for tensors, addressed to our client."""
    data = {name: as_numpy(value) for name, value in response.to_dict().items()}
    return PolicyResponse(f"{core_id}/{response.env_id.rpartition('/')[2]}", **data)


def _batch_and_flags(rows: list[_Row]) -> tuple[Any, list[bool]]:
    """Return the batch of `rows`, and a flag for each env at its limit."""
    batch = named("BatchedData")([row.batch_id for row in rows], [row.ret for row in rows])
    return batch, [row.at_limit for row in rows]


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
    return [given] * len(own)


def build_env_group(env_cfgs: Any, preprocess_fn: Any = default_env_preprocess_fn) -> EnvGroup:
    """Build the configured envs and return their group.

    Args:
        env_cfgs: one `EnvConfig` or mapping, or a list of them; each makes ``num_workers`` envs.
        preprocess_fn: one for all, or a list with one for each config.
    """
    given = _listed(env_cfgs, 1)
    configs = [one if hasattr(one, "backend") else EnvConfig.from_dict(one) for one in given]
    copies: list[Any] = []
    own_fns: list[Any] = []
    for config, fn in zip(configs, _listed(preprocess_fn, len(configs)), strict=True):
        # Copied, so that a config that is given twice makes two entries.
        copies += [config.model_copy(deep=True)] * config.num_workers
        own_fns += [fn] * config.num_workers
    return EnvGroup(copies, own_fns)


def _listed(value: Any, count: int) -> list[Any]:
    """Return `value` if it is a list, else a list that repeats it."""
    return cast("list[Any]", value) if isinstance(value, list) else [value] * count
