"""The protocol of rings and bell, in every order of memory accesses that arm64 permits.

Each scenario has the accesses that `_kernel.c` makes, and what must never be the outcome. With a
fence, release or acquire taken away, the checker finds that outcome, so it finds bugs. The last
tests compare the scenarios with the accesses of the Python twins, recorded as they run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from protocol.memory_model import Access, Program, fence, load, outcomes, store
from protocol.memory_of_rings import both_sides

from rlightning_aio.protocol import exchange, rings
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.exchange import Ring, WorkerSide

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping


@dataclass(frozen=True)
class Scenario:
    """Programs of all processes, and True for an outcome that must not be."""

    programs: tuple[Program, ...]
    is_wrong: Callable[[Mapping[str, int]], bool]

    def weaker(self) -> Iterator[Scenario]:
        """Yield the scenario without each of its orderings."""
        for p, program in enumerate(self.programs):
            for k, access in enumerate(program):
                if access.kind == "fence":
                    found = (*program[:k], *program[k + 1 :])
                elif access.ordered:
                    found = (*program[:k], replace(access, ordered=False), *program[k + 1 :])
                else:
                    continue
                yield replace(self, programs=(*self.programs[:p], found, *self.programs[p + 1 :]))

    def fails(self) -> bool:
        return any(self.is_wrong(values) for values in outcomes(self.programs))


# -- what each side does

SUBMIT: Program = (
    store("row", 1),
    store("request", 1),
    store("sent", 1, release=True),
    fence(),
    load("asleep", "saw asleep"),
)
TAKE: Program = (
    load("sent", "saw sent", acquire=True),
    load("request", "saw request"),
    load("row", "saw action"),
)
FALL_ASLEEP: Program = (store("asleep", 1), fence(), load("sent", "saw sent"))


def report(worker: int, count: int) -> Program:
    """Write a row, report it, and look at the bell, as `serve` does after each entry."""
    return (
        store(f"row {worker} {count}", 1),
        store(f"report {worker} {count}", 1),
        store(f"counter {worker}", count, release=True),
        *look(worker, count),
    )


def look(worker: int, turn: int, workers: int = 2) -> Program:
    """Look at the bell as `is_due` does."""
    return (
        fence(),
        load("armed", f"armed {worker} {turn}"),
        *(load(f"counter {k}", f"{worker} {turn} saw {k}") for k in range(workers)),
    )


def arm(goal: int, workers: int = 2) -> Program:
    return (
        store("armed", goal),
        fence(),
        *(load(f"counter {k}", f"trainer saw {k}") for k in range(workers)),
    )


def nobody_wakes(goal: int, turns: int) -> Callable[[Mapping[str, int]], bool]:
    """Return True for outcomes in which the trainer sleeps though the goal is reached."""

    def is_wrong(values: Mapping[str, int]) -> bool:
        awake = values["trainer saw 0"] + values["trainer saw 1"] >= goal
        rings = any(
            values[f"armed {worker} {turn}"]
            and values[f"{worker} {turn} saw 0"] + values[f"{worker} {turn} saw 1"] >= goal
            for worker in range(2)
            for turn in range(1, turns + 1)
        )
        return not awake and not rings

    return is_wrong


def publish(number: int) -> Program:
    """Publish which request is executed, and since when, as `serve` does before each entry."""
    return store("since", number), store("current", number, release=True)


CLEAR: Program = (store("current", 0),)
WATCH: Program = (load("current", "saw current", acquire=True), load("since", "saw since"))

COMPLETE: Program = (
    load("counter 0", "saw counter", acquire=True),
    load("report 0 1", "saw report"),
    load("row 0 1", "saw row"),
)
# The trainer copies a row out, and then asks for the next result in it.
AGAIN: Program = (load("row", "result"), store("sent", 1, release=True))
OVERWRITE: Program = (load("sent", "saw sent", acquire=True), store("row", 9, given="saw sent"))

SCENARIOS = {
    "the trainer looks at the request in execution while the next one begins": Scenario(
        ((*publish(1), *CLEAR, *publish(2)), WATCH), lambda v: v["saw since"] < v["saw current"]
    ),
    "a reply is read while its request seems to be executed": Scenario(
        ((*publish(1), *CLEAR, store("counter 0", 1, release=True)), (COMPLETE[0], WATCH[0])),
        lambda v: v["saw counter"] == v["saw current"] == 1,
    ),
    "a worker falls asleep while a request is published": Scenario(
        (SUBMIT, FALL_ASLEEP), lambda v: not v["saw asleep"] and not v["saw sent"]
    ),
    "a worker takes a request and its action": Scenario(
        (SUBMIT[:3], TAKE),
        lambda v: bool(v["saw sent"]) and not (v["saw request"] and v["saw action"]),
    ),
    "the trainer reads a report and its row": Scenario(
        (report(0, 1)[:3], COMPLETE),
        lambda v: bool(v["saw counter"]) and not (v["saw report"] and v["saw row"]),
    ),
    "a worker writes a row that was read before": Scenario(
        (AGAIN, OVERWRITE), lambda v: v["result"] == 9
    ),
    **{
        f"two workers report while the trainer arms for {goal}": Scenario(
            (arm(goal), report(0, 1)[2:], report(1, 1)[2:]), nobody_wakes(goal, 1)
        )
        for goal in (1, 2)
    },
    **{
        f"two workers report twice while the trainer arms for {goal}": Scenario(
            (arm(goal), *(report(k, 1)[2:] + report(k, 2)[2:] for k in range(2))),
            nobody_wakes(goal, 2),
        )
        for goal in (1, 3)
    },
    "two workers that look at last report while the trainer arms for 2": Scenario(
        (
            arm(2),
            *((store(f"counter {k}", 1, release=True), *look(k, 1)) for k in range(2)),
        ),
        nobody_wakes(2, 1),
    ),
}


@pytest.mark.parametrize("name", SCENARIOS)
def test_nothing_wrong_can_happen(name: str) -> None:
    """In any order."""
    assert not SCENARIOS[name].fails()


@pytest.mark.parametrize("name", [name for name in SCENARIOS if "twice" not in name])
def test_it_can_with_weaker_orderings(name: str) -> None:
    """The checker finds what goes wrong without a release, an acquire or a fence."""
    assert any(weaker.fails() for weaker in SCENARIOS[name].weaker())


def test_the_checker_knows_what_processors_do() -> None:
    """Both loads of Dekker's rule may miss; with fences, one of them hits."""
    loose = ((store("a", 1), load("b", "x")), (store("b", 1), load("a", "y")))
    found = {(v["x"], v["y"]) for v in outcomes(loose)}
    assert found == {(0, 0), (0, 1), (1, 0), (1, 1)}
    fenced = tuple((program[0], fence(), program[1]) for program in loose)
    assert {(v["x"], v["y"]) for v in outcomes(fenced)} == {(0, 1), (1, 0), (1, 1)}
    behind = ((store("data", 1), store("flag", 1)), (load("flag", "x"), load("data", "y")))
    assert (1, 0) in {(v["x"], v["y"]) for v in outcomes(behind)}


