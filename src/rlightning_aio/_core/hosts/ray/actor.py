"""`EnvActor`: the envs of one host, in a process that shares no memory with the trainer.

It runs as a Ray actor, but doesn't depend on Ray: its methods are called one after the other, with
arrays, bytes and text. Objects that may have a user's class travel as pickles. Only the methods
here and in `ray_host` unpickle them, and report errors.
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

from rlightning_aio._core.hosts.messages import ErrorText
from rlightning_aio._core.hosts.ray.row_table import RowTable
from rlightning_aio._core.hosts.running.build_env import built_envs
from rlightning_aio._core.hosts.running.runner import close_all, resume_all
from rlightning_aio.protocol.entries import Operation, answers_with_value, op_of, slot_of
from rlightning_aio.protocol.info import InfoSchema, InfoSchemas
from rlightning_aio.protocol.pickling import dumped, dumped_with_code
from rlightning_aio.protocol.slab import Slab

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.hosts.messages import AttachOrder, StartOrder
    from rlightning_aio._core.hosts.ray.row_table import Columns
    from rlightning_aio._core.hosts.running.runner import EnvRunner

_NONE: Final = np.empty(0, np.int64)

__all__ = ["Batch", "EnvActor", "Late", "NotStarted", "Reply"]


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
    """The outcome of a batch; each entry is in one of the first four.

    Attributes:
        done: entries whose whole result is in the columns.
        partial: entries whose result is partly out of band, with that part (a pickle).
        values: of calls, pickled.
        errors: raised by requests.
        columns: results of `done`, then of `partial`; see `RowTable.results`.
        schemas: new schemas of infos, with their numbers.
        saved: checkpoints, as in `messages.Saved`, without the host.
    """

    done: NDArray[np.int64]
    partial: list[tuple[int, bytes]]
    values: list[tuple[int, bytes]]
    errors: list[tuple[int, ErrorText]]
    columns: Columns
    schemas: list[tuple[int, InfoSchema]]
    saved: list[tuple[int, bytes, bool]]

    def with_rows(self) -> NDArray[np.int64]:
        """Return the entries of the results in `columns`, in order."""
        if not self.partial:
            return self.done
        return np.array([*self.done.tolist(), *(entry for entry, _ in self.partial)], np.int64)


class NotStarted(NamedTuple):
    """The env of index `env_index` could not be built."""

    env_index: int
    error: ErrorText


class Late(NamedTuple):
    """A request exceeds its time limit.

    Attributes:
        entry: of the request.
        taken_ns: how long it has taken so far.
        stacks: of all threads.
    """

    entry: int
    taken_ns: int
    stacks: str


class EnvActor:
    """Builds envs and executes batches of requests.

    Args:
        first_slot: slot of its first env in the group.
        limits: in seconds, by operation.
        path: `sys.path` of the trainer; folders that are missing here are appended.
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
        # The current entry and its start (monotonic ns); another thread reads them.
        self._executing = (0, 0)

    def _announce(self, number: int, schema: InfoSchema) -> None:
        self._new_schemas.append((number, schema))

    def _save(self, index: int, checkpoint: bytes, before: bool) -> None:
        self._saved.append((index, checkpoint, before))

    def hello(self) -> None:
        """Return, which shows that a node has started this actor."""

    def build(self, order: bytes) -> bytes | NotStarted:
        """Build the envs, and give each a row in this process.

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
        for index, (runner, (slab, row)) in enumerate(zip(self._runners, places, strict=True)):
            runner.attach(slab, row, self._schemas.announce, partial(self._save, index))
        self._table = RowTable(self._first_slot, places)

    def resume(self, order: AttachOrder) -> NotStarted | None:
        """Seed a replacement and restore its envs."""
        try:
            resume_all(self._runners, order)
        except BaseException as error:
            return NotStarted(0, ErrorText.of(error))
        return None

    def execute(self, batch: Batch) -> Reply:
        """Execute requests one after the other."""
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
                    reply.partial.append((entry, dumped(outcome, "the result")))
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
        """Return when a request exceeds its time limit; runs in its own thread."""
        shortest = min(self._limits.values())
        while True:
            entry, since_ns = self._executing
            limit = self._limits.get(op_of(entry))
            taken_ns = time.monotonic_ns() - since_ns
            if limit is None:
                # A request that begins now has at least this long.
                time.sleep(shortest)
            elif taken_ns < limit * 1e9:
                time.sleep(limit - taken_ns / 1e9)
            else:
                return Late(entry, taken_ns, _stacks())

    def close(self) -> list[tuple[int, ErrorText]]:
        """Close the envs; return what that raised, with their indices."""
        return close_all(self._runners)


def _placed_here(runners: Sequence[EnvRunner]) -> Iterator[tuple[Slab, int]]:
    """Yield a row for each env, in memory of this process; equal layouts share a slab."""
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
    """Return the stacks of all threads."""
    with tempfile.TemporaryFile() as file:
        faulthandler.dump_traceback(file, all_threads=True)
        file.seek(0)
        return file.read().decode(errors="replace")
