"""Inline envs share the trainer's process: their errors are reported, and so are interrupts."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, TypeAlias

import pytest
from faults.test_env_errors import RAISED, check_error
from kit.driven import Driven
from kit.tokens import Tokens, entry

from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

    Start: TypeAlias = Callable[..., Driven]


def test_an_error_of_an_inline_env_is_reported_and_it_stays_usable(start: Start) -> None:
    """As in a worker, SystemExit included."""
    group, tokens = start(entry(2, placement="inline")), Tokens()
    for name in RAISED:
        if name in ("interrupt", "keyboard interrupt"):
            continue
        with pytest.raises(EnvRaised) as caught:
            group.step(tokens.steps(group.group.env_ids, {"faulty-1": name}))
        check_error(caught.value, name, "step")
        with pytest.raises(EnvRaised) as caught:
            group.call("faulty-1", "do", name)
        check_error(caught.value, name, "the call of do()")
        group.reset(env_ids=["faulty-1"])
        tokens.check(group.step(tokens.steps(group.group.env_ids))[0])


def test_interrupt_in_an_inline_step_comes_out_and_ends_its_request() -> None:
    """Ctrl-C reaches the program; the interrupted env has an error, the others have results."""
    group, tokens = Driven("sync", entry(3, placement="inline")), Tokens()
    group.init()
    group.reset()
    group.call("faulty-1", "answer_with", info=lambda: signal.raise_signal(signal.SIGINT))
    group.step_async(tokens.steps(group.group.env_ids))
    with pytest.raises(KeyboardInterrupt):
        group.collect_async(wait_all=True)
    with pytest.raises(EnvRaised, match=r"faulty-1.*KeyboardInterrupt"):
        group.collect_async(wait_all=True)
    batch, _ = group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == ["faulty-0", "faulty-2"]
    tokens.check(batch)
    group.reset()
    tokens.check(group.step(tokens.steps(group.group.env_ids))[0])
    group.end()
