"""`Rollout`: transitions of many envs as columns, and advantages over them."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from rlightning_aio.collecting.advantages import Chains, Segments, gae, vtrace
from rlightning_aio.collecting.trees import with_lists
from rlightning_aio.trees import Tree, mapped, zipped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from numpy.typing import NDArray

_Pair: TypeAlias = "tuple[NDArray[Any], NDArray[Any]]"


class Rollout:
    """Transitions, one row each, as columns of contiguous, writable NumPy arrays.

    Rows are ``[n]``, with the transitions of each env contiguous and in order (a *chain*), or
    ``[T, N]`` with `wait_all`: row ``[t, i]`` is the t-th transition of the i-th env. The *ends*
    are transitions without a successor in this rollout: the last of each chain, those that end an
    episode, and those whose episode was lost with its worker. Only ends need an observation to
    bootstrap from; it is in `end_observation`.

    The policy's columns are attributes and items: ``rollout.log_prob``, ``rollout["log_prob"]``.
    Columns of envs with Dict or Tuple spaces are dicts or tuples of arrays; columns of plain Python
    values are lists (of lists, for ``[T, N]``). Reward, terminated, truncated and done of
    multi-agent envs are dicts by agent.

    The collector owns the arrays, in two sets: they are valid until the second call of `collect`
    after it. Until then they may be written to, and used by other threads. ``torch.from_numpy``
    shares them.

    Attributes:
        observation: the observation before the action; action: the policy's answer.
        reward: float32; terminated: the env ended the episode; truncated: the env or the step
            limit of `auto_reset` cut it; done: either.
        policy_version: int64, `Collector.policy_version` when the action was chosen.
        lag: int64, how many versions that is behind the newest.
        index: int64, index of the env in the group: see `BatchedData.index`.
        env_ids: the id of the env, or the place of a client, by index.
        first: True if an episode begins with the transition, or continues after a loss.
        ends: ``[k]``, positions of the ends (for ``[T, N]``, in the flattened block). The last
            transitions of chains come first, in the order of chains.
        episodes: columns of those that ended in this rollout, in the order of arrival: terminated,
            truncated, or cut by the step limit, but not lost with a worker. They may have begun
            earlier. ``index`` is that of the env in the group, ``total_reward`` the undiscounted
            return since the reset, summed over agents, ``length`` the steps since the reset, and
            ``info`` a list: the info of the last step, without that of the next episode.
    """

    observation: Tree
    action: Tree
    reward: Any
    terminated: Any
    truncated: Any
    done: Any
    policy_version: NDArray[np.int64]
    lag: NDArray[np.int64]
    index: NDArray[np.int64]
    first: NDArray[np.bool_]

    def __init__(
        self,
        columns: dict[str, Tree],
        ends: NDArray[np.intp],
        end_observation: Tree,
        episodes: dict[str, Any],
        env_ids: Mapping[int, str],
    ) -> None:
        self._columns = columns
        self.env_ids = env_ids
        index: Any = columns["index"]
        self.shape: tuple[int, ...] = index.shape
        self.ends, self._end_observation = ends, end_observation
        self.episodes = episodes

    @property
    def num_chains(self) -> int:
        """Number of envs with transitions in this rollout."""
        return len(np.unique(self.index))

    # -- columns ------------------------------------------------------------------

    @property
    def end_observation(self) -> Tree:
        """Tree of ``[k, *obs]``, the observation after each end: the final one of the episode
        where that is over.
        """
        return with_lists(self._end_observation)

    def keys(self) -> list[str]:
        """Names of all columns."""
        return list(self._columns)

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns

    def __getitem__(self, name: str) -> Tree:
        try:
            return with_lists(self._columns[name])
        except KeyError:
            known = ", ".join(self._columns)
            raise KeyError(f"this rollout has no column {name!r}; it has {known}") from None

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)  # `copy` asks objects without attributes.
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __len__(self) -> int:
        """Number of transitions."""
        return int(np.prod(self.shape))

    def __repr__(self) -> str:
        rows = " x ".join(map(str, self.shape))
        names = ", ".join(self._columns)
        return f"Rollout({rows} transitions, {self.num_chains} chains: {names})"

    # -- chains -------------------------------------------------------------------

    @cached_property
    def _segments(self) -> Segments:
        return Segments(self.ends, len(self), self.shape[1] if len(self.shape) > 1 else 1)

    @property
    def next_observation(self) -> Tree:
        """Observation after each transition, in new arrays; the final one if the episode ends."""

        def after(leaf: NDArray[Any], ends: NDArray[Any]) -> NDArray[Any]:
            flat = self._flat(leaf)
            return self._segments.successors(flat, ends).reshape(leaf.shape)

        return with_lists(zipped(after, self._columns["observation"], self._end_observation))

    def _flat(self, leaf: NDArray[Any]) -> NDArray[Any]:
        return leaf.reshape(len(self), *leaf.shape[len(self.shape) :])

    # -- advantages ---------------------------------------------------------------

    def advantages(self, values: Any, next_values: Any, gamma: float, lam: float) -> Any:
        """Compute generalised advantage estimates over chains.

        After a termination the value is zero. At any other end (truncated, lost with its worker,
        or continued in the next rollout), `next_values` estimate the rest of the episode.

        Args:
            values: of `observation`: an array or CPU tensor in the shape of the rollout; a dict of
                such by agent for multi-agent envs.
            next_values: of `end_observation`, ``[k]``; ignored at terminated ends. Zeros at
                truncated ends treat truncation like termination.
            gamma: discount.
            lam: λ of the exponentially weighted average.

        Returns:
            A new array with the shape of the rollout and the dtype of `values`, or a dict of such.
            Its sum with `values` is the target of a value function.

        Raises:
            ValueError: an argument has another shape.
        """
        return self._by_agent(partial(gae, gamma=gamma, lam=lam), values, next_values)

    def vtrace(
        self,
        values: Any,
        next_values: Any,
        log_ratios: Any,
        gamma: float,
        lam: float = 1.0,
        clip: float = 1.0,
    ) -> _Pair | dict[str, _Pair]:
        """Compute V-trace over chains, for transitions of an older policy.

        Args:
            values: as for `advantages`.
            next_values: as for `advantages`.
            log_ratios: log-probability of each action under the learned policy minus that under
                the policy that chose it (``rollout.log_prob`` if the policy returned it by that
                name), in the shape of the rollout; a dict of such by agent.
            gamma: discount.
            lam: scales the traces.
            clip: upper limit of the ratios of probabilities, both of those that weight errors and
                advantages and of those that carry corrections back.

        Returns:
            Two new arrays in the shape of the rollout, or a dict of such by agent: targets of the
            value function (``vs`` of the paper), and advantages of the policy gradient, already
            weighted by the clipped ratio.

        Raises:
            ValueError: an argument has another shape.
        """
        traced = partial(vtrace, gamma=gamma, lam=lam, clip=clip)
        return self._by_agent(traced, values, next_values, log_ratios)

    def _by_agent(
        self, compute: Callable[..., Any], values: Any, next_values: Any, *log_ratios: Any
    ) -> Any:
        """Compute what has the shape of the rollout; a dict of such if `values` are one."""
        given = values, next_values, *log_ratios
        if not isinstance(values, dict):
            return self._computed(compute, None, *given)
        agents = cast("dict[str, Any]", values)
        return {
            agent: self._computed(compute, agent, *(one[agent] for one in given))
            for agent in agents
        }

    def _computed(
        self,
        compute: Callable[..., Any],
        agent: str | None,
        values: Any,
        next_values: Any,
        *log_ratios: Any,
    ) -> Any:
        now, after = self._checked(values, next_values)
        chains = Chains(
            self._segments,
            self._of(agent, "reward"),
            self._of(agent, "terminated"),
            now,
            after,
            None if agent is None else self._of(agent, "done"),
        )
        found = compute(chains, *(self._rows("log_ratios", ratios) for ratios in log_ratios))
        return mapped(lambda flat: flat.reshape(self.shape), found)

    def _of(self, agent: str | None, name: str) -> NDArray[Any]:
        column = self[name]
        return self._flat(column if agent is None else column[agent])

    def _checked(self, values: Any, next_values: Any) -> tuple[NDArray[Any], NDArray[Any]]:
        now = self._rows("values", values)
        if now.dtype.kind != "f":
            now = now.astype(np.float32)
        after = np.asarray(next_values)
        if after.shape != self.ends.shape:
            raise ValueError(
                f"next_values has shape {list(after.shape)}, and this rollout has "
                f"{len(self.ends)} ends; give the values of rollout.end_observation, one number "
                f"for each: {list(self.ends.shape)}"
            )
        return now, after.astype(now.dtype)

    def _rows(self, name: str, given: Any) -> NDArray[Any]:
        array = np.asarray(given)
        if array.shape != self.shape:
            raise ValueError(
                f"{name} has shape {list(array.shape)}; give one number for each transition, in "
                f"the rollout's shape {list(self.shape)}"
            )
        return array.reshape(-1)
