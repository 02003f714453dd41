"""Reads timelines for tests, and checks what must hold for each of them."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

SENDING = {"step", "step_async", "reset", "reset_async", "restore"}
TRAINER = 1
"""The trainer's process in the file."""


@dataclass
class Slice:
    """A slice with its times in whole nanoseconds."""

    name: str
    process: str
    track: str
    began: int
    ended: int
    args: dict[str, Any]

    def holds(self, at: int) -> bool:
        return self.began <= at <= self.ended


def _ns(us: float) -> int:
    return round(us * 1000)


class Seen:
    """The timeline in a file in Chrome's trace event format, checked while it is read.

    Slices of a track nest; every track has a name; each flow leads from a call that sends through
    the slice of an env to the call that hands out its result; and each request has one result.
    """

    def __init__(self, path: Path) -> None:
        document = json.loads(path.read_text())
        self.seconds_not_kept: float = document["otherData"]["seconds_not_kept"]
        events = document["traceEvents"]
        named = {
            (event["name"], event["pid"], event.get("tid")): event["args"]["name"]
            for event in events
            if event["ph"] == "M" and event["name"].endswith("_name")
        }
        self.tracks = [
            (named["process_name", pid, None], name)
            for (kind, pid, _), name in named.items()
            if kind == "thread_name"
        ]
        self._place = {
            (pid, tid): (named["process_name", pid, None], name)
            for (kind, pid, tid), name in named.items()
            if kind == "thread_name"
        }
        self.slices = [self._slice(event) for event in events if event["ph"] == "X"]
        self.marks = [
            (event["name"], *self._place[event["pid"], event["tid"]], event.get("args", {}))
            for event in events
            if event["ph"] == "i"
        ]
        assert {event["ph"] for event in events} <= set("MXistf")
        self._check_nested()
        self._check_requests()
        self.flows = self._check_flows([event for event in events if event["ph"] in "stf"])

    def _slice(self, event: dict[str, Any]) -> Slice:
        began = _ns(event["ts"])
        assert event["dur"] >= 0
        ended = began + _ns(event["dur"])
        place = self._place[event["pid"], event["tid"]]
        return Slice(event["name"], *place, began, ended, event.get("args", {}))

    def of(self, track: str) -> list[Slice]:
        """Return the slices of the track with that name."""
        return [one for one in self.slices if one.track == track]

    def called(self, name: str) -> list[Slice]:
        return [one for one in self.slices if one.name == name]

    def results(self) -> list[Slice]:
        return [one for one in self.slices if "request" in one.args]

    def _check_nested(self) -> None:
        by_track: defaultdict[tuple[str, str], list[Slice]] = defaultdict(list)
        for one in self.slices:
            by_track[one.process, one.track].append(one)
        for slices in by_track.values():
            around: list[Slice] = []
            for one in sorted(slices, key=lambda each: (each.began, -each.ended)):
                while around and around[-1].ended <= one.began:
                    around.pop()
                assert not around or one.ended <= around[-1].ended, (one, around[-1])
                around.append(one)

    def _check_requests(self) -> None:
        numbers = Counter((one.process, one.track, one.args["request"]) for one in self.results())
        assert set(numbers.values()) <= {1}

    def _check_flows(self, events: list[dict[str, Any]]) -> int:
        ends: defaultdict[int, dict[str, Any]] = defaultdict(dict)
        for event in events:
            assert event["ph"] not in ends[event["id"]]
            ends[event["id"]][event["ph"]] = event
        by_place: defaultdict[tuple[str, str], list[Slice]] = defaultdict(list)
        for one in self.slices:
            by_place[one.process, one.track].append(one)
        starts = {(one.process, one.track, one.began) for one in self.results()}
        for flow in ends.values():
            assert flow.keys() == set("stf")
            sent, stepped, taken = (flow[phase] for phase in "stf")
            assert sent["ts"] <= stepped["ts"]
            assert sent["ts"] <= taken["ts"]
            place = self._place[stepped["pid"], stepped["tid"]]
            assert (*place, _ns(stepped["ts"])) in starts
            for end, names in ((sent, SENDING), (taken, {"hand out"})):
                assert end["pid"] == TRAINER
                own = by_place[self._place[end["pid"], end["tid"]]]
                assert any(one.name in names and one.holds(_ns(end["ts"])) for one in own)
        return len(ends)
