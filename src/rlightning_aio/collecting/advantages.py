"""Advantages over chains: generalised advantage estimation, and V-trace.

Both are one recursion that runs backwards from the ends of *segments* (transitions without an
end in between), over all segments at once: a step of the loop is one step of time in all those
that are still that long. Arithmetic keeps the dtype of the values, and the order of operations
of the formulas as they are printed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Segments", "VTrace", "gae", "vtrace"]


class VTrace(NamedTuple):
    """What V-trace gives for each transition.

    Attributes:
        targets: of the value function (``vs`` of the paper).
        advantages: of the policy gradient, already weighted by the clipped ratio.
    """

    targets: NDArray[Any]
    advantages: NDArray[Any]


class Segments:
    """Which of ``[n]`` transitions follow one another.

    Args:
        ends: ``[k]``, positions of the last transition of each segment, in any order. Every
            transition belongs to one segment.
        count: of transitions.
        stride: how far the transition after one is: 1 where chains lie one behind the other,
            the number of envs in a ``[T, N]`` block.
    """

    def __init__(self, ends: NDArray[np.intp], count: int, stride: int = 1) -> None:
        self.ends = ends
        self.count = count
        self.stride = stride
        steps = count // stride
        # As if each env's transitions lay one behind the other.
        places = ends % stride * steps + ends // stride
        order = np.argsort(places)
        lengths = np.empty(len(ends), np.intp)
        lengths[order] = np.diff(places[order], prepend=-1)
        # Longest first: those that are longer than d are the first `longer[d]`.
        longest_first = np.argsort(-lengths, kind="stable")
        self._ends = ends[longest_first]
        ascending = np.sort(lengths)
        most = int(ascending[-1]) if len(ends) else 0
        self._longer = len(ends) - np.searchsorted(ascending, np.arange(1, most), side="right")

    def successors(self, values: NDArray[Any], next_values: NDArray[Any]) -> NDArray[Any]:
        """The value after each transition: of the next one, or ``next_values[k]`` at end k."""
        after = np.empty_like(values)
        after[: -self.stride] = values[self.stride :]
        after[self.ends] = next_values
        return after

    def backwards(self, terms: NDArray[Any], decays: NDArray[Any] | float) -> NDArray[Any]:
        """``x[t] = terms[t] + decays[t] * x[t + 1]``, with 0 after the end of each segment."""
        found = np.empty_like(terms)
        positions = self._ends
        latest = terms[positions]
        found[positions] = latest
        each = isinstance(decays, np.ndarray)
        for longer in self._longer.tolist():
            positions = positions[:longer] - self.stride
            decay = decays[positions] if each else decays
            latest = terms[positions] + decay * latest[:longer]
            found[positions] = latest
        return found


def gae(
    segments: Segments,
    rewards: NDArray[Any],
    terminated: NDArray[np.bool_],
    values: NDArray[Any],
    next_values: NDArray[Any],
    gamma: float,
    lam: float,
    stops: NDArray[np.bool_] | None = None,
) -> NDArray[Any]:
    """Generalised advantage estimation (Schulman et al., 2016, arXiv:1506.02438, eq. 16).

    Of ``[n]`` `rewards`, `terminated` and `values`, and ``[k]`` `next_values` after the segments'
    ends, which are without effect where it has terminated; `gamma` is the discount, `lam` is λ.
    `stops` are further ends, whose successors are there: of an agent that ends before others.
    """
    going_on = (~terminated).astype(values.dtype)
    after = segments.successors(values, next_values)
    errors = rewards + gamma * after * going_on - values
    decays = gamma * lam if stops is None else gamma * lam * (~stops).astype(values.dtype)
    return segments.backwards(errors.astype(values.dtype, copy=False), decays)


def vtrace(
    segments: Segments,
    rewards: NDArray[Any],
    terminated: NDArray[np.bool_],
    values: NDArray[Any],
    next_values: NDArray[Any],
    log_ratios: NDArray[Any],
    gamma: float,
    lam: float,
    clip_rho: float,
    clip_c: float,
    stops: NDArray[np.bool_] | None = None,
) -> VTrace:
    """V-trace (Espeholt et al., 2018, arXiv:1802.01561, eq. 1 and section 4.2).

    Of the same as `gae`, and ``[n]`` `log_ratios`: log-probability of the action by the policy
    that is learned, less that by the policy that acted. Ratios are clipped at `clip_rho` where they
    weight errors and advantages, at `clip_c` where they carry corrections back (the paper's traces
    c), which `lam` scales (remark 2).
    """
    dtype = values.dtype
    ratios = np.exp(log_ratios).astype(dtype, copy=False)
    rhos = np.minimum(ratios, dtype.type(clip_rho))
    traces = lam * np.minimum(ratios, dtype.type(clip_c))
    if stops is not None:
        traces = traces * (~stops).astype(dtype)
    going_on = (~terminated).astype(dtype)
    after = segments.successors(values, next_values)
    errors = rhos * (rewards + gamma * after * going_on - values)
    corrections = segments.backwards(errors.astype(dtype, copy=False), gamma * traces)
    targets = values + corrections
    following = segments.successors(targets, next_values)
    # What follows a stop is no part of its chain: its value stands for it there, too.
    after = following if stops is None else np.where(stops, after, following)
    advantages = rhos * (rewards + gamma * after * going_on - values)
    return VTrace(targets, advantages.astype(dtype, copy=False))
