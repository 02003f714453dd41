"""`whole_episodes`: episodes of rollouts, which may cut them anywhere.

Those that were lost with a worker, or whose begin is in no rollout, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rlightning_aio.batch.stacking import concatenated
from rlightning_aio.trees import mapped

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from rlightning_aio.collecting.rollout import Rollout


@dataclass(frozen=True, slots=True)
class WholeEpisode:
    """An episode from its reset to its end, of T steps.

    Attributes:
        observation: ``[T + 1, *obs]``, the first one from the reset; of Dict and Tuple spaces a
            dict or tuple of such arrays; of plain values a list.
        action: ``[T, *action]``, likewise.
        reward: ``[T]`` float32.
        terminated, truncated: ``[T]``; the last of either is True.
    """

    observation: Any
    action: Any
    reward: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.reward)


def whole_episodes(
    rollouts: Iterable[Rollout], begun: dict[int, list[dict[str, Any]]] | None = None
) -> Iterator[WholeEpisode]:
    """Join the transitions of successive rollouts of one `Collector`, in arrays of their own.

    Args:
        rollouts: none is kept.
        begun: a dict that is empty at first, for what is handed over in several calls: it keeps the
            parts of the episode that each env has begun.

    Raises:
        ValueError: the envs have several agents.
    """
    begun = {} if begun is None else begun
    for rollout in rollouts:
        if isinstance(rollout.done, dict):
            raise ValueError("episodes of several agents can't be exported")
        done, first = rollout.done.reshape(-1), rollout.first.reshape(-1)
        ends = {int(position): k for k, position in enumerate(rollout.ends)}
        lengths: dict[int, list[int]] = {}
        ended = rollout.episodes
        for index, length in zip(ended["index"], ended["length"], strict=True):
            lengths.setdefault(index, []).append(length)
        for index, rows in _segments(rollout, ends):
            if first[rows[0]]:
                begun[index] = []
            parts = begun.setdefault(index, [])
            parts.append(_part(rollout, rows))
            if done[rows[-1]]:
                end = ends[int(rows[-1])]
                last = mapped(lambda leaf, k=end: leaf[k : k + 1].copy(), rollout.end_observation)
                episode = _joined(begun.pop(index), last)
                # Shorter if its begin is in no rollout.
                if len(episode) == lengths[index].pop(0):
                    yield episode


def _segments(rollout: Rollout, ends: dict[int, int]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Yield the rows of each env up to each end, in order."""
    of_rows = rollout.index.reshape(-1)
    for index in np.unique(of_rows).tolist():
        rows = np.flatnonzero(of_rows == index)
        stops = [k + 1 for k, row in enumerate(rows.tolist()) if row in ends]
        yield from ((index, part) for part in np.split(rows, stops) if len(part))


def _part(rollout: Rollout, rows: NDArray[np.intp]) -> dict[str, Any]:
    size, axes = len(rollout), len(rollout.shape)

    def part(leaf: Any) -> Any:
        if isinstance(leaf, list):  # Of plain values, or of lists of them.
            listed = cast("list[Any]", leaf)
            values = [*chain.from_iterable(listed)] if axes > 1 else listed
            return [values[row] for row in rows.tolist()]
        return leaf.reshape(size, *leaf.shape[axes:])[rows]

    return {
        name: mapped(part, rollout[name])
        for name in ("observation", "action", "reward", "terminated", "truncated")
    }


def _joined(parts: list[dict[str, Any]], last: Any) -> WholeEpisode:
    columns = {name: [part[name] for part in parts] for name in parts[0]}
    columns["observation"].append(last)
    return WholeEpisode(**{name: concatenated(trees) for name, trees in columns.items()})
