"""Advantages over chains: generalised advantage estimation, and V-trace.

Both are one recursion that runs backwards from the ends of *segments* (transitions without an
end in between). Each iteration of the loop handles one time step of all segments that are long
enough. The arithmetic keeps the dtype of the values and the order of operations of the published
formulas.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Segments:
    """The division of ``[n]`` transitions into segments of consecutive ones.

    Args:
        ends: ``[k]``, positions of the last transition of each segment, in any order. Each
            transition belongs to one segment.
        count: the number of transitions, n.
        stride: distance between successive transitions of an env: 1 for concatenated chains, the
            number of envs in a ``[T, N]`` block.
    """

    def __init__(self, ends: NDArray[np.intp], count: int, stride: int) -> None:
        self.ends = ends
        self.stride = stride
        steps = count // stride
        # Positions as if the transitions of each env were contiguous.
        places = ends % stride * steps + ends // stride
        order = np.argsort(places)
        lengths = np.empty(len(ends), np.intp)
        lengths[order] = np.diff(places[order], prepend=-1)
        # Longest first, so that the first `longer[d]` are those longer than d.
        longest_first = np.argsort(-lengths, kind="stable")
        self._ends = ends[longest_first]
        ascending = np.sort(lengths)
        most = int(ascending[-1]) if len(ends) else 0
        self._longer = len(ends) - np.searchsorted(ascending, np.arange(1, most), side="right")

    def successors(self, values: NDArray[Any], next_values: NDArray[Any]) -> NDArray[Any]:
        """Value after each transition: that of the next one, or ``next_values[k]`` at end k."""
        after = np.empty_like(values)
        after[: -self.stride] = values[self.stride :]
        after[self.ends] = next_values
        return after

    def backwards(
        self,
        terms: NDArray[Any],
        decays: NDArray[Any] | float,
        stops: NDArray[np.bool_] | None = None,
    ) -> NDArray[Any]:
        """Compute ``x[t] = terms[t] + decays[t] * x[t + 1]``, with 0 after each segment.

        `stops` marks further transitions with 0 after them.
        """
        found = np.empty_like(terms)
        positions = self._ends
        latest = terms[positions]
        found[positions] = latest
        each = isinstance(decays, np.ndarray)
        for longer in self._longer.tolist():
            positions = positions[:longer] - self.stride
            latest = latest[:longer]
            if stops is not None:
                latest = np.where(stops[positions], 0, latest)
            latest = terms[positions] + (decays[positions] if each else decays) * latest
            found[positions] = latest
        return found


class Chains(NamedTuple):
    """What advantages are computed from.

    Attributes:
        segments: of the transitions.
        rewards, terminated: ``[n]``.
        values: ``[n]``, whose dtype the results have.
        next_values: ``[k]``, after the ends of segments; ignored after a termination.
        stops: ``[n]``, further ends, inside segments: those of an agent that ends before others.
    """

    segments: Segments
    rewards: NDArray[Any]
    terminated: NDArray[np.bool_]
    values: NDArray[Any]
    next_values: NDArray[Any]
    stops: NDArray[np.bool_] | None

    def errors(self, after: NDArray[Any], gamma: float) -> NDArray[Any]:
        """Return those of the values if `after` are the next ones, but 0 after a termination."""
        # Without a product, as 0 times infinity is NaN.
        return self.rewards + gamma * np.where(self.terminated, 0, after) - self.values


def gae(chains: Chains, gamma: float, lam: float) -> NDArray[Any]:
    """Generalised advantage estimation (Schulman et al., 2016, arXiv:1506.02438, eq. 16).

    `gamma` is the discount, `lam` is λ.
    """
    segments, values = chains.segments, chains.values
    errors = chains.errors(segments.successors(values, chains.next_values), gamma)
    return segments.backwards(errors.astype(values.dtype, copy=False), gamma * lam, chains.stops)


def vtrace(
    chains: Chains, log_ratios: NDArray[Any], gamma: float, lam: float, clip: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """V-trace (Espeholt et al., 2018, arXiv:1802.01561, eq. 1 and section 4.2).

    Takes the arguments of `gae`, and ``[n]`` `log_ratios`: log-probability of the action under the
    learned policy minus that under the acting policy. Ratios that weight errors and advantages
    are clipped at `clip`, and so are those that carry corrections back (the paper's traces c,
    scaled by `lam`, remark 2).
    """
    segments, values, stops = chains.segments, chains.values, chains.stops
    dtype = values.dtype
    ratios = np.exp(log_ratios).astype(dtype, copy=False)
    rhos = np.minimum(ratios, dtype.type(clip))
    traces = lam * rhos
    errors = rhos * chains.errors(segments.successors(values, chains.next_values), gamma)
    traced = segments.backwards(errors.astype(dtype, copy=False), gamma * traces, stops)
    targets = values + traced
    after = segments.successors(targets, chains.next_values)
    # A stop's successor is not part of its chain, so its value is used instead of its target.
    if stops is not None:
        after = np.where(stops, segments.successors(values, chains.next_values), after)
    return targets, (rhos * chains.errors(after, gamma)).astype(dtype, copy=False)
