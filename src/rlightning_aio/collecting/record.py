"""Records the order of a group's results, and replays it, for a `Collector`.

With the same seeds and the same policy, everything else follows from that order, so an asynchronous
run can be repeated bit for bit. Both groups here wrap an `EnvGroup` and have all of its methods.
"""

from __future__ import annotations

import inspect
import struct
from array import array
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import numpy as np

from rlightning_aio._core.group.api.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio._core.group.api.sync import EnvGroup as SyncEnvGroup
from rlightning_aio.batch import joined
from rlightning_aio.batch.data import parts_of
from rlightning_aio.collecting.procedure import Procedure, run_as_one_call
from rlightning_aio.errors import EnvFault, NothingPending, RLightningError
from rlightning_aio.files import write_file
from rlightning_aio.sealing import seal, unseal

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable

    from rlightning_aio.batch import BatchedData

__all__ = ["Record", "RecordFile", "RecordedGroup", "ReplayedGroup"]

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)

_BEGINNING: Final = b"rlightning-aio record 3\n"
_START: Final = len(seal(_BEGINNING, b""))
_BLOCK: Final = b"block"
_SIZE: Final = 8
"""Bytes of a number before each block: that of the block's bytes."""
_HEAD: Final = struct.Struct("<QQ")
_STEP, _RESET, _RESTARTED, _FAULT = range(4)
_NAMES: Final = ("a step", "a reset", "the first result of a replaced worker", "an error")

_COLLECT: Final = inspect.signature(SyncEnvGroup.collect_async)


class Record:
    """The order of results, call by call: four bytes for each result, and for each call.

    A `RecordFile` saves it.
    """

    def __init__(self) -> None:
        # For each call a count, and for each of its results 4 * the env's number + kind.
        self._entries = array("I")
        self._env_ids: list[str] = []
        self._numbers: dict[str, int] = {}
        self.num_calls = 0

    def note(self, results: Iterable[tuple[str, int]]) -> None:
        """Add one call: the env id and the kind of each result."""
        entries = [4 * self._number(env_id) + kind for env_id, kind in results]
        self._entries.extend([len(entries), *entries])
        self.num_calls += 1

    def _number(self, env_id: str) -> int:
        number = self._numbers.get(env_id)
        if number is None:
            number = self._numbers[env_id] = len(self._env_ids)
            self._env_ids.append(env_id)
        return number

    def call_at(self, place: int) -> tuple[list[tuple[str, int]], int]:
        """Return the results of the call at `place`, and the place of the next call."""
        first = place + 1
        end = first + self._entries[place]
        entries = self._entries[first:end]
        return [(self._env_ids[entry >> 2], entry & 3) for entry in entries], end

    def __len__(self) -> int:
        """Number of entries: one for each call, and one for each result."""
        return len(self._entries)

    def since(self, calls: int, names: int, entries: int) -> bytes:
        """Return what was added to a record that had so many calls, env ids and entries."""
        new_names = "\n".join(self._env_ids[names:]).encode()
        head = _HEAD.pack(self.num_calls - calls, len(new_names))
        new = self._entries[entries:]
        return head + new_names + struct.pack(f"<{len(new)}I", *new)

    def sizes(self) -> tuple[int, int, int]:
        """Return the numbers of calls, env ids and entries."""
        return self.num_calls, len(self._env_ids), len(self._entries)

    def add(self, content: bytes) -> None:
        """Add what `since` returned."""
        calls, length = _HEAD.unpack_from(content)
        names, entries = content[_HEAD.size :][:length], content[_HEAD.size + length :]
        for env_id in filter(None, names.decode().split("\n")):
            self._number(env_id)
        self._entries.extend(struct.unpack(f"<{len(entries) // 4}I", entries))
        self.num_calls += calls

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Record:
        """Read the record that a `RecordFile` has written.

        Raises:
            ValueError: the file holds something else, or was changed or truncated.
            OSError: the file can't be read.
        """
        record = cls()
        data = Path(path).read_bytes()
        try:
            unseal(_BEGINNING, data[:_START])
            place = _START
            while place < len(data):
                size = int.from_bytes(data[place : place + _SIZE], "little")
                end = place + _SIZE + size
                record.add(unseal(_BLOCK, data[place + _SIZE : end]))
                place = end
        except ValueError as error:
            raise ValueError(f"the record in {path} can't be replayed: it {error}") from None
        return record


