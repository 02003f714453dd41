"""Convert a timeline to Chrome's trace event format, which Perfetto opens.

The file has one process for the trainer and one for each host. The first track of a host is for its
worker, followed by one track per env. The trainer has a track for each task or thread. A flow
connects the sending of a request, its execution in the env, and the return of its result.
Rule: slices of a track nest.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from rlightning_aio.protocol.entries import NUMBER_SHIFT, OP_MASK, Operation, slots_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from rlightning_aio._core.group.timeline.records import Mark, Span, TracedResults
    from rlightning_aio.outcomes import Outcome

__all__ = ["SENDING", "TRAINER", "HostTrack", "Timeline", "events"]

SENDING: Final = frozenset({"step", "step_async", "reset", "reset_async", "restore"})
"""Names of spans that send requests with results."""
_NAMES: Final = {
    int(Operation.STEP): "step",
    int(Operation.RESET): "reset",
    int(Operation.RESTORE): "restore",
    int(Operation.JOIN): "joined",
}
TRAINER: Final = 1
"""Number of the trainer among the processes; those of hosts follow."""


@dataclass(frozen=True)
class HostTrack:
    """The names of a host and its tracks.

    Attributes:
        own: name of the track for events without an env.
        env_names: of its envs, in the order of their slots from `first_slot`.
    """

    name: str
    own: str
    first_slot: int
    env_names: Sequence[str]


@dataclass(frozen=True)
class Timeline:
    """The content of a trace file. Times in ns of the monotonic clock.

    Attributes:
        began: the start of the recording; since: the start of the part that was kept completely.
        lanes: names of the tracks of the trainer.
    """

    began: int
    since: int
    lanes: Sequence[str]
    hosts: Sequence[HostTrack]
    spans: Sequence[Span]
    results: TracedResults
    marks: Sequence[Mark]


class _Slice(NamedTuple):
    name: str
    began: int
    ended: int
    text: str = ""


def events(timeline: Timeline) -> Iterator[str]:
    """The events of the trace, each as JSON."""
    return _Events(timeline).all()


class _Events:
    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self._base = timeline.began
        count = max((host.first_slot + len(host.env_names) for host in timeline.hosts), default=0)
        # By slot. Track numbers are unique over all processes of the file.
        self._host_of = np.zeros(count, np.int64)
        self._track_of = np.zeros(count, np.int64)
        self._host_tracks: list[int] = []
        track = len(timeline.lanes) + 1
        for host_id, host in enumerate(timeline.hosts):
            self._host_tracks.append(track)
            slots = np.arange(len(host.env_names)) + host.first_slot
            self._host_of[slots] = host_id
            self._track_of[slots] = track + 1 + np.arange(len(slots))
            track += 1 + len(slots)
        self._results = timeline.results.where(timeline.results.sent >= timeline.since)
        self._slots = slots_of(self._results.entries)

    def all(self) -> Iterator[str]:
        yield from self._named()
        spans = self._spans()
        for lane, slices in sorted(spans.items()):
            yield from self._slices(TRAINER, lane + 1, slices)
        yield from self._steps()
        yield from self._host_slices()
        yield from self._marks()
        yield from self._flows(spans)

    # -- names ------------------------------------------------------------------------

    def _named(self) -> Iterator[str]:
        yield from _process(TRAINER, "trainer")
        for lane, name in enumerate(self._timeline.lanes):
            yield from _thread(TRAINER, lane + 1, name)
        for host_id, host in enumerate(self._timeline.hosts):
            pid, track = _pid(host_id), self._host_tracks[host_id]
            yield from _process(pid, host.name)
            yield from _thread(pid, track, host.own)
            for index, name in enumerate(host.env_names):
                if name:  # A member's slot may be free.
                    yield from _thread(pid, track + 1 + index, name)

    # -- slices -----------------------------------------------------------------------

    def _spans(self) -> dict[int, list[_Slice]]:
        """The slices of the trainer by lane, in order."""
        since = self._timeline.since
        lanes: dict[int, list[_Slice]] = {}
        for span in self._timeline.spans:
            if span.ended > since:
                began = max(span.began, since)
                lanes.setdefault(span.lane, []).append(_Slice(span.name, began, span.ended))
        return {lane: nested(slices) for lane, slices in lanes.items()}

    def _slices(self, pid: int, tid: int, slices: Iterable[_Slice]) -> Iterator[str]:
        head, base = f'"ph":"X","pid":{pid},"tid":{tid}', self._base
        for name, began, ended, text in slices:
            yield (
                f'{{"name":{json.dumps(name)},{head},"ts":{(began - base) / 1e3},'
                f'"dur":{(ended - began) / 1e3}{_cause(text)}}}'
            )

    def _times(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The times at which the env began and ended each request."""
        # A member uses another clock, so only the duration of its steps is known.
        began = np.maximum(self._results.done - self._results.busy, self._results.sent)
        return began, np.maximum(self._results.done, began)

    def _steps(self) -> Iterator[str]:
        began, ended = self._times()
        rows = zip(
            (self._results.entries & OP_MASK).tolist(),
            _pid(self._host_of[self._slots]).tolist(),
            self._track_of[self._slots].tolist(),
            self._us(began),
            ((ended - began) / 1e3).tolist(),
            (self._results.entries >> NUMBER_SHIFT).tolist(),
            strict=True,
        )
        for op, pid, tid, ts, dur, number in rows:
            yield (
                f'{{"name":"{_NAMES[op]}","ph":"X","pid":{pid},"tid":{tid},"ts":{ts},'
                f'"dur":{dur},"args":{{"request":{number}}}}}'
            )

    def _host_slices(self) -> Iterator[str]:
        """The slices of the hosts' own tracks: idle time, and marks without an env."""
        _, ended = self._times()
        hosts = self._host_of[self._slots]
        slices: dict[int, list[_Slice]] = {}
        for host_id in range(len(self._timeline.hosts)):
            own = np.flatnonzero(hosts == host_id)
            idle = _gaps(self._results.sent[own], ended[own])
            slices[host_id] = [_Slice("waiting for work", *gap) for gap in idle]
        for mark in self._kept_marks():
            if mark.slot < 0 and mark.began:
                slices[mark.host_id].append(_Slice(mark.name, mark.began, mark.at, mark.text))
        for host_id, found in slices.items():
            yield from self._slices(_pid(host_id), self._host_tracks[host_id], nested(found))

    # -- marks and flows --------------------------------------------------------------

    def _kept_marks(self) -> list[Mark]:
        since = self._timeline.since
        return [
            mark._replace(began=max(mark.began, since) if mark.began else 0)
            for mark in self._timeline.marks
            if mark.at >= since
        ]

    def _marks(self) -> Iterator[str]:
        """Marks without a duration, and those of envs with one; `_host_slices` has the rest."""
        for mark in self._kept_marks():
            pid, on_env = _pid(mark.host_id), mark.slot >= 0
            tid = int(self._track_of[mark.slot]) if on_env else self._host_tracks[mark.host_id]
            if not mark.began:
                yield (
                    f'{{"name":"{mark.name}","ph":"i","s":"t","pid":{pid},"tid":{tid},'
                    f'"ts":{(mark.at - self._base) / 1e3}{_cause(mark.text, mark.outcome)}}}'
                )
            elif on_env:
                one = _Slice(mark.name, mark.began, mark.at, mark.text)
                yield from self._slices(pid, tid, [one])

    def _flows(self, spans: dict[int, list[_Slice]]) -> Iterator[str]:
        """The flows from requests to results; requests outside any known span have none."""
        sends = sorted(
            (span.began, span.ended, lane)
            for lane, slices in spans.items()
            for span in slices
            if span.name in SENDING
        )
        begins = [began for began, _, _ in sends]
        began, _ = self._times()
        rows = zip(
            (self._results.entries & OP_MASK).tolist(),
            self._results.sent.tolist(),
            self._us(self._results.sent),
            _pid(self._host_of[self._slots]).tolist(),
            self._track_of[self._slots].tolist(),
            self._us(began),
            self._results.lanes.tolist(),
            self._us(self._results.taken),
            strict=True,
        )
        for number, (op, sent, ts, pid, tid, step_ts, lane, taken_ts) in enumerate(rows, 1):
            place = bisect_right(begins, sent) - 1
            if op == Operation.JOIN or place < 0 or sends[place][1] < sent:
                continue
            head = f'"name":"request","cat":"request","id":{number}'
            sender = sends[place][2] + 1
            yield f'{{{head},"ph":"s","pid":{TRAINER},"tid":{sender},"ts":{ts}}}'
            yield f'{{{head},"ph":"t","pid":{pid},"tid":{tid},"ts":{step_ts}}}'
            yield (f'{{{head},"ph":"f","bp":"e","pid":{TRAINER},"tid":{lane + 1},"ts":{taken_ts}}}')

    def _us(self, times: NDArray[np.int64]) -> list[float]:
        return ((times - self._base) / 1e3).tolist()


