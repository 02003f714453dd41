"""`EnvActor`: the envs of one host, in a process that shares no memory with the trainer.

It runs as a Ray actor, but knows nothing of Ray: its methods are called one after the other,
and what they take and return are arrays, bytes and text. What a user's class is part of travels
as bytes, which only the methods here and `hosts.ray` read, where whatever that raises is told.
Rule: one call executes the requests of a batch in turn, and answers each of them.
"""

from __future__ import annotations

import faulthandler
import pickle
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.hosts.build_env import built_envs
from rlightning_aio.hosts.messages import ErrorText
from rlightning_aio.hosts.pickling import dumped, dumped_with_code
from rlightning_aio.hosts.row_table import RowTable
from rlightning_aio.hosts.runner import close_all, resume_all
from rlightning_aio.protocol.entries import Operation, answers_with_value, op_of, slot_of
from rlightning_aio.protocol.info import InfoSchema, InfoSchemas
from rlightning_aio.protocol.slab import Slab

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio.hosts.messages import StartOrder
    from rlightning_aio.hosts.row_table import Columns
    from rlightning_aio.hosts.runner import EnvRunner

_NONE: Final = np.empty(0, np.int64)

__all__ = ["Batch", "EnvActor", "Late", "NotStarted", "Reply"]


class Batch(NamedTuple):
    """Requests to envs of one actor.

    Attributes:
        entries: in the order in which they are executed.
        columns: what lies in the rows for them, see `RowTable.requests`.
        arguments: packed, one for each; None where they lie in the rows.
    """

    entries: NDArray[np.int64]
    columns: Columns
    arguments: Sequence[bytes] | None


class Reply(NamedTuple):
    """What has become of a batch; each of its entries is in one of the first four.

    Attributes:
        done: those whose result lies in the columns and nowhere else.
        beside: the others that have a result, with what of it is out of band (a pickle).
        values: of calls, pickled.
        errors: what requests have raised.
        columns: results of `done`, then of `beside`; see `RowTable.results`.
        schemas: in which infos lie, where they are new, with their numbers.
        saved: standings, as of `messages.Saved` but for the host.
    """

    done: NDArray[np.int64]
    beside: list[tuple[int, bytes]]
    values: list[tuple[int, bytes]]
    errors: list[tuple[int, ErrorText]]
    columns: Columns
    schemas: list[tuple[int, InfoSchema]]
    saved: list[tuple[int, bytes, bool]]

    def with_rows(self) -> NDArray[np.int64]:
        """Entries of the results that `columns` hold, in their order."""
        if not self.beside:
            return self.done
        return np.array([*self.done.tolist(), *(entry for entry, _ in self.beside)], np.int64)


class NotStarted(NamedTuple):
    """The env of that index could not be built."""

    env_index: int
    error: ErrorText


class Late(NamedTuple):
    """A request takes longer than it may.

    Attributes:
        entry: of the request.
        taken_ns: how long it has taken so far.
        stacks: of all threads.
    """

    entry: int
    taken_ns: int
    stacks: str


