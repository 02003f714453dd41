"""Runs of programs: in a world or for real, many at once, each twice, and shrunk if one fails."""

from __future__ import annotations

import gc
import logging
import os
import signal
import traceback
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from kit import checked
from simulator.attempting import Attempts
from simulator.coverage import watch
from simulator.play import Play
from simulator.program import CLIENTS, draw
from simulator.training import Evaluations, Training
from simulator.vectors import Singles, Vectors
from simulator.world import World

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from simulator.program import Op, Program
    from simulator.session import Session


WORLDLY: Final = frozenset({"ray", "faults", CLIENTS})
"""Features that only a world has."""

SESSIONS: Final[dict[str, type[Session]]] = {
    "group": Play,
    "training": Training,
    "evaluations": Evaluations,
    "vectors": Vectors,
    "sb3": Singles,
    "attempts": Attempts,
}

transitions: Counter[str] = Counter()
"""What `coverage` has counted in this run."""


@dataclass
class Run:
    """What came of a run.

    Attributes:
        error: the traceback, if it failed; kind: its class and the beginning of its message.
        trace: what happened in its world, a line each.
    """

    program: Program
    error: str = ""
    kind: str = ""
    trace: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    hours: float = 0.0


def run(program: Program, *, real: bool = False) -> Run:
    """Play a program, with real processes or in a world."""
    found = Run(program)
    if real:
        _play(SESSIONS[program.kind](program), found)
        return found
    # Both implementations of the hot path must do the same.
    implementation = "python" if program.seed % 2 else "c"
    with World(program.seed, program.faults, implementation=implementation) as world:
        _play(SESSIONS[program.kind](program, world), found)
        found.trace, found.hours = world.trace, world.hours
        found.counts += world.counts
    return found


def _play(play: Session, found: Run) -> None:
    try:
        play.run()
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  # Whatever it is, it is the result.
        found.error = traceback.format_exc()
        found.kind = (
            f"{type(error).__name__}: {str(error).splitlines()[0][:40] if str(error) else ''}"
        )
    found.counts += play.counts + transitions
    transitions.clear()


def run_twice(program: Program) -> Run:
    """Play a program in two worlds, which must be the same."""
    one = run(program)
    if one.error:
        return one
    other = run(program)
    if other.trace != one.trace:
        pairs = enumerate(zip(one.trace, other.trace, strict=False))
        at = next((k for k, (line, again) in pairs if line != again), len(one.trace))
        shown = [*one.trace[max(at - 3, 0) : at + 1], "in place of", *other.trace[at : at + 1]]
        one.kind, one.error = "another trace", "\n".join(["not the same twice:", *shown])
    return one


def prepare() -> None:
    """Make a process ready for many runs."""
    # Envs press Ctrl-C, also where it is ignored: in the background of a shell.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    checked.install()
    watch(transitions)
    logging.getLogger("rlightning_aio").setLevel(logging.CRITICAL)
    gc.collect()
    gc.freeze()


def run_seeds(
    seeds: Sequence[int], without: frozenset[str], *, real: bool, once: bool
) -> list[Run]:
    """Run the programs of some seeds; the runs that went well come without trace."""
    found: list[Run] = []
    for seed in seeds:
        program = draw(seed, without=without)
        one = run(program, real=real) if real or once else run_twice(program)
        if not one.error:
            one.trace = []
        found.append(one)
    return found


def run_many(
    seeds: Sequence[int], without: frozenset[str], *, real: bool, once: bool
) -> Iterator[Run]:
    """Run the programs of many seeds on all cores."""
    size = max(1, min(20, len(seeds) // (os.cpu_count() or 1)))
    pieces = [seeds[k : k + size] for k in range(0, len(seeds), size)]
    with ProcessPoolExecutor(initializer=prepare) as pool:
        futures = [pool.submit(run_seeds, piece, without, real=real, once=once) for piece in pieces]
        try:
            for future in futures:
                yield from future.result()
        finally:  # Whoever asks may have seen enough.
            pool.shutdown(cancel_futures=True)


def shrunk(failed: Run, runs: Callable[[Program], Run]) -> Run:
    """The smallest program that fails in the same way: fewer operations, simpler entries."""

    def fails(program: Program) -> Run | None:
        found = runs(program)
        return found if found.kind == failed.kind else None

    best = failed
    size = max(1, len(best.program.ops) // 2)
    while size:
        best, size = _without_ops(best, size, fails)
    for simpler in _simpler(best.program):
        best = fails(simpler(best.program)) or best
    return best


def _without_ops(best: Run, size: int, fails: Callable[[Program], Run | None]) -> tuple[Run, int]:
    """Leave out as many operations at a time; return what to try next."""
    at, is_smaller = 0, False
    while at < len(best.program.ops):
        ops: tuple[Op, ...] = best.program.ops
        found = fails(replace(best.program, ops=ops[:at] + ops[at + size :]))
        if found is None:
            at += size
        else:
            best, is_smaller = found, True
    return best, size if is_smaller else size // 2


def _simpler(program: Program) -> Iterator[Callable[[Program], Program]]:
    """Changes that may make a program simpler."""
    for name in program.faults.__dataclass_fields__:
        yield lambda p, n=name: replace(p, faults=replace(p.faults, **{n: 0.0}))
    for feature in sorted(program.features):
        yield lambda p, f=feature: replace(p, features=p.features - {f})
    for number in range(len(program.plans) - 1, 0, -1):
        yield lambda p, k=number: replace(p, plans=p.plans[:k])
    for number in range(len(program.plans)):
        for fields in (
            {"num_workers": 1},
            {"limit": None},
            {"layout": "vector"},
        ):
            yield lambda p, k=number, f=fields: replace(
                p, plans=tuple(replace(q, **f) if j == k else q for j, q in enumerate(p.plans))
            )


def shown(found: Run) -> str:
    """A failed run, to be read."""
    program = found.program
    lines = [
        f"seed {program.seed}: {found.kind}",
        f"features: {', '.join(sorted(program.features))}",
    ]
    lines += [f"faults: {program.faults}", *map(str, program.plans)]
    lines += [f"{number}: {op}" for number, op in enumerate(program.ops)]
    return "\n".join([*lines, "", *found.trace, "", found.error])
