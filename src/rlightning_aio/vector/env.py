"""`VectorEnv`: a group of envs behind Gymnasium's vector interface."""

from __future__ import annotations

import copy as copying
import math
import multiprocessing
import warnings
from contextlib import contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded as GymnasiumResetNeeded
from gymnasium.vector import AutoresetMode, utils

from rlightning_aio._core.group.api.facade import drop_unraised
from rlightning_aio._core.group.api.sync import due_for_reset
from rlightning_aio._core.group.state.episodes import as_int
from rlightning_aio.batch import BatchedData
from rlightning_aio.batch.contents import lost_rows, reported_info_list, reported_infos
from rlightning_aio.batch.infos import listed, vector_infos
from rlightning_aio.envs.adapted.makers import adapted
from rlightning_aio.envs.wrappers import check_running, name_of
from rlightning_aio.errors import BadAction, EnvFault, ResetNeeded, SnapshotError
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.trees import index
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.deaths import Stepped, with_deaths, without_cause
from rlightning_aio.vector.interface import (
    CalledEnvs,
    check_free,
    check_name,
    check_sent,
    checked_mode,
    mask_and_options,
    options_of_envs,
    seeds_of_envs,
)
from rlightning_aio.vector.spaces import adopted_spaces, batched, merged, spread

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.types import EnvMeta

T = TypeVar("T")


