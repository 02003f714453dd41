"""Reads timelines for tests, and checks what must hold for each of them."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path


@dataclass
class Slice:
    """A slice with its times in whole nanoseconds."""

    name: str
    process: str
    track: str
    began: int
    ended: int
    args: dict[str, Any]


def _ns(us: float) -> int:
    return round(us * 1000)


class Seen:
    """The timeline in a file in Chrome's trace event format, checked while it is read.

    Slices of a track nest, every track has a name, and each request has one slice.
    """

    def __init__(self, path: Path) -> None:
        events = json.loads(path.read_text())["traceEvents"]
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
        assert {event["ph"] for event in events} <= set("MX")
        self._check_nested()
        self._check_requests()

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
