"""`try_out`: plays episodes of one env with random actions, and says what is wrong with it.

It looks for rewards that are no numbers, for observations of another dtype than their space, for
results that a seed doesn't repeat, for descriptors, threads, processes and memory that each episode
leaves behind, and for a setting that suits the time of a step. Left out: what a group refuses
anyway, such as observations outside their space.
"""

from __future__ import annotations

import math
import os
import pickle
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rlightning_aio._core.group.api.facade import ensure_auto_reset
from rlightning_aio._core.group.supervision.hint import BRIEF_US, TINY_US
from rlightning_aio._core.hosts.messages import CASTS
from rlightning_aio.cli.policies.collecting import Roster, respond_to_all, responder

if TYPE_CHECKING:
    from rlightning_aio._core.group.api.aio import EnvGroup
    from rlightning_aio._core.hosts.running.casts import Cast
    from rlightning_aio.batch import BatchedData

__all__ = ["Trial", "try_out"]

_REPEATED: Final = 100
"""Most steps that are done twice with the same seed."""
_SLACK_MB: Final = 16.0
"""Memory that caches may take between the second episode and the last."""


@dataclass
class Trial:
    """What was found.

    Attributes:
        episodes: that have ended.
        step_us: median time of a step in its env.
        casts: of parts of the observation.
        problems: in words, each with what to do.
        advice: on the settings of its entry.
    """

    episodes: int
    step_us: float
    casts: list[Cast]
    problems: list[str]
    advice: str


async def try_out(group: EnvGroup, steps: int) -> Trial:
    """Play so many steps of the only env of a group, and some of them once more."""
    (worker,), (meta,) = group.get_workers(), group.metas
    noted_casts = partial(group[meta.env_id].call, CASTS)
    await noted_casts()
    pid, samples, problems = worker["pid"] or "self", list[dict[str, float]](), list[str]()
    bad = 0
    respond = responder(group, Roster(group), None, 0)
    with ensure_auto_reset(group):
        batch, _ = await group.reset(seed=0)
        for _ in range(steps):
            await respond_to_all(group, respond, batch)
            batch, _ = await group.collect_async()
            bad += int(np.count_nonzero(~np.isfinite(batch.reward)))
            samples += [_held(pid)] * int(np.count_nonzero(batch.done & ~batch.is_reset))
        if bad:
            problems.append(f"{bad} of {steps} rewards are NaN or infinite")
        few = min(steps, _REPEATED)
        first, again = [await _played(group, few) for _ in range(2)]
        differs = next((k for k in range(few + 1) if first[k] != again[k]), None)
    if differs is not None:
        where = "the reset" if differs == 0 else f"step {differs}"
        problems.append(
            f"two episodes with the same seed and actions differ from {where} on: draw random "
            "numbers from a generator that reset(seed=…) seeds, such as gymnasium's np_random"
        )
    problems += _leaks(samples)
    step_us = group.get_stats()["latency_us"]["step"]["p50"]
    return Trial(len(samples), step_us, await noted_casts(), problems, _advice(step_us))


async def _played(group: EnvGroup, steps: int) -> list[bytes]:
    """Return what a reset with a seed and steps with actions of the same seed show."""
    respond = responder(group, Roster(group), None, 0)
    batch, _ = await group.reset(seed=1)
    results = [_contents(batch)]
    for _ in range(steps):
        await respond_to_all(group, respond, batch)
        batch, _ = await group.collect_async()
        results.append(_contents(batch))
    return results


def _contents(batch: BatchedData) -> bytes:
    parts: tuple[Any, ...] = batch.observation, batch.reward, batch.terminated, batch.truncated
    return pickle.dumps(parts)


def _held(pid: int | str) -> dict[str, float]:
    """Return what a process holds: open descriptors, threads, children, memory in MB."""
    process = Path(f"/proc/{pid}")
    if not process.exists():
        return {}
    children = sum(len(one.read_text().split()) for one in process.glob("task/*/children"))
    pages = int((process / "statm").read_text().split()[1])
    return {
        "open descriptors": len([*(process / "fd").iterdir()]),
        "threads": len([*(process / "task").iterdir()]),
        "child processes": children,
        "MB of memory": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
    }


def _leaks(samples: list[dict[str, float]]) -> list[str]:
    """Say what has grown from the second episode to the last; the first loads and compiles."""
    if len(samples) < 4:
        return []
    count, found = len(samples) - 2, list[str]()
    for name, before in samples[1].items():
        more = samples[-1].get(name, before) - before
        if more >= max(count / 2, 2) if name != "MB of memory" else more > _SLACK_MB:
            found.append(
                f"{more:.0f} more {name} after {count} episodes: close or drop in reset what the "
                "episode before has opened"
            )
    return found


def _advice(step_us: float) -> str:
    if not math.isfinite(step_us):
        return "no step was timed"
    if step_us < TINY_US:
        return "steps are so short that placement: inline may be fastest; `bench` measures it"
    if step_us < BRIEF_US:
        return "steps are short: let envs share workers (envs_per_process: 8, say)"
    return "steps are long enough for workers: envs_per_process auto, one worker to a core"