class _ResetNeeded(ResetNeeded, GymnasiumResetNeeded):
    """As both trees of errors have it."""


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
            each env; of tasks that are known to compute (`make_vec`), one for each core that this
            process may use.
        entry: further fields of `EnvConfig` (``step_timeout``, ``on_worker_death``, …).

    Attributes:
        group: the `EnvGroup` that runs the envs ``env-0``, ``env-1``, …, one for each callable.

    Raises:
        ConfigError: a callable can't be sent to a worker, or `entry` is wrong.
        StartFailed: a callable raised, or didn't return an env.
        RuntimeError: the spaces don't match.
        ValueError: `env_fns` is empty.
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
        if not env_fns:
            raise ValueError("a vector env has at least one env: give a callable for each")
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
        self._mask: Any = None
        # Every call so far has returned what it was about, and nothing is in flight.
        self._is_whole = True
        mode = self.autoreset_mode
        # A worker can be renewed before a reset, but not within a step.
        self._resets = mode == AutoresetMode.SAME_STEP and bool(entry.get("recycle"))
        config = adapted(env_fns, AutoresetMode.DISABLED if self._resets else mode, entry)
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
        """Set up what depends on the envs: spaces, metadata, resets."""
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
        self._observations: Any = None
        # Envs whose next step is a reset, and the ones that have lost their episodes, which are
        # sent that reset here; None if there are none.
        self._due = np.zeros(len(metas), np.bool_)
        self._lost: NDArray[np.bool_] | None = None
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
        options: dict[str, Any] | Sequence[dict[str, Any] | None] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of a mask, and wait for them.

        Without a mask it always works: what an interrupted or failed call has left in flight is
        awaited and dropped.

        Args:
            seed: env k gets ``seed + k``; or a sequence with one seed or None for each env.
            options: passed to each env, without ``reset_mask``: a bool array ``[num_envs]`` that
                selects the envs to reset. The others return their last observation again. Or a
                sequence with the options of each env, or None.

        Returns batched observations and infos.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; reset all again.
            ResetNeeded: with a mask, other envs have lost their episodes; reset all.
            AlreadyPendingCallError: another call is pending.
            ClosedEnvironmentError: the vector env is closed.
        """
        mask = self._send_resets(seed, options)
        return self._begun(self._collected("reset", None), mask)

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | Sequence[dict[str, Any] | None] | None = None,
    ) -> None:
        """Send resets without waiting; `reset_wait` returns their results."""
        self._mask = self._send_resets(seed, options)
        self._pending = "reset"

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for `reset_async`, at most `timeout` seconds.

        Raises:
            TimeoutError: late results will be dropped.
            NoAsyncCallError: no reset was sent.
        """
        check_sent(self, self._pending, "reset")
        self._pending = None
        return self._begun(self._collected("reset", timeout), self._mask)

    def _send_resets(self, seed: Any, options: Any) -> NDArray[np.bool_] | None:
        """Send resets; return the mask of their envs, or None if it is all of them."""
        check_free(self, self._pending, "reset_async")
        seeds = seeds_of_envs(seed, self.num_envs)
        mask, options = mask_and_options(options, self.num_envs)
        each = options_of_envs(options, self.num_envs)
        if mask is not None:
            self._check_whole()
        else:
            self._drop_outstanding()
        places = range(self.num_envs) if mask is None else np.flatnonzero(mask).tolist()
        group, env_ids = self.group, self.group.env_ids
        # As many at once as have the same options.
        alike = all(each[k] is each[places[0]] for k in places)
        with self._unless_refused(TypeError):
            if mask is None:
                drop_unraised(self.group)
            for some in [places] if alike else [[k] for k in places]:
                own = {env_ids[k]: int(seeds[k]) for k in some if seeds[k] is not None}
                group.reset_async(own, each[some[0]], [env_ids[k] for k in some])
        return mask

    def _drop_outstanding(self) -> None:
        """Wait until nothing is in flight, and drop it with its errors."""
        if not self._is_whole:
            with suppress(EnvFault):
                self.group.drain()

    def _begun(self, batch: BatchedData, mask: NDArray[np.bool_] | None) -> tuple[Any, Any]:
        """Return the results of resets of all envs, or of those of a mask."""
        found = batch.observation
        infos = self._infos(batch)
        if mask is None:
            self._answerable, self._lost = batch, None
        else:
            if self._lost is not None:
                self._lost = self._lost & ~mask
            chosen = np.flatnonzero(mask)
            found = merged(self._observations, found, chosen, self.num_envs)
            infos = spread(infos, chosen, self.num_envs)
        result = self._observed(found), infos
        self._is_whole = True
        return result

    # -- steps ------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Step all envs and wait for them.

        Args:
            actions: ``[num_envs, ...]``, an element of `action_space`; cast to its dtype.

        Returns batched observations, rewards (float64), terminations, truncations (bool) and
        infos.

        Raises:
            ValueError, TypeError: the number of actions is wrong, or they don't fit the space.
            EnvRaised, WorkerDied, EnvHung: an env failed; reset all.
            ResetNeeded: the last call was cut off: by such an error, a timeout, or Ctrl-C.
            AlreadyPendingCallError: another call is pending.
            ClosedEnvironmentError: the vector env is closed.
        """
        responses = self._responses(actions)
        if self._lost is not None:
            self._send_steps(responses)
            return self._stepped(self._collected("step", None))
        self._is_whole = False  # Until the results are returned.
        try:
            batch, _ = self.group.step(responses)
        except BadAction:
            self._is_whole = True  # Nothing was sent.
            raise
        return self._stepped(batch)

    def step_async(self, actions: Any) -> None:
        """Send steps without waiting; `step_wait` returns their results."""
        self._send_steps(self._responses(actions))
        self._pending = "step"

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Wait for `step_async`, at most `timeout` seconds.

        Raises:
            TimeoutError: late results will be dropped.
            NoAsyncCallError: no step was sent.
        """
        check_sent(self, self._pending, "step")
        self._pending = None
        return self._stepped(self._collected("step", timeout))

    def _responses(self, actions: Any) -> BatchedData:
        """Check that the envs may be stepped, and make responses of actions."""
        check_free(self, self._pending, "step_async")
        self._check_whole()
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            self._due = due_for_reset(self.group)
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

    def _send_steps(self, responses: BatchedData) -> None:
        """Send steps, and resets to those envs that have lost their episodes in the last one."""
        lost = self._lost
        with self._unless_refused(BadAction):
            if lost is None:
                self.group.step_async(responses)
                return
            self._due |= lost
            if not lost.all():
                self.group.step_async(responses.take(np.flatnonzero(~lost).tolist()))
        self.group.reset_async(env_ids=self._ids(np.flatnonzero(lost).tolist()))

    def _stepped(self, batch: BatchedData) -> tuple[Any, Any, Any, Any, Any]:
        self._answerable, self._lost = batch, None
        lost = np.zeros(self.num_envs, np.bool_)
        if lost_rows(batch):
            stepped, lost = with_deaths(batch, self._observations, self._due, self.autoreset_mode)
            if self.autoreset_mode == AutoresetMode.NEXT_STEP and lost.any():
                self._lost = lost
        else:
            ends = batch.terminated, batch.truncated
            stepped = Stepped(batch.observation, batch.reward, *ends, self._infos(batch))
        if self._resets:
            stepped = self._with_resets(stepped, lost)
        found = (self._observed(stepped.observations), *stepped[1:])
        self._is_whole = True
        return found

    def _with_resets(self, last: Stepped, lost: NDArray[np.bool_]) -> Stepped:
        """Reset the envs whose episodes have ended in a step; see `SameStep`."""
        # Those that have lost theirs have begun another.
        chosen = np.flatnonzero((last.terminated | last.truncated) & ~lost)
        if not len(chosen):
            return last
        batch, _ = self.group.reset(env_ids=self._ids(chosen.tolist()))
        each = listed(last.infos, self.num_envs)
        for k, info in zip(chosen.tolist(), reported_info_list(batch), strict=True):
            final = copying.deepcopy(index(last.observations, k))
            each[k] = {**without_cause(info), "final_info": each[k], "final_obs": final}
        observations = merged(last.observations, batch.observation, chosen, self.num_envs)
        return last._replace(observations=observations, infos=vector_infos(each))

    # -- both -------------------------------------------------------------------------

    @contextmanager
    def _unless_refused(self, refusal: type[Exception]) -> Generator[None]:
        """Note that a call is not at its end, unless it is refused and nothing was sent."""
        was_whole, self._is_whole = self._is_whole, False
        try:
            yield
        except refusal:
            self._is_whole = was_whole and not self.group.pending
            raise

    def _check_whole(self) -> None:
        if not self._is_whole:
            raise _ResetNeeded(
                "the results of the last call were lost, as it failed, timed out or was "
                "interrupted; call reset() without a mask to begin new episodes"
            )

    def _collected(self, what: str, timeout: float | None) -> BatchedData:
        """Collect the results of all envs, within `timeout` seconds; 0: those that are there."""
        deadline = None if timeout is None else max(timeout, 1e-9)
        try:
            return self.group.collect_async(wait_all=True, deadline=deadline)[0]
        except EnvFault:
            raise  # Before the next clause, as an env may have raised `TimeoutError`.
        except TimeoutError as error:
            raise multiprocessing.TimeoutError(
                f"the envs have not answered {what}_async within {timeout} s; late results are "
                "dropped"
            ) from error

    def _infos(self, batch: BatchedData) -> dict[str, Any]:
        return reported_infos(batch)

    def _observed(self, observations: Any) -> Any:
        """Batch observations as Gymnasium does, and keep the columns for masks and deaths."""
        self._observations = observations
        if type(observations) is np.ndarray and not observations.dtype.hasobject:
            return observations.copy() if self.copy else observations
        result = batched(self.single_observation_space, observations)
        return copying.deepcopy(result) if self.copy else result

    def _ids(self, places: Sequence[int]) -> list[str]:
        env_ids = self.group.env_ids  # Each look makes a list.
        return [env_ids[k] for k in places]

    # -- methods and attributes -------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of each env, found through its wrappers, or get an attribute.

        Raises:
            ResetNeeded: the last call was cut off.
            AlreadyPendingCallError: another call is pending.
        """
        check_name(name)
        return tuple(self.ask(None, "call_wrapped", name, *args, **kwargs))

    def ask(
        self, places: Sequence[int] | None, name: str, /, *args: Any, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the `BaseEnv` in the workers, of all envs or of those at `places`.

        ``call_wrapped`` finds methods and attributes of the env itself.

        Raises:
            ResetNeeded, AlreadyPendingCallError: as of `call`.
        """
        env_ids = None if places is None else self._ids(places)
        call = partial(self.group.call_with, name, args, kwargs, env_ids)
        return self._called("call_async", call)

    def _called(self, what: str, call: Callable[[], T]) -> T:
        """Make a call that leaves episodes alone; Ctrl-C leaves it in flight, an error doesn't."""
        check_free(self, self._pending, what)
        self._check_whole()
        with self._unless_refused(Exception):
            found = call()
        self._is_whole = True
        return found

    def env_is_wrapped(self, wrapper_class: type[Any]) -> bool:
        """Return True if `wrapper_class` is among the wrappers of any env."""
        return any(self.ask(None, "is_wrapped", name_of(wrapper_class)))

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of each env: a list or tuple has one value for each env."""
        check_running(self)
        if not isinstance(values, list | tuple):
            self.ask(None, "call_wrapped", "set_wrapper_attr", name, values)
            return
        each = list(cast("list[Any]", values))
        if len(each) != self.num_envs:
            raise ValueError(
                f"{len(each)} values for num_envs={self.num_envs}; give one for each, or a single "
                "one that is not a list or tuple"
            )
        for k, value in enumerate(each):
            self.ask([k], "call_wrapped", "set_wrapper_attr", name, value)

    def render(self) -> tuple[Any, ...]:
        """Return one rendered frame of each env."""
        return self.call("render")

    # -- state ------------------------------------------------------------------------

    def snapshot(self) -> bytes:
        """Return the state of all envs; see `EnvGroup.snapshot`.

        Raises:
            SnapshotError, EnvRaised, WorkerDied, EnvHung: as `EnvGroup.snapshot`.
            ResetNeeded: the last call was cut off.
            AlreadyPendingCallError: another call is pending.
        """
        return self._called("snapshot", self.group.snapshot)

    def restore(self, snapshot: bytes) -> tuple[Any, dict[str, Any]]:
        """Reset all envs to states that `snapshot` has returned, here or in a run before.

        What was in flight is dropped, as by `reset`. An env that had ended its episode is reset by
        its next step, if it would have been so then.

        Returns what `reset` does: the last observations, and the infos.

        Raises:
            SnapshotError: it is of other envs, or damaged; nothing was changed.
            EnvRaised, WorkerDied, EnvHung: as `EnvGroup.restore`; reset all, or restore again.
            AlreadyPendingCallError: another call is pending.
        """
        check_free(self, self._pending, "restore")
        self._drop_outstanding()
        with self._unless_refused(SnapshotError):
            batch, _ = self.group.restore(snapshot)
        return self._begun(batch, None)

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


def per_worker(max_concurrency: Any, num_envs: int) -> int:
    """Number of envs that share a worker if there are at most `max_concurrency` workers."""
    count = as_int(max_concurrency)
    if count is None or count < 1:
        raise ValueError(f"max_concurrency must be an int above 0 or None, not {max_concurrency!r}")
    return -(-num_envs // count)
