"""The compiled kernel does what its Python twins do, whatever lies in shared memory.

Each scenario runs once with every implementation, on memory of its own, and must have the same
results, errors and memory.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from rlightning_aio.protocol import exchange, kernel
from rlightning_aio.protocol.entries import Operation, entry
from rlightning_aio.protocol.exchange import (
    ARMED,
    CAREFUL,
    FRAMES_TO_TRAINER,
    FRAMES_TO_WORKER,
    LINE,
    NUM_COUNTS,
    REQUESTS_SENT,
    Ring,
    Row,
    WorkerSide,
)
from rlightning_aio.protocol.info import PICKLED

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

COMPILED = kernel.compiled()
compiled_only = pytest.mark.skipif(COMPILED is None, reason="the compiled kernel was not built")
ANY = st.integers(-(1 << 63), (1 << 63) - 1)
NEAR = st.integers(-3, 12)
WORD = st.one_of(NEAR, ANY)


def words(count: int) -> memoryview[int]:
    return memoryview(bytearray(8 * count)).cast("q")


def outcome_of(function: Callable[[], Any]) -> Any:
    try:
        return function()
    except Exception as error:  # noqa: BLE001
        return type(error), str(error)


def same(scenario: Callable[[ModuleType], Any]) -> Any:
    """Run a scenario with each implementation; return what all of them return."""
    expected = scenario(exchange)
    if COMPILED is not None:
        assert scenario(COMPILED) == expected
    return expected


# -- the trainer

HOSTS, ENVS = 3, 4
HOST_OF = np.repeat(np.arange(HOSTS), ENVS)


class Trainer:
    """The tables of a trainer, and rings that anybody has written to."""

    def __init__(self, present: list[bool], shared: list[list[int]]) -> None:
        self.rings: list[Any] = []
        for is_there, contents in zip(present, shared, strict=True):
            memory = words(5 * LINE)
            memory[FRAMES_TO_TRAINER] = contents[0]
            memory[exchange.WORKER_ASLEEP] = contents[1]
            requests, reports = np.zeros(8, np.int64), np.array(contents[2:10])
            ring = Ring(memory, requests, reports, words(2), lambda: None)
            self.rings.append(ring if is_there else None)
        self.entry = np.array([entry(7, slot, Operation.STEP) for slot in range(HOSTS * ENVS)])
        self.state = np.zeros(HOSTS * ENVS, np.int8)
        self.sent_ns = np.zeros(HOSTS * ENVS, np.int64)
        self.in_flight = [ENVS] * HOSTS

    def seen(self) -> Any:
        rings = [
            ring and (ring.words.tolist(), ring.requests.tolist(), ring.own.tolist())
            for ring in self.rings
        ]
        columns = self.entry.tolist(), self.state.tolist(), self.sent_ns.tolist()
        return rings, columns, self.in_flight


CURRENT = st.integers(0, HOSTS * ENVS - 1).map(lambda slot: entry(7, slot, Operation.STEP))
CONTENTS = st.tuples(
    st.integers(-1, 1), st.booleans().map(int), *[st.one_of(CURRENT, CURRENT, ANY)] * 8
).map(list)
RINGS = st.lists(CONTENTS, min_size=HOSTS, max_size=HOSTS)
MOSTLY = st.sampled_from([True] * 8 + [False])


@given(
    shared=RINGS,
    present=st.lists(MOSTLY, min_size=HOSTS, max_size=HOSTS),
    counts=st.lists(st.one_of(st.integers(0, 9), WORD), min_size=HOSTS, max_size=HOSTS),
    read=st.integers(0, 9),
)
def test_complete_survives_any_contents_of_the_rings(
    shared: list[list[int]], present: list[bool], counts: list[int], read: int
) -> None:
    """Reports, counters and frames may hold anything: it returns slots that exist, or None."""

    def scenario(implementation: ModuleType) -> Any:
        trainer = Trainer(present, shared)
        bell = words(LINE * (HOSTS + 1))
        known = words(HOSTS + 1)
        for host, count in enumerate(counts):
            bell[LINE * (host + 1)] = count
            known[host] = read
        found = implementation.complete(
            bell[LINE::LINE], known, trainer.entry, trainer.in_flight, trainer.rings, fence
        )
        slots = None if found is None else found.tolist()
        return slots, known.tolist(), trainer.seen()

    fence = exchange.new_fence()
    slots = same(scenario)[0]
    assert slots is None or all(0 <= slot < HOSTS * ENVS for slot in slots)


@given(
    shared=RINGS,
    slots=st.permutations(range(HOSTS * ENVS)),
    count=st.integers(1, HOSTS * ENVS),
    resets=st.integers(0, (1 << HOSTS * ENVS) - 1),
    sent=st.integers(0, 1 << 62),
)
def test_submit_numbers_and_publishes(
    shared: list[list[int]], slots: list[int], count: int, resets: int, sent: int
) -> None:
    """In the order of the batch, wherever the rings begin; it returns the rings of sleepers."""

    def scenario(implementation: ModuleType) -> Any:
        trainer = Trainer([True] * HOSTS, shared)
        for ring in trainer.rings:
            ring.own[exchange.SENT] = sent
        asleep = implementation.submit(
            np.array(slots[:count]),
            np.array([bool(resets >> k & 1) for k in range(count)]),
            123,
            trainer.entry,
            trainer.state,
            trainer.sent_ns,
            HOST_OF,
            trainer.in_flight,
            trainer.rings,
            exchange.new_fence(),
        )
        numbers = [[ring is one for ring in trainer.rings].index(True) for one in asleep]
        return numbers, trainer.seen()

    same(scenario)


COLUMNS = st.lists(
    arrays.arrays(
        st.sampled_from([np.float64, np.float32, np.int64, np.uint8, np.bool_, np.float16]),
        st.tuples(st.just(6), st.integers(0, 3), st.integers(1, 3)).map(
            lambda shape: shape[: 1 + shape[1] % 3]
        ),
    ),
    max_size=4,
)


@given(columns=COLUMNS, rows=st.lists(st.integers(0, 5), max_size=9), last=st.integers(0, 7))
def test_gather_copies_rows(columns: list[Any], rows: list[int], last: int) -> None:
    """Of any shape, by index or in a range; they keep their types."""
    for chosen in (np.array(rows, np.intp), slice(0, last)):
        for implementation in (exchange, COMPILED or exchange):
            strided = [column[:, :1] if column.ndim == 2 else column for column in columns]
            for given_columns in (columns, strided):
                found = implementation.gather(given_columns, chosen)
                for copy, column in zip(found, given_columns, strict=True):
                    np.testing.assert_array_equal(copy, column[chosen])
                    assert copy.dtype == column.dtype
                    assert copy.flags.writeable
                    assert not np.shares_memory(copy, column)


# -- the worker


@given(
    sent=st.one_of(st.integers(0, 10), WORD),
    entries=st.lists(
        st.one_of(
            st.integers(0, 5).map(lambda slot: entry(3, slot, Operation.STEP)),
            st.integers(0, 5).map(lambda slot: entry(3, slot, Operation.RESET)),
            ANY,
        ),
        min_size=8,
        max_size=8,
    ),
    armed=WORD,
    counters=st.lists(WORD, min_size=2, max_size=2),
    careful=st.booleans(),
    frames=st.integers(0, 1),
    child_after=st.integers(0, 9),
)
@example(  # the sum of these counters has more than 64 bits
    sent=1,
    entries=[entry(3, 0, Operation.STEP)] * 8,
    armed=1,
    counters=[1, (1 << 63) - 1],
    careful=False,
    frames=0,
    child_after=0,
)
def test_serve_survives_any_contents_of_the_rings(
    sent: int,
    entries: list[int],
    armed: int,
    counters: list[int],
    careful: bool,
    frames: int,
    child_after: int,
) -> None:
    """It reports, executes and rings as its twin does, or raises the same error."""

    def scenario(implementation: ModuleType) -> Any:
        events: list[Any] = []
        began = time.monotonic_ns()
        own = words(NUM_COUNTS)
        own[CAREFUL] = careful
        bell = words(3 * LINE)
        bell[ARMED], bell[LINE], bell[2 * LINE] = armed, *counters
        side = WorkerSide(words(5 * LINE), words(8), words(8), own, bell, LINE)
        side.words[REQUESTS_SENT], side.words[FRAMES_TO_WORKER] = sent, frames
        for position, one in enumerate(entries):
            side.requests[position] = one

        def step(name: int, outcome: Any) -> Any:
            events.append(("step", name, executed()))
            if len(events) == child_after:
                own[CAREFUL] = 1
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        def executed() -> int:
            if current := side.words[exchange.CURRENT]:
                assert began <= side.words[exchange.CURRENT_SINCE_NS] <= time.monotonic_ns()
            return current

        def receive() -> None:
            events.append(("receive", executed()))
            own[exchange.FRAMES_SEEN] += 1

        outcomes = (None, {"info": 1}, KeyError("no"), None)
        found = outcome_of(
            lambda: implementation.serve(
                side,
                lambda request: events.append(("execute", request, executed())) or request % 2 == 0,
                lambda request, outcome: events.append(
                    ("finish", request, str(outcome), executed())
                ),
                lambda: events.append(("ring", executed())),
                receive,
                [lambda k=k, one=one: step(k, one) for k, one in enumerate(outcomes)],
                1,
                exchange.new_fence(),
            )
        )
        return found, events, own.tolist(), bell.tolist(), side.reports.tolist(), executed()

    same(scenario)


def test_what_a_worker_cannot_send_ends_its_loop() -> None:
    """An error of `finish` or `ring` is the worker's own."""

    def scenario(implementation: ModuleType) -> Any:
        side = WorkerSide(words(5 * LINE), words(8), words(8), words(5), words(2 * LINE), LINE)
        side.words[REQUESTS_SENT] = 2
        side.requests[0] = side.requests[1] = entry(1, 0, Operation.STEP)
        side.bell[ARMED] = 1 << exchange.GOAL_SHIFT | 1

        def gone(*_: object) -> NoReturn:
            raise BrokenPipeError("gone")

        arguments = (gone, gone, gone, gone, [lambda: None], 0, exchange.new_fence())
        return outcome_of(lambda: implementation.serve(side, *arguments)), side.own.tolist()

    assert same(scenario)[0] == (BrokenPipeError, "gone")


