"""The same faults in Gymnasium's AsyncVectorEnv and in this package, compared by results.

Gymnasium's side is asserted, too: if it improves, the README must change. Each answer is the token
of its action, so an answer to another step is noticed.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError
from gymnasium.spaces import Box
from gymnasium.vector import AsyncVectorEnv

from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Iterator

NOTHING, KILL, RAISE_ODDLY, WAIT_FOR_GATE = range(4)
FIRST, SECOND = 1.0, 2.0
"""Tokens of the two steps."""
LIMIT = 0.1
"""Seconds that the caller waits for a step; the late step takes until the gate opens."""


class OddError(Exception):
    """Can't be rebuilt from its text, like many exceptions of simulators."""

    def __init__(self, *, code: int) -> None:
        super().__init__(f"the simulator failed with code {code}")


class Breakable(gym.Env[Any, Any]):
    """Fails when its action says so; a late step waits until somebody opens and closes a FIFO."""

    observation_space = action_space = Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self, gate: str) -> None:
        self.gate = gate

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        super().reset(seed=seed, options=options)
        return np.zeros(2), {}

    def step(self, action: Any) -> Any:
        fault, token = action.tolist()
        if fault == KILL:
            os.kill(os.getpid(), signal.SIGKILL)
        elif fault == RAISE_ODDLY:
            raise OddError(code=7)
        elif fault == WAIT_FOR_GATE:
            Path(self.gate).read_bytes()
        return np.zeros(2), token, False, False, {}


def actions(fault: int, token: float) -> np.ndarray[Any, Any]:
    """Return a batch whose second action causes the fault."""
    return np.array([[NOTHING, token], [fault, token]])


@pytest.fixture
def gate(tmp_path: Path) -> str:
    """Return the path of a FIFO."""
    os.mkfifo(tmp_path / "gate")
    return str(tmp_path / "gate")


@pytest.fixture
def theirs(gate: str) -> Iterator[AsyncVectorEnv]:
    """Two envs of Gymnasium's, with a process each."""
    envs = AsyncVectorEnv([partial(Breakable, gate)] * 2, shared_memory=False)
    envs.reset()
    yield envs
    # After these faults its own `close` raises or never returns.
    for process in envs.processes:
        process.terminate()
        process.join()
    vars(envs).clear()  # Its pipes and semaphores, which pytest would keep.
    envs.closed = True


@pytest.fixture
def ours(gate: str) -> Iterator[sync.EnvGroup]:
    """Two envs of a group, with a worker each."""
    fields = {"num_workers": 2, "envs_per_process": 1}
    with sync.build_env_group(partial(Breakable, gate), name="e", **fields) as group:
        yield group


def test_late_step_is_not_taken_for_the_next_one(
    theirs: AsyncVectorEnv, ours: sync.EnvGroup, gate: str
) -> None:
    """After a timeout, Gymnasium answers the second step with the results of the first."""
    theirs.step_async(actions(WAIT_FOR_GATE, FIRST))
    with pytest.raises(multiprocessing.TimeoutError):
        theirs.step_wait(timeout=LIMIT)
    Path(gate).write_bytes(b"")
    assert theirs.step(actions(NOTHING, SECOND))[1].tolist() == [FIRST, FIRST]

    batch, _ = ours.reset()
    ours.step_async(batch.respond(action=actions(WAIT_FOR_GATE, FIRST)))
    with pytest.raises(TimeoutError):
        ours.collect_async(wait_all=True, deadline=LIMIT)
    Path(gate).write_bytes(b"")
    late, _ = ours.collect_async(wait_all=True)
    assert late.reward.tolist() == [FIRST, FIRST]
    batch, _ = ours.step(batch.respond(action=actions(NOTHING, SECOND)))
    assert batch.reward.tolist() == [SECOND, SECOND]


def test_killed_worker_is_named_with_its_cause_and_replaced(
    theirs: AsyncVectorEnv, ours: sync.EnvGroup
) -> None:
    """Gymnasium reports neither env nor cause, and can't step any more."""
    with pytest.raises((EOFError, ConnectionResetError)) as raised:
        theirs.step(actions(KILL, FIRST))
    assert "SIGKILL" not in str(raised.value)
    with pytest.raises(AlreadyPendingCallError):
        theirs.step(actions(NOTHING, SECOND))

    batch, _ = ours.reset()
    results, _ = ours.step(batch.respond(action=actions(KILL, FIRST)))
    assert results["e-1"].info["worker_restarted"].startswith("was killed by SIGKILL")
    assert results["e-0"].last_reward == FIRST
    batch, _ = ours.step(batch.respond(action=actions(NOTHING, SECOND)))
    assert batch.reward.tolist() == [SECOND, SECOND]


def test_error_that_cant_be_rebuilt_arrives_complete(
    theirs: AsyncVectorEnv, ours: sync.EnvGroup
) -> None:
    """Gymnasium raises the error of rebuilding it, and the original text is lost."""
    with pytest.raises(TypeError, match=r"OddError.__init__\(\)"):
        theirs.step(actions(RAISE_ODDLY, FIRST))
    with pytest.raises(AlreadyPendingCallError):
        theirs.step(actions(NOTHING, SECOND))

    batch, _ = ours.reset()
    with pytest.raises(EnvRaised, match="the simulator failed with code 7") as raised:
        ours.step(batch.respond(action=actions(RAISE_ODDLY, FIRST)))
    assert raised.value.env_id == "e-1"
    assert "raise OddError(code=7)" in raised.value.traceback_text
    assert raised.value.results["e-0"].last_reward == FIRST
    ours.reset(env_ids=["e-1"])
    batch, _ = ours.step(batch.respond(action=actions(NOTHING, SECOND)))
    assert batch.reward.tolist() == [SECOND, SECOND]
