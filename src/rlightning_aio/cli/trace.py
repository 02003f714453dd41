"""``rlightning-aio trace``: what a timeline says, as text.

Rule: everything is computed from the file alone. A span of the trainer counts without those within
it. The first track of a worker is its own, and the others are those of its envs.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass, field
from pathlib import Path  # noqa: TC003 (Typer reads annotations)
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from rlightning_aio._core.group.timeline.file import TRAINER
from rlightning_aio.cli.terminal import (
    count,
    counted,
    named_columns,
    out,
    print_json,
    print_table,
)
from rlightning_aio.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

__all__ = ["trace"]

_WAITING: Final = frozenset({"collect_async", "step", "reset", "restore"})
"""Calls that wait for envs; they return results in "hand out", which counts by itself."""
_NUM_SHOWN: Final = 10
_MUCH: Final = 0.3
"""A side starves if it waits for this part of the time."""


class _Slice(NamedTuple):
    pid: int
    tid: int
    name: str
    began: float
    seconds: float
    args: Mapping[str, Any]

    @property
    def ended(self) -> float:
        return self.began + self.seconds


@dataclass
class _Env:
    """What an env did; `busy` and `longest` in seconds."""

    env_id: str
    worker: str
    steps: int = 0
    resets: int = 0
    busy: float = 0.0
    longest: float = 0.0


@dataclass
class _Worker:
    """Seconds in which one of its envs was busy, none had a request, and it was being replaced."""

    name: str
    envs: int
    busy: float = 0.0
    idle: float = 0.0
    replaced: float = 0.0
    events: dict[str, int] = field(default_factory=dict[str, int])


@dataclass
class _Summary:
    """What the command prints; times in seconds, `at` since the start of the recording."""

    seconds: float
    seconds_not_kept: float
    trainer: dict[str, float]
    trainer_waits: float
    workers_idle: float
    verdict: str
    workers: list[_Worker]
    envs: list[_Env]
    slowest: list[dict[str, Any]]
    events: list[dict[str, Any]]


def trace(
    file: Annotated[
        Path, typer.Argument(help="Timeline, as `--trace FILE` writes it.", show_default=False)
    ],
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON document instead of the text.")
    ] = False,
) -> None:
    """Say where the time of a timeline went, by worker and env.

    Which side starves (the trainer, or the envs), the slowest steps, deaths and restarts. Record
    a timeline by `rollout --trace run.json`, or in a program by `group.trace("run.json")`.

    For example:

        rlightning-aio rollout cartpole.yaml --trace run.json
        rlightning-aio trace run.json
    """
    summary = _Reader(file).summary()
    if as_json:
        print_json(asdict(summary))
    else:
        _print(file, summary)


class _Reader:
    """Reads a timeline."""

    def __init__(self, path: Path) -> None:
        try:
            document = json.loads(path.read_bytes())
            events: list[dict[str, Any]] = document["traceEvents"]
            self._seconds_not_kept: float = document["otherData"]["seconds_not_kept"]
        except OSError as error:
            raise ConfigError(f"{path}: {error.strerror}") from None
        except (ValueError, KeyError, TypeError):
            raise ConfigError(
                f"{path} is no timeline; `rlightning-aio rollout CONFIG --trace FILE` writes one"
            ) from None
        self._processes: dict[int, str] = {}
        self._tracks: dict[tuple[int, int], str] = {}
        self._slices: list[_Slice] = []
        self._marks: list[dict[str, Any]] = []
        for event in events:
            self._read(event)
        own: dict[int, int] = {}
        for pid, tid in self._tracks:
            own[pid] = min(tid, own.get(pid, tid))
        self._own = set(own.items())

    def _read(self, event: dict[str, Any]) -> None:
        kind, pid, tid = event["ph"], event["pid"], event.get("tid", 0)
        if kind == "X":
            times = event["ts"] / 1e6, event["dur"] / 1e6
            self._slices.append(_Slice(pid, tid, event["name"], *times, event.get("args", {})))
        elif kind == "i":
            self._marks.append(event)
        elif event["name"] == "process_name":
            self._processes[pid] = event["args"]["name"]
        elif event["name"] == "thread_name":
            self._tracks[pid, tid] = event["args"]["name"]

    def summary(self) -> _Summary:
        began = min((one.began for one in self._slices), default=0.0)
        seconds = max((one.ended for one in self._slices), default=0.0) - began
        trainer = self._trainer()
        workers, envs = self._workers(), self._envs()
        waits = sum(spent for name, spent in trainer.items() if name in _WAITING)
        waits = min(1.0, waits / seconds) if seconds else 0.0
        all_of_them = seconds * len(workers) or 1.0
        idle = sum(worker.idle for worker in workers.values()) / all_of_them
        busy = sum(worker.busy for worker in workers.values()) / all_of_them
        return _Summary(
            seconds,
            self._seconds_not_kept,
            trainer,
            waits,
            idle,
            _verdict(waits, idle, busy),
            list(workers.values()),
            list(envs.values()),
            self._slowest(),
            self._events(),
        )

    def _trainer(self) -> dict[str, float]:
        """Seconds by the name of a span, without the spans within it; most first."""
        found: Counter[str] = Counter()
        lanes: dict[int, list[_Slice]] = defaultdict(list)
        for one in self._slices:
            if one.pid == TRAINER:
                lanes[one.tid].append(one)
        for slices in lanes.values():
            around: list[_Slice] = []
            for one in sorted(slices, key=lambda each: (each.began, -each.seconds)):
                while around and around[-1].ended <= one.began:
                    around.pop()
                if around:
                    found[around[-1].name] -= one.seconds  # pyright: ignore[reportArgumentType]
                found[one.name] += one.seconds  # pyright: ignore[reportArgumentType]
                around.append(one)
        return {name: max(0.0, float(spent)) for name, spent in found.most_common()}

    def _envs(self) -> dict[tuple[int, int], _Env]:
        found = {
            place: _Env(name, self._processes[place[0]])
            for place, name in self._tracks.items()
            if place[0] != TRAINER and place not in self._own
        }
        for one in self._slices:
            if "request" in one.args:
                env = found[one.pid, one.tid]
                env.steps += one.name == "step"
                env.resets += one.name == "reset"
                env.busy += one.seconds
                env.longest = max(env.longest, one.seconds)
        return found

    def _workers(self) -> dict[int, _Worker]:
        places = Counter(pid for pid, tid in self._tracks if (pid, tid) not in self._own)
        found = {
            pid: _Worker(name, places[pid])
            for pid, name in self._processes.items()
            if pid != TRAINER
        }
        turns: dict[int, list[tuple[float, float]]] = defaultdict(list)
        for one in self._slices:
            if one.name == "being replaced":
                found[one.pid].replaced += one.seconds
            elif one.name == "waiting for work":
                found[one.pid].idle += one.seconds
            elif one.pid != TRAINER and (one.pid, one.tid) not in self._own:
                turns[one.pid].append((one.began, one.ended))
        for pid, times in turns.items():
            found[pid].busy = _covered(times)
        for mark in self._marks:
            events = found[mark["pid"]].events
            events[mark["name"]] = events.get(mark["name"], 0) + 1
        return found

    def _slowest(self) -> list[dict[str, Any]]:
        steps = [one for one in self._slices if "request" in one.args or "," in one.name]
        steps = [one for one in steps if one.pid != TRAINER]
        steps.sort(key=lambda one: -one.seconds)
        return [
            {
                "env_id": self._tracks[one.pid, one.tid],
                "what": one.name,
                "seconds": one.seconds,
                "at": one.began,
            }
            for one in steps[:_NUM_SHOWN]
        ]

    def _events(self) -> list[dict[str, Any]]:
        """Deaths, hangs, lost episodes and whatever else has a mark, but step limits."""
        return [
            {
                "what": mark["name"],
                "where": self._tracks[mark["pid"], mark["tid"]],
                "worker": self._processes[mark["pid"]],
                "at": mark["ts"] / 1e6,
                "cause": mark.get("args", {}).get("cause", ""),
            }
            for mark in self._marks
            if mark["name"] != "step limit"
        ]


def _covered(times: Iterable[tuple[float, float]]) -> float:
    """Seconds that at least one of the periods covers."""
    total, until = 0.0, float("-inf")
    for began, ended in sorted(times):
        total += max(0.0, ended - max(began, until))
        until = max(until, ended)
    return total


def _verdict(waits: float, idle: float, busy: float) -> str:
    if waits > _MUCH and idle > _MUCH:
        return (
            "Both sides starve: the trainer waits for some envs while others have nothing to do. "
            "Collect fewer results at a time (min_results), or find the env that is slow."
        )
    if waits > _MUCH and busy < _MUCH:
        return (
            "The trainer starves, but not for the envs' code: steps are short compared with the "
            "way to a worker. Give each request more work (num_envs), or use placement: inline."
        )
    if waits > _MUCH:
        return (
            "The trainer starves: it waits for envs. Faster steps, or more workers if there are "
            "cores, make it faster."
        )
    if idle > _MUCH:
        return (
            "The envs starve: they wait for the trainer. Collect fewer results at a time "
            "(min_results), or move the learner out of the way."
        )
    return "Neither side starves."


def _print(path: Path, summary: _Summary) -> None:
    console, total = out(), summary.seconds or 1.0
    steps = sum(env.steps for env in summary.envs)
    envs, workers = counted(len(summary.envs), "env"), counted(len(summary.workers), "worker")
    console.print(f"{path}: {summary.seconds:.3g} s, {count(steps)} steps of {envs} in {workers}")
    if summary.seconds_not_kept:
        console.print(f"{summary.seconds_not_kept:.3g} s before that were not kept")
    console.print(
        f"The trainer waits for envs {summary.trainer_waits:.0%} of the time, and workers have "
        f"nothing to do {summary.workers_idle:.0%} of it. {summary.verdict}",
        soft_wrap=True,
    )
    rows = [
        (name, f"{spent:.3g}", f"{spent / total:.0%}") for name, spent in summary.trainer.items()
    ]
    _table("trainer", ("", "s", "of the time"), rows)
    rows = [
        (
            one.name,
            count(one.envs),
            f"{one.busy / total:.0%}",
            f"{one.idle / total:.0%}",
            f"{one.replaced:.3g}",
            _text(one),
        )
        for one in summary.workers[:_NUM_SHOWN]
    ]
    _table("workers", ("", "envs", "busy", "without work", "s being replaced", "events"), rows)
    busiest = sorted(summary.envs, key=lambda one: -one.busy)[:_NUM_SHOWN]
    rows = [
        (
            one.env_id,
            one.worker,
            count(one.steps),
            f"{one.busy / total:.0%}",
            f"{1e3 * one.busy / max(1, one.steps + one.resets):.3g}",
            f"{1e3 * one.longest:.3g}",
        )
        for one in busiest
    ]
    title = "envs" if len(busiest) == len(summary.envs) else f"the {_NUM_SHOWN} busiest envs"
    _table(title, ("", "worker", "steps", "busy", "mean ms", "longest ms"), rows)
    slowest = [
        (one["env_id"], one["what"], f"{1e3 * one['seconds']:.3g}", f"{one['at']:.3f}")
        for one in summary.slowest
    ]
    _table("slowest requests", ("", "", "ms", "at s"), slowest)
    rows = [
        (one["what"], one["where"], one["worker"], f"{one['at']:.3f}", one["cause"])
        for one in summary.events[:_NUM_SHOWN]
    ]
    title = (
        "faults"
        if len(rows) == len(summary.events)
        else f"faults, {_NUM_SHOWN} of {len(summary.events)}"
    )
    _table(title, ("", "", "worker", "at s", "cause"), rows)


def _text(worker: _Worker) -> str:
    return ", ".join(f"{name}: {number}" for name, number in worker.events.items())


def _table(title: str, columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    if not rows:
        return
    table = named_columns(title, *columns, texts=("", "worker", "events", "cause"))
    for row in rows:
        table.add_row(*row)
    out().print()
    print_table(out(), table)
