"""Records the order in which a group returns its results, and replays it.

With the same seeds and the same policy, everything else follows from that order, so an asynchronous
run can be repeated bit for bit. Both groups here wrap an `EnvGroup` and have all of its methods.
"""

from __future__ import annotations

import struct
from array import array
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from rlightning_aio.batch import joined
from rlightning_aio.collecting.procedure import Procedure, run
from rlightning_aio.errors import EnvFault, NothingPending, ReplayDiverged
from rlightning_aio.group.aio import EnvGroup as AsyncEnvGroup
from rlightning_aio.group.sync import EnvGroup as SyncEnvGroup

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rlightning_aio.batch import BatchedData

__all__ = ["Record", "RecordedGroup", "ReplayedGroup"]

G = TypeVar("G", AsyncEnvGroup, SyncEnvGroup)

_MAGIC: Final = b"rlightning_aio order 1\n"
_STEP, _RESET, _RESTARTED, _FAULT = range(4)
_SAID: Final = ("a step", "a reset", "the first result of a replaced worker", "an error")


class Record:
    """Which envs' results were handed out, call by call: four bytes for each, and for each call.

    It can be stored and read again with `save` and `load`, and pickled.
    """

    def __init__(self) -> None:
        # Calls one behind the other: a count, and for each result 4 * number of its env + kind.
        self._entries = array("I")
        self._env_ids: list[str] = []
        self._numbers: dict[str, int] = {}
        self.num_calls = 0

    def note(self, results: Iterable[tuple[str, int]]) -> None:
        """Add what one call has handed out: env ids, and what kind of result each had."""
        entries = [4 * self._number(env_id) + kind for env_id, kind in results]
        self._entries.append(len(entries))
        self._entries.extend(entries)
        self.num_calls += 1

    def _number(self, env_id: str) -> int:
        number = self._numbers.get(env_id)
        if number is None:
            number = self._numbers[env_id] = len(self._env_ids)
            self._env_ids.append(env_id)
        return number

    def call_at(self, place: int) -> tuple[list[tuple[str, int]], int]:
        """What the call at `place` has handed out, and the place of the next one."""
        first = place + 1
        end = first + self._entries[place]
        entries = self._entries[first:end]
        return [(self._env_ids[entry >> 2], entry & 3) for entry in entries], end

    def __len__(self) -> int:
        """Entries: of each call one, and one for each of its results."""
        return len(self._entries)

    def save(self, path: str | Path) -> None:
        """Write it to a file."""
        names = "\n".join(self._env_ids).encode()
        head = struct.pack("<QQ", self.num_calls, len(names))
        entries = struct.pack(f"<{len(self._entries)}I", *self._entries)
        Path(path).write_bytes(_MAGIC + head + names + entries)

    @classmethod
    def load(cls, path: str | Path) -> Record:
        """Read what `save` has written.

        Raises:
            ValueError: the file holds something else.
        """
        data = Path(path).read_bytes()
        if not data.startswith(_MAGIC):
            raise ValueError(f"{path} is not a record of the order of results")
        start = len(_MAGIC) + 16
        num_calls, length = struct.unpack("<QQ", data[len(_MAGIC) : start])
        record = cls()
        record.num_calls = num_calls
        for env_id in data[start : start + length].decode().split("\n"):
            record._number(env_id)
        entries = data[start + length :]
        record._entries.extend(struct.unpack(f"<{len(entries) // 4}I", entries))
        return record


class _InFront(Generic[G]):
    """Has every method of the group behind it."""

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


class RecordedGroup(_InFront[G]):
    """A group whose `collect_async` keeps account of what it hands out.

    Args:
        group: initialised, asynchronous or not.

    Attributes:
        record: what was handed out so far.
    """

    def __init__(self, group: G) -> None:
        super().__init__(group)
        self.record = Record()

    def collect_async(self, **options: Any) -> Any:
        """As the group's own, to be awaited if that is."""
        return run(self._collect(options), self.group)

    def _collect(self, options: dict[str, Any]) -> Procedure[tuple[BatchedData, list[bool]]]:
        try:
            batch, flags = yield lambda: self.group.collect_async(**options)
        except EnvFault as fault:
            self.record.note([(fault.env_id, _FAULT)])
            raise
        self.record.note(_kinds(batch))
        return batch, flags


class ReplayedGroup(_InFront[G]):
    """A group whose `collect_async` hands results out as a record says, whatever comes when.

    What is there before its turn is kept. The record decides how many results a call returns, so
    of the arguments of `collect_async` only `deadline` matters.

    Args:
        group: initialised, with the envs of the group that was recorded.
        record: what it handed out.
    """

    def __init__(self, group: G, record: Record) -> None:
        super().__init__(group)
        self._record = record
        self._place = self._calls = 0
        self._kept: dict[str, tuple[BatchedData, bool]] = {}
        self._faults: dict[str, EnvFault] = {}

    def collect_async(self, **options: Any) -> Any:
        """As the group's own, to be awaited if that is.

        Raises:
            ReplayDiverged: the record is at its end; or an env can't answer as it did then, as
                it was asked for nothing, or for something else, or its worker was replaced.
        """
        return run(self._collect(options.get("deadline")), self.group)

    def _collect(self, deadline: float | None) -> Procedure[tuple[BatchedData, list[bool]]]:
        if self._place == len(self._record):
            raise ReplayDiverged(
                f"the record ends here, after {self._calls} calls of collect_async; what was not "
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
        """Until all envs of a turn have answered as they did then."""
        while True:
            missing = [env_id for env_id, kind in turn if not self._has(env_id, kind)]
            if not missing:
                return
            options: dict[str, Any] = {"min_results": len(missing), "deadline": deadline}
            try:
                batch, flags = yield partial(self.group.collect_async, ordered=True, **options)
            except NothingPending:
                raise self._diverged(missing[0], "it was asked for nothing") from None
            except EnvFault as fault:
                self._faults[fault.env_id] = fault
                continue
            for k, env_id in enumerate(batch.env_ids()):
                self._kept[env_id] = batch.take([k]), flags[k]

    def _has(self, env_id: str, kind: int) -> bool:
        """Whether an env has answered, with a result of `kind`."""
        if kind == _FAULT and env_id in self._faults:
            return True
        if env_id in self._faults:
            raise self._diverged(env_id, f"its answer was {_SAID[kind]}") from self._faults[env_id]
        if env_id not in self._kept:
            return False
        ((_, found),) = _kinds(self._kept[env_id][0])
        if found != kind:
            raise self._diverged(env_id, f"its answer was {_SAID[kind]}, and is {_SAID[found]} now")
        return True

    def _diverged(self, env_id: str, why: str) -> ReplayDiverged:
        return ReplayDiverged(
            f"the replay left its record in call {self._calls + 1} of collect_async (of "
            f"{self._record.num_calls}): env {env_id!r} is next there, but {why}; replay the same "
            "program with the same seeds and settings"
        )


def _kinds(batch: BatchedData) -> list[tuple[str, int]]:
    """Each result's env, and whether it is a step, a reset or a replaced worker's."""
    count = len(batch)
    resets = batch.is_reset.reshape(count, -1).all(axis=1).astype(int)
    kinds = resets + batch.restarted.reshape(count, -1).all(axis=1)
    return list(zip(batch.env_ids(), kinds.tolist(), strict=True))