# -- the Python twins make the same accesses


class Recorded:
    """Words that record each access, by name."""

    def __init__(self, trace: list[Access], names: Mapping[int, str], size: int) -> None:
        self.trace, self.names = trace, names
        self.values = [0] * size

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, at: Any) -> Any:
        if isinstance(at, slice):
            found = range(*at.indices(len(self)))
            part = Recorded(self.trace, {}, 0)
            part.values = [self[k] for k in found]
            return part
        if at in self.names:
            self.trace.append(load(self.names[at], ""))
        return self.values[at]

    def __setitem__(self, at: Any, value: Any) -> None:
        if isinstance(at, slice):
            for k, one in zip(range(*at.indices(len(self))), value, strict=True):
                self[k] = int(one)
            return
        if at in self.names:
            self.trace.append(store(self.names[at], 1))
        self.values[at] = value

    def __iter__(self) -> Iterator[int]:
        return iter(self.values)

    def tolist(self) -> list[int]:
        return list(self.values)


def bare(program: Program) -> list[Access]:
    """Return the accesses of a program as a twin makes them: with fences for other orderings."""
    found: list[Access] = []
    for access in program:
        if access.kind == "store" and access.ordered:
            found.append(fence())
        word = access.word
        found.append(replace(access, into="", value=int(access.kind == "store"), ordered=False))
        if access.kind == "load" and access.ordered:
            found.append(fence())
        assert word or access.kind == "fence"
    return found


