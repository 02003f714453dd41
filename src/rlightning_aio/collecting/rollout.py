"""`Rollout`: transitions of many envs as columns, and what a learner computes from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from rlightning_aio.collecting.advantages import Segments, VTrace, gae, vtrace
from rlightning_aio.protocol.columns import Tree, gather, mapped

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

__all__ = ["Lag", "Rollout", "Seconds"]


class Lag(NamedTuple):
    """How many policy versions behind the newest one the transitions' own was."""

    min: int
    mean: float
    max: int


@dataclass(frozen=True, slots=True)
class Seconds:
    """Where the time of a rollout went, in seconds.

    Attributes:
        elapsed: since the previous rollout was complete, or since the first call of `collect`.
        collecting: inside `Collector.collect`: how long a learner has waited that doesn't work at
            the same time.
        policy: in calls of the policy.
        env_busy: in steps and resets, summed over envs.
        waited_for_policy: between an env's result and its next request, summed over envs, less
            the next figure: the env waited for the policy, or for results of others to fill its
            batch.
        waited_for_learner: the part of that in which nobody was in `collect`.
    """

    elapsed: float
    collecting: float
    policy: float
    env_busy: float
    waited_for_policy: float
    waited_for_learner: float


class Rollout:
    """Transitions, one row each, as columns of contiguous, writable NumPy arrays.

    Rows are ``[n]``, with each env's transitions side by side and in order (a *chain*), or
    ``[T, N]`` if the collector waits for all: row ``[t, i]`` is the t-th transition of the i-th
    env. The *ends* are those transitions that are not followed by the next one of their env in
    this rollout: the last of each chain, those that end an episode, and those whose episode was
    lost with its worker. Only after these is an observation needed to bootstrap from; it is in
    `end_observation`.

    What the policy attached is an attribute or an item: ``rollout.log_prob``,
    ``rollout["log_prob"]``. Columns of envs with Dict or Tuple spaces are dicts or tuples of
    arrays; reward, terminated, truncated and done of multi-agent envs are dicts by agent.

    The arrays belong to the collector, which has two sets: they are the rollout's until `collect`
    is called for the second time after it. Until then they may be written to, and read from
    another thread. ``torch.from_numpy`` shares them.

    Attributes:
        observation: what the policy saw; action: what it answered.
        reward: float32; terminated: the episode ended by itself; truncated: it was cut, by the
            env or by the step limit of `auto_reset`; done: either.
        policy_version: int64, `Collector.policy_version` when the action was chosen.
        index: int64, which env of the group: see `BatchedData.index`.
        first: whether an episode begins with it, or continues after a loss.
        ends: ``[k]``, positions of the ends (for ``[T, N]``, in the flattened block). The last
            transition of each chain comes first, in the order of chains.
        end_observation: tree of ``[k, *obs]``, the observation after each end: the episode's
            final one where it is over.
        num_chains: number of envs with transitions here.
        lag: how old the transitions' policies are; seconds: where the time went.
    """

    observation: Tree
    action: Tree
    reward: Any
    terminated: Any
    truncated: Any
    done: Any
    policy_version: NDArray[np.int64]
    index: NDArray[np.int64]
    first: NDArray[np.bool_]

    def __init__(
        self,
        columns: dict[str, Tree],
        shape: tuple[int, ...],
        ends: NDArray[np.intp],
        end_observation: Tree,
        num_chains: int,
        lag: Lag,
        seconds: Seconds,
    ) -> None:
        self._columns = columns
        self.shape = shape
        self.ends = ends
        self.end_observation = end_observation
        self.num_chains = num_chains
        self.lag = lag
        self.seconds = seconds
        self._segments: Segments | None = None

    # -- columns ------------------------------------------------------------------

    def keys(self) -> list[str]:
        """Names of all columns."""
        return list(self._columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> Tree:
        try:
            return self._columns[name]
        except KeyError:
            known = ", ".join(self._columns)
            raise KeyError(f"this rollout has no column {name!r}; it has {known}") from None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)  # As of an object that is still being copied.
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __len__(self) -> int:
        """How many transitions."""
        return int(np.prod(self.shape))

    def __repr__(self) -> str:
        rows = " x ".join(map(str, self.shape))
        names = ", ".join(self._columns)
        return f"Rollout({rows} transitions, {self.num_chains} chains: {names})"

    # -- chains -------------------------------------------------------------------

    @property
    def segments(self) -> Segments:
        """Which transitions follow one another."""
        if self._segments is None:
            stride = self.shape[1] if len(self.shape) > 1 else 1
            self._segments = Segments(self.ends, len(self), stride)
        return self._segments

    @property
    def next_observation(self) -> Tree:
        """The observation after each transition, in fresh arrays; the final one where it ends."""

        def after(leaf: NDArray[Any], ends: NDArray[Any]) -> NDArray[Any]:
            flat = self._flat(leaf)
            return self.segments.successors(flat, ends).reshape(leaf.shape)

        return _paired(after, self.observation, self.end_observation)

    def at_ends(self, name: str) -> Tree:
        """A column's rows at the ends, ``[k, *shape]``, in fresh arrays."""
        return mapped(lambda leaf: gather(self._flat(leaf), self.ends), self[name])

    def _flat(self, leaf: NDArray[Any]) -> NDArray[Any]:
        return leaf.reshape(len(self), *leaf.shape[len(self.shape) :])

    # -- advantages ---------------------------------------------------------------

    def advantages(self, values: Any, next_values: Any, gamma: float, lam: float) -> Any:
        """Generalised advantage estimation over chains.

        After a termination the value is zero. Wherever else a chain breaks off (it was truncated,
        lost with its worker, or is in flight when the rollout is full), `next_values` stand for
        the rest of the episode.

        Args:
            values: of `observation`: an array or CPU tensor in the rollout's shape; a dict of
                such by agent for multi-agent envs.
            next_values: of `end_observation`, ``[k]``; without effect where the end is
                terminated. Zeros where it is truncated treat truncation like termination.
            gamma: discount.
            lam: λ of the exponentially weighted average.

        Returns:
            A fresh array of the rollout's shape and the dtype of `values`, or a dict of such.
            Added to `values` it is what a value function learns.

        Raises:
            ValueError: an argument has another shape.
        """
        if isinstance(values, dict):
            return {
                agent: self._gae(agent, own, next_values[agent], gamma, lam)
                for agent, own in cast("dict[str, Any]", values).items()
            }
        return self._gae(None, values, next_values, gamma, lam)

    def _gae(
        self, agent: str | None, values: Any, next_values: Any, gamma: float, lam: float
    ) -> NDArray[Any]:
        now, after = self._checked(values, next_values)
        reward, terminated = self._of(agent, "reward"), self._of(agent, "terminated")
        stops = None if agent is None else self._of(agent, "done")
        found = gae(self.segments, reward, terminated, now, after, gamma, lam, stops)
        return found.reshape(self.shape)

    def vtrace(
        self,
        values: Any,
        next_values: Any,
        log_ratios: Any,
        gamma: float,
        lam: float = 1.0,
        *,
        clip_rho: float = 1.0,
        clip_c: float = 1.0,
    ) -> VTrace | dict[str, VTrace]:
        """V-trace over chains: for transitions of a policy that lags behind.

        Args:
            values: as of `advantages`.
            next_values: likewise.
            log_ratios: log-probability of each action by the policy that is learned, less that
                by the policy that chose it (``rollout.log_prob``, if it was attached by that
                name), in the rollout's shape; a dict of such by agent.
            gamma: discount.
            lam: scales the traces.
            clip_rho: upper limit of the ratios that weight errors and advantages.
            clip_c: upper limit of the ratios that carry corrections back.

        Returns:
            Fresh arrays in the rollout's shape, or such by agent: targets of the value function
            and advantages of the policy gradient.

        Raises:
            ValueError: an argument has another shape.
        """
        if isinstance(values, dict):
            return {
                agent: self._vtrace(
                    agent, own, next_values[agent], log_ratios[agent], gamma, lam, clip_rho, clip_c
                )
                for agent, own in cast("dict[str, Any]", values).items()
            }
        return self._vtrace(None, values, next_values, log_ratios, gamma, lam, clip_rho, clip_c)

    def _vtrace(
        self,
        agent: str | None,
        values: Any,
        next_values: Any,
        log_ratios: Any,
        gamma: float,
        lam: float,
        clip_rho: float,
        clip_c: float,
    ) -> VTrace:
        now, after = self._checked(values, next_values)
        ratios = self._rows("log_ratios", log_ratios, len(self))
        reward, terminated = self._of(agent, "reward"), self._of(agent, "terminated")
        found = vtrace(
            self.segments,
            reward,
            terminated,
            now,
            after,
            ratios,
            gamma,
            lam,
            clip_rho,
            clip_c,
            None if agent is None else self._of(agent, "done"),
        )
        return VTrace(found.targets.reshape(self.shape), found.advantages.reshape(self.shape))

    def _of(self, agent: str | None, name: str) -> NDArray[Any]:
        column = self[name]
        return self._flat(column if agent is None else column[agent])

    def _checked(self, values: Any, next_values: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        now = self._rows("values", values, len(self))
        if now.dtype.kind != "f":
            now = now.astype(np.float32)
        return now, self._rows("next_values", next_values, len(self.ends)).astype(now.dtype)

    def _rows(self, name: str, given: Any, count: int) -> NDArray[Any]:
        array = np.asarray(given)
        if array.size != count:
            raise ValueError(
                f"{name} has shape {list(array.shape)}, which is not one number for each of "
                f"{count} {'ends' if name == 'next_values' else 'transitions'}; give "
                + (
                    "the values of rollout.end_observation"
                    if name == "next_values"
                    else f"it in the shape {list(self.shape)}"
                )
            )
        return array.reshape(-1)


def _paired(function: Any, one: Tree, other: Tree) -> Tree:
    if isinstance(one, dict):
        parts = cast("dict[str, Tree]", one)
        return {key: _paired(function, part, other[key]) for key, part in parts.items()}
    if isinstance(one, tuple):
        several = cast("tuple[Tree, ...]", one)
        return tuple(_paired(function, part, other[k]) for k, part in enumerate(several))
    return function(one, other)