NUMBERS = st.one_of(
    st.floats(allow_nan=False),
    st.integers(-9, 9),
    st.booleans(),
    st.floats(-9, 9, width=32).map(np.float32),
    st.sampled_from([None, "1", np.ones(2), 1 << 2000, np.float64(2.5), np.int64(3)]),
)
ENDS = st.sampled_from([False, False, False, True, np.True_, np.False_, 0, 1])
OBSERVATIONS = st.sampled_from(
    [
        np.arange(3, dtype=np.float32),
        np.arange(3.0),
        np.arange(6, dtype=np.float32)[::2],
        [4, 5, 6],
        b"twelve bytes",
        np.arange(2),
    ]
)
INFOS = st.sampled_from([{}, {}, {"a": 1}, {"b": 2.0}, None])
RESULTS = st.one_of(
    st.tuples(OBSERVATIONS, NUMBERS, ENDS, ENDS, INFOS),
    st.tuples(OBSERVATIONS, NUMBERS, ENDS, ENDS, INFOS).map(list),
    st.sampled_from([None, 3, (1, 2), (1, 2, 3, 4, 5, 6)]),
)


@given(results=st.lists(RESULTS, min_size=1, max_size=12), resets_itself=st.booleans())
def test_row_step_writes_what_its_twin_writes(results: list[Any], resets_itself: bool) -> None:
    """Results of all kinds in a row, also malformed ones, whose errors have the same text."""

    def scenario(implementation: ModuleType) -> Any:
        row = Row(
            memoryview(bytearray(8)).cast("d"),
            memoryview(bytearray(4)).cast("?"),
            memoryview(bytearray(8)).cast("d"),
            words(1),
            memoryview(bytearray(1)),
            words(2),
            np.zeros(3, np.float32),
        )
        seen: list[Any] = []
        waiting = iter(results)

        def write_observation(value: Any) -> None:
            row.observation[...] = value

        execute = implementation.row_step(
            row,
            lambda action: seen.append(action) or next(waiting),
            lambda: "from the row",
            write_observation,
            lambda what, value: float(f"{what} {value}" if value is None else 7),
            lambda info: PICKLED if "b" in info else 9,
            lambda kept: {**kept, "kept": True},
            resets_itself,
        )
        for _ in results:
            seen.append(outcome_of(execute))
            columns = [column.tolist() for column in row[:5]]
            seen.append((columns, row.observation.tolist(), row.times[0] > 0))
        return seen

    same(scenario)


