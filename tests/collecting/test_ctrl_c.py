"""Ctrl-C at any moment of a synchronous collect: the next one goes on as if there had been none."""

from __future__ import annotations

import contextlib
import math
import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from collecting.test_interruptions import PER_ENTRY, SEED, check, parts_of
from combinations.played import Uneven
from faults.striking import hear_of_interrupt, struck

from rlightning_aio import sync
from rlightning_aio.collecting import Collector
from rlightning_aio.errors import NothingPending

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rlightning_aio.collecting import Rollout

pytestmark = pytest.mark.usefixtures("python_raises")
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "97"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
NUM_LINES = 9000
"""More lines than a collect executes."""


@pytest.fixture(scope="module")
def group() -> Iterator[sync.EnvGroup]:
    """Two entries, each with two envs in one worker."""
    entry = {"task": Uneven, "envs_per_process": 2, "num_workers": 2}
    with sync.build_env_group([{**entry, "name": name} for name in PER_ENTRY]) as group:
        yield group


@pytest.mark.parametrize("call", ["first", "third"])
@pytest.mark.parametrize("kind", ["first ready", "blocks"])
def test_a_collect_goes_on_wherever_it_was_interrupted(
    group: sync.EnvGroup, kind: str, call: str
) -> None:
    """The interrupted call raises KeyboardInterrupt, or returns a rollout; then the next does."""
    options = {"num_transitions": 8, "wait_all": True} if kind == "blocks" else {}
    for line in range(1, NUM_LINES, STRIDE):
        found: list[Rollout] = []
        with group.auto_reset(math.inf):
            collector: Any = Collector(
                group, PER_ENTRY, seed=SEED, **{"num_transitions": 3, **options}
            )
            for _ in range(2 if call == "third" else 0):
                found += parts_of(collector.collect())
            reached, interrupted, rollout = struck(line, collector.collect)
            if rollout is not None:
                found += parts_of(rollout)
            if reached and not interrupted:
                hear_of_interrupt(collector.collect)
            while len(found) < 5 or len({*np.concatenate([one.index.flat for one in found])}) < 4:
                found += parts_of(collector.collect())
        check(found, 4)
        with contextlib.suppress(NothingPending):
            while True:
                group.collect_async(wait_all=True)
        if not reached:
            break
    else:
        pytest.fail(f"a collect executes more than {NUM_LINES} lines")
