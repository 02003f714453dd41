"""An invalid request is refused with a reason before any part of it is sent."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, TypeAlias

import pytest
from kit.driven import Driven, on_one_driver
from kit.tokens import Tokens, two_workers

from rlightning_aio.errors import BadAction

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


@on_one_driver
def test_values_that_cannot_be_sent_are_refused_first(start: Start) -> None:
    """An argument of a call, options of a reset, an extra of one response among many."""
    group, tokens = start(two_workers(), preprocess_fn=lambda response: response.action), Tokens()
    lock = threading.Lock()
    with pytest.raises(TypeError, match=r"faulty-1.*can't be sent.*nothing was sent"):
        group.call("faulty-1", "do", lock)
    with pytest.raises(TypeError, match=r"can't be sent.*nothing was sent"):
        group.reset(options={"lock": lock})
    batch = tokens.steps(group.group.env_ids)
    batch.values()[3].lock = lock
    for step in (group.step, group.step_async):
        with pytest.raises(BadAction, match=r"faulty-3.*can't be sent.*nothing was sent"):
            step(batch)
    found, _ = group.step(tokens.steps(group.group.env_ids))
    tokens.check(found)
    assert found.observation[:, 3].tolist() == [1, 1, 1, 1]


def test_options_for_each_env_are_refused_with_the_way_to_give_them(build: Start) -> None:
    """They would reach each env as a whole. Nothing is sent."""
    group = build(two_workers())
    group.init()
    options: Any = [{"level": k} for k in range(4)]
    for reset in (group.reset, group.reset_async):
        with pytest.raises(TypeError, match=r"options must be a dict.*not a list.*env_ids="):
            reset(options=options)
    assert group.group.pending == []
    group.reset(options={"fault": "nothing"})