@pytest.fixture
def trace(monkeypatch: pytest.MonkeyPatch) -> list[Access]:
    """Have the twins order their accesses as on arm64."""
    monkeypatch.setattr(exchange, "IN_ORDER", False)
    return []


STEP = entry(1, 0, Operation.STEP)


def test_submit_and_take_make_these_accesses(trace: list[Access]) -> None:
    """As in the scenarios, without the rows, which others write and read."""
    words: Any = Recorded(
        trace, {exchange.REQUESTS_SENT: "sent", exchange.WORKER_ASLEEP: "asleep"}, 40
    )
    requests: Any = Recorded(trace, {0: "request"}, 2)
    own = memoryview(bytearray(16)).cast("q")
    ring: Any = Ring(words, requests, requests, own, lambda: None)
    exchange.submit(
        np.array([0]), np.array([False]), 1, np.array([0]), np.zeros(1, np.int8), np.array([0]),
        np.array([0]), [0], [ring], lambda: trace.append(fence()),
    )  # fmt: skip
    assert trace == bare(SUBMIT[1:])
    trace.clear()
    counts = memoryview(bytearray(8 * exchange.NUM_COUNTS)).cast("q")
    side: Any = WorkerSide(words, requests, requests, counts, words, 8)
    assert len(exchange.take(side, lambda: trace.append(fence()))) == 1
    assert trace == bare(TAKE[:2])


def test_the_trainer_and_a_worker_agree_on_the_request_in_execution(
    trace: list[Access], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The worker's time is there before its request, and is read after it."""
    monkeypatch.setattr(rings, "IN_ORDER", False)
    _, trainer, worker = both_sides(1)
    names = {exchange.CURRENT: "current", exchange.CURRENT_SINCE_NS: "since"}
    for side, its_fence in ((trainer, "_fence"), (worker, "fence")):
        vars(side)["_words"] = Recorded(trace, names, 40)
        vars(side)[its_fence] = lambda: trace.append(fence())
    worker.begin(STEP, 1)
    assert trace == bare(publish(1))
    trace.clear()
    assert trainer.current() == (0, 0)
    assert trace == bare(WATCH)


def test_the_bell_makes_these_accesses(trace: list[Access]) -> None:
    """When the trainer arms it, and when a worker executes a request and reports."""
    names = {0: "armed", 8: "counter 0", 16: "counter 1"}
    bell: Any = Recorded(trace, names, 24)
    exchange.arm(bell, 1 << exchange.GOAL_SHIFT | 1, lambda: trace.append(fence()))
    assert trace[1:] == bare(arm(1))  # It looks first whether the word stands there.
    trace.clear()
    counts = memoryview(bytearray(8 * exchange.NUM_COUNTS)).cast("q")
    in_execution = {exchange.CURRENT: "current", exchange.CURRENT_SINCE_NS: "since"}
    words: Any = Recorded(trace, in_execution, 40)
    reports: Any = Recorded(trace, {0: "report 0 1"}, 2)
    requests: Any = memoryview(bytearray(16)).cast("q")
    requests[0], words[exchange.REQUESTS_SENT] = STEP, 1
    side = WorkerSide(words, requests, reports, counts, bell, 8)
    exchange.serve(
        side, lambda _: True, lambda *_: None, lambda: None, lambda: None, [lambda: None], 0,
        lambda: trace.append(fence()),
    )  # fmt: skip
    taken = [fence()]
    once_more = bare(look(0, 1)[:2])  # When it has run out of work; it has rung before.
    executed = bare((*publish(1), *CLEAR, *report(0, 1)[1:]))
    assert trace == [*taken, *executed, *once_more]
