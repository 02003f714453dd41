"""`RowTable`: the rows of a host's envs where trainer and envs share no memory.

Both sides have a table of the same envs, each over slabs of its own. What a request or a
result consists of crosses as a few columns, one array for each, whatever the number of envs.
Rule: both sides find out from the entries alone which columns travel and in which order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rlightning_aio.protocol.columns import leaf_of
from rlightning_aio.protocol.entries import OP_BITS, OP_MASK, SLOT_MASK, Operation
from rlightning_aio.protocol.info import NO_INFO, PICKLED

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.protocol.slab import Slab

__all__ = ["Columns", "RowTable"]

Columns = list["NDArray[Any]"]
"""One array for each column, the rows on its first axis; for each slab in turn."""


class RowTable:
    """See the module.

    Args:
        first_slot: slot of the env of index 0.
        places: slab and row of each env, by index; both sides give an env the same position
            among the slabs, in the order in which they first occur.
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
        """Copies of what the rows hold for the requests of `entries`; takes the seeds away.

        Args:
            entries: of the requests.
            seeds: those of resets lie in the rows.
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
        """Write what `requests` has read on the other side."""
        values = iter(columns)
        for k, rows, ops in self._parts(entries):
            if len(stepped := rows[ops == Operation.STEP]):
                for column in self._inputs[k]:
                    column[stepped] = next(values)
            if seeds and len(reset := rows[ops == Operation.RESET]):
                self._slabs[k].seed[reset] = next(values)

    def results(self, entries: NDArray[np.int64], info_width: int) -> Columns:
        """Copies of the results that the rows of `entries` hold.

        Args:
            entries: of requests that have ended in a result.
            info_width: bytes of a row that infos use, at the most.
        """
        columns: Columns = []
        for k, rows, _ in self._parts(entries):
            columns += [column[rows] for column in self._outputs[k]]
            marks = columns[-1]
            packed = ((marks != NO_INFO) & (marks != PICKLED)).any()
            columns.append(self._slabs[k].info[rows, : info_width if packed else 0])
        return columns

    def put_results(self, entries: NDArray[np.int64], columns: Columns, done_ns: int) -> None:
        """Write what `results` has read on the other side, ready at `done_ns` (monotonic)."""
        values = iter(columns)
        for k, rows, _ in self._parts(entries):
            for column in self._outputs[k]:
                column[rows] = next(values)
            info = next(values)
            self._slabs[k].info[rows, : info.shape[1]] = info
            # The clock of another machine says nothing here.
            self._slabs[k].done_ns[rows] = done_ns

    def _parts(
        self, entries: NDArray[np.int64]
    ) -> Iterator[tuple[int, NDArray[np.intp], NDArray[np.int64]]]:
        """Which slabs are concerned, with the rows and the operations of each."""
        indices = ((entries >> OP_BITS) & SLOT_MASK) - self._first_slot
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
    """What a result writes to its row, but for the info; its mark is the last."""
    observation = (
        []
        if slab.observation is None
        else [
            column for _, column in leaf_of(slab.layout.observation_leaves or (), slab.observation)
        ]
    )
    sums = [slab.episode_return, slab.episode_length]
    return [*observation, slab.reward, slab.flags, *sums, slab.busy_ns, slab.info_mark]
