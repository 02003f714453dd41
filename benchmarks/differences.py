"""The effects of a late step, a killed worker and an error that can't be rebuilt.

    python benchmarks/differences.py

The same two environments with the same actions, in Gymnasium's AsyncVectorEnv and in
rlightning_aio; the second environment fails. Each answer is the token of its action, so an
answer to another step is noticed.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from breakable import KILL, NOTHING, RAISE_ODDLY, WAIT_FOR_GATE, Breakable
from gymnasium.vector import AsyncVectorEnv

from rlightning_aio import sync
from rlightning_aio.errors import EnvRaised

if TYPE_CHECKING:
    from collections.abc import Callable

FIRST, SECOND = 1.0, 2.0
"""Tokens of the two steps."""
LIMIT = 0.1
"""Seconds that the caller waits for a step; the late step takes until the gate opens."""
ROWS = {
    "raised": "the caller gets",
    "marked": "marks the result",
    "env_id": "names the environment",
    "late": "the late step's answers",
    "unhurt": "the other environment's answer",
    "asked": "the next step asks for",
    "answered": "the next step's answers",
    "afterwards": "the next step",
}
LATE, KILLED, ODD = "a step that comes late", "a killed worker", "an error that can't be rebuilt"


def actions(fault: int, token: float) -> np.ndarray:
    """Return a batch whose second action causes the fault."""
    return np.array([[NOTHING, token], [fault, token]])


def text_of(error: BaseException) -> str:
    """Return an error as one line."""
    text = " ".join(str(error).split("\n", maxsplit=1)[0].split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def answers(rewards: np.ndarray) -> str:
    """Return the results of a step after the fault."""
    return f"answers {rewards.tolist()}"


def open_gate(gate: str) -> None:
    """Let the late step continue; return when it does."""
    Path(gate).write_bytes(b"")


# -- Gymnasium ------------------------------------------------------------------------


def gymnasium_late(gate: str) -> dict[str, Any]:
    """Time out on the first step, then request the second."""
    envs = AsyncVectorEnv([partial(Breakable, index, gate=gate) for index in range(2)])
    envs.reset()
    envs.step_async(actions(WAIT_FOR_GATE, FIRST))
    try:
        envs.step_wait(timeout=LIMIT)
        raised = None
    except multiprocessing.TimeoutError as error:
        raised = text_of(error)
    open_gate(gate)
    answered = envs.step(actions(NOTHING, SECOND))[1]
    end(envs)
    return {"raised": raised, "asked": SECOND, "answered": answered.tolist()}


def gymnasium_fault(fault: int) -> dict[str, Any]:
    """Let the second environment fail in a step, then continue."""
    envs = AsyncVectorEnv([partial(Breakable, index) for index in range(2)])
    envs.reset()
    raised = afterwards = None
    try:
        envs.step(actions(fault, FIRST))
    except Exception as error:  # noqa: BLE001  # Whatever it is, it is what we look for.
        raised = text_of(error)
    try:
        afterwards = answers(envs.step(actions(NOTHING, SECOND))[1])
    except Exception as error:  # noqa: BLE001
        afterwards = text_of(error)
    end(envs)
    return {"raised": raised, "afterwards": afterwards}


def end(envs: AsyncVectorEnv) -> None:
    """End its processes: after these faults its own `close` raises or never returns."""
    for process in envs.processes:
        process.terminate()
        process.join()
    envs.closed = True


# -- rlightning_aio -------------------------------------------------------------------


def group_of(gate: str | None = None) -> sync.EnvGroup:
    """Return a group of two environments, each in its own worker, as in Gymnasium."""
    entry = {
        "name": "e",
        "backend": "breakable",
        "task": "anything",
        "num_workers": 2,
        "envs_per_process": 1,
        "env_kwargs": {"gate": gate},
        "imports": ["breakable"],
    }
    return sync.build_env_group(entry)


def ours_late(gate: str) -> dict[str, Any]:
    """Time out on the first step, collect it late, then request the second."""
    with group_of(gate) as group:
        batch, _ = group.reset()
        group.step_async(batch.respond(action=actions(WAIT_FOR_GATE, FIRST)))
        raised = None
        try:
            group.collect_async(wait_all=True, deadline=LIMIT)
        except TimeoutError as error:
            raised = text_of(error)
        open_gate(gate)
        late, _ = group.collect_async(wait_all=True)
        batch, _ = group.step(batch.respond(action=actions(NOTHING, SECOND)))
        return {
            "raised": raised,
            "late": late.reward.tolist(),
            "asked": SECOND,
            "answered": batch.reward.tolist(),
        }


def ours_killed() -> dict[str, Any]:
    """Kill the second environment's worker in a step, then continue."""
    with group_of() as group:
        batch, _ = group.reset()
        results, _ = group.step(batch.respond(action=actions(KILL, FIRST)))
        cause = results["e-1"].info["worker_restarted"]
        unhurt = results["e-0"].last_reward
        batch, _ = group.step(batch.respond(action=actions(NOTHING, SECOND)))
        return {"marked": cause, "unhurt": unhurt, "afterwards": answers(batch.reward)}


def ours_odd() -> dict[str, Any]:
    """Let the second environment raise in a step, then continue."""
    with group_of() as group:
        batch, _ = group.reset()
        found: dict[str, Any] = {}
        try:
            group.step(batch.respond(action=actions(RAISE_ODDLY, FIRST)))
        except EnvRaised as error:
            found = {
                "raised": text_of(error),
                "env_id": error.env_id,
                "traceback": error.traceback_text,
                "unhurt": error.results["e-0"].last_reward,
            }
        group.reset(env_ids=["e-1"])
        batch, _ = group.step(batch.respond(action=actions(NOTHING, SECOND)))
        return {**found, "afterwards": answers(batch.reward)}


# -- both -----------------------------------------------------------------------------


def with_gate(work: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Run work that needs a FIFO."""
    with tempfile.TemporaryDirectory() as folder:
        gate = str(Path(folder) / "gate")
        os.mkfifo(gate)
        return work(gate)


def differences() -> dict[str, dict[str, dict[str, Any]]]:
    """Return the outcomes by situation and library."""
    return {
        LATE: {"gymnasium": with_gate(gymnasium_late), "ours": with_gate(ours_late)},
        KILLED: {"gymnasium": gymnasium_fault(KILL), "ours": ours_killed()},
        ODD: {"gymnasium": gymnasium_fault(RAISE_ODDLY), "ours": ours_odd()},
    }


def table(found: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the outcomes as Markdown."""
    title = f"Gymnasium {gym.__version__} AsyncVectorEnv"
    lines = [f"| situation | | {title} | rlightning_aio |", "|---|---|---|---|"]
    for situation, sides in found.items():
        theirs, ours = sides["gymnasium"], sides["ours"]
        for name, row in ROWS.items():
            if name in theirs or name in ours:
                cells = [str(side.get(name, "")) for side in (theirs, ours)]
                lines.append(f"| {situation} | {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write what happened to this file")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    found = differences()
    print(table(found))
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