class RecordFile:
    """Writes a record to a file while it grows.

    Args:
        record: not yet written anywhere.
        path: an existing file is replaced.

    Raises:
        OSError: the file can't be written.
    """

    def __init__(self, record: Record, path: str | os.PathLike[str]) -> None:
        self._record, self._path = record, Path(path).absolute()
        write_file(self._path, seal(_BEGINNING, b""))
        self._size, self._written = _START, (0, 0, 0)

    def write(self) -> None:
        """Add what is new; if that fails, the next call does it.

        Raises:
            OSError: it can't be written.
        """
        sizes = self._record.sizes()
        if sizes == self._written:
            return
        block = seal(_BLOCK, self._record.since(*self._written))
        with self._path.open("r+b") as file:
            file.seek(self._size)
            file.write(len(block).to_bytes(_SIZE, "little") + block)
            file.truncate()
        self._size, self._written = self._size + _SIZE + len(block), sizes


class _WrappedGroup(Generic[G]):
    """Forwards every method to the group that it wraps."""

    def __init__(self, group: G) -> None:
        self.group = group

    def __getattr__(self, name: str) -> Any:
        if name in ("group", "__setstate__"):
            raise AttributeError(name)
        return getattr(self.group, name)

    def __getitem__(self, env_id: str) -> Any:
        return self.group[env_id]

    def __len__(self) -> int:
        return len(self.group)


class RecordedGroup(_WrappedGroup[G]):
    """A group whose `collect_async` records the order of its results.

    Args:
        group: an initialised group, asynchronous or synchronous.

    Attributes:
        record: the results returned so far.
    """

    def __init__(self, group: G) -> None:
        super().__init__(group)
        self.record = Record()
        # The outcome of a call that ended before it was recorded; it is that of the next call.
        self._unrecorded: tuple[BatchedData, list[bool]] | EnvFault | None = None

    @property
    def pending(self) -> list[str]:
        """Ids as in `EnvGroup.pending`, with those of results that were not returned yet."""
        found = self._unrecorded
        kept = [] if found is None else [env_id for env_id, _ in _outcome(found)]
        return list(dict.fromkeys([*self.group.pending, *kept]))

    def collect_async(self, *args: Any, **options: Any) -> Any:
        """Collect like the wrapped group, awaitable if that is asynchronous."""
        return run_as_one_call(
            self._collect(lambda: self.group.collect_async(*args, **options)), self.group
        )

    def _collect(self, collect: Callable[[], Any]) -> Procedure[tuple[BatchedData, list[bool]]]:
        if self._unrecorded is None:
            try:
                self._unrecorded = yield collect
            except EnvFault as fault:
                self._unrecorded = fault
        found: Any = self._unrecorded
        self.record.note(_outcome(found))
        self._unrecorded = None
        if isinstance(found, EnvFault):
            raise found
        return found


