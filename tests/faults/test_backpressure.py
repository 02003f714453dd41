"""A process that reads slowly or is stopped delays no other, and loses nothing."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from faults.test_shutdown import read_until, trainer
from kit.processes import kill, pid_of, stop
from kit.tokens import Tokens, marked, two_workers

if TYPE_CHECKING:
    from collections.abc import Callable

    from kit.driven import Driven

    Start: TypeAlias = Callable[..., Driven]

MEGABYTES = 8 * 2**20
"""More bytes than any pipe or socket buffers."""


def unpacked(response: Any) -> Any:
    """Return the action of a response that has a large array as an extra."""
    assert response.cargo.sum() == MEGABYTES
    return response.action


def loaded(batch: Any) -> Any:
    """Return `batch` with megabytes of extras for each env."""
    for response in batch.values():
        response.cargo = np.ones(MEGABYTES, np.uint8)
    return batch


def test_megabytes_for_a_stopped_worker_do_not_block_the_trainer(start: Start) -> None:
    """They wait until the worker reads; meanwhile the other worker replies."""
    group, tokens = start(two_workers(), preprocess_fn=unpacked), Tokens()
    pid = pid_of(group, "faulty-0")
    stop(pid)
    group.step_async(loaded(tokens.steps(["faulty-0", "faulty-1"])))
    for _ in range(10):
        group.step_async(loaded(tokens.steps(["faulty-2", "faulty-3"])))
        batch, _ = group.collect_async(min_results=2)
        tokens.check(batch)
        assert sorted(batch.ids()) == ["faulty-2", "faulty-3"]
    os.kill(pid, signal.SIGCONT)
    batch, _ = group.collect_async(wait_all=True)
    assert sorted(batch.ids()) == ["faulty-0", "faulty-1"]
    tokens.check(batch)


def test_megabytes_for_a_worker_that_dies_are_dropped(start: Start) -> None:
    """The rest is not sent to its replacement."""
    group, tokens = start(two_workers(), preprocess_fn=unpacked), Tokens()
    pid = pid_of(group, "faulty-0")
    stop(pid)
    group.step_async(loaded(tokens.steps(["faulty-0", "faulty-1"])))
    kill(pid)
    batch, _ = group.collect_async(wait_all=True)
    assert [marked(ret) for ret in batch.values()] == [True, True]
    tokens.check(group.step(loaded(tokens.steps(group.group.env_ids)))[0])


def test_an_unread_stderr_delays_nobody() -> None:
    """Neither an env that prints to it nor the news of deaths; what it can't take is dropped."""
    script = """
        import logging
        logging.disable()
        group = build(); group.init(); group.reset()
        group.step_async(tokens.steps(["faulty-0"], {"faulty-0": "print"}))
        for _ in range(3):
            batch, _ = group.step(tokens.steps(["faulty-3"], {"faulty-3": "exit 3"}))
            say(batch["faulty-3"].info["worker_restarted"])
            tokens.check(group.step(tokens.steps(["faulty-3"]))[0])
        batch, _ = group.collect_async()
        tokens.check(batch)
        say("printed by " + batch.ids()[0])
        group.close()
        say("closed")
    """
    with trainer(script) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        lines = read_until(process.stdout, "closed")
        assert sum("exited with code 3" in line for line in lines) == 3
        assert any("printed by faulty-0" in line for line in lines)
        written = process.stderr.read()
    assert 0 < written.count("e" * 1023 + "\n") < 3000
