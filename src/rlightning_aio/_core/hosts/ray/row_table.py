"""`RowTable`: copies rows between a trainer and envs that share no memory with it.

Both sides have a table of the same envs over their own slabs. Requests and results travel as a few
columns, one array each, however many envs there are.
Rule: the entries alone determine the columns and their order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.protocol.columns import leaf_of
from rlightning_aio.protocol.entries import OP_MASK, Operation, slots_of
from rlightning_aio.protocol.info import NO_INFO, PICKLED

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.protocol.slab import Slab

Columns = list["NDArray[Any]"]
"""One array `[rows, ...]` for each column, slab by slab."""


class RowTable:
    """Reads and writes the rows of one host.

    Args:
        first_slot: slot of the env of index 0.
        places: slab and row of each env, by index. On both sides the slabs must first occur in
            the same order.
    """

    def __init__(self, first_slot: int, places: Sequence[tuple[Slab, int]]) -> None:
        self._first_slot = first_slot
        self._slabs = list({id(slab): slab for slab, _ in places}.values())
        position = {id(slab): k for k, slab in enumerate(self._slabs)}
        self._slab = np.array([position[id(slab)] for slab, _ in places], np.intp)
        self._row = np.array([row for _, row in places], np.intp)
        self._inputs = [[column for _, column in slab.action_columns] for slab in self._slabs]
        self._outputs = [_outputs(slab) for slab in self._slabs]

    def requests(self, entries: NDArray[np.int64], *, seeds: bool) -> Columns:
        """Copy the inputs of requests from the rows, and remove the seeds there.

        Args:
            entries: of the requests.
            seeds: the rows hold the seeds of resets.
        """
        columns: Columns = []
        for k, rows, ops in self._parts(entries):
            if len(stepped := rows[ops == Operation.STEP]):
                columns += [column[stepped] for column in self._inputs[k]]
            if seeds and len(reset := rows[ops == Operation.RESET]):
                columns.append(self._slabs[k].seed[reset])
                self._slabs[k].seed[reset] = 0
        return columns

    def put_requests(self, entries: NDArray[np.int64], columns: Columns, *, seeds: bool) -> None:
        """Write the columns that `requests` returned on the other side."""
        values = iter(columns)
        for k, rows, ops in self._parts(entries):
            if len(stepped := rows[ops == Operation.STEP]):
                for column in self._inputs[k]:
                    column[stepped] = next(values)
            if seeds and len(reset := rows[ops == Operation.RESET]):
                self._slabs[k].seed[reset] = next(values)

    def results(self, entries: NDArray[np.int64], info_width: int) -> Columns:
        """Copy results from the rows.

        Args:
            entries: of requests that ended in a result.
            info_width: the most bytes of a row that infos use.
        """
        columns: Columns = []
        for k, rows, _ in self._parts(entries):
            columns += [column[rows] for column in self._outputs[k]]
            marks = columns[-1]
            packed = ((marks != NO_INFO) & (marks != PICKLED)).any()
            columns.append(self._slabs[k].info[rows, : info_width if packed else 0])
        return columns

    def put_results(self, entries: NDArray[np.int64], columns: Columns, done_ns: int) -> None:
        """Write the columns that `results` returned on the other side at `done_ns` (monotonic)."""
        values = iter(columns)
        for k, rows, _ in self._parts(entries):
            for column in self._outputs[k]:
                column[rows] = next(values)
            info = next(values)
            self._slabs[k].info[rows, : info.shape[1]] = info
            # Clocks of different machines can't be compared.
            self._slabs[k].done_ns[rows] = done_ns

    def _parts(
        self, entries: NDArray[np.int64]
    ) -> Iterator[tuple[int, NDArray[np.intp], NDArray[np.int64]]]:
        """Yield each slab that `entries` concern, with their rows and operations."""
        indices = slots_of(entries) - self._first_slot
        ops = entries & OP_MASK
        if len(self._slabs) == 1:
            if len(indices):
                yield 0, self._row[indices], ops
            return
        slabs = self._slab[indices]
        for k in np.flatnonzero(np.bincount(slabs)).tolist():
            chosen = slabs == k
            yield k, self._row[indices[chosen]], ops[chosen]


def _outputs(slab: Slab) -> Columns:
    """Return the columns of a result except the info; the last one is its mark."""
    observation = (
        []
        if slab.observation is None
        else [
            column for _, column in leaf_of(slab.layout.observation_leaves or (), slab.observation)
        ]
    )
    sums = [slab.episode_return, slab.episode_length]
    return [*observation, slab.reward, slab.flags, *sums, slab.busy_ns, slab.info_mark]