def _pid(host_id: Any) -> Any:
    return host_id + TRAINER + 1


def _cause(text: str, outcome: Outcome | None = None) -> str:
    args: dict[str, str] = {"cause": text} if text else {}
    if outcome is not None:
        args = {"kind": outcome.kind, "blame": outcome.blame, "cause": outcome.cause}
    return f',"args":{json.dumps(args)}' if args else ""


def _process(pid: int, name: str) -> Iterator[str]:
    head = f'"ph":"M","pid":{pid}'
    yield f'{{"name":"process_name",{head},"args":{{"name":{json.dumps(name)}}}}}'
    yield f'{{"name":"process_sort_index",{head},"args":{{"sort_index":{pid}}}}}'


def _thread(pid: int, tid: int, name: str) -> Iterator[str]:
    head = f'"ph":"M","pid":{pid},"tid":{tid}'
    yield f'{{"name":"thread_name",{head},"args":{{"name":{json.dumps(name)}}}}}'
    yield f'{{"name":"thread_sort_index",{head},"args":{{"sort_index":{tid}}}}}'


def nested(slices: list[_Slice]) -> list[_Slice]:
    """The slices of one track in order, each cut at the end of its enclosing slice."""
    found: list[_Slice] = []
    around: list[int] = []
    for one in sorted(slices, key=lambda each: (each.began, -each.ended)):
        while around and around[-1] <= one.began:
            around.pop()
        ended = min(one.ended, around[-1]) if around else one.ended
        around.append(ended)
        found.append(one._replace(ended=ended))
    return found


def _gaps(sent: NDArray[np.int64], ended: NDArray[np.int64]) -> list[tuple[int, int]]:
    """The periods without requests in flight, between the first request and the last."""
    order = np.argsort(sent, kind="stable")
    begins = sent[order][1:]
    until = np.maximum.accumulate(ended[order])[:-1]
    idle = begins > until
    return list(zip(until[idle].tolist(), begins[idle].tolist(), strict=True))