# -- buffers that don't fit


@compiled_only
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("arm", (b"12345678", 1, None)),
        ("arm", (memoryview(bytearray(12))[4:], 1, None)),
        ("arm", (words(0), 1, None)),
        ("arm", (np.zeros((2, 2), np.int64), 1, None)),
        ("is_due", (words(8), words(2), None)),
        ("is_due", (words(0), words(NUM_COUNTS), None)),
        ("complete", (words(2), words(2), words(2), [0, 0], [None, None], None)),
        ("complete", (words(1), words(2), words(2), [], [None], None)),
        ("complete", (words(1), memoryview(bytes(16)).cast("q"), words(2), [0], [None], None)),
        ("gather", ([np.array([None])], slice(0, 1))),
        ("gather", ([np.zeros(3)], np.array([3]))),
        ("gather", ([np.zeros(3)], np.array([-1]))),
        ("gather", ([np.zeros(3)], slice(0, 3, 2))),
        ("gather", ([np.zeros((3, 4))[:, ::2]], slice(0, 3))),
        ("gather", ([np.zeros(())], slice(0, 1))),
        ("gather", (None, slice(0, 1))),
        ("serve", ((), print, print, print, print, [], 0, None)),
        (
            "serve",
            (
                WorkerSide(words(40), words(3), words(3), words(5), words(16), LINE),
                *[print] * 4, [], 0, None,
            ),
        ),
        (
            "serve",
            (
                WorkerSide(words(40), words(4), words(4), words(5), words(16), 16),
                *[print] * 4, [], 0, None,
            ),
        ),
        ("row_step", ((), print, print, print, print, print, print, True)),
        ("row_step", ((words(1),) * 7, print, print, print, print, print, print, True)),
    ],
)  # fmt: skip
def test_buffers_that_do_not_fit_are_refused(name: str, arguments: tuple[Any, ...]) -> None:
    """Before anything is read or written through them."""
    assert COMPILED is not None
    with pytest.raises((TypeError, ValueError, IndexError, BufferError)):
        getattr(COMPILED, name)(*arguments)


