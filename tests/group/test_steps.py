"""When steps are ordinary; that others give the same results, random programs show."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from group.fake_host import PLAIN, FakeGroup

from rlightning_aio.protocol import kernel

pytestmark = pytest.mark.usefixtures("implementation")


def test_steps_are_ordinary_before_and_after_a_death() -> None:
    """Steps are not ordinary until the replacement has shown that it works."""
    group = FakeGroup([2, 2])

    def finish_all() -> None:
        for host in group.hosts:
            while host.waiting:
                group.finish(host.first_slot + host.waiting[0][0])

    running = group.begin(group.core.reset(group.now, None, None, None))
    finish_all()
    batch, _ = running.result()
    published: list[bool] = []

    def turn() -> None:
        nonlocal batch
        with patch.object(kernel, "submit", wraps=kernel.submit) as submit:
            step = group.steps.step(batch.respond(action=np.full(4, PLAIN)), group.now)
            running = group.begin(step)
        published.append(submit.called)
        finish_all()
        batch, _ = running.result()

    turn()
    group.hosts[0].die()
    group.turn()
    for _ in range(3):
        turn()
    assert published == [True, False, False, True]
    group.close()