class EnvActor:
    """See the module.

    Args:
        first_slot: slot of its first env in the group.
        limits: how many seconds an operation may take.
        path: where the trainer finds modules; what of it this process lacks is looked at last.
    """

    def __init__(self, first_slot: int, limits: Mapping[int, float], path: Sequence[str]) -> None:
        sys.path += [place for place in path if place not in sys.path]
        self._first_slot = first_slot
        self._limits = limits
        self._runners: list[EnvRunner] = []
        self._new_schemas: list[tuple[int, InfoSchema]] = []
        self._schemas = InfoSchemas(self._announce)
        self._saved: list[tuple[int, bytes, bool]] = []
        self._info_width = 0
        # Entry and beginning (monotonic ns) of what is being executed; read by another thread.
        self._executing = (0, 0)

    def _announce(self, number: int, schema: InfoSchema) -> None:
        self._new_schemas.append((number, schema))

    def _keep(self, index: int, standing: bytes, before: bool) -> None:
        self._saved.append((index, standing, before))

    def hello(self) -> None:
        """Returns: so there is a place for it."""

    def build(self, order: bytes) -> bytes | NotStarted:
        """Build the envs, and give each a row here.

        Args:
            order: a `StartOrder`, pickled.

        Returns:
            `EnvStarted` of each, pickled.
        """
        given: StartOrder | None = None
        try:
            given = pickle.loads(order)
            assert given is not None
            given = replace(given, trainer_pid=None)
            for runner in built_envs(given):
                self._runners.append(runner)
            started = dumped_with_code([runner.started() for runner in self._runners])
            self._attach()
        except BaseException as error:
            index = len(self._runners)
            if given is not None:
                index = min(index, len(given.worker_indices) - 1)
            return NotStarted(index, ErrorText.of(error))
        return started

    def _attach(self) -> None:
        places = list(_placed_here(self._runners))
        for runner, (slab, row) in zip(self._runners, places, strict=True):
            runner.attach(slab, row, self._schemas.announce)
        for index, runner in enumerate(self._runners):
            runner.keep_with(partial(self._keep, index))
        self._table = RowTable(self._first_slot, places)

    def resume(self, standings: Sequence[bytes | None]) -> NotStarted | None:
        """Have the envs of a replacement stand where they were kept."""
        try:
            resume_all(self._runners, standings)
        except BaseException as error:
            return NotStarted(0, ErrorText.of(error))
        return None

    def execute(self, batch: Batch) -> Reply:
        """Execute requests, one after the other."""
        entries, columns, arguments = batch
        self._table.put_requests(entries, columns, seeds=arguments is None)
        done: list[int] = []
        reply = Reply(_NONE, [], [], [], [], [], [])
        for position, entry in enumerate(entries.tolist()):
            self._executing = entry, time.monotonic_ns()
            given = None if arguments is None else arguments[position]
            try:
                outcome = self._execute(entry, given)
                if answers_with_value(op_of(entry)):
                    reply.values.append((entry, dumped(outcome, "what it returned")))
                elif outcome is None:
                    done.append(entry)
                else:
                    reply.beside.append((entry, dumped(outcome, "the result")))
            except BaseException as error:
                reply.errors.append((entry, ErrorText.of(error)))
        self._executing = 0, 0
        return self._with_rows(reply._replace(done=np.array(done, np.int64)))

    def _execute(self, entry: int, arguments: bytes | None) -> Any:
        runner, op = self._runners[slot_of(entry) - self._first_slot], op_of(entry)
        if arguments is not None:
            return runner.execute(op, pickle.loads(arguments))
        return runner.step() if op == Operation.STEP else runner.reset_from_row()

    def _with_rows(self, reply: Reply) -> Reply:
        schemas, self._new_schemas = self._new_schemas, []
        self._info_width = max([self._info_width, *(schema.size for _, schema in schemas)])
        columns = self._table.results(reply.with_rows(), self._info_width)
        saved, self._saved = self._saved, []
        return reply._replace(columns=columns, schemas=schemas, saved=saved)

    def watch(self) -> Late:
        """Return when a request takes longer than it may; runs in a thread of its own."""
        shortest = min(self._limits.values())
        while True:
            entry, since_ns = self._executing
            limit = self._limits.get(op_of(entry))
            taken_ns = time.monotonic_ns() - since_ns
            if limit is None:
                # What begins from now on may take as long at least.
                time.sleep(shortest)
            elif taken_ns < limit * 1e9:
                time.sleep(limit - taken_ns / 1e9)
            else:
                return Late(entry, taken_ns, _stacks())

    def close(self) -> list[tuple[int, ErrorText]]:
        """Close the envs; what that raised, by index."""
        return close_all(self._runners)


def _placed_here(runners: Sequence[EnvRunner]) -> Iterator[tuple[Slab, int]]:
    """A row for each env, in memory of this process; those of one layout share a slab."""
    counts: dict[tuple[object, ...], int] = {}
    for runner in runners:
        counts[runner.layout.key] = counts.get(runner.layout.key, 0) + 1
    slabs: dict[tuple[object, ...], Slab] = {}
    rows = dict.fromkeys(counts, 0)
    for runner in runners:
        layout = runner.layout
        key, count = layout.key, counts[layout.key]
        if key not in slabs:
            slabs[key] = Slab(layout, memoryview(bytearray(layout.size(count))), count)
        yield slabs[key], rows[key]
        rows[key] += 1


def _stacks() -> str:
    """What every thread of this process is doing."""
    with tempfile.TemporaryFile() as file:
        faulthandler.dump_traceback(file, all_threads=True)
        file.seek(0)
        return file.read().decode(errors="replace")