@compiled_only
@pytest.mark.parametrize(
    "change",
    [
        {"slots": np.array([HOSTS * ENVS])},
        {"slots": np.array([-1])},
        {"slots": np.array([0.0])},
        {"resets": np.zeros(2, np.bool_)},
        {"state": np.zeros(1, np.int8)},
        {"hosts": np.full(HOSTS * ENVS, HOSTS)},
        {"rings": [None] * HOSTS},
        {"rings": [()] * HOSTS},
        {"rings": [Ring(words(1), np.zeros(8, np.int64), None, words(2), print)] * HOSTS},
        {"rings": [Ring(words(40), np.zeros(6, np.int64), None, words(2), print)] * HOSTS},
        {"in_flight": []},
    ],
)
def test_submit_refuses_tables_that_do_not_fit(change: dict[str, Any]) -> None:
    """Whatever the trainer's own mistake: it never writes beyond an array."""
    assert COMPILED is not None
    trainer = Trainer([True] * HOSTS, [[0] * 10] * HOSTS)
    with pytest.raises((TypeError, ValueError, IndexError, AssertionError)):
        COMPILED.submit(
            change.get("slots", np.array([0])),
            change.get("resets", np.zeros(1, np.bool_)),
            1,
            trainer.entry,
            change.get("state", trainer.state),
            trainer.sent_ns,
            change.get("hosts", HOST_OF),
            change.get("in_flight", trainer.in_flight),
            change.get("rings", trainer.rings),
            None,
        )


# -- which implementation


def chosen(wanted: str) -> subprocess.CompletedProcess[str]:
    """Ask a new interpreter which implementation it uses."""
    return subprocess.run(
        [sys.executable, "-c", "from rlightning_aio.cli import main; main()", "--version"],
        env={**os.environ, kernel.VARIABLE: wanted},
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_variable_chooses() -> None:
    """The version tells which one is active; one that doesn't exist is an error."""
    assert "(hot path: python)" in chosen("python").stdout
    compiled = chosen("c")
    if COMPILED is None:
        assert compiled.returncode == 2
        assert "no compiled kernel" in compiled.stderr
    else:
        assert "(hot path: c)" in compiled.stdout
    wrong = chosen("rust")
    assert wrong.returncode == 2
    assert wrong.stderr == "error: RLIGHTNING_AIO_IMPL must be python or c, not 'rust'\n"
