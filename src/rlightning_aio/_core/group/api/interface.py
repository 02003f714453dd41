"""The waiting methods of groups and handles, documented once for both kinds.

`aio` defines them as coroutines and `sync` as plain methods; those whose result has no type of its
own are written here, for both, as only their drivers wait. A method returns when the replies are
there; "cancelled" below means a cancelled task, or Ctrl-C in a synchronous program.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any, TypeVar

from rlightning_aio._core.group.api.facade import Facade

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rlightning_aio._core.hosts.base import Server
    from rlightning_aio.batch import BatchedData
    from rlightning_aio.types import PolicyResponse

E = TypeVar("E", bound="EnvHandleInterface")


class GroupInterface(Facade):
    """The waiting methods of a group."""

    # Runs a procedure: returns its result in a synchronous group, else an awaitable.
    _driver: Any

    def init(self) -> Any:
        """Start all worker processes in parallel, and build their envs.

        Returns one `EnvMeta` for each env, in the order of `env_ids`. It doesn't wait for clients:
        the place of one has no spaces yet. If it fails or is cancelled, nothing is left running.

        Raises:
            StartFailed: an env could not be built, or took longer than ``start_timeout``.
            ConfigError: the envs' action spaces have different shapes (a `ValueError`).
            GroupClosed: the group was closed before.
            RLightningError: another event loop has initialised the group, or another call is
                starting it.
        """
        raise NotImplementedError

    def reset(
        self,
        seed: int | Sequence[int] | Mapping[str, int] | None = None,
        options: dict[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> Any:
        """Start a new episode in all envs, or in those of `env_ids`, and wait for all of them.

        Without `env_ids` it always works: what is still in flight, after Ctrl-C, a cancellation or
        an error, is awaited within its time limits and dropped, and so are errors that nobody has
        collected; only what another call waits for is not.

        Args:
            seed: env k of the group gets ``seed + k`` (k counts sub-environments); a sequence
                gives one seed for each env, a mapping seeds by id.
            options: a dict, passed to each env.
            env_ids: the envs to reset; the results have this order. None: all, after waiting until
                every place of an env_server has a client.

        Returns the first observations, in fresh arrays (views, if the group was built with
        ``zero_copy``), and a list of flags that are all False. Cancelled, it leaves the results
        to `collect_async`.

        Raises:
            EnvBusy: one of `env_ids` has a reply outstanding, or appears twice; or another call
                waits for an env. Nothing was sent.
            UnknownEnv: no env of this group has that id.
            ValueError: a seed is not an int from 0 to 2**62 - 1, or of an env that is not reset, or
                there isn't one for each env.
            TypeError: the options are no dict, or can't be sent to a worker or a client; or
                `env_ids` is one str.
            EnvRaised, WorkerDied, EnvHung, EnvAway: an env failed, or no client has dialled in for
                it; the others' results are in the error's ``results``.
            GroupClosed: the group was not initialised, or is closed.
        """
        raise NotImplementedError

    def step(self, batch: BatchedData) -> Any:
        """Step the envs of `batch` and wait for all of them.

        Args:
            batch: a batch of responses, from `BatchedData.respond` (columns, fast) or made of
                `PolicyResponse` values; any of the envs, in any order.

        Returns results with the same ids in the same order, in fresh arrays (views, if the
        group was built with ``zero_copy``), and None; inside `auto_reset` a flag for each
        result instead of None. Cancelled, it leaves the results to `collect_async`.

        Raises:
            BadAction: an action's shape, dtype or count doesn't fit; it holds NaN, a number that
                its dtype can't hold, or infinity where its space is bounded; or this is not a
                batch. Nothing was sent.
            EnvBusy: an env has a reply outstanding, or appears twice; nothing was sent.
            UnknownEnv: no env of this group has that id.
            EnvRaised, EnvAway, WorkerDied, EnvHung: an env failed; the others' results are in the
                error's ``results``.
            ResetNeeded: the env of an env_server was never reset; nothing was sent.
            GroupClosed: the group was not initialised, or is closed.
        """
        raise NotImplementedError

    def collect_async(
        self,
        timeout: float | None = None,
        wait_all: bool = False,
        min_results: int = 1,
        max_results: int | None = None,
        deadline: float | None = None,
    ) -> Any:
        """Wait for results of `step_async`; never returns an empty batch.

        In a synchronous group the method has the same name and blocks.

        Args:
            timeout: seconds of a further window, opened when the first result is ready, in
                which more results join.
            wait_all: wait for all pending results; ignores `timeout`, with a warning.
            min_results: return when this many are ready, or all that are pending.
            max_results: leave results above this number to the next call, first come, first
                served.
            deadline: limit in seconds, from now.

        Returns results in the group's order, in fresh arrays (views, if the group was built with
        ``zero_copy``), and a flag for each: inside `auto_reset` True where the result reached the
        step limit, as in `BatchedData.limit_reached`. Cancelled, it loses no result.

        Raises:
            NothingPending: no request is outstanding.
            ValueError: a time isn't above 0, a number isn't above 0, or `min_results` is above
                `max_results`.
            TimeoutError: `deadline` has passed; the next call returns the results.
            EnvRaised: the answer to the request of its `env_id`; results and errors of others stay
                for the next call.
            WorkerDied, EnvHung: the answer to the requests of all its `env_ids`; likewise.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another call is collecting.
        """
        raise NotImplementedError

    def abort(self, env_ids: Sequence[str] | None = None) -> Any:
        """End what envs are doing, and drop its results; the envs are free when this returns.

        Args:
            env_ids: the envs; None: all. Idle ones are left as they are.

        Within a second, whatever an env does: an awaitable env's step is cancelled, and the env is
        closed and rebuilt. An env of a worker or a Ray actor may end its step within 0.2 seconds;
        then its worker is killed and replaced, which costs other envs in it their episodes, as
        any death does (`on_worker_death` and `max_restarts` don't count this one). So is a client,
        which may come back with a new session. Only in this process
        nothing can end a step that has begun; those that haven't are withdrawn.

        The episodes are over: reset the envs, or step them, which resets them first and marks the
        result as after a restart. Robots move only when they are reset. Another call that waits
        for one of the envs raises `EpisodeLost`; `collect_async` waits for the rest. Errors that
        were not collected stay for the next collect. Cancelled, it ends the requests all the same.

        Raises:
            UnknownEnv: no env of this group has that id.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self._driver.run(self._core.abort(time.monotonic(), env_ids))

    def drain(self, deadline: float | None = None) -> Any:
        """Wait for all that is in flight, and return it as one batch.

        Args:
            deadline: seconds. What has not ended by then is aborted, as by `abort`, also requests
                that other calls wait for; None waits for the results of `step_async` and
                `reset_async`, however long they take, and aborts nothing.

        Afterwards no env owes anything, which makes this the way to a checkpoint.

        Returns results and a flag for each, as `collect_async` does, in the order of the group;
        an empty batch if there are none. Cancelled, it loses no result that was ready.

        Raises:
            ValueError: `deadline` isn't above 0.
            EnvRaised, WorkerDied, EnvHung: an error that waited to be collected, once all envs are
                idle; the results are in its ``results``, further errors in ``others``.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another call is collecting.
        """
        raise NotImplementedError

    def call(
        self, name: str, /, *args: Any, env_ids: Sequence[str] | None = None, **kwargs: Any
    ) -> Any:
        """Call method `name` of envs in parallel, as `EnvHandle.call` does of one.

        Args:
            name: of a method of each env or of its simulator's wrappers, outermost first;
                ``get_attr`` and ``set_attr`` read and set an attribute.
            args: of the method.
            env_ids: the envs; None for all.
            kwargs: of the method.

        Returns a list with the value of each env, in the order of `env_ids`: copies from a worker,
        the objects themselves from an inline env. Cancelled, it lets the methods end on their own
        and drops the values.

        Raises:
            EnvRaised: a method raised, or its value can't be pickled; further errors are in
                ``others``, and the values of the others are gone.
            EnvBusy: an env has a reply outstanding, or appears twice; nothing was sent.
            UnknownEnv: no env of this group has that id; nothing was sent.
            TypeError: the arguments can't be sent to a worker; nothing was sent.
            NotImplementedError: an env belongs to a client; its methods can't be called.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat the call.
            GroupClosed: the group was not initialised, or is closed.
            RLightningError: another thread is using the group, or it belongs to another loop.
        """
        return self.call_with(name, args, kwargs, env_ids)

    def call_with(
        self,
        name: str,
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
        env_ids: Sequence[str] | None = None,
    ) -> Any:
        """Call method `name` of envs as `call` does, also one with an argument ``env_ids``."""
        asked = name, tuple(args), dict(kwargs or {})
        return self._driver.run(self._core.calls.call(time.monotonic(), env_ids, asked))

    def snapshot(self, env_ids: Sequence[str] | None = None) -> Any:
        """Return the complete state of envs as bytes that can be stored.

        Args:
            env_ids: the envs, all idle and reset before; None: all.

        The bytes hold the state of simulators, wrappers and generators, the sums of the current
        episodes, the step counts of `auto_reset`, and which envs are due for a reset;
        docs/state.md says what they leave out. `restore` takes them in this group or another, in
        this process or another.

        Raises:
            EnvBusy: an env has a reply outstanding; nothing was sent.
            UnknownEnv: no env of this group has that id.
            SnapshotError: an env moves something real, was never reset, or has lost its episode.
            NotImplementedError: an env is a client's.
            EnvRaised: an env can't give its state; the message says why.
            WorkerDied, EnvHung: a worker ended meanwhile.
            GroupClosed: the group was not initialised, or is closed.
        """
        raise NotImplementedError

    def restore(
        self, snapshot: bytes, env_ids: Sequence[str] | None = None, source: str | None = None
    ) -> Any:
        """Reset envs to the states of a snapshot.

        Args:
            snapshot: bytes that `snapshot` returned. They hold pickles, which can make a worker
                execute anything: use only what you have written yourself.
            env_ids: the envs to restore, all idle, in the order of the snapshot's. Any env of an
                equal entry will do. None: all envs, whose ids must be the snapshot's; with
                `source`, all envs of its entry.
            source: the id of one env of the snapshot, whose state all of `env_ids` get. So one
                state is branched into many, which go on alike until their actions differ.

        Returns the envs' last observations at the time of the snapshot, and flags that are all
        False, as `reset` does: with `is_reset`, because no transition ends here, and without
        reward. Cancelled, it leaves these results to `collect_async`.

        Raises:
            SnapshotError: the bytes are damaged, or of another number of envs, another task or
                other options, or an env moves something real; nothing was changed.
            EnvBusy: an env has a reply outstanding; nothing was sent.
            UnknownEnv: no env of this group has that id.
            NotImplementedError: an env is a client's.
            EnvRaised, WorkerDied, EnvHung: an env could not be restored, perhaps because it has
                another version of a library. It has lost its episode, so its next request is a
                reset. The others are restored: their results are in the error's ``results``.
            GroupClosed: the group was not initialised, or is closed.
        """
        raise NotImplementedError

    def __getitem__(self, env_id: str) -> Any:
        """Return a handle on one env (`EnvHandle`), or on one env_server (`ServerHandle`).

        Raises:
            UnknownEnv: the group has neither of that id.
        """
        raise NotImplementedError

    def _handle(self, env_id: str, of_env: type[E]) -> Any:
        for server in self._core.supervisor.places.servers:
            if server.server_id == env_id:
                return ServerHandle(server)
        self._core.envs.find_one(env_id)
        return of_env(self, env_id)

    @property
    def _local_ids(self) -> list[str]:
        envs = self._core.envs
        return list(envs.env_ids[: envs.num_local])

    def offload(self) -> Any:
        """Free the device memory of every local env until `reload`.

        Cancelled, it leaves the envs to free it on their own.

        Raises:
            EnvBusy: an env has a reply outstanding; nothing was sent.
            EnvRaised: an env can't, or failed to; further errors are in ``others``.
            WorkerDied, EnvHung: a worker ended meanwhile; a replacement does not repeat it.
            GroupClosed: the group was not initialised, or is closed.
        """
        return self.call("offload", env_ids=self._local_ids)

    def reload(self) -> Any:
        """Allocate the device memory of every local env again; errors are those of `offload`."""
        return self.call("reload", env_ids=self._local_ids)

    def close(self) -> Any:
        """Close all envs and end their workers, by force after the ``close_timeout`` of
        their entry.

        Idempotent; while another task closes the group, it waits for that. Calls that wait get
        `GroupClosed`, and results that were not collected are gone. Cancelled, it ends the
        remaining workers by force. A warning names an env that raises in its own `close`, and the
        log names those that were not closed in time. A signal handler may close a synchronous
        group; the call that it interrupts raises `GroupClosed`.

        Raises:
            RLightningError: the loop that the group belongs to runs in another thread.
        """
        raise NotImplementedError


class EnvHandleInterface:
    """The methods of a handle on one env."""

    def __init__(self, group: Any, env_id: str) -> None:
        self._group = group
        self._env_id = env_id

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._env_id!r})"

    @property
    def env_id(self) -> str:
        """Id of the env, as in `EnvGroup.env_ids`."""
        return self._env_id

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start a new episode and wait for its first observation.

        Args:
            seed: of the env; sub-environment k gets ``seed + k``.
            options: passed to the env.

        Returns the result as a value, with arrays like those of `EnvGroup.reset`. Cancelled, it
        leaves the result to the group's `collect_async`. Errors are those of `EnvGroup.reset`.
        """
        raise NotImplementedError

    def step(self, response: PolicyResponse | Any) -> Any:
        """Step with a `PolicyResponse`, or with a bare action, and wait for the result.

        Returns the result as a value, inside `auto_reset` that of a reset if one is due, with
        arrays like those of `EnvGroup.step`. Cancelled, it leaves the result to the group's
        `collect_async`. Errors are those of `EnvGroup.step`.
        """
        raise NotImplementedError

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env, or of the first of its simulator's wrappers that has
        it, from the outermost to the simulator.

        Returns its value: a copy from a worker, the object itself from an inline env. Cancelled,
        it lets the method end on its own and drops the value.

        Raises:
            EnvRaised: the method raised, or its value can't be pickled.
            EnvBusy: the env has a reply outstanding; nothing was sent.
            TypeError: the arguments can't be sent to a worker; nothing was sent.
            WorkerDied, EnvHung: the worker ended meanwhile; a replacement does not repeat it.
            NotImplementedError: the env is a client's; nothing was sent.
            GroupClosed: the group was not initialised, or is closed.
        """
        raise NotImplementedError

    def get_attr(self, name: str) -> Any:
        """Return attribute `name` of the first that has it: the env, its simulator's wrappers from
        the outermost in, the simulator; values and errors are those of `call`.
        """
        return self.call("get_attr", name)

    def set_attr(self, name: str, value: Any) -> Any:
        """Set attribute `name` where `get_attr` finds it, or else of the simulator; errors are
        those of `call`.
        """
        return self.call("set_attr", name, value)

    def render(self) -> Any:
        """Return one frame as the simulator renders it; errors are those of `call`."""
        return self.call("render")

    def offload(self) -> Any:
        """Free the env's device memory until `reload`; errors are those of `call`."""
        return self.call("offload")

    def reload(self) -> Any:
        """Allocate the env's device memory again; errors are those of `call`."""
        return self.call("reload")


class ServerHandle:
    """One env_server of a group; its places are envs with handles of their own."""

    def __init__(self, server: Server) -> None:
        self._server = server

    @property
    def address(self) -> str:
        """Address that clients connect to, as ``tcp://host:port`` with the port in use.

        Raises:
            RuntimeError: it does not listen yet, before `init`.
        """
        return self._server.address()

    @property
    def clients(self) -> dict[str, str]:
        """Names of the clients that are there, by the ids of their envs."""
        return self._server.sessions.clients()
