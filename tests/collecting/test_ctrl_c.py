"""Ctrl-C at any moment of a synchronous collect: the next one asks for a restart."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from collecting.test_interruptions import Numbered, failing, parts_of, steps_of
from faults.striking import struck

from rlightning_aio import sync
from rlightning_aio.collecting import Collector, Rollout
from rlightning_aio.errors import NothingPending, ResetNeeded

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.batch import BatchedData

STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "97"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than a collect executes."""


class Short(Numbered):
    """An episode has three steps."""

    length = 3


def check(found: list[Rollout]) -> None:
    """Each env has made its transitions from the begin of an episode, each once and in order."""
    for steps in steps_of(found).values():
        assert steps[0][1] == 0
        for (episode, step), following in itertools.pairwise(steps):
            assert following == ((episode, step + 1) if step < 2 else (episode + 1, 0))


@pytest.fixture(scope="module")
def group() -> Iterator[sync.EnvGroup]:
    """Two entries, each with two envs in one worker."""
    entries = [
        {"name": name, "task": [partial(Short, k) for k in numbers], "envs_per_process": 2}
        for name, numbers in (("a", (0, 1)), ("b", (2, 3)))
    ]
    with sync.build_env_group(entries) as group:
        yield group


def collect_from_all(collector: Any, found: list[Rollout]) -> None:
    """Add rollouts until there are five, and transitions of each env."""
    while len(found) < 5 or len({*np.concatenate([one.index.flat for one in found])}) < 4:
        found += parts_of(collector.collect())


@pytest.mark.parametrize("call", ["first", "third"])
@pytest.mark.parametrize("kind", ["first ready", "blocks"])
def test_a_collector_can_be_restarted_wherever_it_was_interrupted(
    group: sync.EnvGroup, kind: str, call: str, pressed_again: list[bool]
) -> None:
    """Nothing that the interrupted call had half done comes back."""
    options = {"num_transitions": 8, "wait_all": True} if kind == "blocks" else {}
    for line in range(1, NUM_LINES, STRIDE):
        num_calls, found = [0], list[Rollout]()

        def counted(batch: BatchedData, num_calls: list[int] = num_calls) -> dict[str, Any]:
            num_calls[0] += 1
            return failing()(batch)

        policies = {"a": counted, "b": counted}
        with group.auto_reset(math.inf):
            collector: Any = Collector(group, policies, **{"num_transitions": 3, **options})
            for _ in range(2 if call == "third" else 0):
                found += parts_of(collector.collect())
            before = num_calls[0]
            reached, interrupted, rollout = struck(line, collector.collect)
            has_ended = interrupted and num_calls[0] > before
            if rollout is not None:
                found += parts_of(rollout)
            assert len(pressed_again) == (reached and not interrupted)
            pressed_again.clear()
            try:
                found += parts_of(collector.collect())
            except ResetNeeded:
                assert reached
                found, has_ended = [], False
                collector.restart()
            collect_from_all(collector, found)
        if not has_ended:  # Where a line ends the call, Python looks for no signals.
            check(found)
        with contextlib.suppress(NothingPending):
            while True:
                group.collect_async(wait_all=True)
        if not reached:
            break
    else:
        pytest.fail(f"a collect executes more than {NUM_LINES} lines")
