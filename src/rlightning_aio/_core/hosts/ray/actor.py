"""`EnvActor`: the envs of one host, in a process that shares no memory with the trainer.

It runs as a Ray actor, but doesn't depend on Ray: its methods are called one after the other, with
arrays, bytes and text. Objects that may have a user's class travel as pickles. Only the methods
here and in `ray.host` unpickle them, and report errors.
Rule: one call executes the requests of a batch in turn, and answers each of them. Each side copies
rows by a `RowTable`.
"""

from __future__ import annotations

import pickle
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rlightning_aio._core.hosts.completion_frames import SENDER, frame_of
from rlightning_aio._core.hosts.messages import Built, NewSchema
from rlightning_aio._core.hosts.running.build_env import built_envs, not_built
from rlightning_aio._core.hosts.running.execution import execute
from rlightning_aio._core.hosts.running.runner import close_all, give_rows
from rlightning_aio.protocol.entries import OP_MASK, Operation, slot_of, slots_of
from rlightning_aio.protocol.frames import FrameKind
from rlightning_aio.protocol.info import NO_INFO, PICKLED
from rlightning_aio.protocol.slab import Slab, rows_for
from rlightning_aio.trees import walked

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import Completion, StartOrder
    from rlightning_aio._core.hosts.running.runner import EnvRunner
    from rlightning_aio.protocol.error_text import ErrorText
    from rlightning_aio.protocol.frames import Frame


Columns = list["NDArray[Any]"]
"""One array `[rows, ...]` for each column, slab by slab."""


class RowTable:
    """Copies rows between a trainer and envs that share no memory with it.

    Both sides have a table of the same envs over their own slabs. Requests and results travel as a
    few columns, one array each, however many envs there are. The entries alone determine the
    columns and their order.

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
    in_rows = slab.observation is not None
    observation = [column for _, column in walked(slab.observation)] if in_rows else []
    sums = [slab.episode_return, slab.episode_length]
    return [*observation, slab.reward, slab.flags, *sums, slab.busy_ns, slab.info_mark]


class Batch(NamedTuple):
    """Requests to envs of one actor.

    Attributes:
        entries: in the order of execution.
        columns: their inputs, see `RowTable.requests`.
        arguments: packed, one for each; None if they are in the columns.
    """

    entries: NDArray[np.int64]
    columns: Columns
    arguments: Sequence[bytes] | None


class Reply(NamedTuple):
    """The outcome of a batch.

    Attributes:
        done: entries whose whole result is in the columns.
        frames: all other completions, in order.
        columns: results of `done`, then those that the frames complete; see `RowTable.results`.
    """

    done: NDArray[np.int64]
    frames: list[Frame]
    columns: Columns

    def with_rows(self) -> NDArray[np.int64]:
        """Return the entries of the results in `columns`, in order."""
        partial = [frame.number for frame in self.frames if frame.kind == FrameKind.RESULT]
        return np.array([*self.done.tolist(), *partial], np.int64) if partial else self.done


class EnvActor:
    """Builds envs and executes batches of requests.

    Args:
        first_slot: slot of its first env in the group.
        path: `sys.path` of the trainer; folders that are missing here are appended.
    """

    def __init__(self, first_slot: int, path: Sequence[str]) -> None:
        sys.path += [place for place in path if place not in sys.path]
        self._first_slot = first_slot
        self._runners: list[EnvRunner] = []
        self._frames: list[Frame] = []
        self._info_width = 0

    def _post(self, completion: Completion) -> None:
        """Have the next reply report a completion."""
        if isinstance(completion, NewSchema):
            self._info_width = max(self._info_width, completion.schema.size)
        self._frames.append(frame_of(completion))

    def hello(self) -> None:
        """Return, which shows that a node has started this actor."""

    def build(self, order: bytes, is_replacement: bool = False) -> Frame:
        """Build the envs, and give each a row in this process.

        Args:
            order: a `StartOrder`, pickled.
            is_replacement: of an actor before this one.

        Returns `Built` or `NotBuilt`.
        """
        given: StartOrder | None = None
        try:
            given = pickle.loads(order)
            assert given is not None
            is_again = given.is_again or is_replacement
            given = replace(given, trainer_pid=None, is_again=is_again)
            for runner in built_envs(given):
                self._runners.append(runner)
            places = list(_placed_here(self._runners))
            give_rows(places, SENDER, self._post)
            self._table = RowTable(self._first_slot, [(slab, row) for _, slab, row in places])
            return frame_of(Built(SENDER, [runner.started() for runner in self._runners]))
        except BaseException as error:
            return frame_of(not_built(SENDER, given, len(self._runners), error))

    def execute(self, batch: Batch) -> Reply:
        """Execute requests one after the other."""
        entries, columns, arguments = batch
        self._table.put_requests(entries, columns, seeds=arguments is None)
        in_rows: list[int] = []
        for position, entry in enumerate(entries.tolist()):
            runner = self._runners[slot_of(entry) - self._first_slot]
            given = None if arguments is None else arguments[position]
            completion = execute(SENDER, runner, entry, given)
            if completion is None:
                in_rows.append(entry)
            else:
                self._post(completion)
        reply = Reply(np.array(in_rows, np.int64), self._frames, [])
        self._frames = []
        return reply._replace(columns=self._table.results(reply.with_rows(), self._info_width))

    def close(self) -> list[tuple[int, ErrorText]]:
        """Close the envs; return what that raised, with their indices."""
        return close_all(self._runners)


def _placed_here(runners: Sequence[EnvRunner]) -> Iterator[tuple[EnvRunner, Slab, int]]:
    """Yield each env with a row in memory of this process; equal layouts share a slab."""
    sizes, places = rows_for([runner.layout for runner in runners])
    slabs = [Slab(one, memoryview(bytearray(one.size(rows))), rows) for one, rows in sizes]
    for runner, (slab, row) in zip(runners, places, strict=True):
        yield runner, slabs[slab], row