class ReplayedGroup(_WrappedGroup[G]):
    """A group whose `collect_async` returns results in the order of a record.

    A result that arrives early is kept until its turn. The record determines how many results a
    call returns, so `collect_async` ignores its arguments other than `deadline`.

    Args:
        group: an initialised group with the envs of the recorded one.
        record: of that group.
    """

    def __init__(self, group: G, record: Record) -> None:
        super().__init__(group)
        self._record = record
        self._place = self._calls = 0
        self._kept: dict[str, tuple[BatchedData, bool]] = {}
        self._faults: dict[str, EnvFault] = {}

    @property
    def pending(self) -> list[str]:
        """Ids as in `EnvGroup.pending`, with those of results that are kept until their turn."""
        return list(dict.fromkeys([*self.group.pending, *self._kept, *self._faults]))

    def collect_async(self, *args: Any, **options: Any) -> Any:
        """Collect the next recorded results, awaitable if the wrapped group is asynchronous.

        Raises:
            RLightningError: the record has ended; or an env can't answer as recorded, because it
                has no request or another one, or because its worker was replaced.
        """
        given = _COLLECT.bind(self.group, *args, **options).arguments
        return run_as_one_call(self._collect(given.get("deadline")), self.group)

    def _collect(self, deadline: float | None) -> Procedure[tuple[BatchedData, list[bool]]]:
        if self._place == len(self._record):
            raise RLightningError(
                f"the record ends after {self._calls} calls of collect_async; what was not "
                "recorded can't be replayed"
            )
        turn, after = self._record.call_at(self._place)
        yield from self._wait_for(turn, deadline)
        self._place, self._calls = after, self._calls + 1
        if turn[0][1] == _FAULT:
            raise self._faults.pop(turn[0][0])
        kept = [self._kept.pop(env_id) for env_id, _ in turn]
        return joined([row for row, _ in kept]), [flag for _, flag in kept]

    def _wait_for(self, turn: list[tuple[str, int]], deadline: float | None) -> Procedure[None]:
        """Wait until all envs of a turn have answered as recorded."""
        while True:
            missing = [env_id for env_id, kind in turn if not self._has(env_id, kind)]
            if not missing:
                return
            options: dict[str, Any] = {"min_results": len(missing), "deadline": deadline}
            try:
                batch, flags = yield partial(self.group.collect_async, **options)
            except NothingPending:
                raise self._diverged(missing[0], "it has no request to answer") from None
            except EnvFault as fault:
                self._faults[fault.env_id] = fault
                continue
            for k, env_id in enumerate(batch.env_ids()):
                self._kept[env_id] = batch.take([k]), flags[k]

    def _has(self, env_id: str, kind: int) -> bool:
        """Return True if an env has answered with a result of `kind`.

        Raises:
            RLightningError: it has answered with another kind.
        """
        if kind == _FAULT and env_id in self._faults:
            return True
        if env_id in self._faults:
            raise self._diverged(env_id, f"its answer was {_NAMES[kind]}") from self._faults[env_id]
        if env_id not in self._kept:
            return False
        ((_, found),) = _kinds(self._kept[env_id][0])
        if found != kind:
            now = f"its answer was {_NAMES[kind]}, and is {_NAMES[found]} now"
            raise self._diverged(env_id, now)
        return True

    def _diverged(self, env_id: str, why: str) -> RLightningError:
        return RLightningError(
            f"the replay differs from its record in call {self._calls + 1} of collect_async (of "
            f"{self._record.num_calls}): env {env_id!r} is next there, but {why}; replay the same "
            "program with the same seeds and settings"
        )


def _outcome(found: tuple[BatchedData, list[bool]] | EnvFault) -> list[tuple[str, int]]:
    """Return the env id and the kind of each result of a call, or of its error."""
    return [(found.env_id, _FAULT)] if isinstance(found, EnvFault) else _kinds(found[0])


def _kinds(batch: BatchedData) -> list[tuple[str, int]]:
    """Return the env id and the kind of each result."""
    kinds = np.empty(len(batch), np.intp)
    for part in parts_of(batch):
        count = len(part)
        resets = part.is_reset.reshape(count, -1).all(axis=1).astype(np.intp)
        lost = 0 if part.restarted is None else part.restarted
        kinds[slice(None) if part.positions is None else part.positions] = resets + lost
    return list(zip(batch.env_ids(), kinds.tolist(), strict=True))
