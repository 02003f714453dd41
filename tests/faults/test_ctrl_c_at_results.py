"""Ctrl-C at any moment of a call of a synchronous group takes no result from the program."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from faults.striking import hear_of_interrupt, struck
from kit.scripted import Counts

import rlightning_aio.sync
from rlightning_aio.errors import EnvRaised, NothingPending

if TYPE_CHECKING:
    from collections.abc import Callable

PLACES: dict[str, list[dict[str, Any]]] = {
    "alone": [{"placement": "inline"}],
    "inline": [{"placement": "inline", "num_workers": 3}],
    "workers": [{"num_workers": 3, "envs_per_process": 2}],
    "both": [{"num_workers": 2, "envs_per_process": 1}, {"placement": "inline"}],
}
STRIDE = int(os.environ.get("RLIGHTNING_AIO_STRIDE", "17"))
"""Every so many lines, Ctrl-C is pressed; 1 takes minutes."""
pytestmark = pytest.mark.usefixtures("python_raises")
NUM_LINES = 4000
"""More lines than any of the calls below executes."""


class Serial(Counts):
    """Numbers what it is asked for, beginning with 1."""

    serial = 0

    def observed(self) -> Any:
        self.serial += 1
        return np.array([float(self.serial)])


class Answers:
    """Checks that each request of each env has one answer."""

    def __init__(self, group: Any) -> None:
        self.group = group
        self.last = dict.fromkeys(group.env_ids, 0)

    def take(self, answer: Any) -> None:
        """Take results: a batch, or a result of one env."""
        if isinstance(answer, tuple):
            pairs = zip(answer[0].ids(), answer[0].observation[:, 0].tolist(), strict=True)
        else:
            pairs = iter([(answer.env_id, int(answer.observation[0]))])
        for env_id, serial in pairs:
            assert serial == self.last[env_id] + 1, f"{env_id} has answered unheard"
            self.last[env_id] = serial

    def fail(self, fault: EnvRaised) -> None:
        """Take the error of an env that Ctrl-C has interrupted, before or after it counted."""
        assert fault.exception_type == "KeyboardInterrupt"
        self.last[fault.env_id] = self.group[fault.env_id].get_attr("serial")

    def take_outstanding(self) -> None:
        while True:
            try:
                self.take(self.group.collect_async())
            except NothingPending:
                break
            except EnvRaised as fault:
                self.fail(fault)


def step(group: Any, batch: Any) -> Any:
    return group.step(batch.respond(action=np.ones(len(batch), int)))


def step_async(group: Any, batch: Any) -> Any:
    group.step_async(batch.respond(action=np.ones(len(batch), int)))
    return group.collect_async(wait_all=True)


def step_one(group: Any, batch: Any) -> Any:
    return group[batch.ids()[-1]].step(1)


def reset(group: Any, batch: Any) -> Any:
    return group.reset(seed=4)


def reset_one(group: Any, batch: Any) -> Any:
    return group[batch.ids()[-1]].reset()


USES = [step, step_async, step_one, reset, reset_one]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("use", USES, ids=lambda use: use.__name__)
def test_no_result_is_lost_wherever_a_call_is_interrupted(
    use: Callable[[Any, Any], Any], place: str
) -> None:
    """The call raises KeyboardInterrupt, and its results are collected; or it returns them, and the
    next call raises it.
    """
    entries = [{"name": f"e{k}", "task": Serial, **one} for k, one in enumerate(PLACES[place])]
    with rlightning_aio.sync.build_env_group(entries) as group:
        answers = Answers(group)
        batch, flags = group.reset()
        answers.take((batch, flags))
        for _ in range(12):  # Until steps are ordinary.
            answers.take(step(group, batch))
        num_returned = num_raised = 0
        for line in range(1, NUM_LINES, STRIDE):
            try:
                found = struck(line, lambda: use(group, batch))
            except EnvRaised as fault:
                answers.fail(fault)
                continue
            reached, interrupted, returned = found
            if returned is not None:
                answers.take(returned)
            if not reached:
                break
            num_raised, num_returned = num_raised + interrupted, num_returned + (not interrupted)
            if not interrupted:
                hear_of_interrupt(group.collect_async)
            answers.take_outstanding()
        else:
            pytest.fail(f"a call executes more than {NUM_LINES} lines")
        answers.take(step(group, batch))
        assert num_raised > num_returned
