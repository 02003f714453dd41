"""`VectorEnv`: a group of envs behind Gymnasium's vector interface; see the package."""

from __future__ import annotations

import copy as copying
import multiprocessing
import warnings
from typing import TYPE_CHECKING, Any, Final, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError
from gymnasium.vector import AutoresetMode, utils

from rlightning_aio.batch import BatchedData
from rlightning_aio.envs.sub_envs import adapted
from rlightning_aio.group.auto_reset import as_int
from rlightning_aio.protocol.columns import leaves
from rlightning_aio.sync import EnvGroup, build_env_group
from rlightning_aio.types import PolicyResponse
from rlightning_aio.vector.batching import batched, merged, spread
from rlightning_aio.vector.leftovers import drop_outstanding
from rlightning_aio.vector.rows import rows_of
from rlightning_aio.vector.spaces import adopted_spaces

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.types import EnvMeta

__all__ = ["VectorEnv", "per_worker"]

_NO_LIMIT: Final = 1 << 61
"""Step limits are the envs' own business here."""
_NOT_TO_BE_CALLED: Final = ("reset", "step", "close")


class VectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Envs in worker processes behind Gymnasium's vector interface.

    Args:
        env_fns: one callable for each env, or for each of several vector environments of the same
            size whose `autoreset_mode` is this one's. They run in the workers, and
            only there; lambdas and functions of ``__main__`` will do.
        shared_memory: accepted and ignored.
        copy: observations are the caller's own. False saves a copy, but writing to them changes
            what a later masked reset shows of envs that it doesn't reset.
        context: accepted and ignored.
        daemon: accepted and ignored.
        worker: must be None; there is no worker function to replace.
        observation_mode: ``same``, ``different`` (equal shapes and dtypes), or a pair of the
            batched and the single observation space.
        autoreset_mode: what an env does after the end of its episode.
        max_concurrency: maximum number of workers, each of which executes one env at a time; None
            for one per core that this process may use.
        entry: further fields of `EnvConfig` (``step_timeout``, ``on_worker_death``, …).

    Attributes:
        group: the `EnvGroup` that does the work; its envs, one for each callable, are called
            ``env-0``, ``env-1``, …

    Raises:
        ConfigError: a callable can't be sent to a worker, or `entry` is wrong.
        StartFailed: a callable raised, or didn't return an env.
        RuntimeError: the envs' spaces, or their numbers, don't go together.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]]],
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
        # Annotated here: Gymnasium leaves open what its spaces hold.
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
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.closed = True  # Until it has started.
        self._pending: str | None = None
        self._arguments: Any = None
        self._late = False
        if max_concurrency is not None:
            entry = {"envs_per_process": per_worker(max_concurrency, len(env_fns)), **entry}
        makers = adapted(env_fns, self.autoreset_mode, entry.pop("max_episode_steps", None))
        self.group: EnvGroup = build_env_group(
            {"name": "env", "num_workers": len(makers), "make_env": makers, **entry},
            mixed_actions=True,
            zero_copy=copy,
        )
        metas = self.group.init()
        self.closed = False
        try:
            self._adopt(metas)
        except BaseException:
            self.close()
            raise

    def _adopt(self, metas: list[EnvMeta]) -> None:
        """Take the spaces and the metadata of the envs for the whole."""
        self._rows = rows_of(self.group, metas)
        self.num_envs = self._rows.num_envs
        (
            self.single_observation_space,
            self.observation_space,
            self.single_action_space,
            self.action_space,
        ) = adopted_spaces(self._rows.spaces, self.observation_mode)
        for name in ("metadata", "render_mode"):
            self.group.call_async("call_wrapped", name, env_ids=self.group.env_ids[:1])
            (value,) = self.group.collect_calls()
            setattr(self, name, value)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self._fits_rows = leaves(self.single_action_space) is not None
        self._observations: Any = None
        # Results of all envs, in order, which actions can answer.
        self._answerable = BatchedData(self.group.env_ids, [None] * len(metas))
        reset_themselves = metas[0].num_envs > 1
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and not reset_themselves:
            self.group.auto_reset(max_episode_steps=_NO_LIMIT).__enter__()

    # -- resets -----------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Reset all envs, or those of a mask, and wait for them.

        Args:
            seed: env k gets ``seed + k``; or one for each, None for none.
            options: passed to each env, without ``reset_mask``: a bool array ``[num_envs]``
                that tells which envs are reset. The others show the observation they had.

        Returns observations and infos, batched.

        Raises:
            EnvRaised, WorkerDied, EnvHung: an env failed; nothing is left to be collected.
            AlreadyPendingCallError, ClosedEnvironmentError: it is no time for it.
        """
        self.reset_async(seed, options)
        return self.reset_wait()

    def reset_async(
        self,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Send resets, which `reset_wait` waits for; see `reset`."""
        self._begin("reset_async")
        seeds = self._seeds(seed)
        mask = None
        if options is not None and "reset_mask" in options:
            options = dict(options)
            mask = self._checked_mask(options.pop("reset_mask"))
            # Envs that are stepped together share a row, which is about to be written.
            self._observations = copying.deepcopy(self._observations)
        which = range(self.num_envs) if mask is None else np.flatnonzero(mask).tolist()
        self._late = True  # One that can't be sent leaves those before it.
        self._rows.send_resets(seeds, [options] * self.num_envs, which)
        self._pending, self._arguments, self._late = "reset", mask, False

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[Any]:
        if seed is None or isinstance(seed, int | np.integer):
            return [None if seed is None else seed + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for num_envs={self.num_envs}; give one for each")
        return list(seed)

    def _checked_mask(self, mask: Any) -> NDArray[np.bool_]:
        # The words are Gymnasium's, which its own tests look for.
        what = "`options['reset_mask']` must"
        if not isinstance(mask, np.ndarray):
            raise TypeError(f"{what} be a numpy array, got {type(mask)}")
        array = cast("NDArray[Any]", mask)
        if array.shape != (self.num_envs,):
            raise ValueError(f"{what} have shape `({self.num_envs},)`, got {array.shape}")
        if array.dtype != np.bool_:
            raise TypeError(f"{what} have `dtype=np.bool_`, got {array.dtype}")
        if not array.any():
            raise ValueError(
                f"{what} contain a boolean array with at least one True value, got "
                f"reset_mask={array}"
            )
        return array

    def reset_wait(self, timeout: float | None = None) -> tuple[Any, dict[str, Any]]:
        """Wait for `reset_async`, `timeout` seconds at most.

        Raises:
            TimeoutError: the envs reset all the same; late results are dropped.
            NoAsyncCallError: nothing was sent.
        """
        batch = self._finish("reset", timeout, self._collect)
        mask = self._arguments
        if mask is None or mask.all():
            return self._observed(self._rows.observation(batch)), self._rows.infos(batch)
        chosen = np.flatnonzero(mask)
        observations, infos = self._rows.of_mask(batch, mask)
        observations = merged(self._observations, observations, chosen, self.num_envs)
        return self._observed(observations), spread(infos, chosen, self.num_envs)

    # -- steps ------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Step all envs and wait for them.

        Args:
            actions: ``[num_envs, ...]``, an element of `action_space`; cast to its dtype.

        Returns observations, rewards (float64), terminations, truncations (bool) and infos,
        batched.

        Raises:
            ValueError, TypeError: the actions are not as many as envs, or don't fit.
            EnvRaised, WorkerDied, EnvHung: an env failed; nothing is left to be collected.
            AlreadyPendingCallError, ClosedEnvironmentError: it is no time for it.
        """
        self._begin("step_async")
        self._late = True  # Ctrl-C leaves what was sent.
        self._answerable, _ = self.group.step(self._batch(actions))
        self._late = False
        return self._stepped(self._answerable)

    def step_async(self, actions: Any) -> None:
        """Send steps, which `step_wait` waits for; see `step`."""
        self._begin("step_async")
        self._late = True  # Ctrl-C leaves what was sent.
        self.group.step_async(self._batch(actions))
        self._pending, self._late = "step", False

    def step_wait(
        self, timeout: float | None = None
    ) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], Any]:
        """Wait for `step_async`, `timeout` seconds at most.

        Raises:
            TimeoutError: the envs step all the same; late results are dropped.
            NoAsyncCallError: nothing was sent.
        """
        return self._stepped(self._finish("step", timeout, self._collect))

    def _batch(self, actions: Any) -> BatchedData:
        trees = isinstance(self.single_action_space, gym.spaces.Dict | gym.spaces.Tuple)
        if self._fits_rows and not (trees and isinstance(actions, dict | tuple)):
            actions = np.asarray(actions)
            if not actions.ndim:
                raise TypeError(
                    f"there must be as many actions as envs, {self.num_envs}, not a scalar"
                )
        if self._fits_rows:
            return self._answerable.respond(action=self._rows.actions(actions))
        env_ids = self.group.env_ids
        each = list(utils.iterate(self.action_space, actions))
        pairs = zip(env_ids, each, strict=True)
        return BatchedData(env_ids, [PolicyResponse(id_, action) for id_, action in pairs])

    def _stepped(self, batch: BatchedData) -> tuple[Any, Any, Any, Any, Any]:
        rows = self._rows
        return (
            self._observed(rows.observation(batch)),
            rows.flat(batch.reward),
            rows.flat(batch.terminated),
            rows.flat(batch.truncated),
            rows.infos(batch),
        )

    # -- both -------------------------------------------------------------------------

    def _begin(self, what: str) -> None:
        """Make sure that something may be sent."""
        self._check_running()
        if self._pending is not None:
            raise AlreadyPendingCallError(
                f"Calling `{what}` while waiting for a pending call to `{self._pending}` to "
                f"complete; call `{self._pending}_wait` first.",
                self._pending,
            )
        if self._late:
            drop_outstanding(self.group)
            self._late = False

    def _check_running(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"this {type(self).__name__} is closed")

    def _check_sent(self, what: str) -> None:
        self._check_running()
        if self._pending != what:
            raise NoAsyncCallError(
                f"Calling `{what}_wait` without any prior call to `{what}_async`.", what
            )
        self._pending = None

    def _finish(self, what: str, timeout: float | None, collect: Callable[..., Any]) -> Any:
        """What `collect` returns of the calls that were sent."""
        self._check_sent(what)
        self._late = True  # Unless all goes well.
        try:
            found = collect(deadline=_seconds(timeout))
        except TimeoutError as error:
            raise multiprocessing.TimeoutError(
                f"the envs have not answered {what}_async within {timeout} s; late results are "
                "dropped"
            ) from error
        self._late = False
        return found

    def _collect(self, deadline: float | None) -> BatchedData:
        batch, _ = self.group.collect_async(wait_all=True, ordered=True, deadline=deadline)
        return batch

    def _observed(self, observations: Any) -> Any:
        """Observations as Gymnasium batches them; the last ones are kept, for masks.

        With `copy` they are views of the rows still, of which the caller gets the one copy.
        """
        self._observations = batched(self.single_observation_space, observations)
        return copying.deepcopy(self._observations) if self.copy else self._observations

    # -- methods and attributes -------------------------------------------------------

    def call(self, name: str, /, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call method `name` of every env, found through its wrappers, or get an attribute."""
        self.call_async(name, *args, **kwargs)
        return self.call_wait()

    def call_async(self, name: str, /, *args: Any, **kwargs: Any) -> None:
        """Send calls, which `call_wait` waits for; see `call`."""
        self._begin("call_async")
        if name in _NOT_TO_BE_CALLED:
            raise ValueError(f"call {name}() of the vector env itself, not of its envs")
        self._rows.call(name, args, kwargs)
        self._pending = "call"

    def call_wait(self, timeout: float | None = None) -> tuple[Any, ...]:
        """Wait for `call_async`, `timeout` seconds at most; one value for each env.

        Raises:
            TimeoutError: the methods run all the same; late results are dropped.
            NoAsyncCallError: nothing was sent.
        """
        return tuple(self._rows.values(self._finish("call", timeout, self.group.collect_calls)))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Attribute `name` of every env, found through its wrappers."""
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set attribute `name` of every env: one value for each (a list or a tuple), or one."""
        self._check_running()
        single = not isinstance(values, list | tuple)
        each = [values] * self.num_envs if single else list(cast("list[Any]", values))
        if len(each) != self.num_envs:
            raise ValueError(
                f"{len(each)} values for num_envs={self.num_envs}; give one for each, or a single "
                "one that is not a list or tuple"
            )
        self._begin("set_attr")
        self._late = True  # A value that can't be sent leaves the calls before it.
        self._rows.set_attr(name, each)
        self._pending = "call"
        self._finish("call", None, self.group.collect_calls)

    def render(self) -> tuple[Any, ...]:
        """One frame of each env, as it renders it."""
        return self.call("render")

    @property
    def np_random(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]  # As theirs.
        """Random generators of the envs: a tuple of copies."""
        return self.get_attr("np_random")

    @property
    def np_random_seed(self) -> Any:
        """Seeds of these generators: a tuple."""
        return self.get_attr("np_random_seed")

    # -- the end ----------------------------------------------------------------------

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Close the envs and end their workers.

        Args:
            timeout: accepted; workers that don't end are ended by force after 1.5 s.
            terminate: likewise.
        """
        del timeout, terminate
        if self._pending is not None:
            warnings.warn(
                f"Calling `close` while waiting for a pending call to `{self._pending}` to "
                "complete.",
                stacklevel=3,
            )
        self.group.close()
        # They are views of shared memory, which ends with its last one.
        self._observations, self._answerable = None, BatchedData([], [])


def per_worker(max_concurrency: Any, num_envs: int) -> int:
    """How many envs share a worker where there are `max_concurrency` workers at most."""
    count = as_int(max_concurrency)
    if count is None or count < 1:
        raise ValueError(f"max_concurrency must be an int above 0 or None, not {max_concurrency!r}")
    return -(-num_envs // count)


def _seconds(timeout: float | None) -> float | None:
    """A deadline; 0 asks only for what is there."""
    return timeout if timeout is None else max(timeout, 1e-9)
