"""The simulator's programs with real processes, which are killed, do what the model says, too.

As every test, these fail if a process, a descriptor, shared memory or a task is left behind.
`make simulate REAL=1 SEEDS=50` runs more of them.
"""

from __future__ import annotations

import itertools
import logging
from typing import TYPE_CHECKING

import pytest
from simulator.program import draw
from simulator.runs import WORLDLY, run, shown

if TYPE_CHECKING:
    from simulator.program import Program

SLOW = frozenset({"hang"})
"""A hang is noticed after seconds, which are real here."""


def deadly_program(kind: str, *, is_async: bool) -> Program:
    """The first of a kind whose envs end their workers."""
    programs = (draw(seed, without=WORLDLY | SLOW, num_ops=20) for seed in itertools.count())
    return next(
        program
        for program in programs
        if program.kind == kind
        and ("async" in program.features) == is_async
        and "die" in program.features
        and any(plan.placement == "process" for plan in program.plans)
        and not any(plan.start for plan in program.plans)
    )


@pytest.mark.parametrize(
    ("kind", "is_async"), [("group", False), ("group", True), ("evaluations", False)]
)
def test_real_processes_do_what_the_model_says(
    kind: str, is_async: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Groups and evaluations, with workers that die."""
    caplog.set_level(logging.CRITICAL, "rlightning_aio")  # A logger keeps what it enables.
    found = run(deadly_program(kind, is_async=is_async), real=True)
    assert not found.error, shown(found)
