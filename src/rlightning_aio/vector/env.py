"""`VectorEnv`: a group of envs behind Gymnasium's vector interface."""

from __future__ import annotations

import copy as copying
import math
import multiprocessing
import warnings
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, utils

from rlightning_aio._core.group.episodes.continuity import as_int
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.contents import reported_infos
from rlightning_aio.calling import collect_calls, in_one_call
from rlightning_aio.envs.adapted.makers import adapted
from rlightning_aio.errors import BadAction, EnvFault, SnapshotError
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.batching import batched, merged, spread
from rlightning_aio.vector.deaths import Deaths, Stepped
from rlightning_aio.vector.leftovers import drop_outstanding
from rlightning_aio.vector.pending import check_free, check_running, check_sent
from rlightning_aio.vector.proxies import CalledEnvs, check_name
from rlightning_aio.vector.requests import (
    send_call,
    send_look_up,
    send_resets,
    send_values,
    send_wrapper_question,
)
from rlightning_aio.vector.reset_arguments import checked_mask, checked_mode, seeds_of_envs
from rlightning_aio.vector.spaces import adopted_spaces

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.types import EnvMeta

__all__ = ["VectorEnv", "per_worker"]

T = TypeVar("T")


class VectorEnv(  # pyright: ignore[reportIncompatibleMethodOverride]  # `np_random` is a tuple.
    CalledEnvs, gym.vector.VectorEnv[Any, Any, Any]
):
    """Envs in worker processes behind Gymnasium's vector interface.

    Args:
        env_fns: one callable for each env. They are called only in the workers; lambdas and
            functions of ``__main__`` are allowed.
        shared_memory: accepted and ignored.
        copy: return observations that the caller owns. False saves a copy, but writing to them
            changes what a later masked reset returns for envs that it doesn't reset.
        context: accepted and ignored.
        daemon: accepted and ignored.
        worker: must be None; there is no worker function to replace.
        observation_mode: ``same``, ``different`` (equal shapes and dtypes), or a pair of the
            batched and the single observation space.
        autoreset_mode: when an env is reset after the end of its episode.
        max_concurrency: maximum number of workers, each executing one env at a time. None: one for
            each env, up to eight for each core that this process may use; of tasks that are known
            to compute (`make_vec`), one for each core.
        entry: further fields of `EnvConfig` (``step_timeout``, ``on_worker_death``, …).

    Attributes:
        group: the `EnvGroup` that runs the envs ``env-0``, ``env-1``, …, one for each callable.

    Raises:
        ConfigError: a callable can't be sent to a worker, or `entry` is wrong.
        StartFailed: a callable raised, or didn't return an env.
        RuntimeError: the spaces don't match.
        TypeError: `env_fns` is no list of callables.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any]]],
        shared_memory: bool = True,
        copy: bool = True,
        context: str | None = None,
        daemon: bool = True,
        worker: None = None,
        observation_mode: str | tuple[gym.Space[Any], gym.Space[Any]] = "same",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_concurrency: int | None = None,
        **entry: Any,
    ) -> None:
        # Annotated here because Gymnasium doesn't say what its spaces hold.
        self.observation_space: gym.Space[Any]
        self.action_space: gym.Space[Any]
        self.single_observation_space: gym.Space[Any]
        self.single_action_space: gym.Space[Any]
        del shared_memory, context, daemon
        if worker is not None:
            raise ValueError(
                "worker: the workers of rlightning_aio can't be replaced; see EnvGroup"
            )
        self.env_fns = env_fns
        self.copy = copy
        self.observation_mode = observation_mode
        self.autoreset_mode = checked_mode(autoreset_mode)
        self.closed = True  # Until it has started.
        self._pending: str | None = None
        self._arguments: Any = None
        # Requests are outstanding whose results nobody will return.
        self._has_leftovers = False
        # Results of a step or reset were not returned, so no episode can go on.
        self._has_lost = False
        # What a state is of, besides the envs of the group.
        limit = entry.get("max_episode_steps")
        self._kind = {"autoreset_mode": self.autoreset_mode.value, "max_episode_steps": limit}
        config = adapted(env_fns, self.autoreset_mode, entry)
        if max_concurrency is not None:
            together = per_worker(max_concurrency, len(env_fns))
            config = {"envs_per_process": together, **config}
        self.group: EnvGroup = build_env_group(config, mixed_actions=True)
        metas = self.group.init()
        self.closed = False
        try:
            self._adopt(metas)
        except BaseException:
            self.close()
            raise

    def _adopt(self, metas: list[EnvMeta]) -> None:
        """Set up what depends on the envs: spaces, metadata, deaths, resets."""
        self.num_envs = len(metas)
        (
            self.single_observation_space,
            self.observation_space,
            self.single_action_space,
            self.action_space,
        ) = adopted_spaces(
            [(meta.observation_space, meta.action_space) for meta in metas], self.observation_mode
        )
        for name in ("metadata", "render_mode"):
            (value,) = self.group.call("call_wrapped", name, env_ids=self.group.env_ids[:1])
            setattr(self, name, value)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._fits_rows = leaves(self.single_action_space) is not None
        self._deaths = Deaths(self.group, self.autoreset_mode, self._collect)
        self._observations: Any = None
        # The last results of all envs, in order; actions respond to them.
        self._answerable = BatchedData(self.group.env_ids, [None] * len(metas))
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            # No step limit: the envs have their own.
            self.group.auto_reset(math.inf).__enter__()

    # -- resets -----------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of a mask, and wait for them.

        Args:
            seed: env k gets ``seed + k``; or a sequence with one seed or None for each env.
            options: passed to each env, without ``reset_mask``: a bool array ``[num_envs]`` that
                selects the envs to reset. The others return their last observation again.

        Returns batched observations and infos.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; nothing is left to collect.
            AlreadyPendingCallError: another call is pending.
            ClosedEnvironmentError: the vector env is closed.
        """
        return _in_one_call(self.group, partial(self.reset_async, seed, options), self.reset_wait)

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Send resets without waiting; `reset_wait` returns their results."""
        self._begin("reset_async")
        seeds = seeds_of_envs(seed, self.num_envs)
        mask = None
        if options is not None and "reset_mask" in options:
            options = dict(options)
            mask = checked_mask(options.pop("reset_mask"), self.num_envs)
        which = range(self.num_envs) if mask is None else np.flatnonzero(mask).tolist()
        if mask is not None and not mask.all():
            self._check_whole()
        # A reset that can't be sent leaves those before it outstanding.
        self._has_leftovers = self._has_lost = True
        send_resets(self.group, seeds, [options] * self.num_envs, which)
        self._pending, self._arguments, self._has_leftovers = "reset", mask, False

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for `reset_async`, at most `timeout` seconds.

        Raises:
            TimeoutError: the resets continue; their results will be dropped.
            ResetNeeded: with a mask, other envs have lost their episodes; reset all.
            NoAsyncCallError: no reset was sent.
        """
        batch = self._finish("reset", timeout, self._collect)
        mask = self._arguments
        self._deaths.note_reset(... if mask is None else mask)
        found, infos = batch.observation, reported_infos(batch)
        if mask is not None and not mask.all():
            chosen = np.flatnonzero(mask)
            found = merged(self._observations, found, chosen, self.num_envs)
            infos = spread(infos, chosen, self.num_envs)
        found = self._observed(found)
        self._has_lost = False
        return found, infos

    # -- steps ------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Step all envs and wait for them.

        Args:
            actions: ``[num_envs, ...]``, an element of `action_space`; cast to its dtype.

        Returns batched observations, rewards (float64), terminations, truncations (bool) and
        infos.

        Raises:
            ValueError, TypeError: the number of actions is wrong, or they don't fit the space.
            EnvRaised, WorkerDied, EnvHung: an env failed; nothing is left to collect.
            ResetNeeded: the results of the last step or reset were lost: by such an error, a
                timeout, or Ctrl-C.
            AlreadyPendingCallError: another call is pending.
            ClosedEnvironmentError: the vector env is closed.
        """
        if self._deaths.unfinished:
            return _in_one_call(self.group, partial(self.step_async, actions), self.step_wait)
        responses = self._responses(actions)
        self._has_leftovers = self._has_lost = True  # Until they are returned.
        try:
            self._answerable, _ = self.group.step(responses)
        except BadAction:
            self._has_lost = False  # Nothing was sent.
            raise
        self._has_leftovers = False
        found = self._stepped(self._answerable)
        self._has_lost = False
        return found

    def step_async(self, actions: Any) -> None:
        """Send steps without waiting; `step_wait` returns their results."""
        responses = self._responses(actions)
        self._has_leftovers = self._has_lost = True  # As in `step`.
        try:
            if self._deaths.unfinished:
                self._deaths.send(responses)
            else:
                self.group.step_async(responses)
        except BadAction:
            self._has_lost = False
            raise
        self._pending, self._has_leftovers = "step", False

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Wait for `step_async`, at most `timeout` seconds.

        Raises:
            TimeoutError: the steps continue; their results will be dropped.
            NoAsyncCallError: no step was sent.
        """
        collect = self._deaths.collect if self._deaths.unfinished else self._collect
        found = self._stepped(self._finish("step", timeout, collect))
        self._has_lost = False
        return found

    def _responses(self, actions: Any) -> BatchedData:
        """Check that the envs may be stepped, and make responses of actions."""
        self._begin("step_async")
        self._check_whole()
        is_tree = isinstance(actions, dict | tuple) and isinstance(
            self.single_action_space, gym.spaces.Dict | gym.spaces.Tuple
        )
        if self._fits_rows and not is_tree:
            actions = np.asarray(actions)
            if not actions.ndim:
                raise TypeError(
                    f"there must be as many actions as envs, {self.num_envs}, not a scalar"
                )
        if self._fits_rows:
            return self._answerable.respond(action=actions)
        env_ids = self.group.env_ids
        each = list(utils.iterate(self.action_space, actions))
        pairs = zip(env_ids, each, strict=True)
        return BatchedData(env_ids, [PolicyResponse(id_, action) for id_, action in pairs])

    def _stepped(self, batch: BatchedData) -> tuple[Any, Any, Any, Any, Any]:
        ends = batch.terminated, batch.truncated
        stepped = Stepped(batch.observation, batch.reward, *ends, reported_infos(batch))
        if self._deaths.concern(batch):
            stepped = self._deaths.settle(batch, stepped, self._observations)
        self._deaths.note_step(stepped)
        return (self._observed(stepped.observations), *stepped[1:])

    # -- both -------------------------------------------------------------------------

    def _begin(self, what: str) -> None:
        """Check that requests may be sent, and drop those that an earlier call has left."""
        check_free(self, self._pending, what)
        if self._has_leftovers:
            drop_outstanding(self.group)
            self._has_leftovers = False

    def _check_whole(self) -> None:
        if self._has_lost:
            raise ResetNeeded(
                "the results of the last step or reset were lost, as it failed, timed out or was "
                "interrupted; call reset() without a mask to begin new episodes"
            )

    def _finish(self, what: str, timeout: float | None, collect: Callable[..., Any]) -> Any:
        """Collect the pending requests by `collect`, within `timeout` seconds."""
        check_sent(self, self._pending, what)
        self._pending = None
        self._has_leftovers = True  # Until all are collected.
        try:
            found = collect(deadline=_seconds(timeout))
        except EnvFault:
            raise  # Before the next clause, as an env may have raised `TimeoutError`.
        except TimeoutError as error:
            raise multiprocessing.TimeoutError(
                f"the envs have not answered {what}_async within {timeout} s; late results are "
                "dropped"
            ) from error
        self._has_leftovers = False
        return found

    def _collect(self, deadline: float | None = None) -> BatchedData:
        batch, _ = self.group.collect_async(wait_all=True, deadline=deadline)
        return batch

    def _observed(self, observations: Any) -> Any:
        """Batch observations as Gymnasium does, and keep the columns for masks and deaths."""
        self._observations = observations
        if type(observations) is np.ndarray and not observations.dtype.hasobject:
            return observations.copy() if self.copy else observations
        result = batched(self.single_observation_space, observations)
        return copying.deepcopy(result) if self.copy else result

    # -- methods and attributes -------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of each env, found through its wrappers, or get an attribute."""
        send = partial(self.call_async, name, *args, **kwargs)
        return _in_one_call(self.group, send, self.call_wait)

    def call_async(self, name: str, /, *args: Any, **kwargs: Any) -> None:
        """Send calls without waiting; `call_wait` returns their values."""
        self._begin("call_async")
        check_name(name)
        self._has_leftovers = True  # Until all are sent.
        send_call(self.group, name, args, kwargs)
        self._pending = "call"

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Wait for `call_async`, at most `timeout` seconds, and return one value for each env.

        Raises:
            TimeoutError: the calls continue; their values will be dropped.
            NoAsyncCallError: no call was sent.
        """
        collect = partial(collect_calls, self.group)
        return tuple(self._finish("call", timeout, collect))

    def _call_one(self, place: int, name: str, /, *args: Any, **kwargs: Any) -> Any:
        """Call method `name` of the env at `place`, or get its attribute."""
        check_name(name)
        send = partial(send_call, self.group, name, args, kwargs, [place])
        return self._answered("call_async", send)[0]

    def env_is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Return True if `wrapper_class` is among the wrappers of any env."""
        places = range(self.num_envs)
        send = partial(send_wrapper_question, self.group, wrapper_class, places)
        return any(self._answered("call_async", send))

    def _look_up(self, place: int, name: str) -> tuple[bool, Any]:
        send = partial(send_look_up, self.group, name, place)
        return self._answered("call_async", send)[0]

    def _answered(self, what: str, send: Callable[[], None]) -> Any:
        """Return what comes of calls that `send` sends."""

        def begin() -> None:
            self._begin(what)
            self._has_leftovers = True  # A value that can't be sent leaves the calls before it.
            send()
            self._pending = "call"

        finish = partial(self._finish, "call", None, partial(collect_calls, self.group))
        return _in_one_call(self.group, begin, finish)

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of each env: a list or tuple has one value for each env."""
        check_running(self)
        single = not isinstance(values, list | tuple)
        each = [values] * self.num_envs if single else list(cast("list[Any]", values))
        if len(each) != self.num_envs:
            raise ValueError(
                f"{len(each)} values for num_envs={self.num_envs}; give one for each, or a single "
                "one that is not a list or tuple"
            )
        self._answered("set_attr", partial(send_values, self.group, name, each))

    def render(self) -> tuple[Any, ...]:
        """Return one rendered frame of each env."""
        return self.call("render")

    # -- state ------------------------------------------------------------------------

    def save_state(self) -> dict[str, Any]:
        """Return the state of all envs, as a copy that can be pickled; see `EnvGroup.snapshot`.

        Raises:
            SnapshotError, EnvRaised, WorkerDied, EnvHung: as `EnvGroup.snapshot`.
            ResetNeeded: the results of the last step or reset were lost.
            AlreadyPendingCallError: another call is pending.
        """
        self._begin("save_state")
        self._check_whole()
        self._has_leftovers = True
        snapshot = self.group.snapshot()
        self._has_leftovers = False
        return {
            "kind": self._kind,
            "group": snapshot,
            "observations": copying.deepcopy(self._observations),
            "deaths": self._deaths.save_state(),
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore the state of all envs, of this vector env or of another one of equal envs.

        Raises:
            ValueError: it is the state of envs that are stepped together, or with another mode or
                step limit; nothing was changed.
            SnapshotError, EnvRaised, WorkerDied, EnvHung: as `EnvGroup.restore`.
            AlreadyPendingCallError: another call is pending.
        """
        self._begin("load_state")
        if "group" not in state:
            raise ValueError("this is the state of envs that are stepped together, without a group")
        if state["kind"] != self._kind:
            raise ValueError(f"the state is of envs with {state['kind']}, not {self._kind}")
        had_lost, self._has_lost, self._has_leftovers = self._has_lost, True, True
        try:
            self._answerable, _ = self.group.restore(state["group"])
        except SnapshotError:  # All envs are as they were.
            self._has_lost, self._has_leftovers = had_lost, False
            raise
        self._has_leftovers = False
        self._observations = copying.deepcopy(state["observations"])
        self._deaths.load_state(state["deaths"], self._answerable)
        self._has_lost = False

    # -- the end ----------------------------------------------------------------------

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Close the envs and end their workers.

        Args:
            timeout: accepted and ignored; workers that don't end within 1.5 s are killed.
            terminate: accepted and ignored.
        """
        del timeout, terminate
        if self._pending is not None:
            warnings.warn(
                f"Calling `close` while waiting for a pending call to `{self._pending}` to "
                "complete.",
                stacklevel=3,
            )
        self.group.close()


def _in_one_call(group: EnvGroup, send: Callable[[], None], wait: Callable[[], T]) -> T:
    """Send and wait; Ctrl-C comes in the wait, and leaves nothing pending."""

    def ask() -> T:
        send()
        return wait()

    return in_one_call(group, ask)


def per_worker(max_concurrency: Any, num_envs: int) -> int:
    """Number of envs that share a worker if there are at most `max_concurrency` workers."""
    count = as_int(max_concurrency)
    if count is None or count < 1:
        raise ValueError(f"max_concurrency must be an int above 0 or None, not {max_concurrency!r}")
    return -(-num_envs // count)


def _seconds(timeout: float | None) -> float | None:
    """Convert a timeout to a deadline; 0 collects only what has arrived."""
    return timeout if timeout is None else max(timeout, 1e-9)
